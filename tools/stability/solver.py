"""python -m tools.stability solver [json=FILE]: checks the solver against formulas and experiments.

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
from hgn.schema import Bound, Bounded, from_mapping, require, to_mapping
from tools.report import ReportConfig, meta_of
from tools.stability.gallery import GALLERY_CASES, GalleryCase, is_gallery, load_gallery
from tools.stability.row import Report, Row
from tools.stability.solver_contact import contacts
from tools.stability.solver_gallery import gallery_rows
from tools.stability.solver_loads import impacts, long_run, stiffnesses
from tools.stability.solver_steps import Point, largest_steps
from tools.stability.solver_validation import columns, dam_breaks, reposes, rest

NAMES = ("steps", "stiffness", "impact", "contact", "long", "rest", "dam", "column", "repose")
CaseName = Annotated[str, Bound(f"one of {', '.join(NAMES)}, {GALLERY_CASES}", lambda n: n in NAMES or is_gallery(n))]


@dataclass(frozen=True)
class StabilitySolverConfig(ReportConfig, Bounded):
    """The options of `python -m tools.stability solver`."""

    # steps, stiffness, impact, contact, long, rest, dam, column, repose; null: all of these. gallery: the scenes
    # of conf/gallery, which networks are compared with; gallery_NUMBER: a draw of them; gallery:SCENE: one scene
    cases: tuple[CaseName, ...] | None = None


def main(mapping: dict[str, Any]) -> int:
    """Prints rows, and writes JSON if `json` is given. A case that fails is a finding: exit code 0."""
    from datagen.mpm.device import initialise

    config = from_mapping(StabilitySolverConfig, mapping)
    chosen = config.cases or NAMES
    draws: dict[str, dict[str, GalleryCase]] = {}  # scenes by draw and name
    for case in filter(is_gallery, chosen):
        draws.setdefault(case.partition(":")[0], {}).update({each.name: each for each in load_gallery(case)})
    require(len(draws) < 2 or config.json is None, "json", "left out with several draws of the gallery", config.json)
    mpm = MpmConfig(device=config.device)
    meta = meta_of(config, initialise(config.device).kind) | {"solver": to_mapping(mpm)}
    points: list[Point] = []
    cases: dict[str, Callable[[MpmConfig], Iterable[Row]]] = {
        "steps": partial(largest_steps, points=points), "stiffness": stiffnesses, "impact": impacts,
        "contact": contacts, "long": long_run, "rest": rest, "dam": dam_breaks, "column": columns, "repose": reposes,
    }  # fmt: skip
    report = Report("solver", meta, config.json, steps=points, scenes={})
    for name in NAMES:
        if name in chosen:
            print(f"case {name}", file=sys.stderr, flush=True)
            report.add(cases[name](mpm))
    for draw, scenes in draws.items():
        report.add(gallery_rows(draw, scenes, mpm, report), brief=draw in chosen)
    report.close()
    return 0
