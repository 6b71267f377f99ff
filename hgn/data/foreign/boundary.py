"""Obstacles given as particles: cells with normals for the networks.

Shape legend: P particles of the boundary, D dimensions, K obstacle cells.
"""

import numpy as np
from scipy.spatial import KDTree

from hgn.scene.obstacle_grid import ObstacleGrid, grid_of_samples
from hgn.schema import require

NEAR = 1.9  # neighbourhood for normals, in spacings; it contains two layers and not three
THIN = 0.1  # ratio of the spreads across and along a surface below which the surface is one layer
CROWD = 1000  # largest mean number of neighbours; a body has about 30
ONE_SIDED = 0.25  # mean neighbour offset, in spacings, above which it points into a body


def spacing(point_PD: np.ndarray) -> float:
    """Returns the median distance of a particle to its nearest neighbour."""
    if len(point_PD) < 2:
        return 0.0
    return float(np.median(KDTree(point_PD).query(point_PD, k=2)[0][:, 1]))


def boundary_grid(point_P3: np.ndarray, dimensions: int, cell_size: float) -> ObstacleGrid:
    """Returns the cells that contain particles of the boundary, with the normals of its surface.

    At the surface of a body a normal points away from the other particles. In a thin layer it has the direction of
    least spread. As for meshes, its sign is chosen towards the centre of the cell.
    """
    point_PD = point_P3[:, :dimensions].astype(np.float64)
    normal_P3 = np.zeros((len(point_PD), 3))
    apart, tree = spacing(point_PD), KDTree(point_PD)
    pairs = int(tree.count_neighbors(tree, NEAR * apart))
    rule = f"at most {CROWD} within {NEAR:g} spacings of each"
    require(pairs <= CROWD * len(point_PD), "boundary particles", rule, pairs / max(1, len(point_PD)))
    for own, near in enumerate(tree.query_ball_point(point_PD, NEAR * apart)):
        offset_ND = point_PD[near] - point_PD[own]
        mean_D = offset_ND.mean(axis=0)
        spread_D, axes_DD = np.linalg.eigh(offset_ND.T @ offset_ND)
        if spread_D[0] > THIN * spread_D[1] and np.linalg.norm(mean_D) > ONE_SIDED * apart:
            normal_P3[own, :dimensions] = -mean_D
        else:
            normal_P3[own, :dimensions] = axes_DD[:, 0]
    normal_P3 /= np.linalg.norm(normal_P3, axis=1, keepdims=True)
    return grid_of_samples(point_P3.astype(np.float64), normal_P3, cell_size)
