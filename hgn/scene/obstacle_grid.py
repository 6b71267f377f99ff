"""Obstacle cells, the network's input: a mean normal for each cell that an obstacle passes through.

Paper sec. 3: sample the surface with points at least cell_size / 4 apart. Flip a sample's normal if it points away from
the centre of its cell. Sum the normals of a cell, and normalise. Cells are stored sparsely.
Shape legend: K obstacle cells, S surface samples, F triangles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hgn.scene.scene import Obstacle, all_corners
from hgn.scene.surface import MAXIMUM_SAMPLES, area_vectors, sample_surface, split_long_edges
from hgn.schema import ConfigError, Vector, require

CANCELLED = 0.25  # length of a cell's mean normal below which its normals cancel; three faces of a corner give 0.58
NORMAL_SPACING_CELLS = 0.25  # distance of the samples, in cells
SPLIT_CELLS = 16.0  # longest edge, in cells; longer triangles are divided, and pieces outside the domain are omitted


@dataclass(frozen=True, eq=False)
class ObstacleGrid:
    """Sparse cells with unit normals. Cell k spans [k, k + 1) * cell_size."""

    cell_size: float
    cell_K3: np.ndarray  # int32, unique rows, lexicographically sorted
    normal_K3: np.ndarray  # float32, unit length
    friction_K: np.ndarray | None = None  # float32, Coulomb coefficients; None: no obstacle has its own
    # float32, distance of a cell's centre from the surface along its normal, in cells; None: the paper's cells
    distance_K: np.ndarray | None = None


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
    known = any(obstacle.friction for obstacle in obstacles)
    return grid_of_samples(point_S3, normal_S3, cell_size, friction_S if known else None)


def grid_of_samples(
    point_S3: np.ndarray, normal_S3: np.ndarray, cell_size: float, friction_S: np.ndarray | None = None
) -> ObstacleGrid:
    """Returns the mean normal of every cell with a sample, from points and normals of `surface_samples`."""
    if len(point_S3) == 0:
        return ObstacleGrid(cell_size, np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))

    floor_S3 = np.floor(point_S3 / cell_size)
    key_S, low, extent = lexicographic_keys(floor_S3)
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
    grid = ObstacleGrid(cell_size, cell_K3.astype(np.int32), (sum_K3 / length_K[:, None]).astype(np.float32))
    if friction_S is None:
        return grid
    return replace(grid, friction_K=(np.bincount(cell_S, friction_S, len(key_K)) / count_K).astype(np.float32))


def surface_samples(
    obstacles: Sequence[Obstacle],
    cell_size: float,
    seed: int,
    domain_size: Vector | None = None,
    most: int = MAXIMUM_SAMPLES,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the samples of `build_obstacle_grid`, float64 [S, 3], and unit normals and friction of their triangles.

    They can be moved with an obstacle to compute its cells elsewhere without sampling it again.
    Raises: ConfigError as `build_obstacle_grid`, here for `most` samples or more.
    """
    require(0 < cell_size < np.inf, "cell_size", "a finite number > 0", cell_size, "the paper uses 1/64")
    sizes = np.array([len(obstacle.triangle_F3) for obstacle in obstacles], np.int64)
    friction_F = np.repeat(np.array([obstacle.friction for obstacle in obstacles]), sizes)
    # friction is a fourth coordinate, which pieces of a triangle inherit
    corner_F34 = np.concatenate([all_corners(obstacles), np.tile(friction_F[:, None, None], (1, 3, 1))], axis=2)
    if domain_size is not None:
        box = (np.full(3, -cell_size), np.array(domain_size, np.float64) + cell_size)
        unbounded = (np.append(box[0], -np.inf), np.append(box[1], np.inf))
        corner_F34 = split_long_edges(corner_F34, SPLIT_CELLS * cell_size, unbounded)
    corner_F33 = np.ascontiguousarray(corner_F34[..., :3])
    rng = np.random.Generator(np.random.PCG64(seed))
    point_S3, owner_S = sample_surface(corner_F33, NORMAL_SPACING_CELLS * cell_size, rng, most)
    if domain_size is not None:
        near = ((point_S3 >= box[0]) & (point_S3 < box[1])).all(axis=1)
        point_S3, owner_S = point_S3[near], owner_S[near]
    normal_S3 = area_vectors(corner_F33[owner_S])
    normal_S3 /= np.sqrt((normal_S3 * normal_S3).sum(axis=1, keepdims=True))
    return point_S3, normal_S3, corner_F34[owner_S, 0, 3]


def lexicographic_keys(floor_S3: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
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
