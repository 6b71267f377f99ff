"""Exact distances to triangles, and inside tests for closed meshes.

NumPy in float64, without loops over points or triangles.
Shape legend: P points (or point-triangle pairs), F triangles, T tree nodes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hgn.scene.scene import Obstacle
from hgn.scene.surface import area_vectors

POINTS_PER_CHUNK = 1 << 14  # limit for which temporary arrays fit into a core's cache
PAIRS_PER_CHUNK = 1 << 14  # the same limit for dense sums of solid angles
DIRECT_TRIANGLES = 1024  # number of triangles above which the tree is faster than the dense sum
LEAF_TRIANGLES = 16  # largest number of triangles in a leaf of the tree
FAR_FIELD_RATIO = 2.5  # distance / (radius of a cluster of triangles) from which a dipole replaces the cluster


def closest_points(point_P3: np.ndarray, triangle_P33: np.ndarray) -> np.ndarray:
    """Returns, for each pair of a point and a triangle, the closest point of the triangle, float64 [P, 3].

    `triangle_P33` contains corners, [pair, corner, axis]. The closest point is the nearest of four: the foot of the
    perpendicular, if it lies inside, and the closest points of the three edges. The result equals that of the region
    walk of Ericson, Real-Time Collision Detection, sec. 5.1.5. Triangles may be segments or points.
    """
    point, corner = np.asarray(point_P3, np.float64), np.asarray(triangle_P33, np.float64)
    closest = np.empty(point.shape)
    for start in range(0, len(point), POINTS_PER_CHUNK):
        chunk = slice(start, start + POINTS_PER_CHUNK)
        closest[chunk] = _closest_of_axes(
            np.ascontiguousarray(point[chunk].T), np.ascontiguousarray(corner[chunk].transpose(1, 2, 0))
        ).T
    return closest


def winding_numbers(point_P3: np.ndarray, triangle_F33: np.ndarray) -> np.ndarray:
    """Returns the generalised winding number of the triangles about each point, float64 [P].

    It is +1 or -1 inside a closed mesh (by its orientation), 0 outside, and between for meshes with holes. Zero-area
    triangles add nothing. The solid angles of up to DIRECT_TRIANGLES triangles are summed exactly (van Oosterom and
    Strackee 1983; Jacobson et al. 2013). With more triangles, dipoles replace distant clusters (Barill et al. 2018;
    error 0.01).
    """
    point = np.asarray(point_P3, np.float64).reshape(-1, 3)
    triangle = np.asarray(triangle_F33, np.float64).reshape(-1, 3, 3)
    if len(point) == 0 or len(triangle) == 0:
        return np.zeros(len(point))
    if len(triangle) > DIRECT_TRIANGLES:
        return _tree_winding_numbers(point, triangle)
    winding = np.empty(len(point))
    rows = max(1, PAIRS_PER_CHUNK // len(triangle))
    corner = np.ascontiguousarray(triangle.transpose(1, 2, 0))[:, :, None]
    for start in range(0, len(point), rows):
        chunk = np.ascontiguousarray(point[start : start + rows].T)
        winding[start : start + rows] = _solid_angles(chunk[:, :, None], corner).sum(axis=1)
    return winding / (4 * np.pi)


def contains(point_P3: np.ndarray, obstacle: Obstacle) -> np.ndarray:
    """Returns whether each point lies inside the obstacle, bool [P]. No point is inside a sheet.

    Inside means |winding number| > 0.5, so the orientation of triangles has no effect.
    """
    point = np.asarray(point_P3, np.float64).reshape(-1, 3)
    inside = np.zeros(len(point), bool)
    if not obstacle.closed or len(obstacle.triangle_F3) == 0 or len(point) == 0:
        return inside
    triangle = obstacle.corners
    low, high = triangle.min(axis=(0, 1)), triangle.max(axis=(0, 1))
    near = np.flatnonzero(((point >= low) & (point <= high)).all(axis=1))
    inside[near] = np.abs(winding_numbers(point[near], triangle)) > 0.5
    return inside


def extent(point_P3: np.ndarray) -> str:
    """Returns the smallest and largest coordinate of points along each axis, as text."""
    ends = zip("xyz", point_P3.min(axis=0), point_P3.max(axis=0), strict=True)
    return ", ".join(f"{axis} {low:.3g} to {high:.3g}" for axis, low, high in ends)


def fraction_inside(position_N3: np.ndarray, obstacles: Sequence[Obstacle], time_s: float) -> float:
    """Returns the fraction of particles inside closed obstacles, which are where their motion places them at a time."""
    inside_N = np.zeros(len(position_N3), bool)
    for obstacle in obstacles:
        inside_N |= contains(position_N3, obstacle.at(time_s))
    return float(inside_N.mean()) if len(inside_N) else 0.0


def outside_domain(position_N3: np.ndarray, domain_size: Sequence[float]) -> float:
    """Returns the fraction of particles outside of the domain."""
    outside_N3 = (position_N3 < 0) | (position_N3 > np.asarray(domain_size))
    return float(outside_N3.any(-1).mean()) if len(position_N3) else 0.0


def _closest_of_axes(point: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Computes `closest_points` with an array for each axis: points [3, P], corners [3, 3, P]."""
    a, b, c = corner
    ab, ac, ap = b - a, c - a, point - a
    best = _closest_on_segment(ap, a, ab)
    best_square = square(point - best)
    for candidate in (_closest_on_segment(point - b, b, c - b), _closest_on_segment(point - c, c, a - c)):
        candidate_square = square(point - candidate)
        better = candidate_square < best_square
        np.copyto(best, candidate, where=better)
        np.copyto(best_square, candidate_square, where=better)

    normal = cross(ab, ac)
    normal_square = square(normal)
    divisor = np.where(normal_square > 0, normal_square, 1.0)
    u = dot(cross(ap, ac), normal) / divisor
    v = dot(cross(ab, ap), normal) / divisor
    # measured from the corner, so that the inaccurate normal of a sliver cannot move the foot out of the triangle
    foot = a + u * ab + v * ac
    better = (normal_square > 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (square(point - foot) < best_square)
    np.copyto(best, foot, where=better)
    return best


def _closest_on_segment(from_start: np.ndarray, start: np.ndarray, edge: np.ndarray) -> np.ndarray:
    length_square = square(edge)
    along = dot(from_start, edge) / np.where(length_square > 0, length_square, 1.0)
    return start + np.clip(along, 0.0, 1.0) * edge


def _solid_angles(point: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Returns the signed solid angle of triangles, corners [3, 3, ...], from points [3, ...]; trailing axes broadcast.

    From a point in the triangle's plane the angle is 0 if the point is outside the triangle, else undefined.
    """
    a, b, c = (corner - point for corner in triangle)
    la, lb, lc = (np.sqrt(square(side)) for side in (a, b, c))
    determinant = dot(a, cross(b, c))
    cosines = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return np.asarray(2 * np.arctan2(determinant, cosines))


@dataclass(frozen=True)
class _Tree:
    """A binary tree over sorted triangles. A node contains the triangles from `first` to before `last`."""

    first_T: np.ndarray
    last_T: np.ndarray
    child_T2: np.ndarray  # -1 in leaves
    centre_T3: np.ndarray  # area-weighted
    radius_T: np.ndarray
    dipole_T3: np.ndarray  # sum of the area vectors
    triangle_F33: np.ndarray  # sorted


def _build_tree(triangle_F33: np.ndarray) -> _Tree:
    """Splits nodes at the median of the longest axis, one level of the tree after the other."""
    centroid = triangle_F33.mean(axis=1)
    order = np.arange(len(triangle_F33))
    first, last, children = [0], [len(order)], [[-1, -1]]
    level = [0]
    while level:
        grown: list[int] = []
        for node in level:
            start, stop = first[node], last[node]
            if stop - start <= LEAF_TRIANGLES:
                continue
            members = order[start:stop]
            axis = int(np.argmax(np.ptp(centroid[members], axis=0)))
            middle = (stop - start) // 2
            order[start:stop] = members[np.argpartition(centroid[members, axis], middle)]
            children[node] = [len(first), len(first) + 1]
            grown += children[node]
            first += [start, start + middle]
            last += [start + middle, stop]
            children += [[-1, -1], [-1, -1]]
        level = grown
    first_T, last_T = np.array(first), np.array(last)
    sorted_F33 = triangle_F33[order]
    area_vector = area_vectors(sorted_F33)
    area = np.sqrt(square(area_vector.T)) + np.finfo(np.float64).tiny
    dipole = _slice_sums(area_vector, first_T, last_T)
    weight = _slice_sums(area[:, None], first_T, last_T)
    centre = _slice_sums(area[:, None] * sorted_F33.mean(axis=1), first_T, last_T) / weight
    # the spheres enclose the boxes of the corners
    low, high = np.empty_like(centre), np.empty_like(centre)
    for node in range(len(first_T) - 1, -1, -1):  # children come after their parent
        if children[node][0] < 0:
            corners = sorted_F33[first[node] : last[node]]
            low[node], high[node] = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        else:
            low[node] = low[children[node]].min(axis=0)
            high[node] = high[children[node]].max(axis=0)
    radius = np.sqrt(square(np.maximum(high - centre, centre - low).T))
    return _Tree(first_T, last_T, np.array(children), centre, radius, dipole, sorted_F33)


def _slice_sums(value: np.ndarray, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    running = np.concatenate([np.zeros((1, value.shape[1])), np.cumsum(value, axis=0)])
    return running[last] - running[first]


def _tree_winding_numbers(point: np.ndarray, triangle_F33: np.ndarray) -> np.ndarray:
    tree = _build_tree(triangle_F33)
    solid_angle = np.zeros(len(point))
    rows = 4096  # number of points in a pass; limits memory
    for start in range(0, len(point), rows):
        chunk = point[start : start + rows]
        total = solid_angle[start : start + rows]
        who, node = np.arange(len(chunk)), np.zeros(len(chunk), np.int64)
        while len(who):
            offset = tree.centre_T3[node] - chunk[who]
            distance = np.sqrt(square(offset.T))
            far = distance > FAR_FIELD_RATIO * tree.radius_T[node]
            dipole = dot(tree.dipole_T3[node[far]].T, offset[far].T) / distance[far] ** 3
            total += np.bincount(who[far], dipole, len(chunk))
            leaf = ~far & (tree.child_T2[node, 0] < 0)
            total += _leaf_solid_angles(chunk, who[leaf], node[leaf], tree)
            inner = ~far & ~leaf
            who = np.repeat(who[inner], 2)
            node = tree.child_T2[node[inner]].reshape(-1)
    return solid_angle / (4 * np.pi)


def _leaf_solid_angles(point: np.ndarray, who: np.ndarray, node: np.ndarray, tree: _Tree) -> np.ndarray:
    total = np.zeros(len(point))
    slot = np.arange(LEAF_TRIANGLES)
    rows = PAIRS_PER_CHUNK // LEAF_TRIANGLES
    for start in range(0, len(who), rows):
        pair_who, pair_node = who[start : start + rows], node[start : start + rows]
        index = tree.first_T[pair_node][:, None] + slot
        owned = index < tree.last_T[pair_node][:, None]
        corner = np.moveaxis(tree.triangle_F33[np.where(owned, index, 0)], (2, 3), (0, 1))
        angle = np.where(owned, _solid_angles(point[pair_who].T[:, :, None], corner), 0.0).sum(axis=1)
        total += np.bincount(pair_who, angle, len(point))
    return total


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns scalar products of vectors [3, ...]. One array per axis takes a third of the time of rows of three."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def square(a: np.ndarray) -> np.ndarray:
    """Returns squared lengths of vectors [3, ...]."""
    return dot(a, a)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns cross products of vectors [3, ...], as [3, ...]."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
