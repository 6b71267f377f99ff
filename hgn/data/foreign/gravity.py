"""Gravity, where no file says it: what flies freely has it as its acceleration.

Shape legend: T frames, N particles, D dimensions, S stretches, W frames of a stretch.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hgn.schema import ConfigError

STRETCH = 6  # accelerations in a row that are to be the same
CONSTANT = 0.02  # of their mean: by so much they may differ in a stretch
ALIKE = 0.05  # of the median: as near are stretches that show the same gravity
FEWEST = 20  # stretches
LARGEST = 4_000_000  # numbers of a trajectory looked at at once


def estimate_gravity(paths: Sequence[np.ndarray], frame_dt_s: float) -> tuple[float, ...]:
    """The constant acceleration of particles in free flight, length per second squared, from positions [T, N, D].

    A stretch is in flight where its accelerations stay the same and are not zero: what rests, slides evenly or collides
    is left out. Positions in float32 bound the accuracy.
    Raises: ConfigError where too little flies, or different ways.
    """
    acceleration_SD = np.concatenate([_flights(path_TND) for path_TND in paths])
    count = len(acceleration_SD)
    remedy = f"give it, as in gravity={'[0,-9.8]' if acceleration_SD.shape[-1] == 2 else '[0,-9.8,0]'}"
    if count < FEWEST:
        raise ConfigError(f"gravity must be given where fewer than {FEWEST} particles fall, got {count}; {remedy}")
    middle_D = np.median(acceleration_SD, axis=0)
    alike_S = np.linalg.norm(acceleration_SD - middle_D, axis=-1) <= ALIKE * np.linalg.norm(middle_D)
    if alike_S.mean() < 0.5:
        raise ConfigError(
            f"gravity must be given where particles fly differently: {alike_S.mean():.0%} of {count} accelerate "
            f"alike; {remedy}"
        )
    mean_D = acceleration_SD[alike_S].mean(axis=0) / frame_dt_s**2
    size = np.linalg.norm(mean_D)
    # an axis across it: what is there is rounding
    return tuple(float(value) if abs(value) > 0.01 * size else 0.0 for value in mean_D)


def _flights(position_TND: np.ndarray) -> np.ndarray:
    """The mean acceleration of each stretch in flight, domain units per frame squared, [stretches, D]."""
    frames, count, axes = position_TND.shape
    step = max(1, frames * count * axes // LARGEST)
    path_TND = np.asarray(position_TND[:, ::step], np.float64)
    acceleration_FND = np.diff(path_TND, 2, axis=0)[: max(frames - 2, 0) // STRETCH * STRETCH]
    if not len(acceleration_FND):
        return np.zeros((0, axes))
    parts_SWND = acceleration_FND.reshape(-1, STRETCH, *acceleration_FND.shape[1:])
    mean_SND = parts_SWND.mean(axis=1)
    spread_SN = np.linalg.norm(parts_SWND - mean_SND[:, None], axis=-1).max(axis=1)
    size_SN = np.linalg.norm(mean_SND, axis=-1)
    # of a second difference of rounded positions
    rounding = 4 * float(np.spacing(np.float32(np.abs(path_TND).max(initial=0))))
    flying_SN = (spread_SN <= CONSTANT * size_SN + 2 * rounding) & (size_SN > 4 * rounding)
    return mean_SND[flying_SN]
