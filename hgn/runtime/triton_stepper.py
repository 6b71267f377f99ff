"""Frames of a simulation as CUDA graphs (paper algorithm 1), without synchronisation within a block of frames.

The host reads the status after each block of `block_frames` frames, while the device computes the next block. If the
grid needed more memory than it had, the completed frames are kept and the buffers grow. The simulation continues from
the last good frame, so no frame is computed twice.
Shape legend: N particles of all scenes, M velocities of a history, S scenes, T frames.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch

from hgn.config import NetworkConfig
from hgn.kernels.capture import captured
from hgn.kernels.forward import FusedNetwork
from hgn.kernels.grid.op import OUT_OF_BOX, OVERFLOW, CellBox, DeviceGrid, DeviceImage, DeviceParticles
from hgn.kernels.moving import MovingTable
from hgn.kernels.packing import pack_network
from hgn.kernels.scene_tables import SceneTable
from hgn.kernels.step.op import DIVERGED, DeviceStep, rest_numbers
from hgn.kernels.triton_compat import compile_launches, noted_launches
from hgn.kernels.tuning import Tuning
from hgn.network.cell_keys import COORDINATE_LIMIT, pack
from hgn.network.elastic import RestShape
from hgn.network.features import ParticleState
from hgn.network.grid import build_hierarchy
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.network.images import Image
from hgn.network.moving import MovingObstacles
from hgn.network.origins import frame_origin
from hgn.network.own_physics import has_friction
from hgn.runtime.moving_parity import require_moving_parity
from hgn.runtime.parity import OUTPUTS, ParityError, require_parity
from hgn.runtime.triton_host import kernel_precision
from hgn.scene.material import INPUT_PARAMETERS
from hgn.step.reference import rested
from hgn.step_config import UNCONSTRAINED, StepConfig
from hgn.system.machine import available_cpus

BLOCK_FRAMES, FEWEST_FRAMES = 32, 4  # largest and smallest number of frames in a block
CROWDED = 140  # number of particles above which a finest cell is crowded; 1.5 times the density of bodies in the data
PATH_BYTES = 1 << 27  # memory of positions on their way to the host; with many particles it shortens blocks
GROWTH = 2.0  # (new capacity) / (needed cells) when buffers grow
# Smallest values of HEADROOM and GROWTH, used by scenes with many more than ROOMY_CELLS cells.
TIGHT_START, TIGHT_GROWTH = 1.25, 1.5
HEADROOM = 8.0  # (first capacity) / (cells at a scene's start); groups that fall and spread need a factor of up to six
SPREAD_CELLS = (0.6, 0.1, 0.035, 0.02)  # largest number of cells per particle, by level; coarser levels have the last
ROOMY_CELLS = 65_536  # finest cells up to which a first capacity has HEADROOM; above it memory is scarce
CHECKED_PARTICLES = 50_000  # largest number of particles in the comparison with PyTorch, which needs memory


def first_capacities(cells: Sequence[int], particles: int) -> tuple[int, ...]:
    """Returns capacities for a scene that starts with `cells` on each level. Few simulations need more later."""
    capacities = []
    for level, count in enumerate(cells):
        spread = SPREAD_CELLS[min(level, len(SPREAD_CELLS) - 1)] * particles
        roomy = min(HEADROOM * count, spread, ROOMY_CELLS >> 2 * level)
        capacities.append(max(256 >> level, _grown(count, level, TIGHT_START), int(roomy)))
    return tuple(capacities)


def crowded(position_N3: torch.Tensor, scene_N: torch.Tensor, cell_size: float) -> bool:
    """Returns whether more than 5 % of the particles are in crowded cells, where float16 sums lose small terms."""
    cell_N3 = torch.floor(position_N3 / cell_size).long()
    inside_N = (cell_N3.abs() < COORDINATE_LIMIT).all(-1)
    key_N = pack(scene_N[inside_N].long(), cell_N3[inside_N])
    _, count_C = torch.unique(key_N, return_counts=True)
    return 20 * int(count_C[count_C > CROWDED].sum()) > len(position_N3)


def _grown(count: int, level: int, tight: float) -> int:
    """Returns GROWTH times the count. Counts above ROOMY_CELLS get less, but at least `tight` times the count."""
    return max(int(tight * count), int(GROWTH * min(count, ROOMY_CELLS >> 2 * level)))


def _own_physics(config: NetworkConfig, state: ParticleState) -> tuple[str, ...]:
    """Returns the parts of own physics that a state has: friction of any surface, parameters of any particle, elastic
    bodies. Columns of elastic bodies follow those of parameters, so they need both."""
    there = {"friction": has_friction(state), "elastic": state.rest is not None}
    there["parameters"] = there["elastic"] or state.parameter_NP is not None
    return tuple(name for name in config.own_physics if there.get(name))


@dataclass(frozen=True, eq=False)
class _LaunchedBlock:
    """Launched frames: their number, the index of the first one, and `frame` and `status` after the last one."""

    frames: int
    first: int
    seen: torch.Tensor  # int32 [2] on the host, valid after `end`
    end: torch.cuda.Event | None


class TritonStepper:
    """Computes frames on one device. Without CUDA the same launches run one by one in Triton's interpreter."""

    live: int  # number of particles of the state; buffers may have more rows

    def __init__(
        self,
        network: HierarchicalGraphNetwork,
        state: ParticleState,
        precision: str,
        capacities: tuple[int, ...] | None = None,
        capacity: int = 0,
        obstacles: SceneTable | None = None,
        barriers: SceneTable | None = None,
        step: StepConfig | None = None,
    ) -> None:
        """`capacities` are the numbers of cells on each level for which buffers are allocated at first.

        Buffers have at least `capacity` rows. `obstacles` and `barriers` replace the state's, and `step` the network's.
        """
        self.config, self.device = network.config, state.position_N3.device
        self.step_config, self.origin_range = network.step if step is None else step, network.origin_range
        self.precision = kernel_precision(precision, self.device)
        self.packed = pack_network(network)
        self.values = self.packed.gather(list(network.parameters()))
        self.particles = max(capacity, len(state.position_N3))
        self.scenes = state.scene_count

        self.own_physics = _own_physics(self.config, state)
        self.buffers = DeviceParticles.empty(
            self.particles, self.scenes, self.config.velocity_history, self.device, own_physics=self.own_physics
        )
        if network.images:
            near, far = network.step.wall_clearance or (0.0, 0.0)
            same = self.buffers
            copies = map(torch.zeros_like, (same.domain_S3, same.gravity_S3, same.position_N3, same.velocity_NV))
            self.buffers = replace(same, image=DeviceImage(near - far, *copies))
        self.lost, self.frame = (torch.zeros(1, dtype=torch.int32, device=self.device) for _ in range(2))
        self.obstacles = obstacles
        if obstacles is None and state.obstacles is not None:
            self.obstacles = self._obstacle_table(state)
        self.barriers = None
        if self.step_config.obstacle_clearance is not None:
            self.barriers = barriers or SceneTable.of_barriers(state.barriers, self.scenes, self.device)
        self.moving: MovingTable | None = None
        affordable = PATH_BYTES // (2 * 3 * 4 * max(1, self.particles))
        self.block_frames = max(FEWEST_FRAMES, min(BLOCK_FRAMES, affordable))
        self.path_TN3 = torch.zeros(2 * self.block_frames, self.particles, 3, device=self.device)
        self.overlap = self.device.type == "cuda"  # the next block starts before the results of this one are fetched
        normaliser = network.normaliser
        mean_3, std_3 = normaliser.feature_scale(self.config.relative)
        self.scale = (mean_3.float(), std_3.float())
        self.mean, self.std = normaliser.acceleration_mean.float(), normaliser.acceleration_std.float()
        self.growths = 0
        self.half_sums = Tuning.of(self.precision).half_sums and not self._crowded(state)
        if state.moving is not None:
            instants = len(self.path_TN3) + 1  # an instant for each row of the path, and one for the frame after it
            layers, size = state.moving.layers, state.moving.cell_size
            self.moving = MovingTable(self.frame, instants, self.scenes, layers=layers, cell_size=size)
        self._fill(state)
        self._build(capacities or self._first_capacities())

    def fits(self, state: ParticleState) -> bool:
        """Returns whether `begin` can continue from a state.

        The state must have the same domains, obstacle cell size and own physics, and at most as many particles as the
        buffers have rows. A crowded state also needs a stepper that was built for float32 sums.
        """
        if state.scene_count != self.scenes or len(state.position_N3) > self.particles:
            return False
        if self.own_physics != _own_physics(self.config, state) or (self.half_sums and self._crowded(state)):
            return False
        if not self.fits_moving(state.moving):
            return False
        new, old = state.obstacles, self.obstacles
        same = new is old is None or (new is not None and old is not None and new.cell_size == old.cell_size)
        return same and torch.equal(state.domain_S3, self.buffers.domain_S3)

    def begin(self, state: ParticleState, new_obstacles: bool = False) -> None:
        """Continues from another state that `fits`.

        By default obstacles are those of `self.obstacles` and `self.barriers`, which the caller may change. With
        `new_obstacles` they are those of the state.
        """
        if new_obstacles and self.barriers is not None and not self.barriers.is_of(state.barriers):
            self.barriers.take(SceneTable.of_barriers(state.barriers, self.scenes, self.device))
        if new_obstacles and self.obstacles is not None and not self.obstacles.is_of(state.obstacles):
            self.obstacles.take(self._obstacle_table(state))
        self._fill(state)
        self.lost.zero_()
        self.grid.status.zero_()

    def take(self, state: ParticleState) -> bool:
        """Continues from another state and its obstacles, if it `fits`."""
        if not self.fits(state):
            return False
        self.begin(state, new_obstacles=True)
        return True

    def keep(self, kept_N: torch.Tensor) -> None:
        """Removes particles after a divergence. Cells, obstacles and launches stay."""
        names = ("position_N3", "velocity_NV", "scene_N", "material_N", "parameter_NP")
        buffers = [buffer for name in names if (buffer := getattr(self.buffers, name)) is not None]
        remaining = [buffer[: self.live][kept_N] for buffer in buffers]
        if (rest_NR := self.buffers.rest_NR) is not None:
            shape = RestShape.unpacked(rest_NR[: self.live], self.buffers.position_N3[: self.live])[kept_N]
            rest_NR[: len(shape.packed)].copy_(shape.packed)
        self.live = len(remaining[0])
        for buffer, value in zip(buffers, remaining, strict=True):
            buffer[: self.live].copy_(value)
        self.buffers.count.fill_(self.live)
        self.lost.zero_()
        self.grid.status.zero_()

    def motion(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns copies of positions [N, 3] and velocity histories [N, M, 3] after the last block."""
        position_N3, velocity_NV = self.buffers.position_N3[: self.live], self.buffers.velocity_NV[: self.live]
        return position_N3.clone(), velocity_NV.clone().view(self.live, -1, 3)

    def _fill(self, state: ParticleState) -> None:
        count = self.live = len(state.position_N3)
        assert count <= self.particles and state.scene_count == self.scenes
        buffers = self.buffers
        buffers.count.fill_(count)
        buffers.position_N3[:count].copy_(state.position_N3)
        buffers.velocity_NV[:count].copy_(state.velocity_NM3.flatten(1))
        buffers.scene_N[:count].copy_(state.scene_N)
        buffers.material_N[:count].copy_(state.material_N)
        buffers.domain_S3.copy_(state.domain_S3)
        buffers.frame_S.copy_(state.frame_S)
        # those of later frames are written by the last kernel of a frame
        buffers.origin_S3.copy_(frame_origin(state.frame_S, self.origin_range, self.config.dimensions))
        if self.config.relative:
            buffers.gravity_S3.copy_(state.gravity_S3)
        if buffers.image is not None:
            sign_S3 = Image.of(state, UNCONSTRAINED, self.config.dimensions).sign_S3
            buffers.image.sign_S3.copy_(sign_S3)
            buffers.image.gravity_S3.copy_(sign_S3 * state.gravity_S3)
        if buffers.wall_friction_S3 is not None:
            friction_S3 = state.wall_friction_S3
            buffers.wall_friction_S3.copy_(torch.zeros_like(state.domain_S3) if friction_S3 is None else friction_S3)
        if buffers.parameter_NP is not None and "parameters" in self.own_physics:
            columns_NP = buffers.parameter_NP[:count, : len(INPUT_PARAMETERS)]
            columns_NP.zero_() if state.parameter_NP is None else columns_NP.copy_(state.parameter_NP)
        if buffers.rest_NR is not None and state.rest is not None:
            buffers.rest_NR[:count].copy_(state.rest.packed)
        self._moving, self._passed = state.moving, 0  # _passed: number of frames since `_moving`
        if self.moving is not None:
            self.moving.take(state.moving, "friction" in self.own_physics)
            self.frame.zero_()  # the instant of the present frame
            self._set_poses(0, 1)

    def fits_moving(self, moving: MovingObstacles | None) -> bool:
        """Returns whether there are records for moving obstacles."""
        return moving is None or (self.moving is not None and self.moving.fits(moving))

    def _set_poses(self, first: int, frames: int, ahead: int = 0) -> None:
        """Writes the poses of the next frames, or of those after `ahead` frames, to instants from `first` on."""
        if self.moving is not None and self._moving is not None:
            own, begin = self._moving, self._passed + ahead
            at = [frame + begin + i for i in range(frames) for frame in own.frames]
            self.moving.set_poses(first, own.scenes * frames, at, own.frame_s)

    def _obstacle_table(self, state: ParticleState) -> SceneTable:
        assert state.obstacles is not None
        return SceneTable.of_obstacles(state.obstacles, state.scene_count, "friction" in self.own_physics)

    def _crowded(self, state: ParticleState) -> bool:
        nowhere = state.position_N3.device.type == "meta"  # kernels are compiled ahead with empty tensors
        return not nowhere and crowded(state.position_N3, state.scene_N, self.config.cell_size)

    def use_values(self, values: torch.Tensor) -> None:
        """Replaces the parameters by `values` in the packed layout."""
        self.values.copy_(values)
        self.fused.refresh()

    def _first_capacities(self) -> tuple[int, ...]:
        position_N3, scene_N = self.buffers.position_N3[: self.live], self.buffers.scene_N[: self.live].long()
        cell_size, levels, bodies = self.config.cell_size, self.config.levels, self.config.body_cells
        origin_S3 = self.buffers.origin_S3
        grid = build_hierarchy(position_N3, scene_N, origin_S3, cell_size, levels=levels, bodies=bodies)
        return first_capacities([level.cell_count for level in grid.levels], self.live)

    def _cell_box(self) -> CellBox:
        position_N3 = self.buffers.position_N3[: self.live]
        if (image := self.buffers.image) is not None:
            scene_N = self.buffers.scene_N[: self.live].long()
            position_N3 = torch.cat([position_N3, self.buffers.domain_S3[scene_N] + image.wall_shift - position_N3])
        ends = torch.stack([position_N3.amin(0), position_N3.amax(0)]).cpu()
        size = self.buffers.domain_S3.amax(0).cpu()
        lower, upper = torch.minimum(ends[0], torch.zeros(3)), torch.maximum(ends[1], size)
        config = self.config
        return CellBox.around(lower.tolist(), upper.tolist(), config.cell_size, config.levels)

    def _build(self, capacities: tuple[int, ...]) -> None:
        config, box = self.config, self._cell_box()
        self.graph = None
        # No level can have more than eight cells for each particle, or more than the box contains, unless bodies
        # divide its cells.
        limits = [8 * self.particles] * config.levels
        for level in range(1 if config.body_cells else config.levels):
            limits[level] = min(limits[level], self.scenes * math.prod(n >> level for n in box.cells))
        rounded = tuple(16 * math.ceil(max(1, min(c, m)) / 16) for c, m in zip(capacities, limits, strict=True))
        more = rest_numbers(self.step_config, box, self.scenes, config.levels)
        self.grid = DeviceGrid(
            config, box, rounded, scenes=self.scenes, particles=self.particles, device=self.device, more=more
        )
        self.step = DeviceStep(self.step_config, self.grid, self.barriers, self.origin_range)
        tuning = replace(Tuning.of(self.precision), half_sums=self.half_sums)
        count, precision = self.buffers.count, self.precision
        self.fused = FusedNetwork(
            self.packed, self.values, self.grid, particle_count=count, precision=precision, tuning=tuning
        )
        if self.device.type == "cuda":
            self.graph = self._capture()

    def sum_in_float32(self) -> None:
        """Builds the launches of fp16 again, with sums of particles in float32. Call it before the first frame."""
        self.half_sums = False
        self._build(self.grid.capacities)

    def _capture(self) -> torch.cuda.CUDAGraph:
        """Captures the launches of a frame. Kernels that the process has not used are compiled in parallel before."""
        with noted_launches() as launches:
            self._warm_up()
        compile_launches(launches.values(), available_cpus())
        return captured([self.frame_launches], self._warm_up)[0]

    def _warm_up(self) -> None:
        """Makes the launches without moving a particle: a non-zero status disables the integration."""
        self._network_pass()
        self.grid.status.fill_(OVERFLOW)
        self._integrate()
        self.grid.status.zero_()

    def require_parity(self, network: HierarchicalGraphNetwork, state: ParticleState, section: str = "") -> None:
        """Compares the first output, and the constraint at moving obstacles, with PyTorch's, before the first frame.

        If float16 sums fail, it sums in float32. `state` is the initial state, or its first scenes. `section` contains
        the precision. Raises: ParityError.
        """
        try:
            self._require_parity(network, state, section)
        except ParityError:
            if not self.half_sums:
                raise
            self.sum_in_float32()
            self._require_parity(network, state, section)

    def _require_parity(self, network: HierarchicalGraphNetwork, state: ParticleState, section: str) -> None:
        if self.graph is None:
            self._network_pass()
        output_N3 = self.fused.output[: len(state.position_N3), :3]
        if self.buffers.image is not None:
            output_N3 = self.buffers.image.sign_S3[state.scene_N.long()] * output_N3
        with torch.no_grad():
            expected_N3 = rested(network, state, network.prediction(state), self.step_config)
            require_parity(output_N3, expected_N3, OUTPUTS, self.precision, section=section)
            if self.moving is not None and self._moving is not None and self._moving.barriers is not None:
                require_moving_parity(
                    self._moving, self.moving, self.buffers.domain_S3, grid=self.grid, step=self.step_config,
                    precision=self.precision, section=section,
                )  # fmt: skip

    def frame_launches(self) -> None:
        """Makes all launches of one frame. The CUDA graph records them."""
        self._network_pass()
        self._integrate()

    def _network_pass(self) -> None:
        self.grid.build(self.buffers)
        self.grid.prepare(self.buffers, self.scale, self.obstacles, moving=self.moving)
        self.fused.forward()
        self.step.rest(self.fused.output, self.buffers, self.scale[1])

    def _integrate(self) -> None:
        self.step.integrate(
            self.fused.output, self.buffers, (self.mean, self.std), lost=self.lost, frame=self.frame,
            path_TN3=self.path_TN3, moving=self.moving,
        )  # fmt: skip

    def blocks(self, frames: int) -> Iterator[tuple[torch.Tensor, bool]]:
        """Yields blocks of up to `block_frames` frames. While a block is processed, the device computes the next one.

        Raises: torch.OutOfMemoryError if buffers cannot grow. A later call continues from the last completed frame.
        """
        done, half = 0, 0
        ahead: _LaunchedBlock | None = None
        while done < frames:
            block = ahead or self._launch(min(self.block_frames, frames - done), half)
            remaining, half = frames - done - block.frames, 1 - half
            # If this block ends with a non-zero status, these launches change nothing.
            ahead = None
            if self.overlap and remaining:
                ahead = self._launch(min(self.block_frames, remaining), half, block.frames)
            path_TN3, status = self._finish(block)
            done += len(path_TN3)
            self._passed += len(path_TN3)
            if status and ahead is not None:
                self._finish(ahead)  # its launches use the buffers that may grow now
                ahead = None
            lost = bool(status & DIVERGED)
            yield path_TN3, lost
            if lost:
                return
            if status & (OVERFLOW | OUT_OF_BOX):
                self._grow()

    def _launch(self, frames: int, half: int, ahead: int = 0) -> _LaunchedBlock:
        """Starts some frames, after `ahead` frames in progress. Their positions are written to one half of the path."""
        first = half * self.block_frames
        self._set_poses(first, frames, ahead)
        self.frame.fill_(first)
        for _ in range(frames):
            if self.graph is None:
                self.frame_launches()
            else:
                self.graph.replay()
        seen = torch.cat([self.frame, self.grid.status])
        if self.device.type != "cuda":
            return _LaunchedBlock(frames, first, seen, None)
        seen = torch.empty(2, dtype=seen.dtype, pin_memory=True).copy_(seen, non_blocking=True)
        end = torch.cuda.Event()
        end.record()
        return _LaunchedBlock(frames, first, seen, end)

    def _finish(self, block: _LaunchedBlock) -> tuple[torch.Tensor, int]:
        """Waits for started frames. Returns the positions of the completed frames and the status after them."""
        if block.end is not None:
            block.end.synchronize()
        last, status = block.seen.tolist()
        taken = last - block.first
        start = 3 * block.first * self.live
        return self.path_TN3.view(-1)[start : start + 3 * taken * self.live].view(taken, self.live, 3), status

    def _grow(self) -> None:
        # all levels grow, because levels that did not overflow are nearly full and would soon require another capture
        before, needed = self.grid.capacities, self.grid.needed_L.tolist()
        pairs = zip(before, needed, strict=True)
        capacities = tuple(max(c, _grown(n, i, TIGHT_GROWTH)) for i, (c, n) in enumerate(pairs))
        self.growths += 1
        # Free the old buffers first, so that memory need not contain both; particles are stored elsewhere.
        self.graph = None
        del self.fused, self.grid, self.step
        try:
            self._build(capacities)
            return
        except torch.OutOfMemoryError as error:
            reason = str(error)  # the error object would keep the partial allocation
        self._build(before)
        raise torch.OutOfMemoryError(reason)
