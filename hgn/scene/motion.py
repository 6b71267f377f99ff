"""Motion of obstacles: interpolation between poses at keyframes.

Shape legend: T keyframes, P points, B boxes.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hgn.scene.rotation import rotate
from hgn.schema import Vector, require

LEAST_S = 1e-9  # least time between two keyframes, in seconds; in less an obstacle's speed could be infinite
FARTHEST = 1000.0  # largest translation of a keyframe, domain units: networks follow the cells on its path
SOME_POINTS = 100_000  # number of points for which motions are computed together
TURN_STEPS = 16  # steps in which boxes follow a turn between two keyframes
UNIT = 1e-6  # largest difference of a rotation's product with its transpose from the identity
Keyframes = Sequence[tuple[float, Vector]]  # times in seconds and translations in domain units


@dataclass(frozen=True, eq=False)
class Motion:
    """Rigid motion: rotation about `pivot`, then translation, relative to the pose in the scene.

    Between keyframes translation is linear, and angular velocity is constant along the shorter way. Before the first
    and after the last keyframe the obstacle is at rest.
    """

    time_T: np.ndarray  # float64, seconds, increasing
    translation_T3: np.ndarray  # float64, domain units
    rotation_T33: np.ndarray  # float64
    pivot: Vector

    def __post_init__(self) -> None:
        times = np.asarray(self.time_T, np.float64)
        ordered = len(times) > 0 and bool(np.isfinite(times).all() and (np.diff(times) >= LEAST_S).all())
        require(ordered, "keyframes", f"in order of time and {LEAST_S:g} s apart", times.tolist())
        require(times[0] >= 0, "keyframes", "at times >= 0", times.tolist())
        farthest = float(np.abs(self.translation_T3).max())
        require(farthest <= FARTHEST, "keyframes.translation", f"at most {FARTHEST:g} domain units", farthest)
        rotation_T33 = np.asarray(self.rotation_T33, np.float64)
        near = bool(np.abs(rotation_T33).max() < 2)  # products of larger numbers may overflow
        away_T33 = rotation_T33 @ rotation_T33.transpose(0, 2, 1) - np.eye(3) if near else np.ones(1)
        upright = np.abs(away_T33).max() < UNIT and bool((np.linalg.det(rotation_T33) > 0).all())
        require(upright, "keyframes.rotation", "rotation matrices", float(rotation_T33.flat[0]))

    @staticmethod
    def of_frames(keyframes: Keyframes, pivot: Vector) -> Motion:
        """Returns a motion without rotation: times in seconds with translations in domain units."""
        times, translations = zip(*keyframes, strict=True)
        rotation_T33 = np.tile(np.eye(3), (len(times), 1, 1))
        return Motion(np.array(times, np.float64), np.array(translations, np.float64), rotation_T33, pivot)

    def pose(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns rotation, float64 [3, 3], and translation, float64 [3], at a time in seconds."""
        last = len(self.time_T) - 1
        after = int(np.searchsorted(self.time_T, time, side="right"))
        if after == 0 or after > last:
            at = min(after, last)
            return self.rotation_T33[at], self.translation_T3[at]
        fraction = (time - self.time_T[after - 1]) / (self.time_T[after] - self.time_T[after - 1])
        turn = turning(self.rotation_T33[after] @ self.rotation_T33[after - 1].T)
        begin, end = self.translation_T3[after - 1], self.translation_T3[after]
        return turned(fraction * turn) @ self.rotation_T33[after - 1], begin + fraction * (end - begin)

    def place(self, point_P3: np.ndarray, time: float) -> np.ndarray:
        """Returns the positions of the obstacle's points at a time, float64 [P, 3]."""
        rotation, translation = self.pose(time)
        return rotate(np.asarray(point_P3, np.float64) - self.pivot, rotation) + self.pivot + translation

    def transform(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns R, float64 [3, 3], and t, float64 [3], that map a point x of the obstacle to R x + t at a time."""
        return self.pose(time)[0], self.place(np.zeros((1, 3)), time)[0]

    def boxes(self, point_P3: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns low and high corners, float64 [B, 3], of boxes one of which contains the points at any time."""
        corner_83 = np.array(list(itertools.product(*zip(point_P3.min(axis=0), point_P3.max(axis=0), strict=True))))
        steps = TURN_STEPS if np.ptp(self.rotation_T33, axis=0).any() else 1
        before = np.maximum(np.arange(len(self.time_T)) - 1, 0)  # the first boxes are those of the first pose
        begin_T33, begin_T3 = self.rotation_T33[before], self.translation_T3[before]
        turn_T3 = turning(self.rotation_T33 @ begin_T33.transpose(0, 2, 1))
        fraction_S11 = np.linspace(0, 1, steps + 1)[:, None, None]
        turn_TS33 = turned((turn_T3[:, None] * fraction_S11[:, 0]).reshape(-1, 3)).reshape(len(before), -1, 3, 3)
        way_TS13 = begin_T3[:, None, None] + fraction_S11 * (self.translation_T3 - begin_T3)[:, None, None]
        rotation_TS33 = turn_TS33 @ begin_T33[:, None]
        place_TS83 = (corner_83 - self.pivot) @ rotation_TS33.swapaxes(2, 3) + self.pivot + way_TS13
        place_B83 = place_TS83.reshape(-1, 8, 3)
        # largest distance of an arc from its chord; a turn between keyframes is at most pi
        arc = np.linalg.norm(corner_83 - self.pivot, axis=1).max() * (np.pi / steps) ** 2 / 8 if steps > 1 else 0.0
        low_B3, high_B3 = place_B83.min(axis=1) - arc, place_B83.max(axis=1) + arc
        return np.minimum(low_B3[:-1], low_B3[1:]), np.maximum(high_B3[:-1], high_B3[1:])

    def fastest(self, point_P3: np.ndarray) -> float:
        """Returns the largest mean speed of points of the obstacle between two keyframes, domain units per second."""
        turn_T33, way_T3 = np.diff(self.rotation_T33, axis=0), np.diff(self.translation_T3, axis=0)
        interval_T, fastest = np.diff(self.time_T)[:, None], 0.0
        step = 1 + SOME_POINTS // max(1, len(point_P3))  # all motions of all points could fill memory
        for part in (slice(begin, begin + step) for begin in range(0, len(way_T3), step)):
            way_TP3 = (point_P3 - self.pivot) @ turn_T33[part].transpose(0, 2, 1) + way_T3[part, None]
            fastest = max(fastest, float((np.linalg.norm(way_TP3, axis=2) / interval_T[part]).max(initial=0)))
        return fastest


AT_REST = Motion.of_frames([(0.0, (0.0, 0.0, 0.0))], (0.0, 0.0, 0.0))


def turning(rotation: np.ndarray) -> np.ndarray:
    """Returns the axis of a rotation [..., 3, 3] times its angle in radians, at most pi, float64 [..., 3]."""
    from scipy.spatial.transform import Rotation  # here, because it takes 0.1 s and few scenes have motions

    return Rotation.from_matrix(rotation).as_rotvec()


def turned(turn: np.ndarray) -> np.ndarray:
    """Returns the rotation, float64 [..., 3, 3], about an axis by its length in radians."""
    from scipy.spatial.transform import Rotation  # as in `turning`

    return Rotation.from_rotvec(turn).as_matrix()
