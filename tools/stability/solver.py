"""python -m tools.stability solver [--json FILE]: checks the solver against formulas and experiments.

Rows: the largest stable step, stiffness, speed of impact, free flight from obstacles and friction on them, a long run,
and published experiments (water at rest, dams, columns and slopes of sand). On two CPU cores most cases take minutes;
columns need a GPU.
"""

import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

from hgn.config import MpmConfig
from hgn.schema import Bound, Bounded, from_mapping, to_mapping
from tools.report import ReportConfig, meta_of
from tools.stability.gallery import is_gallery
from tools.stability.row import Report, Row, table
from tools.stability.solver_contact import contacts
from tools.stability.solver_gallery import broken_table, gallery_rows
from tools.stability.solver_loads import impacts, long_run, stiffnesses
from tools.stability.solver_steps import Point, largest_steps
from tools.stability.solver_validation import columns, dam_breaks, reposes, rest

NAMES = ("steps", "stiffness", "impact", "contact", "long", "rest", "dam", "column", "repose")
CaseName = Annotated[
    str, Bound(f"one of {', '.join(NAMES)}, gallery, gallery_NUMBER", lambda n: n in NAMES or is_gallery(n))
]


@dataclass(frozen=True)
class StabilitySolverConfig(ReportConfig, Bounded):
    """The options of `python -m tools.stability solver`."""

    # steps, stiffness, impact, contact, long, rest, dam, column, repose; null: all of these. gallery: the scenes
    # of conf/gallery, which networks are compared with; gallery_NUMBER: a draw of them
    cases: tuple[CaseName, ...] | None = None


def main(mapping: dict[str, Any]) -> int:
    """Prints a table, and writes JSON if `json` is given. A case that fails is a finding: exit code 0."""
    from datagen.mpm.device import initialise

    config = from_mapping(StabilitySolverConfig, mapping)
    mpm = MpmConfig(device=config.device)
    meta = meta_of(config, initialise(config.device).kind) | {"solver": to_mapping(mpm)}
    points: list[Point] = []
    cases: dict[str, Callable[[MpmConfig], Iterable[Row]]] = {
        "steps": partial(largest_steps, points=points), "stiffness": stiffnesses, "impact": impacts,
        "contact": contacts, "long": long_run, "rest": rest, "dam": dam_breaks, "column": columns, "repose": reposes,
    }  # fmt: skip
    scenes: dict[str, Any] = {}
    report = Report("solver", meta, config.json, steps=points, scenes=scenes)
    for name in NAMES:
        if config.cases is None or name in config.cases:
            print(f"case {name}", file=sys.stderr, flush=True)
            report.add(cases[name](mpm))
    for name in filter(is_gallery, config.cases or ()):
        report.add(gallery_rows(name, mpm, meta, scenes))
    print(table(report.rows))
    if scenes:
        print(broken_table(report.rows))
    return 0
