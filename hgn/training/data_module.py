"""Feeds batches to the trainer from a data set that may still grow."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import replace
from typing import Any, TypeVar

import torch
from lightning.pytorch import LightningDataModule, Trainer
from torch.utils.data import DataLoader, IterableDataset

from hgn.config import NetworkConfig, TrainingConfig
from hgn.data.batch import Batch, make_batch
from hgn.data.episode_tensors import EpisodeTensors, UpdateChunk, whole_episode
from hgn.data.importance import FrameImportance
from hgn.data.reader import EpisodeStore
from hgn.data.rest_noise import noise_at_rest
from hgn.data.sampler import EpisodeSampler, Sample, SamplerState
from hgn.data.storage import without_patience
from hgn.scene.episode import Episode
from hgn.schema import ConfigError
from hgn.training import lightning_compat
from hgn.training.pushforward import drawn_starts

T = TypeVar("T")
SHARED_FOLDER_PATIENCE_S = 300.0
BATCHES_AHEAD = 2
READERS = 8  # threads that copy whole episodes
LOOK_S = 1.0  # between looks for a signal while there is no batch
UPDATES_AT_ONCE = 64  # in a chunk, at most


class EpisodeDataModule(LightningDataModule):
    """Endless batches in the deterministic order; each epoch sees what was published when it began."""

    def __init__(
        self,
        store: EpisodeStore,
        network: NetworkConfig,
        training: TrainingConfig,
        batches_ahead: int = BATCHES_AHEAD,
        chunks: bool = False,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> None:
        """With `chunks` it gives an UpdateChunk instead of a Batch. Once `interrupted`, it ends instead of waiting."""
        super().__init__()
        assert batches_ahead >= 0
        self.store = store
        self.network = network
        self.training = training
        self.batches_ahead = batches_ahead  # read while another is trained on; 0: read when asked for
        self.hands_out_chunks = chunks
        self.interrupted = interrupted
        self.cursor = SamplerState()  # where to begin; set from the checkpoint on a resume
        self._importance: dict[int, FrameImportance] = {}
        self.waited_s = 0.0  # time that the training has waited for a batch

    def train_dataloader(self) -> DataLoader[Batch | UpdateChunk]:
        # The windows are memory-mapped and small: a worker process would cost more than it saves.
        return DataLoader(_Stream(self), batch_size=None, num_workers=0)

    def transfer_batch_to_device(
        self, batch: Batch | UpdateChunk, device: torch.device, dataloader_idx: int
    ) -> Batch | UpdateChunk:
        return batch.to(device, non_blocking=True) if isinstance(batch, Batch) else batch

    def batches(self) -> Iterator[Batch]:
        """This rank's batches, without end."""
        order = self._order()
        begun = update = self._update()

        def draw() -> tuple[tuple[list[Sample], tuple[tuple[int, int], ...]], SamplerState]:
            nonlocal update
            starts = self._starts(order, begun, update)
            update += 1
            return (order.next_batch(), starts), order.cursor

        def read(drawn: tuple[Sequence[Sample], tuple[tuple[int, int], ...]], cursor: SamplerState) -> Batch:
            samples, starts = self._by_importance(drawn[0]), drawn[1]
            pairs = [(self.store.episodes[sample.episode], sample.frame) for sample in samples]
            seeds, weights = [sample.seed for sample in samples], [sample.weight for sample in samples]
            noise = [sample.noise for sample in samples]
            batch = make_batch(pairs, self.network, seeds, cursor, weights, noise=noise)
            return replace(batch, starts=tuple((self.store.episodes[index], frame) for index, frame in starts))

        yield from self._ahead(draw, read)

    def chunks(self) -> Iterator[UpdateChunk]:
        """The same samples, those of many updates at once. A chunk ends wherever something is due between updates."""
        order = self._order()
        begun = update = self._update()
        known: set[int] = set()

        def draw() -> tuple[tuple[list[tuple[Sample, ...]], tuple[tuple[int, int], ...]], SamplerState]:
            nonlocal update
            starts = self._starts(order, begun, update)
            count = chunk_length(self.training, begun, update)
            update += count
            return ([tuple(order.next_batch()) for _ in range(count)], starts), order.cursor

        def read(
            drawn: tuple[list[tuple[Sample, ...]], tuple[tuple[int, int], ...]], cursor: SamplerState
        ) -> UpdateChunk:
            samples, starts = drawn
            asked = {sample.episode for batch in samples for sample in batch} | {index for index, _ in starts}
            new = sorted(asked - known)
            known.update(new)
            episodes = self._whole(new)
            return UpdateChunk(tuple(self._by_importance(update) for update in samples), episodes, cursor, starts)

        yield from self._ahead(draw, read)

    def _update(self) -> int:
        """The number of the next update."""
        return self.trainer.global_step if self.trainer is not None else 0

    def _starts(self, order: EpisodeSampler, begun: int, update: int) -> tuple[tuple[int, int], ...]:
        """Episodes and frames that the network is to simulate from before this update; none where that is not due."""
        due = update == begun or update % self.training.rollout_every == 0
        if self.training.rollout_share == 0 or not due:
            return ()
        frames = [entry.frames for entry in self.store.entries[: order.cursor.episodes]]
        return drawn_starts(self.training, update, order.rank, frames)

    def _whole(self, indices: Sequence[int]) -> dict[int, EpisodeTensors]:
        """Reads episodes, several at once: a data set's first pass is gigabytes, and copies release Python's lock."""
        share, wanted = self.training.frame_importance, self._asks_what_happens

        def read(episode: Episode) -> tuple[EpisodeTensors, FrameImportance | None]:
            return whole_episode(episode, self.network), FrameImportance.of(episode, share) if wanted else None

        opened = [self.store.episodes[index] for index in indices]
        with ThreadPoolExecutor(READERS) as readers:
            found = dict(zip(indices, readers.map(read, opened), strict=True))
        self._importance.update({index: importance for index, (_, importance) in found.items() if importance})
        return {index: whole for index, (whole, _) in found.items()}

    @property
    def _asks_what_happens(self) -> bool:
        return self.training.frame_importance > 0 or self.training.noise_at_rest < 1

    def _by_importance(self, samples: Sequence[Sample]) -> tuple[Sample, ...]:
        """The same samples with frames drawn as `training.frame_importance` says and noise as `noise_at_rest` does, and
        their weights."""
        share = self.training.frame_importance
        if not self._asks_what_happens:
            return tuple(samples)
        drawn = []
        for sample in samples:
            if sample.episode not in self._importance:
                episode = self.store.episodes[sample.episode]
                self._importance[sample.episode] = FrameImportance.of(episode, share)
            importance = self._importance[sample.episode]
            frame, weight = importance.draw(sample.frame, sample.seed) if share > 0 else (sample.frame, 1.0)
            noise, factor = noise_at_rest(self.training, importance.accelerations[frame], sample.seed)
            drawn.append(Sample(sample.episode, frame, sample.seed, weight * factor, noise))
        return tuple(drawn)

    def _order(self) -> EpisodeSampler:
        rank, world_size = (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
        return EpisodeSampler(
            self.training.seed, self.training.batch_scenes, self._published, self.cursor, rank, world_size
        )

    def _ahead(
        self, draw: Callable[[], tuple[Any, SamplerState]], read: Callable[[Any, SamplerState], T]
    ) -> Iterator[T]:
        # The order may have to ask other ranks, so it stays in this thread; reading runs ahead in another.
        executor = ThreadPoolExecutor(1)
        try:
            waiting: deque[Future[T]] = deque()
            while True:
                started = time.monotonic()
                while len(waiting) <= self.batches_ahead:
                    waiting.append(executor.submit(read, *draw()))
                item = waiting.popleft()
                while not wait([item], timeout=LOOK_S).done:
                    if self._ends():
                        return
                self.waited_s += time.monotonic() - started
                yield item.result()
        finally:
            with without_patience():
                executor.shutdown(cancel_futures=True)

    def _ends(self) -> bool:
        """Whether the training ends here for want of data. Alone: other ranks would wait for this one's gradients."""
        trainer = self.trainer
        if trainer is None:
            return self.interrupted()
        if trainer.world_size > 1 or not (self.interrupted() or lightning_compat.received_sigterm(trainer)):
            return False
        trainer.should_stop = True
        return True

    def _published(self, epoch: int) -> list[int]:
        """Frames of each published episode, the same on all ranks: rank 0 looks, the others follow."""
        self.store.refresh()
        self.store.fetch_ahead()
        count = agreed_count(self.store, self.trainer) if self.trainer is not None else len(self.store)
        return [entry.frames for entry in self.store.entries[:count]]


def chunk_length(training: TrainingConfig, begun: int, update: int) -> int:
    """Updates of the chunk that begins at `update`, in a training that began at `begun`; the same on all ranks.

    The first chunks are short: they bring the most episodes that are not in memory yet.
    """
    due = [training.log_every, training.checkpoint_every, training.monitor_every]
    if training.rollout_share > 0:
        due.append(training.rollout_every)
    until_due = min([every - update % every for every in due])
    until_end = max(training.maximum_updates - update, 1)
    return min(until_due, until_end, UPDATES_AT_ONCE, max(1, update - begun))


def agreed_count(store: EpisodeStore, trainer: Trainer) -> int:
    """How many episodes rank 0 knows; the other ranks wait until they see as many. All ranks call this.

    Episodes come in publication order, so that the first `count` are then the same everywhere.
    Raises: ConfigError when a node does not see them for SHARED_FOLDER_PATIENCE_S.
    """
    if trainer.world_size == 1:
        return len(store)
    count = int(trainer.strategy.broadcast(len(store)))
    deadline = time.monotonic() + SHARED_FOLDER_PATIENCE_S
    while len(store) < count:
        if time.monotonic() > deadline:
            raise ConfigError(
                f"{store.folder} must show the same {count} episodes on every node, got {len(store)} for "
                f"{SHARED_FOLDER_PATIENCE_S:.0f} s; is it a shared folder?"
            )
        time.sleep(1)
        store.refresh()
    return count


class _Stream(IterableDataset[Batch | UpdateChunk]):
    def __init__(self, feed: EpisodeDataModule) -> None:
        self.feed = feed

    def __iter__(self) -> Iterator[Batch | UpdateChunk]:
        return self.feed.chunks() if self.feed.hands_out_chunks else self.feed.batches()
