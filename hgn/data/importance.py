"""Samples frames by importance, their acceleration, with loss weights that keep the expected loss unchanged.

Most of the error arises in the few frames with collisions. Importance sampling (Kahn & Marshall 1953; for gradients
Katharopoulos & Fleuret 2018) draws those frames more often, with smaller loss weights.
Shape legend: T frames, N particles, F = T - 1 frames with a successor.
"""

from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hgn.scene.episode import Episode
from hgn.scene.history import frames_before

PARTICLES = 512  # accelerations are computed from about this number of an episode's particles


@dataclass(frozen=True, eq=False)
class DrawnBySize:
    """Draws from F items by size, with weights that keep the mean over draws unbiased."""

    cumulative_F: np.ndarray  # float64, ends with 1
    weight_F: np.ndarray  # inverse of the relative frequency; 1 for uniform draws

    @staticmethod
    def of(size_F: np.ndarray, fraction: float) -> "DrawnBySize":
        """Returns a distribution that draws a `fraction` in proportion to size, and the rest uniformly."""
        total = size_F.sum()
        often_F = (1 - fraction) + fraction * (size_F * len(size_F) / total if total > 0 else np.ones(len(size_F)))
        cumulative_F = often_F.cumsum()
        return DrawnBySize(cumulative_F / cumulative_F[-1:], 1 / often_F)

    def at(self, place: float) -> tuple[int, float]:
        """Returns the item at the quantile `place` in [0, 1), and its weight."""
        cumulative, weights = self._lists
        number = min(bisect_right(cumulative, place), len(cumulative) - 1)
        return number, weights[number]

    @cached_property
    def _lists(self) -> tuple[list[float], list[float]]:
        """Returns the same numbers as lists, because access to one number is faster in a list than in an array."""
        return self.cumulative_F.tolist(), self.weight_F.tolist()


@dataclass(frozen=True, eq=False)
class FrameImportance:
    """Draws from the F frames of an episode."""

    draws: DrawnBySize
    acceleration_F: np.ndarray  # root mean square over axes and particles

    @staticmethod
    def of(episode: Episode, fraction: float) -> "FrameImportance":
        """Returns a distribution that draws a `fraction` in proportion to rms acceleration, and the rest uniformly."""
        step = max(1, episode.particle_count // PARTICLES)
        past_1N3 = frames_before(episode, -1)[:, ::step]
        position_TN3 = np.concatenate([past_1N3, episode.position_TN3[:, ::step]], dtype=np.float64)
        square_FN3 = np.diff(position_TN3, 2, axis=0) ** 2
        size_F = np.sqrt(square_FN3.mean(axis=(1, 2))) if square_FN3.size else np.zeros(len(square_FN3))
        return FrameImportance(DrawnBySize.of(size_F, fraction), size_F)

    def draw(self, slot: int, seed: int) -> tuple[int, float]:
        """Returns the frame for sample number `slot` of F, and its loss weight.

        Draws are stratified: each slot has its own 1 / F of the quantiles, and `seed` chooses the quantile in it.
        """
        return self.draws.at((slot + _fraction(seed)) / len(self.acceleration_F))

    @cached_property
    def accelerations(self) -> list[float]:
        """Returns the root mean square acceleration of each frame, domain units per frame squared."""
        return self.acceleration_F.tolist()


def _fraction(seed: int) -> float:
    """Returns a number in [0, 1) by Fibonacci hashing, independent of noise and symmetry for the same seed."""
    return (seed * 0x9E3779B97F4A7C15 % (1 << 64) >> 11) / (1 << 53)
