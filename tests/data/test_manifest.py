"""The manifest and the identity of a data set."""

import asyncio
import dataclasses
import errno
import functools
import json
import math
import operator

import pytest

from datagen.pool.writer import DatasetWriter
from datagen.service.server import Published
from hgn.data.identity import dataset_identity, identity_differences, identity_hash
from hgn.data.manifest import EpisodeEntry, Manifest, QuarantinedScene, ShardEntry
from hgn.data.reader import EpisodeStore
from hgn.data.statistics import Moments, Statistics
from hgn.schema import ConfigError
from hgn.system import files


def test_roundtrip(tmp_path):
    """Saving and loading returns every field, floats bitwise; what is published is counted."""
    entry = EpisodeEntry("train-000000", 0, 2**62, 1, 4296, 300, {"position.npy": (512, 15_465_728)})
    moments = Moments(7, (0.1, -0.2, 1e-300), (1 / 3, 0.0, 2.0))
    shard = ShardEntry("train-000000-000001.tar", "train", 0, 1, "ab" * 32, 999, (entry,), Statistics(moments))
    config, requested = {"scene": {"gravity": [0.0, -9.8, 0.0]}}, {"train": 1, "validation": 1, "test": 0}
    failures = [QuarantinedScene("train-000000", 0, 5, "diverged")]
    saved = Manifest(identity_hash(config), config, requested, 3).save(tmp_path, [shard], failures)
    manifest = Manifest.load(tmp_path)
    assert manifest == saved and list(manifest.shards) == [shard] and manifest.quarantined == failures
    assert (manifest.config, manifest.requested, manifest.revision) == (config, requested, 3)
    assert {path.name for path in tmp_path.iterdir()} == {"manifest.json", "index"}
    assert (manifest.published("train"), manifest.published("validation")) == (1, 0) and not manifest.complete
    assert dataclasses.replace(manifest, requested={"train": 1}).complete
    assert manifest.statistics("train").velocity.count == 7 and manifest.statistics("test") == Statistics()


def test_missing_manifest(tmp_path):
    """A folder without a data set is named together with the command that makes one."""
    for folder in (tmp_path, tmp_path / "nowhere"):
        assert not EpisodeStore.available(folder)
        with pytest.raises(ConfigError, match=r"manifest\.json must be the manifest .* generate one with"):
            Manifest.load(folder)


def test_identity(make_config):
    """The identity in a manifest hashes to the manifest's hash, in any key order; keys on one side are differences."""
    identity = dataset_identity(make_config())
    reread = json.loads(json.dumps(dict(reversed(identity.items()))))
    assert identity_hash(reread) == identity_hash(identity) and identity_differences(reread, identity) == []
    lines = identity_differences({"a": {"b": 1, "c": 2}, "d": 3}, {"a": {"b": 1, "c": 4}, "e": 5})
    differences = ["a.c is 2 there, 4", "d is 3 there, nothing", "e is nothing there, 5"]
    assert lines == [f"{difference} is requested" for difference in differences]
    stored, other = ({"shapes": ["cone", "a rock.obj " + 64 * digit, "b.obj " + 64 * "a"]} for digit in "48")
    assert identity_differences(stored, other) == ["shapes: a rock.obj was changed"]
    assert identity_differences(stored, {"shapes": ["cone"]}) == [
        "shapes is ['cone', 'a rock.obj', 'b.obj'] there, ['cone'] is requested"
    ]


def test_manifest_that_is_replaced_while_it_is_read(make_config, folder, monkeypatch):
    """On NFS an open file is lost when another machine replaces it. Reader, writer and service then read the new
    file."""
    real, lost = files.open_at_once, 0

    def opened(path):
        nonlocal lost
        if path.name == "manifest.json" and (lost := lost + 1) % 3:
            raise OSError(errno.ESTALE, "Stale file handle")
        return real(path)

    monkeypatch.setattr(files, "open_at_once", opened)
    assert Manifest.load(folder).complete
    with DatasetWriter(make_config()) as writer:
        assert writer.complete
    asyncio.run(Published(folder).snapshot())
    assert lost >= 9


CUT = r"manifest\.json must be JSON .* run the generator again without manifest.json"
FAULTS = [  # the place in a manifest or in a line of its index, its value, the message
    *(("", content, CUT) for content in (b"", b"{", b"\xff\xfe")),
    ("", b'{"revision": 3, "revision": 4}', "must be JSON .* got the key revision is given twice"),
    ("schema_version", 2, "schema_version must be 1, got 2; .* or use the version that made it"),
    ("colour", 1, "colour is not a known key"),
    ("revision", "3", "revision must be a whole number, got '3'"),
    ("config_hash", "0" * 64, "config_hash must be"),
    *(
        (f"config.{key}", value, f"config.{key} must be a whole number")
        for key in ("frames", "long_frames")
        for value in ("x", [6], None, 6.0, 0)
    ),
    ("requested.dev", 1, "requested must be for train, validation, test"),
    ("index", None, r"index must be given, got None; release 0\.1\.0 listed the shards here"),
    ("shards.0.bytes", None, r"jsonl\.bytes must be a whole number"),
    ("shards.0.bytes", -1, r"jsonl\.bytes must be a finite number >= 0"),
    ("shards.0.statistics.velocity.mean", [math.nan, 0, 0], "must be JSON .* got NaN"),
    *(
        (f"shards.0.statistics.velocity.{name}", [0, 1e300, 0], "must be at most 1e15 in size, with count and squares")
        for name in ("mean", "squared_deviation")
    ),
    ("shards.0.statistics.velocity.squared_deviation", [1, -1, 1], "with count and squares >= 0"),
    ("shards.0.statistics.velocity.count", -1, "must be at most 1e15 in size, with count"),
    # names and hashes become paths: what could lead elsewhere is refused
    ("shards.0.name", "../../etc/passwd", r"jsonl\.name must be a plain file name"),
    ("shards.0.name", ".lock", r"jsonl\.name must be a plain file name"),
    ("shards.0.sha256", "../" * 10 + "evil", r"jsonl\.sha256 must be 64 hexadecimal digits"),
    ("shards.0.split", "../train", r"jsonl\.split must be one of"),
    ("shards.0.episodes", [], r"episodes must be numbers 0 to 0, got \[\]"),
    # what the shard contradicts is never read out of range
    ("shards.0.episodes.0.seed", 1, "must have seed, particles, frames"),
    ("shards.0.episodes.0.members", {"position.npy": [10**9, 4]}, "must lie within"),
    ("shards.0.episodes.0.members", {"position.npy": [0, 2000]}, "json is missing"),
]


@pytest.mark.parametrize(("place", "value", "message"), FAULTS)
def test_faulty_manifests_are_refused(folder, place, value, message):
    """What is no JSON, of another schema or type, contradicts itself or its shards, or leads out of the folder, is
    refused by name."""
    path, lines = folder / "manifest.json", folder / "index" / "1-000000.jsonl"
    stored = json.loads(path.read_bytes())
    shards = [json.loads(line) for line in lines.read_text().splitlines()]
    *parents, key = (int(word) if word.isdigit() else word for word in place.split("."))
    owner = functools.reduce(operator.getitem, parents, stored | {"shards": shards} if parents else stored)
    owner[key] = value
    if value is None and key == "index":
        del stored["index"]
    lines.write_text("".join(json.dumps(shard) + "\n" for shard in shards))
    if "index" in stored:
        stored["index"]["segment_bytes"] = lines.stat().st_size
    path.write_bytes(json.dumps(stored).encode() if place else value)
    with pytest.raises(ConfigError, match=message):
        _ = EpisodeStore(folder, "train")[0]


def test_shards_that_are_listed_twice(folder):
    """The same episodes in two lines are refused."""
    manifest = Manifest.load(folder)
    manifest.save(folder, [*manifest.shards, manifest.shards[0]])
    with pytest.raises(ConfigError, match="must be listed once, got its episodes twice"):
        _ = EpisodeStore(folder, "train")[0]
