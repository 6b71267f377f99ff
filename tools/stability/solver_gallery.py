"""The solver's side of the gallery: figures on two grids, and of broken trajectories.

Rows pass if the solver passes on both grids and at least one broken trajectory fails. The series of all observables
are returned for the JSON, which networks are compared with (gallery.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import groupby
from typing import Any

from hgn.config import MpmConfig
from hgn.runtime.rollouts import RolloutResult
from hgn.scene.scene import Scene
from hgn.system.machine import available_cpus
from tools.report import table
from tools.solver_rollouts import other_grid, solver_trials
from tools.stability.broken import BROKEN, FRICTIONLESS
from tools.stability.checks import interval_text
from tools.stability.gallery import GRID_CELLS, GalleryCase, load_gallery
from tools.stability.observables import Film, series
from tools.stability.row import Row

RATE_HZ = 60.0  # of the shipped weights
DIGITS = 5  # of figures in the JSON


def gallery_rows(case: str, mpm: MpmConfig, scenes: dict[str, Any]) -> Iterator[Row]:
    """Simulates a draw of the gallery, adds the series of each scene to `scenes`, and yields a row for each bound."""
    for measured in _simulated(load_gallery(case), mpm):
        scenes[measured[0].name], rows = measure(*measured)
        yield from rows


def measure(
    case: GalleryCase, films: dict[int, Film], causes: Sequence[str], frictionless: Film | None
) -> tuple[dict[str, Any], list[Row]]:
    """Returns a scene's entry of the JSON and its rows, from its films by cells per unit."""
    entry: dict[str, Any] = {"kind": case.measure.kind, "digest": case.digest, "series": {}}
    entry["particles"] = case.scenes[0].particle_count
    if causes:
        return entry, [
            Row(f"{case.name}: {b.label}", "simulated", "stopped", False, causes[0]) for b in case.measure.bounds
        ]
    bounds = {bound.key: bound for bound in case.measure.bounds}
    coarse = films[GRID_CELLS[0]]
    every = {str(cells): film for cells, film in films.items()}
    for name, change in BROKEN.items():
        path_TN3 = change(coarse.position_TN3, coarse.scene, coarse.rate_hz)
        every[name] = replace(coarse, position_TN3=path_TN3)
    if frictionless is not None:
        every[FRICTIONLESS] = frictionless
    jobs = [(name, key) for key in bounds for name in every]
    with ThreadPoolExecutor(available_cpus()) as threads:
        values = threads.map(lambda job: series(every[job[0]], bounds[job[1]]), jobs)
        measured = dict(zip(jobs, values, strict=True))
    grids = [str(cells) for cells in films]
    entry["series"] = {cells: {key: _short(measured[cells, key]) for key in bounds} for cells in grids}
    rows = []
    for bound in case.measure.bounds:
        figures = {name: bound.reduced(measured[name, bound.key]) for name in every}
        own, wrong = ({k: v for k, v in figures.items() if (k in grids) == of_grid} for of_grid in (True, False))
        low, high = bound.interval(own[str(GRID_CELLS[0])])
        passed = {cells: low <= figure <= high for cells, figure in own.items()}
        failed = [name for name, figure in wrong.items() if not low <= figure <= high]
        beyond = ", ".join(f"{figure:.4g} at {cells}" for cells, figure in own.items()) + "; fails: "
        beyond += ", ".join(failed) or "no broken trajectory"
        more: dict[str, Any] = {"scene": case.name, "kind": case.measure.kind, "observable": bound.of}
        more |= _finite({"low": low, "high": high})
        more |= {"solver": _finite(own), "broken": _finite(wrong), "caught": failed}
        value = own[str(GRID_CELLS[-1])]
        held = all(passed.values()) and bool(failed)
        shown: float | str = value if math.isfinite(value) else "none"
        rows.append(Row(f"{case.name}: {bound.label}", interval_text(low, high), shown, held, beyond, more))
    return entry, rows


def broken_table(rows: Sequence[Row]) -> str:
    """Returns a table of the rows and the figures of broken trajectories; those that fail are marked."""
    names = (*BROKEN, FRICTIONLESS)
    lines = []
    for row in rows:
        if "broken" not in row.more:
            continue
        wrong, caught = row.more["broken"], row.more["caught"]
        cells = [_cell(wrong, caught, name) for name in names]
        lines.append((row.case, row.predicted, *cells))
    return table(("row", "bounds", *names), lines) + "\n(* fails, as it should)"


def _cell(wrong: dict[str, float | None], caught: Sequence[str], name: str) -> str:
    if name not in wrong:
        return ""
    figure = wrong[name]
    return ("none" if figure is None else f"{figure:.3g}") + ("*" if name in caught else "")


def _simulated(
    cases: Sequence[GalleryCase], mpm: MpmConfig
) -> Iterator[tuple[GalleryCase, dict[int, Film], list[str], Film | None]]:
    """Yields films by grid, the solver's causes of failure, and the film without friction; a launch has one domain."""

    def kind(case: GalleryCase) -> tuple[Any, ...]:
        scene = case.scenes[0]
        return scene.domain_size, scene.moves, scene.emits

    for _, some in groupby(sorted(cases, key=kind), kind):
        yield from _launched(list(some), mpm)


def _launched(
    cases: Sequence[GalleryCase], mpm: MpmConfig
) -> Iterator[tuple[GalleryCase, dict[int, Film], list[str], Film | None]]:
    """Simulates cases that share a domain: both grids, far bodies and scenes without friction."""
    films: list[dict[int, Film]] = [{} for _ in cases]
    causes: list[list[str]] = [[] for _ in cases]
    without: list[Film | None] = [None for _ in cases]
    for cells in GRID_CELLS:
        jobs: list[tuple[int, str, Scene]] = []
        for index, case in enumerate(cases):
            scene = case.scene(cells)
            jobs.append((index, "own", scene))
            if case.measure.far is not None:
                jobs.append((index, "far", case.scene(cells, far=True)))
            if cells == GRID_CELLS[0] and _has_friction(scene):
                jobs.append((index, FRICTIONLESS, _smooth(scene)))
        config = other_grid(mpm, 1 / cells, 1 / GRID_CELLS[0])
        frames = max(case.measure.frames for case in cases)
        trials = solver_trials([scene for *_, scene in jobs], config, frames, RATE_HZ)
        by_job = {(index, what): (scene, trial) for (index, what, scene), trial in zip(jobs, trials, strict=True)}
        for index, case in enumerate(cases):
            own = [by_job[index, what] for what in ("own", "far") if (index, what) in by_job]
            causes[index] += [trial.cause for _, trial in own if trial.cause is not None]
            films[index][cells] = _film(case, own)
            if (index, FRICTIONLESS) in by_job and by_job[index, FRICTIONLESS][1].cause is None:
                without[index] = _film(case, [by_job[index, FRICTIONLESS]])
    yield from zip(cases, films, causes, without, strict=True)


def _film(case: GalleryCase, pairs: Sequence[tuple[Scene, RolloutResult]]) -> Film:
    paths = [trial.position_TN3[: case.measure.frames] for _, trial in pairs]
    return case.film(pairs[0][0], paths, RATE_HZ)


def _has_friction(scene: Scene) -> bool:
    return any(scene.wall_friction) or any(obstacle.friction for obstacle in scene.obstacles)


def _smooth(scene: Scene) -> Scene:
    obstacles = tuple(replace(obstacle, friction=0.0) for obstacle in scene.obstacles)
    return replace(scene, obstacles=obstacles, wall_friction=(0.0, 0.0, 0.0))


def _short(values: Sequence[float]) -> str:
    """Returns the numbers in a line: a list would take one for each."""
    return " ".join(f"{value:.{DIGITS}g}" for value in values)


def _finite(figures: dict[str, float]) -> dict[str, float | None]:
    return {name: float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None for name, value in figures.items()}
