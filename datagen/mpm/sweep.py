"""Lists of triangles near particles, by base node: a particle may not cross them, and sheets may hide nodes.

A particle with base node I lies half to one and a half cells above it along each axis. Its nodes are I to I + 2. So all
points on the path to a node, or within half a cell, lie between I and I + 2. All lengths are in cells.
Shape legend: F triangles, K base nodes near triangles, L entries of all lists.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hgn.scene.distance import dot

# cells; a node nearer to a triangle's plane counts as on the side of the normal, despite rounding
ON_TRIANGLE = 1e-4
SMALLEST_SLOPE = 1e-6  # smallest component of a normal along z; a steeper plane gets this component
SLAB_MARGIN = 1e-2  # cells; larger than SMALLEST_SLOPE's effect and rounding
COLUMNS_PER_CHUNK = 1 << 11  # columns of nodes along z in a pass; about 20,000 pairs, which fit into a core's cache


@dataclass(frozen=True, eq=False)
class Sweep:
    """Holds triangles. Each base node near them has a list of triangles that its particles may meet, sheets first."""

    # float32: a corner, the unit normal, and two vectors; the products of these vectors with an offset from the corner
    # are the offset's coordinates along the two edges at the corner
    triangle_F43: np.ndarray
    obstacle_F: np.ndarray  # int32, index of the triangle's obstacle
    base_K3: np.ndarray  # int32
    begin_K: np.ndarray  # int64, start of each list in triangle_L; it ends at the next start
    sheets_K: np.ndarray  # int32, number of triangles of sheets in each list
    triangle_L: np.ndarray  # int32


def build_sweep(
    triangle_F33: np.ndarray, obstacle_F: np.ndarray, sheets: int, shape: tuple[int, ...], reach: float = 1.0
) -> Sweep:
    """Returns the lists for triangles with an area, corners in cells, in a grid of `shape` nodes.

    The first `sheets` triangles are those of sheets. Triangles of a list come within `reach` cells of base node + 1
    along each axis.
    """
    edge_1, edge_2 = triangle_F33[:, 1] - triangle_F33[:, 0], triangle_F33[:, 2] - triangle_F33[:, 0]
    normal = np.cross(edge_1, edge_2)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    across_1, across_2 = np.cross(edge_2, normal), np.cross(normal, edge_1)
    across_1 = across_1 / (across_1 * edge_1).sum(axis=1, keepdims=True)
    across_2 = across_2 / (across_2 * edge_2).sum(axis=1, keepdims=True)
    packed = np.stack([triangle_F33[:, 0], normal, across_1, across_2], axis=1).astype(np.float32)

    flats, owners = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for base, owner in near_slabs(triangle_F33 - 1, reach, shape):
        flats.append(np.ravel_multi_index(tuple(base), shape))
        owners.append(owner)
    flat, owner = np.concatenate(flats), np.concatenate(owners)
    order = np.argsort(flat, kind="stable")
    base, begin = np.unique(flat[order], return_index=True)
    before = np.concatenate([[0], np.cumsum(owner[order] < sheets)])
    return Sweep(
        packed,
        obstacle_F.astype(np.int32),
        np.stack(np.unravel_index(base, shape), axis=1).astype(np.int32),
        begin.astype(np.int64),
        np.diff(before[np.append(begin, len(order))]).astype(np.int32),
        owner[order].astype(np.int32),
    )


def near_slabs(triangle_F33: np.ndarray, reach: float, shape: tuple[int, ...]) -> Iterator[tuple[np.ndarray, ...]]:
    """Yields chunks of (node, triangle): nodes whose cube of half side `reach` meets a triangle's box and plane."""
    normal = np.cross(triangle_F33[:, 1] - triangle_F33[:, 0], triangle_F33[:, 2] - triangle_F33[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    slab = reach * np.abs(normal).sum(axis=1) + 1e-9
    normal_3F, corner_3F = np.ascontiguousarray(normal.T), np.ascontiguousarray(triangle_F33[:, 0].T)
    for node_3P, owner in near_pairs(triangle_F33, normal, reach, slab, shape):
        height = dot(node_3P - corner_3F.take(owner, axis=1), normal_3F.take(owner, axis=1))
        keep = np.flatnonzero(np.abs(height) <= slab[owner])
        yield node_3P.take(keep, axis=1), owner[keep]


def near_pairs(
    triangle_F33: np.ndarray, normal_F3: np.ndarray, band: float, slab_F: np.ndarray, shape: tuple[int, ...]
) -> Iterator[tuple[np.ndarray, ...]]:
    """Yields chunks of (node, triangle index), int64 [3, P] and [P], one triangle after another.

    The nodes lie in each triangle's box widened by `band` cells. Most nodes more than `slab_F` cells from its plane are
    omitted, because a large triangle's box has many more nodes than its surroundings.
    """
    low = np.clip(np.ceil(triangle_F33.min(axis=1) - band), 0, np.array(shape)).astype(np.int64)
    high = np.clip(np.floor(triangle_F33.max(axis=1) + band) + 1, 0, np.array(shape)).astype(np.int64)
    size = np.maximum(high - low, 0)
    columns = size[:, 0] * size[:, 1] * (size[:, 2] > 0)  # number of columns of nodes along z
    end = np.cumsum(columns)
    # the slab meets a column at the plane's height there, and within `half` above and below
    steep = np.where(np.abs(normal_F3[:, 2]) > SMALLEST_SLOPE, normal_F3[:, 2], SMALLEST_SLOPE)
    half = (slab_F + SLAB_MARGIN) / np.abs(steep)
    offset = (triangle_F33[:, 0] * normal_F3).sum(axis=1)
    total = int(end[-1]) if len(end) else 0
    for start in range(0, total, COLUMNS_PER_CHUNK):
        column = np.arange(start, min(start + COLUMNS_PER_CHUNK, total))
        owner = np.searchsorted(end, column, side="right")
        place, size_y = column - (end - columns)[owner], size[owner, 1]
        x, y = low[owner, 0] + place // size_y, low[owner, 1] + place % size_y
        middle = (offset[owner] - normal_F3[owner, 0] * x - normal_F3[owner, 1] * y) / steep[owner]
        first = np.clip(np.ceil(middle - half[owner]), low[owner, 2], high[owner, 2]).astype(np.int64)
        height = np.clip(np.floor(middle + half[owner]) + 1, first, high[owner, 2]).astype(np.int64) - first
        below = first - (np.cumsum(height) - height)
        x, y, z, triangle = np.repeat(np.stack([x, y, below, owner]), height, axis=1)
        yield np.stack([x, y, z + np.arange(len(z))]), triangle
