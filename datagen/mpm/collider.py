"""Contact nodes of mesh obstacles: grid nodes near or inside a mesh, each with the free direction of motion.

A collider from the paper's cell normals leaks, so the solver builds its own from the triangles.
Shape legend: K contact nodes, P points, F triangles, V vertices.

Closed bodies: nodes inside and up to a quarter of a cell above the surface stop inward motion. If a body is thinner
than a cell, nodes outside stop it too, in a band of at least one cell.

Sheets (open meshes): particles on both sides reach the same nodes, which would couple them. So a node near a sheet has
two fields of mass and velocity (Bardenhagen et al. 2000). Particles that see the node use the first field. Particles
from which the sheet hides it use the second (the "colours" of Hu et al. 2018, by line of sight). For hidden
particles the node lies behind the surface, like the inside of a body, with the normal toward the sheet.

A particle's spline reaches 1.5 cells, so a node would stop material at a distance and leave a gap. Therefore a node
near the surface stops motion only if its mass is at least that of material 0.75 cells from the surface. Without nodes
at the surface three quarters of the load would have no support. Then the lowest cell of sand would collapse into a
layer that only the swept test stops, with too much friction.

If two obstacles claim a node, the nearer surface counts. The swept test stops remaining crossings, with the same
friction.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from datagen.mpm.sweep import ON_TRIANGLE, Sweep, build_sweep, near_pairs, near_slabs
from hgn.scene.distance import closest_points, contains, cross, dot, square
from hgn.scene.scene import Obstacle, Scene
from hgn.schema import ConfigError

SEEN, HIDDEN = 0, 1  # the two fields of a node
ON_SURFACE_CELLS = 0.05  # distance below which the direction to the surface is rounding
MOVE_CELLS = 0.1  # largest motion of an obstacle until its contacts are built again
BEARING_CELLS = 0.25  # height above a surface up to which nodes stop motion
LARGE_RADIUS = 2.0  # radius of a large triangle, as a multiple of the reach
SIDE_CELLS = 0.51  # a little more than half the distance of two nodes
GAP_CELLS = 0.75  # distance of material from a surface at which nodes begin to stop it
STENCIL_CELLS = 1.501  # largest distance of a particle's nodes along each axis, with rounding
ON_EDGE = 1e-6  # barycentric coordinate below which a point lies on a triangle's edge
WIDENED = 1 + 1e-3  # factor for triangles, because kernels search a ten-thousandth beyond their edges
REACH_CELLS = WIDENED * STENCIL_CELLS * np.sqrt(3.0)  # largest distance of a particle's nodes in any direction
# squared area over fourth power of the longest edge, below which a triangle has no direction
FLAT_TRIANGLE = 1e-20
# nodes: flat index in a box [P], signed distance from the surface in cells [P], free direction [P, 3], least mass [P]
Contacts = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Collider:
    """A scene's contact nodes, the triangles that particles may not cross, and its closed bodies."""

    node_K3: np.ndarray  # int32, unique
    normal_K23: np.ndarray  # float32, free direction in each field, unit length; zero where all motion is free
    obstacle_K2: np.ndarray  # int32, the obstacle in contact in each field
    least_K2: np.ndarray  # float32: smallest fraction of a full cell's mass with which the node stops motion
    doubled_K: np.ndarray  # bool: sheets hide the node from some particles
    closed: tuple[Obstacle, ...]
    sweep: Sweep

    def count_inside(self, position_N3: np.ndarray) -> int:
        """Returns the number of particles inside closed obstacles."""
        inside = np.zeros(len(position_N3), bool)
        for obstacle in self.closed:
            inside |= contains(position_N3, obstacle)
        return int(inside.sum())


def build_collider(scene: Scene, band_cells: float, time: float = 0.0) -> Collider:
    """Returns the contact nodes of all obstacles of a scene in their pose at `time`, in seconds.

    Nodes lie at multiples of scene.cell_size. They are valid until an obstacle has moved by MOVE_CELLS. Memory is
    bounded for any number and size of triangles. Triangles without area and parts outside the domain are omitted.
    Raises: ConfigError if vertices of an obstacle are not finite, or indices of its triangles are out of range.
    """
    shape = tuple(round(length / scene.cell_size) for length in scene.domain_size)
    count = int(np.prod(shape))
    surfaces = _Surface(count), _Surface(count)
    doubled = np.zeros(count, bool)
    triangles: dict[bool, list[np.ndarray]] = {False: [np.zeros((0, 3, 3))], True: []}
    owners: dict[bool, list[np.ndarray]] = {False: [np.zeros(0, np.int32)], True: []}
    obstacles = [placed(obstacle, time) for obstacle in scene.obstacles]
    for index, obstacle in enumerate(obstacles):
        triangle_F33, rim_F6 = _triangles(obstacle, index, scene.cell_size)
        triangles[obstacle.closed].append(triangle_F33)
        owners[obstacle.closed].append(np.full(len(triangle_F33), index, np.int32))
        if not len(triangle_F33):
            continue
        # the direction out of a body is exact at all nodes that an outside particle may reach
        box = _Box(triangle_F33, max(band_cells, REACH_CELLS) if obstacle.closed else REACH_CELLS, shape)
        if obstacle.closed:
            contacts = _closed_contacts(obstacle, triangle_F33, band_cells, box, scene.cell_size)
            surfaces[SEEN].merge(index, box, contacts)
        else:
            for surface, contacts in zip(surfaces, _sheet_contacts(triangle_F33, rim_F6, box), strict=True):
                surface.merge(index, box, contacts)
            centre_F13 = triangle_F33.mean(axis=1, keepdims=True)
            reach = STENCIL_CELLS if obstacle.motion is None else STENCIL_CELLS + 2 * MOVE_CELLS
            for node, _ in near_slabs(centre_F13 + WIDENED * (triangle_F33 - centre_F13), reach, shape):
                doubled[np.ravel_multi_index(tuple(node), shape)] = True
    node = np.flatnonzero(doubled | np.isfinite(surfaces[SEEN].distance))
    return Collider(
        np.stack(np.unravel_index(node, shape), axis=1).astype(np.int32),
        np.stack([surface.normal[node] for surface in surfaces], axis=1),
        np.stack([surface.obstacle[node] for surface in surfaces], axis=1),
        np.stack([surface.least[node] for surface in surfaces], axis=1),
        doubled[node],
        tuple(obstacle for obstacle in obstacles if obstacle.closed and len(obstacle.triangle_F3)),
        build_sweep(
            np.concatenate(triangles[False] + triangles[True]),
            np.concatenate(owners[False] + owners[True]),
            sum(map(len, triangles[False])),
            shape,
        ),
    )


def placed(obstacle: Obstacle, time: float) -> Obstacle:
    """Returns the obstacle in its pose at a time in seconds."""
    if obstacle.motion is None:
        return obstacle
    return dataclasses.replace(obstacle, vertex_V3=obstacle.motion.place(obstacle.vertex_V3, time))


class _Box:
    """The part of a grid of `grid` nodes that contains all nodes up to `reach` cells from triangles."""

    def __init__(self, triangle_F33: np.ndarray, reach: float, grid: tuple[int, ...]) -> None:
        self.grid, self.reach = grid, reach
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


class _Surface:
    """The closest surface of each node: distance in cells (infinity without one), free direction, obstacle."""

    def __init__(self, count: int) -> None:
        self.distance = np.full(count, np.inf)
        self.normal = np.zeros((count, 3), np.float32)
        self.obstacle = np.zeros(count, np.int32)
        self.least = np.zeros(count, np.float32)

    def merge(self, obstacle: int, box: _Box, contacts: Contacts) -> None:
        flat, height, normal, least = contacts
        node = box.flat_in_grid(flat)
        distance = np.abs(height)
        nearer = distance < self.distance[node]
        node = node[nearer]
        self.distance[node], self.normal[node], self.least[node] = distance[nearer], normal[nearer], least[nearer]
        self.obstacle[node] = obstacle


def reached(height: np.ndarray) -> np.ndarray:
    """Returns the fraction of a full cell's mass at nodes with these heights above a surface, in cells.

    Material fills the half-space above GAP_CELLS. The fraction is the integral of the spline.
    """
    below = GAP_CELLS - height
    far = np.clip(1.5 - np.abs(below), 0, 1) ** 3 / 6
    near = 0.5 - np.abs(below) * (0.75 - below**2 / 3)
    share = np.where(np.abs(below) < 0.5, near, far)
    return np.asarray(np.where(below < 0, 1 - share, share))


def _triangles(obstacle: Obstacle, index: int, cell_size: float) -> tuple[np.ndarray, np.ndarray]:
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


def _rasterise(triangle_F33: np.ndarray, box: _Box) -> tuple[np.ndarray, ...]:
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


def _sheet_contacts(triangle_F33: np.ndarray, rim_F6: np.ndarray, box: _Box) -> tuple[Contacts, Contacts]:
    """Returns the contacts of nodes near a sheet, for particles on the node's side and for those on the other side."""
    node, distance, foot, owner = _rasterise(triangle_F33, box)
    face = _face_normals(triangle_F33)[owner]
    offset = box.node(node) - foot
    height = (offset * face).sum(axis=1)
    away = offset / np.where(distance < ON_SURFACE_CELLS, 1.0, distance)[:, None]
    # at the rim the direction to the foot is along the sheet, not through it
    on_rim = _on_rim(foot, triangle_F33, rim_F6, owner)
    across = (distance < ON_SURFACE_CELLS) | on_rim
    away[across] = face[across] * np.where(height[across] < -ON_TRIANGLE, -1.0, 1.0)[:, None]
    depth = np.where(across, np.abs(height), distance)
    own = (distance <= BEARING_CELLS) & ~on_rim
    return (node[own], distance[own], away[own], reached(distance[own])), (node, -distance, -away, reached(-depth))


def _on_rim(foot_P3: np.ndarray, triangle_F33: np.ndarray, rim_F6: np.ndarray, owner_P: np.ndarray) -> np.ndarray:
    """Returns whether points of triangles lie on their parts `rim_F6` (see _triangles), bool [P]."""
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


def _closed_contacts(
    obstacle: Obstacle, triangle_F33: np.ndarray, band: float, box: _Box, cell_size: float
) -> Contacts:
    node, distance, foot, owner = _rasterise(triangle_F33, box)
    if not len(node):  # the grid lies inside the body, so there is no direction out of it
        return node, distance, foot, distance
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
    outside = np.flatnonzero((height > -BEARING_CELLS) & (height <= max(band, 1.0)))
    thin[outside] = ~contains((foot[outside] - normal[outside]) * cell_size, obstacle)
    chosen = (height <= BEARING_CELLS) | thin
    node, height, normal, least = (
        node[chosen],
        height[chosen],
        normal[chosen],
        np.where(thin, 0.0, reached(height))[chosen],
    )

    deep = np.flatnonzero(inside.ravel() & ~near.ravel())
    if len(deep):  # the direction out leads to the surface point that is closest to the nearest node of the band
        feet = np.zeros((box.count, 3))
        feet[np.flatnonzero(near.ravel())] = foot
        nearest = ndimage.distance_transform_edt(~near, return_distances=False, return_indices=True)
        source = np.ravel_multi_index([axis.ravel()[deep] for axis in nearest], box.shape)
        out = feet[source] - box.node(deep)
        depth = np.linalg.norm(out, axis=1)
        node, height = np.concatenate([node, deep]), np.concatenate([height, -depth])
        normal = np.concatenate([normal, out / depth[:, None]])
        least = np.concatenate([least, np.zeros(len(deep))])
    return node, height, normal, least


def _inside(close: np.ndarray, box: _Box, obstacle: Obstacle, cell_size: float) -> np.ndarray:
    """Returns the nodes inside a body, bool [box], from flat indices of nodes within SIDE_CELLS of its surface.

    No surface lies between neighbouring nodes that are farther away, so one test for each connected region is enough.
    """
    apart, inside = np.ones(box.shape, bool), np.zeros(box.shape, bool)
    apart.ravel()[close] = False
    inside.ravel()[close] = contains(box.node(close) * cell_size, obstacle)
    region, count = ndimage.label(apart)
    if count:
        places = ndimage.maximum_position(apart, region, np.arange(1, count + 1))
        sample = np.ravel_multi_index(tuple(np.array(places).T), box.shape)
        inside |= np.concatenate([[False], contains(box.node(sample) * cell_size, obstacle)])[region]
    return inside
