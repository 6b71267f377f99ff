"""The triangles that no particle may cross, listed by cell, for the swept test after advection.

The collider works on the grid's nodes and may let a particle slip by where its band is curved, cornered or folded;
the swept test stops what would still cross. All lengths are in cells.
Shape legend: F triangles, K cells near triangles, L entries of all lists.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

REACH_CELLS = 0.5  # that a particle moves in a step, at most, for its crossing to be seen
PAIRS_PER_CHUNK = 1_000_000  # (cell, triangle) pairs held at once


@dataclass(frozen=True, eq=False)
class Sweep:
    """Triangles, and for each cell near any which ones a particle in it may meet."""

    # float32: a corner, the unit normal, and two vectors whose products with an offset from the corner are its
    # coordinates along the two edges from there
    triangle_F43: np.ndarray
    cell_K3: np.ndarray  # int32
    begin_K: np.ndarray  # int64, into triangle_L; a list ends where the next begins
    triangle_L: np.ndarray  # int32


def build_sweep(triangle_F33: np.ndarray, shape: tuple[int, ...]) -> Sweep:
    """From triangles with an area, corners in cells, in a grid of `shape` cells. Outside the grid there are none."""
    edge_1, edge_2 = triangle_F33[:, 1] - triangle_F33[:, 0], triangle_F33[:, 2] - triangle_F33[:, 0]
    normal = np.cross(edge_1, edge_2)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    across_1, across_2 = np.cross(edge_2, normal), np.cross(normal, edge_1)
    across_1 = across_1 / (across_1 * edge_1).sum(axis=1, keepdims=True)
    across_2 = across_2 / (across_2 * edge_2).sum(axis=1, keepdims=True)
    packed = np.stack([triangle_F33[:, 0], normal, across_1, across_2], axis=1).astype(np.float32)

    flats, owners = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    slab = 0.5 * np.abs(normal).sum(axis=1) + REACH_CELLS
    for cell, owner in near_pairs(triangle_F33 - 0.5, 0.5 + REACH_CELLS, shape):
        height = ((cell + 0.5 - triangle_F33[owner, 0]) * normal[owner]).sum(axis=1)
        keep = np.abs(height) <= slab[owner] + 1e-9
        flats.append(np.ravel_multi_index(cell[keep].T, shape))
        owners.append(owner[keep])
    flat, owner = np.concatenate(flats), np.concatenate(owners)
    order = np.argsort(flat, kind="stable")
    cell, begin = np.unique(flat[order], return_index=True)
    return Sweep(
        packed,
        np.stack(np.unravel_index(cell, shape), axis=1).astype(np.int32),
        begin.astype(np.int64),
        owner[order].astype(np.int32),
    )


def near_pairs(triangle_F33: np.ndarray, band: float, shape: tuple[int, ...]) -> Iterator[tuple[np.ndarray, ...]]:
    """Chunks of (node, triangle index): the nodes in each triangle's box widened by `band` cells."""
    low = np.clip(np.ceil(triangle_F33.min(axis=1) - band), 0, np.array(shape)).astype(np.int64)
    high = np.clip(np.floor(triangle_F33.max(axis=1) + band) + 1, 0, np.array(shape)).astype(np.int64)
    size = np.maximum(high - low, 0)
    count = size.prod(axis=1)
    end = np.cumsum(count)
    total = int(end[-1]) if len(end) else 0
    for start in range(0, total, PAIRS_PER_CHUNK):
        pair = np.arange(start, min(start + PAIRS_PER_CHUNK, total))
        owner = np.searchsorted(end, pair, side="right")
        place = pair - (end[owner] - count[owner])
        size_y, size_z = size[owner, 1], size[owner, 2]
        offset = np.stack([place // (size_y * size_z), place // size_z % size_y, place % size_z], axis=1)
        yield low[owner] + offset, owner
