"""Obstacles on the device: the normals of sparse cells, found by key.

Paper sec. 3: n_o is the normal of the obstacle cell that contains the particle. Without such a cell it is zero. With
`network.obstacle_distance` cells are those of hgn.scene.surface_field, and |n_o| is the nearness.
Shape legend: K obstacle cells of all scenes, N particles, V values of a surface, its normal first.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
import torch

from hgn.network.cell_keys import find, of_scene, pack
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.scene.surface_field import REACH_CELLS

REMEMBERED_SCENES = 32  # number of scenes whose keys are cached; batches often contain several frames of a scene


@dataclass(frozen=True, eq=False)
class ObstacleCells:
    """Sorted cell keys int64 [K], unit normals float32 [K, 3] and friction coefficients float32 [K] (None: 0)."""

    key_K: torch.Tensor
    normal_K3: torch.Tensor
    cell_size: float
    friction_K: torch.Tensor | None = field(default=None, kw_only=True)
    distance_K: torch.Tensor | None = field(default=None, kw_only=True)  # float32, as in ObstacleGrid

    @staticmethod
    def of(grids: Sequence[ObstacleGrid]) -> "ObstacleCells | None":
        """Returns the cells of a batch, with grids[s] for scene s; None if no scene has an obstacle."""
        if not any(len(grid.cell_K3) for grid in grids):
            return None
        cell_size = grids[0].cell_size
        assert all(grid.cell_size == cell_size for grid in grids), "scenes of one batch share the cell size"
        key_K = torch.cat([of_scene(_keys(grid), scene) for scene, grid in enumerate(grids)])
        normal_K3 = np.concatenate([grid.normal_K3 for grid in grids]).astype(np.float32, copy=False)
        friction_K = None
        if any(grid.friction_K is not None and grid.friction_K.any() for grid in grids):
            parts = (np.zeros(len(g.cell_K3)) if g.friction_K is None else g.friction_K for g in grids)
            friction_K = torch.from_numpy(np.concatenate([*parts]).astype(np.float32, copy=False))
        distances = [grid.distance_K for grid in grids if grid.distance_K is not None]
        assert len(distances) in (0, len(grids)), "either all grids are fields of distances, or none"
        distance_K = torch.from_numpy(np.concatenate(distances)) if distances else None
        cells = key_K, torch.from_numpy(normal_K3), cell_size
        return ObstacleCells(*cells, friction_K=friction_K, distance_K=distance_K)

    def to(self, device: torch.device, non_blocking: bool = False) -> "ObstacleCells":
        names = ("key_K", "normal_K3", "friction_K", "distance_K")
        own = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return replace(self, **{name: tensor.to(device, non_blocking=non_blocking) for name, tensor in own.items()})

    @staticmethod
    def of_rows(key_K: torch.Tensor, row_KV: torch.Tensor, cell_size: float, distance: bool) -> "ObstacleCells":
        """Returns the cells of `rows`, which have a last column of distances with `distance`."""
        column_VK = [column.contiguous() for column in row_KV.unbind(-1)]
        distance_K = column_VK.pop() if distance else None
        friction_K = column_VK[3] if len(column_VK) > 3 else None
        return ObstacleCells(key_K, row_KV[:, :3], cell_size, friction_K=friction_K, distance_K=distance_K)

    def rows(self, friction: bool) -> torch.Tensor:
        """Returns `values`, and the distance as a last column if it is known, [K, 3 to 5]."""
        value_KV = self.values(friction)
        return value_KV if self.distance_K is None else torch.cat([value_KV, self.distance_K[:, None]], -1)

    @cached_property
    def surface_rows(self) -> torch.Tensor:
        """Returns normals and friction [K, 4]."""
        friction_K = torch.zeros_like(self.normal_K3[:, 0]) if self.friction_K is None else self.friction_K
        return torch.cat([self.normal_K3.to(friction_K), friction_K[:, None]], dim=-1)

    def normals(self, position_N3: torch.Tensor, scene_N: torch.Tensor) -> torch.Tensor:
        """Returns n_o of each particle, [N, 3] in the positions' dtype; zero in cells without obstacles."""
        return self.surfaces(position_N3, scene_N)[:, :3]

    def surfaces(self, position_N3: torch.Tensor, scene_N: torch.Tensor) -> torch.Tensor:
        """Returns `normals`, followed by the friction of the cell if any cell has friction, [N, 3 or 4]."""
        return self.rows_at(self.values(self.friction_K is not None), position_N3, scene_N)

    def values(self, friction: bool) -> torch.Tensor:
        """Returns normals, with `friction` also friction, [K, 3 or 4]."""
        return self.surface_rows if friction else self.normal_K3

    def rows_at(self, row_KV: torch.Tensor, position_N3: torch.Tensor, scene_N: torch.Tensor) -> torch.Tensor:
        """Returns the rows of the particles' cells; zeros without a cell. Distances scale normals by the nearness."""
        place_N3 = position_N3 / self.cell_size
        cell_N3 = torch.floor(place_N3)
        index_N, found_N = find(self.key_K, pack(scene_N, cell_N3.long()))
        row_NV = (row_KV[index_N] * found_N[:, None]).to(position_N3.dtype)
        if self.distance_K is None:
            return row_NV
        normal_N3, offset_N3 = row_NV[:, :3], place_N3 - cell_N3 - 0.5
        distance_N = (normal_N3 * offset_N3).sum(-1) + self.distance_K[index_N].to(place_N3)
        near_N = (1 - distance_N.abs() / REACH_CELLS).clamp(min=0)
        side_N = torch.where(distance_N < 0, -near_N, near_N)
        return torch.cat([normal_N3 * side_N[:, None], row_NV[:, 3:] * (near_N > 0)[:, None]], dim=-1)


@lru_cache(REMEMBERED_SCENES)
def _keys(grid: ObstacleGrid) -> torch.Tensor:
    """Returns the keys of the cells in scene 0, int64 [K]."""
    cell_K3 = torch.from_numpy(grid.cell_K3.astype(np.int64))
    key_K = pack(torch.zeros(len(cell_K3), dtype=torch.int64), cell_K3)
    assert bool((key_K[1:] > key_K[:-1]).all()), "obstacle cells come sorted and unique"
    return key_K


def first_surface(rows: Sequence[torch.Tensor]) -> torch.Tensor:
    """Returns for each particle the first of several rows [N, V] that has a normal; without one, the last row."""
    result_NV = rows[-1]
    for row_NV in rows[-2::-1]:
        result_NV = torch.where(row_NV[:, :3].any(-1, keepdim=True), row_NV, result_NV)
    return result_NV
