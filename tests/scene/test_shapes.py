import numpy as np
import pytest
import trimesh

from hgn.config import OBSTACLE_SHAPES
from hgn.scene.rotation import euler_rotation, quaternion_product, quaternion_rotation
from hgn.scene.shapes import CLOSED_SHAPES, shape_obstacle, unit_shape
from hgn.scene.surface import split_long_edges

EXTENTS = {
    "half_box": (1, 0.5, 1),
    "square": (1, 0, 1),
    "half_sphere": (1, 0.5, 1),
    "cone": (1, 1, 1),
    "pyramid": (1, 1, 1),
}
VOLUMES = {"cone": np.pi / 12, "pyramid": 1 / 3}


@pytest.mark.parametrize("shape", OBSTACLE_SHAPES)
def test_shape_has_its_size_and_is_centred(shape):
    """The unrotated bounding box has the stated edges and its middle at the position."""
    obstacle = shape_obstacle(shape, 0.3, (0.5, 0.25, 0.75))
    low, high = obstacle.vertex_V3.min(axis=0), obstacle.vertex_V3.max(axis=0)
    np.testing.assert_allclose(high - low, 0.3 * np.array(EXTENTS[shape]), atol=1e-6)
    np.testing.assert_allclose((high + low) / 2, (0.5, 0.25, 0.75), atol=1e-6)
    assert 2 <= len(obstacle.triangle_F3) <= 400
    assert obstacle.closed == (shape in CLOSED_SHAPES)


@pytest.mark.parametrize("shape", OBSTACLE_SHAPES)
def test_closed_shapes_are_watertight_and_bowls_are_open(shape):
    """Cone and pyramid are watertight, outward and of the right volume; the others have a boundary."""
    vertex, triangle, _ = unit_shape(shape)
    mesh = trimesh.Trimesh(vertex, triangle, process=False)
    assert mesh.is_winding_consistent
    assert mesh.is_watertight == (shape in CLOSED_SHAPES)
    if shape in CLOSED_SHAPES:
        assert mesh.volume == pytest.approx(VOLUMES[shape], rel=0.01)


@pytest.mark.parametrize("shape", ["half_box", "half_sphere"])
def test_bowls_open_towards_y(shape):
    """Near the axis there is surface at the bottom only: there is no lid."""
    vertex, triangle, _ = unit_shape(shape)
    centroid = split_long_edges(vertex[triangle], 0.1).mean(axis=1)
    near_axis = np.hypot(centroid[:, 0], centroid[:, 2]) < 0.2
    assert near_axis.any()
    assert (centroid[near_axis, 1] < 0).all()


@pytest.mark.parametrize("shape", OBSTACLE_SHAPES)
def test_vertices_are_float32_numbers(shape):
    """Placed vertices survive a round trip through float32, so that they agree bitwise between machines."""
    turned = shape_obstacle(shape, 0.123, (0.4, 0.5, 0.6), euler_rotation((10.0, 20.0, 30.0))).vertex_V3
    assert (turned.astype(np.float32).astype(np.float64) == turned).all()


def test_euler_turns_about_fixed_axes_in_order():
    """x turns first: (90, 90, 0) takes +y to +z by x, then +z to +x by y; quarter turns are exact."""
    matrix = euler_rotation((90.0, 90.0, 0.0))
    assert (matrix @ [0.0, 1.0, 0.0]).tolist() == [1.0, 0.0, 0.0]
    assert set(np.abs(euler_rotation((-90.0, 450.0, 180.0))).ravel()) == {0.0, 1.0}
    turned = euler_rotation((0.0, 0.0, 30.0)) @ [1.0, 0.0, 0.0]
    np.testing.assert_allclose(turned, [np.sqrt(3) / 2, 0.5, 0.0], atol=1e-15)


def test_products_of_quaternions():
    """The product turns by the right one first, and is of length 1."""
    left, right = (0.5, -0.5, 0.1, 0.7), (0.6, 0.0, 0.8, 0.0)
    both = quaternion_product(left, right)
    np.testing.assert_allclose(
        quaternion_rotation(both), quaternion_rotation(left) @ quaternion_rotation(right), atol=1e-15
    )
    assert sum(value * value for value in both) == pytest.approx(1.0)


def test_rotations_are_orthonormal():
    """Both parametrisations give matrices with R R^T = 1 and determinant 1."""
    for matrix in (euler_rotation((12.0, -77.0, 203.0)), quaternion_rotation((0.5, -0.5, 0.1, 0.7))):
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(matrix) == pytest.approx(1.0)
