"""The common form of trajectories of all formats, with its checks.

Shape legend: T frames, N particles of all kinds, n sampled particles or coordinates, P particles of the boundary, D
dimensions, 2 or 3. K is the number of obstacle cells, or in property_NK of properties.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hgn.schema import ConfigError, require
from hgn.system.claims import require_few_items

COARSEST = 1e-3  # largest spacing of stored numbers, in radii; gravity moves a particle by a few of these in a frame
SAMPLED = 100_000  # number of coordinates of a trajectory that are searched for rounding
MOVES = 20  # number of changed coordinates above which repeated values show rounding
MOST_RADII = 1 << 14  # largest size of the box in radii, because cells are indexed by integers
MOST_CELLS = 1 << 16  # largest number of obstacle cells along an axis
OUTSIDE = 0.01  # largest fraction of particles that may start more than a radius outside the box
LARGEST = 1e15  # largest size of a number, so that float32 stores its square
FLUID = 1  # the type of particles in files without types


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One simulation in the file's own units."""

    name: str  # file, and position in it, for messages
    position_TND: np.ndarray  # float32 or float64
    type_N: np.ndarray  # int64, the set's own numbers
    boundary_PD: np.ndarray | None = None  # particles at rest; None: they are among the other particles
    property_NK: np.ndarray | None = None  # float32, the field material_property
    obstacle_cell_K3: np.ndarray | None = None  # obstacle cells of the plain format, with these normals:
    obstacle_normal_K3: np.ndarray | None = None
    gravity: tuple[float, ...] | None = None  # gravity of this trajectory, length per second squared


@dataclass(frozen=True)
class SetInfo:
    """Properties common to all trajectories of a set, from metadata, format or command line."""

    format: str
    dimensions: int
    frame_dt_s: float
    bounds: tuple[tuple[float, float], ...]  # limits of the box on each axis, in the set's unit of length
    radius: float  # largest distance of neighbours, in the set's unit of length
    materials: Mapping[int, str]  # names by type
    boundary_types: frozenset[int]
    ignored_types: frozenset[int] = frozenset()  # types of padding
    gravity: tuple[float, ...] | None = None  # length per second squared; None: estimated
    gravity_size: float | None = None  # size of gravity, if only that is known
    obstacle_cell_size: float | None = None
    periodic: tuple[bool, ...] = ()  # whether each axis is periodic
    raw: Mapping[str, Any] = field(default_factory=dict)  # the unprocessed metadata

    def __post_init__(self) -> None:
        require(self.dimensions in (2, 3), "metadata.json: dim", "2 or 3", self.dimensions)
        positive = {"dt": (self.frame_dt_s, 1e-9), "default_connectivity_radius": (self.radius, 1e-15)}
        for name, (value, least) in positive.items():
            rule = f"a finite number > 0, from {least:g} to {1 / least:g}"
            require(least <= value <= 1 / least, f"metadata.json: {name}", rule, value)
        shape = np.shape(self.bounds)
        rule = f"[low, high] for each of {self.dimensions} axes"
        require(shape == (self.dimensions, 2), "metadata.json: bounds", rule, self.bounds)
        ordered = all(-1e9 <= low < high <= 1e9 for low, high in self.bounds)
        require(ordered, "metadata.json: bounds", "low < high, from -1e9 to 1e9", self.bounds)
        longest = max(high - low for low, high in self.bounds)
        key = "metadata.json: default_connectivity_radius"
        rule = f"at least {longest / MOST_RADII:.3g} for a box of width {longest:g}"
        either = "correct it, or bounds"
        require(self.radius * MOST_RADII >= longest, key, rule, self.radius, remedy=either)
        require(self.radius <= longest, key, f"at most the width of the box, {longest:g}", self.radius, remedy=either)
        cell_size = self.obstacle_cell_size
        fits = cell_size is None or longest <= cell_size * MOST_CELLS <= longest * MOST_CELLS
        rule = f"from {longest / MOST_CELLS:.3g} to {longest:g}, the width of the box"
        require(fits, "metadata.json: obstacle_cell_size", rule, cell_size)
        require(len(set(self.materials.values())) <= 256, "materials", "at most 256", len(set(self.materials.values())))
        if self.gravity is not None:
            rule = f"{self.dimensions} finite numbers, one for each axis of bounds, at most {LARGEST:g}"
            there = len(self.gravity) == self.dimensions and bool((np.abs(self.gravity) <= LARGEST).all())
            require(there, "gravity", rule, list(self.gravity))

    def obstacles(self, type_N: np.ndarray) -> np.ndarray:
        """Returns which particles of these types are obstacles, bool [N]."""
        return np.isin(type_N, list(self.boundary_types))


def checked(name: str, position: Any, types: Any, dimensions: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions [T, N, D] and types int64 [N] of a file. `types` may be one number for all particles.

    Raises: ConfigError naming file and field, for another type or shape, and for values that are not finite.
    """
    position_TND = floats(f"{name}: position", position, (None, None, dimensions))
    type_N = as_array(f"{name}: particle_type", types)
    plain = type_N.dtype.kind in "iuf" and type_N.dtype.itemsize <= 8  # some of geoelements' writers store float64
    number_N = type_N.astype(np.float64) if plain else np.full((), np.nan)
    if not ((np.abs(number_N) <= LARGEST) & (number_N == np.round(number_N))).all():
        raise ConfigError(f"{name}: particle_type must be whole numbers, at most 1e15, got {type_N.dtype}")
    count = position_TND.shape[1]
    if type_N.ndim == 0 or (type_N.shape == (1,) and count != 1):
        type_N = np.full(count, type_N.reshape(())[()])
    if type_N.shape != (count,):
        raise ConfigError(f"{name}: particle_type must be one number for each of {count} particles, got {type_N.shape}")
    return position_TND, type_N.astype(np.int64)


def as_array(name: str, value: Any) -> np.ndarray:
    """Returns a file's value as an array. Raises: ConfigError naming `name` for lists of different lengths."""
    try:
        require_few_items(value)
        return np.asarray(value)
    except ValueError as error:  # lists of different lengths
        raise ConfigError(f"{name} must be an array, got {error}") from None


def floats(name: str, array: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    """Returns float32 or float64 of this shape, at most LARGEST. None in the shape means any length above 0.

    Raises: ConfigError naming the file and the field.
    """
    array = as_array(name, array)
    if array.dtype.kind != "f" or array.dtype.itemsize not in (4, 8):
        raise ConfigError(f"{name} must be float32 or float64, got {array.dtype}")
    fits = array.ndim == len(shape) and all(
        n == m or (m is None and n) for n, m in zip(array.shape, shape, strict=True)
    )
    if not fits:
        wanted = ", ".join("any" if length is None else str(length) for length in shape)
        raise ConfigError(f"{name} must have shape [{wanted}], got {list(array.shape)}")
    bad = np.argwhere(~(np.abs(array) <= LARGEST))
    if len(bad):
        value = array[tuple(bad[0])]
        rule = "at most 1e15" if np.isfinite(value) else "finite"
        raise ConfigError(f"{name} must be {rule}, got {value} at {bad[0].tolist()}")
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _step(position_TND: np.ndarray, radius: float) -> float:
    """Returns the smallest difference between coordinates that change, or 0 if too few change to detect rounding."""
    path_Tn = np.unique(position_TND.reshape(len(position_TND), -1), axis=1)  # equal paths count once
    path_Tn = path_Tn[:, (path_Tn != path_Tn[0]).any(axis=0)]
    if not path_Tn.size:
        return 0.0
    moves_Tn = np.diff(path_Tn, axis=0) != 0
    moved = path_Tn[1:][moves_Tn]
    moved = moved[np.abs(moved) > 0.5 * np.abs(moved).max()]  # floats are coarsest there
    values, per_path = np.unique(moved), (np.diff(np.sort(path_Tn, axis=0), axis=0) != 0).sum(axis=0).mean()
    count = len(np.unique(path_Tn[0])) * min(per_path, len(path_Tn) / 2)
    # unrounded numbers, if they are not few, almost surely contain a difference below COARSEST
    few = count**2 * COARSEST * radius < 20 * np.ptp(values)
    # a particle whose motion in a frame is less than the spacing rests, jumps, and rests
    jumps = len(moved) > MOVES and 2 * len(values) < len(moved) and 2 * moves_Tn.sum() < moves_Tn.size
    return float(np.diff(values).min()) if len(values) > 1 and (jumps or not few) else 0.0


def require_inside(trajectory: Trajectory, info: SetInfo) -> None:
    """Refuses trajectories without moving particles, and bounds that do not contain those of the first frame."""
    free_N = ~info.obstacles(trajectory.type_N)
    rule = "of particles that are not obstacles"
    require(bool(free_N.any()), f"{trajectory.name}: position", rule, "none", "leave it out")
    place_ND = trajectory.position_TND[0, free_N].astype(np.float64)
    low_D, high_D = np.array(info.bounds).T
    outside_N = ((place_ND < low_D - info.radius) | (place_ND > high_D + info.radius)).any(-1)
    if outside_N.sum() > OUTSIDE * len(place_ND):
        extent = np.stack([place_ND.min(0), place_ND.max(0)], -1).round(4).tolist()
        raise ConfigError(
            f"bounds must contain the particles, got {[list(pair) for pair in info.bounds]} with "
            f"{outside_N.mean():.0%} of {trajectory.name} outside, whose particles are in {extent}; give bounds=…"
        )


def require_fine(name: str, position_TND: np.ndarray, radius: float) -> None:
    """Refuses positions that are stored too coarsely, or that were rounded too coarsely before they were stored."""
    single = position_TND.astype(np.float32)
    stored = single if np.array_equal(single, position_TND) else position_TND
    largest = np.abs(stored).max(initial=0)
    path_TnD = position_TND[:, :: max(1, position_TND.size // SAMPLED)].astype(np.float64)
    axes = np.split(path_TnD, path_TnD.shape[2], axis=2)  # rounding may differ, as that of map coordinates and heights
    spacing = max(float(np.spacing(largest)), *(_step(part, radius) for part in (path_TnD, *axes)))
    if not spacing <= COARSEST * radius:
        raise ConfigError(
            f"{name}: position must have a resolution of {COARSEST * radius:.2g} (0.001 radii) or finer, got "
            f"{spacing:.2g} in {stored.dtype} at coordinates up to {largest:.3g}; subtract an offset before rounding"
        )
