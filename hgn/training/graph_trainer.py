"""Training by captured updates: what Lightning sees stays true, what runs is hgn.kernels.update.

Parameters and Adam's moments live in the kernels' layout while a chunk of updates runs, and are copied back after it,
so that checkpoints, monitoring and backend torch find them where they belong.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

from hgn.config import TrainingConfig
from hgn.data.episode_tensors import EpisodeTensors, UpdateChunk
from hgn.kernels.barrier_table import BarrierHash
from hgn.kernels.grid.op import ObstacleHash
from hgn.kernels.triton_compat import JitMisses
from hgn.kernels.update.op import DeviceEpisode, DeviceSample, Updates, UpdateSettings
from hgn.network.base import ParticleNetwork
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.triton_host import kernel_precision
from hgn.scene.symmetry import drawn_symmetry
from hgn.training.graph_pushforward import GraphPushforwardPool
from hgn.training.parity import require_parity

REPORTED_UPDATES = 256  # the first ones, which take longest
DATA_FRACTION = 0.6  # of a GPU's memory at most, for episodes; the others stay in the host's


class GraphTrainer:
    """Makes the updates of chunks on a network and its optimiser, a torch.optim.Adam."""

    def __init__(
        self,
        network: ParticleNetwork,
        optimizer: torch.optim.Optimizer,
        training: TrainingConfig,
        obstacle_cell_size: float,
        loss_sum: torch.Tensor,
        counters: torch.Tensor,
        reduce: Callable[[torch.Tensor], None] | None = None,
        ranks: int = 1,
        averaged: ParticleNetwork | None = None,
        rank: int = 0,
    ) -> None:
        """`averaged` holds the moving average of the weights.

        loss_sum [2] and counters [5] are added to, as hgn.kernels.update.kernel.finish_update says."""
        assert isinstance(network, HierarchicalGraphNetwork)
        self._begun, self._made, self._jit_misses = time.monotonic(), 0, JitMisses()
        self._seconds: dict[str, float] = defaultdict(float)
        self.network, self.optimizer = network, optimizer
        self.device = next(network.parameters()).device
        self.symmetric = training.symmetry != "none"
        settings = UpdateSettings.of(training, obstacle_cell_size)
        precision = kernel_precision(training.precision, self.device)
        self._take_over()
        self.updates = Updates(network, settings, precision, loss_sum, counters, reduce, ranks)
        self._read_moments()
        self._averaged = None
        if averaged is not None:
            self._averaged = _flattened(averaged)
            self.updates.average = self._packed(self._averaged)
        self._episodes: dict[int, DeviceEpisode] = {}
        self.pool: GraphPushforwardPool | None = None
        if training.pushforward_fraction > 0:
            simulated = averaged or network
            assert isinstance(simulated, HierarchicalGraphNetwork)
            self.pool = GraphPushforwardPool(simulated, training, obstacle_cell_size, rank)
        self.parity: tuple[float, float] | None = None  # with PyTorch, see hgn.training.parity

    def run(
        self,
        chunk: UpdateChunk,
        rates: list[float],
        average_weights: list[float] | None = None,
        first_update: int = 0,
    ) -> None:
        """Makes an update for each entry of the chunk, at these learning rates.

        `average_weights` are those of the new values in their moving average, where there is one. `first_update` is the
        number of the first update.

        Raises: ConfigError when positions are not finite, or before the first update when the kernels are wrong here.
        """
        for index in chunk.dropped:
            del self._episodes[index]
        with self._timed("placing episodes"):
            for index, episode in chunk.episodes.items():
                self._episodes[index] = self._placed(episode)
        if self.parity is None:
            with self._timed("checking the kernels"):
                self._check(chunk)
        if self.pool is not None and chunk.starts:
            average = self.updates.average
            values = self.updates.values if average is None else average
            with self._timed("pushforward"):
                self.pool.refresh([(self._episodes[i], frame) for i, frame in chunk.starts], values)
        samples = [
            [DeviceSample(self._episodes[s.episode], s.frame, s.seed, s.weight, s.noise_scale) for s in u]
            for u in chunk.samples
        ]
        if self.pool is not None:
            samples = [self.pool.replaced(update, first_update + i) for i, update in enumerate(samples)]
        self.updates.run(samples, rates, average_weights)
        self._write_back()
        self._made += len(chunk.samples)

    def _check(self, chunk: UpdateChunk) -> None:
        first = chunk.samples[0]
        self.updates.predict([(self._episodes[s.episode], s.frame, s.seed) for s in first])
        episodes = [chunk.episodes[s.episode] for s in first]
        shown = None
        if self.symmetric:
            shown = [drawn_symmetry(e.symmetries, s.seed) for e, s in zip(episodes, first, strict=True)]
        self.parity = require_parity(self.updates, episodes, shown)

    @contextmanager
    def _timed(self, what: str) -> Iterator[None]:
        begun = time.monotonic()
        yield
        self._seconds[what] += time.monotonic() - begun

    def report(self) -> str | None:
        """Where the time of the first updates went: once, when REPORTED_UPDATES are made."""
        if not self._begun or self._made < REPORTED_UPDATES:
            return None
        total, updates, misses = time.monotonic() - self._begun, self.updates, self._jit_misses
        self._begun = 0.0
        parts = [f"{seconds:.1f} s {what}" for what, seconds in self._seconds.items()]
        parts.append(f"{updates.capture_seconds:.1f} s capturing {updates.captures} times")
        return (
            f"backend triton: the first {self._made} updates took {total:.1f} s, {', '.join(parts)}; "
            f"in that {misses.seconds:.1f} s for {misses.count} kernels that were not compiled ahead"
        )

    def _placed(self, episode: EpisodeTensors) -> DeviceEpisode:
        """On the device while there is room, else in pinned memory, which the kernels read through the bus."""
        position_TN3 = episode.position_TN3
        if self.device.type == "cuda":
            free, total = torch.cuda.mem_get_info(self.device)
            fits = free - position_TN3.nbytes > (1 - DATA_FRACTION) * total
            position_TN3 = position_TN3.to(self.device) if fits else position_TN3.pin_memory()
        cells, normals = episode.obstacle_cell_K3, episode.obstacle_normal_K3
        obstacles = ObstacleHash.of(cells, normals).to(self.device) if len(cells) else None
        barrier = BarrierHash.of(episode.barrier) if episode.barrier is not None else None
        return DeviceEpisode(
            position_TN3,
            episode.material_N.to(self.device),
            obstacles,
            episode.domain_size,
            episode.gravity,
            episode.symmetries,
            barrier and barrier.to(self.device),
        )

    def _take_over(self) -> None:
        """Makes parameters and moments views of flat buffers, so that one launch copies all of them."""
        parameters = list(self.network.parameters())
        self._flat = _flattened(self.network)
        self._moments = torch.zeros(2, len(self._flat), device=self.device)
        self._steps = torch.zeros(len(parameters), device=self.device)
        first, second = (flat.split([parameter.numel() for parameter in parameters]) for flat in self._moments)
        for i, parameter in enumerate(parameters):
            state = self.optimizer.state[parameter]
            if state:
                first[i].copy_(state["exp_avg"].reshape(-1))
                second[i].copy_(state["exp_avg_sq"].reshape(-1))
                self._steps[i] = state["step"]
            state["step"] = self._steps[i]
            state["exp_avg"], state["exp_avg_sq"] = (m[i].view(parameter.shape) for m in (first, second))

    def _packed(self, flat: torch.Tensor) -> torch.Tensor:
        return self.updates.packed.gather([flat])

    def _read_moments(self) -> None:
        index = self.updates.packed.index.to(self.device)
        used = index >= 0
        for flat, packed in zip(self._moments, (self.updates.first_moment, self.updates.second_moment), strict=True):
            packed.copy_(self._packed(flat))
        self.updates.step.fill_(float(self._steps.max()))
        # of each parameter element in the packed buffers
        self._place = torch.empty_like(index[used], dtype=torch.int64)
        self._place[index[used]] = torch.nonzero(used).flatten()

    def _write_back(self) -> None:
        updates = self.updates
        torch.index_select(updates.values, 0, self._place, out=self._flat)
        torch.index_select(updates.first_moment, 0, self._place, out=self._moments[0])
        torch.index_select(updates.second_moment, 0, self._place, out=self._moments[1])
        if self._averaged is not None:
            assert updates.average is not None
            torch.index_select(updates.average, 0, self._place, out=self._averaged)
        self._steps.copy_(updates.step.expand_as(self._steps))


def _flattened(network: ParticleNetwork) -> torch.Tensor:
    """Makes a network's parameters views of a flat buffer, which it returns."""
    parameters = list(network.parameters())
    flat = torch.cat([parameter.detach().reshape(-1) for parameter in parameters])
    for parameter, view in zip(parameters, flat.split([p.numel() for p in parameters]), strict=True):
        parameter.data = view.view(parameter.shape)
    return flat
