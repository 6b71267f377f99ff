"""The field of distances around obstacles, an input of networks with `network.obstacle_distance`.

The cells that a surface passes through (hgn.scene.obstacle_grid) do not show how far a particle is from the surface:
they end between 0 and 1 cell above it, depending on where the surface lies in its cells. The solver acts on particles
up to 1.7 cells away. So a network cannot see on which side of a plate's edge a body is supported.

The field has all cells within reach of a surface. Each has the unit vector n from the surface point nearest to the
cell's centre c, and the distance d_c of the centre. A particle at x in the cell is n . (x - c) + d_c from the surface.
The network's input is n times the nearness 1 - |distance| / REACH, at least 0; behind the surface it is -n times that.
Shape legend: K cells, F triangles, S points of surfaces.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hgn.scene.distance import closest_points
from hgn.scene.obstacle_grid import ObstacleGrid, lexicographic_keys
from hgn.scene.surface import area_vectors, split_long_edges
from hgn.schema import Vector

REACH_CELLS = 2.0  # distance from a surface at which nearness is 0, in cells
FARTHEST_CELLS = REACH_CELLS + 0.75**0.5  # largest distance of a cell's centre that a particle in the cell may be near
PIECE_CELLS = 2.0  # longest edge of a piece of a triangle, in cells
POINTS_PER_CELL = 2  # number of points along an edge of one cell
CANDIDATES = 4  # number of points nearest to a centre whose triangles are measured
LEAF_POINTS = 64  # number of points in a leaf of the tree; queries take half the time that they take with SciPy's 16
INWARD = 0.05  # fraction by which points move towards the other corners, so that each belongs to one triangle
ON_SURFACE = 1e-6  # distance of a centre, in cells, below which n is the normal of the triangle


def surface_field(grid: ObstacleGrid, corner_F33: np.ndarray, domain_size: Vector | None = None) -> ObstacleGrid:
    """Returns the field of triangles, corners [F, 3, 3] in domain units, in cells of the size of `grid`.

    Friction is that of the cell of `grid` next to the surface point. With `domain_size`, pieces farther than
    FARTHEST_CELLS outside are omitted. The points nearest to a centre, of many on the surface, name the triangles that
    are measured. Zero-area triangles are skipped.
    Raises: ConfigError for a surface that is too large.
    """
    from scipy.spatial import cKDTree

    size, box = grid.cell_size, None
    if domain_size is not None:
        margin = (FARTHEST_CELLS + 1) * size
        box = (np.full(3, -margin), np.array(domain_size, np.float64) + margin)
    corner_F33 = corner_F33[area_vectors(corner_F33).any(axis=1)]
    piece_F33 = split_long_edges(corner_F33, PIECE_CELLS * size, box)
    parts = list(_points(piece_F33, size))
    if not parts:
        return replace(grid, cell_K3=grid.cell_K3[:0], normal_K3=grid.normal_K3[:0], friction_K=None, distance_K=_NONE)
    point_S3, owner_S = (np.concatenate(part) for part in zip(*parts, strict=True))
    cell_K3 = _around(np.floor(point_S3 / size).astype(np.int64))
    tree = cKDTree(point_S3, leafsize=LEAF_POINTS, compact_nodes=False, balanced_tree=False)
    gap = size / POINTS_PER_CELL
    farthest = FARTHEST_CELLS * size + gap
    # a point farther than `gap` behind the nearest one belongs to no nearer triangle
    distance_KC, nearest_KC = tree.query((cell_K3 + 0.5) * size, k=CANDIDATES, distance_upper_bound=farthest + gap)
    near_K = distance_KC[:, 0] < farthest
    # where fewer points are so near, the query gives len(point_S3): any triangle
    cell_K3, owner_KC = cell_K3[near_K], np.append(owner_S, 0)[nearest_KC[near_K]]
    centre_K3, pairs = (cell_K3 + 0.5) * size, owner_KC.shape
    foot_KC3 = closest_points(np.repeat(centre_K3, CANDIDATES, axis=0), piece_F33[owner_KC.flatten()])
    foot_KC3 = foot_KC3.reshape(*pairs, 3)
    best_K = np.square(foot_KC3 - centre_K3[:, None]).sum(axis=-1).argmin(axis=1)
    row_K = np.arange(len(cell_K3))
    foot_K3, triangle_K33 = foot_KC3[row_K, best_K], piece_F33[owner_KC[row_K, best_K]]
    away_K3 = (centre_K3 - foot_K3) / size
    distance_K = np.linalg.norm(away_K3, axis=1)
    normal_K3 = area_vectors(triangle_K33)
    normal_K3 /= np.maximum(np.linalg.norm(normal_K3, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    apart_K = distance_K > ON_SURFACE
    normal_K3[apart_K] = away_K3[apart_K] / distance_K[apart_K, None]
    friction_K = None
    if grid.friction_K is not None:
        friction_K = grid.friction_K[cKDTree((grid.cell_K3 + 0.5) * size).query(foot_K3)[1]]
    distance_K = np.where(apart_K, distance_K, 0.0).astype(np.float32)
    cells = cell_K3.astype(np.int32), normal_K3.astype(np.float32), friction_K, distance_K
    return ObstacleGrid(size, *cells)


_NONE = np.zeros(0, np.float32)


def _points(piece_F33: np.ndarray, cell_size: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields evenly spaced points in triangles, [S, 3], and the numbers of their triangles [S]."""
    edge_F = np.linalg.norm(np.roll(piece_F33, -1, axis=1) - piece_F33, axis=2).max(axis=1, initial=0.0)
    steps_F = np.maximum(np.ceil(edge_F * (POINTS_PER_CELL / cell_size)).astype(np.int64), 1)
    for steps in np.unique(steps_F):
        own = np.flatnonzero(steps_F == steps)
        first, second = np.nonzero(np.add.outer(np.arange(steps + 1), np.arange(steps + 1)) <= steps)
        share_S3 = INWARD + (1 - 3 * INWARD) / steps * np.stack([first, second, steps - first - second], axis=1)
        yield (share_S3 @ piece_F33[own]).reshape(-1, 3), np.repeat(own, len(share_S3))


def _around(cell_S3: np.ndarray) -> np.ndarray:
    """Returns the cells that are at most FARTHEST_CELLS from those of surface points, [K, 3], and a few more.

    They are sorted lexicographically.
    """
    reach = int(np.ceil(FARTHEST_CELLS))
    ends_23 = np.stack([cell_S3.min(axis=0) - reach, cell_S3.max(axis=0) + reach])
    key_S, low_3, extent = lexicographic_keys(np.concatenate([ends_23, cell_S3]))
    key_K = np.unique(key_S[2:])
    for step in (1, extent[2], extent[1] * extent[2]):
        key_K = np.unique(key_K[:, None] + step * np.arange(-reach, reach + 1))
    return np.stack(np.unravel_index(key_K, extent), axis=1) + low_3
