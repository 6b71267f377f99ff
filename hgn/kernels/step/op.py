"""The frame behind the network's output on the device: tables of obstacles, buffers and launches of the kernels.

Shape legend: N particles, S scenes, K middles of cells; B buckets, Q cells, E entries of their lists, F triangles of an
obstacle table.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import triton

from hgn.config import NetworkConfig
from hgn.kernels.buffers import OUT
from hgn.kernels.grid.op import PARTICLE_BLOCK, SUMS, DeviceGrid, Window
from hgn.kernels.step import kernel
from hgn.kernels.triton_compat import overlaps
from hgn.network.barriers import Barriers
from hgn.network.cell_keys import in_buckets, unpack
from hgn.scene.barrier import Barrier
from hgn.step.reference import LEAST_CREASE, LEVEL_SHIFT, REST_SIZES, SLACK, SURFACES, rests_widely
from hgn.step_config import StepConfig

BARRIER_COLUMNS, RATES = kernel.BARRIER_COLUMNS.value, kernel.RATES.value
DIVERGED = kernel.DIVERGED.value
REST_SUMS = (SUMS, RATES)  # columns of the sums of a `RestLevel`
INTEGRATE_BLOCK = 64  # particles


@dataclass(frozen=True, eq=False)
class DeviceParticles:
    """The particles of all scenes, padded to the size of the buffers, and their scenes."""

    position_N3: torch.Tensor
    velocity_NV: torch.Tensor
    scene_N: torch.Tensor  # int32
    material_N: torch.Tensor  # int32
    domain_S3: torch.Tensor
    gravity_S3: torch.Tensor
    count: torch.Tensor  # int32 [1]


@dataclass(frozen=True, eq=False)
class RestLevel:
    """Rest between cells of one size: sums of bodies and displacements, and of slow ones, [K, columns]; the table of
    subtracted motions; of each particle the lowest of its middles, the place from there, the gate and the slow part of
    its deformation.
    """

    bodies: torch.Tensor
    sums: torch.Tensor
    table: torch.Tensor  # [K, RATES]
    base_N: torch.Tensor  # int32
    spot_N3: torch.Tensor
    gate_N: torch.Tensor
    slow_N3: torch.Tensor

    @staticmethod
    def of(grid: DeviceGrid, cleared: Sequence[torch.Tensor]) -> RestLevel:
        """With sums that the grid clears when it is built."""
        particles, device = grid.particles, grid.feature_NF.device
        bodies, sums = (part.view(torch.float32) for part in cleared)
        spot_N3, slow_N3 = (torch.zeros(particles, 3, device=device) for _ in range(2))
        base_N, gate_N = torch.zeros(particles, dtype=torch.int32, device=device), torch.zeros(particles, device=device)
        table = torch.zeros(len(bodies) // SUMS, RATES, device=device)
        return RestLevel(bodies, sums, table, base_N, spot_N3, gate_N, slow_N3)


def rest_numbers(step: StepConfig, window: Window, scenes: int, levels: int) -> tuple[int, ...]:
    """Returns the sizes of the sums that rest needs cleared: with rest, one slot a coarsest cell for each size."""
    middles = scenes * math.prod((n >> levels - 1) + 2 for n in window.cells)
    return tuple(columns * middles for columns in REST_SUMS * REST_SIZES * step.rests)


class DeviceStep:
    """The launches of one network's frames behind its output."""

    def __init__(
        self, step: StepConfig, config: NetworkConfig, grid: DeviceGrid, barriers: BarrierTable | None
    ) -> None:
        """`barriers` are given with `step.obstacle_clearance`."""
        self.step, self.config, self.grid, self.barriers = step, config, grid, barriers
        each = len(REST_SUMS)
        parts = [grid.more_cleared[each * level :][:each] for level in range(REST_SIZES * step.rests)]
        self._levels = [RestLevel.of(grid, cleared) for cleared in parts]
        widely = rests_widely(config.materials)
        # bits of the materials that rest between larger cells; -1: all do
        self._widely = -1 if all(widely) else sum(rests << material for material, rests in enumerate(widely))

    def rest(self, output: torch.Tensor, particles: DeviceParticles, std_3: torch.Tensor) -> None:
        """Takes slow deformations out of columns 0 to 2 of the network's output [N, OUT], in place."""
        grid, overlap, blocks = self.grid, overlaps(), (triton.cdiv(self.grid.particles, PARTICLE_BLOCK),)
        sizes: dict[str, Any] = {"OVERLAP": overlap, "BLOCK": PARTICLE_BLOCK, "launch_pdl": overlap}
        moving = {"velocity": particles.velocity_NV, "scale": std_3, "HISTORY": self.config.velocity_history}
        for level, own in enumerate(self._levels):
            pairs: dict[str, Any] = {"base_of": own.base_N, "gate_of": own.gate_N, "spot_of": own.spot_N3}
            pairs |= {"x": output, "geometry": grid.geometry, "particle_count": particles.count}
            pairs |= {"OUT": output.shape[1], "LEVELS": grid.levels}
            find = kernel.find_deformation[(triton.cdiv(len(own.table), PARTICLE_BLOCK),)]
            tables = {"bodies": own.bodies, "table": own.table, "count": len(own.table), "BODIES": SUMS}
            kernel.sum_displacements[blocks](
                **pairs, **moving, **sizes, coarsest_of=grid.coarsest_N8, share_of=grid.share_N8,
                place_of=grid.place_N3, felt=grid.felt_C2, slot_of_cell=grid.slot_of_cell, low=grid.low,
                sums=own.bodies, SHIFT=level * LEVEL_SHIFT, material_of=particles.material_N,
                RESTING=self._widely if level else -1, COLUMNS=SUMS,
            )  # fmt: skip
            find(**tables, **sizes, sums=own.bodies, AT=10, COLUMNS=SUMS)
            kernel.slow_displacements[blocks](
                **pairs, **moving, **sizes, scene_of=particles.scene_N, gravity=particles.gravity_S3,
                threshold=self.step.rest_threshold, slow=own.slow_N3, table=own.table, sums=own.sums,
            )  # fmt: skip
            find(**tables, **sizes, sums=own.sums, AT=0, COLUMNS=RATES)
            kernel.stop_slow[blocks](**pairs, **sizes, slow=own.slow_N3, table=own.table)

    def integrate(
        self,
        output: torch.Tensor,
        particles: DeviceParticles,
        normaliser: tuple[torch.Tensor, torch.Tensor],
        lost: torch.Tensor,
        frame: torch.Tensor,
        path_TN3: torch.Tensor,
    ) -> None:
        """Moves the particles by a rested output between walls and outside obstacles; `normaliser` is mean and standard
        deviation of accelerations. Counts the frame."""
        step, config, status, overlap = self.step, self.config, self.grid.status, overlaps()
        near, far = step.wall_clearance or (0.0, 0.0)
        clearance = step.obstacle_clearance or 0.0
        kernel.integrate[(triton.cdiv(self.grid.particles, INTEGRATE_BLOCK),)](
            output=output, position=particles.position_N3, velocity=particles.velocity_NV,
            scene_of=particles.scene_N, domain=particles.domain_S3, gravity=particles.gravity_S3,
            mean=normaliser[0], std=normaliser[1], particle_count=particles.count, status=status, lost=lost,
            frame=frame, path=path_TN3, near=near, far=far,
            barrier_table=particles.count if self.barriers is None else self.barriers.row_S7,
            within=(1 - SLACK) * clearance, slack=SLACK * clearance, least_crease=LEAST_CREASE, OUT=OUT,
            HISTORY=config.velocity_history, COLUMNS=1 << (3 * config.velocity_history - 1).bit_length(),
            WALLED_AXES=0 if step.wall_clearance is None else config.dimensions,
            SURFACES=0 if self.barriers is None else SURFACES, OVERLAP=overlap, BLOCK=INTEGRATE_BLOCK,
            launch_pdl=overlap,
        )  # fmt: skip
        kernel.advance[(1,)](status=status, lost=lost, frame=frame, OVERLAP=overlap, num_warps=1, launch_pdl=overlap)


@dataclass(frozen=True, eq=False)
class BarrierHash:
    """One scene's barrier, its cells in hash buckets."""

    bucket_B: torch.Tensor  # int32
    key_Q: torch.Tensor  # int64
    span_Q2: torch.Tensor  # int32: where a cell's list begins and ends
    triangle_E: torch.Tensor  # int32
    row_F24: torch.Tensor  # float32, as in hgn.scene.barrier
    cell_size: float

    @staticmethod
    def of(barrier: Barrier) -> BarrierHash | None:
        """Of a scene's barrier; none where nothing is in it."""
        if not len(barrier.row_F24):
            return None
        lists = (barrier.cell_Q3, barrier.start_Q, barrier.triangle_E, barrier.row_F24)
        return BarrierHash._of([torch.from_numpy(part) for part in lists], barrier.cell_size)

    @staticmethod
    def _of(lists: Sequence[torch.Tensor], cell_size: float) -> BarrierHash:
        cell_Q3, start_Q, triangle_E, row_F24 = lists
        bucket_B, key_Q, order_Q = in_buckets(cell_Q3)
        span_Q2 = torch.stack([start_Q[:-1], start_Q[1:]], dim=1)[order_Q].int().contiguous()
        return BarrierHash(bucket_B, key_Q, span_Q2, triangle_E.int(), row_F24.float().contiguous(), cell_size)

    def to(self, device: torch.device) -> BarrierHash:
        names = ("bucket_B", "key_Q", "span_Q2", "triangle_E", "row_F24")
        moved: dict[str, Any] = {name: getattr(self, name).to(device) for name in names}
        return replace(self, **moved)

    def row(self) -> list[int]:
        """This scene's row of a barrier table; valid as long as this object lives."""
        pointers = [tensor.data_ptr() for tensor in (self.bucket_B, self.key_Q, self.span_Q2)]
        lists = [tensor.data_ptr() for tensor in (self.triangle_E, self.row_F24)]
        return [*pointers, len(self.bucket_B) - 2, *lists, int(np.float32(self.cell_size).view(np.int32))]


class BarrierTable:
    """The barriers of the scenes of a batch, for the kernels; its rows may be rewritten on the device."""

    def __init__(self, hashes: Sequence[BarrierHash | None], device: torch.device) -> None:
        self._hashes = [entry.to(device) if entry is not None else None for entry in hashes]
        rows = [entry.row() if entry is not None else [0] * BARRIER_COLUMNS for entry in self._hashes]
        self.row_S7 = torch.tensor(rows, dtype=torch.int64, device=device)
        self._barriers: Barriers | None = None  # that it was made of, unless of hashes

    def is_of(self, barriers: Barriers | None) -> bool:
        """Whether it was made of this very object; never of none, for which a table takes no time."""
        return barriers is not None and self._barriers is barriers

    def take(self, other: BarrierTable) -> None:
        """Makes its rows those of another table, in place."""
        self.row_S7.copy_(other.row_S7)
        self._hashes, self._barriers = other._hashes, other._barriers

    @staticmethod
    def of(barriers: Barriers | None, scenes: int, device: torch.device) -> BarrierTable:
        """Of a batch's barriers, on their device; without any, of scenes that have none."""
        if barriers is None:
            return BarrierTable([None] * scenes, device)
        scene_Q, cell_Q3 = unpack(barriers.key_Q)
        cells = torch.bincount(scene_Q, minlength=scenes).tolist()
        triangles = torch.bincount(barriers.scene_F, minlength=scenes).tolist()
        first_cell, first_triangle = np.cumsum([0, *cells]).tolist(), np.cumsum([0, *triangles]).tolist()
        first_entry = barriers.start_Q[first_cell].tolist()
        hashes: list[BarrierHash | None] = []
        for scene in range(scenes):
            (q, q_end), (e, e_end), (f, f_end) = (
                first[scene : scene + 2] for first in (first_cell, first_entry, first_triangle)
            )
            start_Q, triangle_E = barriers.start_Q[q : q_end + 1] - e, barriers.triangle_E[e:e_end] - f
            lists = cell_Q3[q:q_end], start_Q, triangle_E, barriers.row_F24[f:f_end]
            hashes.append(BarrierHash._of(lists, barriers.cell_size) if triangles[scene] else None)
        table = BarrierTable(hashes, barriers.key_Q.device)
        table._barriers = barriers
        return table
