"""python -m tools.error_vs_time data=… weights=[…] out=results/error_vs_time: error against run time.

Networks, the solver at coarser grids and larger steps, and predictors that learn nothing, all on the same test scenes,
scored by one converged simulation. Writes a table, OUT.json, OUT.png and OUT_frames.png.
"""

from __future__ import annotations

import sys
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
from hgn.scene.episode import Episode
from hgn.schema import ConfigError, from_mapping, require, to_mapping
from tools.error_vs_time.contenders import Contender, NetworkContender, SolverContender, TrivialContender
from tools.error_vs_time.plot import CONVENTION, draw_frames, draw_pareto
from tools.error_vs_time.score import pay_back, report, score, table, time_in_turns
from tools.error_vs_time.settings import PRECISIONS, ErrorVsTimeConfig
from tools.trial import other_grid, solver_scene, solver_trials


def main(mapping: dict[str, Any]) -> int:
    """Prints a table and writes the report; returns the exit code."""
    config = from_mapping(ErrorVsTimeConfig, mapping)
    device = choose_device(config.device)
    store = EpisodeStore(config.data, config.split)
    episodes = first_episodes(store, config.scenes)
    frames = min(config.frames, *(len(episode.position_TN3) for episode in episodes))
    mpm = replace(from_mapping(MpmConfig, store.manifest.config["mpm"], "mpm"), device=_solver_device(device))
    contenders = network_contenders(config, device, episodes[0])
    if config.resimulate:
        references, left_out = resimulated(episodes, replace(mpm, stability_fraction=config.reference_step), frames)
        reference = f"the solver on the data's grid at {config.reference_step:g} of the limit of stability"
    else:
        references, left_out = [_with_positions(e, np.asarray(e.position_TN3[:frames])) for e in episodes], {}
        reference = "the data"
    require(bool(references), "data", "scenes that the solver gets through", left_out)
    contenders += trivial_contenders(store, device)
    if config.resimulate:
        contenders += solver_contenders(config, mpm, references[0])

    rows, curves = [], []
    with bar("errors", total=len(contenders) * len(references), unit="scene") as progress:
        for contender in contenders:
            row, curve_T = score(contender, references, config, device, progress.update)
            rows.append(row)
            curves.append(curve_T)
    timed = [i for i, row in enumerate(rows) if row["system"] not in ("trivial", "chaos")]
    for i, times in zip(timed, time_in_turns([contenders[i] for i in timed], references, config, device), strict=True):
        rows[i] |= times
    add_pay_back(rows, config, mpm, references[0], frames)

    meta = provenance(device) | {
        "config": without_folders(to_mapping(config)),
        "data": Path(config.data).name,
        "split": config.split,
        "scenes": len(references),
        "episodes": [episode.key for episode in references],
        "left_out": left_out,
        "frames": frames,
        "reference": reference,
        "convention": CONVENTION,
    }
    print(table(rows))
    out = Path(config.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(config.json or f"{out}.json", report(meta, rows), allow_nan=False)
    write_atomically(Path(f"{out}.png"), draw_pareto(rows, meta))
    write_atomically(Path(f"{out}_frames.png"), draw_frames(rows, curves, meta))
    print(f"{out}.png {out}_frames.png {config.json or f'{out}.json'}")
    return 0


def network_contenders(config: ErrorVsTimeConfig, device: torch.device, episode: Episode) -> list[Contender]:
    """Every weights file at every precision that its path knows; what is left out is said."""
    precisions = config.precisions or (PRECISIONS if device.type == "cuda" else ("fp32",))
    contenders: list[Contender] = []
    for file in config.weights:
        for precision in precisions:
            try:
                contenders.append(NetworkContender(Path(file), precision, config.path, device, episode.frame_rate_hz))
            except ConfigError as error:
                if precision != "fp16":
                    raise
                print(f"left out: {Path(file).name} at fp16: {error}", file=sys.stderr)
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
    contenders: list[Contender] = [
        SolverContender(replace(other_grid(mpm, 1 / grid, own), stability_fraction=step), 1 / grid, rate)
        for grid in config.mpm_grids
        for step in config.mpm_steps
    ]
    finest = replace(mpm, stability_fraction=config.reference_step)
    perturbed = SolverContender(finest, own, rate, config.perturbation)
    perturbed.row = {"system": "chaos", "floor": f"perturbed by {config.perturbation:g}"}
    contenders.append(perturbed)
    if 2 * config.reference_step <= 1:
        coarser = SolverContender(replace(mpm, stability_fraction=2 * config.reference_step), own, rate)
        coarser.row = {"system": "chaos", "floor": "twice the step"}
        contenders.append(coarser)
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
    hours = dict(zip((Path(file).name for file in config.weights), config.training_hours or (), strict=False))
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
