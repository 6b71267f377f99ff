"""Holds the grid on the device: capacities and buffers, and the launches of the grid kernels.

Shape legend: N particles, C cells of a level, S scenes, L levels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import triton

from hgn.config import MATERIAL_EMBEDDING, NetworkConfig
from hgn.kernels.coarsest import kernel as coarsest_kernel
from hgn.kernels.features import kernel as feature_kernel
from hgn.kernels.grid import bodies, kernel, slots
from hgn.kernels.moving import MovingTable, arguments_of
from hgn.kernels.scene_tables import SceneTable
from hgn.kernels.triton_compat import interpreting, overlaps
from hgn.network import elastic
from hgn.network.cell_keys import SCENE_LIMIT
from hgn.network.features import WALL_DISTANCE_CELLS
from hgn.network.own_physics import physics_widths
from hgn.network.relative import CONTACT_REACH_CELLS, FEW, OUTPUTS, QUIET, RARE
from hgn.scene.material import INPUT_PARAMETERS
from hgn.scene.surface_field import REACH_CELLS

MARK_BLOCK = 128
PARTICLE_BLOCK = 32
FILL_BLOCK = 4096 if interpreting() else 512  # slots of a program; the interpreter needs few programs
SUMS = 16  # number of columns of the coarsest cells' sums, and of the decoder's padded output
MARGIN_CELLS = 4  # margin of a cell box around the corners that it must contain
UNITE_BLOCK = FILL_BLOCK // 4  # slots of a program with eight corners each
NUMBER_BLOCK = 4096  # entries of a program
OVERFLOW, OUT_OF_BOX = slots.OVERFLOW.value, slots.OUT_OF_BOX.value


@dataclass(frozen=True)
class CellBox:
    """Names the cells of the finest level that exist in every scene: `low` to `low + cells - 1` on each axis.

    Both are multiples of 2^(levels - 1), so that a parent lies inside or outside the box as a whole.
    """

    low: tuple[int, int, int]
    cells: tuple[int, int, int]

    @staticmethod
    def around(
        lower_3: Sequence[float], upper_3: Sequence[float], cell_size: float, levels: int, margin: int = MARGIN_CELLS
    ) -> CellBox:
        """Returns the box of all cells within `margin` cells of two corners in domain units."""
        unit = 1 << (levels - 1)
        low, cells = [], []
        for lower, upper in zip(lower_3, upper_3, strict=True):
            first = math.floor((math.floor(lower / cell_size) - margin - 1) / unit) * unit
            last = math.ceil(upper / cell_size) + margin + 1
            low.append(first)
            cells.append(math.ceil((last - first + 1) / unit) * unit)
        return CellBox((low[0], low[1], low[2]), (cells[0], cells[1], cells[2]))


def own_physics_column(config: NetworkConfig) -> int:
    """Returns the first column of own physics in the encoder's input."""
    return config.feature_width - MATERIAL_EMBEDDING + len(config.materials)


def feature_columns(config: NetworkConfig) -> int:
    """Returns the number of columns of the encoder's input, padded to a power of two.

    They are: features, one-hot material, and the two parts of own physics (hgn.network.own_physics).
    """
    used = own_physics_column(config) + sum(physics_widths(config))
    return max(16, triton.next_power_of_2(used))


@dataclass(frozen=True, eq=False)
class DeviceImage:
    """Holds the image of the particles that the network sees in this frame (hgn.network.images)."""

    wall_shift: float  # difference of the wall clearances, near - far
    sign_S3: torch.Tensor
    gravity_S3: torch.Tensor
    position_N3: torch.Tensor  # those of the image, written at the beginning of a frame
    velocity_NV: torch.Tensor


@dataclass(frozen=True, eq=False)
class DeviceParticles:
    """Holds the particles of all scenes, padded to the size of the buffers, and the scene of each particle."""

    position_N3: torch.Tensor
    velocity_NV: torch.Tensor  # velocity histories, newest first
    scene_N: torch.Tensor  # int32
    material_N: torch.Tensor  # int32
    origin_S3: torch.Tensor  # origin of the grid
    domain_S3: torch.Tensor
    gravity_S3: torch.Tensor  # zero with absolute inputs, whose network has learned gravity
    count: torch.Tensor  # number of particles, int32 [1]
    frame_S: torch.Tensor  # as in ParticleState
    wall_friction_S3: torch.Tensor | None = None  # None: no surface has friction
    # columns of hgn.network.own_physics; None: all are 0. With `rest_NR` those of elastic bodies follow.
    parameter_NP: torch.Tensor | None = None
    rest_NR: torch.Tensor | None = None  # RestShape.packed with rows of the buffers; None: no body is elastic
    image: DeviceImage | None = None  # None: the network sees the particles themselves

    @staticmethod
    def empty(
        particles: int, scenes: int, history: int, device: torch.device, own_physics: Sequence[str] = ()
    ) -> DeviceParticles:
        """Returns buffers of zeros, for own physics only those that `own_physics` needs. No body is elastic."""
        position_N3, velocity_NV = (torch.zeros(particles, columns, device=device) for columns in (3, 3 * history))
        scene_N, material_N, count = (
            torch.zeros(size, dtype=torch.int32, device=device) for size in (particles, particles, 1)
        )
        origin_S3, domain_S3, gravity_S3 = (torch.zeros(scenes, 3, device=device) for _ in range(3))
        frame_S = torch.zeros(scenes, dtype=torch.int64, device=device)
        friction_S3 = torch.zeros(scenes, 3, device=device) if "friction" in own_physics else None
        parameter_NP = rest_NR = None
        width = len(INPUT_PARAMETERS) * ("parameters" in own_physics) + elastic.COLUMNS * ("elastic" in own_physics)
        if width:
            parameter_NP = torch.zeros(particles, width, device=device)
        if "elastic" in own_physics:
            rest_NR = torch.full((particles, elastic.PACKED), -1, dtype=torch.int32, device=device)
        return DeviceParticles(
            position_N3, velocity_NV, scene_N, material_N, origin_S3, domain_S3, gravity_S3, count, frame_S,
            friction_S3, parameter_NP, rest_NR,
        )  # fmt: skip


class DeviceGrid:
    """Holds the tables of all levels at fixed capacities. Counts stay on the device.

    Buffers (int32): counts_L are numbers of cells, at most the capacities, needed_L the numbers without this limit, and
    status has sticky flags. Methods return neighbour, parent, octant and children of a level as views. Each particle
    has cell_N8, weight_N8, fraction_N3, and the encoder's input feature_NF. Relative inputs need more. motion_C4 is
    mass and momentum of the cells of all levels, one level after the other. The coarsest cells have disturbed_C2
    (disturbance and contact of their own particles, in units of FULLY) and spread_C2 (its maximum over a cell and the
    cells across its faces). sum_C and table_C are the sums and the table of `balance`. moment_C contains first and
    second moments of places, and sums of products of normals. A particle has its coarsest cells coarsest_N8 (repeated
    ones are -1), its weights cell_weight_N8 in them, its place place_N3 in the lowest one, and its contact_N. With
    friction as an input, friction_C are the sums of `add_friction`, and friction_fraction_C is k of `removed_along` and
    its derivatives. `friction` is the number of friction columns of the particles that were prepared last, or 0.
    """

    def __init__(
        self,
        config: NetworkConfig,
        box: CellBox,
        capacities: Sequence[int],
        scenes: int,
        particles: int,
        device: torch.device,
        more: tuple[int, ...] = (),
    ) -> None:
        """Allocates for callers also int32 tensors `more_cleared` of sizes `more`, which `build` clears too."""
        assert scenes < SCENE_LIMIT
        relative, features = config.relative, feature_columns(config)
        self.scenes, self.capacities, self.particles = scenes, tuple(capacities), particles
        self.config, self.cell_size, self.levels, self.features = config, config.cell_size, len(capacities), features
        rows, start, at = [], 0, 0
        for level, capacity in enumerate(capacities):
            nx, ny, nz = ((n >> level) + 2 for n in box.cells)
            rows.append([start, scenes * nx * ny * nz, ny, nz, nx * ny * nz, capacity, at, nx])
            start += rows[-1][1]
            at += capacity
        assert start < 2**31, "slots are numbered in int32"
        self.largest = max(row[1] for row in rows)
        bodies = config.body_cells  # cells are divided among bodies (hgn.kernels.grid.bodies)
        marks, entries = rows[0][1] if bodies else start, 0
        if bodies and self.levels > 1:
            entries = triton.next_power_of_2(max(NUMBER_BLOCK, (self.levels - 1) * self.capacities[0] + 1))

        def integers(*shape: int) -> torch.Tensor:
            return torch.zeros(shape, dtype=torch.int32, device=device)

        self.geometry = torch.tensor(rows, dtype=torch.int32, device=device)
        self.low = torch.tensor(box.low, dtype=torch.int32, device=device)
        coarsest = self.capacities[-1] if relative else 0
        self._widths, self.friction, rough = physics_widths(config), 0, coarsest * ("friction" in config.own_physics)
        drifting = coarsest * ("moving" in config.own_physics)
        # 8-byte entries come first, for their alignment
        parts = [2 * entries, 4 * at if relative else 4, *[SUMS * coarsest] * 3, SUMS * rough, 2 * coarsest, marks]
        parts += [8 * drifting, self.levels, *[marks * bodies] * 2]
        self._cleared = integers(sum(parts) + sum(more))  # one launch clears all parts
        cleared = self._cleared.split([*parts, *more])
        table, motion, *sums, moments, friction, disturbed = cleared[:7]
        self.occupied, drift, self.needed_L, self._reached, links = cleared[7 : len(parts)]
        self.more_cleared = cleared[len(parts) :]
        self.prefix_sum = integers(marks)
        self._owners = {"links": links, "table": table.view(torch.int64), "numbers": integers(entries)}
        self._owners["mask"] = max(0, entries - 1)
        self.slot_of_cell, self.parents, self._octant = integers(at), integers(at), integers(at)
        self._tables = integers(14 * at)
        self._neighbour, self._children = self._tables.split([6 * at, 8 * at])
        self.counts_L = integers(self.levels)
        self.status = integers(1)
        self.cell_N8 = integers(particles, 8)
        self.weight_N8 = torch.zeros(particles, 8, device=device)
        self.fraction_N3 = torch.zeros(particles, 3, device=device)
        self.feature_NF = torch.zeros(particles, features, device=device)
        self.coarsest_N8 = integers(particles * relative, 8)
        self.cell_weight_N8 = torch.zeros(particles * relative, 8, device=device)
        self.place_N3 = torch.zeros(particles * relative, 3, device=device)
        self.contact_N = torch.zeros(particles * relative, device=device)
        self.surface_N3 = torch.zeros(particles * (drifting > 0), 3, device=device)
        self.drift_C8 = drift.view(torch.float32).view(-1, 8)
        self.motion_C4, self.moment_C = motion.view(torch.float32).view(-1, 4), moments.view(torch.float32)
        self.sum_C, self.gradient_sum_C, self.friction_C = (
            x.view(torch.float32).view(-1, SUMS) for x in (*sums, friction)
        )
        self.disturbed_C2 = disturbed.view(-1, 2)
        self.spread_C2 = torch.zeros(coarsest, 2, device=device)
        self.table_C, self.friction_fraction_C = (torch.zeros(rows, SUMS, device=device) for rows in (coarsest, rough))
        self._at = [row[6] for row in rows]

    def neighbour(self, level: int) -> torch.Tensor:
        """Returns [6, capacity]: the cell in each direction of DIRECTION_63, or -1."""
        at, capacity = self._at[level], self.capacities[level]
        return self._neighbour[6 * at : 6 * (at + capacity)].view(6, capacity)

    def children(self, level: int) -> torch.Tensor:
        """Returns [8, capacity]: the cell of the finer level at each corner of CORNER_83, or -1."""
        at, capacity = self._at[level], self.capacities[level]
        return self._children[8 * at : 8 * (at + capacity)].view(8, capacity)

    def parent(self, level: int) -> torch.Tensor:
        return self.parents[self._at[level] : self._at[level] + self.capacities[level]]

    def octant(self, level: int) -> torch.Tensor:
        return self._octant[self._at[level] : self._at[level] + self.capacities[level]]

    def count(self, level: int) -> torch.Tensor:
        """Returns the number of active cells, [1], on the device."""
        return self.counts_L[level : level + 1]

    def build(self, particles: DeviceParticles) -> None:
        """Marks, numbers and tabulates the cells of all levels around particles, or around their image."""
        self._cleared.zero_()
        if (image := particles.image) is not None:
            history = self.config.velocity_history
            kernel.show_image[(triton.cdiv(self.particles, MARK_BLOCK),)](
                position=particles.position_N3, velocity=particles.velocity_NV, scene_of=particles.scene_N,
                domain=particles.domain_S3, sign=image.sign_S3, particle_count=particles.count,
                image_position=image.position_N3, image_velocity=image.velocity_NV, wall_shift=image.wall_shift,
                HISTORY=history, COLUMNS=triton.next_power_of_2(3 * history), BLOCK=MARK_BLOCK,
            )  # fmt: skip
        kernel.mark_cells[(triton.cdiv(self.particles, MARK_BLOCK),)](
            position=(image or particles).position_N3, scene_of=particles.scene_N, origin=particles.origin_S3,
            particle_count=particles.count, low=self.low, geometry=self.geometry, occupied=self.occupied,
            reached=self._reached, status=self.status, cell_size=self.cell_size, LEVELS=self.levels,
            BODIES=self.config.body_cells, BLOCK=MARK_BLOCK,
        )  # fmt: skip
        torch.cumsum(self.occupied, 0, dtype=torch.int32, out=self.prefix_sum)
        cells: dict[str, Any] = {
            "occupied": self.occupied, "prefix_sum": self.prefix_sum, "geometry": self.geometry,
            "LEVELS": self.levels, "BLOCK": FILL_BLOCK,
        }  # fmt: skip
        tables: dict[str, Any] = {
            "slot_of_cell": self.slot_of_cell, "neighbour": self._neighbour, "parent": self.parents,
            "octant": self._octant, "children": self._children, "counts": self.counts_L, "needed": self.needed_L,
            "status": self.status, "OVERLAP": overlaps(),
        }  # fmt: skip
        if not self.config.body_cells:
            kernel.fill_tables[(triton.cdiv(self.largest, FILL_BLOCK), self.levels)](**cells, **tables)
            return
        self._tables.fill_(-1)
        finest, links, table, mask = len(self.occupied), *(self._owners[name] for name in ("links", "table", "mask"))
        bodies.unite_cells[(triton.cdiv(finest, UNITE_BLOCK),)](
            reached=self._reached, links=links, geometry=self.geometry, BLOCK=UNITE_BLOCK
        )
        blocks = (triton.cdiv(finest, FILL_BLOCK),)
        bodies.insert_cells[blocks](**cells, links=links, table=table, mask=mask)
        if self.levels > 1:
            bodies.number_cells[(len(table) // NUMBER_BLOCK,)](
                table=table, numbers=self._owners["numbers"], geometry=self.geometry, needed=self.needed_L,
                status=self.status, LEVELS=self.levels, BLOCK=NUMBER_BLOCK,
            )  # fmt: skip
        bodies.join_cells[blocks](**cells, **self._owners, **tables)

    def prepare(
        self,
        particles: DeviceParticles,
        scale: tuple[torch.Tensor, torch.Tensor],
        obstacles: SceneTable | None,
        symmetry: bool = False,
        moving: MovingTable | None = None,
    ) -> None:
        """Computes the cells and the features of every particle. Without `obstacles` and `moving` normals are zero.

        `scale` is Normaliser.feature_scale. With `symmetry` the kernel applies the symmetries in the obstacles' rows.
        """
        config, blocks, overlap = self.config, (triton.cdiv(self.particles, PARTICLE_BLOCK),), overlaps()
        image = particles.image
        seen = image or particles
        walls, parameter_NP, column = particles.wall_friction_S3, particles.parameter_NP, own_physics_column(config)
        self.friction = self._widths[0] if walls is not None else 0
        own_physics = {"FRICTION": self.friction, "FRICTION_AT": column}
        drift: dict[str, Any] = {"surface_of": self.surface_N3, "drift": self.drift_C8}
        drift["MOVING"] = moving.layers if moving is not None and config.obstacle_features else 0
        surfaces: dict[str, Any] = {
            "position": seen.position_N3, "velocity": seen.velocity_NV, "scene_of": particles.scene_N,
            "domain": particles.domain_S3, "particle_count": particles.count,
            "obstacle_table": obstacles.row_SC if obstacles else particles.count,
            "obstacle_cell_size": next((table.cell_size for table in (obstacles, moving) if table), 1.0),
            "features": self.feature_NF,
            "HISTORY": config.velocity_history, "NORMALS": int(config.obstacle_features),
            "OBSTACLES": config.obstacle_features and obstacles is not None, "SYMMETRY": symmetry,
            "FEATURES": self.features, "BLOCK": PARTICLE_BLOCK,
        }  # fmt: skip
        if particles.rest_NR is not None:
            assert parameter_NP is not None
            feature_kernel.deform[blocks](
                position=seen.position_N3, rest=particles.rest_NR, particle_count=particles.count, scale=scale[1],
                columns=parameter_NP, WIDTH=parameter_NP.shape[1], AT=parameter_NP.shape[1] - elastic.COLUMNS,
                BLOCK=PARTICLE_BLOCK,
            )  # fmt: skip
        kernel.prepare_particles[blocks](
            **surfaces, scene_position=particles.position_N3, scene_velocity=particles.velocity_NV,
            sign=particles.domain_S3 if image is None else image.sign_S3, IMAGE=image is not None,
            origin=particles.origin_S3, low=self.low, geometry=self.geometry, occupied=self.occupied,
            prefix_sum=self.prefix_sum, cell_of=self.cell_N8, weight_of=self.weight_N8,
            fraction_of=self.fraction_N3, motion=self.motion_C4, coarsest_of=self.coarsest_N8,
            cell_weight_of=self.cell_weight_N8, place_of=self.place_N3, moments=self.moment_C, cell_size=self.cell_size,
            wall_friction=particles.domain_S3 if walls is None else walls, contact_of=self.contact_N,
            disturbed=self.disturbed_C2, gravity=seen.gravity_S3, scale=scale[1], friction=self.friction_C,
            reach=CONTACT_REACH_CELLS * config.cell_size, capacity=self.capacities[0], LEVELS=self.levels,
            **self._owners, BODIES=self.config.body_cells, REACH=REACH_CELLS if config.obstacle_distance else 0.0,
            MOTION=config.relative, COLUMNS=SUMS, **own_physics, **drift, **arguments_of(moving, particles.count),
            OVERLAP=overlap, launch_pdl=overlap,
        )  # fmt: skip
        if not config.relative:
            feature_kernel.prepare_features[blocks](
                **surfaces, material_of=particles.material_N, mean=scale[0], std=scale[1],
                wall_maximum=WALL_DISTANCE_CELLS * config.cell_size,
            )  # fmt: skip
            return
        feature_kernel.sum_motion[(triton.cdiv(self.capacities[0], MARK_BLOCK), 2)](
            motion=self.motion_C4, parent=self.parents, geometry=self.geometry, counts=self.counts_L,
            disturbed=self.disturbed_C2, spread=self.spread_C2, neighbour=self.neighbour(self.levels - 1),
            drift=self.drift_C8, coarsest_capacity=self.capacities[-1], LEVELS=self.levels, MOVING=drift["MOVING"],
            OVERLAP=overlap, BLOCK=MARK_BLOCK, launch_pdl=overlap,
        )  # fmt: skip
        feature_kernel.prepare_relative_features[blocks](
            velocity=seen.velocity_NV, scene_of=particles.scene_N, material_of=particles.material_N,
            gravity=seen.gravity_S3, particle_count=particles.count, scale=scale[1], cell_of=self.cell_N8,
            weight_of=self.weight_N8, coarsest_of=self.coarsest_N8, cell_weight_of=self.cell_weight_N8,
            motion=self.motion_C4, parent=self.parents, geometry=self.geometry, features=self.feature_NF,
            contact_of=self.contact_N, disturbed=self.disturbed_C2, spread=self.spread_C2,
            parameter_of=self.contact_N if parameter_NP is None else parameter_NP, quiet=QUIET,
            HISTORY=config.velocity_history,
            LEVELS=self.levels, NORMALS=int(config.obstacle_features), **own_physics,
            PARAMETERS=0 if parameter_NP is None else min(parameter_NP.shape[1], sum(self._widths[1:])),
            PARAMETERS_AT=column + self._widths[0], friction=self.friction_C, COLUMNS=SUMS, **drift,
            FEATURES=self.features, OVERLAP=overlap, BLOCK=PARTICLE_BLOCK, launch_pdl=overlap,
        )  # fmt: skip

    def balance(self, output: torch.Tensor, count: torch.Tensor) -> None:
        """Turns the decoder's output [N, OUT] into accelerations minus gravity in columns 0 to 2: relative.balanced."""
        self._through_coarsest(output, count, self.sum_C, coarsest_kernel.balance, OUTPUTS, 3)

    def balance_backward(self, gradient: torch.Tensor, count: torch.Tensor) -> None:
        """Replaces the gradient of the result of `balance` by that of its input."""
        self._through_coarsest(gradient, count, self.gradient_sum_C, coarsest_kernel.balance_backward, 3, OUTPUTS)

    def _through_coarsest(
        self, x: torch.Tensor, count: torch.Tensor, sums: torch.Tensor, between: Any, taken: int, left: int
    ) -> None:
        """Sums x's first `taken` columns by coarsest cell, launches `between`, and adds `left` columns to particles."""
        particles, capacity, coarsest = self.particles, self.capacities[-1], self.neighbour(self.levels - 1)
        forward, overlap = taken == OUTPUTS, overlaps()
        pairs: dict[str, Any] = {"coarsest_of": self.coarsest_N8, "cell_weight_of": self.cell_weight_N8}
        pairs |= {"place_of": self.place_N3, "particle_count": count}
        cells = {"neighbour": coarsest, "counts": self.counts_L, "capacity": capacity, "LEVELS": self.levels}
        sizes = {"OUT": x.shape[1], "OVERLAP": overlap, "BLOCK": PARTICLE_BLOCK}
        cells_too = max(particles, capacity) if forward else particles
        # In a backward pass a kernel of another package comes before, so this launch does not overlap with it.
        coarsest_kernel.sum_coarsest[(triton.cdiv(cells_too, PARTICLE_BLOCK),)](
            x=x, **pairs, **cells, disturbed=self.disturbed_C2, spread=self.spread_C2, sums=sums, USED=taken,
            SPREAD=forward, **sizes, launch_pdl=overlap and forward,
        )  # fmt: skip
        between[(triton.cdiv(capacity, PARTICLE_BLOCK),)](
            sums=sums, spread=self.spread_C2, motion=self.motion_C4, geometry=self.geometry, moments=self.moment_C,
            **cells, table=self.table_C, friction=self.friction_C, fraction=self.friction_fraction_C, few=FEW,
            rare=RARE, FRICTION=self.friction > 0, **sizes, launch_pdl=overlap,
        )  # fmt: skip
        coarsest_kernel.add_coarsest[(triton.cdiv(particles, PARTICLE_BLOCK),)](
            x=x, table=self.table_C, **pairs, USED=left, COLUMNS=triton.next_power_of_2(left + 1), **sizes,
            launch_pdl=overlap,
        )  # fmt: skip
