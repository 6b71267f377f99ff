"""The software renderer: geometry that can be checked by hand, occlusion, and particles that ran away."""

import numpy as np
import pytest
import trimesh

from hgn.render import fragments as fragments_module
from hgn.render.flat import FlatStage
from hgn.render.fragments import fragments
from hgn.render.renderer import LIGHT, MATERIAL_COLORS, Camera, Stage, smooth_normals
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


def test_fragments():
    """The pixels under a right triangle are those whose centres it contains, and its weights give them back. A triangle
    beyond the picture fills it whole, with either winding; a degenerate one gives nothing."""
    corner = np.array([[[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]]])
    ((triangle, pixel, weight),) = fragments(corner, 5, 6)
    place = np.stack((pixel % 5, pixel // 5), axis=1)
    assert set(triangle) == {0}
    assert sorted(map(tuple, place.tolist())) == [(x, y) for x in range(4) for y in range(4) if x + y + 1 <= 4]
    np.testing.assert_allclose(weight.sum(axis=1), 1)
    np.testing.assert_allclose(weight @ corner[0], place + 0.5)
    large = np.array([[-50.0, -50.0], [200.0, -50.0], [-50.0, 200.0]])
    flat = np.array([[0.0, 0.0], [2.0, 2.0], [4.0, 4.0]])
    for corners in (large, large[::-1]):
        ((triangle, pixel, _),) = fragments(np.stack((corners, flat)), 7, 3)
        assert set(triangle) == {0} and sorted(pixel) == list(range(21))


def test_parts_of_the_obstacles(monkeypatch):
    """Obstacles look the same in whatever parts their pixels are drawn."""
    corner_C3 = np.random.default_rng(0).random((90, 3))
    obstacle = Obstacle("random", corner_C3, np.arange(90, dtype=np.int32).reshape(30, 3), closed=False)
    whole = Stage(UNIT, [obstacle], 0.01, 64)
    monkeypatch.setattr(fragments_module, "FRAGMENTS_AT_ONCE", 700)
    parts = Stage(UNIT, [obstacle], 0.01, 64)
    assert np.isfinite(whole.layer_depth_LP[-1]).any()
    for name in ("layer_depth_LP", "layer_shade_LP", "map_top", "empty_P3"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))


def test_smooth_normals():
    """A sphere's normals point outwards from its centre; a cube keeps the normals of its faces."""
    sphere, box = trimesh.creation.icosphere(subdivisions=3), trimesh.creation.box()
    corners = [mesh.vertices[mesh.faces] for mesh in (sphere, box)]
    round_F33, flat_F33 = (
        normal / np.linalg.norm(normal, axis=2, keepdims=True) for _, normal in map(smooth_normals, corners)
    )
    assert (round_F33 * corners[0]).sum(axis=2).min() > 0.999
    np.testing.assert_allclose(flat_F33, np.repeat(box.face_normals[:, None], 3, axis=1), atol=1e-9)


@pytest.mark.parametrize("domain_size", [UNIT, (4.0, 1.0, 2.0), (0.1, 0.3, 0.1)])
def test_camera_fits_the_domain(domain_size):
    """All corners of the domain lie inside the picture, which they nearly fill; up is up."""
    camera = Camera(domain_size, 200)
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * np.array(domain_size)
    xy, _ = camera.project(corner)
    assert (xy >= 0).all() and (xy <= (camera.width, camera.height)).all()
    assert np.ptp(xy[:, 0]) > 0.95 * camera.width
    assert (xy[2::4, 1] < xy[0::4, 1]).all()


@pytest.mark.parametrize("stage_type", [Stage, FlatStage])
def test_tall_domains(stage_type):
    """A picture is at most four times as high as wide; a taller domain lies in its middle."""
    stage = stage_type((1.0, 1e9, 1.0), (), 1e6, 64)
    assert stage.size[0] == 64 and stage.size[1] <= 4 * 64
    xy, _ = stage.camera.project(np.array([[0, 0, 0], [1, 1e9, 0], [0.0, 1e9, 1.0]]))
    np.testing.assert_allclose(xy[:, 0], 64, atol=1)
    assert np.ptp(xy[:, 1]) > 0.95 * stage.camera.height and (xy[:, 1] <= stage.camera.height).all()


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


def test_particles_outside_the_domain():
    """Near the box a particle is seen as long as it is in the picture; NaN, infinite, far and too near ones change
    nothing, without a warning."""
    stage = Stage(UNIT, (), 0.02, 120)
    empty = np.asarray(stage.draw(np.empty((0, 3)), np.empty(0, np.uint8)))
    for outside in ([1.02, 0.5, 0.5], [0.5, -0.02, 0.99]):
        assert (np.asarray(stage.draw(np.array([outside]), WATER)) != empty).any()
    lost = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e30, -1e30, 0.5], stage.camera.eye], np.float32)
    np.testing.assert_array_equal(np.asarray(stage.draw(lost, np.zeros(4, np.uint8))), empty)


def test_materials_can_be_told_apart():
    """The hues of the materials are far from each other and from the background."""
    colors = np.concatenate((MATERIAL_COLORS, [(1.0, 1.0, 1.0)]))
    difference = np.abs(colors[:, None] - colors[None]).max(axis=-1) + np.eye(len(colors))
    assert difference.min() > 0.25
