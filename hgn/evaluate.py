"""python -m hgn.evaluate weights=… data=…: one-step and rollout errors beside the trivial predictors'."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from hgn.command import run_command
from hgn.config import EvaluateConfig
from hgn.data.reader import EpisodeStore
from hgn.data.select import first_episodes
from hgn.files import write_json
from hgn.network.base import ParticleNetwork
from hgn.progress import bar
from hgn.provenance import provenance
from hgn.runtime.simulator import DivergenceError, InitialState, Simulator
from hgn.runtime.weights import require_frame_rate
from hgn.scene.distance import share_inside
from hgn.scene.episode import Episode
from hgn.scene.rollout_file import obstacles_of_episode
from hgn.schema import from_mapping
from hgn.training.errors import (
    REPORTED_FRAMES,
    frame_batches,
    network_predictor,
    one_step_errors,
    rollout_errors,
    told_gain,
    trivial_predictors,
)


def main(mapping: dict[str, Any]) -> int:
    """Prints a table, and writes JSON where asked to; returns the exit code."""
    config = from_mapping(EvaluateConfig, mapping)
    simulator = Simulator.load(config.weights, config.device, config.path, config.precision)
    info = simulator.info
    store = EpisodeStore(config.data, config.split)
    episodes = first_episodes(store, config.scenes)
    require_frame_rate(info, episodes[0].frame_rate_hz)
    rows = one_step_rows(simulator.network, episodes, config)
    if config.rollout_frames >= 2:
        print(simulator.path_said, file=sys.stderr)
        rows.append(rollout_row(simulator, episodes, config.rollout_frames))
    print(table(rows, config, len(episodes)))
    if config.json is not None:
        report = {
            "meta": provenance(simulator.device) | {"weights": Path(config.weights).name, "updates": info.updates},
            "rows": rows,
        }
        write_json(config.json, report)
    return 0


def one_step_rows(network: ParticleNetwork, episodes: list[Episode], config: EvaluateConfig) -> list[dict[str, Any]]:
    """One row a predictor: {"system", "one_step_mse", "by_material"}."""
    predictors = {"network": network_predictor(network)} | trivial_predictors(network)
    device = next(network.parameters()).device
    total = sum(-(-(len(episode.position_TN3) - 1) // config.frame_stride) for episode in episodes)
    with bar("one-step errors", total=total, unit="frame") as progress:

        def counted() -> Any:
            for batch in frame_batches(episodes, network, config.frame_stride, config.particles_per_batch):
                yield batch
                progress.update(len(batch.particles_S))

        errors = one_step_errors(predictors, counted(), device, network.config.materials)
    return [
        {"system": name, "one_step_mse": error.mse, "by_material": error.by_material()}
        for name, error in errors.items()
    ]


def rollout_row(simulator: Simulator, episodes: list[Episode], frames: int) -> dict[str, Any]:
    """{"system", "position_mse": {frame: value}, "mean_position_mse"}, or where the rollout diverged."""
    frames = min(frames, *(len(episode.position_TN3) for episode in episodes))
    with bar("rollouts", total=frames - 1, unit="frame") as progress:
        try:
            initial = [InitialState.of_episode(episode) for episode in episodes]
            predicted = simulator.rollout(initial, frames, lambda _: progress.update())
        except DivergenceError as error:
            return {"system": "network rollout", "diverged_at_frame": error.frame}
    mse_T = rollout_errors(predicted, episodes)
    told = sorted({n for n in (*REPORTED_FRAMES, frames - 1) if n < frames})
    return {
        "system": "network rollout",
        "position_mse": {str(n): float(mse_T["all"][n]) for n in told},
        "mean_position_mse": float(mse_T["all"].mean()),
        "by_material": {name: {str(n): float(of_T[n]) for n in told} for name, of_T in mse_T.items() if name != "all"},
        "ends": [end_of_rollout(path, episode) for path, episode in zip(predicted, episodes, strict=True)],
    }


def end_of_rollout(path_TN3: np.ndarray, episode: Episode) -> dict[str, Any]:
    """Shares of the particles within closed obstacles, beside the data's, and beyond the domain, in the last frame."""
    obstacles, last = obstacles_of_episode(episode), len(path_TN3) - 1
    beyond_N3 = (path_TN3[last] < 0) | (path_TN3[last] > np.asarray(episode.domain_size))
    return {
        "episode": episode.key,
        "penetration": share_inside(path_TN3[last], obstacles),
        "reference_penetration": share_inside(np.asarray(episode.position_TN3[last]), obstacles),
        "outside_domain": float(beyond_N3.any(-1).mean()),
    }


def table(rows: list[dict[str, Any]], config: EvaluateConfig, scenes: int) -> str:
    """The figures for people. Errors sum over axes and average over particles, in frame units."""
    every = "every frame" if config.frame_stride == 1 else f"every {config.frame_stride}th frame"
    lines = [f"{config.split}, {scenes} scenes, {every}; sum over axes, mean over particles, frame units"]
    lines.append(f"{'predictor':<20} {'one-step MSE':>12}  by material")
    for row in rows:
        if "one_step_mse" in row:
            materials = ", ".join(f"{name} {value:.2e}" for name, value in row["by_material"].items())
            lines.append(f"{row['system']:<20} {row['one_step_mse']:>12.3e}  {materials}")
        elif "diverged_at_frame" in row:
            lines.append(f"{row['system']:<20} diverged at frame {row['diverged_at_frame']}")
        else:
            frames = ", ".join(f"frame {frame} {value:.2e}" for frame, value in row["position_mse"].items())
            lines.append(f"{row['system']:<20} position MSE: {frames}")
            mean = {name: np.mean([end[name] for end in row["ends"]]) for name in row["ends"][0] if name != "episode"}
            worst = max(end["penetration"] - end["reference_penetration"] for end in row["ends"])
            lines.append(
                f"{'at the end':<20} within obstacles {mean['penetration']:.2%}, the solver's "
                f"{mean['reference_penetration']:.2%} (at most {worst:.2%} more), "
                f"beyond the domain {mean['outside_domain']:.2%}"
            )
    ours = next(row["one_step_mse"] for row in rows if row["system"] == "network")
    best = min(row["one_step_mse"] for row in rows if "one_step_mse" in row and row["system"] != "network")
    ratio = best / ours if ours > 0 else float("inf")
    lines.append(f"the network's one-step MSE is {told_gain(ratio)} the best trivial predictor's")
    return "\n".join(lines)


if __name__ == "__main__":
    run_command(main, "evaluate")
