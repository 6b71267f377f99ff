"""python -m hgn.evaluate weights=… data=…: measures one-step and rollout errors, and those of baselines."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hgn.command import run_command
from hgn.config import DEFAULT_WEIGHTS, SimulatorConfig, Split
from hgn.data.fresh import set_record
from hgn.data.manifest import errors_in_config
from hgn.data.reader import EpisodeStore, first_episodes
from hgn.scene.distance import fraction_inside, outside_domain
from hgn.scene.episode import Episode
from hgn.schema import Bounded, FileName, NonNegative, Positive, from_mapping
from hgn.system.files import require_place, write_json
from hgn.system.loading import loading
from hgn.system.progress import bar
from hgn.system.signals import Signals, interrupt

if TYPE_CHECKING:
    from hgn.data.batch import Batch
    from hgn.runtime.rollouts import RolloutResult
    from hgn.runtime.simulator import Simulator
    from hgn.runtime.torch_backend import Backend


@dataclass(frozen=True)
class EvaluateConfig(SimulatorConfig, Bounded):
    """`python -m hgn.evaluate`: one-step and rollout errors on a split of a data set."""

    data: str  # folder or URL of a data set
    weights: str = DEFAULT_WEIGHTS  # a file of python -m hgn.export, or the name of shipped weights
    split: Split = "validation"  # train, validation or test
    scenes: Positive[int] = 5  # number of scenes, the first of the split by index
    frame_stride: Positive[int] = 1  # distance between two frames whose one-step errors are measured
    rollout_frames: NonNegative[int] = 300  # length of each rollout in frames; 0: no rollouts
    json: FileName | None = None  # file for the figures; null: none


def main(mapping: dict[str, Any]) -> int:
    """Prints a table, and writes JSON if `json` is set. After a signal both have what was measured. Returns the code.

    Raises: KeyboardInterrupt for a signal before the first measurement.
    """
    with loading():
        from hgn.runtime.simulator import InitialState, Simulator
        from hgn.runtime.weights import require_frame_rate

    config = from_mapping(EvaluateConfig, mapping)
    if config.json is not None:
        require_place(Path(config.json))
    simulator = Simulator.load(config.weights, config.device, config.backend, config.precision)
    store = EpisodeStore(config.data, config.split)
    episodes = first_episodes(store, config.scenes)
    require_frame_rate(simulator.info, episodes[0].frame_rate_hz)
    for episode in episodes:
        simulator.require_fits(InitialState.of_episode(episode))
    with Signals() as signals:
        _measure(config, simulator, store, episodes, signals)
    return signals.exit_code


def _measure(
    config: EvaluateConfig, simulator: Simulator, store: EpisodeStore, episodes: list[Episode], signals: Signals
) -> None:
    from hgn.runtime.weights import find_weights
    from hgn.system.provenance import provenance
    from hgn.training.errors import set_convention

    stop, frames = lambda: signals.requested, 1
    trials: list[RolloutResult] = []
    rows = one_step_rows(simulator.backend, episodes, config, stop)
    if not rows[0]["frames"]:
        interrupt(signals.received[0])
    if config.rollout_frames >= 2 and not signals.requested:
        print(simulator.backend.note, file=sys.stderr)
        trials, frames = rollouts(simulator, episodes, config.rollout_frames, stop)
    if frames > 1:
        rows.append(rollout_row(trials, episodes, frames))
    print(table(rows, config, len(episodes)))
    measured = f"one-step errors of {rows[0]['frames']} frames, rollouts of {frames if frames > 1 else 'no'} frames"
    if signals.requested:
        print(f"stopped early: {measured} were measured", file=sys.stderr)
    own = None
    if episodes[0].imported:
        paths = [trial.position_TN3 for trial in trials]
        own = set_convention(rows[0]["one_step_mse"], paths, episodes[: len(paths)] or episodes)
        print("in the set's own convention: mean over axes and frames; free particles, all particles")
        for name, error in own.items():
            print(f"{name.replace('_', ' '):<20} {error['free']:.3e}, {error['all']:.3e}")
    if config.json is not None:
        with errors_in_config(config.data):
            seed = store.manifest.config["seed"]
        report = {
            "meta": provenance(simulator.device)
            | {"weights": Path(config.weights).name, "updates": simulator.info.updates, "split": config.split}
            | {"set": set_record(config.data, seed, [find_weights(config.weights)])}
            | ({"stopped_early": measured} if signals.requested else {}),
            "rows": rows,
        }
        if own is not None:
            report["set_convention"] = own
        write_json(config.json, report)


def one_step_rows(
    backend: Backend, episodes: list[Episode], config: EvaluateConfig, stop: Callable[[], bool] = lambda: False
) -> list[dict[str, Any]]:
    """Returns a row for each predictor: {"system", "frames" measured until `stop`, "one_step_mse", "by_material"}.

    If scenes are of several kinds (`scene.kinds`), the network's row also has "by_kind": {kind: {"one_step_mse",
    "fraction" of the whole squared error}}, the largest fraction first.
    """
    from hgn.training.errors import SquaredError, baselines, frame_batches, network_predictor, one_step_errors

    network, device = backend.network, backend.device
    predictors = {"network": network_predictor(backend)} | baselines(network)
    total = sum(-(-(len(episode.position_TN3) - 1) // config.frame_stride) for episode in episodes)
    kinds: dict[str, list[Episode]] = {}
    for episode in episodes:
        kinds.setdefault(episode.specification.get("layout", ""), []).append(episode)
    errors, by_kind = {name: SquaredError() for name in predictors}, {}
    with bar("one-step errors", total=total, unit="frame") as progress:

        def counted(batches: Iterable[Batch]) -> Iterator[Batch]:
            for batch in batches:
                yield batch
                progress.update(len(batch.particles_S))

        for kind, of_kind in kinds.items():
            batches = counted(frame_batches(of_kind, network, config.frame_stride))
            found = one_step_errors(predictors, batches, device, network.config.materials, stop)
            by_kind[kind] = found["network"]
            for name, error in found.items():
                errors[name].include(error)
    rows: list[dict[str, Any]] = [
        {"system": name, "frames": progress.n, "one_step_mse": error.mse, "by_material": error.by_material()}
        for name, error in errors.items()
    ]
    if len(kinds) > 1:
        whole = sum(errors["network"].total.values()) or 1.0
        parts = sorted(((sum(e.total.values()) / whole, kind) for kind, e in by_kind.items() if e.count), reverse=True)
        rows[0]["by_kind"] = {k: {"one_step_mse": by_kind[k].mse, "fraction": part} for part, k in parts}
    return rows


def rollouts(
    simulator: Simulator, episodes: list[Episode], frames: int, stop: Callable[[], bool]
) -> tuple[list[RolloutResult], int]:
    """Simulates the episodes from their first frame to the last frame of the shortest one, or until `stop`.

    Returns the rollouts and the number of frames.
    """
    from hgn.runtime.rollouts import simulate_scenes
    from hgn.runtime.simulator import InitialState

    frames = min(frames, *(len(episode.position_TN3) for episode in episodes))
    with bar("rollouts", total=frames - 1, unit="frame") as progress:
        initial = [InitialState.of_episode(episode) for episode in episodes]
        return simulate_scenes(simulator, initial, frames, lambda _: progress.update(), stop), progress.n + 1


def rollout_row(trials: Sequence[RolloutResult], episodes: list[Episode], frames: int) -> dict[str, Any]:
    """Returns {"system", "frames", "position_mse": {frame: value}, "scenes_reached": {frame: count},
    "mean_position_mse", "by_material", "ends"}. An error is the mean over the scenes that reached its frame."""
    from hgn.training.errors import REPORTED_FRAMES, rollout_errors

    mse_T = rollout_errors([trial.position_TN3 for trial in trials], episodes)
    reported = sorted({n for n in (*REPORTED_FRAMES, frames - 1) if n < frames})
    reached = {str(n): sum(trial.frame_count > n for trial in trials) for n in reported}
    return {
        "system": "network rollout",
        "frames": frames,
        "position_mse": _at_frames(mse_T["all"], reported),
        "scenes_reached": reached,
        "mean_position_mse": float(np.nanmean(mse_T["all"])),
        "by_material": {name: _at_frames(of_T, reported) for name, of_T in mse_T.items() if name != "all"},
        "ends": [end_of_rollout(trial, episode) for trial, episode in zip(trials, episodes, strict=True)],
    }


def _at_frames(mse_T: np.ndarray, frames: list[int]) -> dict[str, float]:
    return {str(n): float(mse_T[n]) for n in frames if n < len(mse_T) and np.isfinite(mse_T[n])}


def end_of_rollout(trial: RolloutResult, episode: Episode) -> dict[str, Any]:
    """Returns the fractions of particles in closed obstacles and outside of the domain in a rollout's last frame, the
    former also in the data, and the cause of an early end."""
    from hgn.scene.episode_obstacles import obstacles_of_episode

    obstacles, last = obstacles_of_episode(episode), trial.frame_count - 1
    time_s = last / episode.frame_rate_hz
    position_N3 = trial.position_TN3[last]
    return {
        "episode": episode.key,
        "frames": trial.frame_count,
        "cause": trial.cause,
        "penetration": fraction_inside(position_N3, obstacles, time_s),
        "reference_penetration": fraction_inside(np.asarray(episode.position_TN3[last]), obstacles, time_s),
        "outside_domain": outside_domain(position_N3, episode.domain_size),
    }


def table(rows: list[dict[str, Any]], config: EvaluateConfig, scenes: int) -> str:
    """Returns the figures as text. Errors are sums over axes and means over particles, in frame units."""
    from hgn.training.errors import format_ratio

    every = "every frame" if config.frame_stride == 1 else f"every {config.frame_stride}th frame"
    lines = [
        f"{config.split}, {scenes} scene{'s' * (scenes > 1)}, {every}; sum over axes, mean over particles, frame units"
    ]
    lines.append(f"{'predictor':<20} {'one-step MSE':>12}  by material")
    for row in rows:
        if "one_step_mse" in row:
            materials = ", ".join(f"{name} {value:.2e}" for name, value in row["by_material"].items())
            lines.append(f"{row['system']:<20} {row['one_step_mse']:>12.3e}  {materials}")
            for kind, part in row.get("by_kind", {}).items():
                lines.append(
                    f"  {kind or 'no kind':<18} {part['one_step_mse']:>12.3e}  {part['fraction']:.0%} of the error"
                )
        else:
            frames = ", ".join(f"frame {frame} {value:.2e}" for frame, value in row["position_mse"].items())
            lines.append(f"{row['system']:<20} position MSE: {frames}")
            short = [end for end in row["ends"] if end["cause"] is not None]
            if short:
                first = min(short, key=lambda end: end["frames"])
                place = f"{first['episode']} at frame {first['frames']}: {first['cause']}"
                lines.append(f"{'diverged':<20} {len(short)} of {len(row['ends'])} scenes, first {place}")
            fractions = ("penetration", "reference_penetration", "outside_domain")
            mean = {name: np.mean([end[name] for end in row["ends"]]) for name in fractions}
            worst = max(end["penetration"] - end["reference_penetration"] for end in row["ends"])
            lines.append(
                f"{'at the end':<20} within obstacles {mean['penetration']:.2%}, the data's "
                f"{mean['reference_penetration']:.2%} ({worst:.2%} more in the worst scene), "
                f"beyond the domain {mean['outside_domain']:.2%}"
            )
    ours = next(row["one_step_mse"] for row in rows if row["system"] == "network")
    best = min(row["one_step_mse"] for row in rows if "one_step_mse" in row and row["system"] != "network")
    ratio = best / ours if ours > 0 else float("inf")
    lines.append(f"the network's one-step MSE is {format_ratio(ratio)} the best baseline's")
    return "\n".join(lines)


if __name__ == "__main__":
    run_command(main, "evaluate")
