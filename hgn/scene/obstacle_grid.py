"""Obstacles as the network sees them: one mean normal in each grid cell that an obstacle passes through.

Paper sec. 3: sample the surface with points no closer than cell_size / 4, flip each sample's normal where it
points away from the centre of its cell, sum per cell, normalise. Stored sparsely.
Shape legend: K obstacle cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class ObstacleGrid:
    """Sparse cells with unit normals; cell k spans [k, k + 1) * cell_size."""

    cell_size: float
    cell_K3: np.ndarray  # int32, unique rows, lexicographically sorted
    normal_K3: np.ndarray  # float32, unit length
