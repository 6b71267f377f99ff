"""Tests many live scenes in one batch: each moves as if alone, whatever changes in the others."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from network.states import network_of, silent
from network.test_barriers import square
from runtime.scenes import EMPTY_GRID
from runtime.scenes import random_scene as scene

from hgn.runtime.live import LiveSimulation
from hgn.runtime.simulator import Simulator
from hgn.scene.scene import Scene
from hgn.schema import ConfigError

RELATIVE = {"width": 16, "levels": 2, "inputs": "relative"}


def paths(live, frames):
    """Positions [T, N, 3] of each scene in the next frames; particles are sorted by scene."""
    states = [live.advance() for _ in range(frames)]
    assert all(bool((state.scene_N.diff() >= 0).all()) for state in states)
    return [torch.stack([s.position_N3[s.scene_N == i] for s in states]).numpy() for i in range(len(live.scenes))]


def assert_alone(simulator, start, path_TN3):
    """A path after its start is that of the scene alone, as exactly as batches are (test_simulator.py)."""
    (alone_TN3,) = simulator.rollout([start], len(path_TN3) + 1)
    np.testing.assert_allclose(path_TN3, alone_TN3[1:], rtol=0, atol=2e-6)


@pytest.mark.parametrize("backend", ["torch", "cpu"])
def test_scenes_equal_each_alone(backend):
    """Scenes have different sizes, obstacles and gravity. One diverges at once, others are reset with more, fewer and
    no particles. Each equals its own rollout, and a reset leaves the other scenes bitwise as they are. A scene that
    has ended has no particles until its reset, also if all scenes have ended."""
    simulator = Simulator(network_of(torch.float32, **RELATIVE), 60.0, backend)
    first, second, third = scene(30), scene(12, 4, domain_size=(0.75, 1.0, 1.0)), scene(9, 5, gravity=(0.0, 5.0, 0.0))
    away = replace(scene(15, 1), velocity_N3=np.full((15, 3), 600.0, np.float32))
    with LiveSimulation(simulator, [first, away, scene(5, 2, obstacle_grid=EMPTY_GRID)]) as live:
        before = paths(live, 1)
        assert list(live.ended) == [1] and live.ended[1].frame == 1 and "15 of 15" in live.ended[1].cause
        assert before[1].shape == (1, 0, 3) and live.particle_count == 35
        with pytest.raises(ConfigError, match="index must be the index of a scene in progress, got 1; reset it"):
            live.add_particles(first.position_N3, first.velocity_N3, first.material_N, index=1)
        for index, new, ended in ((2, scene(0, 3), [1]), (2, third, [1]), (1, second, [])):
            state = live.state
            live.reset(index, new)
            for name in ("position_N3", "velocity_NM3", "material_N"):
                old, now = (getattr(each, name)[each.scene_N != index] for each in (state, live.state))
                assert torch.equal(old, now)
            assert list(live.ended) == ended and live.particle_count == len(old) + len(new.position_N3)
        after = paths(live, 3)
        assert_alone(simulator, first, np.concatenate([before[0], after[0]]))
        assert_alone(simulator, second, after[1])
        assert_alone(simulator, third, after[2])
        for index in range(3):
            live.reset(index, replace(away, velocity_N3=away.velocity_N3 * np.float32(np.nan)))
        assert live.step().shape == (0, 3) == live.step().shape and sorted(live.ended) == [0, 1, 2]
        live.reset(1, first)
        assert_alone(simulator, first, paths(live, 2)[1])


def test_changes_of_one_scene():
    """Particles, gravity, obstacles and an earlier frame change in one scene. With a network that predicts zero it
    rests on a square and repeats this, and the other scene falls as if alone. Stored past frames do not prevent the
    changes."""
    still = replace(scene(20, low=0.5), velocity_N3=np.zeros((20, 3), np.float32), obstacle_grid=EMPTY_GRID)
    under = replace(still, corners=lambda: square((0.6, 0.45, 0.6), 1, 0.6))
    simulator = Simulator(silent(network_of(torch.float32, **RELATIVE, obstacle_clearance=1e-3)), 60.0)
    new = [still.position_N3[:3] + np.float32(0.15), still.velocity_N3[:3], still.material_N[:3]]
    past = replace(still, past_HN3=np.repeat(still.position_N3[None], 5, axis=0))
    with LiveSimulation(simulator, [still, past]) as live:
        live.replace_obstacles(under, index=1)
        live.set_gravity((0.0, -20.0, 0.0), index=1)
        live.add_particles(*new, index=0)
        live.add_particles(*new, index=1)
        assert live.state.scene_N.tolist() == [0] * 23 + [1] * 23
        state, path = live.state, paths(live, 15)
        assert path[1][-1, :, 1] == pytest.approx(0.451, rel=0, abs=2e-5)
        live.restore(state.position_N3[23:].numpy(), state.velocity_NM3[23:].numpy(), 15, index=1)
        again = paths(live, 15)
        np.testing.assert_array_equal(again[1], path[1])
        fallen_T1 = 0.5 * 9.8 * (np.arange(1, 31)[:, None] / 60) ** 2
        fall_TN = live.scenes[0].position_N3[:, 1] - np.concatenate([path[0], again[0]])[:, :20, 1]
        np.testing.assert_allclose(fall_TN, fallen_T1.repeat(20, axis=1), rtol=0, atol=1e-5)


@pytest.mark.parametrize("backend", ["torch", "cpu"])
def test_tensors_are_shared_without_a_copy(backend):
    """DLPack gives other libraries the state's own memory, which later frames leave alone; `step` gives a copy."""
    with LiveSimulation(Simulator(network_of(torch.float32, **RELATIVE), 60.0, backend), [scene(20), scene(5)]) as live:
        for tensor in (live.advance().position_N3, live.state.velocity_NM3):
            array = np.from_dlpack(tensor)
            assert array.ctypes.data == tensor.data_ptr() and np.array_equal(array, tensor)
            before = array.copy()
            live.step()[:] = np.nan
            assert np.array_equal(array, before) and bool(live.state.position_N3.isfinite().all())


def test_what_is_refused_changes_nothing():
    """Scenes that are not there, emit or lie out of reach are refused by name, and all go on as if nothing had been."""
    simulator, first = Simulator(network_of(torch.float32, **RELATIVE), 60.0), scene(10)
    far = replace(first, position_N3=first.position_N3 + 1e6)
    emitting = Scene(first.position_N3, first.velocity_N3, first.material_N, entry_s_N=np.linspace(0, 1, 10))
    with LiveSimulation(simulator, [first, first]) as live:
        for call, message in (
            (lambda: live.reset(2, first), "index must be 0 to 1, a scene of the batch, got 2"),
            (lambda: live.set_gravity((0.0, 0.0, 0.0), index=-1), "index must be 0 to 1"),
            (lambda: live.reset(1, far), "position_N3 must be finite and"),
            (lambda: live.reset(1, emitting), "emitters must be left out here"),
            (lambda: LiveSimulation(simulator, []), "scenes must be at least one, got 0"),
            (lambda: LiveSimulation(simulator, [None]), "scene must be a Scene or an InitialState, got 'NoneType'"),
            (lambda: live.set_gravity((0.0, 1.0)), r"gravity must be three numbers from .* to .*, got \(0.0, 1"),
            (lambda: live.set_gravity((0.0, np.nan, 0.0)), "gravity must be three numbers"),
            (lambda: live.set_gravity((0.0, 10**400, 0.0)), "gravity must be three numbers"),
            (lambda: LiveSimulation(None, [first]), "simulator must be a Simulator, got 'NoneType'"),
            (lambda: LiveSimulation(simulator, 3), "scenes must be a list of scenes, got 'int'"),
            (lambda: LiveSimulation(simulator, [first], "x"), "capacity must be a whole number, got 'x'"),
            (lambda: setattr(live, "frame", 1.5), "frame must be a whole number, got 1.5"),
            (lambda: simulator.rollout([], 3), "scenes must be at least one, got 0"),
            (lambda: simulator.rollout([first], 10**20), "frames must be a whole number, got 1000"),
            (lambda: next(simulator.frames(first, "3")), "count must be a whole number, got '3'"),
            (lambda: live.restore(first.position_N3 * np.nan, None, 0), "position_N3 must be finite, got nan"),
            (lambda: live.restore(first.position_N3 * 1j, None, 0), "position_N3 must be of real numbers"),
            (lambda: live.restore(first.position_N3, None, 0), "velocity_NM3 must be a NumPy array, got 'NoneType'"),
            (lambda: live.reset(0, replace(first, velocity_N3=first.velocity_N3[:5])), "velocity_N3 must have shape"),
            (lambda: live.reset(0, replace(first, material_N=np.full(10, 99))), "material_N must be 0 to 3"),
            (lambda: live.reset(0, replace(first, position_N3=[[0.5] * 3] * 10)), "position_N3 must be a NumPy array"),
            (lambda: live.restore(first.position_N3[:, :2], first.velocity_N3, 0), "position_N3 must be of shape"),
            (lambda: live.add_particles(None, None, None), "position_A3 must be a NumPy array, got 'NoneType'"),
            (lambda: live.set_gravity((0.0, 0.0, 0.0), index=0.5), "index must be 0 to 1, a scene of the batch, got 0"),
            (lambda: live.set_gravity((0.0, 0.0, 0.0), index=True), "index must be 0 to 1, a scene of the batch, got"),
        ):  # fmt: skip
            with pytest.raises(ConfigError, match=message):
                call()
        for path_TN3 in paths(live, 2):
            assert_alone(simulator, first, path_TN3)
    for call in (live.advance, live.step, lambda: live.reset(0, first), lambda: live.set_gravity((0.0, 0.0, 0.0))):
        with pytest.raises(ConfigError, match="simulation must be open, got 'closed'; start another one"):
            call()
