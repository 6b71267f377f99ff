"""Pushforward: the network simulates, and learns to return from the simulated states to the data.

The idea of Brandstetter et al. 2022, collected as in DAgger (Ross et al. 2011). Every `pushforward_every` updates the
present parameters (their moving average where there is one) simulate `pushforward_scenes` scenes, each from a random
frame of the data on for `pushforward_frames` (in long episodes for `pushforward_episode_fraction` of their frames), or
to the end of the episode. Each simulated frame becomes a window in a pool, and until the next simulation a fraction of
the samples is taken from the pool. Noise shows a network random errors, while its own are biased and common to a body.
Everything is drawn from seed, update and rank. The pool is not part of a checkpoint: a resumed training simulates anew,
with the same result where the checkpoint is at a multiple of `pushforward_every`.

The rule and the pool are here; scenes of a backend are in hgn.training.torch_pushforward and triton_pushforward.
Shape legend: H velocity history, F simulated frames, W = H + 2 frames of a window, N particles, S scenes.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from typing import Generic, Protocol, TypeVar

import numpy as np
import torch

from hgn.config import SIMULATED_FRAMES, TrainingConfig
from hgn.data.importance import DrawnBySize
from hgn.runtime.divergence import diverged
from hgn.runtime.simulator import InitialState
from hgn.scene.barrier import Barrier
from hgn.scene.episode import Episode
from hgn.schema import ConfigError
from hgn.training.noise import noise_scale, target_acceleration

E = TypeVar("E")  # an episode as a backend reads it


class Sample(Protocol):
    """A sample as a backend reads it."""

    @property
    def seed(self) -> int: ...


T = TypeVar("T", bound=Sample)
Starts = tuple[tuple[int, int], ...]  # episodes and frames that the network simulates from
START_STREAM, SAMPLE_STREAM = 0x57A7, 0xE217
# In finest cells, root mean square over a scene. Frames farther from the data are dropped, because its motion is no
# target for them, and they would dominate the loss; of an untrained network most frames are.
DROPPED_BEYOND = 0.5
PULLED_WITHIN = 1.0  # finest cells on each axis: the distance that a target takes a fraction of is clamped to this


def simulated_frames(training: TrainingConfig, frame_count: int) -> int:
    """Returns how many frames are simulated in an episode of `frame_count` frames, if it is long enough."""
    return max(training.pushforward_frames, int(training.pushforward_episode_fraction * frame_count))


def drawn_starts(training: TrainingConfig, update: int, rank: int, frame_counts: Sequence[int]) -> Starts:
    """Draws episode and frame of each simulation before `update`, from episodes with `frame_counts` frames.

    Every episode is drawn once before one is drawn twice. After the start frame the episode has as many frames as are
    simulated and one more, for the last target; or half of its frames, if that is less.
    Raises: ConfigError when all episodes are too short.
    """
    last = {
        i: count - 2 - min(simulated_frames(training, count), (count - 1) // 2) for i, count in enumerate(frame_counts)
    }
    long_enough = [i for i, count in enumerate(frame_counts) if count >= SIMULATED_FRAMES]
    if not long_enough:
        raise ConfigError(
            f"training.pushforward_fraction must be 0 where no episode has {SIMULATED_FRAMES} frames, got "
            f"{training.pushforward_fraction:g} for episodes of up to {max(frame_counts, default=0)} frames"
        )
    generator = np.random.default_rng([training.seed, START_STREAM, update, rank])
    drawn: list[int] = []
    while len(drawn) < training.pushforward_scenes:
        drawn += generator.permutation(long_enough).tolist()
    return tuple((i, int(generator.integers(last[i] + 1))) for i in drawn[: training.pushforward_scenes])


class PoolDraws:
    """Draws windows of a pool, by their target accelerations as far as `training.pushforward_importance` says."""

    def __init__(self, training: TrainingConfig, rank: int, accelerations: Sequence[float]) -> None:
        self._training, self._rank = training, rank
        self._windows = len(accelerations)
        self._by_size = DrawnBySize.of(np.array(accelerations, np.float64), training.pushforward_importance)

    def drawn(self, update: int) -> list[tuple[int, float]]:
        """Returns the windows that replace the first samples of an update, `pushforward_fraction` of them on average,
        each with its loss weight.
        """
        if not self._windows:
            return []
        generator = np.random.default_rng([self._training.seed, SAMPLE_STREAM, update, self._rank])
        count = int(self._training.pushforward_fraction * self._training.batch_scenes + generator.random())
        return [self._by_size.at(place) for place in generator.random(count)]


def known_frames(simulated: int, frame_count: int, frame: int) -> int:
    """Returns how many of the frames simulated from `frame` on have a target, in an episode of `frame_count` frames."""
    return min(simulated, frame_count - 2 - frame)


def pushforward_windows(
    true_TN3: torch.Tensor, simulated_FN3: torch.Tensor, pull: float, cell_size: float
) -> torch.Tensor:
    """Returns the windows of one scene's simulation, [F, W, N, 3].

    true_TN3 has the frames n - H to n + F + 1 of the data, simulated_FN3 the frames n + 1 to n + F. The last frame of
    the window of frame k is x_k + (true_{k+1} - true_k) + pull (true_k - x_k): the network undoes its velocity error,
    and a fraction of its position error, which also brings back particles that crossed a wall.
    """
    frames = len(simulated_FN3)
    history = len(true_TN3) - frames - 2
    positions_TN3 = torch.cat([true_TN3[: history + 1], simulated_FN3])
    question = positions_TN3.unfold(0, history + 1, 1)[1:].permute(0, 3, 1, 2)
    now_FN3, next_FN3 = true_TN3[history + 1 : -1], true_TN3[history + 2 :]
    limit = PULLED_WITHIN * cell_size
    answer = simulated_FN3 + (next_FN3 - now_FN3) + pull * (now_FN3 - simulated_FN3).clamp(-limit, limit)
    return torch.cat([question, answer[:, None]], dim=1)


def usable_frames(
    true_TN3: torch.Tensor, simulated_FN3: torch.Tensor, domain_3: torch.Tensor, cell_size: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns how many frames can be trained on, from the first on, and the mean squared distance from the data in the
    last of them, both [] on the device.
    """
    now_FN3 = true_TN3[len(true_TN3) - len(simulated_FN3) - 1 : -1]
    square_F = (simulated_FN3 - now_FN3).square().sum(-1).mean(-1)
    good_F = (square_F <= (DROPPED_BEYOND * cell_size) ** 2) & ~diverged(simulated_FN3, domain_3).any(
        -1
    )  # NaN diverged
    count = good_F.int().cumprod(0).sum()
    return count, square_F[(count - 1).clamp(min=0)]


@functools.lru_cache(maxsize=256)
def simulated_barrier(episode: Episode, clearance: float) -> Barrier:
    """Returns the barrier of an episode's obstacles, empty where only their cells are known.

    Barriers of the last episodes are cached; that of a large mesh takes 0.1 s and more.
    Raises: ConfigError for a clearance of more than a cell.
    """
    return InitialState.of_episode(episode).barrier(clearance)


class SimulatedScenes(Protocol[E, T]):
    """Scenes of a backend: its episodes, simulations from their frames, and its samples."""

    @property
    def cell_size(self) -> float:
        """The size of the finest cells."""

    def frame_count(self, episode: E) -> int:
        """Returns the number of frames of an episode, without those before frame 0."""

    def domain_size(self, episode: E) -> torch.Tensor:
        """Returns the domain size, [3] on the device."""

    def groups(self, starts: Sequence[tuple[E, int]]) -> list[Sequence[tuple[E, int]]]:
        """Divides scenes into groups that fit into memory."""

    def simulate(self, starts: Sequence[tuple[E, int]], frames: int) -> list[torch.Tensor]:
        """Returns simulated positions [F, N, 3] of each scene of a group; anything after a divergence."""

    def true_frames(self, episode: E, frame: int, known: int) -> torch.Tensor:
        """Returns the frames of the data from `frame` - H to `frame` + `known` + 1, [T, N, 3]."""

    def sample(self, episode: E, frame: int, window_WN3: torch.Tensor) -> T:
        """Returns the sample of a window around a frame."""

    def drawn(self, sample: T, seed: int, weight: float, scale: float) -> T:
        """Returns the sample with this seed, loss weight and noise scale."""


class PushforwardPool(Generic[E, T]):
    """Windows of the last simulations."""

    def __init__(self, scenes: SimulatedScenes[E, T], training: TrainingConfig, rank: int) -> None:
        self._scenes, self.training, self._rank = scenes, training, rank
        self._samples: list[tuple[T, float]] = []  # with the rms of the target acceleration
        self._draws = PoolDraws(training, rank, [])
        self.figures: dict[str, float] = {}

    def refresh(self, starts: Sequence[tuple[E, int]]) -> None:
        """Simulates from these frames, and fills the pool with the windows.

        Raises: ConfigError the first time, when the backend computes wrongly on this machine.
        """
        begin_s = time.monotonic()
        self._samples = []  # frees the memory
        squares, known = [], 0
        for frames, alike in self._by_frames(starts):
            for group in self._scenes.groups(alike):
                counts = [known_frames(frames, self._scenes.frame_count(episode), frame) for episode, frame in group]
                simulated = self._scenes.simulate(group, frames)
                squares += self._add(group, [path_FN3[:n] for path_FN3, n in zip(simulated, counts, strict=True)])
                known += sum(counts)
        self._draws = PoolDraws(self.training, self._rank, [acceleration for _, acceleration in self._samples])
        windows = len(self._samples)
        values = {"windows": float(windows), "dropped": float(known - windows), "seconds": time.monotonic() - begin_s}
        if squares:
            values["mse"] = float(np.mean(squares))
        self.figures = {f"pushforward/{name}": value for name, value in values.items()}

    def replaced(self, samples: Sequence[T], update: int) -> list[T]:
        """Returns an update's samples with a fraction from the pool: seeds stay, noise scales are computed anew."""
        samples, scenes = list(samples), self._scenes
        for slot, (number, rarity) in enumerate(self._draws.drawn(update)):
            own, acceleration = self._samples[number]
            seed = samples[slot].seed
            scale, weight = noise_scale(self.training, acceleration, seed)
            samples[slot] = scenes.drawn(own, seed, rarity * weight, scale)
        return samples

    def _by_frames(self, starts: Sequence[tuple[E, int]]) -> list[tuple[int, list[tuple[E, int]]]]:
        """Groups the starts by the number of frames to simulate; the largest group first."""
        groups: dict[int, list[tuple[E, int]]] = {}
        for episode, frame in starts:
            frames = simulated_frames(self.training, self._scenes.frame_count(episode))
            groups.setdefault(frames, []).append((episode, frame))
        return sorted(groups.items(), key=lambda group: -len(group[1]))

    def _add(self, starts: Sequence[tuple[E, int]], simulated: Sequence[torch.Tensor]) -> list[float]:
        """Adds the windows of simulated scenes; returns the mean squared distance from the data in the last frame of
        each scene that is usable until then.
        """
        scenes, cell_size, squares = self._scenes, self._scenes.cell_size, []
        pairs = list(zip(starts, simulated, strict=True))
        truths = [scenes.true_frames(episode, frame, len(path_FN3)) for (episode, frame), path_FN3 in pairs]
        usable = [
            torch.stack([x.double() for x in usable_frames(truth, path_FN3, scenes.domain_size(episode), cell_size)])
            for ((episode, _), path_FN3), truth in zip(pairs, truths, strict=True)
        ]
        for ((episode, frame), path_FN3), truth, (count, square) in zip(
            pairs, truths, torch.stack(usable).tolist(), strict=True
        ):
            windows = pushforward_windows(truth, path_FN3, self.training.pushforward_pull, cell_size)
            windows = windows[: int(count)].contiguous()
            accelerations = target_acceleration(windows).tolist()
            self._samples += [
                (scenes.sample(episode, frame + k + 1, window_WN3), acceleration)
                for k, (window_WN3, acceleration) in enumerate(zip(windows, accelerations, strict=True))
            ]
            squares += [square] if count == len(path_FN3) else []
        return squares
