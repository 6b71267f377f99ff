"""Defines the scenes of the solver's tests, on a grid of 16 cells a side. Only tests that simulate load the solver."""

import dataclasses

import numpy as np

from hgn.config import MpmConfig
from hgn.scene.scene import Obstacle, Scene

CELL = 1 / 16
CONFIG = MpmConfig(device="cpu")
QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
_SIDES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
BOX = np.array([triangle for a, b, c, d in _SIDES for triangle in ((a, b, c), (a, c, d))], np.int32)


def particles(place_N3, material=0, velocity=(0, 0, 0), **scene):
    """A scene of particles at these places; material and velocity are those of all, or of each."""
    place_N3 = np.asarray(place_N3, np.float32).reshape(-1, 3)
    velocity_N3 = np.broadcast_to(np.float32(velocity), place_N3.shape).copy()
    material_N = np.broadcast_to(np.asarray(material, np.uint8), len(place_N3)).copy()
    return Scene(place_N3, velocity_N3, material_N, **({"cell_size": CELL} | scene))


def block(material, low, high, velocity=(0, 0, 0), seed=0, count=0, **scene):
    """A box of particles at random places, eight a cell unless `count` is given."""
    low, high = np.array(low), np.array(high)
    count = count or int(8 * np.prod((high - low) / CELL))
    return particles(np.random.default_rng(seed).uniform(low, high, (count, 3)), material, velocity, **scene)


def joined(*scenes, **changes):
    """The particles of all, and what else the first one has."""
    names = ("position_N3", "velocity_N3", "material_N")
    arrays = {name: np.concatenate([getattr(scene, name) for scene in scenes]) for name in names}
    return dataclasses.replace(scenes[0], **arrays, **changes)


def sheet(height, low=0.0, high=1.0):
    """A level one at this height, its normal down."""
    corner = [[low, height, low], [high, height, low], [high, height, high], [low, height, high]]
    return Obstacle("sheet", np.array(corner, float), QUAD, False)


def box_corners(low, high):
    """[8, 3] of the triangles BOX: corner number is 4 x + 2 y + z."""
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])], float)


def simulated(scenes, config=CONFIG, frames=2, rate_hz=60.0, **options):
    """What the solver makes of each scene; none may fail."""
    from datagen.mpm.solver import Simulated, simulate

    outcomes = simulate(scenes, config, frames, rate_hz, **options)
    failures = [outcome for outcome in outcomes if not isinstance(outcome, Simulated)]
    assert not failures, failures
    return outcomes


def assert_inside(position_TN3, scene, config=CONFIG):
    """All particles, in all frames, are finite and between the walls."""
    from datagen.mpm.solver import particle_bounds

    low, high = particle_bounds(scene, config)
    assert ((position_TN3 >= low) & (position_TN3 <= high)).all()
