"""Rotations of points by plain sums and products, so that results do not depend on a BLAS library."""

import math
from collections.abc import Sequence

import numpy as np

from hgn.schema import Vector

_QUARTER_TURNS = {0.0: (1.0, 0.0), 90.0: (0.0, 1.0), 180.0: (-1.0, 0.0), 270.0: (0.0, -1.0)}


def quaternion_rotation(quaternion: tuple[float, float, float, float]) -> np.ndarray:
    """Returns the rotation matrix, float64 [3, 3], of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_product(
    left: tuple[float, float, float, float], right: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    """Returns the quaternion (w, x, y, z) of the rotation by `right` and then by `left`."""
    (a, b, c, d), (e, f, g, h) = left, right
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


def euler_rotation(degrees: Vector) -> np.ndarray:
    """Returns the matrix, float64 [3, 3], of turns in degrees about the fixed x axis, then y, then z.

    Quarter turns are exact, so an axis-aligned mesh stays axis-aligned.
    """
    return euler_rotations([degrees])[0]


def euler_rotations(degrees_T3: Sequence[Sequence[float]]) -> np.ndarray:
    """Returns the matrices of `euler_rotation`, float64 [T, 3, 3]."""
    matrix_T33 = np.tile(np.eye(3), (len(degrees_T3), 1, 1))
    for axis in range(3):
        pair_T2 = np.array([_cosine_sine(degrees[axis]) for degrees in degrees_T3])
        turn_T33 = np.tile(np.eye(3), (len(degrees_T3), 1, 1))
        first, second = (axis + 1) % 3, (axis + 2) % 3
        turn_T33[:, first, first], turn_T33[:, first, second] = pair_T2[:, 0], -pair_T2[:, 1]
        turn_T33[:, second, first], turn_T33[:, second, second] = pair_T2[:, 1], pair_T2[:, 0]
        x, y, z = (turn_T33[:, :, k, None] * matrix_T33[:, k, None, :] for k in range(3))
        matrix_T33 = x + y + z
    return matrix_T33


def _cosine_sine(degrees: float) -> tuple[float, float]:
    reduced = math.fmod(degrees, 360.0) % 360.0
    radians = math.radians(reduced)
    return _QUARTER_TURNS.get(reduced, (math.cos(radians), math.sin(radians)))


def rotate(point_P3: np.ndarray, rotation_33: np.ndarray) -> np.ndarray:
    """Multiplies each row by the matrix from the left, float64 [P, 3]."""
    x, y, z = point_P3[:, 0], point_P3[:, 1], point_P3[:, 2]
    return np.stack([row[0] * x + row[1] * y + row[2] * z for row in rotation_33], axis=1)


def round_to_float32(point_P3: np.ndarray) -> np.ndarray:
    """Rounds to float32 values, as float64. Differences in the last bits between maths libraries disappear."""
    return point_P3.astype(np.float32).astype(np.float64)
