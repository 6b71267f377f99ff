"""Obstacle triangles near each cell, for the obstacle constraint: particles stay outside obstacles.

A triangle covers the points within `clearance` of its plane and at most MARGIN * clearance beyond its edges. Its row
contains four planes (unit normal and offset) and a box. The first plane is its own; the others are those of the edges,
which point outwards and are moved out by the margin. The box of the corners is widened by 2 * clearance. Covered points
are inside the edge planes and the box.
Shape legend: F triangles, Q cells, E entries of their lists, C cells of a box.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hgn.scene.obstacle_grid import SPLIT_CELLS
from hgn.scene.rotation import round_to_float32
from hgn.scene.surface import area_vectors, split_long_edges
from hgn.schema import Vector, require

ROW = 24  # numbers of a triangle: four planes of four, then the box's two corners, padded with zeros
CELLS = 2  # (cell size) / (obstacle cell size); smaller cells would have more lists, and no shorter ones
# fraction of the clearance, enough for rounding at shared edges; a margin as wide as the clearance would form a lip at
# convex edges, and stop sliding particles
MARGIN = 0.1
LEAST_HEIGHT = 1e-9  # smallest height above the longest edge, domain units; neighbours cover thinner triangles
CELLS_AT_ONCE = 1 << 18  # number of cells of triangles' boxes in a pass; limits memory


@dataclass(frozen=True, eq=False)
class Barrier:
    """The obstacles of one scene. Cell q spans [q, q + 1) * cell_size.

    A path is cut into pieces no longer than a cell. The lists of the cells at the pieces' midpoints contain every
    triangle that covers a part of the path.
    """

    cell_size: float
    clearance: float  # domain units
    cell_Q3: np.ndarray  # int32, unique rows, lexicographically sorted
    start_Q: np.ndarray  # int32 [Q + 1]: entries of cell q are start_Q[q] to start_Q[q + 1]
    triangle_E: np.ndarray  # int32
    row_F24: np.ndarray  # float32


def build_barrier(corner_F33: np.ndarray, cell_size: float, clearance: float, domain_size: Vector) -> Barrier:
    """Returns the barrier of triangles, corners [F, 3, 3] in domain units. `cell_size` is the obstacle cells'.

    Parts more than a cell outside the domain are omitted. Raises: ConfigError for an invalid clearance.
    """
    return barrier_of_pieces(barrier_pieces(corner_F33, cell_size, domain_size), cell_size, clearance)


def barrier_pieces(corner_F33: np.ndarray, cell_size: float, domain_size: Vector | None = None) -> np.ndarray:
    """Returns the triangles of a barrier, corners float64 [F', 3, 3]: long ones are cut, those without area omitted.

    With `domain_size`, pieces more than a cell outside are omitted. Corners are rounded to float32 for equal rows.
    """
    box = None
    if domain_size is not None:
        box = (np.full(3, -cell_size), np.array(domain_size, np.float64) + cell_size)
    corner_F33 = round_to_float32(split_long_edges(corner_F33, SPLIT_CELLS * cell_size, box))
    area = np.linalg.norm(area_vectors(corner_F33), axis=1)
    longest = np.linalg.norm(np.roll(corner_F33, -1, axis=1) - corner_F33, axis=2).max(axis=1, initial=0.0)
    return np.asarray(corner_F33[2 * area > LEAST_HEIGHT * longest])


def barrier_of_pieces(corner_F33: np.ndarray, cell_size: float, clearance: float) -> Barrier:
    """Returns the barrier of `barrier_pieces`: row f is triangle f. Raises: ConfigError for an invalid clearance."""
    require(0 < clearance <= cell_size, "obstacle_clearance", f"above 0 and at most a cell ({cell_size:g})", clearance)
    row_F24, cell_size = _rows(corner_F33, clearance), CELLS * cell_size
    cell_Q3, start_Q, triangle_E = _lists(row_F24, cell_size, clearance)
    return Barrier(
        cell_size,
        clearance,
        cell_Q3.astype(np.int32),
        start_Q.astype(np.int32),
        triangle_E.astype(np.int32),
        row_F24.astype(np.float32),
    )


def _rows(corner_F33: np.ndarray, clearance: float) -> np.ndarray:
    normal_F3 = area_vectors(corner_F33)
    normal_F3 /= np.maximum(np.linalg.norm(normal_F3, axis=1, keepdims=True), 1e-300)
    row_F24 = np.zeros((len(corner_F33), ROW))
    for plane in range(4):
        corner_F3, direction_F3 = corner_F33[:, plane - 1], normal_F3
        if plane:
            direction_F3 = np.cross(corner_F33[:, plane % 3] - corner_F3, normal_F3)
            direction_F3 = direction_F3 / np.maximum(np.linalg.norm(direction_F3, axis=1, keepdims=True), 1e-300)
        row_F24[:, 4 * plane : 4 * plane + 3] = direction_F3
        row_F24[:, 4 * plane + 3] = (direction_F3 * corner_F3).sum(axis=1) + (MARGIN * clearance if plane else 0.0)
    row_F24[:, 16:19] = corner_F33.min(axis=1) - 2 * clearance
    row_F24[:, 20:23] = corner_F33.max(axis=1) + 2 * clearance
    return row_F24


def _lists(row_F24: np.ndarray, cell_size: float, clearance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns cells [Q, 3], the start of each cell's list [Q + 1], and the triangles of all lists [E].

    A list contains the triangles within half a cell, because a piece of a path may extend half a cell beyond the cell
    of its midpoint.
    """
    reach = 0.5 * cell_size * (1 + 1e-3)
    low_F3 = np.floor((row_F24[:, 16:19] - reach) / cell_size).astype(np.int64)
    extent_F3 = np.floor((row_F24[:, 20:23] + reach) / cell_size).astype(np.int64) - low_F3 + 1
    origin_3 = low_F3.min(axis=0, initial=0)
    all_cells = tuple((low_F3 + extent_F3).max(axis=0, initial=1) - origin_3)  # extents, which number the cells
    low_F = np.ravel_multi_index(tuple((low_F3 - origin_3).T), all_cells)
    numbers, triangles = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for triangle_F, cell_3C in _alike(extent_F3):
        cell_C = np.ravel_multi_index(tuple(cell_3C), all_cells)
        f, c = np.nonzero(_near(row_F24[triangle_F], low_F3[triangle_F], cell_3C, cell_size, reach, clearance))
        numbers.append(low_F[triangle_F[f]] + cell_C[c])
        triangles.append(triangle_F[f])
    number_E, triangle_E = np.concatenate(numbers), np.concatenate(triangles)
    order_E = np.lexsort((triangle_E, number_E))
    number_E, triangle_E = number_E[order_E], triangle_E[order_E]
    first_Q = np.flatnonzero(np.diff(number_E, prepend=-1))
    cell_Q3 = np.stack(np.unravel_index(number_E[first_Q], all_cells), axis=1) + origin_3
    return cell_Q3, np.append(first_Q, len(number_E)), triangle_E


def _alike(extent_F3: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Groups triangles [F'] by the extents of their boxes. Yields them with the cells of such a box, [3, C]."""
    shape = tuple(extent_F3.max(axis=0, initial=0) + 1)
    extent_F = np.ravel_multi_index(tuple(extent_F3.T), shape)
    for extent in np.unique(extent_F):
        cell_3C = np.indices(np.unravel_index(extent, shape)).reshape(3, -1)
        triangle_F, count = np.flatnonzero(extent_F == extent), max(1, CELLS_AT_ONCE // cell_3C.shape[1])
        for first in range(0, len(triangle_F), count):
            yield triangle_F[first : first + count], cell_3C


def _near(
    row_F24: np.ndarray, low_F3: np.ndarray, cell_3C: np.ndarray, cell_size: float, reach: float, clearance: float
) -> np.ndarray:
    """Returns whether the planes allow a triangle's covered volume within `reach` of a cell, bool [F, C]."""
    centre_F3, half = (low_F3 + 0.5) * cell_size, 0.5 * cell_size + reach
    near_FC = np.ones((len(row_F24), cell_3C.shape[1]), bool)
    for plane in range(4):
        normal_F3, offset_F = row_F24[:, 4 * plane : 4 * plane + 3], row_F24[:, 4 * plane + 3]
        distance_FC = (normal_F3 * cell_size) @ cell_3C
        distance_FC += ((normal_F3 * centre_F3).sum(axis=1) - offset_F)[:, None]
        spread_F1 = half * np.abs(normal_F3).sum(axis=1, keepdims=True)
        near_FC &= (np.abs(distance_FC) <= spread_F1 + clearance) if plane == 0 else (distance_FC <= spread_F1)
    return near_FC
