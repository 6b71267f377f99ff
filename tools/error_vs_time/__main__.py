"""python -m tools.error_vs_time data=… weights=[…] out=results/error_vs_time: error against run time.

Networks (shipped ones where none are named), the solver at coarser grids and larger steps, and predictors that learn
nothing, all on the same test scenes, scored by one converged simulation. Writes a table, OUT.json, OUT.png and
OUT_frames.png.
"""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from hgn.command import run_command
from hgn.config import MpmConfig
from hgn.data.reader import EpisodeStore
from hgn.data.select import first_episodes
from hgn.device import choose_device
from hgn.files import write_atomically, write_json
from hgn.progress import bar
from hgn.provenance import provenance, without_folders
from hgn.runtime.weights import find_weights, load_weights, shipped_weights
from hgn.scene.episode import Episode
from hgn.scene.material import MATERIALS
from hgn.schema import ConfigError, from_mapping, require, to_mapping
from tools.error_vs_time.contenders import (
    COARSE_GRIDS,
    PARTICLES_AT_ONCE,
    SAME_GRID,
    Contender,
    NetworkContender,
    SolverContender,
    TrivialContender,
)
from tools.error_vs_time.launches import Setting, SolverLaunches
from tools.error_vs_time.plot import CONVENTION, draw_frames, draw_pareto
from tools.error_vs_time.score import label, pay_back, report, score, table, time_in_turns
from tools.error_vs_time.settings import PRECISIONS, ErrorVsTimeConfig
from tools.trial import other_grid

if TYPE_CHECKING:
    from hgn.runtime.ahead import AheadCompilation

# of the seconds given: until when a contender's errors, and its run times, may be begun with
SCORING_SHARE, TIMING_SHARE = 0.72, 0.9
HGN_ORDER, GNS_ORDER = ("tf32", "fp16", "fp32"), ("fp16", "tf32", "fp32")  # what tells most for its time first


def main(mapping: dict[str, Any]) -> int:
    """Prints a table and writes the report; returns the exit code."""
    begun = time.monotonic()
    config = from_mapping(ErrorVsTimeConfig, mapping)
    device = choose_device(config.device)
    store = EpisodeStore(config.data, config.split)
    episodes = first_episodes(store, config.scenes)
    frames = min(config.frames, *(len(episode.position_TN3) for episode in episodes))
    mpm = replace(from_mapping(MpmConfig, store.manifest.config["mpm"], "mpm"), device=_solver_device(device))
    networks = network_contenders(config, device, episodes)
    own_cell, rate = episodes[0].obstacle_grid.cell_size, episodes[0].frame_rate_hz
    own_grid = round(1 / own_cell)

    @functools.cache
    def launches(grid: int) -> SolverLaunches:
        reference = config.resimulate and grid == own_grid
        most = frames if reference else min(frames, config.mpm_frames)
        cell_size = own_cell if grid == own_grid else 1 / grid
        return SolverLaunches(other_grid(mpm, cell_size, own_cell), cell_size, rate, most)

    solvers = solver_contenders(config, mpm, launches, own_grid)
    with ExitStack() as stack:
        ahead = _kernels_ahead(networks, episodes, device)
        if ahead is not None:
            stack.enter_context(ahead)
        if config.resimulate:
            references, left_out = resimulated(episodes, launches(own_grid), config.reference_step)
            reference = f"the solver on the data's grid at {config.reference_step:g} of the limit of stability"
        else:
            references, left_out = [_with_positions(e, np.asarray(e.position_TN3[:frames])) for e in episodes], {}
            reference = "the data"
        require(bool(references), "data", "scenes that the solver gets through", left_out)
        if ahead is not None:
            print(ahead.wait(), file=sys.stderr)
    contenders = [*networks, *trivial_contenders(store, device), *solvers]

    def late(share: float) -> bool:
        return config.seconds is not None and time.monotonic() - begun > share * config.seconds

    scored: dict[int, tuple[dict[str, Any], np.ndarray]] = {}  # by the contender's place in the report
    not_run: list[dict[str, Any]] = []
    meta = provenance(device) | {
        "config": without_folders(to_mapping(config)),
        "data": Path(config.data).name,
        "split": config.split,
        "scenes": len(references),
        "episodes": [episode.key for episode in references],
        "left_out": left_out,
        "not_run": not_run,
        "frames": frames,
        "reference": reference,
        "convention": CONVENTION,
        "seconds_before_scoring": time.monotonic() - begun,
    }
    out = Path(config.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    file = config.json or f"{out}.json"

    def write() -> None:  # after each contender and round: what there is outlives a run that is cut off
        write_json(file, report(meta, [scored[i][0] for i in sorted(scored)]), allow_nan=False)

    def leave_out(contender: Contender, cause: str) -> None:
        not_run.append(contender.row | {"cause": cause})
        print(f"left out: {label(contender.row)}: {cause}", file=sys.stderr)

    with bar("errors", total=len(contenders) * len(references), unit="scene") as progress:
        for i in sorted(range(len(contenders)), key=lambda i: contenders[i].importance):
            contender = contenders[i]
            if late(SCORING_SHARE):
                leave_out(contender, "the time was over")
                continue
            started = time.monotonic()
            try:
                row, curve_T = score(contender, references, config, device, progress.update)
            except (ConfigError, torch.OutOfMemoryError) as error:  # the others need not wait for it
                leave_out(contender, str(error))
                continue
            finally:
                contender.release()
            row["scoring_s"] = time.monotonic() - started
            scored[i] = row, curve_T
            write()
    meta["seconds_before_timing"] = time.monotonic() - begun
    timed = [i for i in sorted(scored) if scored[i][0]["system"] not in ("trivial", "chaos")]

    def note(times_of: Sequence[dict[str, Any] | None]) -> None:
        for i, times in zip(timed, times_of, strict=True):
            scored[i][0].update(times or {})
        write()

    watched = [contenders[i] for i in timed]
    note(time_in_turns(watched, references, config, device, lambda: late(TIMING_SHARE), note))
    rows, curves = [scored[i][0] for i in sorted(scored)], [scored[i][1] for i in sorted(scored)]
    meta["not_timed"] = [label(scored[i][0]) for i in timed if scored[i][0].get("ms") is None]
    add_pay_back(rows, config, mpm, references[0], frames)
    meta["seconds"] = time.monotonic() - begun
    print(table(rows))
    write()
    write_atomically(Path(f"{out}.png"), draw_pareto(rows, meta))
    write_atomically(Path(f"{out}_frames.png"), draw_frames(rows, curves, meta))
    print(f"{out}.png {out}_frames.png {file}")
    return 0


def network_contenders(
    config: ErrorVsTimeConfig, device: torch.device, episodes: Sequence[Episode]
) -> list[NetworkContender]:
    """Every weights file at every precision that its path knows; what is left out is said."""
    files = fitting_weights(episodes) if config.weights is None else [find_weights(name) for name in config.weights]
    contenders: list[NetworkContender] = []
    rate = episodes[0].frame_rate_hz
    for file in files:
        kind = load_weights(file)[1].network.kind
        order = HGN_ORDER if kind == "hgn" else GNS_ORDER
        precisions = config.precisions
        if precisions is None:
            precisions = ("fp32",) if device.type != "cuda" else PRECISIONS if kind == "hgn" else ("tf32", "fp16")
        ranked = sorted(precisions, key=order.index)
        for precision in precisions:
            rank = ranked.index(precision)
            try:
                made = NetworkContender(file, precision, config.path, device, rate, rank, config.repeated_frames)
            except ConfigError as error:
                if precision != "fp16":
                    raise
                print(f"left out: {file.name} at fp16: {error}", file=sys.stderr)
            else:
                contenders.append(made)
    return contenders


def fitting_weights(episodes: Sequence[Episode]) -> list[Path]:
    """All shipped weights for such data: of its frame rate and materials, and those that see obstacles where there are
    some, in cells as large, else those that do not. What does not fit is said.
    """
    first = episodes[0]
    seen = any(len(episode.obstacle_grid.cell_K3) for episode in episodes)
    present = {MATERIALS[i] for episode in episodes for i in np.unique(episode.material_N)}
    found = []
    for name, file in shipped_weights().items():
        info = load_weights(file)[1]
        fits = info.network.sees_obstacles == seen and info.frame_rate_hz == first.frame_rate_hz
        fits = fits and (not seen or info.obstacle_cell_size == first.obstacle_grid.cell_size)
        if fits and present <= set(info.network.materials):
            found.append(file)
        else:
            print(f"left out: the shipped weights {name}, which are for other data", file=sys.stderr)
    return found


def _kernels_ahead(
    networks: Sequence[NetworkContender], episodes: Sequence[Episode], device: torch.device
) -> AheadCompilation | None:
    """Compiles what the fast networks launch: beside the solver, which needs one core."""
    fast = [contender for contender in networks if contender.path == "fast"]
    if not fast:
        return None
    # Triton, which the plain path does without, is loaded here.
    from hgn.runtime.ahead import frames_ahead

    particles = max(len(episode.material_N) for episode in episodes)
    sizes = [particles, 8 * particles, PARTICLES_AT_ONCE]
    pairs = [(contender.network.config, contender.precision) for contender in fast]
    return frames_ahead([config for config, _ in pairs], [precision for _, precision in pairs], device, sizes)


def trivial_contenders(store: EpisodeStore, device: torch.device) -> list[Contender]:
    """What a network must beat to have learned anything."""
    mean_3 = np.asarray(store.manifest.statistics("train").acceleration.mean)
    predictors: dict[str, Callable[[Episode], np.ndarray]] = {
        "constant velocity": lambda episode: np.zeros(3),
        "ballistic motion": lambda episode: np.asarray(episode.gravity) / episode.frame_rate_hz**2,
        "mean acceleration": lambda episode: mean_3,
    }
    return [TrivialContender(name, acceleration, device) for name, acceleration in predictors.items()]


def solver_contenders(
    config: ErrorVsTimeConfig, mpm: MpmConfig, launches: Callable[[int], SolverLaunches], own_grid: int
) -> list[Contender]:
    """The solver at its settings, and how far the reference departs from itself: the chaos floor."""
    step = config.reference_step if config.resimulate else mpm.stability_fraction
    if config.resimulate:
        launches(own_grid).add(Setting(step))

    def solver(grid: int, step: float, perturbation: float = 0.0) -> SolverContender:
        importance = SAME_GRID if grid == own_grid else COARSE_GRIDS
        return SolverContender(launches(grid), Setting(step, perturbation), config.mpm_frames, importance)

    points = {(grid, step): solver(grid, step) for grid in config.mpm_grids for step in config.mpm_steps}
    contenders: list[Contender] = list(points.values())
    if config.perturbation:
        perturbed = solver(own_grid, step, config.perturbation)
        contenders.append(perturbed.named(system="chaos", floor=f"perturbed by {config.perturbation:g}"))
    if config.mpm_grids and 2 * step <= 1:
        coarser = points.get((own_grid, 2 * step)) or solver(own_grid, 2 * step)
        contenders.append(coarser.named(system="chaos", floor="twice the step"))
    return contenders


def resimulated(
    episodes: Sequence[Episode], launches: SolverLaunches, step: float
) -> tuple[list[Episode], dict[str, str]]:
    """The episodes with the trajectories of another step, and the scenes that it stopped, with the cause; the other
    settings of the grid are simulated beside it.
    """
    with bar("reference", total=launches.frames, unit="frame") as progress:
        trials = launches.trials(Setting(step), episodes, lambda _: progress.update())
    pairs = list(zip(episodes, trials, strict=True))
    left_out = {episode.key: trial.cause for episode, trial in pairs if trial.cause is not None}
    return [_with_positions(e, trial.position_TN3) for e, trial in pairs if trial.cause is None], left_out


def add_pay_back(
    rows: Sequence[dict[str, Any]], config: ErrorVsTimeConfig, mpm: MpmConfig, episode: Episode, frames: int
) -> None:
    """Adds to networks after how many rollouts they have paid for themselves, against the solver that made the data."""
    own = round(1 / episode.obstacle_grid.cell_size)
    solver_ms = next(
        (r.get("ms") for r in rows if r["system"] == "mpm" and (r["grid"], r["step"]) == (own, mpm.stability_fraction)),
        None,
    )
    hours = dict(
        zip((find_weights(name).name for name in config.weights or ()), config.training_hours or (), strict=False)
    )
    for row in rows:
        if "weights" in row:
            row["training_hours"] = hours.get(row["weights"])
            row["generation_hours"] = config.generation_hours
            row["pay_back_rollouts"] = pay_back(row, solver_ms, row["training_hours"], config.generation_hours, frames)


def _with_positions(episode: Episode, position_TN3: np.ndarray) -> Episode:
    return replace(episode, position_TN3=position_TN3)


def _solver_device(device: torch.device) -> str:
    return "gpu" if device.type == "cuda" else "cpu"


if __name__ == "__main__":
    run_command(main, "error_vs_time")
