"""Obstacles that are given as particles: cells with normals for the networks, and the particles for GNS.

Shape legend: P particles of the boundary, D dimensions, K obstacle cells.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from hgn.scene.obstacle_grid import ObstacleGrid, grid_of_samples

NEAR = 1.9  # spacings around a particle that its surface is found from: two layers, not three
THIN = 0.1  # of the spread along a surface: what is less is one layer, at its rim too
ONE_SIDED = 0.25  # of a spacing: where neighbours lie on one side by more, that is where the body is


def spacing(point_PD: np.ndarray) -> float:
    """The median distance of a particle to the next one."""
    if len(point_PD) < 2:
        return 0.0
    return float(np.median(KDTree(point_PD).query(point_PD, k=2)[0][:, 1]))


def boundary_grid(point_P3: np.ndarray, dimensions: int, cell_size: float) -> ObstacleGrid:
    """The cells that particles of the boundary lie in, with their surface's normal.

    At a body's surface it points away from its other particles. In a thin layer it is the direction in which those
    around spread least. Its sign is taken as for meshes: towards the centre of the cell.
    """
    point_PD = point_P3[:, :dimensions].astype(np.float64)
    normal_P3 = np.zeros((len(point_PD), 3))
    apart = spacing(point_PD)
    for own, near in enumerate(KDTree(point_PD).query_ball_point(point_PD, NEAR * apart)):
        offset_ND = point_PD[near] - point_PD[own]
        mean_D = offset_ND.mean(axis=0)
        spread_D, axes_DD = np.linalg.eigh(offset_ND.T @ offset_ND)
        if spread_D[0] > THIN * spread_D[1] and np.linalg.norm(mean_D) > ONE_SIDED * apart:
            normal_P3[own, :dimensions] = -mean_D
        else:
            normal_P3[own, :dimensions] = axes_DD[:, 0]
    normal_P3 /= np.linalg.norm(normal_P3, axis=1, keepdims=True)
    return grid_of_samples(point_P3.astype(np.float64), normal_P3, cell_size)
