"""Groups of particles: solid shapes filled with random points.

Numbers are sums, products and square roots of those of `Generator.random()`, so the same seed gives the same bits on
every machine. Shape legend: N particles, P points.
"""

import math
from dataclasses import dataclass

import numpy as np

from hgn.schema import Vector

WALL_CELLS = 3  # thickness of the solver's walls (MpmConfig.wall_cells); no particle starts inside them
MOST_PARTICLES = 10_000_000  # largest number in a scene file or a random scene


@dataclass(frozen=True)
class Region:
    """An axis-aligned box, or a ball if only `radius` is not zero. Domain units."""

    centre: Vector
    half_width: Vector = (0.0, 0.0, 0.0)
    radius: float = 0.0

    @property
    def reach(self) -> np.ndarray:
        """Returns half the edges of the bounding box, float64 [3]."""
        return np.array(self.half_width) + self.radius

    def distances(self, point_P3: np.ndarray) -> np.ndarray:
        """Returns distances from the region to points, float64 [P]; negative or zero inside."""
        outside = np.maximum(np.abs(point_P3 - np.array(self.centre)) - np.array(self.half_width), 0.0)
        return np.sqrt((outside * outside).sum(axis=1)) - self.radius

    def distance(self, other: "Region") -> float:
        """Returns the distance to another region; negative or zero if they overlap."""
        width = np.array(self.half_width) + np.array(other.half_width)
        outside = np.maximum(np.abs(np.array(self.centre) - np.array(other.centre)) - width, 0.0)
        return float(np.sqrt((outside * outside).sum())) - self.radius - other.radius


def region_of(shape: str, size: Vector, centre: Vector) -> Region:
    """Returns the region of a cube or box (three edges) or of a sphere (its diameter, three times)."""
    if shape == "sphere":
        return Region(centre, radius=0.5 * size[0])
    return Region(centre, half_width=(0.5 * size[0], 0.5 * size[1], 0.5 * size[2]))


def particle_count(region: Region, particles_per_cell: float, cell_size: float) -> int:
    """Returns the number of particles that fill a region, as in Taichi Elements: int(n + 1) in boxes, ceil(n) in balls.

    At 8 per cell of 1/64 a cube of 0.08 has 1,074 particles. Four cubes have the 4,296 of the paper's scenes without
    obstacles (sec. 4).
    """
    if region.radius > 0:
        volume = 4 / 3 * math.pi * region.radius * region.radius * region.radius
        return math.ceil(particles_per_cell * volume / cell_size**3)
    x, y, z = region.half_width
    return int(particles_per_cell * 8 * x * y * z / cell_size**3 + 1)


def fill(region: Region, count: int, rng: np.random.Generator) -> np.ndarray:
    """Returns uniformly random points inside a region, float32 [N, 3]."""
    if region.radius > 0:
        local = points_in_ball(count, 3, rng) * region.radius
    else:
        local = (2 * rng.random((count, 3)) - 1) * np.array(region.half_width)
    return (np.array(region.centre) + local).astype(np.float32)


def points_in_ball(count: int, dimensions: int, rng: np.random.Generator) -> np.ndarray:
    """Returns uniformly random points of the unit ball, float64 [P, dimensions], by rejection."""
    accepted = np.zeros((0, dimensions))
    while len(accepted) < count:
        candidate = 2 * rng.random((max(count, 16), dimensions)) - 1
        accepted = np.concatenate([accepted, candidate[(candidate * candidate).sum(axis=1) <= 1]])
    return accepted[:count]


def random_direction(rng: np.random.Generator, dimensions: int = 3) -> np.ndarray:
    """Returns a uniformly random unit vector by rejection. With four dimensions it is a rotation's quaternion."""
    while True:
        point = points_in_ball(1, dimensions, rng)[0]
        length = float(np.sqrt((point * point).sum()))
        if length > 0.1:  # a smaller divisor would amplify rounding
            return point / length
