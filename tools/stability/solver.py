"""python -m tools.stability solver [--json FILE] [picture=FILE]: what the solver bears, up to where, and beyond.

Rows: the largest stable step against the formula, stiffness, speed of impact, convergence of the default step, flight
from obstacles and friction on them, leaks through them, a long run, what published experiments found (water at rest,
dams, columns and slopes of sand), and convergence on the grid. On two CPU cores each case takes minutes, the table of
leaks with leak_seconds=0.1 leak_block_cells=3; columns want a GPU.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

from hgn.config import MpmConfig, Processor
from hgn.schema import NonNegative, Positive, from_mapping, one_of, require, require_bounds, to_mapping
from hgn.system.files import write_json
from hgn.system.progress import bar
from hgn.system.provenance import provenance, without_folders
from tools.stability.row import Row, table
from tools.stability.solver_contact import contacts
from tools.stability.solver_leak import OFFSETS, leaks
from tools.stability.solver_loads import convergence, impacts, long_run, stiffnesses
from tools.stability.solver_steps import Point, draw, largest_steps
from tools.stability.solver_validation import (
    COLUMN_ASPECTS,
    column_laws,
    columns,
    dam_breaks,
    grids,
    reposes,
    rest,
)  # fmt: skip

PART = "solver"
CASES = (
    "steps", "stiffness", "impact", "convergence", "contact", "leak", "long", "rest", "dam", "column",
    "column_law", "repose", "grid",
)  # fmt: skip


@dataclass(frozen=True)
class StabilitySolverConfig:
    """`python -m tools.stability solver`: what is tried."""

    # steps, stiffness, impact, convergence, contact, leak, long, rest, dam, column, column_law, repose, grid; null: all
    cases: tuple[Annotated[str, one_of(*CASES)], ...] | None = None
    device: Processor = "auto"  # or cpu, gpu
    leak_seconds: Positive[float] = 5.0  # simulated, for each row of the table of leaks
    leak_block_cells: Positive[float] = 4.0  # side of the blocks that hit the obstacles, eight particles a cell
    leak_offsets: int = len(OFFSETS)  # of an obstacle within a cell, at most 8; 54 scenes each
    # of the case grid, in widths of dams, radii of columns and sides of blocks; four such fit into a domain, so 8 to 32
    # are what 32 to 128 cells a side give; 32 want a GPU
    grid_cells: tuple[int, ...] = (8, 12, 16)
    column_aspects: tuple[Positive[float], ...] = COLUMN_ASPECTS  # height over radius, of the case column
    column_cells: int = 0  # in radius, where that is more than 24, or 72 below an aspect of 1
    # in radius, which make friction grow with the rate of flow; 0: friction does not; null: the default sand's, 200
    column_grains: tuple[NonNegative[float], ...] | None = None
    leak_band_cells: float | None = None  # mpm.collider_band_cells for the table of leaks; null: the solver's own
    picture: str | None = None  # also draw stable and unstable steps against the formula, as PNG
    json: str | None = None  # also write the rows to this file; --json FILE does the same

    def __post_init__(self) -> None:
        require_bounds(self)
        require(1 <= self.leak_offsets <= len(OFFSETS), "leak_offsets", f"1 to {len(OFFSETS)}", self.leak_offsets)
        cells = self.grid_cells
        rising = len(cells) > 2 and cells[0] > 3 and all(a < b for a, b in pairwise(cells))
        require(rising, "grid_cells", "three numbers or more that rise, from 4 on", list(cells))
        band = self.leak_band_cells
        require(band is None or band > 0, "leak_band_cells", "> 0", band)
        drawn = self.picture is None or self.cases is None or "steps" in self.cases
        require(drawn, "picture", "left out without the case steps", self.picture)


def main(mapping: dict[str, Any]) -> int:
    """Prints a table, and writes JSON and the picture where asked to; what does not hold is a finding: exit code 0."""
    config = from_mapping(StabilitySolverConfig, mapping)
    mpm = MpmConfig(device=config.device)
    points: list[Point] = []
    parts: dict[str, Callable[[], list[Row]]] = {
        "steps": lambda: _steps(mpm, points),
        "stiffness": lambda: stiffnesses(mpm),
        "impact": lambda: impacts(mpm),
        "convergence": lambda: convergence(mpm),
        "contact": lambda: contacts(mpm),
        "leak": lambda: leaks(
            _leak_settings(mpm, config), config.leak_seconds, config.leak_block_cells, config.leak_offsets
        ),
        "long": lambda: long_run(mpm),
        "rest": lambda: rest(mpm),
        "dam": lambda: dam_breaks(mpm),
        "column": lambda: columns(mpm, config.column_aspects, config.column_grains, config.column_cells),
        "column_law": lambda: column_laws(mpm),
        "repose": lambda: reposes(mpm),
        "grid": lambda: grids(mpm, config.grid_cells),
    }
    rows: list[Row] = []
    wanted = [name for name in CASES if name in (config.cases or CASES)]
    with bar("cases", total=len(wanted), unit="case") as progress:
        for name in wanted:
            rows += parts[name]()
            progress.update()
    print(table(rows))
    if config.json is not None:
        meta = provenance(_torch_device(config.device)) | {
            "config": without_folders(to_mapping(config)),
            "solver": to_mapping(mpm),
        }
        steps = [point.mapping() for point in points]
        report = {"meta": meta, "rows": [row.mapping(PART) for row in rows], "steps": steps}
        write_json(config.json, report, allow_nan=False)
    if config.picture is not None:
        draw(points, mpm, Path(config.picture))
    return 0


def _leak_settings(mpm: MpmConfig, config: StabilitySolverConfig) -> MpmConfig:
    if config.leak_band_cells is None:
        return mpm
    return dataclasses.replace(mpm, collider_band_cells=config.leak_band_cells)


def _steps(mpm: MpmConfig, points: list[Point]) -> list[Row]:
    rows, found = largest_steps(mpm)
    points += found
    return rows


def _torch_device(device: str) -> str:
    from datagen.mpm.device import initialise

    return "cuda" if initialise(device).kind == "gpu" else "cpu"
