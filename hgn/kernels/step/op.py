"""Holds the buffers and makes the launches of the part of a frame that follows the network's output.

Shape legend: N particles, S scenes, K middles of cells.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import triton

from hgn.kernels.buffers import OUT
from hgn.kernels.grid.op import PARTICLE_BLOCK, SUMS, CellBox, DeviceGrid, DeviceParticles
from hgn.kernels.moving import MovingTable, arguments_of
from hgn.kernels.scene_tables import SceneTable
from hgn.kernels.step import kernel
from hgn.kernels.triton_compat import overlaps
from hgn.network.images import IMAGES
from hgn.step.reference import LEAST_CREASE, LEVEL_SHIFT, REST_SIZES, SLACK, SURFACES, rests_widely
from hgn.step_config import StepConfig

RATES = kernel.RATES.value
DIVERGED = kernel.DIVERGED.value
REST_SUMS = (SUMS, RATES)  # columns of the sums of a `RestLevel`
INTEGRATE_BLOCK = 64  # particles of a program


@dataclass(frozen=True, eq=False)
class RestLevel:
    """Holds the buffers of rest on cells of one size. `bodies` are the sums of bodies and displacements, `sums` those
    of slow deformations, both [K, columns]. The table has the subtracted motions. Each particle has the lowest of its
    middles, its place from that middle, its gate and its slow deformation."""

    bodies: torch.Tensor
    sums: torch.Tensor
    table: torch.Tensor  # [K, RATES]
    base_N: torch.Tensor  # int32
    spot_N3: torch.Tensor
    gate_N: torch.Tensor
    slow_N3: torch.Tensor

    @staticmethod
    def of(grid: DeviceGrid, cleared: Sequence[torch.Tensor]) -> "RestLevel":
        """Returns a level whose sums the grid clears when it is built."""
        particles, device = grid.particles, grid.feature_NF.device
        bodies, sums = (part.view(torch.float32) for part in cleared)
        spot_N3, slow_N3 = (torch.zeros(particles, 3, device=device) for _ in range(2))
        base_N, gate_N = torch.zeros(particles, dtype=torch.int32, device=device), torch.zeros(particles, device=device)
        table = torch.zeros(len(bodies) // SUMS, RATES, device=device)
        return RestLevel(bodies, sums, table, base_N, spot_N3, gate_N, slow_N3)


def rest_numbers(step: StepConfig, box: CellBox, scenes: int, levels: int) -> tuple[int, ...]:
    """Returns the sizes of the sums of rest, which the grid clears. All cell sizes have the coarsest cells' slots."""
    middles = scenes * math.prod((n >> levels - 1) + 2 for n in box.cells)
    return tuple(columns * middles for columns in REST_SUMS * REST_SIZES * step.rests)


class DeviceStep:
    """Launches the part of a frame that follows the network's output."""

    def __init__(self, step: StepConfig, grid: DeviceGrid, barriers: SceneTable | None, origin_range: float) -> None:
        """Takes `barriers` if `step.obstacle_clearance` is set. `origin_range` is that of the network."""
        self.origin_range = origin_range
        self.step, self.config, self.grid, self.barriers = step, grid.config, grid, barriers
        each = len(REST_SUMS)
        parts = [grid.more_cleared[each * level :][:each] for level in range(REST_SIZES * step.rests)]
        self._levels = [RestLevel.of(grid, cleared) for cleared in parts]
        widely = rests_widely(grid.config.materials)
        # These are bits of the materials that rest on the larger cells too; -1 has all bits.
        self._widely = -1 if all(widely) else sum(rests << material for material, rests in enumerate(widely))

    def rest(self, output: torch.Tensor, particles: DeviceParticles, std_3: torch.Tensor) -> None:
        """Subtracts slow deformations from columns 0 to 2 of the network's output [N, OUT]."""
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
                **pairs, **moving, **sizes, coarsest_of=grid.coarsest_N8, cell_weight_of=grid.cell_weight_N8,
                place_of=grid.place_N3, spread=grid.spread_C2, slot_of_cell=grid.slot_of_cell, low=grid.low,
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
        moving: MovingTable | None = None,
    ) -> None:
        """Moves particles by the result of `rest`, stops them at walls and obstacles, and increments the frames.
        `normaliser` is the mean and standard deviation of accelerations."""
        step, config, status, overlap = self.step, self.config, self.grid.status, overlaps()
        image, gravity_S3 = particles.image, particles.gravity_S3
        sign_S3 = gravity_S3 if image is None else image.sign_S3
        near, far = step.wall_clearance or (0.0, 0.0)
        clearance = step.obstacle_clearance or 0.0
        kernel.integrate[(triton.cdiv(self.grid.particles, INTEGRATE_BLOCK),)](
            output=output, position=particles.position_N3, velocity=particles.velocity_NV,
            scene_of=particles.scene_N, domain=particles.domain_S3, gravity=particles.gravity_S3,
            mean=normaliser[0], std=normaliser[1], particle_count=particles.count, status=status, lost=lost,
            frame=frame, path=path_TN3, near=near, far=far,
            barrier_table=particles.count if self.barriers is None else self.barriers.row_SC,
            within=(1 - SLACK) * clearance, slack=SLACK * clearance, least_crease=LEAST_CREASE, OUT=OUT,
            HISTORY=config.velocity_history, COLUMNS=1 << (3 * config.velocity_history - 1).bit_length(),
            WALLED_AXES=0 if step.wall_clearance is None else config.dimensions,
            SURFACES=0 if self.barriers is None else SURFACES, **arguments_of(moving, particles.count),
            MOVING=0 if moving is None or self.barriers is None else moving.layers, sign=sign_S3,
            IMAGE=image is not None, OVERLAP=overlap, BLOCK=INTEGRATE_BLOCK, launch_pdl=overlap,
        )  # fmt: skip
        kernel.advance[(1,)](
            status=status, lost=lost, frame=frame, frame_of=particles.frame_S, origin=particles.origin_S3,
            scenes=len(particles.frame_S), origin_range=self.origin_range, sign=sign_S3, gravity=gravity_S3,
            image_gravity=(image or particles).gravity_S3, DIMENSIONS=config.dimensions,
            IMAGES=0 if image is None else len(IMAGES), OVERLAP=overlap, num_warps=1, launch_pdl=overlap,
        )  # fmt: skip
