"""Fresh test sets: the seed is drawn once weights are frozen, and reports say so."""

import json
import re

import pytest

from datagen.generate import datagen_config
from hgn.data.fresh import draw_fresh, read_fresh, set_record
from hgn.data.manifest import Manifest
from hgn.data.verification import file_sha256
from hgn.schema import ConfigError


@pytest.fixture
def weights(tmp_path):
    path = tmp_path / "own.safetensors"
    path.write_bytes(b"frozen")
    return path


def test_the_seed_is_drawn_once(weights, tmp_path):
    """A folder keeps its seed, its time and the hashes through further starts; another folder has another seed."""
    mapping = {"out": str(tmp_path / "fresh"), "frozen": [str(weights)], "dataset": {"training_scenes": 0}}
    first, again = datagen_config(mapping), datagen_config(mapping)
    other = datagen_config(mapping | {"out": str(tmp_path / "other")})
    assert first.dataset.seed == again.dataset.seed != other.dataset.seed
    fresh = read_fresh(tmp_path / "fresh")
    assert fresh is not None and fresh.weights == {"own.safetensors": file_sha256(weights)}
    assert re.fullmatch(r"20\d\d-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00", fresh.drawn)
    assert datagen_config({"out": str(tmp_path / "plain"), "frozen": None}).dataset.seed == 0
    assert read_fresh(tmp_path / "plain") is None and not (tmp_path / "plain").exists()


def test_what_reports_say_of_a_set(weights, tmp_path):
    """Seed and time of a fresh set, and which weights are younger or others than those frozen; none of a chosen set."""
    folder = tmp_path / "fresh"
    fresh = draw_fresh(folder, [str(weights)])
    said = set_record(folder, fresh.seed, [weights])
    assert said == {"seed": fresh.seed, "drawn": fresh.drawn, "not_frozen_before": []}
    assert read_fresh(f"file://{folder}") == fresh
    weights.write_bytes(b"trained on")
    assert set_record(folder, fresh.seed, [weights])["not_frozen_before"] == ["own.safetensors"]
    chosen = set_record(tmp_path, 3, [weights])
    assert chosen == {"seed": 3, "drawn": None, "not_frozen_before": ["own.safetensors"]}
    with pytest.raises(ConfigError, match=r"fresh\.json: seed must be the data set's own"):
        set_record(folder, fresh.seed + 1, [weights])
    message = r"fresh\.json must be a file that python -m datagen frozen=… wrote, got .*"
    for text, cause in ((json.dumps({"seed": "x"}), "seed must be"), ('{"seed": 1, "seed": 2}', "seed is given twice")):
        (folder / "fresh.json").write_text(text)
        with pytest.raises(ConfigError, match=message + cause):
            read_fresh(folder)


def test_what_is_no_fresh_set_is_refused(weights, tmp_path, folder):
    """A data set that is there, weights that changed since, files that are not there."""
    assert Manifest.load(folder).complete
    with pytest.raises(ConfigError, match=r"frozen must be left out, because the seed of .* was not drawn"):
        draw_fresh(folder, [str(weights)])
    draw_fresh(tmp_path / "fresh", [str(weights)])
    weights.write_bytes(b"changed")
    with pytest.raises(ConfigError, match="changed weights need another folder"):
        draw_fresh(tmp_path / "fresh", [str(weights)])
    with pytest.raises(ConfigError, match=r"frozen\[0\] must be an existing file of weights, got 'none'"):
        draw_fresh(tmp_path / "fresh", ["none"])
