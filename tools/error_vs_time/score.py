"""The row of a contender: its errors on the test scenes against the reference, and its run times.

Conventions: squared errors sum over axes and average over particles, in frame units; means over scenes, of those
scenes that reached the frame. Shape legend: T frames, N particles of a scene.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch

from hgn.runtime.rollouts import RolloutResult
from hgn.scene.distance import share_inside
from hgn.scene.episode import Episode
from hgn.scene.material import MATERIALS
from hgn.scene.rollout_file import obstacles_of_episode
from hgn.training.errors import REPORTED_FRAMES, mean_so_far, position_mse
from tools.error_vs_time.contenders import Contender, OneStep
from tools.error_vs_time.settings import ErrorVsTimeConfig
from tools.error_vs_time.sinkhorn import sinkhorn_divergences
from tools.measures import momentum_error, outside_domain


def score(
    contender: Contender,
    references: Sequence[Episode],
    config: ErrorVsTimeConfig,
    device: torch.device,
) -> dict[str, Any]:
    """The row without run times."""
    steps = [contender.one_step(episode, config.frame_stride, config.rest_speed) for episode in references]
    frames = len(references[0].position_TN3)
    trials: list[RolloutResult] = []
    together = len(references) if contender.all_at_once else config.batch_scenes
    for first in range(0, len(references), together):
        some = references[first : first + together]
        trials += contender.trials(some, frames, None)
    row = contender.row | one_step_figures([step for step in steps if step is not None])
    row |= rollout_figures(trials, references, config, device)
    known = [None if step is None else _rounded(step.error.mse) for step in steps]
    row["by_scene"] = ({"one-step MSE": {"0": known}} if any(v is not None for v in known) else {}) | row["by_scene"]
    return row


def one_step_figures(steps: Sequence[OneStep]) -> dict[str, Any]:
    """Errors over all scenes, by material, their quartiles over scenes, and the mean acceleration at rest."""
    if not steps:
        return {"one_step_mse": None, "one_step_quartiles": None, "one_step_by_material": None, "ghost": None}
    total = {name: sum(step.error.total.get(name, 0.0) for step in steps) for name in MATERIALS}
    count = {name: sum(step.error.count.get(name, 0) for step in steps) for name in MATERIALS}
    resting = sum(step.rest_count for step in steps)
    return {
        "one_step_mse": sum(total.values()) / sum(count.values()),
        "one_step_quartiles": quartiles([step.error.mse for step in steps]),
        "one_step_by_material": {name: total[name] / count[name] for name in MATERIALS if count[name]},
        "ghost": sum(step.rest_sum for step in steps) / resting if resting else None,
        "ghost_samples": resting,
    }


def rollout_figures(
    trials: Sequence[RolloutResult], references: Sequence[Episode], config: ErrorVsTimeConfig, device: torch.device
) -> dict[str, Any]:
    """Everything that rollouts tell; `curve` is the position MSE of each frame, none where no scene came so far."""
    frames = len(references[0].position_TN3)
    mse_ST = np.full((len(trials), frames), np.nan)
    with ThreadPoolExecutor(torch.get_num_threads()) as threads:
        for mse_T, found_T in zip(mse_ST, threads.map(_position_mse, trials, references), strict=True):
            mse_T[: len(found_T)] = found_T
        momenta = list(threads.map(_momentum_error, trials, references))
        ends = list(threads.map(_end, trials, references))
    reached_T = np.isfinite(mse_ST).sum(0)
    curve_T = mean_so_far(mse_ST)
    reported = sorted({frame for frame in (*REPORTED_FRAMES, frames - 1) if frame < frames})
    told = [frame for frame in reported if reached_T[frame]]
    failures = [trial for trial in trials if trial.cause is not None]
    sinkhorn_S = _sinkhorn(
        trials[: config.sinkhorn_scenes], references[: config.sinkhorn_scenes], reported, config, device
    )
    row: dict[str, Any] = {
        "position_mse": {str(frame): float(curve_T[frame]) for frame in told},
        "position_quartiles": {str(frame): quartiles(mse_ST[:, frame]) for frame in told},
        "position_by_material": _by_material(trials, references, told),
        "curve": [float(f"{value:.4g}") for value in curve_T],
        "scenes_reached": {str(frame): int(reached_T[frame]) for frame in reported},
        "sinkhorn": _means([found for of_scene in sinkhorn_S for found in of_scene.items()]),
        "by_scene": {
            "position MSE": {str(frame): [_rounded(value) for value in mse_ST[:, frame]] for frame in told},
            "Sinkhorn": {str(frame): [_of_frame(found, str(frame)) for found in sinkhorn_S] for frame in told},
        },
        "failed_scenes": len(failures),
        "first_failure_frame": min((trial.frame_count for trial in failures), default=None),
        "first_failure": failures[0].cause if failures else None,
        "seeds": [reference.seed for reference in references],
    }
    row["momentum_error"] = float(np.mean(momenta))
    for name in ("penetration", "reference_penetration", "outside_domain"):
        row[name] = float(np.mean([end[name] for end in ends]))
    row["most_penetration"] = max(end["penetration"] - end["reference_penetration"] for end in ends)
    return row


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The figures for people."""
    frames = sorted({int(frame) for row in rows for frame in row.get("scenes_reached", {})})
    head = "".join(f"{f'MSE at {frame}':>12}" for frame in frames)
    lines = [f"{'system':<48} {'ms':>9} {'batched':>9} {'one-step MSE':>13}{head} {'Sinkhorn':>10} {'failed':>7}"]
    for row in rows:
        errors = "".join(f"{_number(row['position_mse'].get(str(frame))):>12}" for frame in frames)
        last = [values[max(values, key=int)] for values in row["sinkhorn"].values() if values]
        lines.append(
            f"{label(row):<48} {_number(row.get('ms'), '.3f'):>9} {_number(row.get('ms_batched'), '.3f'):>9} "
            f"{_number(row['one_step_mse']):>13}{errors} {_number(float(np.mean(last)) if last else None):>10} "
            f"{row['failed_scenes']:>7}"
        )
    return "\n".join(lines)


def label(row: Mapping[str, Any]) -> str:
    """A contender's name."""
    match row["system"]:
        case "mpm":
            return f"MPM {row['grid']}³, step {row['step']:g}"
        case "baseline":
            return str(row["predictor"])
        case "chaos":
            return f"chaos floor: {row['floor']}"
    size = f"M = {row['message_passing_steps']}"
    size = f"L = {row['levels']}, {size}" if row["system"] == "hgn" else size
    return f"{row['system'].upper().replace('_', ' ')} {size}, {row['backend']} {row['precision']} ({row['weights']})"


def report(
    meta: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], paired: Sequence[Mapping[str, Any]] = ()
) -> dict[str, Any]:
    """What the report's JSON holds; numbers that are none are null, for JSON knows no NaN."""
    return {"meta": meta, "rows": _plain(list(rows)), "paired": list(paired)}


def _position_mse(trial: RolloutResult, reference: Episode) -> np.ndarray:
    return position_mse(trial.position_TN3, reference.position_TN3[: trial.frame_count])


def _by_material(
    trials: Sequence[RolloutResult], references: Sequence[Episode], frames: Sequence[int]
) -> dict[str, dict[str, float]]:
    """Position MSE of a material's particles: means over the scenes that hold it and reached the frame."""
    found: dict[str, dict[str, list[float]]] = {}
    for trial, reference in zip(trials, references, strict=True):
        reached = [frame for frame in frames if frame < trial.frame_count]
        for index in np.unique(reference.material_N):
            chosen_N = reference.material_N == index
            of_frames = found.setdefault(MATERIALS[index], {})
            for frame in reached:
                pair = trial.position_TN3[frame, chosen_N], reference.position_TN3[frame, chosen_N]
                of_frames.setdefault(str(frame), []).append(float(position_mse(*(part[None] for part in pair))[0]))
    return {name: {frame: float(np.mean(v)) for frame, v in values.items()} for name, values in found.items()}


def _momentum_error(trial: RolloutResult, reference: Episode) -> float:
    return momentum_error(trial.position_TN3, reference.position_TN3)


def _end(trial: RolloutResult, reference: Episode) -> dict[str, float]:
    last_N3 = trial.position_TN3[-1]
    return {
        "penetration": share_inside(last_N3, obstacles_of_episode(reference)),
        "reference_penetration": _reference_penetration(reference, trial.frame_count - 1),
        "outside_domain": outside_domain(last_N3, reference.domain_size),
    }


# The same for every contender.
@functools.lru_cache(maxsize=1024)
def _reference_penetration(reference: Episode, frame: int) -> float:
    return share_inside(np.asarray(reference.position_TN3[frame]), obstacles_of_episode(reference))


def _sinkhorn(
    trials: Sequence[RolloutResult],
    references: Sequence[Episode],
    frames: Sequence[int],
    config: ErrorVsTimeConfig,
    device: torch.device,
) -> list[dict[tuple[str, str], float]]:
    """Of each scene, by material and frame."""
    named, pairs = [], []
    for scene, (trial, reference) in enumerate(zip(trials, references, strict=True)):
        for index in np.unique(reference.material_N):
            of_material = np.flatnonzero(reference.material_N == index)
            # The same particles of both: as near to the whole clouds as so few can be.
            chosen = np.random.default_rng(reference.seed).permutation(of_material)[: config.sinkhorn_points]
            for frame in frames:
                if frame < trial.frame_count:
                    first, second = (
                        torch.from_numpy(np.ascontiguousarray(path[frame, chosen])).to(device)
                        for path in (trial.position_TN3, reference.position_TN3)
                    )
                    named.append((scene, MATERIALS[index], str(frame)))
                    pairs.append((first, second))
    found: list[dict[tuple[str, str], float]] = [{} for _ in trials]
    for (scene, *kind), value in zip(named, sinkhorn_divergences(pairs, config.sinkhorn_blur), strict=True):
        found[scene][kind[0], kind[1]] = value
    return found


def _means(values: Sequence[tuple[tuple[str, str], float]]) -> dict[str, dict[str, float]]:
    found: dict[str, dict[str, list[float]]] = {}
    for (material, frame), value in values:
        found.setdefault(material, {}).setdefault(frame, []).append(value)
    return {name: {frame: float(np.mean(v)) for frame, v in frames.items()} for name, frames in found.items()}


def _of_frame(values: Mapping[tuple[str, str], float], frame: str) -> float | None:
    """The mean over materials; none for a scene that did not come so far."""
    found = [value for (_, other), value in values.items() if other == frame]
    return _rounded(np.mean(found)) if found else None


def _rounded(value: float | np.floating[Any]) -> float | None:
    return float(f"{value:.5g}") if np.isfinite(value) else None


def quartiles(values: Sequence[float] | np.ndarray) -> list[float] | None:
    """The first and the third of what is finite."""
    finite = np.asarray(values, np.float64)
    finite = finite[np.isfinite(finite)]
    return [float(q) for q in np.percentile(finite, (25, 75))] if len(finite) else None


def _number(value: float | None, form: str = ".2e") -> str:
    return "-" if value is None or not np.isfinite(value) else format(value, form)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
