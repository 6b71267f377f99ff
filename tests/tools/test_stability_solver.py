"""python -m tools.stability solver: its rows and its measures."""

import json

import numpy as np
import pytest

from hgn.config import MpmConfig
from hgn.scene.material import ELASTIC, WATER
from tools.stability import solver_steps
from tools.stability import solver_validation as validation
from tools.stability.solver import main

pytestmark = pytest.mark.usefixtures("solver_kernels")

CPU = MpmConfig(device="cpu")


def test_report(tmp_path, monkeypatch, capsys):
    """The largest step of a single particle lies at the formula; rows and points are in the JSON, and are drawn."""
    monkeypatch.setattr(solver_steps, "STIFFNESS", (1.0,))
    kinds = {"single particle, water": WATER, "single particle, elastic solid": ELASTIC}
    some = {name: (kind, lambda *of: solver_steps.singles(*of)[::4], (0.97, 1.1)) for name, kind in kinds.items()}
    monkeypatch.setattr(solver_steps, "CASES", some)
    file = tmp_path / "reports" / "solver.json"
    assert main({"cases": ["steps"], "device": "cpu", "json": str(file)}) == 0
    report = json.loads(file.read_text())
    assert {"device", "versions", "commit", "date", "command", "config", "solver"} <= report["meta"].keys()
    assert [row["held"] for row in report["rows"]] == [True, True]
    assert all({"part", "case", "predicted", "measured", "beyond"} <= row.keys() for row in report["rows"])
    assert [point["stable"] for point in report["steps"]] == [True, False] * 2
    assert solver_steps.draw(report["steps"], CPU).startswith(b"\x89PNG")
    printed = capsys.readouterr()
    assert "case steps\n" in printed.err
    assert "passes largest step, single particle, water, stiffness x1: " in printed.out
    assert printed.out.endswith("\n2 of 2 rows pass\n") and len(printed.out.splitlines()) == 3


def test_formula():
    """dx sqrt(rho / (3 lambda + 2 mu)): 5.41e-4 s for water and 3.83e-4 s for solids at the default settings."""
    assert [round(solver_steps.formula(CPU, kind), 6) for kind in range(3)] == [5.41e-4, 3.83e-4, 3.83e-4]


def test_validation_rows(monkeypatch):
    """Even four cells of water differ from the experiment by less than 18 %; columns have a run-out and a height.
    Rows of a column whose sand reaches the walls of the basin fail, with a note."""
    short = {"DAM_CELLS": (4, 5), "COLUMN_CELLS": 4, "COLUMN_ASPECTS": (1.0,), "REST_S": 0.5, "SETTLED_S": 0.25}
    for name, value in short.items():
        monkeypatch.setattr(validation, name, value)
    level, *dams = [*validation.rest(CPU), *validation.dam_breaks(CPU)]
    assert level.case.startswith("level of water at rest") and len(dams) == 3 and dams[0].held and dams[1].held
    columns = list(validation.columns(CPU))
    assert [row.more["published"] for row in columns] == [pytest.approx([1.013, 1.24], rel=1e-3), [0.74, 0.88]]
    assert [row.predicted for row in columns] == pytest.approx([1.013, 0.74], rel=1e-3)  # both are below
    # the default sand
    assert columns[0].case.endswith("mohr coulomb, 33 degrees, 4 cells in radius, 200 grains, run-out")
    monkeypatch.setattr(validation, "COLUMN_SPACE", 0.7)
    monkeypatch.setattr(validation, "COLUMN_WITHIN", 10.0)
    crowded = list(validation.column_rows(1.0, CPU, 6))
    assert [row.held for row in crowded] == [False, False]
    assert all("reached the walls of the basin, 10 cells wide" in row.beyond for row in crowded)


def test_rows_of_slopes(monkeypatch):
    """Slopes should rest at the angle of shear: tan = sin of the friction angle. Moving slopes fail. The angle of
    repose of quartz sand is a row of its own."""
    own, shears = 33.0, (18.9, 28.6, 32.7)

    def rests(angle, start, *_):
        return start, start if start < angle else {20.0: 20.5, own: 30.8, 40.0: 32.9}[angle], 0.05 * (angle == 20)

    monkeypatch.setattr(validation, "repose", rests)
    base = MpmConfig(device="cpu", sand_friction_angle_deg=own)
    rows = list(validation.reposes(base))
    asked = [17, shears[0], own - 3, shears[1], 31, 37, shears[2]]
    assert [row.predicted for row in rows] == pytest.approx(asked, abs=0.05)
    assert [row.held for row in rows] == [True, False, *[True] * 5]
    assert rows[4].case.endswith("as quartz sand has it")


def test_published_columns():
    """Low columns keep their height, of glass beads at most 0.74; that of sand is a power of the aspect. A cone
    of glass beads has the volume of the column."""
    assert [*validation.run_outs(0.5), *validation.run_outs(4.0)] == pytest.approx([0.62, 3.2])
    sand, beads = validation.run_outs(1.5)
    assert sand == pytest.approx(1.86) and np.pi * (1 + beads) ** 2 * 0.74 / 3 == pytest.approx(1.5 * np.pi)
    assert validation.heights(0.5) == (0.5, 0.5) and validation.heights(0.8) == (0.74, 0.8)
    assert validation.heights(1.5) == pytest.approx((0.74, 0.9415), abs=1e-3)
    assert validation.heights(4.0) == pytest.approx((0.74, 1.109), abs=1e-3)


def test_edges():
    """The edge of a cliff, wherever it ends in its cell, is found within 0.1 cells, that of a slope within 0.2."""
    for end in np.arange(6.0, 7.0, 0.1):
        cliff = np.clip(end - np.arange(12), 0, 1) * 5.0
        assert validation.edge(cliff, 0.25) == pytest.approx(end, abs=0.1)
        for steepness in (0.1, 0.3, 0.6):
            depth = np.clip(steepness * (end - np.arange(0, 12, 0.01) - 0.005), 0, None).reshape(12, 100).mean(axis=1)
            assert validation.edge(depth, 0.25) == pytest.approx(end - 0.25 / steepness, abs=0.2)


def test_slope_of_a_filled_wedge():
    """The slope of randomly filled sand is that of its surface."""
    for degrees in (17.0, 30.0):
        scene = validation.platform(degrees, 48)
        place_N3 = scene.position_N3.astype(np.float64) / scene.cell_size - validation.WALL
        place_N3[:, 1] -= round(validation.PIT * 48)
        assert validation.surface_slope(place_N3, 48) == pytest.approx(degrees, abs=0.7)
