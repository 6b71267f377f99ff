"""Whole frames in one launch, a team for each scene: the same physics as one launch a substep.

A GPU runs it with hundreds of threads a block; here a block has one, and two blocks run on the two threads.
"""

import dataclasses

import numpy as np
import pytest
import shared_kernels
from mpm_scenes import CELL, CONFIG, assert_inside, block, joined, particles, sheet, simulated

from datagen.mpm import solver, team_launch
from datagen.mpm.device import Device
from datagen.mpm.solver import SceneFailure, Simulated, Team, _team, _teams_at_once, simulate
from datagen.mpm.team_launch import divided
from hgn.config import MpmConfig
from hgn.scene.motion import Motion
from hgn.scene.rotation import euler_rotation
from hgn.scene.shapes import shape_obstacle
from hgn.schema import ConfigError


def mixed(count, seed, velocity, **scene):
    kinds, low, high = np.arange(count) % 4, (0.3, 0.4, 0.3), (0.5, 0.6, 0.5)
    return block(kinds, low, high, velocity, seed, count, obstacles=(sheet(0.3),), **scene)


@pytest.fixture(scope="module", autouse=True)
def two_threads():
    shared_kernels.use_threads(2)
    yield
    shared_kernels.use_threads(1)


HEAVY = mixed(90, 1, (1, -1, 0), material_parameters={"density_kg_m3": np.linspace(500, 2000, 90, dtype=np.float32)})


ABOVE = block(np.arange(20) % 4, (0.3, 0.32, 0.3), (0.4, 0.38, 0.4), (0, -3, 0), 4, 20, obstacles=(sheet(0.3),))
BOTH_SIDES = joined(ABOVE, block(np.arange(20) % 4, (0.3, 0.22, 0.3), (0.4, 0.28, 0.4), (0, 3, 0), 5, 20))


def test_teams_agree_with_the_other_launch():
    """The batch contains scenes of several sizes, densities and obstacles. One frame agrees to 1e-6 of the domain, ten
    frames to 1e-3, in the given order. Frames are reported one by one, and a scene that fails does not change the
    others."""
    scenes = [mixed(120, 0, (0, -3, 0)), HEAVY, mixed(1, 2, (0, 0, 0)), BOTH_SIDES]
    frames: list[int] = []
    expected = simulated(scenes, frames=11)
    found = simulate([*scenes, mixed(40, 3, (0, 1e6, 0))], CONFIG, 11, 60.0, frames.append, team=Team(1))
    assert frames == list(range(11))
    failed = found.pop()
    assert isinstance(failed, SceneFailure) and failed.cause.startswith("frame 1: ")
    for scene, one, other in zip(scenes, expected, found, strict=True):
        assert isinstance(other, Simulated)
        assert np.array_equal(other.position_TN3[0], scene.position_N3)
        assert np.abs(one.position_TN3[1] - other.position_TN3[1]).max() < 1e-6
        assert np.abs(one.position_TN3 - other.position_TN3).max() < 1e-3
        assert one.counters["substeps"] == other.counters["substeps"]
    # with all that the batch's kernel computes
    (alone,) = simulated(scenes[1:2], frames=11, team=Team(1))
    assert np.abs(alone.position_TN3 - found[1].position_TN3).max() < 1e-3


FAILING = mixed(40, 3, (0, 1e6, 0))


def lifted(*obstacles):
    """The obstacles rise and turn, also within a frame."""
    turns = np.stack([euler_rotation((0.0, angle, 5 * angle)) for angle in (0.0, 2.0, 3.0)])
    rise = np.array([[0.0, 0.0, 0.0], [0.0, 0.02, 0.0], [0.0, 0.03, 0.0]])
    motion = Motion(np.array([0.0, 0.02, 0.04]), rise, turns, (0.4, 0.3, 0.4))
    own = tuple(dataclasses.replace(obstacle, motion=motion) for obstacle in obstacles)
    return dataclasses.replace(mixed(120, 0, (0, -3, 0)), obstacles=own)


MOVING = lifted(sheet(0.3), shape_obstacle("pyramid", 0.2, (0.4, 0.15, 0.4)))


@pytest.mark.parametrize(
    ("config", "scenes", "team", "tolerance"),
    [
        (MpmConfig(device="cpu", fixed_time_step_s=1e-3), [HEAVY], Team(1), 1e-3),
        (CONFIG, [MOVING, HEAVY, FAILING], Team(1, 2, 1), 1e-5),
    ],
    ids=["each step is an interval", "two blocks and moving obstacles"],
)
def test_other_kernels_agree(config, scenes, team, tolerance):
    """Kernels without separate steps of particles, and scenes of two blocks that wait for each other, next to one that
    fails, agree with one launch per substep: a frame to 1e-6, with equal numbers of substeps."""
    for one, other in zip(*(simulate(scenes, config, 4, 60.0, team=each) for each in (Team(0), team)), strict=True):
        if isinstance(one, SceneFailure):
            assert one == other and scenes[2:] == [FAILING]
            continue
        assert isinstance(other, Simulated) and one.counters["substeps"] == other.counters["substeps"]
        assert np.abs(one.position_TN3[1] - other.position_TN3[1]).max() < 1e-6
        assert np.abs(one.position_TN3 - other.position_TN3).max() < tolerance


def test_a_hundred_thousand_substeps():
    """A particle of each material in the smallest domain: after 100,000 substeps all lie still, inside, unfloored."""
    place = np.array([[3.2, 3.5, 2.7], [4.1, 2.8, 3.3], [2.6, 2.9, 4.4], [4.6, 2.9, 4.6]]) * CELL
    density = {"density_kg_m3": np.float32([1000, 1200, 1000, 1000])}
    room = {"obstacles": (sheet(0.3),), "domain_size": (8 * CELL,) * 3}
    scene = particles(place, range(4), material_parameters=density, **room)
    config = MpmConfig(device="cpu", fixed_time_step_s=5e-4)
    (outcome,) = simulated([scene], config, 12, 1 / 4.55, team=Team(1))
    assert outcome.counters["substeps"] == 11 * 9100 > 100_000
    assert_inside(outcome.position_TN3, scene, config)
    # what is left is a creep of single particles into the floor's last cell, 0.04 cells in five seconds
    assert np.abs(outcome.position_TN3[-1] - outcome.position_TN3[-2]).max() < 0.1 * CELL
    floors = {
        name: outcome.counters[name] for name in ("water_volume_floors", "singular_value_floors", "position_clamps")
    }
    assert set(floors.values()) == {0}, floors


@pytest.mark.parametrize("scenes", [1, 2, 7, 32, 132, 133, 264, 800])
@pytest.mark.parametrize("most", [1, 50, 4_000, 40_000, 1_000_000])
def test_blocks_that_wait_for_each_other_all_run_at_once(scenes, most):
    """The blocks of a scene, where there are several, find room on a GPU's processors."""
    team = _team(Device("cuda", 1, 132), [most] * scenes)
    assert team.threads % 32 == 0
    assert team.blocks * _teams_at_once(Device("cuda", 1, 132), team) <= 132 * 2
    assert _team(Device("cpu", 2), [most] * scenes) == _team(Device("cuda", 1, 132), [50_000_000]) == Team(0)


def test_teams_are_larger_where_few_scenes_have_most_of_the_work():
    """Even scenes have many small teams. One long scene gets a large team, and the others take turns."""
    team, even, step = Team(256, 3, 4), np.full(145, 4_000), np.ones(145)
    assert divided(even, step, 264, team) == (88, 3)
    large = np.where(np.arange(145) < 6, 16_000, 3_000)
    teams, blocks = divided(large, step, 264, team)
    assert 20 <= teams <= 60 and blocks == 264 // teams
    longer, more = divided(large, np.where(np.arange(145) < 6, 5.0, 1.0), 264, team)
    assert longer < teams and more == 264 // longer
    assert divided(even, step * 0, 264, team) == (88, 3)
    assert divided(large, step, 264, Team(256)) == (145, 1)
    assert divided(large[:9], step[:9], 264, Team(128, 29)) == (9, 29)


def test_blocks_that_are_not_at_work_at_once(monkeypatch):
    """Three blocks on two threads would wait for ever. All of them end, a warning reports it, and each substep becomes
    a launch, with the same result."""
    monkeypatch.setattr(solver, "_teams_at_once", lambda device, team: 1)
    monkeypatch.setattr(team_launch, "PATIENCE", (10_000, 10_000))
    scenes = [MOVING, HEAVY]  # of which kernels are compiled already
    expected, _ = simulated(scenes, frames=4)
    with pytest.warns(RuntimeWarning, match="does not run the 3 blocks of 1 threads of a scene concurrently"):
        found, _ = simulated(scenes, frames=4, team=Team(1, 3, 1))
    assert np.array_equal(found.position_TN3, expected.position_TN3)


def test_more_than_runs(monkeypatch):
    """Blocks that would wait for ever, and a batch beyond the range of int32, are refused with the remedy."""
    with pytest.raises(ConfigError, match=r"team.blocks must be at most 2, .*, got 3"):
        simulate([mixed(1, 0, (0, 0, 0))], CONFIG, 2, 60.0, team=Team(1, 3))
    monkeypatch.setattr(team_launch, "MAXIMUM_PARTICLES", 10)
    with pytest.raises(ConfigError, match=r"at most 10 particles, got 11 of 1 scenes; lower scenes_per_launch"):
        simulate([mixed(11, 0, (0, 0, 0))], CONFIG, 2, 60.0, team=Team(1))
