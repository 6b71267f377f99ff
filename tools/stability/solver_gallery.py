"""The solver's figures for the gallery, on two grids, and figures of trajectories that were broken on purpose.

A row passes if the solver passes on both grids and at least one broken trajectory fails. The series of all observables
are returned for the JSON, with which networks are compared (gallery.py). Scenes that did not change since the JSON in
results/stability was written are not simulated again: their stored series are compared with the present bounds.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

from datagen.fine import solver_on_grid
from hgn.config import MpmConfig
from hgn.runtime.rollouts import RolloutResult
from hgn.scene.hdf5 import damage_named
from hgn.scene.scene import Scene
from hgn.schema import to_mapping
from hgn.system.machine import available_cpus
from hgn.system.yaml_files import read_json
from tools.report import table
from tools.solver_rollouts import solver_trials
from tools.stability.broken import BROKEN, FRICTIONLESS
from tools.stability.checks import interval_text
from tools.stability.gallery import GRID_CELLS, REFERENCE, GalleryCase, load_gallery
from tools.stability.observables import BoundEntry, Film, series
from tools.stability.row import Row

RATE_HZ = 60.0  # frame rate of the shipped weights
DIGITS = 5  # significant digits of figures in the JSON
SIMULATED = ("device", "commit", "date")  # keys of the report's meta that each scene's entry repeats


def gallery_rows(case: str, mpm: MpmConfig, meta: dict[str, Any], scenes: dict[str, Any]) -> Iterator[Row]:
    """Adds the series of each scene of a draw to `scenes`, and yields a row for each bound; `meta` is the report's."""
    loaded, again = load_gallery(case), []
    file = REFERENCE / f"{case}_solver.json"
    remedy = "move it, and run python -m tools.stability solver again"
    with damage_named(f"{file} must be a report of tools.stability solver", remedy):
        earlier = _earlier(file, mpm)
        for each in loaded:
            entry = earlier["scenes"].get(each.name, {"digest": None})
            figures = [earlier["figures"].get(_name(each, bound)) for bound in each.measure.bounds]
            if entry["digest"] != each.digest or None in figures:
                again.append(each)
                continue
            scenes[each.name] = {"simulated": earlier["simulated"]} | entry
            series_of = {cells: {**one} for cells, one in {**entry["series"]}.items()}
            for index, bound in enumerate(each.measure.bounds):
                solver = {cells: bound.reduced_line(one[bound.key]) for cells, one in series_of.items()}
                yield _row(each, bound, solver, {k: math.nan if v is None else v for k, v in figures[index].items()})
    for measured in _simulated(again, mpm):
        entry, rows = measure(*measured)
        scenes[measured[0].name] = {"simulated": {name: meta[name] for name in SIMULATED}} | entry
        yield from rows


def _earlier(file: Path, mpm: MpmConfig) -> dict[str, Any]:
    """Reads scenes of an earlier report, and figures of broken trajectories by row; empty if the solver's differ."""
    report = read_json(file) if file.is_file() else {}
    meta = report.get("meta", {})
    if without_device(meta.get("solver", {})) != without_device(to_mapping(mpm)):
        return {"scenes": {}, "figures": {}}
    figures = {row["case"]: row["broken"] for row in report["rows"] if "broken" in row}
    return {"scenes": report["scenes"], "figures": figures, "simulated": {name: meta[name] for name in SIMULATED}}


def without_device(solver: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the solver's settings without those of the device."""
    return {name: value for name, value in solver.items() if name not in ("device", "scenes_per_launch")}


def measure(
    case: GalleryCase, films: dict[int, Film], causes: Sequence[str], frictionless: Film | None
) -> tuple[dict[str, Any], list[Row]]:
    """Returns a scene's entry of the JSON, and its rows. The keys of `films` are cells per unit of length."""
    entry: dict[str, Any] = {"kind": case.measure.kind, "digest": case.digest, "series": {}}
    entry["particles"] = case.scenes[0].particle_count
    if causes:
        return entry, [Row(_name(case, b), "simulated", "stopped", False, causes[0]) for b in case.measure.bounds]
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
    # the numbers in one line of text; in a JSON list each would take a line
    text = {name: " ".join(f"{value:.{DIGITS}g}" for value in numbers) for name, numbers in measured.items()}
    entry["series"] = {cells: {key: text[cells, key] for key in bounds} for cells in grids}
    rows = []
    for bound in case.measure.bounds:
        figures = {name: bound.reduced(measured[name, bound.key]) for name in every}
        own, wrong = ({k: v for k, v in figures.items() if (k in grids) == of_grid} for of_grid in (True, False))
        rows.append(_row(case, bound, own, wrong))
    return entry, rows


def _row(case: GalleryCase, bound: BoundEntry, solver: dict[str, float], broken: dict[str, float]) -> Row:
    """Compares figures of both grids (keys: cells per unit of length) and of broken trajectories with a bound."""
    low, high = bound.interval(solver[str(GRID_CELLS[0])])
    failed = [name for name, figure in broken.items() if not low <= figure <= high]
    beyond = ", ".join(f"{figure:.4g} at {cells}" for cells, figure in solver.items()) + "; fails: "
    beyond += ", ".join(failed) or "no broken trajectory"
    more: dict[str, Any] = {"scene": case.name, "kind": case.measure.kind, "observable": bound.of}
    more |= _finite({"low": low, "high": high})
    more |= {"solver": _finite(solver), "broken": _finite(broken), "caught": failed}
    value = solver[str(GRID_CELLS[-1])]
    held = all(low <= figure <= high for figure in solver.values()) and bool(failed)
    shown: float | str = value if math.isfinite(value) else "none"
    return Row(_name(case, bound), interval_text(low, high), shown, held, beyond, more)


def _name(case: GalleryCase, bound: BoundEntry) -> str:
    return f"{case.name}: {bound.label}"


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
    """Yields films by grid, causes of failure, and the film without friction. Cases of a launch share their domain."""

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
            if cells == GRID_CELLS[0] and (any(scene.wall_friction) or any(o.friction for o in scene.obstacles)):
                smooth = tuple(replace(obstacle, friction=0.0) for obstacle in scene.obstacles)
                jobs.append((index, FRICTIONLESS, replace(scene, obstacles=smooth, wall_friction=(0.0, 0.0, 0.0))))
        config = solver_on_grid(mpm, 1 / cells, 1 / GRID_CELLS[0])
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


def _finite(figures: dict[str, float]) -> dict[str, float | None]:
    return {name: float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None for name, value in figures.items()}
