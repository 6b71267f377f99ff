"""python -m tools.error_vs_time data=… weights=[…] out=results/error_vs_time: error against run time.

Networks (shipped ones where none are named), the solver at coarser grids and larger steps, and predictors that learn
nothing, all on the same test scenes, scored by one converged simulation. Writes a table, OUT.json, OUT.png and
OUT_frames.png.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

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
from hgn.schema import ConfigError, from_mapping, require, to_mapping
from tools.error_vs_time.contenders import Contender, NetworkContender, SolverContender, TrivialContender
from tools.error_vs_time.plot import CONVENTION, draw_frames, draw_pareto
from tools.error_vs_time.score import pay_back, report, score, table, time_in_turns
from tools.error_vs_time.settings import PRECISIONS, ErrorVsTimeConfig
from tools.trial import other_grid, solver_scene, solver_trials

# of the seconds given: until when a contender's errors, and its run times, may be begun with
SCORING_SHARE, TIMING_SHARE = 0.6, 0.85


def main(mapping: dict[str, Any]) -> int:
    """Prints a table and writes the report; returns the exit code."""
    begun = time.monotonic()
    config = from_mapping(ErrorVsTimeConfig, mapping)
    device = choose_device(config.device)
    store = EpisodeStore(config.data, config.split)
    episodes = first_episodes(store, config.scenes)
    frames = min(config.frames, *(len(episode.position_TN3) for episode in episodes))
    mpm = replace(from_mapping(MpmConfig, store.manifest.config["mpm"], "mpm"), device=_solver_device(device))
    contenders = network_contenders(config, device, episodes)
    if config.resimulate:
        references, left_out = resimulated(episodes, replace(mpm, stability_fraction=config.reference_step), frames)
        reference = f"the solver on the data's grid at {config.reference_step:g} of the limit of stability"
    else:
        references, left_out = [_with_positions(e, np.asarray(e.position_TN3[:frames])) for e in episodes], {}
        reference = "the data"
    require(bool(references), "data", "scenes that the solver gets through", left_out)
    contenders += trivial_contenders(store, device)
    contenders += solver_contenders(config, mpm, references[0])

    def late(share: float) -> bool:
        return config.seconds is not None and time.monotonic() - begun > share * config.seconds

    rows: list[dict[str, Any]] = []
    curves: list[np.ndarray] = []
    scored: list[Contender] = []
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
    }
    out = Path(config.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    file = config.json or f"{out}.json"
    with bar("errors", total=len(contenders) * len(references), unit="scene") as progress:
        for contender in contenders:
            if late(SCORING_SHARE):
                not_run.append(contender.row)
                print(f"left out, for the time is over: {contender.row}", file=sys.stderr)
                continue
            started = time.monotonic()
            row, curve_T = score(contender, references, config, device, progress.update)
            rows.append(row)
            curves.append(curve_T)
            scored.append(contender)
            row["scoring_s"] = time.monotonic() - started
            write_json(file, report(meta, rows), allow_nan=False)  # errors outlive a run that is cut off
    timed = [i for i, row in enumerate(rows) if row["system"] not in ("trivial", "chaos")]
    times_of = time_in_turns([scored[i] for i in timed], references, config, device, lambda: late(TIMING_SHARE))
    for i, times in zip(timed, times_of, strict=True):
        rows[i] |= times
    add_pay_back(rows, config, mpm, references[0], frames)
    meta["seconds"] = time.monotonic() - begun
    print(table(rows))
    write_json(file, report(meta, rows), allow_nan=False)
    write_atomically(Path(f"{out}.png"), draw_pareto(rows, meta))
    write_atomically(Path(f"{out}_frames.png"), draw_frames(rows, curves, meta))
    print(f"{out}.png {out}_frames.png {file}")
    return 0


def network_contenders(config: ErrorVsTimeConfig, device: torch.device, episodes: Sequence[Episode]) -> list[Contender]:
    """Every weights file at every precision that its path knows; what is left out is said.

    Of shipped weights, those that see obstacles, where there are obstacles, and else those that do not.
    """
    files = [find_weights(name) for name in config.weights or ()]
    if config.weights is None:
        obstacles = any(len(episode.obstacle_grid.cell_K3) for episode in episodes)
        files = [f for f in shipped_weights().values() if load_weights(f)[1].network.sees_obstacles == obstacles]
    precisions = config.precisions or (PRECISIONS if device.type == "cuda" else ("fp32",))
    contenders: list[Contender] = []
    for file in files:
        for precision in precisions:
            try:
                contenders.append(NetworkContender(file, precision, config.path, device, episodes[0].frame_rate_hz))
            except ConfigError as error:
                if precision != "fp16":
                    raise
                print(f"left out: {file.name} at fp16: {error}", file=sys.stderr)
    return contenders


def trivial_contenders(store: EpisodeStore, device: torch.device) -> list[Contender]:
    """What a network must beat to have learned anything."""
    mean_3 = np.asarray(store.manifest.statistics("train").acceleration.mean)
    predictors: dict[str, Callable[[Episode], np.ndarray]] = {
        "constant velocity": lambda episode: np.zeros(3),
        "ballistic motion": lambda episode: np.asarray(episode.gravity) / episode.frame_rate_hz**2,
        "mean acceleration": lambda episode: mean_3,
    }
    return [TrivialContender(name, acceleration, device) for name, acceleration in predictors.items()]


def solver_contenders(config: ErrorVsTimeConfig, mpm: MpmConfig, episode: Episode) -> list[Contender]:
    """The solver at its settings, and how far the reference departs from itself: the chaos floor."""
    own, rate = episode.obstacle_grid.cell_size, episode.frame_rate_hz
    step = config.reference_step if config.resimulate else mpm.stability_fraction

    def solver(grid: int, step: float, perturbation: float = 0.0) -> SolverContender:
        settings = replace(other_grid(mpm, 1 / grid, own), stability_fraction=step)
        return SolverContender(settings, 1 / grid, rate, config.mpm_frames, config.mpm_timed_frames, perturbation)

    own_grid = round(1 / own)
    points = {(grid, step): solver(grid, step) for grid in config.mpm_grids for step in config.mpm_steps}
    contenders: list[Contender] = list(points.values())
    if config.perturbation:
        perturbed = solver(own_grid, step, config.perturbation)
        contenders.append(perturbed.named(system="chaos", floor=f"perturbed by {config.perturbation:g}"))
    if config.mpm_grids and 2 * step <= 1:
        coarser = points.get((own_grid, 2 * step)) or solver(own_grid, 2 * step)
        contenders.append(coarser.named(system="chaos", floor="twice the step"))
    return contenders


def resimulated(episodes: Sequence[Episode], mpm: MpmConfig, frames: int) -> tuple[list[Episode], dict[str, str]]:
    """The episodes with the trajectories of other solver settings, and the scenes that it stopped, with the cause."""
    with bar("reference", total=frames, unit="frame") as progress:
        trials = solver_trials(
            [solver_scene(episode) for episode in episodes],
            mpm,
            frames,
            episodes[0].frame_rate_hz,
            lambda _: progress.update(),
        )
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
