"""Obstacles and ways that meet them, for the tests of obstacles that nothing passes."""

import numpy as np

from hgn.network.barriers import Barriers
from hgn.scene.barrier import build_barrier
from hgn.scene.rotation import euler_rotation
from hgn.scene.scene import all_corners
from hgn.scene.shapes import shape_obstacle

CELL, CLEARANCE = 1 / 64, 1e-3
DOMAIN = (1.0, 1.0, 1.0)


def square(at, normal_axis, size=0.25):
    """A square of two triangles about a place, across an axis: corners [2, 3, 3]."""
    first, second = [axis for axis in range(3) if axis != normal_axis]
    corner_43 = np.tile(np.asarray(at, float), (4, 1))
    for corner, (a, b) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
        corner_43[corner, first] += 0.5 * size * a
        corner_43[corner, second] += 0.5 * size * b
    return corner_43[[[0, 1, 2], [0, 2, 3]]]


def barriers_of(*scenes, clearance=CLEARANCE):
    return Barriers.of([build_barrier(corner_F33, CELL, clearance, DOMAIN) for corner_F33 in scenes])


def scattered(seed, count=2000):
    """Obstacles of three kinds somewhere, and ways of all lengths around them."""
    generator = np.random.default_rng(seed)
    meshes = [
        shape_obstacle(
            shape, size, tuple(generator.uniform(0.3, 0.7, 3)), euler_rotation(tuple(generator.uniform(0, 360, 3)))
        )
        for shape, size in (("pyramid", 0.3), ("half_sphere", 0.25), ("square", 0.4))
    ]
    before_N3 = generator.uniform(0.2, 0.8, (count, 3))
    way_N3 = generator.normal(size=(count, 3)) * 10.0 ** generator.uniform(-4, -0.7, (count, 1))
    return all_corners(meshes), before_N3, before_N3 + way_N3


def gutter(degrees):
    """Two sheets that meet at an angle of so much below, along z: corners [4, 3, 3]."""
    sheet = square((0.2, 0, 0), 1, 0.4)
    sides = [sheet @ euler_rotation((0, 0, 90 - sign * degrees / 2)).T for sign in (1, -1)]
    return np.add(np.concatenate(sides), (0.5, 0.4, 0.5))


def ball(rings, radius):
    """A ball about the origin of rings of triangles."""
    polar, around = np.linspace(0, np.pi, rings + 1)[:, None], np.linspace(0, 2 * np.pi, 2 * rings + 1)
    place = np.stack([np.sin(polar) * np.cos(around), np.cos(polar) + 0 * around, np.sin(polar) * np.sin(around)], -1)
    place *= radius
    a, b, c, d = place[:-1, :-1], place[1:, :-1], place[1:, 1:], place[:-1, 1:]
    return np.concatenate([np.stack([a, b, c], -2).reshape(-1, 3, 3), np.stack([a, c, d], -2).reshape(-1, 3, 3)])


def crossings(before_N3, after_N3, corner_F33):
    """How many ways pass a triangle (Moeller and Trumbore 1997), by determinants alone."""
    count = 0
    for a, b, c in corner_F33:
        way_N3, e1, e2 = after_N3 - before_N3, b - a, c - a
        p_N3, t_N3 = np.cross(way_N3, e2), before_N3 - a
        determinant_N = p_N3 @ e1
        with np.errstate(divide="ignore", invalid="ignore"):
            q_N3 = np.cross(t_N3, e1)
            u_N, v_N = (t_N3 * p_N3).sum(-1) / determinant_N, (way_N3 * q_N3).sum(-1) / determinant_N
            time_N = q_N3 @ e2 / determinant_N
            count += int(((u_N >= 0) & (v_N >= 0) & (u_N + v_N <= 1) & (time_N >= 0) & (time_N <= 1)).sum())
    return count
