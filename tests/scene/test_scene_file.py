"""Scene files: what is read, and one table of what is refused."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

from hgn.scene.material import SAND, SNOW, WATER
from hgn.scene.rotation import euler_rotation
from hgn.scene.scene_file import load_scene
from hgn.scene.scene_notes import notes_on_files
from hgn.schema import ConfigError

EXAMPLES = Path(__file__).resolve().parents[2] / "conf" / "example"
CUBE = {"shape": "cube", "size": 0.08, "position": [0.5, 0.5, 0.5], "material": "water"}
CONE = {"shape": "cone", "size": 0.2, "position": [0.5, 0.2, 0.5]}


def write(folder, content):
    """A scene file of a mapping, a text or bytes."""
    path = folder / "scene.yaml"
    text = content if isinstance(content, str | bytes) else yaml.safe_dump(content)
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def load(folder, **mapping):
    return load_scene(write(folder, {"groups": [CUBE]} | mapping))


@pytest.mark.parametrize("name", ["funnel.yaml", "own_mesh.yaml"])
def test_examples_load_and_are_deterministic(name):
    """The example scenes load, twice the same, with a JSON-able specification."""
    scene, again = load_scene(EXAMPLES / name), load_scene(EXAMPLES / name)
    assert scene.particle_count > 2000
    assert len(scene.obstacles) >= 2
    assert scene.position_N3.tobytes() == again.position_N3.tobytes()
    assert json.loads(json.dumps(scene.specification)) == scene.specification
    assert sum(scene.specification["particle_counts"]) == scene.particle_count


def test_example_mesh_is_closed_and_found_beside_the_scene_file(tmp_path):
    """Mesh paths are relative to the scene file, wherever that is."""
    for name in ("own_mesh.yaml", "ramp.obj"):
        shutil.copy(EXAMPLES / name, tmp_path / name)
    ramp = load_scene(tmp_path / "own_mesh.yaml").obstacles[0]
    assert ramp.closed
    np.testing.assert_allclose(ramp.vertex_V3.min(axis=0), [0.3, 0.05, 0.3], atol=1e-6)
    np.testing.assert_allclose(ramp.vertex_V3.max(axis=0), [0.7, 0.45, 0.7], atol=1e-6)


def test_groups_become_particles(tmp_path):
    """Counts, places, materials, velocities and the scene's numbers are those of the file."""
    mapping = {
        "domain_size": [2, 1, 1],
        "cell_size": 0.03125,
        "gravity": [0, -1.5, 0],
        "particles_per_cell": 4,
        "seed": 9,
        "groups": [
            {**CUBE, "size": 0.25, "velocity": [1, 2, 3]},
            {"shape": "sphere", "size": 0.2, "position": [1.5, 0.5, 0.5], "material": "sand"},
            {"shape": "box", "size": [0.5, 0.125, 0.25], "position": [1.0, 0.8, 0.5], "material": "snow"},
        ],
    }
    scene = load(tmp_path, **mapping)
    assert (scene.domain_size, scene.cell_size, scene.gravity) == ((2.0, 1.0, 1.0), 0.03125, (0.0, -1.5, 0.0))
    assert scene.seed == 9
    counts = [4 * 512 + 1, int(np.ceil(4 * np.pi / 6 * 0.2**3 * 32**3)), 4 * 512 + 1]
    assert scene.specification["particle_counts"] == counts
    assert np.bincount(scene.material_N).tolist() == [counts[WATER], counts[SAND], counts[SNOW]]
    assert (scene.velocity_N3[: counts[0]] == [1, 2, 3]).all()
    assert not scene.velocity_N3[counts[0] :].any()
    parts = np.split(scene.position_N3.astype(float), np.cumsum(counts)[:-1])
    assert np.abs(parts[0] - 0.5).max() <= 0.125 + 1e-6
    assert np.linalg.norm(parts[1] - [1.5, 0.5, 0.5], axis=1).max() <= 0.1 + 1e-6
    assert (np.abs(parts[2] - [1.0, 0.8, 0.5]).max(axis=0) <= np.array([0.25, 0.0625, 0.125]) + 1e-6).all()


def test_friction_of_each_surface(tmp_path):
    """Walls, floor and each obstacle have their own friction, kept in the specification; by default none."""
    scene = load(tmp_path, floor_friction=0.5, wall_friction=0.1, obstacles=[CONE, {**CONE, "friction": 0.3}])
    assert scene.wall_friction == (0.1, 0.5, 0.1)
    assert [obstacle.friction for obstacle in scene.obstacles] == [0.0, 0.3]
    assert scene.specification["floor_friction"] == 0.5
    assert scene.specification["obstacles"][1]["friction"] == 0.3


def test_keyframes_are_poses_about_the_position(tmp_path):
    """An obstacle with keyframes moves from where its entry places it, turned about its position."""
    keyframes = [{"time": 0}, {"time": 2, "translation": [0.1, 0, 0], "rotation": [0, 90, 0]}]
    scene = load(tmp_path, obstacles=[{**CONE, "keyframes": keyframes}])
    (cone,) = scene.obstacles
    assert scene.moves and cone.motion is not None
    assert np.allclose(cone.motion.place(cone.vertex_V3, 0.0), cone.vertex_V3)
    middle = cone.motion.place(np.array([CONE["position"]]), 1.0)
    assert np.allclose(middle, [[0.55, 0.2, 0.5]])
    assert np.allclose(cone.motion.place(np.array([[0.6, 0.2, 0.5]]), 2.0), [[0.6, 0.2, 0.4]])


@pytest.mark.parametrize("axis", range(3))
def test_obstacles_turn_as_far_as_written(tmp_path, axis):
    """Keyframes half a turn or more apart turn the obstacle at a constant rate about the axis whose angle differs."""
    begin = np.array([10.0, 20.0, 30.0])
    for degrees in (-1080, -190, -180, 170, 180, 190, 360, 720):
        end = begin + degrees * np.eye(3)[axis]
        keyframes = [{"time": 1, "rotation": begin.tolist()}, {"time": 3, "rotation": end.tolist()}]
        (cone,) = load(tmp_path, obstacles=[{**CONE, "keyframes": keyframes}]).obstacles
        assert cone.motion is not None and np.ptp(cone.motion.rotation_T33, axis=0).any()
        for fraction in (0, 0.1, 0.5, 0.9, 1):
            expected_33 = euler_rotation(tuple(begin + fraction * (end - begin)))
            np.testing.assert_allclose(cone.motion.pose(1 + 2 * fraction)[0], expected_33, atol=1e-12)


@pytest.mark.parametrize(
    ("rotations", "message"),
    [
        ([(9, 0, 0), (0, 0, 0), (180, 1, 0)], r"or different in one angle, got \[\[0.0, 0.0, 0.0\], \[180.0, 1"),
        ([], r"keyframes must be at least one, got \[\]; leave them out for an obstacle at rest"),
        ([(0, 0, 0), (4e5, 0, 0)], "keyframes must be of at most 1000 turns together, got 1111.1"),
        ([(-1e15, 0, 0), (1e15, 0, 0)], "keyframes must be of at most 1000 turns together, got 5.5"),
    ],
)
def test_refused_keyframes(tmp_path, rotations, message):
    """Large turns without one axis, too many turns, and no keyframes."""
    keyframes = [{"time": time, "rotation": list(degrees)} for time, degrees in enumerate(rotations)]
    with pytest.raises(ConfigError, match=message):
        load(tmp_path, obstacles=[{**CONE, "keyframes": keyframes}])


def test_moving_obstacles_begin_at_their_first_pose(tmp_path):
    """Groups are clear of obstacles where these are in frame 0, which may be another place than the entry's; a mesh in
    millimetres around the domain is reported if it moves, too."""
    away = [{"time": 0, "translation": [5, 0, 0]}, {"time": 1, "translation": [5.1, 0, 0]}]
    with pytest.raises(ConfigError, match="must be clear of closed obstacles, got 1074 of 1074 particles inside"):
        load(tmp_path, obstacles=[{**CONE, "size": 0.8, "position": [-4.5, 0.6, 0.5], "keyframes": away}])
    load(tmp_path, obstacles=[{**CONE, "size": 0.8, "position": [0.5, 0.6, 0.5], "keyframes": away}])
    sphere = trimesh.creation.icosphere(radius=500)
    trimesh.Trimesh(sphere.vertices, sphere.faces[:-1], process=False).export(tmp_path / "a.obj")
    keyframes = [{"time": 0}, {"time": 1, "translation": [0.1, 0, 0]}]
    notes = notes_on_files(load(tmp_path, obstacles=[{"mesh": "a.obj", "keyframes": keyframes}]))
    assert any("no surface in the domain: a.obj" in note for note in notes)


def test_editing_one_group_leaves_the_others(tmp_path):
    """Each group has a random stream of its own."""
    other = {**CUBE, "position": [0.2, 0.5, 0.5]}
    before, after = load(tmp_path, groups=[CUBE, other]), load(tmp_path, groups=[{**CUBE, "size": 0.1}, other])
    assert before.position_N3[-1074:].tobytes() == after.position_N3[-1074:].tobytes()
    assert before.position_N3[:1074].tobytes() != before.position_N3[1074:].tobytes()


def test_shapes_are_placed_and_turned(tmp_path):
    """A square turned by 90 degrees about x stands upright at its position."""
    square = {"shape": "square", "size": 0.2, "position": [0.5, 0.3, 0.6], "rotation": [90, 0, 0]}
    (obstacle,) = load(tmp_path, obstacles=[square]).obstacles
    np.testing.assert_allclose(obstacle.vertex_V3.min(axis=0), [0.4, 0.2, 0.6], atol=1e-6)
    np.testing.assert_allclose(obstacle.vertex_V3.max(axis=0), [0.6, 0.4, 0.6], atol=1e-6)


WALL, HALF = 3 / 64, 0.04  # the solver's walls are 3 cells thick


def test_where_groups_may_be(tmp_path):
    """A cube on the inner face of the walls is accepted, and one inside a bowl, which is a sheet."""
    load(tmp_path, groups=[{**CUBE, "position": [WALL + HALF, 1 - WALL - HALF, 0.5]}])
    bowl = {"shape": "half_sphere", "size": 0.4, "position": [0.5, 0.5, 0.5]}
    assert load(tmp_path, obstacles=[bowl]).particle_count == 1074


def scene_with(**changes):
    return {"groups": [CUBE], **changes}


def group_with(**changes):
    return {"groups": [{**CUBE, **changes}]}


DISC = {"shape": "disc", "size": 0.1, "position": [0.5, 0.8, 0.5], "material": "water"}
DISC |= {"velocity": [0, -1, 0], "stop": 1}


def emitter_with(**changes):
    return {"emitters": [{**DISC, **changes}]}


def obstacle_with(**changes):
    entry = {key: value for key, value in {**CONE, **changes}.items() if value is not None}
    return {"groups": [CUBE], "obstacles": [entry]}


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join(9 * [f'*{before}'])}]\n"
    for before, name in zip("abcdefghi", "bcdefghij", strict=True)
)
GROUP, EMITTER, OBSTACLE = r"groups\[0\]", r"emitters\[0\]", r"obstacles\[0\]"
BETWEEN_WALLS = r" \((cube|disc) of water\) must lie between the walls"
MESH = {"shape": None, "size": None, "mesh": "a.obj"}
INSIDE = {"groups": [CUBE, {**CUBE, "position": [0.5, 0.25, 0.5]}], "obstacles": [CONE]}
YAML, ALIASES = "must be a YAML file", "it has more than 100000 values; an alias counts as all of its values"
ONE_CUBE = "groups:\n  - {shape: cube, size: 0.05, position: [0.5, 0.8, 0.5], material: water}\n"
MISTAKES = [
    ("groups: [", YAML),
    (ONE_CUBE + " seed: 1\n", "line 3, column 2: expected <block end>, .*; check the indentation"),
    (b"\xff\xfe\xfa", YAML + ": it is not UTF-8 text"),
    (b"PK\x03\x04\xff", YAML + ": it is a zip file; unpack it, and give the YAML file in it"),
    ("groups: " + 1000 * "[", YAML),
    *(
        (
            text.replace("N", number),
            rf"{YAML}: line 1: .*: {number[:9]}.* is a number of {len(number)} characters; at mo",
        )
        for number in (5000 * "9", "0x" + 5000 * "f", "-0b" + 20_000 * "1")
        for text in ("cell_size: N", "N", "gravity: [N, 0]", "? N\n: 1", "- {a: {? N : 0}}", "{? [N] : 1}")
    ),
    ("cell_size: " + 400 * "9", "cell_size must be a number of at most 63 bits, got 1329"),
    (BOMB, ALIASES),
    ("groups: &a [*a]", ALIASES),
    ("groups: [&a [" + 400 * "1," + "]" + 250 * ",*a" + "]", ALIASES),
    (ONE_CUBE + "seed: 1\n" + ONE_CUBE, r"line 4: the key groups is given twice, first in line 1"),
    (ONE_CUBE.replace("size: 0.05", "size: 0.05, size: 0.1"), "line 2: the key size is given twice, first in line 2"),
    ("\ufeff" + ONE_CUBE.replace("\n", "\r\n") + "seed: 1\r\nseed: 2\r\n", "line 4: the key seed is given twice"),
    ("gravity: [0, 0, 0]\n'gravity': [0, -9.8, 0]\n" + ONE_CUBE, "line 2: the key gravity is given twice"),
    *(
        (ONE_CUBE + f"{one}: 1\n{other}: 1\n", f"line 4: the key {other} is given twice, first in line 3")
        for one, other in (("~", "null"), ("1", "0x1"), ("yes", "true"), ("1e1", "10"), ("0", "-0"), (".nan", ".NaN"))
    ),
    (ONE_CUBE + "<<: {seed: 1}\n!!merge x: {seed: 2}\n", "line 4: the key x is given twice, first in line 3"),
    (ONE_CUBE + "seed: 010\n", "line 3: seed: 010 is an octal number in YAML; write 10, or 8"),
    (ONE_CUBE + "seed: 007\n", "line 3: seed: 007 is an octal number in YAML; write 7$"),
    (ONE_CUBE + "seed: -00_17\n", "line 3: seed: -00_17 is an octal number in YAML; write -17, or -15"),
    (ONE_CUBE + "gravity:\n- 0\n- -9:30\n- 0\n", "line 5: gravity: -9:30 is a number of base 60 in YAML"),
    (ONE_CUBE + "cell_size: 1:0.5\n", "line 3: cell_size: 1:0.5 is a number of base 60"),
    (ONE_CUBE.replace("0.8", "1:48"), "line 2: position: 1:48 is a number of base 60"),
    *(
        (ONE_CUBE + f"seed: {word}\n", f"line 3: seed: {word} is a number with _; write it without")
        for word in ("1_0", "0x1_0", "1_0.5")
    ),
    (ONE_CUBE.replace("0.05", "0.05, 0.1, 0.2"), r"groups\[0\]\.0\.1 is not a known key; a list needs brackets"),
    (None, "the file must be a mapping"),
    ({}, "groups must be a list with at least one group, or emitters"),
    *(
        (emitter_with(size=1e-200, velocity=[x, x, 0]), EMITTER + r"\.velocity must be of length 1e-15 to 1e15, got")
        for x in (0, 1e-200)
    ),
    (emitter_with(stop=0), EMITTER + r"\.stop must be later than start \(0\), got 0"),
    (emitter_with(start=-1), EMITTER + r"\.start must be a finite number >= 0"),
    (emitter_with(shape="cube"), EMITTER + r"\.shape must be one of disc, rectangle, got 'cube'"),
    (emitter_with(shape="rectangle"), EMITTER + r"\.size must be a list of two edges for a rectangle"),
    (emitter_with(size=-1), EMITTER + r"\.size must be finite and > 0, got -1"),
    (emitter_with(material="lava"), EMITTER + r"\.material must be one of water, .*, got 'lava'"),
    (emitter_with(water_tension=2.0), EMITTER + ".*water_tension must be at most 1, got 2"),
    (emitter_with(position=[0.5, 0.99, 0.5]), EMITTER + BETWEEN_WALLS),
    (
        emitter_with(position=[0.5, 0.22, 0.5]) | {"obstacles": [CONE]},
        EMITTER + r" \(disc of water\) must be clear of closed .* inside obstacle_0_cone .*y .* to .*; obstacle: x 0",
    ),
    (scene_with(gruops=1), "gruops is not a known key; did you mean groups"),
    (scene_with(cell_size=0), "cell_size must be a finite number > 0"),
    (scene_with(cell_size=float("nan")), "cell_size must be a finite number > 0, got nan"),
    (scene_with(particles_per_cell=-1), "particles_per_cell must be a finite number > 0"),
    (scene_with(particles_per_cell=1e9), "groups must be at most 10000000 particles"),
    (scene_with(cell_size=1e9), r"domain_size \(x\) must be a whole number of cells of 1e\+09, got .*; for example 1e"),
    (scene_with(cell_size=3000.0), r"domain_size \(x\) must be a whole number of cells of 3000, got .*example 3000"),
    (scene_with(cell_size=1e-20), "domain_size must be at most 2147483647 cells of 1e-20"),
    (group_with(size=1e300), "groups must be at most 10000000 particles together, .* got inf"),
    (obstacle_with(size=1e300), OBSTACLE + r".size must be from 1e-30 to 1e30, the range of fp32, got 1e\+300"),
    (obstacle_with(position=[0, 1e300, 0]), OBSTACLE + r".position\[1\] must be at most 1e15 in size, got 1e\+300"),
    (scene_with(domain_size=[1, -1, 1]), r"domain_size\[1\] must be from 1e-9 to 1e9, got -1"),
    (scene_with(domain_size=[1, 1e12, 1]), r"domain_size\[1\] must be from 1e-9 to 1e9, got 1000000000000.0"),
    (
        scene_with(domain_size=[1e6, 1e6, 1e6]),
        r"domain_size must be at most 2147483647 cells of 0.015625, got \[1000000.0, .*; lower it or raise cell_size",
    ),
    (scene_with(domain_size=[20, 20, 21]), "domain_size must be at most 2147483647 cells"),
    (scene_with(domain_size=[1, 1]), "domain_size must be a list of 3 values"),
    (scene_with(domain_size=[0.125, 1, 1]), GROUP + BETWEEN_WALLS),
    (scene_with(gravity=[0, float("inf"), 0]), r"gravity\[1\] must be finite, got inf"),
    (scene_with(floor_friction=-0.1), "floor_friction must be a finite number >= 0, got -0.1"),
    (scene_with(wall_friction=float("nan")), "wall_friction must be a finite number >= 0, got nan"),
    (scene_with(wall_friction=1e39), "wall_friction must be at most 1e30, the range of fp32, got 1e.39"),
    *(
        (group_with(density_kg_m3=value), GROUP + r"\.density_kg_m3 must be from 1e-30 to 1e30, the range of fp32")
        for value in (1e39, 1e-300)  # denormal numbers are 0 where a library flushes them
    ),
    (obstacle_with(keyframes=[{"time": 1}, {"time": 1}]), OBSTACLE + r"\.keyframes must be in order of time"),
    (obstacle_with(keyframes=[{"time": 0}, {"time": 5e-324}]), r"keyframes must be in order of time.* 1e-09 s apart"),
    (obstacle_with(keyframes=[{"time": -1}]), OBSTACLE + r"\.keyframes\[0\]\.time must be .* >= 0"),
    (obstacle_with(keyframes=[{"time": 0, "rotation": [0, float("inf"), 0]}]), r"\.rotation\[1\] must be finite"),
    *(
        (obstacle_with(keyframes=[{"time": 0, "translation": [0, far, 0]}]), "translation must be at most 1000 domain")
        for far in (1001.0, -1e12)
    ),
    (obstacle_with(friction=-1), OBSTACLE + r"\.friction must be a finite number >= 0, got -1"),
    (scene_with(seed=-1), "seed must be a whole number >= 0"),
    (scene_with(seed=0.5), "seed must be a whole number"),
    (
        group_with(material="snoww"),
        GROUP + r"\.material must be one of water, sand, snow, elastic, got 'snoww'; did you mean snow\?",
    ),
    (group_with(shape="torus"), GROUP + r"\.shape must be one of cube, sphere, box"),
    (group_with(size=0), GROUP + r"\.size must be finite and > 0"),
    (group_with(size=float("nan")), GROUP + r"\.size must be finite and > 0"),
    (group_with(size=[0.1, 0.1, 0.1]), GROUP + r"\.size must be one number for a cube"),
    (group_with(shape="box"), GROUP + r"\.size must be a list of three edges for a box"),
    (group_with(shape="box", size=[0.1, -0.1, 0.1]), GROUP + r"\.size must be finite and > 0"),
    (group_with(position=[0.5, float("nan"), 0.5]), GROUP + r"\.position\[1\] must be finite, got nan"),
    (group_with(velocity=[0, float("inf"), 0]), GROUP + r"\.velocity\[1\] must be finite"),
    (group_with(position=[5, 0.5, 0.5]), "got 1074 of 1074 particles outside; move or shrink it"),
    (group_with(position=[WALL + HALF - 1 / 64, 0.5, 0.5]), GROUP + BETWEEN_WALLS),
    (group_with(density_kg_m3=-1.0), GROUP + ".*density_kg_m3 must be"),
    (
        INSIDE,
        r"groups\[1\] \(cube of water\) must be clear of closed .* of 1074 particles inside obstacle_0_cone .*e: x",
    ),
    (obstacle_with(shape="sphere"), OBSTACLE + r"\.shape must be one of half_box"),
    (obstacle_with(shape=None), OBSTACLE + r"\.mesh or shape must be given, .* got neither"),
    (obstacle_with(mesh="a.obj"), OBSTACLE + r"\.mesh or shape must be given, .* got both"),
    (obstacle_with(size=None), OBSTACLE + r"\.size must be given with shape"),
    (obstacle_with(size=-1), OBSTACLE + r"\.size must be a finite number > 0"),
    (obstacle_with(position=None), OBSTACLE + r"\.position must be given with shape"),
    (obstacle_with(position=[0, 0, float("nan")]), OBSTACLE + r"\.position\[2\] must be finite"),
    (obstacle_with(rotation=[0, 0, float("nan")]), OBSTACLE + r"\.rotation\[2\] must be finite"),
    (obstacle_with(scale=2), OBSTACLE + r"\.scale must be left out with shape"),
    (obstacle_with(shape=None, mesh="a.obj"), OBSTACLE + r"\.size must be left out with mesh"),
    (obstacle_with(scale=0, **MESH), OBSTACLE + r"\.scale must be a finite"),
    (obstacle_with(**MESH), OBSTACLE + r"\.mesh must be an existing file"),
    (group_with(size="wide"), "size must be a number or a list of 3 values or null, got 'wide'$"),
    *((group_with(size=size), r"0\]\.size\S* must .*; write it without quotes$") for size in ("0.1", [".1", 0.1, 0.1])),
    *((group_with(size=a), "size.* write it with a decimal point$") for a in ("0,1", ",5", "-1,5e-3", ["0,1", 1, 1])),
    (group_with(position=["+5", 0, 0]), r"n\[0\] must be a number, got '\+5' \(str\); write it without quotes$"),
    (scene_with(seed="-5"), r"seed must be a whole number, got '-5' \(str\); write it without quotes$"),
]


@pytest.mark.parametrize(("content", "message"), MISTAKES, ids=range(len(MISTAKES)))
def test_every_mistake_is_named(tmp_path, content, message):
    """Each mistake in a scene file ends in one short error: the file, the field, the rule and the value. So do aliases
    that stand for billions of values, deep nesting and endless numbers, keys given twice and numbers of other bases."""
    with pytest.raises(ConfigError, match=rf"scene\.yaml:? .*{message}") as caught:
        load_scene(write(tmp_path, content))
    assert len(str(caught.value)) < 1000 and "1074 of 1074 particles inside" not in str(caught.value)
    with pytest.raises(ConfigError, match=r"scene must be an existing YAML file, got .*nothing\.yaml"):
        load_scene(tmp_path / "nothing.yaml")


def test_emitters(tmp_path):
    """Particles enter through the face while it is open, and fill the distance that they move. Groups come
    first, then the other particles in the order of their times, each with its material's constants."""
    disc = DISC | {"velocity": [0, -2, 1], "start": 0.5, "water_tension": 0.5}
    slot = {"shape": "rectangle", "size": [0.2, 0.05], "position": [0.3, 0.5, 0.5], "velocity": [0, 0, 1.5]}
    scene = load_scene(write(tmp_path, {"groups": [CUBE], "emitters": [disc, slot | {"material": "sand", "stop": 1}]}))
    time = scene.entry_s_N
    body, sand = time == 0, (time > 0) & (scene.material_N == SAND)
    water = ~body & ~sand
    assert body.sum() == 1074 and (np.diff(time) >= 0).all()
    assert water.sum() == round(8 * 64**3 * np.pi * 0.05**2 * 5**0.5 * 0.5)
    assert sand.sum() == round(8 * 64**3 * 0.2 * 0.05 * 1.5)
    assert time[water].min() < 0.51 and time[sand].min() < 0.01 and 0.99 < time.max() <= 1
    offset = scene.position_N3[water] - np.float32(disc["position"])
    assert np.abs(offset @ np.array([0, -2, 1])).max() < 1e-6
    assert 0.049 < np.linalg.norm(offset, axis=1).max() <= 0.05 + 1e-6
    aside = np.abs(scene.position_N3[sand] - np.float32(slot["position"])).max(axis=0)
    assert aside == pytest.approx([0.1, 0.025, 0], abs=1e-3)
    tension = scene.material_parameters["water_tension"]
    assert (tension[water] == 0.5).all() and np.isnan(tension[~water]).all()


def test_material_parameters_of_groups(tmp_path):
    """A group may differ in its material's constants; particles of other groups hold NaN, the solver's own setting."""
    stiff = CUBE | {"material": "sand", "position": [0.3, 0.5, 0.5], "youngs_modulus_pa": 5e6, "density_kg_m3": 1600.0}
    scene = load(tmp_path, groups=[CUBE, stiff])
    assert sorted(scene.material_parameters) == ["density_kg_m3", "youngs_modulus_pa"]
    modulus = scene.material_parameters["youngs_modulus_pa"]
    assert np.isnan(modulus[scene.material_N == WATER]).all()
    assert (modulus[scene.material_N == SAND] == 5e6).all()
    assert load(tmp_path).material_parameters == {}


@pytest.mark.parametrize(("text", "value"), [("1e5", 1e5), ("1.0e5", 1e5), ("+2E-1", 0.2), (".5e1", 5.0), ("3", 3.0)])
def test_numbers_as_people_write_them(tmp_path, text, value):
    """A power of ten needs neither a decimal point nor a sign."""
    group = f"{{shape: cube, size: 0.08, position: [0.5, 0.5, 0.5], material: water, density_kg_m3: {text}}}"
    scene = load_scene(write(tmp_path, f"groups: [{group}]"))
    np.testing.assert_array_equal(np.unique(scene.material_parameters["density_kg_m3"]), np.float32(value))


def test_particles_of_a_file(tmp_path):
    """A group's particles are those of an .npz, with its velocities and the group's own; beside shapes and without."""
    position_N3 = np.random.default_rng(0).random((9, 3)).astype(np.float32)
    np.savez(tmp_path / "own.npz", position=position_N3, velocity=2 * position_N3)
    np.savez(tmp_path / "still.npz", position=position_N3[:4])
    moving = {"particles": "own.npz", "material": "sand", "velocity": [0, 1, 0]}
    scene = load(tmp_path, groups=[moving, CUBE, {"particles": "still.npz", "material": "snow"}])
    cube = scene.particle_count - 13
    np.testing.assert_array_equal(scene.position_N3[:9], position_N3)
    np.testing.assert_array_equal(scene.position_N3[-4:], position_N3[:4])
    np.testing.assert_allclose(scene.velocity_N3[:9], 2 * position_N3 + np.array([0, 1, 0], np.float32))
    assert not scene.velocity_N3[9:].any()
    assert scene.material_N.tolist() == [1] * 9 + [0] * cube + [2] * 4


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (None, "must be an existing .npz or USD file, got '"),
        (b"PK no zip", "must be a readable .npz file"),
        ({"velocity": np.zeros((2, 3))}, "must be a file with an array named position"),
        ({"position": np.zeros((2, 2))}, r"position must be of shape \(1, 3\), got \(2, 2\)"),
        ({"position": np.full((2, 3), np.nan)}, "position must be finite, got nan"),
        ({"position": np.zeros((2, 3), "M8[s]")}, "position must be of numbers, got 'datetime64\\[s\\]'"),
        ({"position": np.full((2, 3), 1.5)}, "position must be inside the domain, got '2 outside'"),
        ({"position": np.full((2, 3), 0.5), "velocity": np.zeros((1, 3))}, r"velocity must be of shape \(2, 3\)"),
        ({"position": np.array([{}], object)}, "must be a readable .npz file"),
        ({"position": np.full((2, 3), 0.5), "velocities": np.ones((2, 3))}, "arrays .*'velocities'; did you mean vel"),
    ],
)
def test_particles_that_cannot_be_taken(tmp_path, arrays, message):
    """Each fault of a file of particles is named with the group's field; objects are never unpickled."""
    path = tmp_path / "own.npz"
    if isinstance(arrays, dict):
        np.savez(path, **arrays)
    elif arrays is not None:
        path.write_bytes(arrays)
    with pytest.raises(ConfigError, match=rf"groups\[0\].particles.*{message}"):
        load(tmp_path, groups=[{"particles": "own.npz", "material": "sand"}])


def test_numbers_that_are_none(tmp_path):
    """Zero, decimals that begin with it or with a point, a date of the name, and anchors used twice are read."""
    text = ONE_CUBE.replace("[0.5, 0.8, 0.5]", "&middle [0.5, 0.8, 0.5]") + "obstacles:\n"
    text += "  - {shape: cone, size: 00.1, position: [0.2, 0.2, 0.2]}\nseed: 0\ngravity: [-.5, -0.98e1, +.5]\n"
    assert load_scene(write(tmp_path, text)).gravity == (-0.5, -9.8, 0.5)


def test_a_mistyped_file_name_is_answered_with_the_file(tmp_path):
    """The nearest YAML file of the folder, or all of them where none is near; nothing where there is no folder."""
    (tmp_path / "my_scene.yaml").write_text("groups: []")
    with pytest.raises(ConfigError, match=r"got .*my_sceen\.yaml; did you mean my_scene\.yaml\?$"):
        load_scene(tmp_path / "my_sceen.yaml")
    os.mkfifo(tmp_path / "pipe.yaml")
    others = "; YAML files there: my_scene.yaml"
    for name, remedy in (("funnel.yaml", others), ("pipe.yaml", others), ("nowhere/my_scene.yaml", "")):
        with pytest.raises(ConfigError, match=rf"got {tmp_path / name}{remedy}$"):
            load_scene(tmp_path / name)
