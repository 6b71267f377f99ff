"""Computes the order of training samples: a pure function of seed, epoch, episodes and window.

A sample is one frame of one episode. An epoch is a permutation of all samples of the episodes that were published when
it began. Batch size and number of ranks only divide the order: every sample is used exactly once per epoch. All batches
have the same size, so a batch may span two epochs. A `SamplerState` is the whole state of the order.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hgn.schema import Bounded, ConfigError, NonNegative, require
from hgn.system.splitmix import splitmix64


@dataclass(frozen=True)
class SamplerState(Bounded):
    """Holds the position in the order of samples, over all ranks."""

    epoch: NonNegative[int] = 0
    position: NonNegative[int] = 0  # number of samples of this epoch that were taken
    episodes: NonNegative[int] = 0  # number of episodes in this epoch; 0: not yet fixed
    digest: str = ""  # digest of the shards with these episodes; empty: they end within a shard
    window: NonNegative[int] = 0  # episodes whose samples are shuffled together (training.shuffle_episodes); 0: all
    seed: int = 0  # seed of the order


class Sample(NamedTuple):  # faster to construct than a dataclass; a thousand are drawn per second
    """Names frame n of an episode. The network sees frames up to n and predicts the acceleration to frame n + 1."""

    episode: int
    frame: int
    seed: int  # seed of its noise, grid jitter and symmetry
    weight: float = 1.0  # loss weight


BLOCK_EPISODES = 8  # number of consecutive episodes in a block of the shuffle; most shards have this size


def epoch_order(seed: int, epoch: int, first_sample: np.ndarray, window: int = 0) -> np.ndarray:
    """Returns the order of an epoch, int64 [samples].

    `first_sample` [episodes + 1] is the index of each episode's first sample; its last entry is the number of samples.
    Without a `window` all samples are shuffled together. With one, the blocks of BLOCK_EPISODES are shuffled, and then
    the samples within each window of blocks. A rank then needs the shards of at most two windows at a time, and each
    shard once per epoch (twice if it is in two blocks).
    """
    generator = np.random.Generator(np.random.PCG64([seed, epoch]))
    episodes = len(first_sample) - 1
    if window == 0 or window >= episodes:
        return generator.permutation(int(first_sample[-1]))
    blocks = generator.permutation(-(-episodes // BLOCK_EPISODES))
    together = max(1, window // BLOCK_EPISODES)
    order = []
    for start in range(0, len(blocks), together):
        ranges = [
            np.arange(first_sample[block * BLOCK_EPISODES], first_sample[min((block + 1) * BLOCK_EPISODES, episodes)])
            for block in blocks[start : start + together].tolist()
        ]
        order.append(generator.permutation(np.concatenate(ranges)))
    return np.concatenate(order)


def balanced_parts(size_K: np.ndarray, ranks: int) -> np.ndarray:
    """Assigns K samples to ranks, int64 [ranks, K / ranks], with equal counts and about equal total sizes.

    In each round every rank gets one of the largest remaining samples: the rank with the smallest sum gets the largest
    (longest processing time first, Graham 1969, with equal counts). Equal sizes keep their order, so all ranks agree.
    """
    row_order = np.argsort(-size_K, kind="stable").reshape(-1, ranks)
    load, parts = np.zeros(ranks), np.empty_like(row_order)
    for row, largest in enumerate(row_order):
        parts[row, np.argsort(load, kind="stable")] = largest
        load += size_K[parts[row]]
    return parts.T


class EpisodeSampler:
    """Iterates over epochs in batches and returns each rank's part.

    `published(epoch)` is called when an epoch begins. It returns the number of frames of each published episode, in
    publication order. It must return the same list on every rank, and continue the list of the epoch before. Episodes
    that are published after an epoch began are used from the next epoch on, also after a resume. `digest(count)`
    identifies the first `count` episodes (`hgn.data.index`). `particles(episodes)` returns their particle counts, by
    which samples are divided evenly among the ranks.
    """

    def __init__(
        self,
        seed: int,
        batch_scenes: int,
        published: Callable[[int], Sequence[int]],
        state: SamplerState | None = None,
        rank: int = 0,
        world_size: int = 1,
        digest: Callable[[int], str | None] = lambda count: "",
        window: int = 0,
        particles: Callable[[Sequence[int]], Sequence[int]] | None = None,
    ) -> None:
        """Raises: ConfigError if the state's epoch cannot be resumed. See `epoch_order` for `window`."""
        assert 0 <= rank < world_size and batch_scenes >= 1
        self.seed, self.batch_scenes, self.rank, self.world_size = seed, batch_scenes, rank, world_size
        self.state = state or SamplerState()
        self._published, self._digest, self._window = published, digest, window
        self._particles = particles if world_size > 1 else None
        if self.state.position > 0 and self.state.window != window:
            raise ConfigError(
                f"training.shuffle_episodes must be {self.state.window} to resume in the middle of epoch "
                f"{self.state.epoch}, got {window}; use that value, or start another run"
            )
        if self.state.position > 0 and self.state.seed != seed:
            raise ConfigError(
                f"training.seed must be {self.state.seed} to resume in the middle of epoch {self.state.epoch}, got "
                f"{seed}: samples would repeat; use that value, or start another run"
            )
        self._order = np.zeros(0, np.int64)
        self._first_sample = np.zeros(1, np.int64)
        self._first_seed = np.uint64(0)  # added to a sample's index, before splitmix64 derives its seed
        self._begin_epoch(self.state.epoch, self.state.position, self.state.episodes, self.state.digest)

    def next_batch(self) -> list[Sample]:
        """Returns this rank's `batch_scenes` samples of the next global batch, and advances the state."""
        total = self.batch_scenes * self.world_size
        parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []  # episodes, frames and seeds by epoch
        taken = 0  # number of samples taken of the global batch, which may span two epochs
        while taken < total:
            if self.state.position == len(self._order):
                self._begin_epoch(self.state.epoch + 1, 0, 0, "")
            rest = self._order[self.state.position :][: total - taken]
            episode_K = self._first_sample.searchsorted(rest, side="right") - 1
            frame_K = rest - self._first_sample[episode_K]
            parts.append((episode_K, frame_K, rest.astype(np.uint64) + self._first_seed))
            self.state = replace(self.state, position=self.state.position + len(rest))
            taken += len(rest)
        episode_K, frame_K, seed_K = (np.concatenate(part) for part in zip(*parts, strict=True))
        mine = self._part(episode_K)
        rows = zip(episode_K[mine].tolist(), frame_K[mine].tolist(), seed_K[mine].tolist(), strict=True)
        return [Sample(episode, frame, splitmix64(seed) >> 1) for episode, frame, seed in rows]

    def upcoming(self, samples: int) -> list[int]:
        """Returns the episodes of this epoch's next samples, of all ranks, in the order of their use."""
        ahead = self._order[self.state.position :][:samples]
        return list(dict.fromkeys((self._first_sample.searchsorted(ahead, side="right") - 1).tolist()))

    @property
    def window_samples(self) -> int:
        """Returns the mean number of samples that are shuffled together, or 0 if these are all samples."""
        blocks = max(1, self._window // BLOCK_EPISODES) * BLOCK_EPISODES
        windowed = 0 < self._window < self.state.episodes
        return -(-len(self._order) * blocks // self.state.episodes) if windowed else 0

    def _part(self, episode_K: np.ndarray) -> np.ndarray:
        """Returns the indices of this rank's samples in a global batch."""
        if self._particles is None:
            return np.arange(self.batch_scenes * self.rank, self.batch_scenes * (self.rank + 1))
        return np.sort(balanced_parts(np.asarray(self._particles(episode_K.tolist())), self.world_size)[self.rank])

    def _begin_epoch(self, epoch: int, position: int, episodes: int, digest: str) -> None:
        frame_counts = list(self._published(epoch))
        if episodes > len(frame_counts):
            raise ConfigError(
                f"data set must still contain the {episodes} training episodes that epoch {epoch} began with, "
                f"got {len(frame_counts)}; restore the missing shards or training.more_data, or start another run"
            )
        frame_counts = frame_counts[: episodes or len(frame_counts)]
        if not frame_counts:
            raise ConfigError("data set must contain at least one training episode, got none; generate some first")
        stored = self._digest(len(frame_counts)) or ""
        if digest not in ("", stored):
            raise ConfigError(
                f"data set must still contain the shards that epoch {epoch} began with, in the order of publication, "
                "got others or another order; restore them or training.more_data, or start another run"
            )
        self._first_sample = np.concatenate([[0], np.cumsum(np.asarray(frame_counts) - 1)])
        self._order = epoch_order(self.seed, epoch, self._first_sample, self._window)
        rule = f"at most the {len(self._order)} samples of epoch {epoch}"
        require(position <= len(self._order), "checkpoint sampler_state.position", rule, position)
        self._first_seed = np.random.SeedSequence([self.seed, epoch]).generate_state(1, np.uint64)[0]
        self.state = SamplerState(epoch, position, len(frame_counts), stored, self._window, self.seed)
