"""Feeds batches to the trainer from a data set that may still grow."""

from __future__ import annotations

import sys
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import Any, TypeVar

import torch
from lightning.pytorch import LightningDataModule, Trainer
from torch.utils.data import DataLoader, IterableDataset

from hgn.config import NetworkConfig, TrainingConfig
from hgn.data.batch import Batch, BatchSample, UpdateSamples
from hgn.data.episode_tensors import EpisodeTensors, UpdateChunk, whole_episode
from hgn.data.importance import FrameImportance
from hgn.data.pooled import AnyStore
from hgn.data.sampler import BLOCK_EPISODES, EpisodeSampler, Sample, SamplerState
from hgn.scene.episode import Episode
from hgn.scene.history import window
from hgn.schema import ConfigError
from hgn.system.patience import without_patience
from hgn.training.noise import noise_scale
from hgn.training.pushforward import Starts, drawn_starts, simulated_barrier

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
        store: AnyStore,
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
        self.sampler_state = SamplerState()  # where to begin; set from the checkpoint on a resume
        self._importance: dict[int, FrameImportance] = {}
        self._fetched_from = (-1, -1)  # epoch and quarter of a window that shards were last asked for at
        self.waited_s = 0.0  # time that the training has waited for a batch

    def train_dataloader(self) -> DataLoader[Batch | UpdateSamples | UpdateChunk]:
        # The windows are memory-mapped and small: a worker process would cost more than it saves.
        return DataLoader(_Stream(self), batch_size=None, num_workers=0)

    def transfer_batch_to_device(
        self, batch: Batch | UpdateSamples | UpdateChunk, device: torch.device, dataloader_idx: int
    ) -> Batch | UpdateSamples | UpdateChunk:
        return batch.to(device, non_blocking=True) if isinstance(batch, Batch) else batch

    def batches(self) -> Iterator[Batch | UpdateSamples]:
        """This rank's batches, without end; samples instead where the pushforward pool may replace some of them."""
        order = self._order()
        begun = update = self._update()

        def draw() -> tuple[tuple[list[Sample], Starts], SamplerState]:
            nonlocal update
            starts = self._starts(order, begun, update)
            update += 1
            self._fetch_window(order)
            return (order.next_batch(), starts), order.state

        def read(drawn: tuple[list[Sample], Starts], state: SamplerState) -> Batch | UpdateSamples:
            samples = tuple(
                BatchSample(
                    self.store[sample.episode],
                    sample.frame,
                    window(self.store[sample.episode], sample.frame, self.network.velocity_history),
                    sample.seed,
                    sample.weight,
                    sample.noise_scale,
                )
                for sample in self._weighted(drawn[0])
            )
            update_samples = UpdateSamples(samples, state, tuple((self.store[i], frame) for i, frame in drawn[1]))
            return update_samples if self.training.pushforward_fraction else update_samples.batch(self.network)

        yield from self._prefetched(draw, read)

    def chunks(self) -> Iterator[UpdateChunk]:
        """The same samples, those of many updates at once. A chunk ends wherever something is due between updates."""
        order = self._order()
        begun = update = self._update()
        held: OrderedDict[int, None] = OrderedDict()  # episodes that the trainer has, the longest unused first
        most = self._most_held()

        def draw() -> tuple[tuple[list[tuple[Sample, ...]], Starts], SamplerState]:
            nonlocal update
            starts = self._starts(order, begun, update)
            count = chunk_length(self.training, begun, update)
            update += count
            self._fetch_window(order)
            return ([tuple(order.next_batch()) for _ in range(count)], starts), order.state

        def read(drawn: tuple[list[tuple[Sample, ...]], Starts], state: SamplerState) -> UpdateChunk:
            samples, starts = drawn
            needed = {sample.episode for batch in samples for sample in batch} | {index for index, _ in starts}
            new = sorted(needed - held.keys())
            for episode in sorted(needed):
                held[episode] = None
                held.move_to_end(episode)
            dropped = list(islice(held, max(0, len(held) - max(most, len(needed)))))
            for episode in dropped:
                del held[episode]
            episodes = self._whole(new)
            drawn_frames = tuple(self._weighted(update) for update in samples)
            return UpdateChunk(drawn_frames, episodes, state, tuple(dropped), starts)

        yield from self._prefetched(draw, read)

    def _fetch_window(self, order: EpisodeSampler) -> None:
        """Has the shards of as many samples as a window has brought here before they are needed; each quarter of it."""
        quarter = order.window_samples // 4
        if quarter and (place := (order.state.epoch, order.state.position // quarter)) != self._fetched_from:
            self._fetched_from = place
            self.store.fetch_ahead(order.upcoming(order.window_samples + quarter))

    def _most_held(self) -> int:
        """How many episodes stay on the device: two windows of the order, where it has windows."""
        window = self.training.shuffle_episodes
        return 2 * max(window, BLOCK_EPISODES) if window else sys.maxsize

    def _update(self) -> int:
        """The number of the next update."""
        return self.trainer.global_step if self.trainer is not None else 0

    def _starts(self, order: EpisodeSampler, begun: int, update: int) -> Starts:
        """Episodes and frames that the network is to simulate from before this update; none where that is not due."""
        due = update == begun or update % self.training.pushforward_every == 0
        if self.training.pushforward_fraction == 0 or not due:
            return ()
        frames = self.store.frames(order.state.episodes)
        return drawn_starts(self.training, update, order.rank, frames)

    def _whole(self, indices: Sequence[int]) -> dict[int, EpisodeTensors]:
        """Reads episodes, several at once: a data set's first pass is gigabytes, and copies release Python's lock."""
        fraction, measured = self.training.frame_importance, self._measures_frames
        clearance = self.network.obstacle_clearance if self.training.pushforward_fraction > 0 else None

        def read(episode: Episode) -> tuple[EpisodeTensors, FrameImportance | None]:
            barrier = None if clearance is None else simulated_barrier(episode, clearance)
            whole = whole_episode(episode, self.network, barrier)
            return whole, FrameImportance.of(episode, fraction) if measured else None

        opened = [self.store[index] for index in indices]
        with ThreadPoolExecutor(READERS) as readers:
            results = dict(zip(indices, readers.map(read, opened), strict=True))
        self._importance.update({index: importance for index, (_, importance) in results.items() if importance})
        return {index: whole for index, (whole, _) in results.items()}

    @property
    def _measures_frames(self) -> bool:
        """Whether it matters how much happens in a frame."""
        training = self.training
        return training.frame_importance > 0 or training.noise_min_scale < 1 or training.quiet_acceleration > 0

    def _weighted(self, samples: Sequence[Sample]) -> tuple[Sample, ...]:
        """The same samples with frames drawn as `training.frame_importance` says, the scale of their noise as
        `noise_min_scale` says, and their weights. For both backends, before windows are read."""
        fraction = self.training.frame_importance
        if not self._measures_frames:
            return tuple(samples)
        drawn = []
        for sample in samples:
            if sample.episode not in self._importance:
                episode = self.store[sample.episode]
                self._importance[sample.episode] = FrameImportance.of(episode, fraction)
            importance = self._importance[sample.episode]
            frame, weight = importance.draw(sample.frame, sample.seed) if fraction > 0 else (sample.frame, 1.0)
            scale, scale_weight = noise_scale(self.training, importance.accelerations[frame], sample.seed)
            drawn.append(Sample(sample.episode, frame, sample.seed, weight * scale_weight, scale))
        return tuple(drawn)

    def _order(self) -> EpisodeSampler:
        rank, world_size = (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
        return EpisodeSampler(
            self.training.seed,
            self.training.batch_scenes,
            self._published,
            self.sampler_state,
            rank,
            world_size,
            self.store.digest,
            self.training.shuffle_episodes,
            self.store.particles,
        )

    def _prefetched(
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
        if trainer.world_size > 1 or not self.interrupted():
            return False
        trainer.should_stop = True
        return True

    def _published(self, epoch: int) -> list[int]:
        """Frames of each published episode, the same on all ranks: rank 0 looks, the others follow."""
        self.store.refresh()
        if not 0 < self.training.shuffle_episodes < len(self.store):
            self.store.fetch_ahead()
        count = len(self.store)
        if self.trainer is not None:
            names = ("seed", "batch_scenes", "shuffle_episodes")
            count = agreed_count(self.store, self.trainer, {name: getattr(self.training, name) for name in names})
        return self.store.frames(count)


def chunk_length(training: TrainingConfig, begun: int, update: int) -> int:
    """Updates of the chunk that begins at `update`, in a training that began at `begun`; the same on all ranks.

    The first chunks are short: they bring the most episodes that are not in memory yet.
    """
    due = [training.log_every, training.checkpoint_every, training.monitor_every]
    if training.pushforward_fraction > 0:
        due.append(training.pushforward_every)
    until_due = min([every - update % every for every in due])
    until_end = max(training.maximum_updates - update, 1)
    return min(until_due, until_end, UPDATES_AT_ONCE, max(1, update - begun))


def agreed_count(store: AnyStore, trainer: Trainer, order: Mapping[str, int] | None = None) -> int:
    """How many episodes rank 0 knows; the other ranks wait until they see as many. All ranks call this.

    `order` is what the order of samples stands on beside the data: settings of `training`.

    Episodes come in publication order, so that the first `count` are then the same everywhere.
    Raises: ConfigError when a node does not see them for SHARED_FOLDER_PATIENCE_S; on every rank when one sees others,
    or was given another order.
    """
    if trainer.world_size == 1:
        return len(store)
    count, digest, others = trainer.strategy.broadcast((len(store), store.digest(len(store)), order))
    if order is not None and not trainer.strategy.reduce_boolean_decision(order == others, all=True):
        raise ConfigError(
            f"training.{', '.join(order or {})} must be the same on all ranks, got {order} on rank "
            f"{trainer.global_rank} and {others} on rank 0: samples would come twice; start all with the same command"
        )
    deadline = time.monotonic() + SHARED_FOLDER_PATIENCE_S
    while len(store) < count:
        if time.monotonic() > deadline:
            raise ConfigError(
                f"{store.folder} must show the same {count} episodes on every node, got {len(store)} for "
                f"{SHARED_FOLDER_PATIENCE_S:.0f} s; is it a shared folder?"
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


class _Stream(IterableDataset[Batch | UpdateSamples | UpdateChunk]):
    def __init__(self, feed: EpisodeDataModule) -> None:
        self.feed = feed

    def __iter__(self) -> Iterator[Batch | UpdateSamples | UpdateChunk]:
        return self.feed.chunks() if self.feed.hands_out_chunks else self.feed.batches()
