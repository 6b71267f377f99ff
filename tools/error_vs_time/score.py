"""The row of a contender: its errors on the test scenes against the reference.

Conventions: squared errors are sums over axes and means over particles, in frame units; a mean over scenes includes
only scenes that reached the frame. Shape legend: T frames, N particles of a scene, S scenes.
"""

import functools
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch

from hgn.runtime.rollouts import RolloutResult
from hgn.scene.distance import fraction_inside, outside_domain
from hgn.scene.episode import Episode
from hgn.scene.episode_obstacles import obstacles_of_episode
from hgn.scene.material import MATERIALS
from hgn.training.errors import REPORTED_FRAMES, mean_so_far, position_mse
from tools import report
from tools.error_vs_time.contenders import Contender, OneStep
from tools.error_vs_time.sinkhorn import sinkhorn_divergences
from tools.measures import momentum_error

FRAME_STRIDE = 10  # one-step errors are measured on every tenth frame
BATCH_SCENES = 8  # number of rollouts that are simulated side by side
SINKHORN_SCENES, SINKHORN_POINTS, SINKHORN_BLUR = 20, 1024, 0.01  # most scenes, most points per material; domain units
OfMaterial = tuple[int, str, str, float]  # a scene's number, material and frame, and a value


def score(contender: Contender, references: Sequence[Episode], device: torch.device) -> dict[str, Any]:
    """Returns the contender's row without run times."""
    steps = [contender.one_step(episode, FRAME_STRIDE) for episode in references]
    frames = len(references[0].position_TN3)
    together = len(references) if contender.all_at_once else BATCH_SCENES
    trials: list[RolloutResult] = []
    for first in range(0, len(references), together):
        trials += contender.trials(references[first : first + together], frames, None)
    row = contender.row | one_step_figures([step for step in steps if step is not None])
    row |= rollout_figures(trials, references, device)
    known = [None if step is None else _rounded(step.error.mse) for step in steps]
    row["by_scene"] = ({"one-step MSE": {"0": known}} if any(v is not None for v in known) else {}) | row["by_scene"]
    return row


def one_step_figures(steps: Sequence[OneStep]) -> dict[str, Any]:
    """Returns errors over all scenes and by material, quartiles over scenes, and the mean acceleration at rest."""
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
    trials: Sequence[RolloutResult], references: Sequence[Episode], device: torch.device
) -> dict[str, Any]:
    """Returns the figures of rollouts; `curve` is the position MSE of each frame, NaN if no scene reached it."""
    frames = len(references[0].position_TN3)
    mse_ST = np.full((len(trials), frames), np.nan)

    def measured(mse_T: np.ndarray, trial: RolloutResult, reference: Episode) -> dict[str, float]:
        end = trial.frame_count
        mse_T[:end] = position_mse(trial.position_TN3, reference.position_TN3[:end])
        return {
            "momentum_error": momentum_error(trial.position_TN3, reference.position_TN3),
            "penetration": _penetration(trial.position_TN3[-1], reference, end - 1),
            "reference_penetration": _reference_penetration(reference, end - 1),
            "outside_domain": outside_domain(trial.position_TN3[-1], reference.domain_size),
        }

    with ThreadPoolExecutor(torch.get_num_threads()) as threads:
        of_scene = list(threads.map(measured, mse_ST, trials, references))
    reached_T = np.isfinite(mse_ST).sum(0)
    curve_T = mean_so_far(mse_ST)
    reported = sorted({frame for frame in (*REPORTED_FRAMES, frames - 1) if frame < frames})
    shown = [frame for frame in reported if reached_T[frame]]
    failures = [trial for trial in trials if trial.cause is not None]
    few = trials[:SINKHORN_SCENES]
    sinkhorn = _sinkhorn(few, references[:SINKHORN_SCENES], reported, device)
    row: dict[str, Any] = {
        "position_mse": {str(frame): float(curve_T[frame]) for frame in shown},
        "position_quartiles": {str(frame): quartiles(mse_ST[:, frame]) for frame in shown},
        "curve": [float(f"{value:.4g}") for value in curve_T],
        "scenes_reached": {str(frame): int(reached_T[frame]) for frame in reported},
        "sinkhorn": _means(sinkhorn),
        "by_scene": {
            "position MSE": {str(frame): [_rounded(value) for value in mse_ST[:, frame]] for frame in shown},
            "Sinkhorn": {str(frame): _by_scene(sinkhorn, str(frame), len(few)) for frame in shown},
        },
        "failed_scenes": len(failures),
        "first_failure_frame": min((trial.frame_count for trial in failures), default=None),
        "first_failure": failures[0].cause if failures else None,
        "seeds": [reference.seed for reference in references],
    }
    row |= {name: float(np.mean([scene[name] for scene in of_scene])) for name in of_scene[0]}
    row["most_penetration"] = max(scene["penetration"] - scene["reference_penetration"] for scene in of_scene)
    return row


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Returns a table of the rows."""
    frames = sorted({int(frame) for row in rows for frame in row.get("scenes_reached", {})})
    frames = [frame for frame in frames if frame in (10, 50, frames[-1])]
    head = ["system", "ms", "batched", "one-step", *(f"MSE {frame}" for frame in frames), "Sinkhorn", "failed"]
    lines = []
    for row in rows:
        last = [values[max(values, key=int)] for values in row["sinkhorn"].values() if values]
        errors = [row["one_step_mse"], *(row["position_mse"].get(str(frame)) for frame in frames)]
        errors.append(float(np.mean(last)) if last else None)
        times = [report.number(row.get(name), ".3f") for name in ("ms", "ms_batched")]
        shown = [report.number(error, ".2e").replace("e-0", "e-").replace("e+0", "e+") for error in errors]
        lines.append([label(row).replace(".safetensors", ""), *times, *shown, row["failed_scenes"]])
    return report.table(head, lines)


def label(row: Mapping[str, Any], setting: bool = True) -> str:
    """Returns a contender's name; without `setting` that of all steps of a grid, or of all precisions of a network."""
    match row["system"]:
        case "mpm":
            return f"MPM {row['grid']}³" + (f", step {row['step']:g}" if setting else "")
        case "baseline":
            return str(row["predictor"])
        case "chaos":
            return f"chaos floor: {row['floor']}"
    size = f"M = {row['message_passing_steps']}"
    size = f"L = {row['levels']}, {size}" if row["system"] == "hgn" else size
    size += f", {row['backend']} {row['precision']}" if setting else ""
    return f"{row['system'].upper().replace('_', ' ')} {size} ({row['weights']})"


# cached: the same for every contender
@functools.lru_cache(maxsize=1024)
def _reference_penetration(reference: Episode, frame: int) -> float:
    return _penetration(np.asarray(reference.position_TN3[frame]), reference, frame)


def _penetration(position_N3: np.ndarray, reference: Episode, frame: int) -> float:
    return fraction_inside(position_N3, obstacles_of_episode(reference), frame / reference.frame_rate_hz)


def _sinkhorn(
    trials: Sequence[RolloutResult], references: Sequence[Episode], frames: Sequence[int], device: torch.device
) -> list[OfMaterial]:
    """Compares particles of each material, drawn at random. Frames that a scene did not reach are left out."""
    parts, pairs = [], []
    for scene, (trial, reference) in enumerate(zip(trials, references, strict=True)):
        for index in np.unique(reference.material_N):
            chosen = np.flatnonzero(reference.material_N == index)
            chosen = np.random.default_rng(reference.seed).permutation(chosen)[:SINKHORN_POINTS]
            for frame in frames:
                if frame < trial.frame_count:
                    both = (each.position_TN3[frame, chosen] for each in (trial, reference))
                    one_N3, other_N3 = (torch.from_numpy(position_N3).to(device) for position_N3 in both)
                    parts.append((scene, MATERIALS[index], str(frame)))
                    pairs.append((one_N3, other_N3))
    values = sinkhorn_divergences(pairs, SINKHORN_BLUR)
    return [(*part, value) for part, value in zip(parts, values, strict=True)]


def _means(values: Iterable[OfMaterial]) -> dict[str, dict[str, float]]:
    """Averages over the scenes that contain a material and reached a frame."""
    of_frames: dict[str, dict[str, list[float]]] = {}
    for _, material, frame, value in values:
        of_frames.setdefault(material, {}).setdefault(frame, []).append(value)
    return {name: {frame: float(np.mean(v)) for frame, v in frames.items()} for name, frames in of_frames.items()}


def _by_scene(values: Iterable[OfMaterial], frame: str, scenes: int) -> list[float | None]:
    """Returns the mean over materials of each scene, None for a scene that did not reach the frame."""
    of_scenes: list[list[float]] = [[] for _ in range(scenes)]
    for scene, _, other, value in values:
        if other == frame:
            of_scenes[scene].append(value)
    return [_rounded(np.mean(some)) if some else None for some in of_scenes]


def _rounded(value: float | np.floating[Any]) -> float | None:
    return float(f"{value:.5g}") if np.isfinite(value) else None


def quartiles(values: Sequence[float] | np.ndarray) -> list[float] | None:
    """Returns the first and third quartile of the finite values."""
    finite = np.asarray(values, np.float64)
    finite = finite[np.isfinite(finite)]
    return [float(q) for q in np.percentile(finite, (25, 75))] if len(finite) else None
