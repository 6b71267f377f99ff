"""Observables of gallery scenes (gallery.py): figures of a trajectory by name, with units.

The unit of a length is in OBSERVABLES: domain units, or cells of the scene file (1/64 by default), also on a finer
grid. Shape legend: T frames, N particles, S sampled frames.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from hgn.scene.scene import Scene
from hgn.schema import NonNegative, Vector, require, require_bounds

SAMPLED_EVERY = 5  # stride of sampled frames; frame 0 is not sampled, because speeds need the frame before
COUNTED = 2000  # largest number of particles whose neighbours are counted, evenly spaced among all
HIGH, FRONT = 0.98, 0.99  # quantiles of places that count as the top and the front of a material


@dataclass(frozen=True, kw_only=True)
class BoundEntry:
    """A row of a gallery file: an observable, frames, and the two bounds of its figure.

    `between` bounds the figure absolutely, `times` as multiples of the solver's figure, `within` as a distance from it;
    `times` and `within` may be combined.
    """

    of: str  # a key of OBSERVABLES
    frames: tuple[int, int]  # first and last; every fifth frame is sampled
    take: str = "mean"  # over the sampled frames: a key of TAKES
    between: tuple[float, float] | None = None
    times: tuple[float, float] | None = None
    within: NonNegative[float] | None = None
    group: int | None = None  # only the particles of this group, counted from 0; null: all
    along: Vector | None = None  # direction of moved; also of centre, front, spread and beyond, in place of x
    at: float | None = None  # place of below and beyond, domain units
    since: NonNegative[int] = 0  # frame that moved and displacement are measured from

    def __post_init__(self) -> None:
        require_bounds(self)
        require(self.of in OBSERVABLES, "of", f"one of {', '.join(OBSERVABLES)}", self.of)
        require(self.take in TAKES, "take", f"one of {', '.join(TAKES)}", self.take)
        relative = self.times is not None or self.within is not None
        rule = "given, or else times or within, one of the two kinds"
        require((self.between is not None) != relative, "between", rule, self.between)
        for name in ("between", "times"):
            pair = getattr(self, name)
            require(pair is None or -math.inf < pair[0] <= pair[1] < math.inf, name, "finite and in order", pair)
        first, last = self.frames
        sampled = all(frame % SAMPLED_EVERY == 0 for frame in self.frames)
        rule = f"two multiples of {SAMPLED_EVERY} in order, from {SAMPLED_EVERY} on"
        require(sampled and SAMPLED_EVERY <= first <= last, "frames", rule, list(self.frames))
        own = OBSERVABLES[self.of]
        for name in ("along", "at"):
            given, rule = getattr(self, name) is not None, f"given with {self.of}" if name in own.needs else "left out"
            optional = name == "along" and self.of in DIRECTED
            require(given == (name in own.needs) or optional, name, rule, getattr(self, name))
        require(self.along is None or any(self.along), "along", "other than zero", self.along)
        require(self.since == 0 or self.of in SINCE, "since", f"left out except with {', '.join(SINCE)}", self.since)

    @property
    def key(self) -> str:
        """Returns the measured quantity without the frames: rows with the same key share a series."""
        parts = [
            self.of,
            *(f"{name} {getattr(self, name)}" for name in ("group", "at") if getattr(self, name) is not None),
        ]
        parts += [f"along {' '.join(f'{x:g}' for x in self.along)}"] if self.along else []
        return ", ".join(parts + ([f"since {self.since}"] if self.since else []))

    @property
    def label(self) -> str:
        first, last = self.frames
        frames = f"frame {first}" if first == last else f"frames {first} to {last}"
        return f"{'' if self.take == 'mean' else self.take + ' '}{self.key}, {frames}"

    def interval(self, solver: float) -> tuple[float, float]:
        """Returns the lowest and the highest figure that pass, for the solver's figure."""
        if self.between is not None:
            return self.between
        scaled, room = [factor * solver for factor in self.times or (1.0, 1.0)], self.within or 0.0
        return min(scaled) - room, max(scaled) + room

    def reduced(self, series_S: Sequence[float]) -> float:
        """Returns the figure of a series that was sampled from frame SAMPLED_EVERY on."""
        first, last = (frame // SAMPLED_EVERY for frame in self.frames)
        return float(TAKES[self.take](np.asarray(series_S[first - 1 : last], np.float64)))

    def reduced_line(self, line: str) -> float:
        """Returns the figure of a series as reports store it. Raises ValueError if it is too short."""
        numbers = [float(number) for number in line.split()]
        if len(numbers) < (frames := self.frames[1] // SAMPLED_EVERY):
            raise ValueError(f"{len(numbers)} numbers instead of {frames}")
        return self.reduced(numbers)


@dataclass(frozen=True, eq=False)
class Film:
    """A trajectory of a scene, and of the same scene with a body far away if it was simulated."""

    scene: Scene
    position_TN3: np.ndarray  # domain units; NaN before a particle enters
    rate_hz: float
    cell_size: float  # cell size of the scene file
    particles_per_cell: float  # number of particles in a cell of that size
    beside_far_TN3: np.ndarray | None = None  # places of the scene's own particles if the far body is present

    def of_group(self, group: int | None) -> "Film":
        """Returns the film of one group's particles."""
        if group is None:
            return self
        counts = self.scene.specification["particle_counts"]
        own = slice(sum(counts[:group]), sum(counts[: group + 1]))
        beside = None if self.beside_far_TN3 is None else self.beside_far_TN3[:, own]
        scene, position_TN3 = self.scene.selected(own), self.position_TN3[:, own]
        return replace(self, scene=scene, position_TN3=position_TN3, beside_far_TN3=beside)

    def place(self, frame: int) -> np.ndarray:
        """Returns the particles that have entered, float64 [N, 3]."""
        place_N3 = self.position_TN3[frame].astype(np.float64)
        return place_N3[np.isfinite(place_N3[:, 0])]

    def velocity(self, frame: int) -> np.ndarray:
        """Returns mean velocities over the last frame, float64 [N, 3], domain units per second."""
        velocity_N3 = np.subtract(*self.position_TN3[[frame, frame - 1]].astype(np.float64)) * self.rate_hz
        return velocity_N3[np.isfinite(velocity_N3[:, 0])]

    @property
    def gravity_3(self) -> np.ndarray:
        return np.array(self.scene.gravity, np.float64)


def height(film: Film, frame: int, _: BoundEntry) -> float:
    return float(film.place(frame)[:, 1].mean()) / film.cell_size


def top(film: Film, frame: int, _: BoundEntry) -> float:
    return float(np.quantile(film.place(frame)[:, 1], HIGH)) / film.cell_size


def crowding(film: Film, frame: int, _: BoundEntry) -> float:
    per_cell = film.scene.particles_per_cell or film.particles_per_cell
    finer = per_cell / film.particles_per_cell * (film.cell_size / film.scene.cell_size) ** 3
    place_N3 = film.place(frame)
    counted_N3 = place_N3[:: max(1, len(place_N3) // COUNTED)]
    counts = cKDTree(place_N3).query_ball_point(counted_N3, film.cell_size, return_length=True)
    return (float(counts.mean()) - 1) / finer


def spread(film: Film, frame: int, bound: BoundEntry) -> float:
    axes = np.eye(3)[[0, 2]] if bound.along is None else [_direction(bound)]
    return float(np.sqrt((film.place(frame) @ np.transpose(axes)).var(axis=0).mean()))


def centre(film: Film, frame: int, bound: BoundEntry) -> float:
    return float((film.place(frame) @ _direction(bound)).mean())


def front(film: Film, frame: int, bound: BoundEntry) -> float:
    return float(np.quantile(film.place(frame) @ _direction(bound), FRONT))


def squared_speed(film: Film, frame: int, _: BoundEntry) -> float:
    return float((film.velocity(frame) ** 2).sum(axis=1).mean())


def energy_gain(film: Film, frame: int, _: BoundEntry) -> float:
    middle_N3 = film.position_TN3[[frame - 1, frame]].mean(axis=0, dtype=np.float64)
    kinetic = 0.5 * (
        squared_speed(film, frame, _) - float((film.scene.velocity_N3.astype(np.float64) ** 2).sum(1).mean())
    )
    return kinetic - float((middle_N3 - film.position_TN3[0]).mean(axis=0) @ film.gravity_3)


def moved(film: Film, frame: int, bound: BoundEntry) -> float:
    way_N3 = np.subtract(*film.position_TN3[[frame, bound.since]].astype(np.float64))
    return float(np.nanmean(way_N3 @ _direction(bound)))


def below(film: Film, frame: int, bound: BoundEntry) -> float:
    assert bound.at is not None
    return float((film.place(frame)[:, 1] < bound.at).mean())


def beyond(film: Film, frame: int, bound: BoundEntry) -> float:
    assert bound.at is not None
    return float((film.place(frame) @ _direction(bound) > bound.at).mean())


def momentum(film: Film, frame: int, _: BoundEntry) -> float:
    flown_3 = film.scene.velocity_N3.mean(axis=0, dtype=np.float64) + (frame - 0.5) / film.rate_hz * film.gravity_3
    return float(np.linalg.norm(film.velocity(frame).mean(axis=0) - flown_3))


def displacement(film: Film, frame: int, bound: BoundEntry) -> float:
    way_N3 = np.subtract(*film.position_TN3[[frame, bound.since]].astype(np.float64))
    return float(np.sqrt(np.nanmax((way_N3**2).sum(axis=1)))) / film.cell_size


def far_effect(film: Film, frame: int, _: BoundEntry) -> float:
    assert film.beside_far_TN3 is not None
    way_N3 = film.position_TN3[frame].astype(np.float64) - film.beside_far_TN3[frame]
    return float(np.sqrt((way_N3**2).sum(axis=1).mean())) / film.cell_size


def _direction(bound: BoundEntry) -> np.ndarray:
    along_3 = np.array(bound.along or (1.0, 0.0, 0.0))
    return np.asarray(along_3 / np.linalg.norm(along_3))


def period(series_S: np.ndarray) -> float:
    """Returns twice the mean time between crossings of the mean, in frames; NaN for fewer than two crossings."""
    swing_S = series_S - series_S.mean()
    before = np.flatnonzero(swing_S[:-1] * swing_S[1:] < 0)
    crossed = before + swing_S[before] / (swing_S[before] - swing_S[before + 1])
    return 2 * SAMPLED_EVERY * float(np.diff(crossed).mean()) if len(crossed) > 1 else math.nan


@dataclass(frozen=True)
class Observable:
    """A figure of a frame."""

    measure: Callable[[Film, int, BoundEntry], float]
    unit: str
    what: str
    needs: tuple[str, ...] = ()  # fields of a bound


OBSERVABLES: Mapping[str, Observable] = {
    "height": Observable(height, "cells", "mean height above the lower plane of the domain"),
    "top": Observable(top, "cells", "height that 98 % of the particles are below"),
    "crowding": Observable(crowding, "particles", "mean number of others within a cell, at the density of the file"),
    "spread": Observable(spread, "domain units", "root mean square distance from the mean along x and z, or `along`"),
    "centre": Observable(centre, "domain units", "mean place along x, or `along`"),
    "front": Observable(front, "domain units", "place along x, or `along`, that 99 % have not reached"),
    "squared_speed": Observable(squared_speed, "(domain units/s)²", "mean squared speed"),
    "energy_gain": Observable(
        energy_gain, "(domain units/s)²", "kinetic and potential energy per mass, less that of the start"
    ),
    "moved": Observable(moved, "domain units", "mean displacement in the direction `along`", ("along",)),
    "below": Observable(below, "fraction", "particles lower than `at`", ("at",)),
    "beyond": Observable(beyond, "fraction", "particles farther along x, or `along`, than `at`", ("at",)),
    "momentum": Observable(momentum, "domain units/s", "difference of the mean velocity from that of free flight"),
    "displacement": Observable(displacement, "cells", "largest displacement of a particle"),
    "far_effect": Observable(
        far_effect, "cells", "root mean square distance between the scene alone and with the body of measure.far"
    ),
}
SINCE = ("moved", "displacement")
DIRECTED = ("centre", "front", "spread", "beyond")  # `along` is optional
LACKS = {  # observables that some scenes do not have: whether one does not, and what it would need
    "energy_gain": (lambda scene, _: scene.emits, "particles that are all present from the start"),
    "momentum": (lambda scene, _: scene.emits, "particles that are all present from the start"),
    "far_effect": (lambda _, far: not far, "a body in measure.far"),
}
TAKES: Mapping[str, Callable[[np.ndarray], float]] = {
    "mean": np.mean, "max": np.max, "min": np.min, "swing": np.ptp, "period": period,
}  # fmt: skip


def series(film: Film, bound: BoundEntry) -> list[float]:
    """Measures an observable every SAMPLED_EVERY frames."""
    own, measure = film.of_group(bound.group), OBSERVABLES[bound.of].measure
    return [measure(own, frame, bound) for frame in range(SAMPLED_EVERY, len(film.position_TN3), SAMPLED_EVERY)]
