"""Shapes of obstacles by closed forms, and rotations."""

import json

import numpy as np
import pytest
import trimesh

from hgn.config import OBSTACLE_SHAPES
from hgn.scene.rotation import euler_rotation, quaternion_product, quaternion_rotation
from hgn.scene.scene_file import load_scene
from hgn.scene.scene_notes import notes_on_files
from hgn.scene.shapes import CLOSED_SHAPES, shape_obstacle, unit_shape
from hgn.scene.surface import split_long_edges
from hgn.schema import ConfigError

BOXES = {"half_box": (1, 0.5, 1), "square": (1, 0, 1), "half_sphere": (1, 0.5, 1)}  # edges; others are as wide as high
VOLUMES = {"cone": np.pi / 12, "pyramid": 1 / 3}


@pytest.mark.parametrize("shape", OBSTACLE_SHAPES)
def test_shapes_are_what_they_are_called(shape):
    """The bounding box has the stated edges and its middle at the position. Cone and pyramid are watertight, outward
    and of the right volume; the others have a boundary, and bowls open towards y: near the axis they have no lid.
    Turned vertices are float32 numbers, so that they agree bitwise between machines."""
    obstacle = shape_obstacle(shape, 0.3, (0.5, 0.25, 0.75))
    low, high = obstacle.vertex_V3.min(axis=0), obstacle.vertex_V3.max(axis=0)
    np.testing.assert_allclose(high - low, 0.3 * np.array(BOXES.get(shape, (1, 1, 1))), atol=1e-6)
    np.testing.assert_allclose((high + low) / 2, (0.5, 0.25, 0.75), atol=1e-6)
    vertex, triangle, _ = unit_shape(shape)
    mesh = trimesh.Trimesh(vertex, triangle, process=False)
    assert 2 <= len(obstacle.triangle_F3) <= 400 and mesh.is_winding_consistent
    assert obstacle.closed == mesh.is_watertight == (shape in VOLUMES) == (shape in CLOSED_SHAPES)
    assert shape not in VOLUMES or mesh.volume == pytest.approx(VOLUMES[shape], rel=0.01)
    if shape in ("half_box", "half_sphere"):
        centroid = split_long_edges(vertex[triangle], 0.1).mean(axis=1)
        height = centroid[np.hypot(centroid[:, 0], centroid[:, 2]) < 0.2, 1]
        assert len(height) and (height < 0).all()
    turned = shape_obstacle(shape, 0.123, (0.4, 0.5, 0.6), euler_rotation((10.0, 20.0, 30.0))).vertex_V3
    assert (turned.astype(np.float32).astype(np.float64) == turned).all()


def test_rotations():
    """Euler angles turn about fixed axes: (90, 90, 0) takes +y to +z by x, then +z to +x by y; quarter turns are exact.
    Products of quaternions turn by the right one first and have length 1. All matrices are rotations."""
    assert (euler_rotation((90.0, 90.0, 0.0)) @ [0.0, 1.0, 0.0]).tolist() == [1.0, 0.0, 0.0]
    assert set(np.abs(euler_rotation((-90.0, 450.0, 180.0))).ravel()) == {0.0, 1.0}
    turned = euler_rotation((0.0, 0.0, 30.0)) @ [1.0, 0.0, 0.0]
    np.testing.assert_allclose(turned, [np.sqrt(3) / 2, 0.5, 0.0], atol=1e-15)
    left, right = (0.5, -0.5, 0.1, 0.7), (0.6, 0.0, 0.8, 0.0)
    both, product = quaternion_product(left, right), quaternion_rotation(left) @ quaternion_rotation(right)
    np.testing.assert_allclose(quaternion_rotation(both), product, atol=1e-15)
    assert sum(value * value for value in both) == pytest.approx(1.0)
    for matrix in (euler_rotation((12.0, -77.0, 203.0)), quaternion_rotation(left)):
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(matrix) == pytest.approx(1.0)


def through(*poses):
    return {"keyframes": [{"time": time, **pose} for time, pose in enumerate(poses)]}


AROUND, OUTSIDE = "no surface in the domain: ", "outside the domain, out of reach of particles: "
ASIDE, TURN = {"position": [5, 0.5, 0.5]}, through({"rotation": [0, 0, -30]}, {"rotation": [0, 0, 120]})
ARM = {"shape": None, "size": None, "position": None, "mesh": "arm.obj"}


@pytest.mark.parametrize(
    ("changes", "notes"),
    [
        ({}, []),
        ({"size": 300}, [AROUND + "obstacle_0_half_box (x -150 to 150, y -74.5 to 75.5, "]),
        ({"size": 1e-3}, ["smaller than a cell of 0.0156: obstacle_0_half_box"]),
        (ASIDE, [OUTSIDE + "obstacle_0_half_box (x 4.85 to 5.15, "]),
        (ASIDE | through({"translation": [0, 1, 0]}), [OUTSIDE]),
        (ASIDE | through({}, {"translation": [0, 1, 0]}), [OUTSIDE]),
        (ASIDE | through({}, {"translation": [-4.5, 0, 0]}), []),
        (ASIDE | through({}, {"translation": [-10, 0, 0]}), []),  # through the domain, between two keyframes
        (ASIDE | through({"translation": [-10, 0, 0]}, {}), []),
        (ARM | {"scale": 0.9} | TURN, []),  # from below the domain to its left, through a corner
        (ARM | {"scale": 1.9} | TURN, [OUTSIDE + "arm.obj"]),
    ],
)
def test_obstacles_that_reach_no_particle(tmp_path, changes, notes):
    """Shapes around or outside the domain or smaller than a cell are noted, and bodies that stay outside in motion."""
    arm = trimesh.creation.box(bounds=((0.98, -0.02, 0.48), (1, 0.02, 0.52)))
    arm.export(tmp_path / "arm.obj")
    obstacle = {"shape": "half_box", "size": 0.3, "position": [0.5, 0.5, 0.5], **changes}
    entry = {key: value for key, value in obstacle.items() if value is not None}
    group = {"shape": "cube", "size": 0.05, "position": [0.2, 0.8, 0.2], "material": "water"}
    (tmp_path / "a.yaml").write_text(json.dumps({"groups": [group], "obstacles": [entry]}))
    seen = notes_on_files(load_scene(tmp_path / "a.yaml"))
    assert [text.startswith(note) for text, note in zip(seen, notes, strict=True)] == [True] * len(notes)


@pytest.mark.parametrize(("size", "named"), [(0.8, False), (300.0, True)])
def test_meshes_in_millimetres_around_the_particles(tmp_path, size, named):
    """The remedy names the scale of a mesh larger than the domain, also if a side of the mesh lies in the domain."""
    trimesh.creation.box((size,) * 3).export(tmp_path / "rock.stl")
    cube = "{shape: cube, size: 0.2, position: [0.5, 0.5, 0.5], material: water}"
    rock = f"{{mesh: rock.stl, position: [0.5, {0.1 + size / 2}, 0.5]}}"
    (tmp_path / "scene.yaml").write_text(f"groups: [{cube}]\nobstacles: [{rock}]\n")
    with pytest.raises(ConfigError, match=r"got .* particles inside rock .*; move or shrink") as caught:
        load_scene(tmp_path / "scene.yaml")
    assert ("or its scale (a file in millimetres needs scale: 0.001)" in str(caught.value)) == named
