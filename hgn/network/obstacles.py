"""Obstacles on the device: the normals or planes of sparse cells, found by key.

Paper sec. 3: n_o is the normal of the obstacle cell that contains the particle. Without such a cell it is zero. With
`network.obstacle_distances` the cells are those near a surface, each with a plane (obstacle_grid.surface_planes).
Shape legend: K obstacle cells of all scenes, N particles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
import torch

from hgn.network.cell_keys import find, of_scene, pack, unpack
from hgn.scene.obstacle_grid import REACH_CELLS, ObstacleGrid, surface_planes

WALL_LIMIT = 2.0  # largest nearness of a wall or a plane, reached one reach behind it
REMEMBERED_SCENES = 32  # number of scenes whose keys are cached; batches often contain several frames of a scene


@dataclass(frozen=True, eq=False)
class ObstacleCells:
    """Sorted cell keys int64 [K], unit normals float32 [K, 3] and friction coefficients float32 [K] (None: 0)."""

    key_K: torch.Tensor
    normal_K3: torch.Tensor
    cell_size: float
    friction_K: torch.Tensor | None = field(default=None, kw_only=True)
    offset_K: torch.Tensor | None = field(default=None, kw_only=True)  # of planes, domain units; None: normals alone

    @staticmethod
    def of(grids: Sequence[ObstacleGrid], distances: bool = False) -> ObstacleCells | None:
        """Returns the cells of a batch, with grids[s] for scene s; None if no scene has an obstacle.

        With `distances` they are the cells near a surface, with planes.
        """
        if not any(len(grid.cell_K3) for grid in grids):
            return None
        offset_K = None
        if distances:
            grids, offsets = zip(*(_planes(grid) for grid in grids), strict=True)
            offset_K = torch.from_numpy(np.concatenate(offsets))
        cell_size = grids[0].cell_size
        assert all(grid.cell_size == cell_size for grid in grids), "scenes of one batch share the cell size"
        key_K = torch.cat([of_scene(_keys(grid), scene) for scene, grid in enumerate(grids)])
        normal_K3 = np.concatenate([grid.normal_K3 for grid in grids]).astype(np.float32, copy=False)
        friction_K = None
        if any(grid.friction_K is not None and grid.friction_K.any() for grid in grids):
            parts = (np.zeros(len(g.cell_K3)) if g.friction_K is None else g.friction_K for g in grids)
            friction_K = torch.from_numpy(np.concatenate([*parts]).astype(np.float32, copy=False))
        return ObstacleCells(key_K, torch.from_numpy(normal_K3), cell_size, friction_K=friction_K, offset_K=offset_K)

    def to(self, device: torch.device, non_blocking: bool = False) -> ObstacleCells:
        return ObstacleCells(
            self.key_K.to(device, non_blocking=non_blocking),
            self.normal_K3.to(device, non_blocking=non_blocking),
            self.cell_size,
            friction_K=self.friction_K if self.friction_K is None else self.friction_K.to(device),
            offset_K=self.offset_K if self.offset_K is None else self.offset_K.to(device),
        )

    @cached_property
    def surface_rows(self) -> torch.Tensor:
        """Returns normals, the planes' offsets if there are any, and friction, [K, 4 or 5]."""
        friction_K = torch.zeros_like(self.normal_K3[:, 0]) if self.friction_K is None else self.friction_K
        return torch.cat([self.values(False).to(friction_K), friction_K[:, None]], dim=-1)

    def normals(self, position_N3: torch.Tensor, scene_N: torch.Tensor) -> torch.Tensor:
        """Returns n_o of each particle, [N, 3] in the positions' dtype; zero in cells without obstacles."""
        return self.surfaces(position_N3, scene_N)[:, :3]

    def surfaces(self, position_N3: torch.Tensor, scene_N: torch.Tensor) -> torch.Tensor:
        """Returns `normals`, followed by the friction of the cell if any cell has friction, [N, 3 or 4]."""
        return self.rows_at(self.values(self.friction_K is not None), position_N3, scene_N)

    def planes(self, position_N3: torch.Tensor, scene_N: torch.Tensor) -> torch.Tensor:
        """Returns the plane's normal, the signed distance from it, and its friction, [N, 5]; zeros without a plane."""
        row_N5 = self.rows_at(self.surface_rows, position_N3, scene_N)
        place_N3 = position_N3 / self.cell_size
        place_N3 = (place_N3 - torch.floor(place_N3) - 0.5) * self.cell_size
        distance_N1 = (row_N5[:, :3] * place_N3).sum(-1, keepdim=True) - row_N5[:, 3:4]
        return torch.cat([row_N5[:, :3], distance_N1, row_N5[:, 4:]], dim=-1)

    def near(
        self, position_N3: torch.Tensor, velocity_N3: torch.Tensor, scene_N: torch.Tensor, part: float
    ) -> torch.Tensor:
        """Returns the nearness of the plane at a part of the path to the next frame, and its friction, [N, 4].

        The nearness is that of `relative.wall_nearness`, times the normal that points to the particle's side: 0 at
        distances of REACH_CELLS and more, at most WALL_LIMIT, and of an approaching particle that of the next frame.
        """
        way_N3 = part * velocity_N3
        plane_N5 = self.planes(position_N3 + way_N3, scene_N)
        normal_N3, distance_N = plane_N5[:, :3], plane_N5[:, 3] - (plane_N5[:, :3] * way_N3).sum(-1)
        side_N3 = torch.where(distance_N < 0, -1, 1)[:, None] * normal_N3
        approach_N = (side_N3 * velocity_N3).sum(-1).clamp(max=0)
        near_N = 1 - (distance_N.abs() + approach_N) / (REACH_CELLS * self.cell_size)
        return torch.cat([near_N.clamp(0.0, WALL_LIMIT)[:, None] * side_N3, plane_N5[:, 4:]], dim=-1)

    def about_origin(self) -> ObstacleCells:
        """Returns the same planes with offsets from the scene's origin, instead of from the cells' centres."""
        assert self.offset_K is not None
        centre_K3 = (unpack(self.key_K)[1] + 0.5) * self.cell_size
        return replace(self, offset_K=self.offset_K + (self.normal_K3 * centre_K3.to(self.offset_K)).sum(-1))

    def values(self, friction: bool) -> torch.Tensor:
        """Returns normals, then offsets if there are any, then with `friction` friction, [K, 3 to 5]."""
        if friction:
            return self.surface_rows
        return self.normal_K3 if self.offset_K is None else torch.cat([self.normal_K3, self.offset_K[:, None]], -1)

    def rows_at(self, row_KV: torch.Tensor, position_N3: torch.Tensor, scene_N: torch.Tensor) -> torch.Tensor:
        cell_N3 = torch.floor(position_N3 / self.cell_size).long()
        index_N, found_N = find(self.key_K, pack(scene_N, cell_N3))
        return (row_KV[index_N] * found_N[:, None]).to(position_N3.dtype)


def nearest(rows: Sequence[torch.Tensor]) -> torch.Tensor:
    """Returns of several rows [N, V] the one whose first three columns are longest; of equal ones the first."""
    result_NV = rows[0]
    for row_NV in rows[1:]:
        longer_N = row_NV[:, :3].square().sum(-1) > result_NV[:, :3].square().sum(-1)
        result_NV = torch.where(longer_N[:, None], row_NV, result_NV)
    return result_NV


def first_normal(here_N3: torch.Tensor, ahead_N3: torch.Tensor, distances: bool) -> torch.Tensor:
    """Returns n [N, 3] such that n n^T counts in a contact: the normal at the particle, or ahead of it if that is 0.

    With `distances` the normals have the length of their nearness q, and n n^T counts min(1, 2 q) times.
    """
    first_N3 = torch.where(here_N3.any(-1, keepdim=True), here_N3, ahead_N3)
    if not distances:
        return first_N3
    square_N1 = first_N3.square().sum(-1, keepdim=True)
    there_N1 = square_N1 > 0
    near_N1 = torch.where(there_N1, square_N1, 1).sqrt()
    return torch.where(there_N1, first_N3 * ((2 * near_N1).clamp(max=1).sqrt() / near_N1), 0)


_planes = lru_cache(REMEMBERED_SCENES)(surface_planes)


@lru_cache(REMEMBERED_SCENES)
def _keys(grid: ObstacleGrid) -> torch.Tensor:
    """Returns the keys of the cells in scene 0, int64 [K]."""
    cell_K3 = torch.from_numpy(grid.cell_K3.astype(np.int64))
    key_K = pack(torch.zeros(len(cell_K3), dtype=torch.int64), cell_K3)
    assert bool((key_K[1:] > key_K[:-1]).all()), "obstacle cells come sorted and unique"
    return key_K
