"""Neighbours of elastic particles in the rest shape of their bodies, which is the scene's first frame.

Shape legend: N particles, B particles of a body, K neighbours.
"""

import math
from typing import Any

import numpy as np

NEIGHBOURS = 12  # those of a close packing; in a body of random points they are within about 1.4 spacings
CONNECTED_SPACINGS = 1.5  # particles of unknown bodies that are nearer than this are of one body
# Candidates for the neighbours. More than NEIGHBOURS, because particles of a lattice have up to 19 at equal distances.
CANDIDATES = 32


def body_numbers(scene: Any) -> np.ndarray | None:
    """Returns the number of each particle's body, a group of a scene's or an episode's specification; None: unknown."""
    counts = scene.specification.get("particle_counts")
    if counts is None:
        counts = [group.get("particle_count", 0) for group in scene.specification.get("groups", ())]
    return np.repeat(np.arange(len(counts)), counts) if counts and sum(counts) == scene.particle_count else None


def rest_neighbours(
    position_N3: np.ndarray, elastic_N: np.ndarray, body_N: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns the positions, and the nearest elastic particles of the same body, int32 [N, K].

    Returns None without elastic particles. Missing neighbours are -1. The nearest is first, and of equally near ones
    that with the lowest number. Without `body_N` chains of particles nearer than CONNECTED_SPACINGS are bodies.
    """
    if not elastic_N.any():
        return None
    row_B = np.flatnonzero(elastic_N)
    neighbour_NK = np.full((len(elastic_N), NEIGHBOURS), -1, np.int32)
    label_B = _connected(position_N3[row_B].astype(np.float64)) if body_N is None else body_N[row_B]
    order_B = np.argsort(label_B, kind="stable")
    for rows in np.split(row_B[order_B], np.flatnonzero(np.diff(label_B[order_B])) + 1):
        neighbour_NK[rows, : len(rows) - 1] = rows[_nearest(position_N3[rows].astype(np.float64))]
    return position_N3, neighbour_NK


def connected_bodies(neighbour_NK: np.ndarray) -> list[np.ndarray]:
    """Returns the particles of each elastic body, int64: those that chains of rest neighbours connect."""
    particle_E, place_E = np.nonzero(neighbour_NK >= 0)
    part_N = _parts(np.stack([particle_E, neighbour_NK[particle_E, place_E]], 1), len(neighbour_NK))
    row_B = np.unique(neighbour_NK[particle_E, place_E])
    row_B = row_B[np.argsort(part_N[row_B], kind="stable")]
    return np.split(row_B, np.flatnonzero(np.diff(part_N[row_B])) + 1) if len(row_B) else []


def _parts(pair_P2: np.ndarray, count: int) -> np.ndarray:
    """Returns the number of the connected part of each of `count` points, int [count]."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = coo_matrix((np.ones(len(pair_P2)), (pair_P2[:, 0], pair_P2[:, 1])), shape=(count, count))
    return np.asarray(connected_components(edges, directed=False)[1])


def _nearest(point_B3: np.ndarray) -> np.ndarray:
    """Returns the numbers of each point's nearest others, int [B, at most K], by distance and then by number."""
    from scipy.spatial import cKDTree

    count = len(point_B3)
    _, near_BC = cKDTree(point_B3).query(point_B3, k=[*range(1, min(count, CANDIDATES) + 1)])
    near_BC = np.sort(near_BC, axis=1)
    offset_BC3 = point_B3[near_BC] - point_B3[:, None]
    square_BC = (offset_BC3 * offset_BC3).sum(axis=2)
    square_BC[near_BC == np.arange(count)[:, None]] = np.inf
    order_BK = np.argsort(square_BC, axis=1, kind="stable")[:, : min(count - 1, NEIGHBOURS)]
    return np.take_along_axis(near_BC, order_BK, axis=1)


def _connected(point_B3: np.ndarray) -> np.ndarray:
    """Returns the number of each point's connected part, int [B].

    The spacing is that of a cubic lattice with the same median distance of the neighbour number NEIGHBOURS.
    """
    from scipy.spatial import cKDTree

    count, tree = len(point_B3), cKDTree(point_B3)
    distance_B, _ = tree.query(point_B3, k=[min(count, NEIGHBOURS + 1)])
    pair_P2 = tree.query_pairs(CONNECTED_SPACINGS * float(np.median(distance_B)) / math.sqrt(2), output_type="ndarray")
    return _parts(pair_P2, count)
