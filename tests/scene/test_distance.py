"""Distances to triangles and what is inside of a mesh, by brute force and by counting turns."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from hgn.scene.distance import DIRECT_TRIANGLES, closest_points, contains, winding_numbers
from hgn.scene.scene import Obstacle

COORDINATE = st.integers(-4, 4).map(float)  # small integers, so that degenerate triangles are common
POINT = st.tuples(COORDINATE, COORDINATE, COORDINATE)


def brute_force(point, triangle, steps=200):
    """Smallest distance to a barycentric lattice on the triangle."""
    u, v = np.meshgrid(np.linspace(0, 1, steps + 1), np.linspace(0, 1, steps + 1))
    u, v = u[u + v <= 1 + 1e-12], v[u + v <= 1 + 1e-12]
    lattice = triangle[0] + u[:, None] * (triangle[1] - triangle[0]) + v[:, None] * (triangle[2] - triangle[0])
    return float(np.sqrt(((lattice - point) ** 2).sum(axis=1).min()))


def obstacle_of(mesh, closed=True):
    return Obstacle("mesh", np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32), closed)


@settings(max_examples=60, deadline=None)
@given(point=POINT, corners=st.tuples(POINT, POINT, POINT))
def test_closest_point_is_on_the_triangle_and_no_point_is_nearer(point, corners):
    """For any triangle, degenerate ones too, the distance is that to a fine lattice, up to its step."""
    triangle = np.array(corners)
    closest = closest_points(np.array([point]), triangle[None])[0]
    distance = np.linalg.norm(closest - point)
    found = brute_force(np.array(point), triangle)
    step = max(np.linalg.norm(triangle - np.roll(triangle, 1, axis=0), axis=1)) / 200
    assert found - 2 * step - 1e-9 <= distance <= found + 1e-9
    assert brute_force(closest, triangle) <= 2 * step + 1e-9


@pytest.mark.parametrize("scale", [0.0, 1e-300, 1e-160, 1e-80, 1.0, 1e60])
def test_closest_points_are_finite_at_every_scale(scale):
    """Points, segments, slivers and triangles of any size give finite points within their box."""
    corners = [[(0, 0, 0)] * 3, [(0, 0, 0), (1, 1, 1), (2, 2, 2)], [(0, 0, 0), (1, 0, 0), (0.5, 1e-17, 0)]]
    triangle = np.array([*corners, [(0, 0, 0), (1, 0, 0), (0, 1, 0)]], float) * scale
    closest = closest_points(np.full((4, 3), 0.25 * scale), triangle)
    assert np.isfinite(closest).all()
    assert (closest >= triangle.min(axis=1) - 1e-15 * scale).all()
    assert (closest <= triangle.max(axis=1) + 1e-15 * scale).all()


def test_winding_number_counts_turns():
    """1 inside an outward mesh, -1 inside its mirror, 0 outside, 2 inside two copies, 1/2 at a half space; zero-area
    triangles add nothing, even where a point lies on them."""
    box = trimesh.creation.box((1, 1, 1)).triangles
    point = np.array([[0.1, 0.2, 0.3], [0.6, 0.2, 0.3], [5.0, 0.0, 0.0]])
    np.testing.assert_allclose(winding_numbers(point, box), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(winding_numbers(point, box[:, ::-1]), [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(winding_numbers(point, np.concatenate([box, box])), [2, 0, 0], atol=1e-12)
    junk = np.array([[[0, 0, 0], [0, 0, 0], [0, 0, 0]], [[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]], float)
    inside = np.array([[0.0, 0.0, 0.0], [0.3, 0.3, 0.1]])
    np.testing.assert_allclose(winding_numbers(inside, np.concatenate([box, junk])), [1, 1], atol=1e-12)
    sheet = np.array([[[-1e6, 0, -1e6], [1e6, 0, -1e6], [0, 0, 1e6]]])
    assert abs(winding_numbers(np.array([[0, 1e-3, 0]]), sheet)[0]) == pytest.approx(0.5, abs=1e-6)


def test_far_field_agrees_with_the_dense_sum():
    """For a mesh above the direct limit, with a hole, the tree is within 0.02 of the exact sum."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.4)
    triangle = mesh.triangles[200:]
    parts = np.array_split(triangle, 8)
    assert len(triangle) > DIRECT_TRIANGLES >= max(map(len, parts))
    point = np.random.default_rng(0).random((500, 3)) * 1.2 - 0.6
    exact = sum(winding_numbers(point, part) for part in parts)
    np.testing.assert_allclose(winding_numbers(point, triangle), exact, atol=0.02)


@pytest.mark.parametrize("subdivisions", [2, 4])
@pytest.mark.parametrize("flip", [False, True])
def test_contains_does_not_depend_on_orientation(subdivisions, flip):
    """Points of a ball are inside, points outside are not, whichever way the triangles turn."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.3)
    if flip:
        mesh.invert()
    point = np.random.default_rng(1).random((2000, 3)) - 0.5
    radius, inside = np.linalg.norm(point, axis=1), contains(point, obstacle_of(mesh))
    assert inside[radius < 0.28].all() and not inside[radius > 0.3].any()


def test_nothing_is_inside_a_sheet_or_at_a_bad_point():
    """Sheets contain nothing, a NaN point is nowhere inside, and empty inputs give empty or zero outputs."""
    mesh = trimesh.creation.box((1, 1, 1))
    assert not contains(np.zeros((3, 3)), obstacle_of(mesh, closed=False)).any()
    assert contains(np.array([[0.1, 0.2, 0.3], [np.nan, 0, 0]]), obstacle_of(mesh)).tolist() == [True, False]
    assert contains(np.zeros((0, 3)), obstacle_of(mesh)).shape == (0,)
    assert closest_points(np.zeros((0, 3)), np.zeros((0, 3, 3))).shape == (0, 3)
    assert winding_numbers(np.zeros((0, 3)), mesh.triangles).shape == (0,)
    assert winding_numbers(np.ones((4, 3)), np.zeros((0, 3, 3))).tolist() == [0, 0, 0, 0]
