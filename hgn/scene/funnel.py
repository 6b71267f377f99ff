"""Funnels: four tilted squares that leave a hole, with the groups above it.

All numbers are sums, products, quotients and square roots of what is drawn, so that they are the same bits on every
machine. Shape legend: P points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hgn.config import FUNNEL_HEIGHT, FUNNEL_SQUARES, SceneConfig
from hgn.scene.group import points_in_ball
from hgn.scene.rotation import quaternion_product, quaternion_rotation
from hgn.schema import Vector

Quaternion = tuple[float, float, float, float]

STEEPEST = 0.87  # sine of the slope, drawn from 0 on: 60 degrees
CAUGHT = 0.5  # of a square's width over the ground: groups are placed above that inner part


@dataclass(frozen=True)
class Funnel:
    """Where its parts are, from the middle of its hole. Domain units."""

    hole_width: float  # side of the square that is left free
    size: float  # side of the four squares
    quaternion: tuple[Quaternion, ...]  # of each square
    centre_43: np.ndarray
    low_3: np.ndarray  # of where groups are placed, in the funnel's axes, y against gravity
    high_3: np.ndarray
    rotation_33: np.ndarray  # from the funnel's axes
    extent_P3: np.ndarray  # corners of the squares, and points below and above: all must be in the domain


def draw_funnel(config: SceneConfig, gravity: Vector, rng: np.random.Generator) -> Funnel:
    """Width of the hole, size of the squares, sine of their slope and turn about gravity, each uniform in its range.
    Gravity must not be zero.
    """
    (narrow, wide), (small, large) = config.funnel_hole, FUNNEL_SQUARES
    below, above = (config.group_size * size for size in FUNNEL_HEIGHT)
    hole_part, size_part, slope_part = rng.random(3).tolist()
    hole_width = narrow + (wide - narrow) * hole_part
    size = config.obstacle_size[1] * (small + (large - small) * size_part)
    sine = STEEPEST * slope_part
    cosine = float(np.sqrt(1 - sine * sine))
    half_cosine = float(np.sqrt((1 + cosine) / 2))  # of half the slope's angle, as quaternions have it
    slope = (half_cosine, 0.0, 0.0, sine / (2 * half_cosine))
    upright = quaternion_product(_upwards(gravity), _turn(rng))
    quarter = (float(np.sqrt(0.5)), 0.0, float(np.sqrt(0.5)), 0.0)
    rotation_33, turned, quaternions, centres = quaternion_rotation(upright), upright, [], []
    extent = [-below * rotation_33[:, 1], above * rotation_33[:, 1]]
    for _ in range(4):
        quaternions.append(quaternion_product(turned, slope))
        outwards_3, up_3, _ = quaternion_rotation(turned).T
        centres.append((0.5 * hole_width + 0.5 * size * cosine) * outwards_3 + 0.5 * size * sine * up_3)
        along_3, _, across_3 = 0.5 * size * quaternion_rotation(quaternions[-1]).T
        extent += [centres[-1] + a * along_3 + b * across_3 for a in (-1, 1) for b in (-1, 1)]
        turned = quaternion_product(turned, quarter)
    caught = 0.5 * hole_width + CAUGHT * size * cosine
    low_3, high_3 = np.array([-caught, 0.0, -caught]), np.array([caught, above, caught])
    return Funnel(hole_width, size, tuple(quaternions), np.stack(centres), low_3, high_3, rotation_33, np.stack(extent))


def _upwards(gravity: Vector) -> Quaternion:
    """Turns the y axis against gravity, by the shortest way."""
    up_3 = -np.array(gravity)
    x, y, z = (up_3 / np.sqrt((up_3 * up_3).sum())).tolist()
    if y < -1 + 1e-6:
        return (0.0, 1.0, 0.0, 0.0)  # half a turn about x
    scale = float(np.sqrt(2 + 2 * y))
    return (scale / 2, z / scale, 0.0, -x / scale)


def _turn(rng: np.random.Generator) -> Quaternion:
    """About the y axis, uniform."""
    while True:
        first, second = points_in_ball(1, 2, rng)[0].tolist()
        length = float(np.sqrt(first * first + second * second))
        if length > 0.1:  # dividing by less would magnify rounding
            return (first / length, 0.0, second / length, 0.0)
