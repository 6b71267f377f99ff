"""Obstacle cells, the network's input: a mean normal for each cell that an obstacle passes through.

Paper sec. 3: sample the surface with points at least cell_size / 4 apart. Flip a sample's normal if it points away from
the centre of its cell. Sum the normals of a cell, and normalise. Cells are stored sparsely.
`surface_planes` describes the surface near these cells too, for networks that see distances to obstacles.
Shape legend: K obstacle cells, B cells near a surface, S surface samples, F triangles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hgn.scene.scene import Obstacle, all_corners
from hgn.scene.surface import area_vectors, sample_surface, split_long_edges
from hgn.schema import ConfigError, Vector, require

CANCELLED = 0.25  # length of a cell's mean normal below which its normals cancel; three faces of a corner give 0.58
NORMAL_SPACING_CELLS = 0.25  # distance of the samples, in cells
SPLIT_CELLS = 16.0  # longest edge, in cells; longer triangles are divided, and pieces outside the domain are omitted
REACH_CELLS = 2  # distance from an obstacle at which a network with distances begins to see it, in obstacle cells
# A cell's piece of surface is a disk of this radius, in cells: a circle with the area of a cell's face, and a bit more.
DISK_CELLS = 0.6


@dataclass(frozen=True, eq=False)
class ObstacleGrid:
    """Sparse cells with unit normals. Cell k spans [k, k + 1) * cell_size."""

    cell_size: float
    cell_K3: np.ndarray  # int32, unique rows, lexicographically sorted
    normal_K3: np.ndarray  # float32, unit length
    friction_K: np.ndarray | None = None  # float32, Coulomb coefficients; None: no obstacle has its own
    point_K3: np.ndarray | None = None  # float32, mean surface point from the cell's centre, in cells; None: the centre


def build_obstacle_grid(
    obstacles: Sequence[Obstacle], cell_size: float, seed: int, domain_size: Vector | None = None
) -> ObstacleGrid:
    """Returns the mean obstacle normal of every cell that a surface passes through (Paper sec. 3).

    Samples of all obstacles are at least cell_size / 4 apart. A sample contributes its triangle's normal, negated if it
    points away from the cell's centre. The sum of a cell is normalised. The sum may cancel (two sheets on both sides of
    the centre). The cell then gets the normal of the sample nearest to its centre. Zero would mean "no obstacle".
    Zero-area triangles are skipped. With `domain_size`, cells more than a cell outside the domain are omitted, which
    limits the cost of large meshes. A cell has the mean friction of its samples. The result is deterministic.
    Raises: ConfigError for a bad cell size, or for a surface that is too large to sample.
    """
    point_S3, normal_S3, friction_S = surface_samples(obstacles, cell_size, seed, domain_size)
    known = any(obstacle.friction is not None for obstacle in obstacles)
    return grid_of_samples(point_S3, normal_S3, cell_size, friction_S if known else None)


def grid_of_samples(
    point_S3: np.ndarray, normal_S3: np.ndarray, cell_size: float, friction_S: np.ndarray | None = None
) -> ObstacleGrid:
    """Returns the mean normal of every cell with a sample, from points and normals of `surface_samples`."""
    if len(point_S3) == 0:
        return ObstacleGrid(cell_size, np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))

    floor_S3 = np.floor(point_S3 / cell_size)
    key_S, low, extent = _lexicographic_keys(floor_S3)
    to_centre_S3 = (floor_S3 + 0.5) * cell_size - point_S3
    away = (normal_S3 * to_centre_S3).sum(axis=1) < 0
    normal_S3 = np.where(away[:, None], -normal_S3, normal_S3)

    key_K, cell_S, count_K = np.unique(key_S, return_inverse=True, return_counts=True)
    sum_K3 = np.stack([np.bincount(cell_S, normal_S3[:, axis], len(key_K)) for axis in range(3)], axis=1)
    length_K = np.sqrt((sum_K3 * sum_K3).sum(axis=1))
    by_nearness = np.lexsort(((to_centre_S3 * to_centre_S3).sum(axis=1), cell_S))
    nearest_K = by_nearness[np.cumsum(count_K) - count_K]
    cancelled_K = length_K < CANCELLED * count_K
    sum_K3[cancelled_K] = normal_S3[nearest_K[cancelled_K]]
    length_K[cancelled_K] = 1.0
    cell_K3 = np.stack(np.unravel_index(key_K, extent), axis=1) + low
    normal_K3 = (sum_K3 / length_K[:, None]).astype(np.float32)

    def mean(value_S: np.ndarray) -> np.ndarray:
        return (np.bincount(cell_S, value_S, len(key_K)) / count_K).astype(np.float32)

    point_K3 = np.stack([mean(-to_centre_S3[:, axis] / cell_size) for axis in range(3)], axis=1)
    friction_K = None if friction_S is None else mean(friction_S)
    return ObstacleGrid(cell_size, cell_K3.astype(np.int32), normal_K3, friction_K, point_K3)


def surface_planes(grid: ObstacleGrid) -> tuple[ObstacleGrid, np.ndarray]:
    """Returns the cells near a surface, and the offsets of their planes, float32 [B], domain units.

    The points x of a cell's plane fulfil n . (x - centre of the cell) = offset. An obstacle cell has the plane through
    its mean point with its mean normal n; its surface counts as a disk about this point. Another cell has a plane if
    the nearest disk is at most REACH_CELLS + 0.5 cells from its centre. This plane goes through the nearest point of
    the disk, n points from there to the centre, and the friction is that of the disk.
    """
    own_K3 = np.zeros_like(grid.normal_K3) if grid.point_K3 is None else grid.point_K3
    normal_K3, own_K3 = grid.normal_K3.astype(np.float64), own_K3.astype(np.float64)
    around = slice(-REACH_CELLS, REACH_CELLS + 1)
    step_D3 = np.mgrid[around, around, around].reshape(3, -1).T
    # the vector from the mean point of cell K to the centre of the cell D steps away, in cells: its part across the
    # disk, its squared length, its part along the disk
    own_K = (normal_K3 * own_K3).sum(axis=1)
    height_DK = step_D3 @ normal_K3.T - own_K
    square_DK = (step_D3 * step_D3).sum(axis=1)[:, None] - 2 * step_D3 @ own_K3.T + (own_K3 * own_K3).sum(axis=1)
    along_DK = np.sqrt(np.maximum(square_DK - height_DK * height_DK, 0))
    distance_DK = np.hypot(height_DK, np.maximum(along_DK - DISK_CELLS, 0))
    distance_DK[len(step_D3) // 2] = -1.0  # the cell itself, which comes first
    d_P, k_P = np.nonzero(distance_DK <= REACH_CELLS + 0.5)
    # a number for each cell, in the order of its coordinates
    low_3 = grid.cell_K3.min(axis=0, initial=0).astype(np.int64) - REACH_CELLS
    extent_3 = grid.cell_K3.max(axis=0, initial=0) - low_3 + REACH_CELLS + 1
    stride_3 = np.array([extent_3[1] * extent_3[2], extent_3[2], 1])
    number_P = ((grid.cell_K3 - low_3) @ stride_3)[k_P] + (step_D3 @ stride_3)[d_P]
    order_P = np.lexsort((distance_DK[d_P, k_P], number_P))
    chosen_B = order_P[np.diff(number_P[order_P], prepend=-1) != 0]
    d_B, k_B = d_P[chosen_B], k_P[chosen_B]
    distance_B, along_B, height_B = (value_DK[d_B, k_B] for value_DK in (distance_DK, along_DK, height_DK))
    across_B3 = height_B[:, None] * normal_K3[k_B]
    beyond_B = np.maximum(1 - DISK_CELLS / np.maximum(along_B, DISK_CELLS), 0)
    away_B3 = across_B3 + beyond_B[:, None] * (step_D3[d_B] - own_K3[k_B] - across_B3)
    here_B = distance_B < 0
    away_B3 /= np.maximum(distance_B, 1e-6)[:, None]
    normal_B3 = np.where(here_B[:, None], normal_K3[k_B], away_B3).astype(np.float32)
    offset_B = grid.cell_size * np.where(here_B, own_K[k_B], -distance_B)
    friction_B = None if grid.friction_K is None else grid.friction_K[k_B]
    cell_B3 = grid.cell_K3[k_B] + step_D3[d_B].astype(np.int32)
    near = ObstacleGrid(grid.cell_size, cell_B3, normal_B3, friction_B)
    return near, offset_B.astype(np.float32)


def surface_samples(
    obstacles: Sequence[Obstacle], cell_size: float, seed: int, domain_size: Vector | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the samples of `build_obstacle_grid`, float64 [S, 3], and unit normals and friction of their triangles.

    They can be moved with an obstacle to compute its cells elsewhere without sampling it again.
    Raises: ConfigError as `build_obstacle_grid`.
    """
    require(0 < cell_size < np.inf, "cell_size", "a finite number > 0", cell_size, "the paper uses 1/64")
    sizes = np.array([len(obstacle.triangle_F3) for obstacle in obstacles], np.int64)
    friction_F = np.repeat(np.array([obstacle.friction or 0.0 for obstacle in obstacles]), sizes)
    # friction is a fourth coordinate, which pieces of a triangle inherit
    corner_F34 = np.concatenate([all_corners(obstacles), np.tile(friction_F[:, None, None], (1, 3, 1))], axis=2)
    if domain_size is not None:
        box = (np.full(3, -cell_size), np.array(domain_size, np.float64) + cell_size)
        unbounded = (np.append(box[0], -np.inf), np.append(box[1], np.inf))
        corner_F34 = split_long_edges(corner_F34, SPLIT_CELLS * cell_size, unbounded)
    corner_F33 = np.ascontiguousarray(corner_F34[..., :3])
    rng = np.random.Generator(np.random.PCG64(seed))
    point_S3, owner_S = sample_surface(corner_F33, NORMAL_SPACING_CELLS * cell_size, rng)
    if domain_size is not None:
        near = ((point_S3 >= box[0]) & (point_S3 < box[1])).all(axis=1)
        point_S3, owner_S = point_S3[near], owner_S[near]
    normal_S3 = area_vectors(corner_F33[owner_S])
    normal_S3 /= np.sqrt((normal_S3 * normal_S3).sum(axis=1, keepdims=True))
    return point_S3, normal_S3, corner_F34[owner_S, 0, 3]


def _lexicographic_keys(floor_S3: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
    """Returns an integer per cell that sorts like its coordinates, then the lowest cell and the extent."""
    low, high = floor_S3.min(axis=0), floor_S3.max(axis=0)
    extent = [int(length) + 1 for length in high - low]
    if max(abs(low).max(), abs(high).max()) >= 2**31 or extent[0] * extent[1] * extent[2] >= 2**63:
        raise ConfigError(
            f"obstacles must lie within 2^31 cells of the origin and span fewer than 2^63 cells, got cells "
            f"{low.tolist()} to {high.tolist()}; scale or move the mesh"
        )
    index = (floor_S3 - low).astype(np.int64)
    return np.ravel_multi_index(tuple(index.T), tuple(extent)), low.astype(np.int64), tuple(extent)
