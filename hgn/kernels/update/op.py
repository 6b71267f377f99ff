"""Makes training updates on the device: batch, grid, forward pass, backward pass and optimiser in one CUDA graph.

The host uploads a table with the samples of many updates and replays the graph once for each update. It reads the
results only after the last replay. If a grid is too small, its update and later ones change nothing. The host enlarges
the buffers and continues with this update. Shape legend: K updates, S scenes, N particles of all scenes.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
import triton

from hgn.config import CORRELATED_WAVELENGTHS, CORRELATED_WAVES, TrainingConfig
from hgn.kernels.backward import FusedTrainingNetwork
from hgn.kernels.capture import captured
from hgn.kernels.grid.op import OUT_OF_BOX, CellBox, DeviceGrid, DeviceParticles
from hgn.kernels.moving import NONE_MOVES, EpisodeMoving, MovingTable
from hgn.kernels.muon.op import SquareBlocks
from hgn.kernels.packing import pack_network
from hgn.kernels.scene_tables import OBSTACLE_COLUMNS, SceneHash, SceneTable
from hgn.kernels.update import kernel
from hgn.network.elastic import RestShape
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.network.own_physics import physics_widths
from hgn.scene.symmetry import Symmetry, Vector, drawn_symmetry
from hgn.schema import ConfigError

SAMPLE_COLUMNS = kernel.SAMPLE_COLUMNS.value
GROWTH = 1.25
TABLE_UPDATES = 64  # smallest capacity of the tables, in updates; a larger table needs a new capture of the graph
BLOCK, ERROR_BLOCK, FLAT_BLOCK = 128, 32, 1024
TAIL = 16  # number of extra elements after the gradient; the first one reports an overflow to the other ranks


@dataclass(frozen=True, eq=False)
class DeviceEpisode:
    """Holds an episode where the kernels can read it: on the device, or in pinned memory of the host.

    position_TN3 float32 begins with the frames before frame 0. Each window is therefore one contiguous piece of it.
    """

    position_TN3: torch.Tensor
    material_N: torch.Tensor  # int32, index into the network's list of materials
    obstacles: SceneHash | None
    domain_size: Vector
    gravity: Vector = (0.0, 0.0, 0.0)  # domain units per frame squared; only relative inputs use it
    symmetries: tuple[Symmetry, ...] = ()  # with training.symmetry one of them is drawn for each sample
    barrier: SceneHash | None = None  # the barrier of the episode's simulations
    wall_friction: Vector = (0.0, 0.0, 0.0)  # friction of the walls normal to x, y, z
    parameter_NP: torch.Tensor | None = None  # float32, columns of hgn.network.own_physics; None: all are 0
    rest: RestShape | None = None  # None: no elastic bodies
    moving: EpisodeMoving = NONE_MOVES
    first_frame: int = 0  # number of the episode's frame that follows the frames before frame 0

    def __post_init__(self) -> None:
        position_TN3, material_N = self.position_TN3, self.material_N
        assert position_TN3.dtype == torch.float32 and position_TN3.is_contiguous()
        assert material_N.dtype == torch.int32 and material_N.is_contiguous()
        assert position_TN3.shape[1:] == (len(material_N), 3)

    @cached_property
    def particles(self) -> int:
        return len(self.material_N)

    @cached_property
    def frames(self) -> int:
        """Returns the number of frames, including those before frame 0."""
        return len(self.position_TN3)

    @cached_property
    def row(self) -> np.ndarray:
        """Returns the row of the sample table for frame 0, int64 [SAMPLE_COLUMNS], without seed and weight."""
        obstacles = self.obstacles.row() if self.obstacles is not None else [0] * OBSTACLE_COLUMNS
        parameters = 0 if self.parameter_NP is None else self.parameter_NP.data_ptr()
        first = [self.position_TN3.data_ptr(), self.particles, 0, 0, self.material_N.data_ptr(), 0, parameters]
        first.append(0 if self.rest is None else self.rest.packed.data_ptr())
        return np.array([*first, *obstacles], np.int64)


class DeviceSample(NamedTuple):
    """Names a frame of an episode to train on."""

    episode: DeviceEpisode
    frame: int
    seed: int  # seed of noise, jitter and symmetry
    weight: float = 1.0  # weight of this sample in the loss


AnySample = DeviceSample | tuple[DeviceEpisode, int, int]


class Updates:
    """Holds parameters and Adam's moments in flat buffers, and makes the launches that update them.

    The launches add to loss_sum [2] and counters [5], see finish_update. `reduce` must sum a float32 tensor over all
    ranks in place. Updates then average the gradients of `ranks` ranks, and all ranks make the same updates.
    """

    grid: DeviceGrid
    fused: FusedTrainingNetwork
    jitter = True  # whether the grids begin at random places; comparisons with other updates set it to False

    def __init__(
        self,
        network: HierarchicalGraphNetwork,
        training: TrainingConfig,
        obstacle_cell_size: float,
        precision: str,
        loss_sum: torch.Tensor,
        counters: torch.Tensor,
        reduce: Callable[[torch.Tensor], None] | None = None,
        ranks: int = 1,
        capacities: tuple[int, ...] = (),
    ) -> None:
        """Takes the initial number of cells of each level from `capacities`, or measures it at the first update."""
        self.network, self.config, self.training, self.precision = network, network.config, training, precision
        self.scenes, self.symmetry = training.batch_scenes, training.symmetry != "none"
        self.obstacle_cell_size = obstacle_cell_size
        self.loss_sum, self.counters, self.reduce, self.ranks = loss_sum, counters, reduce, ranks
        self.device = device = next(network.parameters()).device
        self.packed = pack_network(network)
        self.values = self.packed.gather(list(network.parameters()))
        self.first_moment, self.second_moment = torch.zeros_like(self.values), torch.zeros_like(self.values)
        self.average: torch.Tensor | None = None  # moving average of the values; assigned before the first update
        muon = training.optimizer == "muon"
        self.blocks = SquareBlocks(network, self.packed.index, device) if muon else None
        self.step = torch.zeros(1, dtype=torch.float64, device=device)
        self.update = torch.zeros(1, dtype=torch.int32, device=device)
        self.loss, self.norm = torch.zeros(1, device=device), torch.zeros(1, device=device)
        scenes, normaliser = self.scenes, network.normaliser
        columns = 4 + 3 * self.config.velocity_history  # wave vector, phase, and a change of amplitude per velocity
        self.waves_SKC = torch.zeros(scenes, CORRELATED_WAVES, columns, device=device)
        sees = self.config.obstacle_features
        table = SceneTable([None] * scenes, OBSTACLE_COLUMNS, device, obstacle_cell_size)
        self.obstacles, self._obstacle_row = table if sees else None, table.row_SC
        self.moving: MovingTable | None = None
        mean_3, std_3 = normaliser.feature_scale(self.config.relative)
        self.scale = (mean_3.float(), std_3.float())
        self.mean, self.std = normaliser.acceleration_mean.float(), normaliser.acceleration_std.float()
        self.capacities = capacities
        self.particles = 0
        self.growths = 0  # number of times that the buffers grew
        self.captures, self.capture_seconds = 0, 0.0
        self._corners = (torch.zeros(3), torch.zeros(3))  # corners, in domain units, of what the cell box must contain
        self._graphs: list[torch.cuda.CUDAGraph] = []
        self._samples = self._vectors = self._rates = self._ema_weights = torch.empty(0)

    # updates

    def run(
        self, chunk: Sequence[Sequence[AnySample]], rates: Sequence[float], ema_weights: Sequence[float] | None = None
    ) -> None:
        """Makes one update for each entry of `chunk`. An entry lists one sample per scene.

        `ema_weights` are those of the new values in `average`. Raises: ConfigError for positions that are not finite.
        """
        assert (ema_weights is None) == (self.average is None)
        self._prepare(chunk, rates)
        if ema_weights is not None:
            self._ema_weights[: len(chunk)].copy_(torch.tensor(ema_weights, dtype=torch.float64))
        done = 0
        while True:
            for _ in range(len(chunk) - done):
                self._replay()
            done, status, *needed = torch.cat([self.update, self.grid.status, self.grid.needed_L]).tolist()
            if done == len(chunk):
                return
            self._grow(status, needed)

    def predict(self, samples: Sequence[AnySample]) -> None:
        """Assembles the batch of one update and writes the network's output to `fused.output`."""
        self._prepare([samples], [0.0])
        while True:
            self._assemble()
            self._grid()
            self.fused.forward()
            status, *needed = torch.cat([self.grid.status, self.grid.needed_L]).tolist()
            if status == 0:
                return
            self._grow(status, needed)

    def _prepare(self, chunk: Sequence[Sequence[AnySample]], rates: Sequence[float]) -> None:
        """Uploads the tables of a chunk, and grows buffers if necessary."""
        assert len(chunk) == len(rates)
        particles = self._upload(chunk, rates)
        if particles > self.particles or not self._inside():
            self.particles = max(self.particles, 16 * math.ceil(particles / 16))
            self._build()

    def _upload(self, chunk: Sequence[Sequence[AnySample]], rates: Sequence[float]) -> int:
        """Writes the tables of the chunk, and returns the largest number of particles of an update."""
        scenes, history = self.scenes, self.config.velocity_history
        assert all(len(samples) == scenes for samples in chunk)
        flat = [DeviceSample(*sample) for samples in chunk for sample in samples]
        # The kernels read raw addresses and check no bounds. The host therefore checks them here.
        for episode, frame, *_ in flat:
            assert 0 <= frame <= episode.frames - history - 2, "a window reaches beyond its episode"
        table = np.array([sample.episode.row for sample in flat]).reshape(len(chunk), scenes, SAMPLE_COLUMNS)
        count = table[..., 1]
        table[..., 0] += np.array([sample.frame for sample in flat]).reshape(count.shape) * count * 12
        table[..., 2] = count.cumsum(1) - count  # index of the first particle
        table[..., 3] = np.array([sample.seed for sample in flat]).reshape(count.shape)
        weight = np.array([sample.weight for sample in flat], np.float64)
        table[..., 5] = weight.view(np.int64).reshape(count.shape)
        symmetries = [Symmetry()] * len(flat)
        if self.symmetry:
            symmetries = [drawn_symmetry(sample.episode.symmetries, sample.seed) for sample in flat]
            table[..., -1] = np.array([symmetry.code for symmetry in symmetries]).reshape(count.shape)
        vectors = np.zeros((len(flat), 3, 3), np.float32)
        vectors[:, 0] = [sample.episode.domain_size for sample in flat]
        if self.config.relative:
            vectors[:, 1] = [s.direction(sample.episode.gravity) for s, sample in zip(symmetries, flat, strict=True)]
        pairs = [(s.source, sample.episode.wall_friction) for s, sample in zip(symmetries, flat, strict=True)]
        vectors[:, 2] = [[friction[axis] for axis in source] for source, friction in pairs]
        most = int(count.sum(1).max())
        if len(chunk) > len(self._rates):
            self._allocate_tables(max(len(chunk), TABLE_UPDATES))
        self._samples[: len(chunk)].copy_(torch.from_numpy(table))
        self._vectors[: len(chunk)].copy_(torch.from_numpy(vectors).view(*count.shape, 3, 3))
        self._rates[: len(chunk)].copy_(torch.tensor(rates, dtype=torch.float64))
        moving = [(s.episode.moving, s.episode.first_frame + s.frame) for s in flat]
        self.allocate_moving(max(len(own.obstacles) for own, _ in moving))
        if self.moving is not None:
            self.moving.write(moving, symmetries)
        self.update.zero_()
        largest = torch.from_numpy(vectors[:, 0]).amax(0)
        self._corners = (self._corners[0], torch.maximum(self._corners[1], largest))
        return most

    def allocate_moving(self, layers: int) -> None:
        """Allocates, for each update, records for `layers` moving obstacles of a scene, if there are not enough."""
        table, updates = self.moving, len(self._rates)
        layers = layers if table is None else max(layers, table.layers)
        if layers and (table is None or layers > table.layers or updates > len(table.record_TVR)):
            self._graphs, size = [], self.obstacle_cell_size  # the graphs read the old records
            self.moving = MovingTable(self.update, updates, self.scenes, layers, size)

    def _allocate_tables(self, length: int) -> None:
        self._graphs = []  # the graphs read the old tables
        shape = (length, self.scenes)
        self._samples = torch.zeros(*shape, SAMPLE_COLUMNS, dtype=torch.int64, device=self.device)
        self._vectors = torch.zeros(*shape, 3, 3, device=self.device)
        self._rates, self._ema_weights = (torch.zeros(length, device=self.device) for _ in range(2))

    def _replay(self) -> None:
        if self.device.type == "cuda" and not self._graphs:
            self._capture()
        if self.reduce is None:
            self._graphs[0].replay() if self._graphs else self.launches()
            return
        self._graphs[0].replay() if self._graphs else self.launches_before_reduction()
        self.reduce(self.fused.totals)
        self._graphs[1].replay() if self._graphs else self.launches_after_reduction()

    # launches

    def allocate(self, particles: int, cells: Sequence[int]) -> None:
        """Allocates buffers for about this number of particles and of cells of each level, for precompilation."""
        self._allocate_tables(1)
        self.particles, self.capacities = 16 * math.ceil(particles / 16), self._rounded(cells)
        self._build()

    def launches(self) -> None:
        """Makes all launches of one update, without communication with other ranks."""
        self.launches_before_reduction()
        self.launches_after_reduction()

    def launches_before_reduction(self) -> None:
        """Makes the launches from the sample table to this rank's gradients."""
        self._assemble()
        self._grid()
        fused = self.fused
        fused.forward()
        grid, levels, columns = self.grid, self.config.levels, fused.output.shape[1]
        sums = {"sums": self.sum_C4, "cell_of": grid.cell_N8, "weight_of": grid.weight_N8}
        above = {"parent": grid.parents, "geometry": grid.geometry, "LEVELS": levels if len(self.sum_C4) else 0}
        errors = {"output": fused.output, "target": self.target_N3, "particle_count": self.buffers.count}
        blocks, cells = (triton.cdiv(self.particles, ERROR_BLOCK),), (triton.cdiv(self.capacities[0], BLOCK),)
        if len(self.sum_C4):
            kernel.sum_errors[blocks](**errors, **sums, OUT=columns, BLOCK=ERROR_BLOCK)
            kernel.sum_errors_above[cells](**above, sums=self.sum_C4, counts=grid.counts_L, BLOCK=BLOCK)
        kernel.loss_gradient[blocks](
            **errors, **sums, **above, loss_weight_of=self.loss_weight_N, gradient=fused.output_gradient,
            loss=self.loss, scale=1.0 / fused.unscale, cell_mean_weight=self.training.cell_mean_weight, OUT=columns,
            BLOCK=ERROR_BLOCK,
        )  # fmt: skip
        fused.backward()
        if self.reduce is not None:
            kernel.flag_overflow[(1,)](status=self.grid.status, flag=fused.totals[-TAIL:])

    def launches_after_reduction(self) -> None:
        """Makes the launches from the summed gradients to the new parameters."""
        fused, size, rank_weight = self.fused, self.packed.size, 1.0 / self.ranks
        blocks = (triton.cdiv(size, FLAT_BLOCK),)
        kernel.square_norm[blocks](
            gradient=fused.totals, size=size, rank_weight=rank_weight, flag=fused.totals[-TAIL:],
            status=self.grid.status, norm=self.norm, BLOCK=FLAT_BLOCK,
        )  # fmt: skip
        kernel.adam[blocks](
            value=self.values, weight=fused.weights, gradient=fused.totals, rank_weight=rank_weight,
            first_moment=self.first_moment, second_moment=self.second_moment, rates=self._rates,
            update=self.update, step=self.step, status=self.grid.status, norm=self.norm, size=size,
            others=self.blocks.member if self.blocks else None, PRECISION=fused.copy_precision,
            BLOCK=FLAT_BLOCK,
        )  # fmt: skip
        if self.blocks is not None:
            self.blocks.step(
                self.values, fused.weights, self.first_moment, fused.totals, rank_weight, self._rates, self.update,
                self.grid.status, self.norm, fused.copy_precision,
            )  # fmt: skip
        if self.average is not None:
            kernel.average_values[blocks](
                value=self.values, average=self.average, ema_weights=self._ema_weights, update=self.update,
                status=self.grid.status, size=size, BLOCK=FLAT_BLOCK,
            )  # fmt: skip
        fused.refresh_encoder()
        kernel.finish_update[(1,)](
            status=self.grid.status, update=self.update, step=self.step, loss=self.loss, norm=self.norm,
            loss_sum=self.loss_sum, counters=self.counters,
        )  # fmt: skip

    def _assemble(self) -> None:
        """Launches the assembly of the samples: windows, symmetry, noise and jitter. The rule is hgn.training.noise."""
        training, config = self.training, self.config
        correlated, steps = training.noise_correlated_fraction, config.velocity_history
        wave_step = training.noise_std * math.sqrt(2 / CORRELATED_WAVES * correlated / steps)
        own_step = training.noise_std * math.sqrt((1 - correlated) / steps)
        if wave_step > 0:
            shortest, longest = (cells * config.cell_size for cells in CORRELATED_WAVELENGTHS)
            kernel.draw_waves[(self.scenes,)](
                samples=self._samples, update=self.update, waves=self.waves_SKC, amplitude_step=wave_step,
                largest_number=2 * math.pi / shortest, log_range=math.log(longest / shortest),
                scenes=self.scenes, HISTORY=config.velocity_history, WAVES=CORRELATED_WAVES,
            )  # fmt: skip
        walls, parameter_NP, rest_NR = self.buffers.wall_friction_S3, self.buffers.parameter_NP, self.buffers.rest_NR
        kernel.assemble_batch[(triton.cdiv(self.particles, BLOCK),)](
            samples=self._samples, sample_vectors=self._vectors, update=self.update, position=self.buffers.position_N3,
            velocity=self.buffers.velocity_NV, scene_of=self.buffers.scene_N, material_of=self.buffers.material_N,
            target=self.target_N3, loss_weight_of=self.loss_weight_N, origin=self.buffers.origin_S3,
            domain=self.buffers.domain_S3, gravity=self.buffers.gravity_S3, obstacle_table=self._obstacle_row,
            particle_count=self.buffers.count, mean=self.mean, std=self.std, noise_step=own_step, waves=self.waves_SKC,
            jitter=config.cell_size if self.jitter else 0.0, scenes=self.scenes,
            wall_friction=self.buffers.domain_S3 if walls is None else walls,
            parameter_of=self.loss_weight_N if parameter_NP is None else parameter_NP,
            rest_of=self.buffers.scene_N if rest_NR is None else rest_NR,
            obstacle_cell_size=self.obstacle_cell_size, HISTORY=config.velocity_history,
            SYMMETRY=self.symmetry, NOISE=own_step > 0, WAVES=CORRELATED_WAVES if wave_step > 0 else 0,
            FRICTION=walls is not None, PARAMETERS=physics_widths(config)[1],
            WIDTH=0 if parameter_NP is None else parameter_NP.shape[1], REST=rest_NR is not None,
            DIMENSIONS=config.dimensions, SCENES=triton.next_power_of_2(self.scenes), BLOCK=BLOCK,
        )  # fmt: skip

    def _grid(self) -> None:
        """Builds the grid, and computes the cells and the features of the particles."""
        self.grid.build(self.buffers)
        self.grid.prepare(self.buffers, self.scale, self.obstacles, self.symmetry, self.moving)

    def _inside(self) -> bool:
        (low, high), (built_low, built_high) = self._corners, self._built_corners
        return bool((built_low <= low).all() and (built_high >= high).all())

    def _build(self) -> None:
        """Allocates buffers for `particles` and `capacities`. It first measures capacities that are unknown."""
        config, device, particles = self.config, self.device, self.particles
        self._graphs = []
        if hasattr(self, "fused"):
            del self.fused, self.grid  # frees the old buffers before the allocation of the new ones
        self._built_corners = self._corners
        self.buffers = DeviceParticles.empty(
            particles, self.scenes, config.velocity_history, device, config.own_physics
        )
        self.target_N3 = torch.zeros(particles, 3, device=device)
        self.loss_weight_N = torch.zeros(particles, device=device)
        # Bodies divide only cells for which the finest level has room, so the second measurement finds theirs.
        for _ in range(0 if self.capacities else 1 + config.body_cells):
            self.grid = self._device_grid(self.capacities or (16,) * config.levels)
            self._assemble()
            self.grid.build(self.buffers)
            self.capacities = self._rounded(self.grid.needed_L.tolist())
        self.grid = self._device_grid(self.capacities)
        # sums of errors in the cells of all levels; no rows without training.cell_mean_weight
        self.sum_C4 = self.grid.more_cleared[0].view(torch.float32).view(-1, 4)
        # The gradients of a mean over particles are small. float16 would round them to zero without a scale.
        scale = 2.0 ** round(math.log2(max(self.particles, 2))) if self.precision == "fp16" else 1.0
        self.fused = FusedTrainingNetwork(
            self.packed, self.values, self.grid, self.buffers.count, self.precision, scale, tail=TAIL
        )

    def _device_grid(self, capacities: tuple[int, ...]) -> DeviceGrid:
        config, (lower, upper) = self.config, self._corners
        box = CellBox.around(lower.tolist(), upper.tolist(), config.cell_size, config.levels)
        sums = 4 * sum(capacities) * (self.training.cell_mean_weight > 0)
        return DeviceGrid(config, box, capacities, self.scenes, self.particles, self.device, more=(sums,))

    def _grow(self, status: int, needed: list[int]) -> None:
        if status & OUT_OF_BOX:
            position = self.buffers.position_N3[: int(self.buffers.count)]
            if not bool(position.isfinite().all()):
                raise ConfigError("positions of the training episodes must be finite, got some that are not")
            low, high = position.amin(0).cpu(), position.amax(0).cpu()
            self._corners = (torch.minimum(self._corners[0], low), torch.maximum(self._corners[1], high))
        grown = self._rounded(needed)
        self.capacities = tuple(
            c if n <= c else max(c, g) for c, n, g in zip(self.capacities, needed, grown, strict=True)
        )
        self.growths += 1
        self._build()

    def _capture(self) -> None:
        begun = time.monotonic()
        parts = [self.launches_before_reduction, self.launches_after_reduction] if self.reduce else [self.launches]

        def warm_up() -> None:
            self.grid.status.fill_(kernel.REPEAT.value)  # with this status launches are compiled but change nothing
            self.launches()
            self.grid.status.zero_()

        self._graphs = captured(parts, warm_up)
        self.captures += 1
        self.capture_seconds += time.monotonic() - begun

    def _rounded(self, needed: Sequence[int]) -> tuple[int, ...]:
        return tuple(16 * math.ceil(max(GROWTH * count, 32) / 16) for count in needed)
