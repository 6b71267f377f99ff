"""Mesh obstacles as the grid sees them: nodes near or inside a mesh, each with the direction that is free.

The paper's cell normals leak when used as a collider, so the solver builds its own from the triangles.
Shape legend: K contact nodes, P points, F triangles, V vertices.

Sheets (open meshes): nodes within `band_cells` of the surface, with the normal toward the node's own side. The nodes
nearest to the sheet (within half a cell) stop motion both ways: one that lies just behind the sheet would else pass on
what comes from the front. Closed bodies: nodes inside, a third of a cell below the surface, with the
normal outward; where the body is thinner than a cell, so that no node may lie there, those nearer to the surface and
outside too, in a band of one cell at least. Where two obstacles claim a node, the closest surface wins. What nodes
leave open the swept test stops.

A particle's spline reaches 1.5 cells, so a solid block stops well above the uppermost node that stops it: 0.85 cells
where there is one layer of such nodes, 1.32 where there are more below. For it to rest within a cell of the surface
those nodes must lie that much lower: 0.15 cells above a sheet at most, so bands are lowered by 0.35 cells the way
gravity pulls, and stay as thick; and 0.35 cells within a body.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from datagen.mpm.sweep import Sweep, build_sweep, near_pairs
from hgn.scene.distance import closest_points, contains
from hgn.scene.scene import Obstacle, Scene
from hgn.schema import ConfigError

ONE_SIDED, BOTH_SIDES = 1, 2
ON_SURFACE_CELLS = 0.05  # nearer than this, the direction to the surface is rounding
ROUNDING = 2e-6  # of a distance: a sheet midway between nodes has nodes on both sides within half a cell
BOTH_SIDES_CELLS = 0.5 * (1 + ROUNDING)
LOWERED_CELLS = 0.35  # of a band, where a sheet lies level
BARE_CELLS = 0.35  # below a body's surface, where nodes stop nothing
# squared area over fourth power of the longest edge, below which a triangle has no direction
FLAT_TRIANGLE = 1e-20


@dataclass(frozen=True, eq=False)
class Collider:
    """A scene's contact nodes, the triangles that none may cross, and which of its bodies are closed."""

    node_K3: np.ndarray  # int32, unique
    normal_K3: np.ndarray  # float32, unit length
    kind_K: np.ndarray  # uint8: ONE_SIDED or BOTH_SIDES
    closed: tuple[Obstacle, ...]
    sweep: Sweep

    def count_inside(self, position_N3: np.ndarray) -> int:
        """How many of the particles lie inside a closed obstacle."""
        inside = np.zeros(len(position_N3), bool)
        for obstacle in self.closed:
            inside |= contains(position_N3, obstacle)
        return int(inside.sum())


def build_collider(scene: Scene, band_cells: float) -> Collider:
    """The contact nodes of all obstacles of a scene; nodes lie at multiples of scene.cell_size.

    Any number and size of triangles takes bounded memory. Triangles without area and parts outside the domain
    are left out. Raises: ConfigError when an obstacle has vertices that are not finite, or triangles whose
    indices are out of range.
    """
    shape = tuple(round(length / scene.cell_size) for length in scene.domain_size)
    surface = _Surface(shape)
    gravity = np.array(scene.gravity, np.float64)
    up = -gravity / (np.linalg.norm(gravity) or 1.0)
    triangles = [np.zeros((0, 3, 3))]
    for index, obstacle in enumerate(scene.obstacles):
        triangle_F33 = _triangles(obstacle, index) / scene.cell_size
        triangles.append(triangle_F33)
        if len(triangle_F33):
            surface.merge(
                _closed_contacts(obstacle, triangle_F33, band_cells, shape, scene.cell_size)
                if obstacle.closed
                else _sheet_contacts(triangle_F33, band_cells, shape, up)
            )
    node = np.flatnonzero(np.isfinite(surface.distance))
    return Collider(
        np.stack(np.unravel_index(node, shape), axis=1).astype(np.int32),
        surface.normal[node],
        surface.kind[node],
        tuple(obstacle for obstacle in scene.obstacles if obstacle.closed and len(obstacle.triangle_F3)),
        build_sweep(np.concatenate(triangles), shape),
    )


class _Surface:
    """Per node the closest surface: distance in cells, free direction, kind; infinity where there is none."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        count = int(np.prod(shape))
        self.shape = shape
        self.distance = np.full(count, np.inf)
        self.normal = np.zeros((count, 3), np.float32)
        self.kind = np.zeros(count, np.uint8)

    def merge(self, contacts: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]) -> None:
        node, distance, normal, kind = contacts
        nearer = distance < self.distance[node]
        node = node[nearer]
        self.distance[node], self.normal[node], self.kind[node] = distance[nearer], normal[nearer], kind[nearer]


def _triangles(obstacle: Obstacle, index: int) -> np.ndarray:
    """Corners of the triangles that have an area, float64 [F, 3, 3]."""
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
    edge = corner - np.roll(corner, 1, axis=1)
    longest_square = (edge**2).sum(axis=2).max(axis=1)
    area_square = (np.cross(edge[:, 0], edge[:, 1]) ** 2).sum(axis=1)
    return corner[area_square > FLAT_TRIANGLE * longest_square**2]


def _rasterise(triangle_F33: np.ndarray, band: float, shape: tuple[int, ...]) -> tuple[np.ndarray, ...]:
    """Nodes within `band` cells of the triangles: flat index [P], distance [P], closest point [P, 3], triangle [P].

    All in cells. Of triangles equally close the first counts.
    """
    count = int(np.prod(shape))
    best = np.full(count, np.inf)
    closest = np.zeros((count, 3))
    owner = np.full(count, -1, np.int64)
    normal = _face_normals(triangle_F33)
    centre = triangle_F33.mean(axis=1)
    radius = np.linalg.norm(triangle_F33 - centre[:, None], axis=2).max(axis=1)
    # a triangle counts at a node only if its sphere comes nearer than the nearest centre of all
    bound = np.full(count, band)
    for node, triangle in near_pairs(triangle_F33, band, shape):
        np.minimum.at(bound, np.ravel_multi_index(node.T, shape), np.linalg.norm(node - centre[triangle], axis=1))
    for node, triangle in near_pairs(triangle_F33, band, shape):
        flat = np.ravel_multi_index(node.T, shape)
        height = ((node - triangle_F33[triangle, 0]) * normal[triangle]).sum(axis=1)
        reach = np.linalg.norm(node - centre[triangle], axis=1) - radius[triangle]
        keep = np.maximum(np.abs(height), reach) <= bound[flat] + 1e-9
        node, triangle, flat = node[keep], triangle[keep], flat[keep]
        foot = closest_points(node, triangle_F33[triangle])
        distance = np.linalg.norm(node - foot, axis=1)
        nearer = (distance <= band) & (distance < best[flat])
        flat, distance, foot, triangle = flat[nearer], distance[nearer], foot[nearer], triangle[nearer]
        order = np.lexsort((triangle, distance, flat))
        first = order[np.unique(flat[order], return_index=True)[1]]
        node_first = flat[first]
        best[node_first], closest[node_first], owner[node_first] = distance[first], foot[first], triangle[first]
    near = np.flatnonzero(owner >= 0)
    return near, best[near], closest[near], owner[near]


def _face_normals(triangle_F33: np.ndarray) -> np.ndarray:
    normal = np.cross(triangle_F33[:, 1] - triangle_F33[:, 0], triangle_F33[:, 2] - triangle_F33[:, 0])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _points(flat: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    return np.stack(np.unravel_index(flat, shape), axis=1).astype(np.float64)


def _sheet_contacts(
    triangle_F33: np.ndarray, band: float, shape: tuple[int, ...], up: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    lowered = min(LOWERED_CELLS, band)
    node, distance, foot, owner = _rasterise(triangle_F33, (band + lowered) * (1 + ROUNDING), shape)
    on_surface = distance < ON_SURFACE_CELLS
    away = (_points(node, shape) - foot) / np.where(on_surface, 1.0, distance)[:, None]
    normal = np.where(on_surface[:, None], _face_normals(triangle_F33)[owner], away)
    reach = distance + lowered * np.where(on_surface, 0.0, normal @ up)
    chosen = reach <= band * (1 + ROUNDING)
    kind = np.where(reach <= BOTH_SIDES_CELLS, BOTH_SIDES, ONE_SIDED)
    return node[chosen], distance[chosen], normal[chosen], kind[chosen]


def _closed_contacts(
    obstacle: Obstacle, triangle_F33: np.ndarray, band: float, shape: tuple[int, ...], cell_size: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    # one cell at least: a line of nodes that crosses the surface then meets a node of the band
    band = max(band, 1.0)
    node, distance, foot, owner = _rasterise(triangle_F33, band, shape)
    within = contains(_points(node, shape) * cell_size, obstacle)
    inside = np.zeros(shape, bool)
    inside.ravel()[node[within]] = True
    near = np.zeros(shape, bool)
    near.ravel()[node] = True
    _fill_inside(inside, near, obstacle, cell_size)

    point = _points(node, shape)
    sign = np.where(within, -1.0, 1.0)
    on_surface = distance < ON_SURFACE_CELLS
    away = (point - foot) * (sign / np.where(on_surface, 1.0, distance))[:, None]
    face = _face_normals(triangle_F33)[owner]
    # face normals may point inwards: the side that lies inside decides
    on = np.flatnonzero(on_surface)
    inward = contains((foot[on] + 0.1 * face[on]) * cell_size, obstacle)
    face[on[inward]] *= -1
    normal = np.where(on_surface[:, None], face, away)

    # thin: a cell further on, past the surface, lies outside again
    thin = np.zeros(len(node), bool)
    between = np.flatnonzero((sign * distance > -BARE_CELLS) & (distance <= band))
    thin[between] = ~contains((foot[between] - normal[between]) * cell_size, obstacle)
    chosen = (sign * distance <= -BARE_CELLS) | thin
    node, distance, normal = node[chosen], distance[chosen], normal[chosen]

    deep = np.flatnonzero(inside.ravel() & ~near.ravel())
    if len(deep):  # the way out leads to the surface that is nearest to the nearest node of the band
        feet = np.zeros((int(np.prod(shape)), 3))
        feet[np.flatnonzero(near.ravel())] = foot
        nearest = ndimage.distance_transform_edt(~near, return_distances=False, return_indices=True)
        source = np.ravel_multi_index([axis.ravel()[deep] for axis in nearest], shape)
        out = feet[source] - _points(deep, shape)
        depth = np.linalg.norm(out, axis=1)
        node, distance = np.concatenate([node, deep]), np.concatenate([distance, depth])
        normal = np.concatenate([normal, out / depth[:, None]])
    return node, distance, normal, np.full(len(node), ONE_SIDED)


def _fill_inside(inside: np.ndarray, near: np.ndarray, obstacle: Obstacle, cell_size: float) -> None:
    """Marks the nodes inside that are not near the surface: one test for each connected region of them."""
    region, count = ndimage.label(~near)
    if count == 0:
        return
    index = np.arange(1, count + 1)
    sample = np.array(ndimage.maximum_position(~near, region, index)).reshape(-1, 3)
    holds = contains(sample * cell_size, obstacle)
    inside |= np.concatenate([[False], holds])[region]
