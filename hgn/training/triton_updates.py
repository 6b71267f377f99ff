"""Training updates in Triton kernels (hgn.kernels.update), captured as CUDA graphs.

While a chunk of updates runs, parameters and Adam's moments are in the kernels' layout. They are copied back after the
chunk, so checkpoints do not depend on the backend.
"""

import math
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from hgn.config import TrainingConfig
from hgn.data.episode_tensors import EpisodeChunk, EpisodeTensors
from hgn.kernels.moving import EpisodeMoving
from hgn.kernels.scene_tables import SceneHash
from hgn.kernels.triton_compat import JitMisses
from hgn.kernels.update.op import DeviceEpisode, DeviceSample, Updates
from hgn.network.base import ParticleNetwork
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.parity import ParityError
from hgn.runtime.triton_host import kernel_precision
from hgn.scene.symmetry import drawn_symmetry
from hgn.training.distributed import sum_over_ranks
from hgn.training.parity import require_update_parity
from hgn.training.pushforward import PushforwardPool
from hgn.training.schedule import average_weight, learning_rate
from hgn.training.triton_pushforward import TritonScenes
from hgn.training.updates import TrainedNetwork

REPORTED_UPDATES = 256  # number of first updates whose times are printed; they are the slowest
DATA_FRACTION = 0.6  # largest fraction of a GPU's memory that episodes use; other episodes stay in host memory


class TritonUpdates:
    """Trains on chunks of samples with CUDA graphs. hgn.training.updates.Updates describes the methods."""

    def __init__(
        self,
        trained: TrainedNetwork,
        training: TrainingConfig,
        obstacle_cell_size: float,
        rank: int = 0,
        *,
        world_size: int = 1,
        precisions: tuple[str, ...] = ("fp32",),
    ) -> None:
        """`precisions` are tried in order. Training uses the first one whose kernels agree with PyTorch."""
        self._start_s, self._made, self._jit_misses = time.monotonic(), 0, JitMisses()
        self._seconds: dict[str, float] = defaultdict(float)
        self.training, self._rank, self._world_size = training, rank, world_size
        assert isinstance(trained.network, HierarchicalGraphNetwork)
        self.network, self.optimizer = trained.network, trained.optimizer
        self.device = next(self.network.parameters()).device
        self._take_over()
        self._averaged = None if trained.averaged is None else _flattened(trained.averaged)
        self._trained, self._obstacle_cell_size = trained, obstacle_cell_size
        self._build(precisions[0])
        self._other_precisions = precisions[1:]
        self._episodes: dict[int, DeviceEpisode] = {}
        self.parity: tuple[float, float] | None = None  # with PyTorch, see hgn.training.parity

    def _build(self, precision: str) -> None:
        """Builds the updates and simulations of this precision from the network's present parameters."""
        trained, training = self._trained, self.training
        self.precision = precision
        self.updates = Updates(
            self.network,
            training,
            self._obstacle_cell_size,
            kernel_precision(precision, self.device),
            loss_sum=trained.loss_sum,
            counters=trained.counters,
            reduce=sum_over_ranks if self._world_size > 1 else None,
            ranks=self._world_size,
        )
        self._read_moments()
        if self._averaged is not None:
            self.updates.average = self._packed(self._averaged)
        self.pool: PushforwardPool[DeviceEpisode, DeviceSample] | None = None
        if training.pushforward_fraction > 0:
            simulated = trained.result
            assert isinstance(simulated, HierarchicalGraphNetwork)
            self._scenes = TritonScenes(simulated, training, self._obstacle_cell_size, precision)
            self.pool = PushforwardPool(self._scenes, training, self._rank)

    def run(self, chunk: EpisodeChunk, first_update: int) -> None:
        """Raises: ConfigError for positions that are not finite; ParityError if no precision passes the first check."""
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
            self._scenes.values = self.updates.values if average is None else average
            with self._timed("pushforward"):
                self.pool.refresh([(self._episodes[i], frame) for i, frame in chunk.starts])
        samples = [[DeviceSample(self._episodes[s.episode], *s[1:]) for s in update] for update in chunk.samples]
        if self.pool is not None:
            samples = [self.pool.replaced(update, first_update + i) for i, update in enumerate(samples)]
        numbers = range(first_update, first_update + len(samples))
        rates = [learning_rate(self.training, update) for update in numbers]
        average_weights = [average_weight(self.training, update) for update in numbers]
        self.updates.run(samples, rates, None if self._averaged is None else average_weights)
        self.optimizer.param_groups[0]["lr"] = rates[-1]
        self._write_back()
        self._made += len(samples)
        self._report()

    def _check(self, chunk: EpisodeChunk) -> None:
        first = chunk.samples[0]
        self.updates.predict([(self._episodes[s.episode], s.frame, s.seed) for s in first])
        episodes = [chunk.episodes[s.episode] for s in first]
        shown = None
        if self.training.symmetry != "none":
            shown = [drawn_symmetry(e.symmetries, s.seed) for e, s in zip(episodes, first, strict=True)]
        failure = ""
        try:
            self.parity = require_update_parity(self.updates, episodes, shown, [s.frame for s in first])
        except ParityError as error:
            failure = str(error)  # a stored error would keep the graphs in memory
        failures = torch.tensor(float(failure != ""), device=self.device)
        if self._world_size > 1:
            sum_over_ranks(failures)
        if failures > 0:
            failure = failure or "the kernels failed the check on another rank, whose message contains the error"
            if not self._other_precisions:
                raise ParityError(failure)
            precision, self._other_precisions = self._other_precisions[0], self._other_precisions[1:]
            self._say(f"{failure}; precision=auto trains in {precision}")
            self._build(precision)
            self._check(chunk)
            return
        assert self.parity is not None
        outputs, gradients = self.parity
        text = f"outputs within {outputs:.0e}, gradients within {gradients:.0e} of PyTorch's"
        self._say(text if math.isfinite(outputs) else "batch too large to check")

    def _say(self, text: str) -> None:
        if self._rank == 0:
            print(f"backend triton: {text}", file=sys.stderr)

    @contextmanager
    def _timed(self, what: str) -> Iterator[None]:
        start_s = time.monotonic()
        yield
        self._seconds[what] += time.monotonic() - start_s

    def _report(self) -> None:
        """Prints once how long the parts of the first REPORTED_UPDATES updates took."""
        if not self._start_s or self._made < REPORTED_UPDATES:
            return
        total, updates, misses = time.monotonic() - self._start_s, self.updates, self._jit_misses
        self._start_s = 0.0
        parts = [f"{seconds:.1f} s {what}" for what, seconds in self._seconds.items()]
        parts.append(f"{updates.capture_seconds:.1f} s capturing {updates.captures} times")
        self._say(
            f"the first {self._made} updates took {total:.1f} s, {', '.join(parts)}; "
            f"including {misses.seconds:.1f} s for {misses.count} kernels that were not compiled ahead"
        )

    def _placed(self, episode: EpisodeTensors) -> DeviceEpisode:
        """Copies an episode to the device. If its positions do not fit, kernels read them from pinned host memory."""
        position_TN3 = episode.position_TN3
        if self.device.type == "cuda":
            free, total = torch.cuda.mem_get_info(self.device)
            fits = free - position_TN3.nbytes > (1 - DATA_FRACTION) * total
            position_TN3 = position_TN3.to(self.device) if fits else position_TN3.pin_memory()
        obstacles = SceneHash.of_grid(episode.obstacle_grid, "friction" in self.network.config.own_physics)
        barrier = SceneHash.of_barrier(episode.barrier) if episode.barrier is not None else None
        return DeviceEpisode(
            position_TN3,
            episode.material_N.to(self.device),
            obstacles and obstacles.to(self.device),
            episode.domain_size,
            gravity=episode.gravity,
            symmetries=episode.symmetries,
            barrier=barrier and barrier.to(self.device),
            wall_friction=episode.wall_friction,
            parameter_NP=None if episode.parameter_NP is None else episode.parameter_NP.to(self.device),
            rest=episode.rest and episode.rest.to(self.device),
            moving=EpisodeMoving.of(episode.moving, episode.frame_s, self.network.config, self.device),
        )

    def _take_over(self) -> None:
        """Makes parameters and moments views of flat buffers, so that one launch copies a whole buffer."""
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
        # index of each parameter element in the packed buffers
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
    """Makes a network's parameters views of a flat buffer. Returns the buffer."""
    parameters = list(network.parameters())
    flat = torch.cat([parameter.detach().reshape(-1) for parameter in parameters])
    for parameter, view in zip(parameters, flat.split([p.numel() for p in parameters]), strict=True):
        parameter.data = view.view(parameter.shape)
    return flat
