"""Poisson-disk samples on triangle surfaces, and splitting of long triangles.

Shape legend: F triangles, S samples.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hgn.schema import ConfigError, require

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

CANDIDATES = 1.0  # number per spacing^2 and round; a dense Poisson-disk set has about 0.7
MINIMUM_ROUNDS, MAXIMUM_ROUNDS = 4, 12
SETTLED = 0.02  # rounds end after one that adds less than this fraction
MINIMUM_CANDIDATES = 64  # added to the number of candidates of a round
MAXIMUM_SAMPLES, MAXIMUM_PIECES = 3_000_000, 2_000_000  # samples take about 6 CPU seconds a million
MOST_PAIRS = 5e6  # about the largest number of near pairs in memory; surfaces may lie on one another


def sample_surface(
    corner_F33: np.ndarray, spacing: float, rng: np.random.Generator, most: int = MAXIMUM_SAMPLES
) -> tuple[np.ndarray, np.ndarray]:
    """Returns random points of triangles, no two closer than `spacing` (Paper sec. 3: Poisson disks).

    Returns float64 [S, 3] and the triangle of each point, int64 [S]. Candidates are drawn by area; slivers thinner than
    about the spacing are drawn by length. A candidate is accepted unless it is too close to an earlier point. Rounds
    end when few are added. Zero-area triangles get no points. The state of `rng` determines the result.
    Raises: ConfigError if the surface needs `most` samples or more.
    """
    weight = _weights(corner_F33, spacing)
    usable = np.flatnonzero(weight > 0)
    running = np.cumsum(weight[usable])
    if len(usable) == 0:
        return np.zeros((0, 3)), np.zeros(0, np.int64)
    expected = CANDIDATES * running[-1] / (spacing * spacing)
    if not expected < most:
        raise ConfigError(
            f"obstacle surface must need fewer than {most} samples at spacing {spacing:g}, got "
            f"{expected:.3g}; scale it down, remove others, cut away what lies outside the domain, or raise cell_size"
        )
    candidate_count = int(expected) + MINIMUM_CANDIDATES
    points, owners = np.zeros((0, 3)), np.zeros(0, np.int64)
    trees: list[cKDTree] = []  # of the points of each round
    for round_index in range(MAXIMUM_ROUNDS):
        chosen = np.searchsorted(running, rng.random(candidate_count) * running[-1], side="right")
        owner = usable[np.minimum(chosen, len(usable) - 1)]
        point = _uniform_in_triangles(corner_F33[owner], rng)
        order = _by_place(point, spacing)
        for tree in trees:
            near = tree.query(point[order], distance_upper_bound=spacing)[0]
            order = order[near >= spacing]  # infinite if no point is nearer
        free = np.sort(order)
        point, owner = point[free], owner[free]
        selected = _spread_out(point, spacing)
        trees.append(point_tree(point[selected[_by_place(point[selected], spacing)]]))
        points = np.concatenate([points, point[selected]])
        owners = np.concatenate([owners, owner[selected]])
        if round_index + 1 >= MINIMUM_ROUNDS and len(selected) < SETTLED * len(points):
            break
    return points, owners


def split_long_edges(
    corner_F33: np.ndarray, longest: float, box: tuple[np.ndarray, np.ndarray] | None = None
) -> np.ndarray:
    """Bisects triangles at their longest edge until no edge exceeds `longest`. Returns corners, float64 [F', 3, 3].

    Pieces whose bounding box is outside `box` (lowest and highest corner) are dropped. They inherit more coordinates.
    Raises: ConfigError for more than MAXIMUM_PIECES.
    """
    corner = np.asarray(corner_F33, np.float64)
    pieces = [corner[:0]]
    while len(corner):
        if box is not None:
            corner = corner[((corner.max(axis=1) >= box[0]) & (corner.min(axis=1) <= box[1])).all(axis=1)]
        edge = np.roll(corner, -1, axis=1) - corner
        length_square = (edge * edge).sum(axis=2)
        short = ~(length_square > longest * longest).any(axis=1)
        pieces.append(corner[short])
        corner = corner[~short]
        start = length_square[~short].argmax(axis=1)
        rows = np.arange(len(corner))
        rule = f"fewer than {MAXIMUM_PIECES} pieces with edges of {longest:.3g}"
        require(len(corner) < MAXIMUM_PIECES // 2, "obstacle surface", rule, 2 * len(corner), "raise cell_size")
        a, b, c = (corner[rows, (start + i) % 3] for i in range(3))
        middle = 0.5 * (a + b)
        corner = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return np.concatenate(pieces)


def area_vectors(corner_F33: np.ndarray) -> np.ndarray:
    """Returns normals whose length is the triangle's area, float64 [F, 3]."""
    return 0.5 * np.cross(corner_F33[:, 1] - corner_F33[:, 0], corner_F33[:, 2] - corner_F33[:, 0])


def distinct_rows(row_NK: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the distinct rows in order, the first place of each, and the number of each given row, as np.unique does.

    np.unique with an axis takes several times as long.
    """
    order = np.lexsort(row_NK.T[::-1])
    sorted_NK = row_NK[order]
    new = np.ones(len(order), bool)
    new[1:] = (sorted_NK[1:] != sorted_NK[:-1]).any(axis=1)
    number_N = np.empty(len(order), np.int64)
    number_N[order] = np.cumsum(new) - 1
    return sorted_NK[new], order[new], number_N


def _weights(corner: np.ndarray, spacing: float) -> np.ndarray:
    area = np.sqrt((area_vectors(corner) ** 2).sum(axis=1))
    edge = np.roll(corner, -1, axis=1) - corner
    length = np.sqrt((edge * edge).sum(axis=2).max(axis=1, initial=0.0))
    sliver = (area > 0) & (length > spacing) & (area < spacing * length)
    return np.where(sliver, spacing * length, area)


def point_tree(point_S3: np.ndarray) -> cKDTree:
    """Returns a nearest-neighbour tree. Importing SciPy's takes half a second, and most commands need none."""
    from scipy.spatial import cKDTree

    return cKDTree(point_S3, balanced_tree=False)


def _by_place(point: np.ndarray, spacing: float) -> np.ndarray:
    """Returns an order of points in which neighbours follow one another. Searches in it take half the time."""
    return np.argsort(_cells(point, 8 * spacing))


def _cells(point: np.ndarray, edge: float) -> np.ndarray:
    """Returns a number for the cell of each point. Several cells may share it."""
    return np.asarray(np.floor(point / edge) @ (1.0, 1e5 + 3, 1e10 + 19))


def _uniform_in_triangles(corner_S33: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    u = np.sqrt(rng.random(len(corner_S33)))[:, None]
    v = rng.random(len(corner_S33))[:, None]
    return (1 - u) * corner_S33[:, 0] + u * (1 - v) * corner_S33[:, 1] + u * v * corner_S33[:, 2]


def _spread_out(point: np.ndarray, spacing: float) -> np.ndarray:
    """Returns the points of a loop that drops each point too close to an earlier point that it kept."""
    if len(point) == 0:
        return np.zeros(0, np.int64)
    crowd = np.unique(_cells(point, spacing), return_counts=True)[1]
    if (crowd.astype(np.float64) ** 2).sum() > MOST_PAIRS:  # the halves in turn
        half = len(point) // 2
        first = _spread_out(point[:half], spacing)
        near = point_tree(point[first]).query(point[half:], distance_upper_bound=np.nextafter(spacing, np.inf))[0]
        free = half + np.flatnonzero(np.isinf(near))
        return np.concatenate([first, free[_spread_out(point[free], spacing)]])
    pair = point_tree(point).query_pairs(spacing, output_type="ndarray").astype(np.int64)
    earlier, later = pair.min(axis=1), pair.max(axis=1)
    undecided = np.ones(len(point), bool)
    selected = np.zeros(len(point), bool)
    while undecided.any():
        waits = np.zeros(len(point), bool)
        waits[later] = True
        settled = undecided & ~waits
        selected |= settled
        dropped = later[settled[earlier]]
        undecided &= ~settled
        undecided[dropped] = False
        open_pair = undecided[earlier] & undecided[later]
        earlier, later = earlier[open_pair], later[open_pair]
    return np.flatnonzero(selected)
