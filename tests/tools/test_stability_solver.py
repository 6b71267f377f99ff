"""python -m tools.stability solver: its rows, and that a step beyond the formula is seen."""

import json
from pathlib import Path

import numpy as np
import pytest

from hgn.config import MpmConfig
from hgn.schema import ConfigError
from tools.stability import solver_steps
from tools.stability.solver import main
from tools.stability.solver_leak import _crossing_paths
from tools.stability.solver_scenes import front_cells, thickness_cells


def test_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The largest step of a single particle lies at the formula; rows and points are in the JSON, and are drawn."""
    monkeypatch.setattr(solver_steps, "STIFFNESS", (1.0,))
    monkeypatch.setattr(solver_steps, "FACTORS", (0.97, 1.1))
    monkeypatch.setattr(solver_steps, "SOLID_FACTORS", (1.0,))
    file, picture = tmp_path / "reports" / "solver.json", tmp_path / "steps.png"
    assert main({"cases": ["steps"], "device": "cpu", "json": str(file), "picture": str(picture)}) == 0
    report = json.loads(file.read_text())
    assert {"device", "versions", "commit", "date", "command", "config", "solver"} <= report["meta"].keys()
    assert [row["held"] for row in report["rows"]] == [True] * 4
    assert all({"part", "case", "predicted", "measured", "beyond"} <= row.keys() for row in report["rows"])
    singles = [point["stable"] for point in report["steps"] if point["case"].startswith("single")]
    assert singles == [True, False, True, False]
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "single particle, water" in capsys.readouterr().out


def test_formula() -> None:
    """dx sqrt(rho / (3 lambda + 2 mu)): 5.41e-4 s for water and 3.83e-4 s for solids at the default settings."""
    config = MpmConfig()
    assert [round(solver_steps.formula(config, kind), 6) for kind in range(3)] == [5.41e-4, 3.83e-4, 3.83e-4]


def test_crossing_paths() -> None:
    """Only a way through the triangle counts: not one beside it, not one that turns back before it."""
    triangle = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 0, 1]]])
    path = np.array([[[0.2, 1, 0.2], [0.9, 1, 0.9], [0.2, 1, 0.2]], [[0.2, -1, 0.2], [0.9, -1, 0.9], [0.2, 0.1, 0.2]]])
    assert _crossing_paths(path, triangle) == pytest.approx(1 / 3)


def test_extents() -> None:
    """Thickness leaves out a twentieth at each end; the front is counted from the wall."""
    line = np.linspace(0, 1, 101)
    position = np.stack([line, line, line], axis=1)
    assert thickness_cells(position) == pytest.approx(0.9 * 64)
    assert front_cells(position) == pytest.approx(0.99 * 64 - 3)


def test_bad_options_are_refused() -> None:
    """Unknown cases, and a picture without the case that it shows."""
    with pytest.raises(ConfigError, match="cases"):
        main({"cases": ["stesp"]})
    with pytest.raises(ConfigError, match="picture"):
        main({"cases": ["leak"], "picture": "steps.png"})
