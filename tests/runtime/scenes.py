"""Scenes that simulations of the tests begin with."""

from dataclasses import replace

import numpy as np
from network.states import random_grid

from hgn.runtime.simulator import InitialState
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.scene.own_physics import NOMINAL_P

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


def rough(start):
    """The scene with friction of walls and obstacle cells, and parameters of its own."""
    grid, count, rng = start.obstacle_grid, len(start.position_N3), np.random.default_rng(1)
    grid = replace(grid, friction_K=rng.random(len(grid.cell_K3)).astype(np.float32))
    value_NP = (np.array(NOMINAL_P) + rng.random((count, len(NOMINAL_P)))).astype(np.float32)
    return replace(start, obstacle_grid=grid, wall_friction=(0.2, 0.9, 0.4), parameters=value_NP)
