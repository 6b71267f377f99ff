"""Reads the samples of a chunk from the data set: windows for backend torch, whole episodes for triton."""

import sys
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import islice
from typing import NamedTuple, Protocol

from hgn.config import NetworkConfig, TrainingConfig
from hgn.data.batch import BatchSample, WindowChunk, join
from hgn.data.episode_tensors import EpisodeChunk, EpisodeTensors, whole_episode
from hgn.data.importance import FrameImportance
from hgn.data.pooled import AnyStore
from hgn.data.sampler import BLOCK_EPISODES, Sample, SamplerState
from hgn.scene.episode import Episode
from hgn.scene.history import window
from hgn.step_config import UNCONSTRAINED, StepConfig
from hgn.training.noise import quiet_weight
from hgn.training.pushforward import Starts, simulated_barrier

REMEMBERED_SCENES = 1024  # number of episodes whose rest shapes stay in memory
READERS = 8  # number of threads that copy whole episodes


class DrawnChunk(NamedTuple):
    """A chunk in the deterministic order, before its data are read."""

    samples: list[list[Sample]]  # samples of each update
    sampler_state: SamplerState  # state of the order after these samples
    starts: Starts


class ChunkReader(Protocol):
    updates_at_once: int  # largest number of updates in a chunk

    def read(self, drawn: DrawnChunk) -> WindowChunk | EpisodeChunk:
        """Reads a chunk. It is called for the chunks in their order."""


class FrameDraws:
    """Draws a sample's frame by importance, and its loss weight by the frame's acceleration."""

    def __init__(self, store: AnyStore, training: TrainingConfig) -> None:
        self._store, self._training = store, training
        self._importance: dict[int, FrameImportance] = {}
        self.measures_frames = training.frame_importance > 0 or training.quiet_acceleration > 0

    def measured(self, episode: Episode) -> FrameImportance | None:
        """Returns an episode's accelerations; None if no setting depends on them."""
        return FrameImportance.of(episode, self._training.frame_importance) if self.measures_frames else None

    def add(self, index: int, importance: FrameImportance | None) -> None:
        """Stores the result of `measured` for the episode with this index."""
        if importance is not None:
            self._importance[index] = importance

    def drawn(self, samples: Sequence[Sample]) -> tuple[Sample, ...]:
        """Returns the samples with the drawn frames and loss weights."""
        fraction = self._training.frame_importance
        if not self.measures_frames:
            return tuple(samples)
        drawn = []
        for sample in samples:
            if sample.episode not in self._importance:
                self.add(sample.episode, self.measured(self._store.read(sample.episode)))
            importance = self._importance[sample.episode]
            frame, weight = importance.draw(sample.frame, sample.seed) if fraction > 0 else (sample.frame, 1.0)
            weight *= quiet_weight(self._training, importance.accelerations[frame])
            drawn.append(sample._replace(frame=frame, weight=weight))
        return tuple(drawn)


class WindowReader:
    """Reads the position windows of one update's samples."""

    updates_at_once = 1

    def __init__(self, store: AnyStore, network: NetworkConfig, training: TrainingConfig) -> None:
        self._store, self._network = store, network
        self._simulates = training.pushforward_fraction > 0
        self._draws = FrameDraws(store, training)
        # episodes with frame 0 only, oldest first: they keep rest shapes and the fields of their obstacles
        self._scenes: OrderedDict[int, Episode] = OrderedDict()

    def read(self, drawn: DrawnChunk) -> WindowChunk:
        (update,) = drawn.samples
        samples = tuple(self._sample(sample) for sample in self._draws.drawn(update))
        starts = tuple((self._store[index], frame) for index, frame in drawn.starts)
        batch = None if self._simulates else join(samples, self._network)
        return WindowChunk((samples,), drawn.sampler_state, starts, batch)

    def _sample(self, sample: Sample) -> BatchSample:
        episode = self._store.read(sample.episode)
        window_WN3 = window(episode, sample.frame, self._network.velocity_history)
        if sample.episode not in self._scenes:
            self._scenes[sample.episode] = replace(episode, position_TN3=episode.position_TN3[:1].copy())
            if len(self._scenes) > REMEMBERED_SCENES:
                self._scenes.popitem(last=False)
        scene = self._scenes[sample.episode]
        return BatchSample(scene, sample.frame, window_WN3, seed=sample.seed, weight=sample.weight)


class EpisodeReader:
    """Reads the episodes that are not yet on the device, and names the episodes that it may free."""

    updates_at_once = 64

    def __init__(
        self, store: AnyStore, network: NetworkConfig, training: TrainingConfig, step: StepConfig = UNCONSTRAINED
    ) -> None:
        self._store, self._network = store, network
        self._draws = FrameDraws(store, training)
        self._clearance = step.obstacle_clearance if training.pushforward_fraction > 0 else None
        shuffled = training.shuffle_episodes
        # episodes on the device: two windows of the order, if the order has windows
        self.capacity = 2 * max(shuffled, BLOCK_EPISODES) if shuffled else sys.maxsize
        self._on_device: OrderedDict[int, None] = OrderedDict()  # least recently used first

    def read(self, drawn: DrawnChunk) -> EpisodeChunk:
        needed = {sample.episode for update in drawn.samples for sample in update}
        needed |= {index for index, _ in drawn.starts}
        new = sorted(needed - self._on_device.keys())
        for episode in sorted(needed):
            self._on_device[episode] = None
            self._on_device.move_to_end(episode)
        excess = max(0, len(self._on_device) - max(self.capacity, len(needed)))
        dropped = tuple(islice(self._on_device, excess))
        for episode in dropped:
            del self._on_device[episode]
        episodes = self._whole(new)
        samples = tuple(self._draws.drawn(update) for update in drawn.samples)
        return EpisodeChunk(samples, episodes, drawn.sampler_state, dropped=dropped, starts=drawn.starts)

    def _whole(self, indices: Sequence[int]) -> dict[int, EpisodeTensors]:
        """Reads several episodes together. The first pass over a data set copies gigabytes without Python's lock."""

        def read(index: int) -> tuple[EpisodeTensors, FrameImportance | None]:
            episode = self._store.read(index)
            barrier = None if self._clearance is None else simulated_barrier(episode, self._clearance)
            return whole_episode(episode, self._network, barrier), self._draws.measured(episode)

        with ThreadPoolExecutor(READERS) as readers:
            results = dict(zip(indices, readers.map(read, indices), strict=True))
        for index, (_, importance) in results.items():
            self._draws.add(index, importance)
        return {index: whole for index, (whole, _) in results.items()}
