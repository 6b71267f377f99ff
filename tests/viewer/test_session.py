"""Tests the actions of the page's buttons without the page."""

import io
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from network.states import network_of, silent
from scipy.spatial import KDTree

from hgn.runtime.divergence import DivergedError
from hgn.runtime.simulator import Simulator
from hgn.scene.rollout_file import read_rollout, write_rollout
from hgn.scene.scene import Scene
from hgn.scene.scene_file import ObstacleEntry, load_scene
from hgn.schema import ConfigError
from hgn.viewer.session import PlaySession, Spout

SCENE = """
cell_size: 0.03125
obstacles:
  - {shape: half_box, size: 0.5, position: [0.5, 0.3, 0.5], rotation: [0, 30, 0]}
  - {mesh: ramp.obj, scale: 0.3, position: [0.2, 0.2, 0.2]}
groups:
  - {shape: cube, size: 0.1, position: [0.5, 0.5, 0.5], material: water}
  - {shape: cube, size: 0.1, position: [0.5, 0.7, 0.5], material: snow, velocity: [0, -0.5, 0]}
"""


def free_flight(**changes):
    """A network of relative inputs whose output is zero."""
    return Simulator(silent(network_of(torch.float32, width=16, levels=2, inputs="relative", **changes)), 60.0, "cpu")


def simulator(factor=1.0):
    network = network_of(torch.float32, width=16, levels=2, inputs="relative")
    network.normaliser.acceleration_std.mul_(factor)
    return Simulator(network, 60.0, "cpu")


@pytest.fixture
def folder(tmp_path):
    ramp = Path(__file__).parents[2] / "conf/example/ramp.obj"
    (tmp_path / "ramp.obj").write_bytes(ramp.read_bytes())
    (tmp_path / "scene.yaml").write_text(SCENE)
    return tmp_path


@pytest.fixture
def session(folder):
    return PlaySession(simulator(), load_scene(folder / "scene.yaml"), folder)


def steps(session, count):
    """The newest positions after some frames."""
    for _ in range(count):
        session.step()
    return session.newest.position_N3


def test_untouched_it_is_a_rollout(session, folder):
    """Frames are those of a rollout of the scene, to rounding of the cells' normals; the file has each of them."""
    scene = load_scene(folder / "scene.yaml")
    (expected_TN3,) = simulator().rollout([scene], 5)
    steps(session, 4)
    write_rollout(folder / "played.vtkhdf", session.rollout())
    played = read_rollout(folder / "played.vtkhdf")
    np.testing.assert_allclose(played.position_TN3, expected_TN3, rtol=0, atol=2e-4)
    for found, expected in zip(played.obstacles, scene.obstacles, strict=True):
        np.testing.assert_allclose(found.vertex_V3, expected.vertex_V3, rtol=0, atol=1e-7)


def test_spout(session):
    """A spout emits particles at the density of the material at rest, from its disc and at its speed, until it is
    closed. It emits none while earlier particles are still in front of it."""
    session.use_weights(free_flight())
    session.set_gravity((0.0, 0.0, 0.0))
    session.spout = Spout((0.25, 0.9, 0.75), "sand", diameter=0.1, speed=0.6)
    before = len(session.newest.position_N3)
    steps(session, 30)
    session.spout = None
    poured_A3 = session.newest.position_N3[before:]
    expected = 8 * np.pi * 0.05**2 * 0.6 * 0.5 / session.cell_size**3
    assert len(poured_A3) == pytest.approx(expected, abs=1)
    assert (session.materials()[before:] == 1).all()
    entry_A3 = session.recording.entry_NM3[before:, 0]
    np.testing.assert_allclose(entry_A3[:, 1], -0.6 / 60, atol=1e-6)
    assert len(steps(session, 2)) == before + len(poured_A3)
    count = session.drop("water", (0.75, 0.8, 0.25), 0.2)
    session.spout = Spout((0.75, 0.8, 0.25))
    assert len(steps(session, 5)) == before + len(poured_A3) + count


def test_obstacles_that_are_moved_hold(session):
    """With `obstacle_clearance` falling particles rest on an obstacle at the place to which it was dragged, and pass a
    removed one."""
    clearance = 1e-3
    session.use_weights(free_flight(obstacle_clearance=clearance))
    for obstacle in session.obstacles:
        session.remove_obstacle(obstacle.body.number)
    plate = session.add_obstacle(ObstacleEntry(shape="square", size=0.4, position=(0.2, 0.2, 0.2)), Path())
    session.move_obstacle(replace(plate, position=(0.5, 0.3, 0.5)))
    assert steps(session, 30)[:, 1] == pytest.approx(0.3 + clearance, rel=0, abs=0.02 * clearance)
    session.remove_obstacle(plate.body.number)
    assert (steps(session, 2)[:, 1] < 0.3).all()


def test_keyframes_are_refused(folder):
    """Also with weights that see motion, because viewers move the obstacles."""
    (folder / "moving.yaml").write_text(SCENE.replace("[0, 30, 0]}", "[0, 30, 0], keyframes: [{time: 0}]}"))
    with pytest.raises(ConfigError, match=r"obstacles must be at rest in hgn\.play, got 'keyframes'; leave them out"):
        PlaySession(free_flight(own_physics=("moving",)), load_scene(folder / "moving.yaml"), folder)


def test_a_dragged_obstacle_carries_particles_along(session):
    """With weights that use moving obstacles a plate that is dragged up lifts particles by its displacement in a frame,
    and rests afterwards. A jump has no velocity."""
    session.use_weights(free_flight(obstacle_clearance=1e-3, own_physics=("moving",)))
    for obstacle in session.obstacles:
        session.remove_obstacle(obstacle.body.number)
    plate = session.add_obstacle(ObstacleEntry(shape="square", size=0.6, position=(0.5, 0.3, 0.5)), Path())
    steps(session, 30)
    for height in (0.31, 0.34, 0.41):
        session.move_obstacle(replace(plate, position=(0.5, height - 5e-3, 0.5)))
        session.move_obstacle(replace(plate, position=(0.5, height, 0.5)))
        assert session.live.state.moving.poses.shift_V3[0, 1] > 0.005
        assert (steps(session, 1)[:, 1] > height).all() and not session.live.state.moving.poses.shift_V3.any()
    session.move_obstacle(replace(plate, position=(0.5, 0.6, 0.5)))
    assert session.live.state.moving is None


def test_obstacles_at_rest_are_not_prepared_again(session):
    """While one obstacle is dragged, cells and barriers of the others are the same objects; a drop prepares all."""
    session.use_weights(free_flight(obstacle_clearance=1e-3, own_physics=("moving",), obstacle_distance=True))
    plate = session.add_obstacle(ObstacleEntry(shape="square", size=0.3, position=(0.5, 0.7, 0.5)), Path())
    seen = []
    for height in (0.705, 0.71, 0.715):
        session.step()
        session.move_obstacle(replace(plate, position=(0.5, height, 0.5)))
        assert session.live.state.moving is not None
        seen.append((session.live.state.obstacles, session.live.state.barriers))
    assert seen[0][0] is not None and all(cells is seen[0][0] and held is seen[0][1] for cells, held in seen)
    session.move_obstacle(replace(plate, position=(0.5, 0.9, 0.5)))
    assert len(session.live.state.obstacles.key_K) > len(seen[0][0].key_K)


def test_nothing_enters_where_there_is_no_place(session):
    """Not among particles, not in closed obstacles, not beyond the limit, not in the walls."""
    assert session.drop("water", (0.5, 0.5, 0.5), 0.06) == 0
    session.add_obstacle(ObstacleEntry(shape="cone", size=0.3, position=(0.2, 0.8, 0.8)))
    assert session.drop("water", (0.2, 0.75, 0.8), 0.06) == 0
    assert session.drop("water", (9.0, -9.0, 0.5), 0.1) > 0
    entered_A3 = session.live.state.position_N3.numpy()[len(session.newest.position_N3) :]
    wall = 3 * session.cell_size
    assert (entered_A3 >= wall - 1e-6).all() and (entered_A3 <= 1 - wall + 1e-6).all()
    session.maximum_particles = session.live.particle_count + 5
    assert session.drop("snow", (0.8, 0.8, 0.2), 0.2) == 5
    with pytest.raises(ConfigError, match=r"material must be one of water, sand, snow.*, got 'lava'"):
        session.drop("lava", (0.8, 0.8, 0.2), 0.2)


def test_obstacles_act_where_they_are_put(session):
    """Cells with normals follow an obstacle that is moved and turned, those of one that is removed go; turning is about
    the vertical through the obstacle's position."""
    for obstacle in session.obstacles:
        session.remove_obstacle(obstacle.body.number)
    assert len(session.live.scenes[0].obstacle_grid.cell_K3) == 0
    plate = session.add_obstacle(ObstacleEntry(shape="square", size=0.2, position=(0.5, 0.31, 0.5)))
    session.move_obstacle(replace(plate.turned(45), position=(0.5, 0.72, 0.5)))
    grid = session.live.scenes[0].obstacle_grid
    assert set(grid.cell_K3[:, 1]) == {int(0.72 / session.cell_size)}
    np.testing.assert_allclose(np.abs(grid.normal_K3[:, 1]), 1, atol=1e-5)
    reach = 0.2 / np.sqrt(2)
    (moved,) = session.obstacles
    low, high = moved.mesh().vertex_V3.min(0), moved.mesh().vertex_V3.max(0)
    np.testing.assert_allclose(low, (0.5 - reach, 0.72, 0.5 - reach), atol=1e-6)
    np.testing.assert_allclose(high, (0.5 + reach, 0.72, 0.5 + reach), atol=1e-6)
    assert moved.entry.rotation == pytest.approx((0, 45, 0))


def test_going_back_repeats_to_the_bit(session):
    """After going back to a frame its future is the same again, with the obstacles and gravity of then, and particles
    that entered a frame before with their histories."""
    steps(session, 2)
    session.drop("snow", (0.3, 0.8, 0.3), 0.08)
    steps(session, 1)
    expected_N3 = steps(session, 3).copy()
    plate, _ = session.obstacles
    session.move_obstacle(replace(plate, position=(0.5, 0.6, 0.5)))
    session.set_gravity((3.0, 0.0, 0.0))
    session.drop("water", (0.7, 0.8, 0.7), 0.1)
    later_N3 = steps(session, 3)
    assert len(later_N3) > len(expected_N3)
    session.rewind(3)
    assert session.frame == 3 and session.gravity == (0.0, -9.8, 0.0) and session.obstacles[0] is plate
    np.testing.assert_array_equal(steps(session, 3), expected_N3)
    session.rewind(2)
    assert len(session.materials()) == load_count(session)
    session.restart()
    assert session.frame == 0


def load_count(session):
    return len(session.recording[0].position_N3)


def test_changes_are_undone_one_by_one(session):
    """Undo restores frame, obstacles and gravity before the last change, twice for two changes in one frame. Changes
    after a frame to which the scene was rewound are dropped."""
    steps(session, 3)
    then, before = session.newest.position_N3.copy(), session.obstacles
    session.remember()
    session.set_gravity((1.0, 0.0, 0.0))
    session.remember()
    session.add_obstacle(ObstacleEntry(shape="cone", size=0.1, position=session.free_place(0.1)))
    steps(session, 2)
    session.undo()
    assert session.frame == 3 and session.obstacles == before and session.gravity == (1.0, 0.0, 0.0)
    session.undo()
    assert session.gravity == (0.0, -9.8, 0.0) and np.array_equal(session.newest.position_N3, then)
    steps(session, 1)
    session.remember()
    session.rewind(2)
    steps(session, 3)
    with pytest.raises(ConfigError, match="undo must be used after a change"):
        session.undo()


def test_free_places(session):
    """A free place is clear of particles and obstacles, in the middle if that is free; a full scene is refused."""
    for _ in range(4):
        place = np.array(session.free_place(0.15))
        inside = np.abs(session.newest.position_N3 - place) < 0.075
        assert not inside.all(axis=1).any() and place.min() >= 0.075 - 1e-9 and place.max() <= 0.925 + 1e-9
        for obstacle in session.obstacles:
            assert not (np.abs(obstacle.samples[0] - place) < 0.075).all(axis=1).any()
        session.add_obstacle(ObstacleEntry(shape="half_box", size=0.15, position=tuple(place.tolist())))
    with pytest.raises(ConfigError, match=r"size must leave room among particles and obstacles, got 0\.9"):
        session.free_place(0.9)
    assert not session.full


@pytest.mark.parametrize(("middle", "size"), [(0.5, 0.3), (0.3, 0.6)])
def test_free_places_are_inside_the_domain(middle, size):
    """No part of an obstacle at a free place is beyond a wall, although places near walls are free too."""
    block_N3 = middle + 0.2 * np.random.default_rng(0).random((500, 3)).astype(np.float32)
    scene = Scene(block_N3, 0 * block_N3, np.zeros(500, np.uint8), cell_size=1 / 32, domain_size=(1.0, 1.0, 1.0))
    session = PlaySession(simulator(), scene)
    for _ in range(40):
        try:
            place = np.array(session.free_place(size))
        except ConfigError:
            break
        assert (place - size / 2 >= -1e-9).all() and (place + size / 2 <= 1 + 1e-9).all()
        session.add_obstacle(ObstacleEntry(shape="half_box", size=size, position=tuple(place.tolist())))
    else:
        raise AssertionError("the domain is never full")


def test_samples_of_added_obstacles_are_bounded(session, monkeypatch):
    """They count together, because a change may need them all. Those of removed obstacles do not count."""
    entry = ObstacleEntry(shape="cone", size=0.1, position=(0.5, 0.5, 0.5))
    most = 10 * len(session.add_obstacle(entry).samples[0])
    monkeypatch.setattr("hgn.viewer.session.MOST_SAMPLES", most)
    for _ in range(2):
        with pytest.raises(ConfigError, match=r"surface must need fewer than .* remove others"):
            for _ in range(10):
                session.add_obstacle(entry)
        session.restart()


def test_what_is_kept_is_bounded(session):
    """Frames beyond the limit are forgotten, going back to them is refused with the frames that are kept, and the
    oldest that is kept repeats to the bit."""
    session.recording.limit_bytes = 12 * session.recording.bytes
    steps(session, 20)
    recording = session.recording
    assert (len(recording.frames), recording.first, recording.earliest) == (12, 9, 13)
    expected_N3 = recording[20].position_N3
    with pytest.raises(ConfigError, match="frame must be between 13 and 20, the frames that are kept, got 12"):
        session.rewind(12)
    session.rewind(13)
    np.testing.assert_array_equal(steps(session, 7), expected_N3)


def test_the_scene_is_saved(session, tmp_path):
    """The archive is a scene file: the particles with their velocities, the obstacles where they are, the gravity."""
    session.set_gravity((1.0, -2.0, 0.5))
    session.add_obstacle(ObstacleEntry(shape="cone", size=0.2, position=(0.8, 0.2, 0.8), rotation=(10, 20, 30)))
    session.drop("sand", (0.3, 0.8, 0.3), 0.1)
    steps(session, 3)
    with zipfile.ZipFile(io.BytesIO(session.scene_archive())) as archive:
        archive.extractall(tmp_path / "saved")
    saved = load_scene(tmp_path / "saved" / "scene.yaml")
    order_N = np.argsort(session.materials(), kind="stable")
    np.testing.assert_array_equal(saved.position_N3, session.newest.position_N3[order_N])
    velocity_N3 = 60 * session.newest.velocity_N3[order_N].astype(np.float64) + np.array([1.0, -2.0, 0.5]) / 120
    np.testing.assert_allclose(saved.velocity_N3, velocity_N3, rtol=1e-6)
    np.testing.assert_array_equal(saved.material_N, np.sort(session.materials()))
    assert saved.gravity == (1.0, -2.0, 0.5) and saved.cell_size == session.cell_size
    for found, expected in zip(saved.obstacles, session.obstacles, strict=True):
        np.testing.assert_allclose(found.vertex_V3, expected.mesh().vertex_V3, rtol=0, atol=1e-6)
    again = PlaySession(simulator(), saved, tmp_path / "saved")
    assert len(again.live.scenes[0].obstacle_grid.cell_K3) == len(session.live.scenes[0].obstacle_grid.cell_K3)


@pytest.mark.parametrize("frames", [0, 3])
def test_friction_constants_and_velocities_are_saved(folder, frames):
    """The saved scene contains both frictions, the constants of each particle (none for poured ones), and velocities at
    the instant of the frame, from which a simulation starts with the particles' displacements."""
    cubes = [
        "material: sand, sand_friction_angle_deg: 40.1, density_kg_m3: 900",
        "material: water, water_viscosity_pa_s: 3, velocity: [0.1, 0.2, 0.3]",
        "material: sand, sand_friction_angle_deg: 20",
        "material: sand, velocity: [0, 1, 0]",
        "material: sand, sand_friction_angle_deg: 20",
    ]
    own = "floor_friction: 0.6\nwall_friction: 0.2\ncell_size: 0.03125\ngravity: [1, -2, 0.5]\ngroups:\n"
    for number, cube in enumerate(cubes):
        own += f"  - {{shape: cube, size: 0.05, position: [{0.2 + 0.15 * number}, 0.5, 0.5], {cube}}}\n"
    (folder / "own.yaml").write_text(own)
    scene = load_scene(folder / "own.yaml")
    session = PlaySession(free_flight(), scene, folder)
    if frames:
        session.drop("sand", (0.5, 0.8, 0.5), 0.1)
    steps(session, frames)
    with zipfile.ZipFile(io.BytesIO(session.scene_archive())) as archive:
        archive.extractall(folder / "saved")
    saved = load_scene(folder / "saved" / "scene.yaml")
    assert saved.wall_friction == (0.2, 0.6, 0.2) and len(saved.specification["groups"]) == 4
    count, poured = scene.particle_count, saved.particle_count - scene.particle_count
    assert (poured > 0) == (frames > 0)
    row_N = KDTree(saved.position_N3).query(session.newest.position_N3)[1]
    np.testing.assert_array_equal(saved.material_N[row_N], session.materials())
    assert saved.material_parameters.keys() == scene.material_parameters.keys()
    for name, value_N in scene.material_parameters.items():
        expected_N = np.pad(value_N, (0, poured), constant_values=np.nan)
        np.testing.assert_array_equal(saved.material_parameters[name][row_N], expected_N, err_msg=name)
    expected_N3 = scene.velocity_N3 + np.array(scene.gravity) * frames / 60
    np.testing.assert_allclose(saved.velocity_N3[row_N[:count]], expected_N3, rtol=0, atol=2e-6)
    again = PlaySession(free_flight(), saved, folder / "saved")
    np.testing.assert_allclose(again.newest.velocity_N3[row_N], session.newest.velocity_N3, rtol=0, atol=1e-8)


def test_the_rollout_is_saved(session, tmp_path):
    """Each particle is in the frames since it entered, and nowhere before; obstacles move as they were moved."""
    steps(session, 2)
    box, _ = session.obstacles
    begin = box.mesh().vertex_V3
    session.move_obstacle(replace(box.turned(90), position=(0.5, 0.35, 0.45)))
    session.drop("sand", (0.3, 0.8, 0.3), 0.1)
    steps(session, 2)
    write_rollout(tmp_path / "a.vtkhdf", session.rollout())
    rollout = read_rollout(tmp_path / "a.vtkhdf")
    count = load_count(session)
    assert np.isnan(rollout.position_TN3[:3, count:]).all() and np.isfinite(rollout.position_TN3[3:]).all()
    for frame in range(5):
        np.testing.assert_array_equal(
            rollout.position_TN3[frame, : len(session.recording[frame].position_N3)],
            session.recording[frame].position_N3,
        )
    moved, rest = rollout.obstacles
    assert rest.motion is None and moved.motion is not None
    np.testing.assert_allclose(moved.motion.place(moved.vertex_V3, 2 / 60), begin, atol=1e-6)
    now = session.obstacles[0].mesh().vertex_V3
    np.testing.assert_allclose(moved.motion.place(moved.vertex_V3, 3 / 60), now, atol=1e-6)


def test_other_weights_go_on_from_here(session):
    """Other weights continue from the bitwise same state and histories, and the next frames are those of the other
    network. A frame rate or a material that does not fit is refused without a change. With another history length the
    new history starts from the last displacement."""
    steps(session, 3)
    state = session.live.state
    with pytest.raises(ConfigError, match=r"weights must be for 60.0 frames per second, got 30.0"):
        session.use_weights(Simulator(network_of(torch.float32), 30.0))
    with pytest.raises(ConfigError, match=r"material must be one of the training data's \(sand\), got water"):
        session.use_weights(Simulator(network_of(torch.float32, materials=("sand",)), 60.0))
    assert session.live.state.position_N3 is state.position_N3
    session.use_weights(simulator(2.0))
    for name in ("position_N3", "velocity_NM3", "material_N"):
        np.testing.assert_array_equal(getattr(session.live.state, name), getattr(state, name))
    other_N3 = steps(session, 1)
    session.rewind(3)
    session.use_weights(simulator())
    assert not np.array_equal(steps(session, 1), other_N3) and session.frame == 4
    newest_N3 = session.newest.velocity_N3
    session.use_weights(free_flight(velocity_history=3))
    np.testing.assert_allclose(session.live.state.velocity_NM3[:, 0], newest_N3, rtol=0, atol=1e-8)


def test_other_weights_go_on_with_added_particles(folder):
    """The others keep their constants; the added ones have the defaults, and each ball stays a body of its own."""
    text = SCENE.replace("material: snow,", "material: snow, snow_hardening: 7,")
    (folder / "own.yaml").write_text(text)
    physics = {"own_physics": ("parameters", "elastic"), "materials": ("water", "sand", "snow", "elastic")}
    session = PlaySession(free_flight(**physics), load_scene(folder / "own.yaml"), folder)
    steps(session, 2)
    for x in (0.2, 0.35):
        assert session.drop("snow", (x, 0.8, 0.2), 0.1) and session.drop("elastic", (x, 0.8, 0.8), 0.12)
    steps(session, 1)
    state = session.live.state
    session.use_weights(free_flight(**physics))
    np.testing.assert_array_equal(session.live.state.rest.neighbour_NK, state.rest.neighbour_NK)
    for name in ("position_N3", "velocity_NM3", "material_N", "parameter_NP"):
        np.testing.assert_array_equal(getattr(session.live.state, name), getattr(state, name), err_msg=name)
    steps(session, 1)


def test_divergence_is_taken_back(session):
    """A divergence is reported, and the scene returns to the frame before it."""
    before_N3 = steps(session, 2)
    session.drop("water", (0.3, 0.8, 0.3), 0.1, speed=600.0)
    with pytest.raises(DivergedError, match="at frame 3"):
        session.step()
    assert session.frame == 2 and session.live.particle_count == len(before_N3)
    assert np.isfinite(steps(session, 2)).all()


def test_scenes_that_cannot_be_played():
    """Too many particles are refused by the setting's name; an empty scene plays, and cannot be saved."""
    cloud_N3 = np.random.default_rng(0).random((30, 3)).astype(np.float32)
    scene = Scene(cloud_N3, 0 * cloud_N3, np.zeros(30, np.uint8))
    with pytest.raises(ConfigError, match="scene's particles must be at most 20, got 30; raise particles"):
        PlaySession(simulator(), scene, maximum_particles=20)
    empty = PlaySession(simulator(), Scene(cloud_N3[:0], cloud_N3[:0], np.zeros(0, np.uint8)))
    empty.step()
    with pytest.raises(ConfigError, match="scene's particles must be at least one to be saved, got 0; pour some"):
        empty.scene_archive()
    assert empty.drop("water", (0.5, 0.5, 0.5), 0.05) > 0
    assert len(steps(empty, 2)) > 0
