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

The nodes near a moving obstacle change. So kernels read its surface from samples in a grid that moves with it
(datagen.mpm.body_kernel), which datagen.mpm.body computes once.
"""

from dataclasses import dataclass

import numpy as np

from datagen.mpm.body import REACH_CELLS, STENCIL_CELLS, WIDENED, Body, build_body
from datagen.mpm.surface_samples import BEARING_CELLS, Box, closed_samples, sheet_samples, triangles_of
from datagen.mpm.sweep import Sweep, build_sweep, near_slabs
from hgn.scene.distance import contains
from hgn.scene.scene import Obstacle, Scene

SEEN, HIDDEN = 0, 1  # the two fields of a node
GAP_CELLS = 0.75  # distance of material from a surface at which nodes begin to stop it
# nodes: flat index in a box [P], signed distance from the surface in cells [P], free direction [P, 3], least mass [P]
Contacts = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Collider:
    """Contact nodes and triangles of a scene's obstacles at rest, its moving obstacles, and all its closed ones."""

    node_K3: np.ndarray  # int32, unique
    normal_K23: np.ndarray  # float32, free direction in each field, unit length; zero where all motion is free
    obstacle_K2: np.ndarray  # int32, the obstacle in contact in each field
    least_K2: np.ndarray  # float32: smallest fraction of a full cell's mass with which the node stops motion
    distance_K2: np.ndarray  # float32: distance of the obstacle in contact in each field, cells; infinity without one
    doubled_K: np.ndarray  # bool: sheets hide the node from some particles
    closed: tuple[Obstacle, ...]
    sweep: Sweep
    bodies: tuple[Body, ...] = ()

    def count_inside(self, position_N3: np.ndarray, time: float = 0.0) -> int:
        """Returns the number of particles inside closed obstacles at a time in seconds."""
        inside = np.zeros(len(position_N3), bool)
        for obstacle in self.closed:
            inside |= contains(position_N3, obstacle.at(time))
        return int(inside.sum())


def build_collider(scene: Scene, band_cells: float) -> Collider:
    """Returns the contact nodes of a scene's obstacles at rest, and its moving obstacles in their own frames.

    Nodes lie at multiples of scene.cell_size. Memory is bounded for any number and size of triangles. Triangles without
    area and parts outside the domain are omitted.
    Raises: ConfigError if vertices of an obstacle are not finite, or indices of its triangles are out of range.
    """
    shape = tuple(round(length / scene.cell_size) for length in scene.domain_size)
    count = int(np.prod(shape))
    surfaces = _Surface(count), _Surface(count)
    doubled = np.zeros(count, bool)
    triangles: dict[bool, list[np.ndarray]] = {False: [np.zeros((0, 3, 3))], True: []}
    owners: dict[bool, list[np.ndarray]] = {False: [np.zeros(0, np.int32)], True: []}
    bodies = []
    for index, obstacle in enumerate(scene.obstacles):
        triangle_F33, rim_F6 = triangles_of(obstacle, index, scene.cell_size)
        if obstacle.motion is not None:
            bodies += build_body(obstacle, index, band_cells, scene)
            continue
        triangles[obstacle.closed].append(triangle_F33)
        owners[obstacle.closed].append(np.full(len(triangle_F33), index, np.int32))
        if not len(triangle_F33):
            continue
        # the direction out of a body is exact at all nodes that an outside particle may reach
        box = Box(triangle_F33, max(band_cells, REACH_CELLS) if obstacle.closed else REACH_CELLS, shape)
        if obstacle.closed:
            contacts = _closed_contacts(obstacle, triangle_F33, band_cells, box, scene.cell_size)
            surfaces[SEEN].merge(index, box, contacts)
        else:
            for surface, contacts in zip(surfaces, _sheet_contacts(triangle_F33, rim_F6, box), strict=True):
                surface.merge(index, box, contacts)
            centre_F13 = triangle_F33.mean(axis=1, keepdims=True)
            for node, _ in near_slabs(centre_F13 + WIDENED * (triangle_F33 - centre_F13), STENCIL_CELLS, shape):
                doubled[np.ravel_multi_index(tuple(node), shape)] = True
    node = np.flatnonzero(doubled | np.isfinite(surfaces[SEEN].distance))
    return Collider(
        np.stack(np.unravel_index(node, shape), axis=1).astype(np.int32),
        np.stack([surface.normal[node] for surface in surfaces], axis=1),
        np.stack([surface.obstacle[node] for surface in surfaces], axis=1),
        np.stack([surface.least[node] for surface in surfaces], axis=1),
        np.stack([surface.distance[node] for surface in surfaces], axis=1).astype(np.float32),
        doubled[node],
        tuple(obstacle for obstacle in scene.obstacles if obstacle.closed and len(obstacle.triangle_F3)),
        build_sweep(
            np.concatenate(triangles[False] + triangles[True]),
            np.concatenate(owners[False] + owners[True]),
            sum(map(len, triangles[False])),
            shape,
        ),
        tuple(bodies),
    )


class _Surface:
    """The closest surface of each node: distance in cells (infinity without one), free direction, obstacle."""

    def __init__(self, count: int) -> None:
        self.distance = np.full(count, np.inf)
        self.normal = np.zeros((count, 3), np.float32)
        self.obstacle = np.zeros(count, np.int32)
        self.least = np.zeros(count, np.float32)

    def merge(self, obstacle: int, box: Box, contacts: Contacts) -> None:
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


def _sheet_contacts(triangle_F33: np.ndarray, rim_F6: np.ndarray, box: Box) -> tuple[Contacts, Contacts]:
    """Returns the contacts of nodes near a sheet, for particles on the node's side and for those on the other side."""
    node, distance, depth, away, on_rim, _ = sheet_samples(triangle_F33, rim_F6, box)
    own = (distance <= BEARING_CELLS) & ~on_rim
    return (node[own], distance[own], away[own], reached(distance[own])), (node, -distance, -away, reached(-depth))


def _closed_contacts(obstacle: Obstacle, triangle_F33: np.ndarray, band: float, box: Box, cell_size: float) -> Contacts:
    node, height, normal, thin = closed_samples(obstacle, triangle_F33, band, box, cell_size)
    chosen = (height <= BEARING_CELLS) | thin
    return node[chosen], height[chosen], normal[chosen], np.where(thin, 0.0, reached(height))[chosen]
