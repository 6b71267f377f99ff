"""Scenes that simulations of the tests begin with."""

import numpy as np
from network.states import random_grid

from hgn.runtime.simulator import InitialState
from hgn.scene.obstacle_grid import ObstacleGrid

GRAVITY = (0.0, -9.8, 0.0)
EMPTY_GRID = ObstacleGrid(1 / 64, np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))


def random_scene(particles, seed=0, low=0.05, size=0.1, **changes):
    """Particles of all materials in a cube, some of them in obstacle cells."""
    rng = np.random.default_rng(seed)
    values = {
        "position_N3": (low + size * rng.random((particles, 3))).astype(np.float32),
        "velocity_N3": rng.normal(0, 0.1, (particles, 3)).astype(np.float32),
        "material_N": rng.integers(0, 3, particles).astype(np.uint8),
        "obstacle_grid": random_grid(seed, 4_000),
        "domain_size": (1.0, 1.0, 1.0),
        "gravity": GRAVITY,
    }
    return InitialState(**(values | changes))
