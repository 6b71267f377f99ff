"""Extreme scenes, each with a defined result; more are in test_solver, test_collider, test_constitutive, test_team."""

import numpy as np
import pytest
from mpm_scenes import CELL, CONFIG, assert_inside, beside, particles, simulated

from datagen.mpm.solver import SceneFailure, simulate
from hgn.config import MpmConfig
from hgn.scene.material import SAND, SNOW, WATER
from hgn.scene.scene import Scene
from hgn.schema import ConfigError


@pytest.mark.parametrize("distance", [1000.0, -1000.0])
def test_a_scene_a_thousand_away(distance):
    """Coordinates are the scene's own, from 0: particles 1,000 away are refused with the bounds and what to do."""
    place = np.full((4, 3), 0.5)
    place[:, 0] += distance
    with pytest.raises(ConfigError, match=r"position_N3 of scene 0 .* within the walls.*move the particles"):
        simulate([particles(place)], CONFIG, 2, 60.0)


def test_the_far_end_of_a_long_domain():
    """Water 1,000 cells from the origin splashes as it does near it, but for the rounding of its coordinates."""
    place = np.random.default_rng(0).uniform(0, 2, (64, 3)) + np.array([8, 3, 4])
    paths = []
    for shift in (0, 1000):
        away = np.array([shift, 0, 0])
        domain = (1020 * CELL, 10 * CELL, 10 * CELL)
        scene = particles((place + away) * CELL, WATER, (0, -2, 0), domain_size=domain)
        (outcome,) = simulated([scene], frames=4)
        paths.append(outcome.position_TN3.astype(float) - away * CELL)
    assert np.abs(paths[1] - paths[0]).max() < 0.01 * CELL


@pytest.mark.parametrize("material", [WATER, SAND, SNOW])
def test_several_cells_a_substep(material):
    """At 1,000 m/s the adaptive step crosses 0.3 cells at most; a fixed one of five cells stops the scene or leaves all
    particles inside, never out of range.
    """
    place = np.random.default_rng(1).uniform(0, 2, (64, 3)) * CELL + 0.45
    scene = particles(place, material, (300, -950, 0))
    outcome, _ = simulated([scene, beside()], rate_hz=960.0)
    assert_inside(outcome.position_TN3, scene)
    assert outcome.counters["smallest_time_step_s"] <= 0.3 * CELL / 990
    fixed = MpmConfig(device="cpu", time_step="fixed")
    scenes = [scene, particles(place, material, (0, 1000, 0))]
    for outcome in simulate([*scenes, beside()], fixed, 3, 60.0)[:2]:
        if isinstance(outcome, SceneFailure):
            assert outcome.cause.startswith("frame ")
        else:
            assert_inside(outcome.position_TN3, scene)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite(bad):
    """A position or velocity that is NaN or infinite is refused with the particle's index; so is gravity."""
    place = np.full((3, 3), 0.5, np.float32)
    for field in ("position_N3", "velocity_N3"):
        values = {"position_N3": place.copy(), "velocity_N3": np.zeros((3, 3), np.float32)}
        values[field][1, 2] = bad
        with pytest.raises(ConfigError, match=f"{field} must be finite.*particle 1"):
            Scene(**values, material_N=np.zeros(3, np.uint8), cell_size=CELL)
    with pytest.raises(ConfigError, match="gravity of scene 0 must be finite"):
        simulate([particles(place, gravity=(0.0, bad, 0.0))], CONFIG, 2, 60.0)
