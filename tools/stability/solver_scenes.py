"""The scenes of the stability report: blocks and single particles above the floor of a domain of one unit.

Shape legend: N particles.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hgn.scene.scene import Obstacle, Scene

CELL = 1 / 64
FLOOR_CELLS = 3  # nodes below it belong to the walls
PARTICLES_PER_CELL = 8


def block(
    material: int,
    low_cells: Sequence[float],
    size_cells: Sequence[float],
    velocity: Sequence[float] = (0.0, 0.0, 0.0),
    seed: int = 0,
    obstacles: tuple[Obstacle, ...] = (),
    gravity: tuple[float, float, float] = (0.0, -9.8, 0.0),
) -> Scene:
    """A box of particles at random places, eight a cell; corner and size in cells of the default grid."""
    count = max(1, round(PARTICLES_PER_CELL * float(np.prod(size_cells))))
    place = np.random.default_rng(seed).uniform(0, 1, (count, 3)) * np.asarray(size_cells) + np.asarray(low_cells)
    return particles(material, place, velocity, obstacles, gravity)


def particles(
    material: int,
    place_N3: np.ndarray,
    velocity: Sequence[float] = (0.0, 0.0, 0.0),
    obstacles: tuple[Obstacle, ...] = (),
    gravity: tuple[float, float, float] = (0.0, -9.8, 0.0),
) -> Scene:
    """Particles of one material and velocity at the given places, in cells."""
    count = len(place_N3)
    return Scene(
        position_N3=(np.asarray(place_N3) * CELL).astype(np.float32),
        velocity_N3=np.tile(np.asarray(velocity, np.float32), (count, 1)),
        material_N=np.full(count, material, np.uint8),
        obstacles=obstacles,
        cell_size=CELL,
        gravity=gravity,
    )


def thickness_cells(position_N3: np.ndarray) -> float:
    """From the lowest to the highest particle, twentieths at each end left out."""
    low, high = np.quantile(position_N3[:, 1], (0.05, 0.95))
    return float(high - low) / CELL


def height_cells(position_N3: np.ndarray) -> float:
    """How high above the last node of the floor's walls the uppermost twentieth begins."""
    return float(np.quantile(position_N3[:, 1], 0.95)) / CELL - (FLOOR_CELLS - 1)


def centre_cells(position_N3: np.ndarray) -> float:
    """The centre's height above the last node of the floor's walls."""
    return float(position_N3[:, 1].mean()) / CELL - (FLOOR_CELLS - 1)


def front_cells(position_N3: np.ndarray) -> float:
    """How far from the last wall node the foremost hundredth begins."""
    return float(np.quantile(position_N3[:, 0], 0.99)) / CELL - (FLOOR_CELLS - 1)
