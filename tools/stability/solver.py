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
from hgn.schema import Bound, NonNegative, Positive, from_mapping, one_of, require, require_bounds, to_mapping
from hgn.system.files import write_json
from hgn.system.progress import bar
from tools.report import meta_of
from tools.stability.row import Row, table
from tools.stability.solver_contact import contacts
from tools.stability.solver_leak import OFFSETS, leaks
from tools.stability.solver_loads import convergence, impacts, long_run, stiffnesses
from tools.stability.solver_steps import Point, draw, largest_steps
from tools.stability.solver_validation import column_laws, columns, dam_breaks, grids, reposes, rest

CASES = (
    "steps", "stiffness", "impact", "convergence", "contact", "leak", "long", "rest", "dam", "column",
    "column_law", "repose", "grid",
)  # fmt: skip
_AN_OFFSET = Bound(f"1 to {len(OFFSETS)}", lambda value: 1 <= value <= len(OFFSETS))


@dataclass(frozen=True)
class StabilitySolverConfig:
    """`python -m tools.stability solver`: what is tried."""

    # steps, stiffness, impact, convergence, contact, leak, long, rest, dam, column, column_law, repose, grid; null: all
    cases: tuple[Annotated[str, one_of(*CASES)], ...] | None = None
    device: Processor = "auto"  # or cpu, gpu
    leak_seconds: Positive[float] = 5.0  # simulated, for each row of the table of leaks
    leak_block_cells: Positive[float] = 4.0  # side of the blocks that hit the obstacles, eight particles a cell
    leak_offsets: Annotated[int, _AN_OFFSET] = len(OFFSETS)  # of an obstacle within a cell, at most 8; 54 scenes each
    leak_band_cells: Positive[float] | None = None  # mpm.collider_band_cells for leaks; null: the solver's own
    # of the case grid, in widths of dams, radii of columns and sides of blocks; four such fit into a domain, so 8 to 32
    # are what 32 to 128 cells a side give; 32 want a GPU
    grid_cells: tuple[int, ...] = (8, 12, 16)
    # of columns, in radius, which make friction grow with the rate of flow; 0: friction does not; null: the default
    # sand's, 200
    column_grains: tuple[NonNegative[float], ...] | None = None
    picture: str | None = None  # also draw stable and unstable steps against the formula, as PNG
    json: str | None = None  # also write the rows to this file; --json FILE does the same

    def __post_init__(self) -> None:
        require_bounds(self)
        cells = self.grid_cells
        rising = len(cells) > 2 and cells[0] > 3 and all(a < b for a, b in pairwise(cells))
        require(rising, "grid_cells", "three numbers or more that rise, from 4 on", list(cells))
        drawn = self.picture is None or self.cases is None or "steps" in self.cases
        require(drawn, "picture", "left out without the case steps", self.picture)


def main(mapping: dict[str, Any]) -> int:
    """Prints a table, and writes JSON and the picture where asked to; what does not hold is a finding: exit code 0."""
    from datagen.mpm.device import initialise

    config = from_mapping(StabilitySolverConfig, mapping)
    mpm = MpmConfig(device=config.device)
    meta = meta_of(config, "cuda" if initialise(config.device).kind == "gpu" else "cpu") | {"solver": to_mapping(mpm)}
    leaky = dataclasses.replace(mpm, collider_band_cells=config.leak_band_cells or mpm.collider_band_cells)
    points: list[Point] = []
    parts: dict[str, Callable[[], list[Row]]] = {
        "steps": lambda: largest_steps(mpm, points),
        "stiffness": lambda: stiffnesses(mpm),
        "impact": lambda: impacts(mpm),
        "convergence": lambda: convergence(mpm),
        "contact": lambda: contacts(mpm),
        "leak": lambda: leaks(leaky, config.leak_seconds, config.leak_block_cells, config.leak_offsets),
        "long": lambda: long_run(mpm),
        "rest": lambda: rest(mpm),
        "dam": lambda: dam_breaks(mpm),
        "column": lambda: columns(mpm, config.column_grains),
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
        steps = [dataclasses.asdict(point) for point in points]
        report = {"meta": meta, "rows": [row.mapping("solver") for row in rows], "steps": steps}
        write_json(config.json, report, allow_nan=False)
    if config.picture is not None:
        draw(points, mpm, Path(config.picture))
    return 0
