"""Measures of trajectories: momentum, energy, density, and particles outside of the domain.

All are in frame units: domain units a frame for velocities, domain units a frame squared for accelerations.
Shape legend: T frames, N particles.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

FRAMES_AT_ONCE = 50  # in float64


def momentum_error(path_TN3: np.ndarray, reference_TN3: np.ndarray) -> float:
    """Returns the root mean square, over frames, of the difference of mean velocities; 0 for a single frame."""
    if len(path_TN3) < 2:
        return 0.0
    reference_TN3 = reference_TN3[: len(path_TN3)]
    difference_T3 = np.diff(_mean_position(path_TN3) - _mean_position(reference_TN3), axis=0)
    return float(np.sqrt((difference_T3**2).sum(-1).mean()))


def _mean_position(path_TN3: np.ndarray) -> np.ndarray:
    """Returns float64 [T, 3]; axis by axis takes a seventh of the time."""
    return np.stack([path_TN3[..., axis].mean(1, dtype=np.float64) for axis in range(path_TN3.shape[2])], axis=-1)


def energies(path_TN3: np.ndarray, gravity_3: np.ndarray) -> np.ndarray:
    """Returns kinetic and potential energy per mass, v² / 2 - g · x, at the middle of each frame, float64 [T - 1].

    Gravity is in domain units a frame squared. Elastic energy is not included.
    """
    parts = [np.zeros(0)]
    for first in range(0, len(path_TN3) - 1, FRAMES_AT_ONCE):
        position_TN3 = path_TN3[first : first + FRAMES_AT_ONCE + 1].astype(np.float64)
        velocity_TN3 = np.diff(position_TN3, axis=0)
        middle_TN3 = 0.5 * (position_TN3[1:] + position_TN3[:-1])
        parts.append((0.5 * (velocity_TN3**2).sum(-1) - middle_TN3 @ gravity_3).mean(-1))
    return np.concatenate(parts)


def energy_scale(gravity_3: np.ndarray, domain_size: Sequence[float]) -> float:
    """Returns the energy per mass of a fall through the domain; 1 without gravity."""
    return float(np.abs(gravity_3) @ np.asarray(domain_size)) or 1.0


def neighbours(position_N3: np.ndarray, radius: float) -> float:
    """Returns the mean number of other particles within the radius of a particle."""
    if len(position_N3) == 0:
        return 0.0
    tree = cKDTree(position_N3)
    return float(tree.count_neighbors(tree, radius)) / len(position_N3) - 1
