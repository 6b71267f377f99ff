"""Distances and directions from grid nodes to the surfaces of mesh obstacles.

Shape legend: P points, F triangles.
"""

import math

import numpy as np

from datagen.mpm.sweep import ON_TRIANGLE, near_pairs
from hgn.scene.distance import closest_points, contains, cross, dot, square
from hgn.scene.scene import Obstacle
from hgn.schema import ConfigError

ON_SURFACE_CELLS = 0.05  # distance below which the direction to the surface is rounding
BEARING_CELLS = 0.25  # height above a surface up to which nodes stop motion
LARGE_RADIUS = 2.0  # radius of a large triangle, as a multiple of the reach
SIDE_CELLS = 0.51  # a little more than half the distance of two nodes
ON_EDGE = 1e-6  # barycentric coordinate below which a point lies on a triangle's edge
# squared area over fourth power of the longest edge, below which a triangle has no direction
FLAT_TRIANGLE = 1e-20


class Box:
    """The part of a grid of `grid` nodes that contains all nodes up to `reach` spacings of the nodes from triangles.

    A cell of the solver has `per_cell` spacings. All other lengths of sampled surfaces are in spacings too.
    """

    def __init__(self, triangle_F33: np.ndarray, reach: float, grid: tuple[int, ...], per_cell: int = 1) -> None:
        self.grid, self.reach, self.per_cell = grid, reach, per_cell
        whole = np.array(grid)
        self._low = np.clip(np.ceil(triangle_F33.min(axis=(0, 1)) - reach), 0, whole).astype(np.int64)
        high = np.clip(np.floor(triangle_F33.max(axis=(0, 1)) + reach) + 1, self._low, whole).astype(np.int64)
        self.shape = tuple((high - self._low).tolist())
        self.count = math.prod(self.shape)

    def flat(self, node_3P: np.ndarray) -> np.ndarray:
        """Returns flat indices [P] in the box of nodes of the grid."""
        (x, y, z), (_, size_y, size_z) = self._low, self.shape
        return np.asarray(((node_3P[0] - x) * size_y + node_3P[1] - y) * size_z + node_3P[2] - z)

    def node(self, flat_P: np.ndarray) -> np.ndarray:
        """Returns the nodes of the grid at flat indices, int64 [P, 3]."""
        return np.stack(np.unravel_index(flat_P, self.shape), axis=1) + self._low

    def flat_in_grid(self, flat_P: np.ndarray) -> np.ndarray:
        """Returns the flat indices in the whole grid."""
        return np.ravel_multi_index(tuple(self.node(flat_P).T), self.grid)


def triangles_of(obstacle: Obstacle, index: int, cell_size: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the corners of triangles with an area, in cells, float64 [F, 3, 3], and parts on the rim, bool [F, 6].

    The parts are the edges opposite to the corners, then the corners. Edges of only one triangle form the rim.
    """
    vertex = np.asarray(obstacle.vertex_V3, np.float64)
    triangle = np.asarray(obstacle.triangle_F3)
    if not np.isfinite(vertex).all():
        raise ConfigError(f"vertex_V3 of obstacle {index} ({obstacle.name}) must be finite; repair the mesh")
    if len(triangle) and not (triangle.min() >= 0 and triangle.max() < len(vertex)):
        raise ConfigError(
            f"triangle_F3 of obstacle {index} ({obstacle.name}) must index its {len(vertex)} vertices, got "
            f"{triangle.min()} to {triangle.max()}; repair the mesh"
        )
    corner = vertex[triangle].reshape(-1, 3, 3)
    side = corner - np.roll(corner, 1, axis=1)
    longest_square = (side**2).sum(axis=2).max(axis=1)
    area_square = (np.cross(side[:, 0], side[:, 1]) ** 2).sum(axis=1)
    has_area = area_square > FLAT_TRIANGLE * longest_square**2
    corner = corner[has_area] / cell_size
    if obstacle.closed or not len(corner):
        return corner, np.zeros((len(corner), 6), bool)
    # corners at one place count as one, because mesh files repeat them
    _, place_F3 = np.unique(corner.reshape(-1, 3), axis=0, return_inverse=True)
    place_F3 = place_F3.reshape(-1, 3)
    ends = np.sort(place_F3[:, [[1, 2], [2, 0], [0, 1]]], axis=2).reshape(-1, 2).astype(np.int64)
    _, edge_of, uses = np.unique(
        ends[:, 0] * (place_F3.max() + 1) + ends[:, 1], return_inverse=True, return_counts=True
    )
    rim_edge_F3 = (uses[edge_of.ravel()] == 1).reshape(-1, 3)
    on_rim = np.zeros(place_F3.max() + 1, bool)
    on_rim[ends[rim_edge_F3.ravel()]] = True
    return corner, np.concatenate([rim_edge_F3, on_rim[place_F3]], axis=1)


def _rasterise(triangle_F33: np.ndarray, box: Box) -> tuple[np.ndarray, ...]:
    """Returns the nodes within the box's reach: flat index [P], distance [P], closest point [P, 3], triangle [P].

    Lengths are in cells. The first of several equally close triangles counts.
    """
    best = np.full(box.count, np.inf)
    closest = np.zeros((box.count, 3))
    owner = np.full(box.count, -1, np.int64)
    centre = triangle_F33.mean(axis=1)
    radius = np.linalg.norm(triangle_F33 - centre[:, None], axis=2).max(axis=1)
    normal = _face_normals(triangle_F33)
    centre_3F, corner_3F, normal_3F = (
        np.ascontiguousarray(of_triangle.T) for of_triangle in (centre, triangle_F33[:, 0], normal)
    )
    slab = np.full(len(triangle_F33), box.reach)
    # a triangle can be nearest only if its sphere comes nearer than the nearest centre of any triangle
    bound = np.full(box.count, box.reach)
    dense = (radius < LARGE_RADIUS * box.reach).any()  # few nodes are near the centres of large triangles
    for node_3P, triangle in near_pairs(triangle_F33, normal, box.reach, slab, box.grid) if dense else ():
        np.minimum.at(bound, box.flat(node_3P), np.sqrt(square(node_3P - centre_3F.take(triangle, axis=1))))
    bound += 1e-9
    for node_3P, triangle in near_pairs(triangle_F33, normal, box.reach, slab, box.grid):
        flat = box.flat(node_3P)
        height = dot(node_3P - corner_3F.take(triangle, axis=1), normal_3F.take(triangle, axis=1))
        reach = np.sqrt(square(node_3P - centre_3F.take(triangle, axis=1))) - radius[triangle]
        keep = np.flatnonzero(np.maximum(np.abs(height), reach) <= bound[flat])
        node, triangle, flat = node_3P.take(keep, axis=1).T, triangle[keep], flat[keep]
        foot = closest_points(node, triangle_F33.take(triangle, axis=0))
        distance = np.sqrt(square((node - foot).T))
        nearer = np.flatnonzero((distance <= box.reach) & (distance < best[flat]))
        np.minimum.at(best, flat[nearer], distance[nearer])
        # written in reverse order, so that the first of several triangles at a node stays
        nearest = nearer[distance[nearer] == best[flat[nearer]]][::-1]
        closest[flat[nearest]], owner[flat[nearest]] = foot[nearest], triangle[nearest]
    near = np.flatnonzero(owner >= 0)
    return near, best[near], closest[near], owner[near]


def _face_normals(triangle_F33: np.ndarray) -> np.ndarray:
    normal = np.cross(triangle_F33[:, 1] - triangle_F33[:, 0], triangle_F33[:, 2] - triangle_F33[:, 0])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def sheet_samples(triangle_F33: np.ndarray, rim_F6: np.ndarray, box: Box) -> tuple[np.ndarray, ...]:
    """Returns the nodes near a sheet: flat index [P], distance [P], distance across the sheet [P], direction away from
    it [P, 3], whether the rim is nearest [P], and the normal of the nearest triangle [P, 3]."""
    node, distance, foot, owner = _rasterise(triangle_F33, box)
    face = _face_normals(triangle_F33)[owner]
    offset = box.node(node) - foot
    height = (offset * face).sum(axis=1)
    away = offset / np.where(distance < ON_SURFACE_CELLS, 1.0, distance)[:, None]
    # at the rim the direction to the foot is along the sheet, not through it
    on_rim = _on_rim(foot, triangle_F33, rim_F6, owner)
    across = (distance < ON_SURFACE_CELLS) | on_rim
    away[across] = face[across] * np.where(height[across] < -ON_TRIANGLE, -1.0, 1.0)[:, None]
    return node, distance, np.where(across, np.abs(height), distance), away, on_rim, face


def _on_rim(foot_P3: np.ndarray, triangle_F33: np.ndarray, rim_F6: np.ndarray, owner_P: np.ndarray) -> np.ndarray:
    """Returns whether points of triangles lie on their parts `rim_F6` (see triangles_of), bool [P]."""
    corner, edge_1, edge_2 = triangle_F33[:, 0].T, *(triangle_F33[:, end].T - triangle_F33[:, 0].T for end in (1, 2))
    normal = cross(edge_1, edge_2)
    normal_square = square(normal).take(owner_P)
    normal, edge_1, edge_2, corner = (of_F.take(owner_P, axis=1) for of_F in (normal, edge_1, edge_2, corner))
    from_corner = foot_P3.T - corner
    share_1 = dot(cross(from_corner, edge_2), normal) / normal_square
    share_2 = dot(cross(edge_1, from_corner), normal) / normal_square
    # on the edge opposite to a corner this corner's weight is 0; at the corner it is 1
    shares = (1 - share_1 - share_2, share_1, share_2)
    parts = [share < ON_EDGE for share in shares] + [share > 1 - ON_EDGE for share in shares]
    on_rim = np.zeros(len(owner_P), bool)
    for part, on_part in enumerate(parts):
        on_rim |= on_part & rim_F6[:, part].take(owner_P)
    return on_rim


def closed_samples(
    obstacle: Obstacle, triangle_F33: np.ndarray, band: float, box: Box, cell_size: float
) -> tuple[np.ndarray, ...]:
    """Returns the nodes near a body's surface, then those deep inside: flat index [P], height above the surface [P],
    direction out of the body [P, 3], and whether the node is outside a body that is thin there [P].

    `cell_size` is the spacing of the nodes in domain units.
    """
    node, distance, foot, owner = _rasterise(triangle_F33, box)
    if not len(node):  # the grid lies inside the body, so there is no direction out of it
        return node, distance, foot, distance > 0
    inside = _inside(node[distance <= SIDE_CELLS], box, obstacle, cell_size)
    within = inside.ravel()[node]
    near = np.zeros(box.shape, bool)
    near.ravel()[node] = True

    point = box.node(node)
    sign = np.where(within, -1.0, 1.0)
    on_surface = distance < ON_SURFACE_CELLS
    away = (point - foot) * (sign / np.where(on_surface, 1.0, distance))[:, None]
    face = _face_normals(triangle_F33)[owner]
    # face normals may point inwards, so a test of one side decides
    on = np.flatnonzero(on_surface)
    inward = contains((foot[on] + 0.1 * face[on]) * cell_size, obstacle)
    face[on[inward]] *= -1
    normal = np.where(on_surface[:, None], face, away)

    # a body is thin if the point one cell further, behind the surface, is outside again
    height = sign * distance
    thin = np.zeros(len(node), bool)
    # one cell at least, so that a line of nodes across the surface contains a node of the band
    cell = box.per_cell
    outside = np.flatnonzero((height > -BEARING_CELLS * cell) & (height <= max(band, 1.0) * cell))
    thin[outside] = ~contains((foot[outside] - cell * normal[outside]) * cell_size, obstacle)

    deep = np.flatnonzero(inside.ravel() & ~near.ravel())
    if len(deep):  # the direction out leads to the surface point that is closest to the nearest node of the band
        from scipy import ndimage

        feet = np.zeros((box.count, 3))
        feet[np.flatnonzero(near.ravel())] = foot
        nearest = ndimage.distance_transform_edt(~near, return_distances=False, return_indices=True)
        source = np.ravel_multi_index([axis.ravel()[deep] for axis in nearest], box.shape)
        out = feet[source] - box.node(deep)
        depth = np.linalg.norm(out, axis=1)
        node, height = np.concatenate([node, deep]), np.concatenate([height, -depth])
        normal = np.concatenate([normal, out / depth[:, None]])
        thin = np.concatenate([thin, np.zeros(len(deep), bool)])
    return node, height, normal, thin


def _inside(close: np.ndarray, box: Box, obstacle: Obstacle, cell_size: float) -> np.ndarray:
    """Returns the nodes inside a body, bool [box], from flat indices of nodes within SIDE_CELLS of its surface.

    No surface lies between neighbouring nodes that are farther away, so one test for each connected region is enough.
    """
    from scipy import ndimage  # imported here, because it takes 0.2 s, and solvers need it only for moving bodies

    apart, inside = np.ones(box.shape, bool), np.zeros(box.shape, bool)
    apart.ravel()[close] = False
    inside.ravel()[close] = contains(box.node(close) * cell_size, obstacle)
    region, count = ndimage.label(apart)
    if count:
        places = ndimage.maximum_position(apart, region, np.arange(1, count + 1))
        sample = np.ravel_multi_index(tuple(np.array(places).T), box.shape)
        inside |= np.concatenate([[False], contains(box.node(sample) * cell_size, obstacle)])[region]
    return inside
