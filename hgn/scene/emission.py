"""Emitters: faces through which particles enter at a given velocity and density.

Shape legend: N particles, E particles of an emitter, P points, F triangles.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from hgn.scene.group import points_in_ball
from hgn.scene.scene import Scene
from hgn.schema import Vector, require

WAYS = 256  # largest number of entering particles whose paths are checked for obstacles


@dataclass(frozen=True)
class Face:
    """A disc, or a rectangle if `edges` are not zero, perpendicular to a velocity. Domain units."""

    centre: Vector
    velocity: Vector  # velocity of entering particles, domain units per second
    radius: float = 0.0
    edges: tuple[float, float] = (0.0, 0.0)  # the first edge is horizontal, and along x for a vertical velocity

    @property
    def area(self) -> float:
        return math.pi * self.radius**2 if self.radius else self.edges[0] * self.edges[1]

    @property
    def axes(self) -> np.ndarray:
        """Returns unit vectors along the two edges, float64 [2, 3]."""
        along = np.array(self.velocity) / np.linalg.norm(self.velocity)
        level = np.cross([0.0, 1.0, 0.0], along)
        level = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(level) < 1e-9 else level / np.linalg.norm(level)
        return np.stack([level, np.cross(along, level)])

    @property
    def reach(self) -> np.ndarray:
        """Returns half the edges of the bounding box, float64 [3]."""
        if self.radius:
            along = np.array(self.velocity) / np.linalg.norm(self.velocity)
            return np.asarray(self.radius * np.sqrt(np.maximum(1 - along**2, 0.0)))
        return np.asarray(0.5 * np.array(self.edges) @ np.abs(self.axes))

    def count(self, seconds: float, particles_per_cell: float, cell_size: float) -> int:
        """Returns the number of particles that enter in this time at the density of groups."""
        volume = self.area * float(np.linalg.norm(self.velocity)) * seconds
        return round(particles_per_cell * volume / cell_size**3)

    def draw(self, start: float, stop: float, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draws entry points on the face, float32 [E, 3], and sorted entry times, float64 [E].

        One particle enters in each of `count` equal intervals.
        """
        if self.radius:
            place = points_in_ball(count, 2, rng) * self.radius
        else:
            place = (rng.random((count, 2)) - 0.5) * np.array(self.edges)
        time = start + (stop - start) * (np.arange(count) + rng.random(count)) / max(count, 1)
        return (np.array(self.centre) + place @ self.axes).astype(np.float32), time


def entry_frames(scene: Scene, frame_rate_hz: float) -> np.ndarray:
    """Returns the first frame of each particle, int64 [N]: the first one at or after its time of entry."""
    if scene.entry_s_N is None:
        return np.zeros(scene.particle_count, np.int64)
    return np.maximum(np.ceil(scene.entry_s_N * frame_rate_hz - 1e-9), 0).astype(np.int64)


def at_entry(scene: Scene, frame_rate_hz: float) -> Scene:
    """Returns the scene with each particle at its first frame, after free flight from the face."""
    if scene.entry_s_N is None:
        return scene
    time_N1 = (entry_frames(scene, frame_rate_hz) / frame_rate_hz - scene.entry_s_N)[:, None]
    time_N1[scene.entry_s_N <= 0] = 0.0
    gravity = np.array(scene.gravity)
    position_N3 = scene.position_N3 + time_N1 * scene.velocity_N3 + 0.5 * time_N1**2 * gravity
    return dataclasses.replace(
        scene,
        position_N3=position_N3.astype(np.float32),
        velocity_N3=(scene.velocity_N3 + time_N1 * gravity).astype(np.float32),
    )


def at_start(scene: Scene) -> Scene:
    """Returns the scene with only the particles that are present from the start."""
    if scene.entry_s_N is None:
        return scene
    return dataclasses.replace(scene.selected(scene.entry_s_N <= 0), entry_s_N=None)


def require_free_entries(scene: Scene, entered: Scene) -> None:
    """Raises ConfigError if an obstacle in its initial pose blocks an entering particle's path.

    The path leads from the emitter to the particle's first position (`entered`, from `at_entry`).
    """
    if scene.entry_s_N is None:
        return
    late = np.flatnonzero(scene.entry_s_N > 0)
    late = late[:: -(-len(late) // WAYS) or 1]
    start, way = scene.position_N3[late].astype(np.float64), (entered.position_N3 - scene.position_N3)[late]
    for obstacle in scene.obstacles:
        corner_F33 = obstacle.corners
        hits = sum(_crosses(point, step.astype(np.float64), corner_F33) for point, step in zip(start, way, strict=True))
        rule = "clear of obstacles for the first frame of entering particles"
        blocked = f"{hits / max(len(late), 1):.0%} of them pass {obstacle.name}"
        require(not hits, "emitters", rule, blocked, "move one of them")


def _crosses(start_3: np.ndarray, way_3: np.ndarray, corner_F33: np.ndarray) -> bool:
    """Returns whether a straight path meets a triangle (Möller and Trumbore 1997)."""
    edge_1, edge_2 = corner_F33[:, 1] - corner_F33[:, 0], corner_F33[:, 2] - corner_F33[:, 0]
    across = np.cross(way_3, edge_2)
    determinant = (edge_1 * across).sum(axis=1)
    determinant = np.where(determinant == 0, np.nan, determinant)
    offset = start_3 - corner_F33[:, 0]
    u = (offset * across).sum(axis=1) / determinant
    normal = np.cross(offset, edge_1)
    v = (normal @ way_3) / determinant
    fraction = (edge_2 * normal).sum(axis=1) / determinant
    inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (fraction >= 0) & (fraction <= 1)
    return bool(inside.any())
