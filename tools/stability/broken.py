"""Trajectories that are wrong on purpose: each row of the gallery must fail for at least one of them.

Shape legend: T frames, N particles.
"""

from collections.abc import Callable, Mapping

import numpy as np

from hgn.scene.scene import Scene

FLOOR_NODE = 2  # of the file's grid: the last that stops falling material
COMPRESSED = 0.6  # of the heights above the floor
DRIFT = (0.05, 0.02)  # domain units per second along x and z
STIR_CELLS = 0.15  # standard deviation of the displacement from the true place, anew in each frame
SQUEEZED = 0.8  # of the distances from the mean


def frozen(path_TN3: np.ndarray, scene: Scene, rate_hz: float) -> np.ndarray:
    """Repeats the first frame; particles that enter later stay where they enter."""
    first_N = np.isfinite(path_TN3[..., 0]).argmax(axis=0)
    start_N3 = path_TN3[first_N, np.arange(path_TN3.shape[1])]
    return np.where(np.isnan(path_TN3), path_TN3, start_N3)


def delayed(path_TN3: np.ndarray, scene: Scene, rate_hz: float) -> np.ndarray:
    """Plays at half speed."""
    return _played(path_TN3, 0.5)


def hurried(path_TN3: np.ndarray, scene: Scene, rate_hz: float) -> np.ndarray:
    """Plays at twice the speed, and stops."""
    return _played(path_TN3, 2.0)


def compressed(path_TN3: np.ndarray, scene: Scene, rate_hz: float) -> np.ndarray:
    """Lowers all heights above the floor to 60 %."""
    floor, path_TN3 = FLOOR_NODE / 64, path_TN3.copy()
    path_TN3[..., 1] = floor + COMPRESSED * (path_TN3[..., 1] - floor)
    return path_TN3


def squeezed(path_TN3: np.ndarray, scene: Scene, rate_hz: float) -> np.ndarray:
    """Draws all particles towards their mean, to 80 % of the distance."""
    entered_TN1 = np.isfinite(path_TN3[..., :1])
    count_T11 = np.maximum(entered_TN1.sum(axis=1, keepdims=True), 1).astype(np.float32)
    mean_T13 = np.where(entered_TN1, path_TN3, 0).sum(axis=1, keepdims=True) / count_T11
    return mean_T13 + np.float32(SQUEEZED) * (path_TN3 - mean_T13)


def drifting(path_TN3: np.ndarray, scene: Scene, rate_hz: float) -> np.ndarray:
    """Adds a constant velocity; nothing leaves the domain."""
    seconds_T11 = np.arange(len(path_TN3), dtype=np.float32)[:, None, None] / np.float32(rate_hz)
    moved_TN3 = path_TN3 + seconds_T11 * np.array([DRIFT[0], 0.0, DRIFT[1]], np.float32)
    return np.clip(moved_TN3, 0.0, np.array(scene.domain_size, np.float32))


def stirred(path_TN3: np.ndarray, scene: Scene, rate_hz: float) -> np.ndarray:
    """Displaces each particle anew in each frame."""
    size = STIR_CELLS / 64
    noise_TN3 = np.random.default_rng(0).normal(0.0, size, path_TN3.shape).astype(np.float32)
    noise_TN3[0] = 0.0
    return path_TN3 + noise_TN3


def _played(path_TN3: np.ndarray, factor: float) -> np.ndarray:
    time_T = np.minimum(factor * np.arange(len(path_TN3)), len(path_TN3) - 1)
    before_T = np.floor(time_T).astype(int)
    after_T = np.minimum(before_T + 1, len(path_TN3) - 1)
    part_T11 = (time_T - before_T).astype(np.float32)[:, None, None]
    return (1 - part_T11) * path_TN3[before_T] + part_T11 * path_TN3[after_T]


BROKEN: Mapping[str, Callable[[np.ndarray, Scene, float], np.ndarray]] = {
    "frozen": frozen, "delayed": delayed, "hurried": hurried, "compressed": compressed, "squeezed": squeezed,
    "drifting": drifting, "stirred": stirred,
}  # fmt: skip
FRICTIONLESS = "frictionless"  # simulated: scenes with friction, without it
