"""Tests the assumptions of hgn.hydra_compat about Hydra."""

import pytest

from hgn.hydra_compat import compose
from hgn.schema import ConfigError


def test_canary(tmp_path):
    """Dataclasses are bases under their dotted names, also in groups. Values that Hydra's grammar refuses are quoted,
    and unknown keys are added. Hydra's own entry point composes the same. A missing required key is named."""
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "wide.yaml").write_text("defaults:\n  - hgn.config.SceneConfig\ngroup_size: 0.5\n")
    (tmp_path / "made.yaml").write_text(
        "defaults:\n  - hgn.evaluate.EvaluateConfig\n  - scene: wide\n  - _self_\nweights: x\n"
    )
    arguments = ["made", "data=my data (1)/ü", "scene.group_count=3", "invented.key=1"]
    (composed,) = compose(tmp_path, "made", arguments)
    assert (composed["data"], composed["weights"], composed["split"]) == ("my data (1)/ü", "x", "validation")
    assert composed["scene"]["group_size"] == 0.5 and composed["scene"]["group_count"] == 3
    assert composed["scene"]["materials"] == ["water", "sand", "snow"] and composed["invented"] == {"key": 1}
    assert compose(tmp_path, "made", [*arguments, "hydra.job.name=x"]) == [composed]
    twice = compose(tmp_path, "made", ["made", "--multirun", *arguments[1:], "weights=a,b"])
    assert [each["weights"] for each in twice] == ["a", "b"]
    with pytest.raises(ConfigError, match="data is missing; it must be given, as in data=…"):
        compose(tmp_path, "made", ["made"])
    assert compose(tmp_path, "made", ["made"], complete=False)[0]["data"] == "???"
