"""Obstacles in motion as inputs of a network with `moving` in `network.own_physics`.

The cells of a moving obstacle are computed once, in the pose of the scene file. Particles are looked up in coordinates
that move with the obstacle, so its cells move exactly. Until the next frame the obstacle's points move by

    V(x) = A (x - p) + b,    A = R' R^T - 1,    b = p' - p

R and p are the obstacle's rotation and its pivot's position in this frame, R' and p' those one frame later; b is in
domain units per frame. A particle at x moves relative to the obstacle by v - V(x). docs/concepts/method.md lists where
the network uses v - V.

Tensors have one row for each obstacle. Obstacle j of scene s has row j S + s. Scenes with fewer than J moving
obstacles have rows without cells. The key of a cell or triangle contains its coordinates and a number: its scene's for
obstacles at rest, its row's for moving obstacles.
Shape legend: N particles, S scenes, J largest number of moving obstacles in a scene, C coarsest cells, V (in names of
tensors) J S rows. K columns: three of the normal, one of friction; if there are 7, also three of the velocity V(x).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import zip_longest

import numpy as np
import torch
from torch.nn.functional import pad

from hgn.config import NetworkConfig
from hgn.network.barriers import Barriers
from hgn.network.grid import GridHierarchy
from hgn.network.obstacles import ObstacleCells, first_surface
from hgn.scene.barrier import barrier_of_pieces
from hgn.scene.motion import AT_REST
from hgn.scene.moving import MovingObstacle
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.scene.symmetry import Symmetry

TINY = 1e-30  # lower bound of divisors


@dataclass(frozen=True, eq=False)
class Poses:
    """The poses x -> R (x - c) + p of moving obstacles in a frame, and their motion until the next frame; float64."""

    rotation_V33: torch.Tensor  # R
    pivot_V3: torch.Tensor  # c, domain units
    place_V3: torch.Tensor  # p, domain units
    change_V33: torch.Tensor  # A
    shift_V3: torch.Tensor  # b, domain units per frame

    @property
    def tensors(self) -> list[torch.Tensor]:
        return [getattr(self, item.name) for item in fields(self)]

    def map(self, function: Callable[[torch.Tensor], torch.Tensor]) -> Poses:
        return Poses(*map(function, self.tensors))

    @property
    def later(self) -> Poses:
        """Returns the poses one frame later, with A and b set to 0."""
        rotation_V33 = self.rotation_V33 + self.change_V33 @ self.rotation_V33
        still = torch.zeros_like(self.change_V33), torch.zeros_like(self.shift_V3)
        return Poses(rotation_V33, self.pivot_V3, self.place_V3 + self.shift_V3, *still)

    def under(self, symmetries: Sequence[Symmetry]) -> Poses:
        """Returns the images of the poses, each under the symmetry of its row."""
        source_V3, mirrored_V3 = (np.array([getattr(s, name) for s in symmetries]) for name in ("source", "mirrored"))
        turn_V33 = np.where(mirrored_V3, -1.0, 1.0)[..., None] * np.eye(3)[source_V3]
        sum_V3 = mirrored_V3 * np.array([s.mirror_sum for s in symmetries])
        map_V33, shift_V3 = (torch.from_numpy(x).to(self.place_V3) for x in (turn_V33, sum_V3))
        rotation_V33, change_V33 = (map_V33 @ x @ map_V33.mT for x in (self.rotation_V33, self.change_V33))
        pivot_V3, place_V3 = (turned(x, map_V33) + shift_V3 for x in (self.pivot_V3, self.place_V3))
        return Poses(rotation_V33, pivot_V3, place_V3, change_V33, turned(self.shift_V3, map_V33))

    def mirrored(self, sign_V3: torch.Tensor, shift_V3: torch.Tensor) -> Poses:
        """Returns the poses x -> sign (R (x - c) + p) + shift: the images of the obstacles, with the same cells."""
        sign_V3 = sign_V3.to(self.place_V3)
        rotation_V33 = sign_V3[:, :, None] * self.rotation_V33
        change_V33 = sign_V3[:, :, None] * self.change_V33 * sign_V3[:, None]
        return Poses(
            rotation_V33, self.pivot_V3, sign_V3 * self.place_V3 + shift_V3, change_V33, sign_V3 * self.shift_V3
        )

    def undo(self, position_V3: torch.Tensor) -> torch.Tensor:
        """Moves a point of each row to the coordinates of the row's cells."""
        return turned(position_V3 - self.place_V3, self.rotation_V33.mT) + self.pivot_V3

    def put(self, position_V3: torch.Tensor) -> torch.Tensor:
        """Moves a point of each row from the coordinates of the row's cells to the pose. Inverts `undo`."""
        return turned(position_V3 - self.pivot_V3, self.rotation_V33) + self.place_V3

    def velocity(self, position_V3: torch.Tensor) -> torch.Tensor:
        """Returns the displacement V of the obstacle's points at these positions until the next frame."""
        return turned(position_V3 - self.place_V3, self.change_V33) + self.shift_V3


def turned(vector_V3: torch.Tensor, matrix_V33: torch.Tensor) -> torch.Tensor:
    return (matrix_V33 @ vector_V3[..., None]).squeeze(-1)


@dataclass(frozen=True, eq=False)
class MovingObstacles:
    """The moving obstacles of a batch of scenes, each scene at a frame of its own."""

    scenes: tuple[tuple[MovingObstacle, ...], ...]
    frames: tuple[int, ...]
    frame_s: float
    cells: ObstacleCells | None  # in the poses of the scene files; None for a network without obstacle features
    barriers: Barriers | None  # likewise; only with step.obstacle_clearance
    poses: Poses

    @staticmethod
    def of(
        scenes: Sequence[tuple[MovingObstacle, ...]],
        frames: Sequence[int],
        frame_s: float,
        network: NetworkConfig,
        clearance: float | None = None,
    ) -> MovingObstacles | None:
        """Returns the moving obstacles of scenes as network inputs, scene s at frames[s]; None if all are at rest."""
        if not any(scenes):
            return None
        rows, cells = [row for layer in zip_longest(*scenes) for row in layer], None
        size = next(row.grid.cell_size for row in rows if row is not None)
        if network.obstacle_features:
            none_K, distance = np.zeros(0, np.float32), network.obstacle_distance
            nothing = ObstacleGrid(size, np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
            nothing = replace(nothing, distance_K=none_K if distance else None)
            cells = ObstacleCells.of([nothing if row is None else row.surfaces(distance) for row in rows])
        own = tuple(map(tuple, scenes))
        moving = MovingObstacles(own, tuple(frames), frame_s, cells, None, poses_of(own, frames, frame_s))
        return moving if clearance is None else moving.with_barriers(clearance)

    def with_barriers(self, clearance: float) -> MovingObstacles:
        """Returns the obstacles with barriers. Raises: ConfigError for an invalid clearance."""
        empty = barrier_of_pieces(np.zeros((0, 3, 3)), self.cell_size, clearance)
        rows = (row for layer in zip_longest(*self.scenes) for row in layer)
        barriers = Barriers.of([empty if row is None else row.barrier(clearance) for row in rows])
        return replace(self, barriers=barriers and barriers.to(self.poses.place_V3.device))

    @property
    def layers(self) -> int:
        """Returns J, the largest number of moving obstacles of a scene."""
        return len(self.poses.place_V3) // len(self.scenes)

    @property
    def cell_size(self) -> float:
        return next(scene[0].grid.cell_size for scene in self.scenes if scene)

    def at(self, frames: Sequence[int]) -> MovingObstacles:
        """Returns the obstacles with each scene at another frame."""
        poses, device = poses_of(self.scenes, frames, self.frame_s), self.poses.place_V3.device
        return replace(self, frames=tuple(frames), poses=poses.map(lambda tensor: tensor.to(device)))

    def later(self, frames: int = 1) -> MovingObstacles:
        return self.at([frame + frames for frame in self.frames])

    def to(self, device: torch.device, non_blocking: bool = False) -> MovingObstacles:
        move = {"cells": self.cells, "barriers": self.barriers}
        own = {name: part and part.to(device, non_blocking) for name, part in move.items()}
        return replace(self, **own, poses=self.poses.map(lambda tensor: tensor.to(device)))  # type: ignore[arg-type]

    def rows(self, scene_N: torch.Tensor, dtype: torch.dtype) -> Iterator[tuple[torch.Tensor, Poses]]:
        """Yields for each j the row of obstacle j of the particle's scene, [N], and the poses of these rows."""
        for layer in range(self.layers):
            row_N = scene_N.long() + layer * len(self.scenes)
            yield row_N, Poses(*(tensor.to(dtype)[row_N] for tensor in self.poses.tensors))

    def met(
        self, still: ObstacleCells | None, place: tuple[torch.Tensor, torch.Tensor, torch.Tensor], steps: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns `relative.obstacle_surfaces` of moving and `still` obstacles, [N, 8], and velocities V [N, 3].

        V is the velocity of the surface at the particle, or else of the first one on its path; 0 without a surface. In
        cells of several obstacles, normals are summed, and the sum is shortened to at most 1; friction and V are means.
        """
        (position_N3, velocity_N3, scene_N), cells = place, self.cells
        assert cells is not None
        rows: list[list[torch.Tensor]] = [[] for _ in range(steps + 1)]
        if still is not None:
            for step, row in enumerate(rows):
                row.append(pad(_seen(still, position_N3, velocity_N3, scene_N, step / steps), (0, 3)))
        for row_N, pose in self.rows(scene_N, position_N3.dtype):
            own_N3, surface_N3 = pose.undo(position_N3), pose.velocity(position_N3)
            way_N3 = turned(velocity_N3 - surface_N3, pose.later.rotation_V33.mT)
            for step, row in enumerate(rows):
                own_N4 = _seen(cells, own_N3, way_N3, row_N, step / steps)
                # a product with a slice would fix the size of an exported graph
                normal_N3 = own_N4[:, :3].clone(memory_format=torch.contiguous_format)
                row.append(torch.cat([turned(normal_N3, pose.rotation_V33), own_N4[:, 3:], surface_N3], -1))
        here_N7, *ahead = map(_merged, rows)
        ahead_N7 = first_surface(ahead)
        first_N7 = first_surface([here_N7, ahead_N7])
        there_N1 = first_N7[:, :3].any(-1, keepdim=True)
        return torch.cat([here_N7[:, :4], ahead_N7[:, :4]], dim=-1), there_N1 * first_N7[:, 4:]


def _seen(
    cells: ObstacleCells, place_N3: torch.Tensor, way_N3: torch.Tensor, scene_N: torch.Tensor, part: float
) -> torch.Tensor:
    """Returns normals and friction at the fraction `part` of the particles' paths, [N, 4]."""
    row_NK = cells.surfaces(place_N3 + way_N3 * part, scene_N)
    return pad(row_NK, (0, 4 - row_NK.shape[1]))


def _merged(rows: Sequence[torch.Tensor]) -> torch.Tensor:
    """Returns sums of normals, at most 1 long, and means of friction and V over rows with a normal, [N, 7]."""
    there = [row_N7[:, :3].any(-1, keepdim=True).to(row_N7) for row_N7 in rows]
    count_N1, total_N7 = sum(there), sum(there_N1 * row_N7 for there_N1, row_N7 in zip(there, rows, strict=True))
    assert isinstance(count_N1, torch.Tensor) and isinstance(total_N7, torch.Tensor)
    normal_N3 = total_N7[:, :3]
    square_N1 = torch.where(count_N1 > 1, normal_N3.square().sum(-1, keepdim=True).clamp(min=1), 1)
    return torch.cat([normal_N3 * square_N1.rsqrt(), total_N7[:, 3:] / count_N1.clamp(min=1)], -1)


def poses_of(scenes: Sequence[Sequence[MovingObstacle]], frames: Sequence[int], frame_s: float) -> Poses:
    """Returns the poses of the rows of scenes, scene s in frame frames[s]."""
    rows, pose = [], cache(lambda motion, frame: motion.pose(frame * frame_s))
    for layer in zip_longest(*scenes):
        for obstacle, frame in zip(layer, frames, strict=True):
            motion = AT_REST if obstacle is None else obstacle.motion
            (turn_33, shift_3), (later_33, later_3) = pose(motion, frame), pose(motion, frame + 1)
            pivot_3, change_33 = np.array(motion.pivot), later_33 @ turn_33.T - np.eye(3)
            rows.append((turn_33, pivot_3, pivot_3 + shift_3, change_33, later_3 - shift_3))
    return Poses(*(torch.from_numpy(np.stack(part).astype(np.float64)) for part in zip(*rows, strict=True)))


def surface_velocity(
    contact_N: torch.Tensor, surface_N3: torch.Tensor, contact_C: torch.Tensor, grid: GridHierarchy
) -> torch.Tensor:
    """Returns the velocity V of the surface for each particle, t V_own + (1 - t) V_mean, [N, 3].

    t is the particle's contact, `contact_N`. V_own is its row of `surface_N3`, 0 at walls. V_mean is the mean of V_own,
    weighted by t, over the particles in the same coarsest cells and in their face neighbours.
    """
    level, gate_C1 = grid.levels[-1], contact_C[:, None]
    sum_C4 = grid.coarsest.sums(contact_N[:, None] * torch.cat([surface_N3, torch.ones_like(surface_N3[:, :1])], -1))
    sum_C4 = sum_C4.index_add(0, level.receiver_E, sum_C4[level.sender_E])
    mean_C3 = sum_C4[:, :3] / sum_C4[:, 3:].clamp(min=TINY)
    near_N3, gate_N1 = grid.coarsest.at_particles(torch.cat([gate_C1 * mean_C3, gate_C1], -1)).split([3, 1], 1)
    near_N3 = near_N3 / gate_N1.clamp(min=TINY)
    return contact_N[:, None] * surface_N3 + (1 - contact_N)[:, None] * near_N3
