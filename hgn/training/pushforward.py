"""Pushforward: the network simulates, and learns to return from the simulated states to the data.

The idea is that of Brandstetter et al. 2022. Samples are collected as in DAgger (Ross et al. 2011). The rules are in
docs/concepts/training.md. Noise shows the network random errors. The network's own errors are biased, and similar for
all particles of a body. Seed, update and rank determine all draws. The pool is not part of a checkpoint, so a resumed
training simulates again. Its updates are those of an uninterrupted training if the checkpoint is at a multiple of
`pushforward_every`.

This module contains the pool, pushforward_targets the targets; torch_pushforward and triton_pushforward simulate.
Shape legend: H velocity history, F simulated frames, T = H + F + 2 frames of the data, W = H + 2 frames of a window,
N particles, S scenes.
"""

import functools
import json
import time
from collections.abc import Sequence
from typing import Generic, Protocol, TypeVar

import numpy as np
import torch

from hgn.config import SIMULATED_FRAMES, TrainingConfig
from hgn.data.importance import DrawnBySize
from hgn.runtime.divergence import diverged
from hgn.scene.barrier import Barrier, build_barrier
from hgn.scene.episode import Episode
from hgn.scene.episode_obstacles import corners_at_rest
from hgn.schema import ConfigError, Vector
from hgn.training.noise import quiet_weight, target_acceleration
from hgn.training.pushforward_targets import pushforward_windows

E = TypeVar("E")  # an episode as a backend reads it


class Sample(Protocol):
    """A sample as a backend reads it."""

    @property
    def seed(self) -> int: ...


T = TypeVar("T", bound=Sample)
Starts = tuple[tuple[int, int], ...]  # (episode, frame) of each simulation's start
START_STREAM, SAMPLE_STREAM = 0x57A7, 0xE217
# Largest RMS distance of a frame from the data, in finest cells. Frames farther away are dropped, with all later ones:
# the data's motion is no target for them, and they would dominate the loss. An untrained network loses most frames.
DROPPED_BEYOND = 0.5


class SimulationStoppedError(Exception):
    """A stop request ended the simulations before an update. The same simulations are made when the run resumes."""


def simulated_frames(training: TrainingConfig, frame_count: int) -> int:
    """Returns the number of frames to simulate in an episode of `frame_count` frames. The episode may end earlier."""
    return max(training.pushforward_frames, int(training.pushforward_episode_fraction * frame_count))


def drawn_starts(training: TrainingConfig, update: int, rank: int, frame_counts: Sequence[int]) -> Starts:
    """Draws the episode and the start frame of each simulation before `update`.

    Every episode is drawn once before one is drawn twice. After a start the episode has enough frames for a whole
    simulation (or for half of the episode, if that is shorter), and one more as the last target. `frame_counts` are the
    episodes' numbers of frames. Raises: ConfigError if all episodes are too short.
    """
    last = {
        i: count - 2 - min(simulated_frames(training, count), (count - 1) // 2) for i, count in enumerate(frame_counts)
    }
    long_enough = [i for i, count in enumerate(frame_counts) if count >= SIMULATED_FRAMES]
    if not long_enough:
        raise ConfigError(
            f"training.pushforward_fraction must be 0 if no episode has {SIMULATED_FRAMES} frames, got "
            f"{training.pushforward_fraction:g} for episodes of up to {max(frame_counts, default=0)} frames"
        )
    generator = np.random.default_rng([training.seed, START_STREAM, update, rank])
    drawn: list[int] = []
    while len(drawn) < training.pushforward_scenes:
        drawn += generator.permutation(long_enough).tolist()
    return tuple((i, int(generator.integers(last[i] + 1))) for i in drawn[: training.pushforward_scenes])


class PoolDraws:
    """Draws pool windows: a fraction `training.pushforward_importance` by target acceleration, the others uniformly."""

    def __init__(self, training: TrainingConfig, rank: int, accelerations: Sequence[float]) -> None:
        self._training, self._rank = training, rank
        self._windows = len(accelerations)
        self._by_size = DrawnBySize.of(np.array(accelerations, np.float64), training.pushforward_importance)

    def drawn(self, update: int) -> list[tuple[int, float]]:
        """Returns the numbers and loss weights of the windows that replace the first samples of an update.

        On average they replace `pushforward_fraction` of the update's samples.
        """
        if not self._windows:
            return []
        generator = np.random.default_rng([self._training.seed, SAMPLE_STREAM, update, self._rank])
        count = int(self._training.pushforward_fraction * self._training.batch_scenes + generator.random())
        return [self._by_size.at(place) for place in generator.random(count)]


def usable_frames(
    true_TN3: torch.Tensor, simulated_FN3: torch.Tensor, domain_3: torch.Tensor, cell_size: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the number of leading frames usable for training, and the last one's error, as scalars on the device.

    The error is the mean squared distance from the data in the last usable frame.
    """
    now_FN3 = true_TN3[len(true_TN3) - len(simulated_FN3) - 1 : -1]
    square_F = (simulated_FN3 - now_FN3).square().sum(-1).mean(-1)
    # NaN counts as diverged
    usable_F = (square_F <= (DROPPED_BEYOND * cell_size) ** 2) & ~diverged(simulated_FN3, domain_3).any(-1)
    count = usable_F.int().cumprod(0).sum()
    return count, square_F[(count - 1).clamp(min=0)]


def simulated_barrier(episode: Episode, clearance: float) -> Barrier:
    """Returns the barrier of an episode's obstacles; it is empty if only the obstacles' cells are stored.

    The last barriers are cached: a large mesh takes 0.1 s or more.
    Raises: ConfigError for a clearance of more than a cell.
    """
    specification, cell_size = json.dumps(episode.specification), episode.obstacle_grid.cell_size
    return _barrier(specification, cell_size, clearance, tuple(episode.domain_size))


@functools.lru_cache(maxsize=256)
def _barrier(specification: str, cell_size: float, clearance: float, domain_size: Vector) -> Barrier:
    """Does not take the episode, because the cache would keep its positions in memory."""
    return build_barrier(corners_at_rest(json.loads(specification)), cell_size, clearance, domain_size)


class SimulatedScenes(Protocol[E, T]):
    """The interface that pushforward needs of a backend: episodes, simulations from their frames, and samples."""

    @property
    def cell_size(self) -> float:
        """Returns the size of the finest cells in domain units."""

    def frame_count(self, episode: E) -> int:
        """Returns the number of frames of an episode, without the frames before frame 0."""

    def domain_size(self, episode: E) -> torch.Tensor:
        """Returns the domain size, [3] on the device."""

    def groups(self, starts: Sequence[tuple[E, int]]) -> list[Sequence[tuple[E, int]]]:
        """Divides scenes into groups that fit into memory."""

    def simulate(self, starts: Sequence[tuple[E, int]], frames: int) -> list[torch.Tensor]:
        """Returns simulated positions [F, N, 3] of each scene of a group. Values after a divergence are undefined."""

    def true_frames(self, episode: E, frame: int, simulated: int) -> torch.Tensor:
        """Returns the frames of the data from `frame` - H to `frame` + `simulated` + 1, [T, N, 3]."""

    def materials_and_bodies(self, episode: E) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Returns each particle's material, and the particles of each elastic body, on the simulation's device."""

    def sample(self, episode: E, frame: int, window_WN3: torch.Tensor) -> T:
        """Returns the sample of a window around a frame."""

    def drawn(self, sample: T, seed: int, weight: float) -> T:
        """Returns the sample with this seed and loss weight."""


class PushforwardPool(Generic[E, T]):
    """The windows of the last simulations."""

    def __init__(self, scenes: SimulatedScenes[E, T], training: TrainingConfig, rank: int) -> None:
        self._scenes, self.training, self._rank = scenes, training, rank
        self._samples: list[tuple[T, float]] = []  # samples, and the rms of their target accelerations
        self._draws = PoolDraws(training, rank, [])
        self.figures: dict[str, float] = {}

    def refresh(self, starts: Sequence[tuple[E, int]]) -> None:
        """Simulates from these starts and fills the pool with the windows.

        Raises: ConfigError in the first call, if the backend's results differ from PyTorch's.
        """
        begin_s = time.monotonic()
        self._samples = []  # frees memory before the simulations
        squares, total = [], 0
        for frames, equally_long in self._by_frames(starts):
            for group in self._scenes.groups(equally_long):
                # later frames have no target in the episode
                counts = [min(frames, self._scenes.frame_count(episode) - 2 - frame) for episode, frame in group]
                simulated = self._scenes.simulate(group, frames)
                squares += self._add(group, [path_FN3[:n] for path_FN3, n in zip(simulated, counts, strict=True)])
                total += sum(counts)
        self._draws = PoolDraws(self.training, self._rank, [acceleration for _, acceleration in self._samples])
        windows = len(self._samples)
        values = {"windows": float(windows), "dropped": float(total - windows), "seconds": time.monotonic() - begin_s}
        if squares:
            values["mse"] = float(np.mean(squares))
        self.figures = {f"pushforward/{name}": value for name, value in values.items()}

    def replaced(self, samples: Sequence[T], update: int) -> list[T]:
        """Returns the samples, some replaced by samples of the pool, each with the seed of the sample it replaces."""
        samples, scenes = list(samples), self._scenes
        for slot, (number, draw_weight) in enumerate(self._draws.drawn(update)):
            simulated, acceleration = self._samples[number]
            weight = draw_weight * quiet_weight(self.training, acceleration)
            samples[slot] = scenes.drawn(simulated, samples[slot].seed, weight)
        return samples

    def _by_frames(self, starts: Sequence[tuple[E, int]]) -> list[tuple[int, list[tuple[E, int]]]]:
        """Groups the starts by the number of frames to simulate. The largest group comes first."""
        groups: dict[int, list[tuple[E, int]]] = {}
        for episode, frame in starts:
            frames = simulated_frames(self.training, self._scenes.frame_count(episode))
            groups.setdefault(frames, []).append((episode, frame))
        return sorted(groups.items(), key=lambda group: -len(group[1]))

    def _add(self, starts: Sequence[tuple[E, int]], simulated: Sequence[torch.Tensor]) -> list[float]:
        """Adds the windows of simulated scenes to the pool.

        Returns the mean squared distances from the data in the last frame, for scenes whose frames are all usable.
        """
        scenes, cell_size, squares = self._scenes, self._scenes.cell_size, []
        pairs = list(zip(starts, simulated, strict=True))
        truths = [scenes.true_frames(episode, frame, len(path_FN3)) for (episode, frame), path_FN3 in pairs]
        usable = [
            torch.stack([x.double() for x in usable_frames(truth, path_FN3, scenes.domain_size(episode), cell_size)])
            for ((episode, _), path_FN3), truth in zip(pairs, truths, strict=True)
        ]
        for ((episode, frame), path_FN3), truth, (number, square) in zip(
            pairs, truths, torch.stack(usable).tolist(), strict=True
        ):
            count = int(number)
            if count == 0:
                continue
            true_TN3, simulated_FN3 = truth[: len(truth) - len(path_FN3) + count], path_FN3[:count]
            material_N, bodies = scenes.materials_and_bodies(episode)
            windows = pushforward_windows(true_TN3, simulated_FN3, cell_size, material_N=material_N, bodies=bodies)
            windows = windows.contiguous()
            accelerations = target_acceleration(windows).tolist()
            self._samples += [
                (scenes.sample(episode, frame + k + 1, window_WN3), acceleration)
                for k, (window_WN3, acceleration) in enumerate(zip(windows, accelerations, strict=True))
            ]
            squares += [square] if count == len(path_FN3) else []
        return squares
