"""python -m tools.studies.solver_times: a row for each number of scenes and of particles; no time for what fails."""

import json
from pathlib import Path

import pytest

from hgn.config import MpmConfig
from hgn.schema import ConfigError
from tools.bench.states import Workload, scene_of
from tools.studies.solver_times import _timed, main, table


def test_rows_and_table(tmp_path: Path) -> None:
    """Each row names its scenes, particles, steps and milliseconds; the table and the JSON hold the same."""
    file = tmp_path / "made" / "times.json"
    given = {"scenes": [1], "particles": [60], "scene_frames": 3, "particle_frames": 3, "device": "cpu"}
    assert main({**given, "json": str(file)}) == 0
    rows = json.loads(file.read_text())["rows"]
    assert [(row["case"], row["scenes"]) for row in rows] == [("random scenes with obstacles", 1), ("one scene", 1)]
    assert rows[1]["particles"] == 60
    assert all(row["ms"] > 0 and row["substeps"] >= 54 for row in rows)
    assert "| one scene | 1 | 60 |" in table(rows)


def test_no_time_for_a_failure() -> None:
    """A contender whose scene needs more steps than it may take has a cause in the place of a time."""
    row = _timed([scene_of(Workload(40, 1), 0, 0.035)], MpmConfig(device="cpu", maximum_substeps_per_frame=1), 3)
    assert row["ms"] is None
    assert "maximum_substeps_per_frame = 1" in table([{"case": "one scene"} | row])


def test_bad_input() -> None:
    """Numbers that time nothing are refused by name."""
    with pytest.raises(ConfigError, match=r"scene_frames must be at least 3"):
        main({"scene_frames": 2})
