"""Blocks above the floor of a domain of one unit, and their measures.

Shape legend: T frames, N particles.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from datagen.mpm.solver import SceneFailure, Simulated
from hgn.scene.scene import Scene
from tools.scenes import filled, random_places

CELL = 1 / 64
# of obstacles, degrees about x, y and z
ORIENTATIONS = {"aligned": (0.0, 0.0, 0.0), "tilted": (27.0, 0.0, 13.0), "turned over": (180.0, 40.0, 0.0)}


def block(
    material: int,
    low_cells: Sequence[float],
    size_cells: Sequence[float],
    velocity: Sequence[float] = (0.0, 0.0, 0.0),
    seed: int = 0,
    **more: Any,
) -> Scene:
    """Returns a box of particles at random places, eight a cell; corner and size are in cells of the default grid."""
    return filled(material, (random_places(size_cells, seed) + np.asarray(low_cells)) * CELL, velocity, **more)


def positions(outcome: Simulated | SceneFailure) -> np.ndarray:
    """Returns a scene's trajectory, float32 [T, N, 3]. Raises: RuntimeError if the solver stopped it."""
    if isinstance(outcome, SceneFailure):
        raise RuntimeError(f"a scene was stopped: {outcome.cause}")
    return outcome.position_TN3


def rms_speed(path_TN3: np.ndarray, rate_hz: float) -> float:
    """Returns the root mean square speed over particles and frames, domain units per second."""
    return float(np.sqrt((np.diff(path_TN3.astype(np.float64), axis=0) ** 2).sum(axis=2).mean())) * rate_hz
