"""Scenes of reports: bodies of one material, parts of scenes, and joined scenes.

Shape legend: N particles.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hgn.scene.scene import Scene

PARTICLES_PER_CELL = 8


def random_places(size_cells: Sequence[float], seed: int = 0) -> np.ndarray:
    """Draws places in a box with a corner at 0, eight a cell, in cells."""
    count = max(1, round(PARTICLES_PER_CELL * float(np.prod(size_cells))))
    return np.random.default_rng(seed).random((count, 3)) * np.asarray(size_cells)


def filled(material: int, position_N3: np.ndarray, velocity_3: Sequence[float] | np.ndarray, **more: Any) -> Scene:
    """Returns particles of one material and velocity; `more` are fields of Scene."""
    count = len(position_N3)
    velocity_N3 = np.tile(np.asarray(velocity_3, np.float32), (count, 1))
    return Scene(np.asarray(position_N3).astype(np.float32), velocity_N3, np.full(count, material, np.uint8), **more)


def with_friction(scene: Scene, friction: float) -> Scene:
    """Returns the scene with this friction of all obstacles."""
    return replace(scene, obstacles=tuple(replace(obstacle, friction=friction) for obstacle in scene.obstacles))


def joined(scenes: Sequence[Scene]) -> Scene:
    """Returns the first scene with the particles of all."""
    names = ("position_N3", "velocity_N3", "material_N")
    whole: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in scenes]) for name in names}
    return replace(scenes[0], **whole)
