"""One-step and rollout errors of the network, and of baselines without learned parameters.

Squared errors are summed over axes and averaged over particles, in frame units: domain units for positions, domain
units per frame squared for accelerations.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from hgn.data.batch import Batch, make_batch
from hgn.network.base import ParticleNetwork
from hgn.runtime.torch_backend import Backend
from hgn.scene.episode import Episode

REPORTED_FRAMES = (10, 50, 150, 299)  # frames of a rollout whose errors are reported
FRAMES_AT_ONCE = 16  # number of frames converted to float64 together
MONITORED_SCENES = 5  # number of scenes of each split that a training measures
LARGE_RATIO = 1e4  # ratios from here on are written with an exponent
PARTICLES_PER_BATCH = 32_768  # limits the memory of frames that are computed together
Predictor = Callable[[Batch], torch.Tensor]  # accelerations [N, 3] in frame units


def format_ratio(gain: float, digits: int = 2, unit: str = " times") -> str:
    """Describes an error by gain = (other error) / (this error): 2 gives "2.00 times below", 0.5 "2.00 times above"."""
    above = 0 < gain < 1
    number = 1 / gain if above else gain
    return f"{number:{f'.{digits}f' if number < LARGE_RATIO else '.1e'}}{unit} {'above' if above else 'below'}"


@dataclass
class SquaredError:
    """Sums of squared errors and particle counts by material. `mse` is the mean over all materials."""

    total: dict[str, float] = field(default_factory=dict)
    count: dict[str, int] = field(default_factory=dict)

    def add(self, error_N: torch.Tensor, material_N: torch.Tensor, materials: Sequence[str]) -> None:
        rows = len(materials)
        totals = torch.zeros(rows, dtype=torch.float64, device=error_N.device)
        totals.index_add_(0, material_N, error_N.double())
        counts = torch.bincount(material_N, minlength=rows)
        for name, total, count in zip(materials, totals.tolist(), counts.tolist(), strict=True):
            self.total[name] = self.total.get(name, 0.0) + total
            self.count[name] = self.count.get(name, 0) + count

    def include(self, other: "SquaredError") -> None:
        """Adds the sums of another one."""
        for name in other.total:
            self.total[name] = self.total.get(name, 0.0) + other.total[name]
            self.count[name] = self.count.get(name, 0) + other.count[name]

    @property
    def mse(self) -> float:
        count = sum(self.count.values())
        return sum(self.total.values()) / count if count else float("nan")

    def by_material(self) -> dict[str, float]:
        return {name: self.total[name] / self.count[name] for name in self.total if self.count[name]}


def ballistic(batch: Batch) -> torch.Tensor:
    """Returns the acceleration of free fall [N, 3]."""
    return batch.gravity_S3[batch.scene_N]


def baselines(network: ParticleNetwork) -> dict[str, Predictor]:
    """Returns the predictors that a trained network must improve on."""
    mean_3 = network.normaliser.acceleration_mean  # of the training data
    return {
        "constant velocity": lambda batch: torch.zeros_like(batch.window_WN3[0]),
        "ballistic motion": ballistic,
        "mean acceleration": lambda batch: mean_3.to(batch.window_WN3).expand_as(batch.window_WN3[0]),
    }


def network_predictor(backend: Backend) -> Predictor:
    """Returns the predictions of a backend as a function, without noise and jitter."""
    return lambda batch: backend.predict(batch.state())


def frame_batches(
    episodes: Sequence[Episode],
    network: ParticleNetwork,
    stride: int,
    particles_per_batch: int = PARTICLES_PER_BATCH,
    rank: int = 0,
    world_size: int = 1,
) -> Iterator[Batch]:
    """Returns batches of every stride-th frame of every episode. Each rank takes an equal part of the frames."""
    config = network.config
    pairs = [(e, n) for e in episodes for n in range(0, len(e.position_TN3) - 1, stride)][rank::world_size]
    return (make_batch(group, config) for group in groups_of_frames(pairs, particles_per_batch))


def groups_of_frames(
    pairs: Sequence[tuple[Episode, int]], most: int = PARTICLES_PER_BATCH
) -> Iterator[Sequence[tuple[Episode, int]]]:
    """Divides episodes with their frames into groups. A group ends when it has `most` particles or more."""
    before_P = np.cumsum([0, *(episode.particle_count for episode, _ in pairs)])
    first = 0
    while first < len(pairs):
        stop = max(first + 1, int(np.searchsorted(before_P, before_P[first] + most)))
        yield pairs[first:stop]
        first = stop


def one_step_errors(
    predictors: dict[str, Predictor],
    batches: Iterator[Batch],
    device: torch.device,
    materials: Sequence[str],
    stop: Callable[[], bool] = lambda: False,
) -> dict[str, SquaredError]:
    """Returns the squared errors of each predictor's accelerations over the batches."""
    errors = {name: SquaredError() for name in predictors}
    with torch.inference_mode():
        for batch in batches:
            if stop():
                break
            batch = batch.to(device)
            target_N3 = batch.acceleration()
            for name, predict in predictors.items():
                error_N = (predict(batch) - target_N3).square().sum(-1)
                errors[name].add(error_N, batch.material_N, materials)
    return errors


def position_mse(predicted_TN3: np.ndarray, reference_TN3: np.ndarray) -> np.ndarray:
    """Returns the mean squared distance of the particles at each frame, float64 [T]."""
    mse_T = np.empty(len(predicted_TN3))
    for first in range(0, len(mse_T), FRAMES_AT_ONCE):
        some = slice(first, first + FRAMES_AT_ONCE)
        difference_TN3 = np.subtract(predicted_TN3[some], reference_TN3[some], dtype=np.float64)
        np.einsum("tnk,tnk->t", difference_TN3, difference_TN3, out=mse_T[some])
    return mse_T / predicted_TN3.shape[1]


def rollout_errors(predicted: Sequence[np.ndarray], episodes: Sequence[Episode]) -> dict[str, np.ndarray]:
    """Returns the position MSE at each frame, float64 [T], for `all` particles and for each material.

    A value is the mean over the scenes that reached the frame and have the material; NaN without such scenes.
    `predicted` contains positions [T, N, 3] of each episode. The result has the length of the longest rollout.
    """
    frames = max(len(path_TN3) for path_TN3 in predicted)
    curves: dict[str, list[np.ndarray]] = {}
    for path_TN3, episode in zip(predicted, episodes, strict=True):
        reference_TN3 = episode.position_TN3[: len(path_TN3)]
        parts = {episode.materials[index]: episode.material_N == index for index in np.unique(episode.material_N)}
        for name, chosen in {"all": slice(None), **parts}.items():
            mse_T = np.full(frames, np.nan)
            mse_T[: len(path_TN3)] = position_mse(path_TN3[:, chosen], reference_TN3[:, chosen])
            curves.setdefault(name, []).append(mse_T)
    return {name: mean_so_far(np.stack(mse)) for name, mse in curves.items()}


def set_convention(one_step_mse: float, predicted: Sequence[np.ndarray], episodes: Sequence[Episode]) -> dict[str, Any]:
    """Returns errors as papers on imported sets report them: averaged also over axes, over free and over all particles.

    Boundary particles do not move, so they have no error; GNS includes them in its averages. Rollout errors are
    averaged over each scene, then over scenes. GNS compares all predicted frames (Sanchez-Gonzalez et al. 2020), and
    LagrangeBench the first 20 for MSE20 (Toshev et al. 2023). Units: the set's unit of length, squared.
    """
    dimensions = episodes[0].dimensions
    still = [0 if episode.boundary_P3 is None else len(episode.boundary_P3) for episode in episodes]
    share_S = np.array([e.particle_count / (e.particle_count + more) for e, more in zip(episodes, still, strict=True)])
    steps_S = np.array([e.particle_count * (e.frame_count - 1) for e in episodes], np.float64)
    free = one_step_mse / dimensions
    result = {"one_step": {"free": float(free), "all": float(free * (steps_S.sum() / (steps_S / share_S).sum()))}}
    curves = [
        position_mse(path_TN3[1:], episode.position_TN3[1 : len(path_TN3)]) / dimensions
        for path_TN3, episode in zip(predicted, episodes, strict=True)
    ]
    for name, frames in (("rollout", None), ("rollout_20_frames", 20)):
        free_S = np.array([mse_T[:frames].mean() for mse_T in curves])
        if len(free_S):
            result[name] = {"free": float(free_S.mean()), "all": float((free_S * share_S).mean())}
    return result


def mean_so_far(value_ST: np.ndarray) -> np.ndarray:
    """Returns the mean at each frame over the scenes with a finite value there, float64 [T]."""
    there_ST = np.isfinite(value_ST)
    count_T = there_ST.sum(0)
    return np.where(count_T > 0, np.where(there_ST, value_ST, 0).sum(0) / np.maximum(count_T, 1), np.nan)
