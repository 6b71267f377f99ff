"""Computes mean and spread of velocity and acceleration, merged over episodes and shards.

Units are frame units, as in the network: v^n = x^n - x^(n-1), a^n = v^(n+1) - v^n.
Shape legend: T frames, N particles.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from hgn.schema import Vector, triple

_BLOCK_PARTICLES = 1 << 18  # number of particles times number of frames of a block
_ROWS_ABREAST = 512  # number of rows [3] that are summed side by side


@dataclass(frozen=True)
class Moments:
    """Holds count, mean and sum of squared deviations of 3-vectors, per axis, in float64.

    Merging follows Chan, Golub, LeVeque (1979), which loses no digits if the mean is far from zero.
    """

    count: int = 0
    mean: Vector = (0.0, 0.0, 0.0)
    squared_deviation: Vector = (0.0, 0.0, 0.0)

    @staticmethod
    def of(values: np.ndarray) -> Moments:
        """Returns the moments of an array [..., 3]."""
        flat = np.asarray(values, dtype=np.float64).reshape(-1, 3)
        if not len(flat):
            return Moments()
        mean = _sums(flat, np.zeros(3), 1) / len(flat)
        return Moments(len(flat), triple(mean), triple(_sums(flat, mean, 2)))

    def merge(self, other: Moments) -> Moments:
        """Returns the moments of the union."""
        if self.count == 0 or other.count == 0:
            return other if self.count == 0 else self
        count = self.count + other.count
        fraction, weight = other.count / count, self.count * other.count / count
        axes = list(zip(self.mean, other.mean, self.squared_deviation, other.squared_deviation, strict=True))
        x, y, z = (mean + (their_mean - mean) * fraction for mean, their_mean, _, _ in axes)
        u, v, w = (
            (squares + their_squares) + (their_mean - mean) * (their_mean - mean) * weight
            for mean, their_mean, squares, their_squares in axes
        )
        return Moments(count, (x, y, z), (u, v, w))

    @property
    def std(self) -> Vector:
        """Returns the standard deviation per axis (divided by the count); zero without values."""
        return triple(np.sqrt(np.array(self.squared_deviation) / max(self.count, 1)))


@dataclass(frozen=True)
class Statistics:
    """Holds moments of velocity (domain units per frame) and acceleration (domain units per frame squared)."""

    velocity: Moments = Moments()
    acceleration: Moments = Moments()

    def merge(self, other: Statistics) -> Statistics:
        return Statistics(self.velocity.merge(other.velocity), self.acceleration.merge(other.acceleration))


def episode_statistics(position_TN3: np.ndarray) -> Statistics:
    """Returns the statistics of one trajectory.

    Differences are computed in float64, over blocks of frames to limit memory. Blocks depend only on the number of
    particles, so the result does not depend on the division of a data set into shards.
    """
    frames, particles = position_TN3.shape[:2]
    block = max(2, _BLOCK_PARTICLES // max(particles, 1))
    statistics = Statistics()
    for first in range(0, frames - 1, block):
        # the velocities into frames first + 1 … first + block, and the velocity before them
        start = max(first - 1, 0)
        velocity = np.diff(np.asarray(position_TN3[start : first + block + 1], np.float64), axis=0)
        statistics = statistics.merge(
            Statistics(Moments.of(velocity[first - start :]), Moments.of(np.diff(velocity, axis=0)))
        )
    return statistics


def merge_statistics(parts: Iterable[Statistics]) -> Statistics:
    """Merges all parts in their order."""
    total = Statistics()
    for part in parts:
        total = total.merge(part)
    return total


def _sums(flat: np.ndarray, origin: np.ndarray, power: int) -> np.ndarray:
    """Returns the sum of (flat - origin)^power per axis. Rows are added in groups; short rows are slow in NumPy."""
    total = np.zeros(3)
    whole = len(flat) // _ROWS_ABREAST * _ROWS_ABREAST
    for part, abreast in ((flat[:whole], _ROWS_ABREAST), (flat[whole:], 1)):
        if len(part):
            offset = np.ascontiguousarray(part).reshape(-1, 3 * abreast) - np.tile(origin, abreast)
            sums = offset.sum(axis=0) if power == 1 else np.einsum("ij,ij->j", offset, offset)
            total = total + sums.reshape(abreast, 3).sum(axis=0)
    return total
