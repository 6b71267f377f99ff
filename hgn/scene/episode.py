"""An episode: one scene's simulated trajectory, as stored in shards and read by the trainer.

Shape legend: T frames, N particles, K obstacle cells.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hgn.scene.obstacle_grid import ObstacleGrid

SCHEMA_VERSION = 1


@dataclass(frozen=True, eq=False)
class Episode:
    """Frame 0 is the initial state, so T frames hold T - 1 steps of 1 / frame_rate_hz seconds."""

    key: str  # sample name inside the data set, without dots: train-000012
    position_TN3: np.ndarray  # float32, domain units
    initial_velocity_N3: np.ndarray  # float32, domain units per second
    material_N: np.ndarray  # uint8, index into MATERIALS
    obstacle_grid: ObstacleGrid
    domain_size: tuple[float, float, float]
    gravity: tuple[float, float, float]  # domain units per second squared
    frame_rate_hz: float
    seed: int
    specification: dict[str, Any]  # how the scene was made
    solver: dict[str, Any]  # settings and counters: substeps, projections, floors hit
    # per-particle material parameters that differ from the solver's defaults, float32 [N] by name
    material_parameters: dict[str, np.ndarray] = field(default_factory=dict)
