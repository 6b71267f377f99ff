"""Feeds batches to the trainer from a data set that may still grow."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import torch
from lightning.pytorch import LightningDataModule, Trainer
from torch.utils.data import DataLoader, IterableDataset

from hgn.config import NetworkConfig, TrainingConfig
from hgn.data.batch import Batch, make_batch
from hgn.data.order import Cursor, Sample, SampleOrder
from hgn.data.reader import EpisodeStore
from hgn.schema import ConfigError

SHARED_FOLDER_PATIENCE_S = 300.0
BATCHES_AHEAD = 2


class Feed(LightningDataModule):
    """Endless batches in the deterministic order; each epoch sees what was published when it began."""

    def __init__(
        self,
        store: EpisodeStore,
        network: NetworkConfig,
        training: TrainingConfig,
        batches_ahead: int = BATCHES_AHEAD,
    ) -> None:
        super().__init__()
        assert batches_ahead >= 0
        self.store = store
        self.network = network
        self.training = training
        self.batches_ahead = batches_ahead  # read while another is trained on; 0: read when asked for
        self.cursor = Cursor()  # where to begin; set from the checkpoint on a resume
        self.waited_s = 0.0  # time that the training has waited for a batch

    def train_dataloader(self) -> DataLoader[Batch]:
        # The windows are memory-mapped and small: a worker process would cost more than it saves.
        return DataLoader(_Stream(self), batch_size=None, num_workers=0)

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, dataloader_idx: int) -> Batch:
        return batch.to(device, non_blocking=True)

    def batches(self) -> Iterator[Batch]:
        """This rank's batches, without end."""
        rank, world_size = (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
        order = SampleOrder(
            self.training.seed, self.training.batch_scenes, self._published, self.cursor, rank, world_size
        )

        def read(samples: Sequence[Sample], cursor: Cursor) -> Batch:
            pairs = [(self.store.episodes[sample.episode], sample.frame) for sample in samples]
            return make_batch(pairs, self.network, [sample.seed for sample in samples], cursor)

        # The order may have to ask other ranks, so it stays in this thread; reading runs ahead in another.
        with ThreadPoolExecutor(1) as executor:
            waiting: deque[Future[Batch]] = deque()
            while True:
                started = time.monotonic()
                while len(waiting) <= self.batches_ahead:
                    waiting.append(executor.submit(read, order.next_batch(), order.cursor))
                batch = waiting.popleft().result()
                self.waited_s += time.monotonic() - started
                yield batch

    def _published(self, epoch: int) -> list[int]:
        """Frames of each published episode, the same on all ranks: rank 0 looks, the others follow."""
        self.store.refresh()
        self.store.fetch_ahead()
        count = agreed_count(self.store, self.trainer) if self.trainer is not None else len(self.store)
        return [entry.frames for entry in self.store.entries[:count]]


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


class _Stream(IterableDataset[Batch]):
    def __init__(self, feed: Feed) -> None:
        self.feed = feed

    def __iter__(self) -> Iterator[Batch]:
        return self.feed.batches()
