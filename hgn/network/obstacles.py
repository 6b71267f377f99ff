"""Obstacles on the device: the normals of sparse cells, found by key, or particles on the obstacles' surfaces.

Paper sec. 3: n_o is the normal of the solver-sized cell that contains the particle, zero where there is none.
Sec. 4: GNS has static particles instead, sampled from the surfaces.
Shape legend: K obstacle cells of all scenes, N particles, P surface particles of all scenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from hgn.network.cell_keys import find, of_scene, pack, unpack
from hgn.scene.obstacle_grid import ObstacleGrid

CELL_DIAGONAL = 3**0.5 + 1e-3  # points of two cells are at most this much nearer than the cells' corners
CELLS_AT_ONCE = 1 << 12
REMEMBERED_SCENES = 32  # whose keys are: batches of many frames of a scene need them again and again


@dataclass(frozen=True, eq=False)
class ObstacleCells:
    """Sorted cell keys int64 [K] and unit normals float32 [K, 3]."""

    key_K: torch.Tensor
    normal_K3: torch.Tensor
    cell_size: float

    @staticmethod
    def of(grids: Sequence[ObstacleGrid]) -> ObstacleCells | None:
        """The cells of a batch, scene s from grids[s]; none where no scene has an obstacle."""
        if not any(len(grid.cell_K3) for grid in grids):
            return None
        cell_size = grids[0].cell_size
        assert all(grid.cell_size == cell_size for grid in grids), "scenes of one batch share the cell size"
        key_K = torch.cat([of_scene(_keys(grid), scene) for scene, grid in enumerate(grids)])
        normal_K3 = np.concatenate([grid.normal_K3 for grid in grids]).astype(np.float32, copy=False)
        return ObstacleCells(key_K, torch.from_numpy(normal_K3), cell_size)

    def to(self, device: torch.device, non_blocking: bool = False) -> ObstacleCells:
        return ObstacleCells(
            self.key_K.to(device, non_blocking=non_blocking),
            self.normal_K3.to(device, non_blocking=non_blocking),
            self.cell_size,
        )

    def normals(self, position_N3: torch.Tensor, scene_N: torch.Tensor) -> torch.Tensor:
        """n_o of each particle, [N, 3] in the positions' dtype; zero where its cell holds no obstacle."""
        cell_N3 = torch.floor(position_N3 / self.cell_size).long()
        index_N, found_N = find(self.key_K, pack(scene_N, cell_N3))
        return (self.normal_K3[index_N] * found_N[:, None]).to(position_N3.dtype)


@dataclass(frozen=True, eq=False)
class SurfaceParticles:
    """Points on the surfaces of a batch's obstacles: float32 [P, 3] in domain units, and the scene of each."""

    position_P3: torch.Tensor
    scene_P: torch.Tensor

    @staticmethod
    def of(points: Sequence[np.ndarray]) -> SurfaceParticles | None:
        """The surfaces of a batch, scene s from points[s] [P_s, 3]; none where no scene has an obstacle."""
        if not any(len(point_P3) for point_P3 in points):
            return None
        scene_P = np.repeat(np.arange(len(points)), [len(point_P3) for point_P3 in points])
        position_P3 = np.concatenate(points).astype(np.float32)
        return SurfaceParticles(torch.from_numpy(position_P3), torch.from_numpy(scene_P))

    def to(self, device: torch.device, non_blocking: bool = False) -> SurfaceParticles:
        return SurfaceParticles(
            self.position_P3.to(device, non_blocking=non_blocking), self.scene_P.to(device, non_blocking=non_blocking)
        )

    def within(self, reach: float, position_N3: torch.Tensor, scene_N: torch.Tensor) -> SurfaceParticles:
        """Those with a particle of their scene within `reach`, and few others: distances are taken between cells.

        The cells are a twentieth of the reach wide, so that none is missed and none kept beyond 1.2 times the reach.
        """
        size = 0.05 * reach
        cell_N = torch.unique(pack(scene_N, torch.floor(position_N3 / size).long()))
        cell_Q, of_P = torch.unique(
            pack(self.scene_P, torch.floor(self.position_P3 / size).long()), return_inverse=True
        )
        near_Q = torch.zeros_like(cell_Q, dtype=torch.bool)
        scene_C, particle_C3 = unpack(cell_N)
        scene_Q, surface_Q3 = unpack(cell_Q)
        for scene in scene_Q.unique().tolist():
            here_Q = torch.nonzero(scene_Q == scene).flatten()
            particle_L3 = particle_C3[scene_C == scene].float()
            for block_Q in here_Q.split(CELLS_AT_ONCE):
                distance_QL = torch.cdist(
                    surface_Q3[block_Q].float(), particle_L3, compute_mode="donot_use_mm_for_euclid_dist"
                )
                near_Q[block_Q] = (distance_QL < reach / size + CELL_DIAGONAL).any(-1)
        kept_P = near_Q[of_P]
        return SurfaceParticles(self.position_P3[kept_P], self.scene_P[kept_P])


@lru_cache(REMEMBERED_SCENES)
def _keys(grid: ObstacleGrid) -> torch.Tensor:
    """Of scene 0, int64 [K]."""
    cell_K3 = torch.from_numpy(grid.cell_K3.astype(np.int64))
    key_K = pack(torch.zeros(len(cell_K3), dtype=torch.int64), cell_K3)
    assert bool((key_K[1:] > key_K[:-1]).all()), "obstacle cells come sorted and unique"
    return key_K
