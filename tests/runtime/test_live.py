"""Tests changes of scenes during a simulation: unchanged values stay bitwise, and changes have the requested effect."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from network.states import network_of, silent
from network.test_barriers import square
from runtime.scenes import EMPTY_GRID, rough
from runtime.scenes import random_scene as scene

from hgn.runtime import simulator as simulator_module
from hgn.runtime.divergence import DivergedError
from hgn.runtime.live import LiveSimulation
from hgn.runtime.simulator import Simulator
from hgn.runtime.weights import WeightsInfo
from hgn.scene.own_physics import NOMINAL_P
from hgn.scene.scene import Scene
from hgn.schema import ConfigError

BACKENDS = ("torch", "cpu")


def entering(live, other):
    return live.add_particles(other.position_N3, other.velocity_N3, other.material_N)


def joined(*scenes):
    """The arrays of all their particles, by name."""
    names = ("position_N3", "velocity_N3", "material_N")
    return {name: np.concatenate([getattr(one, name) for one in scenes]) for name in names}


def frames(live, count):
    return np.stack([live.step() for _ in range(count)])


def small(**changes):
    return network_of(torch.float32, width=16, levels=2, **changes)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_scene_that_changes_is_one_that_began_so(backend):
    """To the bit: frames with nothing added, the same obstacles and the same gravity set between them are a rollout's;
    particles added before the first frame move as if the scene had begun with them, histories too; and what is restored
    with positions and histories of an earlier frame repeats that frame's future, without those that entered later."""
    simulator, first, second = Simulator(small(), 60.0, backend), scene(30), scene(20, 1)
    (expected_TN3,) = simulator.rollout([replace(first, **joined(first, second))], 7)
    live = LiveSimulation(simulator, first)
    history_AM3 = entering(live, second)
    np.testing.assert_array_equal(history_AM3, simulator.start([second]).velocity_NM3)
    for frame in range(1, 4):
        entering(live, scene(0))
        live.replace_obstacles(first)
        live.set_gravity(first.gravity)
        np.testing.assert_array_equal(live.step(), expected_TN3[frame])
    state = live.state
    position_N3, velocity_NM3 = state.position_N3.numpy().copy(), state.velocity_NM3.numpy().copy()
    entering(live, scene(10, 2))
    frames(live, 2)
    assert live.frame == 5
    live.restore(position_N3, velocity_NM3, 3)
    assert (live.frame, live.particle_count) == (3, 50)
    np.testing.assert_array_equal(frames(live, 3), expected_TN3[4:])


def test_friction_and_parameters_belong_to_scenes_and_particles():
    """A scene with its own physics that replaces a plain one moves as if it had begun so, and a plain one after it as
    without friction; particles that are added have the solver's parameters. A start with some of its particles has
    their parameters, and arrays of other lengths are refused."""
    own = small(inputs="local", own_physics=("friction", "parameters"))
    torch.nn.init.normal_(own.encode.first.weight)
    simulator, plain, other = Simulator(own, 60.0), scene(30), rough(scene(20, 1))
    expected = [frames_TN3[1:] for frames_TN3 in simulator.rollout([plain, other], 5)]
    assert np.abs(expected[1] - simulator.rollout([scene(20, 1)], 5)[0][1:]).max() > 1e-5
    live = LiveSimulation(simulator, [plain, plain])
    live.reset(1, other)
    np.testing.assert_array_equal(frames(live, 4), np.concatenate(expected, 1))
    live.reset(1, plain)
    live.reset(0, plain)
    np.testing.assert_array_equal(frames(live, 4), np.concatenate([expected[0]] * 2, 1))
    added = LiveSimulation(simulator, other)
    added.set_gravity(other.gravity)
    added.replace_obstacles(other)
    entering(added, scene(10, 2))
    whole = joined(other, scene(10, 2)) | {"parameters": np.concatenate([other.parameters, nominal(10)])}
    whole = replace(other, **whole)
    np.testing.assert_array_equal(frames(added, 4), simulator.rollout([whole], 5)[0][1:])
    one = replace(whole, body_N=np.arange(30), past_HN3=np.tile(whole.position_N3, (5, 1, 1))).selected(slice(20, 21))
    assert (one.body_N.tolist(), one.past_HN3.shape, one.parameters.tolist()) == ([20], (5, 1, 3), nominal(1).tolist())
    for name, value in (("parameters", nominal(29)), ("body_N", np.arange(29)), ("past_HN3", np.zeros((5, 29, 3)))):
        with pytest.raises(ConfigError, match=rf"{name} must be of 30 particles, got \(.*29.*\)"):
            replace(whole, **{name: value})


def nominal(count):
    return np.tile(np.array(NOMINAL_P, np.float32), (count, 1))


def test_empty_scenes_and_other_obstacles():
    """A scene without particles waits; those that enter move as a scene of their own. From the next frame on particles
    feel other obstacles, and without any they move as if there were none."""
    simulator, first = Simulator(small(), 60.0), scene(20)
    live, bare = LiveSimulation(simulator, scene(0)), replace(first, obstacle_grid=EMPTY_GRID)
    assert frames(live, 2).shape == (2, 0, 3)
    live.frame = 0  # for the grid origins of the rollout
    live.replace_obstacles(bare)
    entering(live, first)
    (expected_TN3,) = simulator.rollout([bare], 5)
    np.testing.assert_array_equal(frames(live, 3), expected_TN3[1:4])
    live.replace_obstacles(scene(0, 5))
    assert np.abs(live.step() - expected_TN3[-1]).max() > 1e-6


@pytest.mark.parametrize("backend", BACKENDS)
def test_obstacles_that_come_hold(backend):
    """With `obstacle_clearance` particles in free flight rest on a square that is put under them, those that enter
    later and under other gravity too, and fall on when it is gone; without the setting they fall through."""
    still = replace(scene(20, low=0.5), velocity_N3=np.zeros((20, 3), np.float32), obstacle_grid=EMPTY_GRID)
    later = replace(still, position_N3=still.position_N3 + np.float32(0.15))
    under = replace(still, corners=lambda: square((0.6, 0.45, 0.6), 1, 0.6))
    for clearance in (1e-3, None):
        simulator = Simulator(silent(small(inputs="relative", obstacle_clearance=clearance)), 60.0, backend)
        with LiveSimulation(simulator, still) as live:
            live.step()
            live.replace_obstacles(under)
            live.step()
            live.set_gravity((0.0, -20.0, 0.0))
            entering(live, later)
            low_N = frames(live, 14)[-1, :, 1]
            if clearance is None:
                assert (low_N < 0.4).all()
                continue
            assert low_N == pytest.approx(0.45 + clearance, rel=0, abs=0.02 * clearance)
            live.replace_obstacles(still)
            assert (frames(live, 2)[-1, :, 1] < 0.45 - clearance).all()


def test_barriers_stay_where_obstacles_do(monkeypatch):
    """Nothing is built for particles that enter, other gravity, and going back in time, and all hold as before."""
    still = replace(scene(5, low=0.5), velocity_N3=np.zeros((5, 3), np.float32), obstacle_grid=EMPTY_GRID)
    under = replace(still, corners=lambda: square((0.6, 0.45, 0.6), 1, 0.6))
    built, real = [], simulator_module.build_barrier
    monkeypatch.setattr(simulator_module, "build_barrier", lambda *given: built.append(len(given[0])) or real(*given))
    simulator = Simulator(silent(small(inputs="relative", obstacle_clearance=1e-3)), 60.0)
    with LiveSimulation(simulator, under) as live:
        barriers, begin = live.state.barriers, live.state
        live.set_gravity((0.0, -20.0, 0.0))
        entering(live, still)
        live.restore(begin.position_N3.numpy(), begin.velocity_NM3.numpy(), 0)
        assert live.state.barriers is barriers and sum(built) == 2
        assert frames(live, 14)[-1, :, 1] == pytest.approx(0.451, rel=0, abs=2e-5)
        live.replace_obstacles(under)
        assert live.state.barriers is barriers and sum(built) == 2
        live.replace_obstacles(replace(under, corners=lambda: square((0.6, 0.45, 0.6), 1, 0.6)))
        assert live.state.barriers is not barriers and sum(built) == 4


def test_distances_follow_the_triangles():
    """A scene in whose place comes one with the same cells and other triangles shows the distances of its own."""
    network = network_of(torch.float32, inputs="relative", obstacle_distance=True)
    low, high = (replace(scene(5), corners=lambda y=y: square((0.6, y, 0.6), 1, 0.6)) for y in (0.45, 0.46))
    with LiveSimulation(Simulator(network, 60.0), low) as live:
        live.reset(0, replace(high, obstacle_grid=low.obstacle_grid))
        expected = Simulator(network, 60.0).start([high]).obstacles
        torch.testing.assert_close(live.state.obstacles.distance_K, expected.distance_K, rtol=0, atol=0)


def test_gravity_changes_between_frames():
    """Relative inputs: a lone particle falls on under the new gravity from the velocity that it had, by the closed
    form of the frame's integration: v += g dt^2, x += v."""
    simulator = Simulator(silent(small(inputs="relative")), 60.0)
    one = replace(scene(1), velocity_N3=np.zeros((1, 3), np.float32))
    live = LiveSimulation(simulator, one)
    before_T13 = frames(live, 2)
    live.set_gravity((1.8, 3.6, 0.0))
    after_T13 = frames(live, 3)
    velocity_3 = (before_T13[1] - before_T13[0])[0].astype(np.float64)
    step_T1 = np.arange(1, 4)[:, None]
    rise_T3 = velocity_3 * step_T1 + 0.5 * step_T1 * (step_T1 + 1) * np.array((1.8, 3.6, 0.0)) / 3600
    np.testing.assert_allclose(after_T13[:, 0], before_T13[1, 0] + rise_T3, rtol=0, atol=2e-6)


def test_what_is_refused_changes_nothing():
    """Unsupported materials and gravity, and arrays that do not fit, are refused by name. The simulation then continues
    unchanged."""
    network = small(materials=("water", "sand"))
    info = WeightsInfo(network.config, 60.0, 1 / 64)
    simulator, first = Simulator(network, 60.0, info=info), scene(20)
    first.material_N[:] = 0
    (expected_TN3,) = simulator.rollout([first], 3)
    live, one_13, which_1 = LiveSimulation(simulator, first), np.full((1, 3), 0.5, np.float32), np.array([0])
    for call, message in (
        (lambda: live.add_particles(one_13, one_13, np.array([2])),
         r"material must be one of the training data's \(water, sand\), got snow"),
        (lambda: live.add_particles(one_13, one_13[:, :2], which_1),
         r"velocity_A3 must be of shape \(1, 3\), got \(1, 2\)"),
        (lambda: live.add_particles([[0.5] * 3], one_13, which_1), "position_A3 must be a NumPy array, got 'list'"),
        (lambda: live.add_particles(one_13, one_13, np.zeros(1)), "material_A must be whole numbers, got 'float64'"),
        (lambda: live.add_particles(one_13 * np.nan, one_13, which_1), "position_A3 must be finite, got nan"),
        (lambda: simulator.rollout(first, 3),
         r"scenes must be a list of scenes, got 'InitialState'; as in rollout\(\[scene\], fr"),
        (lambda: live.set_gravity((0.0, 0.0, 0.0)), "gravity must be the weights'"),
        (lambda: live.restore(np.zeros((21, 3), np.float32), np.zeros((21, 5, 3), np.float32), 0),
         "position_N3 must be at most 20 particles, got 21"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=message):
            call()
    np.testing.assert_array_equal(frames(live, 2), expected_TN3[1:])


def test_divergence_says_at_which_frame_of_the_scene():
    """Also behind changes, which begin the backend's own count anew; and the scene can be restored."""
    live = LiveSimulation(Simulator(small(), 60.0), scene(10))
    live.step()
    away_13 = np.full((1, 3), 0.5, np.float32)
    live.add_particles(away_13, np.full((1, 3), 600.0, np.float32), np.array([0]))
    with pytest.raises(DivergedError, match="at frame 2: 1 of 11 particles") as raised:
        live.step()
    assert raised.value.frame == 2
    start = Simulator(small(), 60.0).start([scene(10)])
    live.restore(start.position_N3.numpy(), start.velocity_NM3.numpy(), 0)
    assert np.isfinite(live.step()).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_scene_that_particles_enter(backend):
    """Each particle is there from the frame of its entry on, at first where free flight has it; until another comes
    the others are bitwise those of a rollout, and then of a simulation that they were added to.
    """
    first, new = scene(20), scene(6, seed=1, low=0.4)
    time = np.repeat([0.0, 0.04, 0.05], [20, 2, 4])
    emitting = Scene(**joined(first, new), entry_s_N=time, gravity=first.gravity)
    simulator = Simulator(small(), 60.0, backend)
    (path_TN3,) = simulator.rollout([emitting], 6)
    entry_N = np.repeat([0, 3, 3], [20, 2, 4])
    assert (np.isfinite(path_TN3).all(axis=2) == (entry_N <= np.arange(6)[:, None])).all()
    flight = (3 / 60 - time[20:])[:, None]
    expected = new.position_N3 + flight * new.velocity_N3 + flight**2 / 2 * np.array(first.gravity)
    np.testing.assert_allclose(path_TN3[3, 20:], expected, atol=1e-6)
    with LiveSimulation(simulator, Scene(first.position_N3, first.velocity_N3, first.material_N)) as live:
        np.testing.assert_array_equal(frames(live, 3), path_TN3[1:4, :20])
        entered = new.velocity_N3 + flight * np.array(first.gravity)
        live.add_particles(path_TN3[3, 20:], entered.astype(np.float32), new.material_N)
        np.testing.assert_array_equal(frames(live, 2), path_TN3[4:])
    # beside a scene of its own, and frame by frame, particles enter in the same way
    other, _ = simulator.rollout([emitting, first], 6)
    np.testing.assert_allclose(other, path_TN3, rtol=0, atol=1e-6)
    for position_N3, expected_N3 in zip(simulator.frames(emitting), path_TN3, strict=False):
        np.testing.assert_array_equal(position_N3, expected_N3[: len(position_N3)])
        assert np.isnan(expected_N3[len(position_N3) :]).all()
    with pytest.raises(ConfigError, match="emitters must be left out here"):
        LiveSimulation(simulator, emitting)
