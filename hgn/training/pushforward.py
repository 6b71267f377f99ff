"""Pushforward: the network simulates, and learns to return from where that leads to the truth.

The idea of Brandstetter et al. 2022, collected like DAgger (Ross et al. 2011). Every `pushforward_every` updates the
present weights (their moving average where there is one) simulate `pushforward_scenes` scenes, each from a random true
frame on for `pushforward_frames` (of long episodes for `pushforward_episode_fraction` of their frames) or as long as
the truth goes, and each simulated frame becomes a window in a pool;
until the next simulation a fraction of the samples is taken from the pool. Noise shows a network errors that are drawn;
its own are biased, and common to a body. Everything is drawn from seed, update and rank. The pool is not part of a
checkpoint: a training that goes on makes a new one, which is the old one where the checkpoint lies at a multiple of
`pushforward_every`.

The rule is here, and the pool of the torch backend; that of the triton backend is in hgn.training.graph_pushforward.
Both replace samples before a batch is made of them.
Shape legend: H velocity history, F simulated frames, W = H + 2 frames of a window, N particles, S scenes.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch

from hgn.config import SIMULATED_FRAMES, TrainingConfig
from hgn.data.batch import BatchSample, UpdateSamples, make_batch
from hgn.data.importance import DrawnBySize
from hgn.network.barriers import Barriers
from hgn.network.base import ParticleNetwork
from hgn.runtime.backend import fastest_stepped
from hgn.runtime.divergence import diverged
from hgn.runtime.simulator import InitialState
from hgn.runtime.stepped_rollout import stepped
from hgn.scene.barrier import Barrier
from hgn.scene.episode import Episode
from hgn.scene.history import window
from hgn.schema import ConfigError
from hgn.training.errors import PARTICLES_PER_BATCH
from hgn.training.noise import noise_scale, target_acceleration

S = TypeVar("S")
Starts = tuple[tuple[int, int], ...]  # episodes and frames that the network simulates from
START_STREAM, SAMPLE_STREAM = 0x57A7, 0xE217
# finest cells; farther from the truth (rms over a scene) its motion is no answer any more, and the loss would be made
# of such frames alone: they are dropped, and with an untrained network most are
DROPPED_BEYOND = 0.5
PULLED_WITHIN = 1.0  # finest cells on an axis; no particle is pulled as if it were farther away


def simulated_frames(training: TrainingConfig, frame_count: int) -> int:
    """How many frames are simulated of an episode of so many, where its truth goes on for as long."""
    return max(training.pushforward_frames, int(training.pushforward_episode_fraction * frame_count))


def drawn_starts(training: TrainingConfig, update: int, rank: int, frame_counts: Sequence[int]) -> Starts:
    """Episode and frame that each simulation before `update` starts from, of episodes of so many frames.

    Every episode once before one comes twice, from a frame from which on the truth goes on for as long as is simulated,
    or for half of what it has, where that is less: it has to be known for one frame longer than is trained on.
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
    """Which windows of a pool are drawn, and how often: by the accelerations that they ask for where
    `training.pushforward_importance` says so."""

    def __init__(self, training: TrainingConfig, rank: int, accelerations: Sequence[float]) -> None:
        self._training, self._rank = training, rank
        self._windows = len(accelerations)
        self._by_size = DrawnBySize.of(np.array(accelerations, np.float64), training.pushforward_importance)

    def drawn(self, update: int) -> list[tuple[int, float]]:
        """The windows that replace the first samples of an update, `pushforward_fraction` of them on average, each
        with the weight of its loss.
        """
        if not self._windows:
            return []
        generator = np.random.default_rng([self._training.seed, SAMPLE_STREAM, update, self._rank])
        count = int(self._training.pushforward_fraction * self._training.batch_scenes + generator.random())
        return [self._by_size.at(place) for place in generator.random(count)]


def by_frames(training: TrainingConfig, starts: Sequence[S], frame_counts: Sequence[int]) -> list[tuple[int, list[S]]]:
    """The starts that are simulated for as many frames, with that number; the most of them first."""
    groups: dict[int, list[S]] = {}
    for start, count in zip(starts, frame_counts, strict=True):
        groups.setdefault(simulated_frames(training, count), []).append(start)
    return sorted(groups.items(), key=lambda group: -len(group[1]))


def known_frames(simulated: int, frame_count: int, frame: int) -> int:
    """How many of the frames simulated from `frame` on the truth of an episode of `frame_count` frames answers."""
    return min(simulated, frame_count - 2 - frame)


def pushforward_windows(
    true_TN3: torch.Tensor, simulated_FN3: torch.Tensor, pull: float, cell_size: float
) -> torch.Tensor:
    """The windows of one scene's simulation, [F, W, N, 3].

    true_TN3 holds the frames n - H to n + F + 1 of the truth, simulated_FN3 the frames n + 1 to n + F. The answer after
    frame k is x_k + (true_{k+1} - true_k) + pull (true_k - x_k): the network undoes its velocity error, and a fraction
    of its position error, which brings back what has crossed a wall.
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
    """How many frames from the first on can be trained on, and the mean squared distance from the truth in the last of
    them, both [] on the device.
    """
    now_FN3 = true_TN3[len(true_TN3) - len(simulated_FN3) - 1 : -1]
    square_F = (simulated_FN3 - now_FN3).square().sum(-1).mean(-1)
    good_F = (square_F <= (DROPPED_BEYOND * cell_size) ** 2) & ~diverged(simulated_FN3, domain_3).any(-1)  # NaN is not
    count = good_F.int().cumprod(0).sum()
    return count, square_F[(count - 1).clamp(min=0)]


def diverged_scenes(position_N3: torch.Tensor, scene_N: torch.Tensor, domain_S3: torch.Tensor) -> torch.Tensor:
    """Whether each particle belongs to a scene that has one that diverged, bool [N]."""
    scene_N = scene_N.long()
    diverged_S = torch.zeros(len(domain_S3), device=position_N3.device)
    diverged_S.index_add_(0, scene_N, diverged(position_N3, domain_S3[scene_N]).float())
    return diverged_S[scene_N] > 0


@functools.lru_cache(maxsize=256)
def simulated_barrier(episode: Episode, clearance: float) -> Barrier:
    """What of an episode's obstacles its simulations hold by: where only their cells are known, nothing.

    Kept for the episodes used last; that of a large mesh takes some tenths of a second.
    Raises: ConfigError for a clearance of more than a cell.
    """
    return InitialState.of_episode(episode).barrier(clearance)


class PushforwardPool:
    """The pool on backend torch, which serves every network; see GraphPushforwardPool for triton's."""

    def __init__(self, network: ParticleNetwork, training: TrainingConfig, rank: int) -> None:
        """`network` simulates."""
        self.network, self.training, self.rank = network, training, rank
        self._backend = fastest_stepped(network)
        self._samples: list[tuple[BatchSample, float]] = []  # with the rms of the target acceleration
        self._draws = PoolDraws(training, rank, [])
        self.figures: dict[str, float] = {}

    def refresh(self, starts: Sequence[tuple[Episode, int]]) -> None:
        """Simulates from these frames, and makes the pool of that."""
        begin_s = time.monotonic()
        self._samples = []
        squares, known = [], 0
        for frames, alike in by_frames(self.training, starts, [episode.frame_count for episode, _ in starts]):
            for group in self._groups(alike):
                for (episode, frame), simulated_FN3 in zip(group, self._simulate(group, frames), strict=True):
                    answered = known_frames(frames, episode.frame_count, frame)
                    squares += self._take(episode, frame, simulated_FN3[:answered])
                    known += answered
        self._draws = PoolDraws(self.training, self.rank, [acceleration for _, acceleration in self._samples])
        self.figures = pool_figures(len(self._samples), known, squares, time.monotonic() - begin_s)

    def replaced(self, update_samples: UpdateSamples, update: int) -> UpdateSamples:
        """The samples of an update with a fraction from the pool; seeds stay, and with them noise, jitter, symmetry."""
        samples = list(update_samples.samples)
        for slot, (number, rarity) in enumerate(self._draws.drawn(update)):
            own, acceleration = self._samples[number]
            seed = samples[slot].seed
            scale, weight = noise_scale(self.training, acceleration, seed)
            samples[slot] = replace(own, seed=seed, weight=rarity * weight, noise_scale=scale)
        return replace(update_samples, samples=tuple(samples))

    def _groups(self, starts: Sequence[tuple[Episode, int]]) -> list[list[tuple[Episode, int]]]:
        """What fits into memory at once."""
        groups: list[list[tuple[Episode, int]]] = []
        left = 0  # particles that the last group may still take
        for start in starts:
            if left <= 0:
                groups.append([])
                left = PARTICLES_PER_BATCH
            groups[-1].append(start)
            left -= len(start[0].material_N)
        return groups

    def _simulate(self, starts: Sequence[tuple[Episode, int]], frames: int) -> list[torch.Tensor]:
        """Positions [F, N, 3] of each scene; of a scene that diverged, whatever came after."""
        config = self.network.config
        batch = make_batch(starts, config).to(self._backend.device)
        begin = state = replace(batch.state(), barriers=self._barriers([episode for episode, _ in starts]))
        path = []
        for _ in range(frames):
            state = stepped(self._backend.predict, state, config)
            path.append(state.position_N3.cpu().clone())
            again_N = diverged_scenes(state.position_N3, state.scene_N, state.domain_S3)
            if bool(again_N.any()):
                position_N3 = torch.where(again_N[:, None], begin.position_N3, state.position_N3)
                velocity_NM3 = torch.where(again_N[:, None, None], 0.0, state.velocity_NM3)
                state = replace(state, position_N3=position_N3, velocity_NM3=velocity_NM3)
        return list(torch.stack(path).split(list(batch.particles_S), dim=1))

    def _barriers(self, episodes: Sequence[Episode]) -> Barriers | None:
        """What of the obstacles simulations hold by; windows are trained on without."""
        clearance = self.network.config.obstacle_clearance
        if clearance is None:
            return None
        barriers = Barriers.of([simulated_barrier(episode, clearance) for episode in episodes])
        return barriers and barriers.to(self._backend.device)

    def _take(self, episode: Episode, frame: int, simulated_FN3: torch.Tensor) -> list[float]:
        """Adds a scene's windows; its mean squared distance at the end, where it is there until then."""
        config, frames = self.network.config, len(simulated_FN3)
        true_TN3 = torch.from_numpy(window(episode, frame, config.velocity_history, frames + 1))
        count, square = usable_frames(true_TN3, simulated_FN3, torch.tensor(episode.domain_size), config.cell_size)
        windows = pushforward_windows(true_TN3, simulated_FN3, self.training.pushforward_pull, config.cell_size)
        accelerations = target_acceleration(windows).tolist()
        self._samples += [
            (BatchSample(episode, frame + k + 1, windows[k].numpy()), accelerations[k]) for k in range(int(count))
        ]
        return [float(square)] if count == frames else []


def pool_figures(windows: int, known: int, squares: Sequence[float], seconds: float) -> dict[str, float]:
    """What is logged of a pool of so many windows, where the truth is known of so many frames; `squares` are mean
    squared distances of whole simulations in their last frame.
    """
    values = {"windows": float(windows), "dropped": float(known - windows), "seconds": seconds}
    if squares:
        values["mse"] = float(np.mean(squares))
    return {f"pushforward/{name}": value for name, value in values.items()}
