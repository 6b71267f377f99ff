"""Rigid surfaces of obstacles: their triangles, and which of them a particle's way may meet in a cell.

A triangle covers a place that is within `clearance` of its plane and no farther than MARGIN of that beside it. Its row
has four planes, a unit normal and an offset each: its own, then those of its edges, which point outwards and lie that
margin farther out; and the box of its corners, widened by 2 * clearance. It covers what is on the inner side of the
edges, in the box.
Shape legend: F triangles, Q cells, E entries of their lists.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hgn.scene.obstacle_grid import SPLIT_CELLS
from hgn.scene.rotation import round_to_float32
from hgn.scene.surface import area_vectors, split_long_edges
from hgn.schema import Vector, require

ROW = 24  # numbers of a triangle: four planes of four, then the box, lowest and highest corner with a zero behind each
CELLS = 2  # obstacle cells to a cell here: narrower ones have lists as long, and more of them
# of the clearance: enough for rounding at the edges that triangles share; as wide as the clearance it would be a lip
# at convex edges, which stops what slides off
MARGIN = 0.1
LEAST_HEIGHT = 1e-9  # domain units: of a triangle above its longest edge; thinner ones cover nothing that others do not
CELLS_AT_ONCE = 1 << 20  # candidates of triangles, which bounds memory


@dataclass(frozen=True, eq=False)
class Barrier:
    """One scene's obstacles; cell q spans [q, q + 1) * cell_size.

    Where a way is cut into pieces no longer than a cell, whatever is covered of it is in the lists of the cells that
    the pieces' middles lie in.
    """

    cell_size: float
    clearance: float  # domain units
    cell_Q3: np.ndarray  # int32, unique rows, lexicographically sorted
    start_Q: np.ndarray  # int32 [Q + 1]: entries of cell q are start_Q[q] to start_Q[q + 1]
    triangle_E: np.ndarray  # int32
    row_F24: np.ndarray  # float32


def build_barrier(corner_F33: np.ndarray, cell_size: float, clearance: float, domain_size: Vector) -> Barrier:
    """The barrier of triangles, corners [F, 3, 3] in domain units; `cell_size` is that of the obstacle cells. What is
    more than one of these outside the domain is not in it.

    Raises: ConfigError for a clearance that is none.
    """
    return barrier_of_pieces(barrier_pieces(corner_F33, cell_size, domain_size), cell_size, clearance)


def barrier_pieces(corner_F33: np.ndarray, cell_size: float, domain_size: Vector | None = None) -> np.ndarray:
    """The triangles of a barrier, corners float64 [F', 3, 3]: long ones in pieces, without those that have no area.

    With the domain's size, without what is more than a cell outside it. Corners are float32's, so that what is given
    them in that precision has the same rows.
    """
    box = None
    if domain_size is not None:
        box = (np.full(3, -cell_size), np.array(domain_size, np.float64) + cell_size)
    corner_F33 = round_to_float32(split_long_edges(corner_F33, SPLIT_CELLS * cell_size, box))
    area = np.linalg.norm(area_vectors(corner_F33), axis=1)
    longest = np.linalg.norm(np.roll(corner_F33, -1, axis=1) - corner_F33, axis=2).max(axis=1, initial=0.0)
    return np.asarray(corner_F33[2 * area > LEAST_HEIGHT * longest])


def barrier_of_pieces(corner_F33: np.ndarray, cell_size: float, clearance: float) -> Barrier:
    """The barrier of `barrier_pieces`, row f from triangle f. Raises: ConfigError for a clearance that is none."""
    require(0 < clearance <= cell_size, "obstacle_clearance", f"above 0, up to a cell ({cell_size:g})", clearance)
    row_F24, cell_size = _rows(corner_F33, clearance), CELLS * cell_size
    cell_E3, triangle_E = _lists(row_F24, cell_size, clearance)
    order = np.lexsort((triangle_E, *cell_E3.T[::-1]))
    cell_E3, triangle_E = cell_E3[order], triangle_E[order]
    first = np.flatnonzero(np.diff(cell_E3, axis=0, prepend=np.iinfo(np.int64).min // 2).any(axis=1))
    return Barrier(
        cell_size,
        clearance,
        cell_E3[first].astype(np.int32),
        np.append(first, len(triangle_E)).astype(np.int32),
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


def _lists(row_F24: np.ndarray, cell_size: float, clearance: float) -> tuple[np.ndarray, np.ndarray]:
    """Cells int64 [E, 3] and the triangle of each, int64 [E]: those that a triangle's planes and box come to within
    half a cell, for a piece of a way may reach half a cell beyond the cell that its middle is in.
    """
    reach = 0.5 * cell_size * (1 + 1e-3)
    low_F3 = np.floor((row_F24[:, 16:19] - reach) / cell_size).astype(np.int64)
    extent_F3 = np.floor((row_F24[:, 20:23] + reach) / cell_size).astype(np.int64) - low_F3 + 1
    count_F = extent_F3.prod(axis=1)
    cells, owners = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    block_F = np.cumsum(count_F) // CELLS_AT_ONCE
    for block in range(int(block_F[-1]) + 1 if len(block_F) else 0):
        chosen = np.flatnonzero(block_F == block)
        count = count_F[chosen]
        owner_E = np.repeat(chosen, count)
        place_E = np.arange(len(owner_E)) - np.repeat(np.cumsum(count) - count, count)
        extent_E3 = extent_F3[owner_E]
        x_E, rest_E = np.divmod(place_E, extent_E3[:, 1] * extent_E3[:, 2])
        cell_E3 = low_F3[owner_E] + np.stack([x_E, *np.divmod(rest_E, extent_E3[:, 2])], axis=1)
        centre_E3, half = (cell_E3 + 0.5) * cell_size, 0.5 * cell_size + reach
        near_E = np.ones(len(owner_E), bool)
        for plane in range(4):
            plane_E4 = row_F24[owner_E, 4 * plane : 4 * plane + 4]
            distance_E = (plane_E4[:, :3] * centre_E3).sum(axis=1) - plane_E4[:, 3]
            spread_E = half * np.abs(plane_E4[:, :3]).sum(axis=1)
            near_E &= (np.abs(distance_E) <= spread_E + clearance) if plane == 0 else (distance_E <= spread_E)
        cells.append(cell_E3[near_E])
        owners.append(owner_E[near_E])
    return np.concatenate(cells), np.concatenate(owners)
