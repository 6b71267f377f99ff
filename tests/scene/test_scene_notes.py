"""Warnings about the files of scenes."""

import re
import tracemalloc

import numpy as np
import pytest
import trimesh
from scene.test_scene_file import ONE_CUBE, load, write

from hgn.scene.motion import Motion
from hgn.scene.rotation import euler_rotations
from hgn.scene.scene_file import load_scene
from hgn.scene.scene_notes import notes_on_files
from hgn.schema import ConfigError


@pytest.mark.parametrize(
    ("scale", "note"), [(1000, "no surface in the domain"), (1, None), (1e-3, "smaller than a cell")]
)
def test_units_of_a_bowl(tmp_path, scale, note):
    """A sheet around the whole domain, as a bowl in millimetres, is noted, and the scale that helps."""
    bowl = trimesh.creation.icosphere(subdivisions=2)
    bowl.update_faces(bowl.triangles_center[:, 1] < 0.5)
    bowl.apply_scale(0.3 * scale)
    bowl.export(tmp_path / "bowl.obj")
    text = ONE_CUBE + "obstacles: [{mesh: bowl.obj, position: [0.5, 0.4, 0.5]}]\n"
    notes = notes_on_files(load_scene(write(tmp_path, text)))
    assert len(notes) == 1 + (note is not None) and (note is None or note in notes[1])


def test_groups_in_one_place_are_noted(tmp_path):
    """Each group that overlaps an earlier one by a part of the smaller one's particles; contact is no overlap."""
    cube = {"shape": "cube", "size": 0.1, "material": "sand"}
    ball = {"shape": "sphere", "size": 0.3, "material": "snow", "position": [0.7, 0.3, 0.5]}
    places = ([0.25, 0.25, 0.5], [0.35, 0.25, 0.5], [0.25, 0.3, 0.5], [0.7, 0.3, 0.5])
    groups = [*(cube | {"position": place} for place in places), ball]
    half, inside = notes_on_files(load(tmp_path, groups=groups))
    found = re.fullmatch(r"groups\[2\] \(cube of sand\) overlaps groups\[0\] \(cube of sand\): (\d+)% of the .*", half)
    assert found is not None and 40 < int(found[1]) < 60
    assert inside.startswith("groups[4] (sphere of snow) overlaps groups[3] (cube of sand): 100% of the smaller one")


def test_entries_without_effect_are_noted(tmp_path):
    """Constants of another material, and emitters that start after the last frame."""
    constants = {"sand_friction_angle_deg": 30, "youngs_modulus_pa": 1e4}
    cube = {"shape": "cube", "size": 0.1}
    groups = [cube | {"material": name, "position": [x, 0.5, 0.5]} for name, x in (("sand", 0.5), ("snow", 0.2))]
    emitter = {"shape": "disc", "size": 0.1, "position": [0.5, 0.8, 0.5], "velocity": [0, -1, 0], "material": "water"}
    emitters = [emitter | {"start": 0.4, "stop": 1}, emitter | {"start": 0.6, "stop": 1, "snow_hardening": 5}]
    scene = load(tmp_path, groups=[group | constants for group in groups], emitters=emitters)
    constants = [
        "no effect: sand_friction_angle_deg of groups[1], which is snow",
        "no effect: snow_hardening of emitters[1], which is water",
    ]
    assert notes_on_files(scene) == constants
    assert notes_on_files(scene, 0.5) == [*constants, "no effect: emitters[1], because it starts after the last frame"]


@pytest.mark.parametrize("inside", [0, 1, 7])
def test_stored_particles_inside_an_obstacle(tmp_path, inside):
    """They are noted with their number, for obstacles of any kind; an empty file is refused."""
    position_N3 = np.full((20, 3), 0.8, np.float32)
    position_N3[:inside] = (0.5, 0.3, 0.5)
    np.savez(tmp_path / "stored.npz", position=position_N3)
    trimesh.creation.box(extents=(0.3, 0.3, 0.3)).export(tmp_path / "box.ply")
    told = [f"{inside} of 20 particles of stored.npz"] * (inside > 0)
    for kind in ({"shape": "cone", "size": 0.3}, {"mesh": "box.ply"}):
        obstacles = [kind | {"position": [0.5, 0.3, 0.5]}]
        scene = load(tmp_path, groups=[{"particles": "stored.npz", "material": "sand"}], obstacles=obstacles)
        assert [note.partition(" lie")[0] for note in notes_on_files(scene)] == told
    np.savez(tmp_path / "stored.npz", position=position_N3[:0])
    with pytest.raises(ConfigError, match="position must be of at least one particle"):
        load_scene(tmp_path / "scene.yaml")


def test_the_fastest_of_many_points_in_many_turns():
    """The speed is the largest between keyframes. Motions of all points together took 11 GB for a file of 1.5 MB."""
    generator = np.random.default_rng(0)
    rotation_T33 = euler_rotations([(0, 120 * turn, turn) for turn in range(500)])
    place_T3, point_P3 = generator.random((500, 3)), generator.random((20_000, 3))
    motion = Motion(np.cumsum(generator.uniform(0.1, 1, 500)), place_T3, rotation_T33, (0.5, 0.2, 0.3))
    place_TP3 = np.stack([motion.place(point_P3[:100], time) for time in motion.time_T])
    speed_TP = np.linalg.norm(np.diff(place_TP3, axis=0), axis=2) / np.diff(motion.time_T)[:, None]
    assert motion.fastest(point_P3[:100]) == pytest.approx(speed_TP.max())
    assert motion.fastest(point_P3[:0]) == 0  # an obstacle without vertices
    tracemalloc.start()
    try:
        motion.fastest(point_P3)
        assert tracemalloc.get_traced_memory()[1] < 100 << 20
    finally:
        tracemalloc.stop()
