"""Obstacles as the network sees them: one mean normal in each grid cell that an obstacle passes through.

Paper sec. 3: sample the surface with points no closer than cell_size / 4, flip each sample's normal where it
points away from the centre of its cell, sum per cell, normalise. Stored sparsely.
Not the paper's: a cell's surface is a plane, across its normal and through the middle of its samples, and how far the
cell's centre is from it is stored too. Networks with `network.obstacle_distances` see planes, those of the cells around
too (`surface_planes`).
Shape legend: K obstacle cells, S surface samples, F triangles, P planes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hgn.scene.scene import Obstacle, all_corners
from hgn.scene.surface import area_vectors, sample_surface, split_long_edges
from hgn.schema import ConfigError, Vector, require

# A plane's distance from the centre of its own cell, at most, in cells: behind the surface, too, where it is bent
FARTHEST = 0.9
# Beside its plane's place by more than that many cells, a cell is past an edge: it sees the way from the place instead
PAST_EDGE = 0.75
CANCELLED = 0.25  # below this mean length the normals of a cell cancel; three faces of a corner give 0.58
NORMAL_SPACING_CELLS = 0.25  # of the samples that normals are made from
SPLIT_CELLS = 16.0  # longest edge, in cells, of the pieces that are cut to the domain


@dataclass(frozen=True, eq=False)
class ObstacleGrid:
    """Sparse cells with unit normals; cell k spans [k, k + 1) * cell_size."""

    cell_size: float
    cell_K3: np.ndarray  # int32, unique rows, lexicographically sorted
    normal_K3: np.ndarray  # float32, unit length
    # float32: of the cell's centre from the surface, along the normal, in cells; none in data of before
    distance_K: np.ndarray | None = None


def build_obstacle_grid(
    obstacles: Sequence[Obstacle],
    cell_size: float,
    seed: int,
    domain_size: Vector | None = None,
) -> ObstacleGrid:
    """The mean obstacle normal of every cell that a surface passes through (Paper sec. 3).

    Samples no two closer than cell_size / 4, over all obstacles together; each gives its triangle's normal,
    negated where it points away from the cell's centre; summed per cell and normalised. Where the sum cancels
    (two sheets facing each other across the centre) the cell takes the corrected normal of the sample nearest
    to its centre, for a sum near zero says nothing about direction and zero would say "no obstacle".
    Zero-area triangles are skipped. Cells may lie outside the domain; with `domain_size` those more than a
    cell outside are left out, which keeps a mesh much larger than the domain affordable. Deterministic.

    Raises: ConfigError for a bad cell size, or a surface too large to sample.
    """
    return grid_of_samples(*surface_samples(obstacles, cell_size, seed, domain_size), cell_size)


def surface_samples(
    obstacles: Sequence[Obstacle],
    cell_size: float,
    seed: int,
    domain_size: Vector | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The points that `build_obstacle_grid` takes normals from, float64 [S, 3], and their triangles' unit normals.

    They may be turned and moved with an obstacle, to have the cells of other places without sampling it again.
    Raises: ConfigError as `build_obstacle_grid`.
    """
    corner_F33, point_S3, owner_S = _samples(obstacles, cell_size, seed, domain_size)
    normal_S3 = area_vectors(corner_F33[owner_S])
    return point_S3, normal_S3 / np.sqrt((normal_S3 * normal_S3).sum(axis=1, keepdims=True))


def grid_of_samples(point_S3: np.ndarray, normal_S3: np.ndarray, cell_size: float) -> ObstacleGrid:
    """The mean normal of every cell that holds a sample, from points and unit normals of `surface_samples`."""
    if len(point_S3) == 0:
        return ObstacleGrid(
            cell_size, np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
        )

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
    normal_K3 = sum_K3 / length_K[:, None]
    # the mean of a cell's samples lies between sheets that face each other: there the nearest one is meant
    way_K3 = np.stack([np.bincount(cell_S, to_centre_S3[:, axis], len(key_K)) for axis in range(3)], axis=1)
    way_K3 = np.where(cancelled_K[:, None], to_centre_S3[nearest_K], way_K3 / count_K[:, None])
    distance_K = np.clip((normal_K3 * way_K3).sum(axis=1) / cell_size, -FARTHEST, FARTHEST)
    cell_K3 = np.stack(np.unravel_index(key_K, extent), axis=1) + low
    return ObstacleGrid(
        cell_size, cell_K3.astype(np.int32), normal_K3.astype(np.float32), distance_K.astype(np.float32)
    )


def shown_cells(grid: ObstacleGrid, planes: bool) -> tuple[np.ndarray, np.ndarray]:
    """The cells that a network sees, int32 [K, 3], with their normals, or `surface_planes`, float32 [K, 3]."""
    return surface_planes(grid) if planes else (grid.cell_K3, grid.normal_K3)


def surface_planes(grid: ObstacleGrid) -> tuple[np.ndarray, np.ndarray]:
    """Cells that hold a surface or touch one that does, int32 [P, 3], sorted, and the surface that each sees, as a
    vector along its normal of length 1 + the distance of the cell's centre in cells, float32 [P, 3].

    A cell without a surface sees the nearest of the cells around it, from its own side.
    Raises: ConfigError for a grid without distances.
    """
    if len(grid.cell_K3) == 0:
        return grid.cell_K3, grid.normal_K3
    if grid.distance_K is None:
        raise ConfigError(
            "network.obstacle_distances must be false for data without obstacle_distance, which older data are, and "
            "imported ones that name cells and normals; make the data set again, from meshes"
        )
    around_Q3 = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    normal_K3 = grid.normal_K3.astype(np.float64)
    place_K3 = -grid.distance_K[:, None] * normal_K3  # of the surface, from its cell's centre, in cells
    # squared distances of all cells around, [Q, K]; a cell's own surface comes first
    far_QK = np.zeros((len(around_Q3), len(place_K3)))
    for axis in range(3):
        far_QK += (around_Q3[:, axis, None] - place_K3[:, axis]) ** 2
    far_QK[len(around_Q3) // 2] = -1
    cell_K3 = grid.cell_K3.astype(np.int64)
    _, low, extent = _lexicographic_keys(np.stack([cell_K3.min(axis=0) - 1, cell_K3.max(axis=0) + 1]))
    # what is added to a cell is added to its key
    stride_3 = np.array([extent[1] * extent[2], extent[2], 1])
    key_QK = (around_Q3 @ stride_3)[:, None] + (cell_K3 - low) @ stride_3
    key_P, which_A = np.unique(key_QK.ravel(), return_inverse=True)
    least_P = np.full(len(key_P), np.inf)
    np.minimum.at(least_P, which_A, far_QK.ravel())
    nearest_A = np.flatnonzero(far_QK.ravel() == least_P[which_A])
    chosen_P = np.empty(len(key_P), np.int64)
    chosen_P[which_A[nearest_A]] = nearest_A  # of several any
    side_P, own_P = np.divmod(chosen_P, len(normal_K3))
    way_P3, normal_P3 = around_Q3[side_P] - place_K3[own_P], normal_K3[own_P]
    height_P = (way_P3 * normal_P3).sum(axis=1)
    beside_P3 = way_P3 - height_P[:, None] * normal_P3
    inside_P = side_P == len(around_Q3) // 2
    length_P = np.sqrt((way_P3**2).sum(axis=1))
    past_P = ~inside_P & ((beside_P3**2).sum(axis=1) > PAST_EDGE**2)
    normal_P3 = np.where(past_P[:, None], way_P3 / np.where(past_P, length_P, 1.0)[:, None], normal_P3)
    height_P = np.where(past_P, length_P, height_P)
    behind_P = ~inside_P & (height_P < 0)
    normal_P3, height_P = np.where(behind_P[:, None], -normal_P3, normal_P3), np.where(behind_P, -height_P, height_P)
    cell_P3 = np.stack(np.unravel_index(key_P, extent), axis=1) + low
    return cell_P3.astype(np.int32), ((1 + height_P)[:, None] * normal_P3).astype(np.float32)


def surface_points(
    obstacles: Sequence[Obstacle],
    cell_size: float,
    seed: int,
    domain_size: Vector | None = None,
    spacing_cells: float = NORMAL_SPACING_CELLS,
) -> np.ndarray:
    """Points on obstacles no closer than `spacing_cells` cells, float32 [S, 3]: GNS's static particles.

    At the default spacing these are the samples that the normals of `build_obstacle_grid` are made from.
    Raises: ConfigError for a bad cell size, or a surface too large to sample.
    """
    return _samples(obstacles, cell_size, seed, domain_size, spacing_cells)[1].astype(np.float32)


def _samples(
    obstacles: Sequence[Obstacle],
    cell_size: float,
    seed: int,
    domain_size: Vector | None,
    spacing_cells: float = NORMAL_SPACING_CELLS,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangle corners, surface points no closer than `spacing_cells` cells, and the triangle of each."""
    require(0 < cell_size < np.inf, "cell_size", "a finite number > 0", cell_size, "the paper uses 1/64")
    corner_F33 = all_corners(obstacles)
    if domain_size is not None:
        box = (np.full(3, -cell_size), np.array(domain_size, np.float64) + cell_size)
        corner_F33 = split_long_edges(corner_F33, SPLIT_CELLS * cell_size, box)
    rng = np.random.Generator(np.random.PCG64(seed))
    point_S3, owner_S = sample_surface(corner_F33, spacing_cells * cell_size, rng)
    if domain_size is not None:
        near = ((point_S3 >= box[0]) & (point_S3 < box[1])).all(axis=1)
        point_S3, owner_S = point_S3[near], owner_S[near]
    return corner_F33, point_S3, owner_S


def _lexicographic_keys(floor_S3: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
    """One integer per cell that sorts like the cell's coordinates; with the lowest cell and the extent."""
    low, high = floor_S3.min(axis=0), floor_S3.max(axis=0)
    extent = [int(length) + 1 for length in high - low]
    if max(abs(low).max(), abs(high).max()) >= 2**31 or extent[0] * extent[1] * extent[2] >= 2**63:
        raise ConfigError(
            f"obstacles must lie within 2^31 cells of the origin and span fewer than 2^63 cells, got cells "
            f"{low.tolist()} to {high.tolist()}; scale or move the mesh"
        )
    index = (floor_S3 - low).astype(np.int64)
    return np.ravel_multi_index(tuple(index.T), tuple(extent)), low.astype(np.int64), tuple(extent)
