"""Feeds chunks of updates to the trainer from a data set that may still grow."""

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import Any

import torch

from hgn.config import TrainingConfig
from hgn.data.batch import WindowChunk
from hgn.data.episode_tensors import EpisodeChunk
from hgn.data.pooled import AnyStore
from hgn.data.sampler import EpisodeSampler, SamplerState
from hgn.schema import ConfigError
from hgn.system.patience import standard_patience_s, without_patience
from hgn.training.lightning_compat import LightningDataModule, Trainer
from hgn.training.pushforward import Starts, drawn_starts
from hgn.training.readers import ChunkReader, DrawnChunk
from hgn.training.schedule import next_measurement

CHUNKS_AHEAD = 2  # number of chunks that are read while another one is trained on
LOOK_S = 1.0  # interval of checks for a stop request while no chunk is ready


class EpisodeDataModule(LightningDataModule):
    """Yields chunks of updates in a deterministic order, until the last update.

    An epoch contains the episodes that were published when it began.
    """

    def __init__(
        self,
        store: AnyStore,
        training: TrainingConfig,
        reader: ChunkReader,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> None:
        """If `interrupted` returns True, a training on one rank ends instead of waiting for data."""
        super().__init__()
        self.store, self.training, self.reader = store, training, reader
        self.interrupted = interrupted
        # where to begin; a resumed run takes both from its checkpoint
        self.sampler_state, self.first_update = SamplerState(), 0
        self._fetched_from = (-1, -1)  # epoch and quarter of a window at the last request for shards
        self.waited_s = 0.0  # time that the training has waited for a chunk

    def train_dataloader(self) -> "EpisodeDataModule":
        return self

    def __iter__(self) -> Iterator[WindowChunk | EpisodeChunk]:
        return self.chunks()

    def transfer_batch_to_device(self, batch: Any, device: torch.device, dataloader_idx: int) -> Any:
        return batch  # the updates copy it themselves

    def chunks(self) -> Iterator[WindowChunk | EpisodeChunk]:
        """Yields this rank's chunks. See `chunk_length` for their lengths."""
        drawn = self._drawn()
        # Drawing samples may communicate with other ranks, so this thread draws. Another thread reads chunks ahead.
        executor = ThreadPoolExecutor(1)
        try:
            waiting: deque[Future[WindowChunk | EpisodeChunk]] = deque()
            while True:
                started = time.monotonic()
                self.store.ask_again()
                for chunk in islice(drawn, CHUNKS_AHEAD + 1 - len(waiting)):
                    waiting.append(executor.submit(self.reader.read, chunk))
                if not waiting:
                    break
                item = waiting.popleft()
                while not wait([item], LOOK_S).done:
                    if self._ends():
                        return
                self.waited_s += time.monotonic() - started
                yield item.result()
        finally:
            with without_patience():
                executor.shutdown(cancel_futures=True)

    def _drawn(self) -> Iterator[DrawnChunk]:
        order, update = self._order(), self.first_update
        while update < self.training.maximum_updates:
            starts = self._starts(order, update)
            count = chunk_length(self.training, self.first_update, update, self.reader.updates_at_once)
            update += count
            self._fetch_window(order)
            samples = [order.next_batch() for _ in range(count)]
            yield DrawnChunk(samples, order.state, starts)

    def _fetch_window(self, order: EpisodeSampler) -> None:
        """Requests the shards of a window of samples before they are needed, once for each quarter of the window."""
        quarter = order.window_samples // 4
        if quarter and (place := (order.state.epoch, order.state.position // quarter)) != self._fetched_from:
            self._fetched_from = place
            self.store.fetch_ahead(order.upcoming(order.window_samples + quarter))

    def _starts(self, order: EpisodeSampler, update: int) -> Starts:
        """Returns the episodes and frames from which the network simulates before this update; none if not due."""
        due = update == self.first_update or update % self.training.pushforward_every == 0
        if self.training.pushforward_fraction == 0 or not due:
            return ()
        frames = self.store.frames(order.state.episodes)
        return drawn_starts(self.training, update, order.rank, frames)

    def _order(self) -> EpisodeSampler:
        rank, world_size = (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
        return EpisodeSampler(
            self.training.seed,
            self.training.batch_scenes,
            self._published,
            self.sampler_state,
            rank=rank,
            world_size=world_size,
            digest=self.store.digest,
            window=self.training.shuffle_episodes,
            particles=self.store.particles,
        )

    def _ends(self) -> bool:
        """Returns whether to end instead of waiting for data. False with several ranks, which share gradients."""
        trainer = self.trainer
        if trainer is None:
            return self.interrupted()
        if trainer.world_size > 1 or not self.interrupted():
            return False
        trainer.should_stop = True
        return True

    def _published(self, epoch: int) -> list[int]:
        """Returns the number of frames of each published episode, as rank 0 sees them."""
        self.store.refresh()
        if not 0 < self.training.shuffle_episodes < len(self.store):
            self.store.fetch_ahead()
        count = len(self.store)
        if self.trainer is not None:
            names = ("seed", "batch_scenes", "shuffle_episodes")
            count = agreed_count(self.store, self.trainer, {name: getattr(self.training, name) for name in names})
        return self.store.frames(count)


def chunk_length(training: TrainingConfig, first_update: int, update: int, most: int) -> int:
    """Returns the number of updates in the chunk that begins at `update`, at most `most`. It is equal on all ranks.

    A chunk ends where a log line, checkpoint, measurement or simulation is due. The first chunks after `first_update`,
    the start of the training, are short: most of their episodes must be loaded.
    """
    due = [training.log_every, training.checkpoint_every]
    if training.pushforward_fraction > 0:
        due.append(training.pushforward_every)
    until_due = min(every - update % every for every in due)
    until_due = min(until_due, next_measurement(training, update) - update)
    return min(until_due, training.maximum_updates - update, most, max(1, update - first_update))


def agreed_count(store: AnyStore, trainer: Trainer, order: Mapping[str, int] | None = None) -> int:
    """Returns the number of episodes that rank 0 sees. The other ranks wait for them. All ranks call this.

    Episodes are in the order of their publication, so the first ones are the same on all ranks. `order` contains the
    settings of `training` that determine the order of samples.
    Raises: ConfigError if a node does not see them within the standard patience, and on every rank if any rank sees
    other episodes or has other settings.
    """
    if trainer.world_size == 1:
        return len(store)
    count, digest, others = trainer.strategy.broadcast((len(store), store.digest(len(store)), order))
    if order is not None and not trainer.strategy.reduce_boolean_decision(order == others, all=True):
        raise ConfigError(
            f"training.{', '.join(order or {})} must be the same on all ranks, got {order} on rank "
            f"{trainer.global_rank} and {others} on rank 0: samples would repeat; start all with the same command"
        )
    patience_s = standard_patience_s()
    deadline = time.monotonic() + patience_s
    while len(store) < count:
        if time.monotonic() > deadline:
            raise ConfigError(
                f"{store.folder} must show the same {count} episodes on every node, got {len(store)} for "
                f"{patience_s:.0f} s; is it a shared folder?"
            )
        time.sleep(1)
        store.refresh()
    same = store.digest(count) == digest
    if not trainer.strategy.reduce_boolean_decision(same, all=True):
        raise ConfigError(
            f"{store.folder} must show the same {count} episodes on every node, got others, or another order, on "
            + ("another rank" if same else f"rank {trainer.global_rank}")
            + "; is it a shared folder?"
        )
    return count
