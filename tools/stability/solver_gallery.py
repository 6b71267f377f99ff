"""The solver's figures for the gallery, on two grids, and figures of trajectories that were broken on purpose.

A row passes if the solver passes on both grids and at least one broken trajectory fails. The series of all observables
are stored in the JSON, with which networks are compared (case.py). Scenes that did not change since the JSON in
results/stability was written are not simulated again: their stored series are compared with the present bounds. Rows
and series of scenes that were not chosen are copied from that file.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import chain, groupby
from pathlib import Path
from typing import Any

from datagen.fine import solver_on_grid
from hgn.config import MpmConfig
from hgn.renamed import current_names
from hgn.runtime.rollouts import RolloutResult
from hgn.scene.hdf5 import damage_named
from hgn.scene.scene import Scene
from hgn.scene.scene_file import scene_files
from hgn.schema import require, to_mapping
from hgn.system.machine import available_cpus
from hgn.system.yaml_files import read_json
from tools.scenes import with_friction
from tools.solver_rollouts import solver_trials
from tools.stability.broken import BROKEN, FRICTIONLESS
from tools.stability.checks import interval_text
from tools.stability.gallery import GALLERY, GRID_CELLS, REFERENCE, GalleryCase
from tools.stability.observables import BoundEntry, Film, series
from tools.stability.row import Report, Row

RATE_HZ = 60.0  # frame rate of the shipped weights
DIGITS = 5  # significant digits of figures in the JSON
SIMULATED = ("device", "commit", "date")  # keys of the report's meta that each scene's entry repeats


def gallery_rows(draw: str, chosen: Mapping[str, GalleryCase], mpm: MpmConfig, report: Report) -> Iterator[Row]:
    """Yields a row for each bound of the chosen scenes of a draw, and adds the other scenes to the report.

    With other scenes the report keeps its earlier `meta`. The entry of each scene has the commit that simulated it.
    Raises: ConfigError if the other scenes were simulated with other settings of the solver.
    """
    again: list[GalleryCase] = []
    simulated = {name: report.meta.get(name) for name in SIMULATED}
    file, others = REFERENCE / f"{draw}_solver.json", scene_files(GALLERY).keys() - chosen.keys()
    remedy = "move it, and run python -m tools.stability solver again"
    with damage_named(f"{file} must be a report of tools.stability solver", remedy):
        earlier = _earlier(file, mpm, others)
        scenes = report.more["scenes"]
        if not others.isdisjoint(earlier["scenes"]):
            report.meta = earlier["meta"]
        scenes |= {name: entry for name, entry in earlier["scenes"].items() if name in others}
        report.rows += [row for row in earlier["rows"] if row.get("scene") in others]
        broken = {row["case"]: row["broken"] for row in earlier["rows"] if "broken" in row}
        for each in chosen.values():
            entry = earlier["scenes"].get(each.name, {"digest": None})
            names = [_name(each, bound) for bound in each.measure.bounds]
            if entry["digest"] != each.digest or not broken.keys() >= {*names}:
                again.append(each)
                continue
            scenes[each.name] = entry
            yield from _rows(each, entry, [broken[name] for name in names])
    launches = groupby(sorted(again, key=_launch), _launch)
    for each, films, causes, frictionless in chain.from_iterable(_launched(list(some), mpm) for _, some in launches):
        entry = {"simulated": simulated, "kind": each.measure.kind}
        entry |= {"digest": each.digest, "series": {}, "particles": each.scenes[0].particle_count}
        scenes[each.name] = entry
        if causes:
            for bound in each.measure.bounds:
                yield Row(_name(each, bound), "simulated", "stopped", False, causes[0], {"scene": each.name})
            continue
        entry["series"], wrong = measure(each, films, frictionless)
        yield from _rows(each, entry, wrong)
    report.rows.sort(key=lambda row: row.get("scene", ""))
    report.more["scenes"] = dict(sorted(scenes.items()))


def _earlier(file: Path, mpm: MpmConfig, others: Collection[str]) -> dict[str, Any]:
    """Reads an earlier report; an empty one if the solver's settings were others, unless scenes are copied from it."""
    if file.is_file():
        report: dict[str, Any] = read_json(file)
        if without_device(current_names(report["meta"]["solver"], "mpm")) == without_device(to_mapping(mpm)):
            return report
        rule = f"the whole gallery where {file} has other settings of the solver"
        require(not others, "cases", rule, f"without {', '.join(sorted(others))}")
    return {"scenes": {}, "rows": []}


def without_device(solver: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the solver's settings without those of the device."""
    return {name: value for name, value in solver.items() if name not in ("device", "scenes_per_launch")}


def measure(
    case: GalleryCase, films: dict[int, Film], frictionless: Film | None
) -> tuple[dict[str, dict[str, str]], list[dict[str, float]]]:
    """Returns series by grid and key, as the JSON has them, and for each bound the figures of broken trajectories.

    The keys of `films` are cells per unit of length.
    """
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
    # the numbers in one line of text; in a JSON list each would take a line
    text = {job: " ".join(f"{value:.{DIGITS}g}" for value in numbers) for job, numbers in measured.items()}
    solver = {str(cells): {key: text[str(cells), key] for key in bounds} for cells in films}
    names = [name for name in every if name not in solver]
    return solver, [_rounded({name: b.reduced(measured[name, b.key]) for name in names}) for b in case.measure.bounds]


def _rows(case: GalleryCase, entry: Mapping[str, Any], broken: Sequence[Mapping[str, float | None]]) -> Iterator[Row]:
    """Compares a scene's stored series of both grids, and figures of broken trajectories by bound, with its bounds."""
    for bound, stored in zip(case.measure.bounds, broken, strict=True):
        solver = {cells: bound.reduced_line({**one}[bound.key]) for cells, one in {**entry["series"]}.items()}
        wrong = {name: math.nan if figure is None else figure for name, figure in stored.items()}
        low, high = bound.interval(solver[str(GRID_CELLS[0])])
        failed = [name for name, figure in wrong.items() if not low <= figure <= high]
        beyond = ", ".join(f"{figure:.4g} at {cells}" for cells, figure in solver.items()) + "; "
        figures = ", ".join(f"{name} {figure:.4g}" for name, figure in wrong.items())
        beyond += f"fails: {', '.join(failed)}" if failed else f"no broken trajectory fails: {figures}"
        more: dict[str, Any] = {"scene": case.name, "kind": case.measure.kind, "observable": bound.of}
        more |= _rounded({"low": low, "high": high})
        more |= {"solver": _rounded(solver), "broken": wrong, "caught": failed}
        value = solver[str(GRID_CELLS[-1])]
        held = all(low <= figure <= high for figure in solver.values()) and bool(failed)
        shown: float | str = value if math.isfinite(value) else "none"
        yield Row(_name(case, bound), interval_text(low, high), shown, held, beyond, more)


def _name(case: GalleryCase, bound: BoundEntry) -> str:
    return f"{case.name}: {bound.label}"


def _launch(case: GalleryCase) -> tuple[Any, ...]:
    """Returns the properties that cases of a launch share."""
    scene = case.scenes[0]
    return scene.domain_size, scene.moves, scene.emits


def _launched(
    cases: Sequence[GalleryCase], mpm: MpmConfig
) -> Iterator[tuple[GalleryCase, dict[int, Film], list[str], Film | None]]:
    """Simulates cases of a launch: on both grids, also with far bodies and without friction.

    Yields films by grid, causes of failure, and the film without friction.
    """
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
                smooth = replace(with_friction(scene, 0.0), wall_friction=(0.0, 0.0, 0.0))
                jobs.append((index, FRICTIONLESS, smooth))
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


def _rounded(figures: Mapping[str, float]) -> dict[str, float]:
    return {name: float(f"{value:.{DIGITS}g}") for name, value in figures.items()}
