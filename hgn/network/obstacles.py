"""Obstacles on the device: the normals of sparse cells, found by key.

Paper sec. 3: n_o is the normal of the obstacle cell that contains the particle. Without such a cell it is zero.
Shape legend: K obstacle cells of all scenes, N particles, V values of a surface, its normal first.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
import torch

from hgn.network.cell_keys import find, of_scene, pack
from hgn.scene.obstacle_grid import ObstacleGrid

REMEMBERED_SCENES = 32  # number of scenes whose keys are cached; batches often contain several frames of a scene


@dataclass(frozen=True, eq=False)
class ObstacleCells:
    """Sorted cell keys int64 [K], unit normals float32 [K, 3] and friction coefficients float32 [K] (None: 0)."""

    key_K: torch.Tensor
    normal_K3: torch.Tensor
    cell_size: float
    friction_K: torch.Tensor | None = field(default=None, kw_only=True)

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
        return ObstacleCells(key_K, torch.from_numpy(normal_K3), cell_size, friction_K=friction_K)

    def to(self, device: torch.device, non_blocking: bool = False) -> "ObstacleCells":
        return ObstacleCells(
            self.key_K.to(device, non_blocking=non_blocking),
            self.normal_K3.to(device, non_blocking=non_blocking),
            self.cell_size,
            friction_K=self.friction_K if self.friction_K is None else self.friction_K.to(device),
        )

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
        cell_N3 = torch.floor(position_N3 / self.cell_size).long()
        index_N, found_N = find(self.key_K, pack(scene_N, cell_N3))
        return (row_KV[index_N] * found_N[:, None]).to(position_N3.dtype)


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
