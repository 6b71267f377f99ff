"""python -m tools.studies.solver_targets: a row for each case; no time for what fails or differs."""

import json
import sys

import pytest

from datagen.mpm import solver, team_launch
from hgn.config import MpmConfig
from hgn.data.manifest import Manifest
from hgn.schema import ConfigError
from tools.bench.states import Workload, scene_of
from tools.studies import solver_targets
from tools.studies.solver_targets import main, table, timed


def test_rows_and_table(tmp_path, monkeypatch):
    """Rows name case, milliseconds and check, the plain prototype's too; what fell elsewhere than ours is red."""
    monkeypatch.setattr(solver_targets, "CUBE_SIZE", 0.03)
    file = tmp_path / "made" / "times.json"
    given = {"cases": ["one_scene_te_step", "plain_one_scene_te_step"], "frames": 6, "device": "cpu"}
    assert main({**given, "json": str(file)}) == 0
    rows = json.loads(file.read_text())["rows"]
    assert [row["case"] for row in rows] == given["cases"]
    assert all(row["ms"] > 0 and row["check"] == "green" and row["substeps"] == 55 for row in rows)
    assert "| one_scene_te_step " in table(rows)
    monkeypatch.setattr(solver_targets, "FALL", 0.0)
    assert main({**given, "cases": ["plain_one_scene_te_step"]}) == 1


def test_no_time_for_a_failure(monkeypatch):
    """Scenes that fail, and paths that lead elsewhere than the other launch, have a cause in place of a time."""
    scene = [scene_of(Workload(40, 1), 0, 0.035)]
    row = timed(scene, MpmConfig(device="cpu", maximum_substeps_per_frame=1), 4)
    assert row["ms"] is None
    assert "maximum_substeps_per_frame = 1" in table([{"case": "one_scene", "target": None} | row])
    monkeypatch.setattr(solver_targets, "LATER_FRAMES", -1.0)
    assert timed(scene, MpmConfig(device="cpu"), 4)["ms"] is None


def test_a_team_that_is_compared(monkeypatch):
    """A scene can be run by another team than the solver takes. Where blocks are not at work at once it has no time."""
    scene, mpm = [scene_of(Workload(40, 1), 0, 0.035)], MpmConfig(device="cpu")
    assert timed(scene, mpm, 4, team=(1, 1, 4))["check"] == "green"
    monkeypatch.setattr(solver, "_teams_at_once", lambda *_: 1)
    monkeypatch.setattr(team_launch, "PATIENCE", (10_000, 10_000))
    row = timed(scene, mpm, 4, team=(1, 9, 4))
    assert row["ms"] is None and "does not run 9 blocks" in row["check"]
    with pytest.raises(ConfigError, match="team must be null with dataset_800"):
        main({"cases": ["dataset_800"], "team": [256, 3, 4]})


MAKES = """
import shutil, sys, time
data, *arguments = sys.argv[1:]
out = dict(argument.split("=") for argument in arguments)["out"]
shutil.copytree(data, out)
time.sleep(60 if "slow" in out else 0)
"""


@pytest.mark.parametrize(("name", "seconds", "check"), [("quick", 60, "green"), ("slow", 3, "5 scenes after 3 s")])
def test_a_data_set_that_is_kept(folder, tmp_path, monkeypatch, name, seconds, check):
    """Its episodes stay where they are wanted, also where it is stopped, which has no time; it is not gone on with."""
    monkeypatch.setattr(solver_targets, "GENERATOR", (sys.executable, "-c", MAKES, str(folder)))
    kept, file = tmp_path / name, tmp_path / "times.json"
    given = {"cases": ["dataset_800"], "device": "cpu", "folder": str(kept), "seconds": seconds, "json": str(file)}
    assert main(given) == (check != "green")
    (row,) = json.loads(file.read_text())["rows"]
    assert row["check"] == check and (row["seconds"] is None) == (check != "green")
    assert Manifest.load(kept).published("train") == 5
    with pytest.raises(ConfigError, match="folder must be one without a data set"):
        main(given)
