"""The five obstacles of the paper (sec. 3.3) as small triangle meshes, and mesh files instead of them.

Half box and half sphere are bowls without a lid. The square is a sheet. Cone and pyramid are closed and oriented
outwards. Open sides and tips point along +y before rotation.
"""

from __future__ import annotations

import functools
import hashlib
import math
from pathlib import Path

import numpy as np

from hgn.config import is_mesh_file
from hgn.scene.rotation import rotate, round_to_float32
from hgn.scene.scene import Obstacle
from hgn.schema import Vector, require

CLOSED_SHAPES = frozenset({"cone", "pyramid"})
SEGMENTS = 32  # number of segments around a cone
SPHERE_SEGMENTS, SPHERE_RINGS = 24, 6  # facets deviate by at most 0.9 % of the radius


def shape_obstacle(
    shape: str,
    size: float,
    position: Vector = (0.0, 0.0, 0.0),
    rotation_33: np.ndarray | None = None,
    name: str | None = None,
) -> Obstacle:
    """Returns an obstacle of a known shape. `position` is the centre of its unrotated bounding box.

    `size` is in domain units. It is the side of the square and of the half box, the diameter of the half sphere, and
    the base width and height of cone and pyramid. The half box is half as high. A mesh file's bounding box has `size`
    as its longest side. Vertices are rounded to float32.
    Raises: KeyError for a shape neither in hgn.config.OBSTACLE_SHAPES nor a file; ConfigError for a size <= 0 or an
    unreadable mesh.
    """
    require(0 < size < math.inf, "size", "finite and > 0", size)
    vertex, triangle, closed = unit_shape(shape)
    scaled = size * vertex
    turned = scaled if rotation_33 is None else rotate(scaled, rotation_33)
    placed = round_to_float32(turned + np.array(position, np.float64))
    return Obstacle(name or shape, placed, triangle, closed)


@functools.cache
def unit_shape(shape: str) -> tuple[np.ndarray, np.ndarray, bool]:
    """Returns the shape of size 1 about the origin: vertices float64 [V, 3], triangles int32 [F, 3], whether closed."""
    closed = shape in CLOSED_SHAPES
    if is_mesh_file(shape):
        # it imports parts of SciPy that few scenes need
        from hgn.scene.mesh import load_mesh

        mesh = load_mesh(shape, "obstacle_shapes")
        low, high = mesh.vertex_V3.min(axis=0), mesh.vertex_V3.max(axis=0)
        vertex_V3 = round_to_float32((mesh.vertex_V3 - 0.5 * (low + high)) / (high - low).max())
        triangle_F3, closed = mesh.triangle_F3, mesh.closed
    else:
        vertex, triangle = _BUILDERS[shape]()
        vertex_V3 = round_to_float32(np.array(vertex, np.float64))
        triangle_F3 = np.array(triangle, np.int32)
    vertex_V3.setflags(write=False)
    triangle_F3.setflags(write=False)
    return vertex_V3, triangle_F3, closed


@functools.cache
def mesh_sha256(shape: str) -> str:
    """Returns the sha256 of a mesh file. It identifies the mesh in data sets.

    Raises: ConfigError for an unreadable mesh.
    """
    unit_shape(shape)
    return hashlib.sha256(Path(shape).read_bytes()).hexdigest()


Mesh = tuple[list[Vector], list[tuple[int, int, int]]]


def _square() -> Mesh:
    vertex = [(-0.5, 0.0, -0.5), (-0.5, 0.0, 0.5), (0.5, 0.0, 0.5), (0.5, 0.0, -0.5)]
    return vertex, [(0, 1, 2), (0, 2, 3)]


def _half_box() -> Mesh:
    ring = [(-0.5, -0.5), (-0.5, 0.5), (0.5, 0.5), (0.5, -0.5)]
    vertex = [(x, y, z) for y in (-0.25, 0.25) for x, z in ring]
    triangle = [(0, 2, 1), (0, 3, 2)]
    for i in range(4):
        j = (i + 1) % 4
        triangle += [(i, j, j + 4), (i, j + 4, i + 4)]
    return vertex, triangle


def _half_sphere() -> Mesh:
    vertex = [(0.0, -0.25, 0.0)]
    for ring in range(1, SPHERE_RINGS + 1):
        polar = 0.5 * math.pi * ring / SPHERE_RINGS
        height, radius = 0.25 - 0.5 * math.cos(polar), 0.5 * math.sin(polar)
        vertex += [(radius * x, height, radius * z) for x, z in _circle(SPHERE_SEGMENTS)]
    triangle = []
    for i in range(SPHERE_SEGMENTS):
        j = (i + 1) % SPHERE_SEGMENTS
        triangle.append((0, 1 + i, 1 + j))
        for ring in range(SPHERE_RINGS - 1):
            lower, upper = 1 + ring * SPHERE_SEGMENTS, 1 + (ring + 1) * SPHERE_SEGMENTS
            triangle += [(lower + i, upper + i, upper + j), (lower + i, upper + j, lower + j)]
    return vertex, triangle


def _cone() -> Mesh:
    vertex = [(0.0, 0.5, 0.0), (0.0, -0.5, 0.0)]
    vertex += [(0.5 * x, -0.5, 0.5 * z) for x, z in _circle(SEGMENTS)]
    triangle = []
    for i in range(SEGMENTS):
        j = (i + 1) % SEGMENTS
        triangle += [(0, 2 + j, 2 + i), (1, 2 + i, 2 + j)]
    return vertex, triangle


def _pyramid() -> Mesh:
    vertex = [(0.0, 0.5, 0.0), (-0.5, -0.5, -0.5), (-0.5, -0.5, 0.5), (0.5, -0.5, 0.5), (0.5, -0.5, -0.5)]
    return vertex, [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 1), (1, 3, 2), (1, 4, 3)]


def _circle(segments: int) -> list[tuple[float, float]]:
    angles = (2 * math.pi * i / segments for i in range(segments))
    return [(math.cos(angle), math.sin(angle)) for angle in angles]


_BUILDERS = {"half_box": _half_box, "square": _square, "half_sphere": _half_sphere, "cone": _cone, "pyramid": _pyramid}
