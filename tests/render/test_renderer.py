"""The software renderer: geometry that can be checked by hand, occlusion, and particles that ran away."""

import numpy as np
import pytest
import trimesh

from hgn.render.renderer import LIGHT, MATERIAL_COLORS, Camera, Stage, fragments, smooth_normals
from hgn.scene.scene import Obstacle

UNIT = (1.0, 1.0, 1.0)
CENTER = np.array([[0.5, 0.5, 0.5]])
WATER = np.zeros(1, np.uint8)


def sheet_towards_the_eye(distance):
    """A large square across the line of sight, `distance` from the domain's centre towards the eye."""
    right, up, back = Camera(UNIT, 64).axes
    middle = CENTER[0] + distance * back
    corner = [middle + 0.3 * (a * right + b * up) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return Obstacle("sheet", np.array(corner), np.array([[0, 1, 2], [0, 2, 3]], np.int32), closed=False)


def middle_color(stage, position_N3, material_N):
    picture = np.asarray(stage.draw(position_N3, material_N)).astype(np.int64)
    (x, y), *_ = stage.camera.project(CENTER)[0] / 2
    return picture[int(y), int(x)]


def test_fragments_of_a_right_triangle():
    """The pixels under a right triangle are those whose centres it contains, and its weights give them back."""
    corner = np.array([[[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]]])
    triangle, pixel, weight = fragments(corner, 5, 6)
    assert set(triangle) == {0}
    assert sorted(zip(pixel % 5, pixel // 5, strict=True)) == [
        (x, y) for x in range(4) for y in range(4) if x + y + 1 <= 4
    ]
    np.testing.assert_allclose(weight.sum(axis=1), 1)
    np.testing.assert_allclose(weight @ corner[0], np.stack((pixel % 5, pixel // 5), axis=1) + 0.5)


def test_fragments_are_clipped_and_either_winding_counts():
    """A triangle beyond the picture fills it whole; a degenerate one gives nothing."""
    large = np.array([[-50.0, -50.0], [200.0, -50.0], [-50.0, 200.0]])
    flat = np.array([[0.0, 0.0], [2.0, 2.0], [4.0, 4.0]])
    for corners in (large, large[::-1]):
        triangle, pixel, _ = fragments(np.stack((corners, flat)), 7, 3)
        assert set(triangle) == {0}
        assert sorted(pixel) == list(range(21))


def test_smooth_normals():
    """A sphere's normals point outwards from its centre; a cube keeps the normals of its faces."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    corner = sphere.vertices[sphere.faces]
    _, normal = smooth_normals(corner)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    assert (normal * corner).sum(axis=2).min() > 0.999
    box = trimesh.creation.box()
    _, normal = smooth_normals(box.vertices[box.faces])
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    np.testing.assert_allclose(normal, np.repeat(box.face_normals[:, None], 3, axis=1), atol=1e-9)


@pytest.mark.parametrize("domain_size", [UNIT, (4.0, 1.0, 2.0), (0.1, 0.3, 0.1)])
def test_camera_fits_the_domain(domain_size):
    """All corners of the domain lie inside the picture, which they nearly fill; up is up."""
    camera = Camera(domain_size, 200)
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * np.array(domain_size)
    xy, _ = camera.project(corner)
    assert (xy >= 0).all() and (xy <= (camera.width, camera.height)).all()
    assert np.ptp(xy[:, 0]) > 0.95 * camera.width
    assert (xy[2::4, 1] < xy[0::4, 1]).all()


def test_nearer_particles_cover_farther_ones():
    """Of two particles on one line of sight the nearer is seen, whatever their order in the arrays."""
    stage = Stage(UNIT, (), 0.05, 100)
    back = stage.camera.axes[2]
    position = np.concatenate((CENTER + 0.2 * back, CENTER - 0.2 * back))
    material = np.array([0, 1], np.uint8)  # water before sand
    color = middle_color(stage, position, material)
    assert color[2] > color[0]
    np.testing.assert_array_equal(color, middle_color(stage, position[::-1], material[::-1]))
    assert middle_color(stage, position, material[::-1])[0] > color[0]


def test_obstacles_veil_only_what_lies_behind():
    """A sheet before a particle lets it shine through; one behind it changes nothing."""
    bare = middle_color(Stage(UNIT, (), 0.05, 100), CENTER, WATER)
    behind = middle_color(Stage(UNIT, (sheet_towards_the_eye(-0.2),), 0.05, 100), CENTER, WATER)
    before = middle_color(Stage(UNIT, (sheet_towards_the_eye(0.2),), 0.05, 100), CENTER, WATER)
    assert np.abs(behind - bare).max() <= 40  # it may still shade the particle
    saturation = np.array([np.ptp(color) for color in (bare, behind, before)])
    assert saturation[1] > 0.75 * saturation[0]
    assert 0.3 * saturation[0] < saturation[2] < 0.8 * saturation[0]


def test_particles_cast_a_shadow_along_the_light():
    """The floor is darker where the light through a particle meets it."""
    stage = Stage(UNIT, (), 0.04, 200)
    empty = np.asarray(stage.draw(np.empty((0, 3)), np.empty(0, np.uint8))).astype(np.int64)
    picture = np.asarray(stage.draw(CENTER, WATER)).astype(np.int64)
    fall = CENTER - LIGHT * CENTER[0, 1] / LIGHT[1]
    (x, y), *_ = stage.camera.project(fall)[0] / 2
    assert (empty - picture)[int(y), int(x)].min() > 10


def test_lost_particles_are_left_out():
    """NaN, infinite, far and too near particles change nothing, without a warning."""
    stage = Stage(UNIT, (), 0.01, 80)
    lost = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e30, -1e30, 0.5], stage.camera.eye], np.float32)
    empty = np.asarray(stage.draw(np.empty((0, 3)), np.empty(0, np.uint8)))
    np.testing.assert_array_equal(np.asarray(stage.draw(lost, np.zeros(4, np.uint8))), empty)


def test_particles_outside_the_domain_are_drawn():
    """A particle that left the box is seen as long as it is in the picture."""
    stage = Stage(UNIT, (), 0.02, 120)
    outside = np.array([[1.02, 0.5, 0.5], [0.5, -0.02, 0.99]])
    empty = np.asarray(stage.draw(np.empty((0, 3)), np.empty(0, np.uint8)))
    for position in outside:
        assert (np.asarray(stage.draw(position[None], WATER)) != empty).any()


def test_materials_can_be_told_apart():
    """The hues of the materials are far from each other and from the background."""
    colors = np.concatenate((MATERIAL_COLORS, [(1.0, 1.0, 1.0)]))
    for i in range(len(colors)):
        for j in range(i):
            assert np.abs(colors[i] - colors[j]).max() > 0.25
