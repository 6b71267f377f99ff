"""Estimates gravity from particles in free flight, for data sets that do not contain it.

Shape legend: T frames, N particles, D dimensions, S stretches, W frames of a stretch.
"""

from collections.abc import Sequence

import numpy as np

from hgn.schema import ConfigError, require

STRETCH = 6  # number of consecutive accelerations that must agree
CONSTANT = 0.02  # largest deviation in a stretch, relative to its mean
ALIKE = 0.05  # largest deviation of stretches that agree, relative to the median
FEWEST = 20  # smallest number of stretches
LARGEST = 4_000_000  # largest number of a trajectory's coordinates that are processed


def estimate_gravity(paths: Sequence[np.ndarray], frame_dt_s: float) -> tuple[float, ...]:
    """Returns the acceleration of free flight, length per second squared, from positions [T, N, D].

    A stretch is in flight if its accelerations are equal and not zero, which excludes rest, uniform sliding and
    collisions. The accuracy is that of positions in float32.
    Raises: ConfigError if too few particles are in free flight, or if their accelerations differ.
    """
    acceleration_SD = np.concatenate([_flights(path_TND) for path_TND in paths])
    count = len(acceleration_SD)
    remedy = f"give it, for example gravity={'[0,-9.8]' if acceleration_SD.shape[-1] == 2 else '[0,-9.8,0]'}"
    require(count >= FEWEST, "gravity", f"given if fewer than {FEWEST} particles fall freely", count, remedy)
    middle_D = np.median(acceleration_SD, axis=0)
    alike_S = np.linalg.norm(acceleration_SD - middle_D, axis=-1) <= ALIKE * np.linalg.norm(middle_D)
    if alike_S.mean() < 0.5:
        raise ConfigError(
            f"gravity must be given if accelerations in free flight differ, got {alike_S.mean():.0%} of {count} that "
            f"agree; {remedy}"
        )
    mean_D = acceleration_SD[alike_S].mean(axis=0) / frame_dt_s**2
    size = np.linalg.norm(mean_D)
    # a component of less than 1 % is rounding
    return tuple(float(value) if abs(value) > 0.01 * size else 0.0 for value in mean_D)


def _flights(position_TND: np.ndarray) -> np.ndarray:
    """Returns the mean acceleration of each stretch in flight, domain units per frame squared, [stretches, D]."""
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
    # the rounding error of a second difference of positions
    rounding = 4 * float(np.spacing(np.float32(np.abs(path_TND).max(initial=0))))
    flying_SN = (spread_SN <= CONSTANT * size_SN + 2 * rounding) & (size_SN > 4 * rounding)
    return mean_SND[flying_SN]
