"""Funnels: four tilted squares around a hole, with groups above it.

Numbers are sums, products, quotients and square roots of drawn numbers, so they have the same bits on every machine.
Shape legend: P points.
"""

from dataclasses import dataclass

import numpy as np

from hgn.config import SceneConfig
from hgn.scene.group import random_direction
from hgn.scene.kinds import FUNNEL_HEIGHT, FUNNEL_SQUARES
from hgn.scene.rotation import quaternion_product, quaternion_rotation
from hgn.schema import Vector

Quaternion = tuple[float, float, float, float]

STEEPEST = 0.87  # largest sine of the slope, that of 60 degrees; the smallest is 0
CAUGHT = 0.5  # inner fraction of a square's horizontal width; groups are placed above it


@dataclass(frozen=True)
class Funnel:
    """The positions of a funnel's parts relative to the centre of its hole. Domain units."""

    size: float  # side of the four squares
    quaternion: tuple[Quaternion, ...]  # rotation of each square
    centre_43: np.ndarray
    low_3: np.ndarray  # lowest corner of the space for groups, in the funnel's axes, with y against gravity
    high_3: np.ndarray
    rotation_33: np.ndarray  # rotation from the funnel's axes to the scene's
    extent_P3: np.ndarray  # points that must be in the domain: corners of the squares, and points below and above


def draw_funnel(config: SceneConfig, gravity: Vector, rng: np.random.Generator) -> Funnel:
    """Draws a funnel: width of the hole, size of the squares, sine of their slope and turn about gravity.

    Each is uniform in its range. Gravity must not be zero.
    """
    (narrow, wide), (small, large) = config.funnel_hole, FUNNEL_SQUARES
    below, above = (config.group_size * size for size in FUNNEL_HEIGHT)
    hole_part, size_part, slope_part = rng.random(3).tolist()
    hole_width = narrow + (wide - narrow) * hole_part
    size = config.obstacle_size[1] * (small + (large - small) * size_part)
    sine = STEEPEST * slope_part
    turn_w, turn_y = random_direction(rng, 2).tolist()
    upright = quaternion_product(_upwards(gravity), (turn_w, 0.0, turn_y, 0.0))
    quaternions, centre_43 = funnel_squares(hole_width, size, sine, upright)
    rotation_33 = quaternion_rotation(upright)
    extent = [-below * rotation_33[:, 1], above * rotation_33[:, 1]]
    for quaternion, centre_3 in zip(quaternions, centre_43, strict=True):
        along_3, _, across_3 = 0.5 * size * quaternion_rotation(quaternion).T
        extent += [centre_3 + a * along_3 + b * across_3 for a in (-1, 1) for b in (-1, 1)]
    caught = 0.5 * hole_width + CAUGHT * size * float(np.sqrt(1 - sine * sine))
    low_3, high_3 = np.array([-caught, 0.0, -caught]), np.array([caught, above, caught])
    return Funnel(size, quaternions, centre_43, low_3, high_3, rotation_33, np.stack(extent))


def funnel_squares(
    hole_width: float, size: float, sine: float, upright: Quaternion = (1.0, 0.0, 0.0, 0.0)
) -> tuple[tuple[Quaternion, ...], np.ndarray]:
    """Rotations and centres, float64 [4, 3], of squares of that size that leave a square hole of that width about the
    origin and rise outwards; `sine` is that of their slope, `upright` turns the y axis upwards."""
    cosine = float(np.sqrt(1 - sine * sine))
    half_cosine = float(np.sqrt((1 + cosine) / 2))  # of half the slope's angle, as quaternions have it
    slope = (half_cosine, 0.0, 0.0, sine / (2 * half_cosine))
    quarter = (float(np.sqrt(0.5)), 0.0, float(np.sqrt(0.5)), 0.0)
    turned, quaternions, centres = upright, [], []
    for _ in range(4):
        quaternions.append(quaternion_product(turned, slope))
        outwards_3, up_3, _ = quaternion_rotation(turned).T
        centres.append((0.5 * hole_width + 0.5 * size * cosine) * outwards_3 + 0.5 * size * sine * up_3)
        turned = quaternion_product(turned, quarter)
    return tuple(quaternions), np.stack(centres)


def _upwards(gravity: Vector) -> Quaternion:
    """Turns the y axis against gravity, by the shortest way."""
    up_3 = -np.array(gravity)
    x, y, z = (up_3 / np.sqrt((up_3 * up_3).sum())).tolist()
    if y < -1 + 1e-6:
        return (0.0, 1.0, 0.0, 0.0)  # half a turn about x
    scale = float(np.sqrt(2 + 2 * y))
    return (scale / 2, z / scale, 0.0, -x / scale)
