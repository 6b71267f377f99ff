"""Holds obstacles that viewers move: each is sampled once and placed again and again.

Shape legend: V vertices, S surface samples.
"""

import dataclasses
import itertools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hgn.runtime.simulator import InitialState
from hgn.scene.mesh import load_mesh
from hgn.scene.motion import Motion
from hgn.scene.moving import MovingObstacle
from hgn.scene.obstacle_grid import ObstacleGrid, grid_of_samples, surface_samples
from hgn.scene.rotation import euler_rotation, rotate, round_to_float32
from hgn.scene.scene import Obstacle, all_corners
from hgn.scene.scene_file import ObstacleEntry
from hgn.scene.shapes import shape_obstacle
from hgn.scene.surface import MAXIMUM_SAMPLES
from hgn.schema import Vector, triple

JUMP = 0.1  # longest displacement of an obstacle in a frame that moves particles along, domain units
LONGEST_STEM = 32  # characters of a file's name that a page shows
_numbers = itertools.count()


@dataclass(frozen=True, eq=False)
class Body:
    """Holds an obstacle about its own origin, neither rotated nor moved, which all its places have in common."""

    entry: ObstacleEntry  # the position and the rotation of the entry are not used
    mesh: Obstacle
    cell_size: float
    mesh_file: bytes | None = None
    most_samples: int = MAXIMUM_SAMPLES
    number: int = field(default_factory=lambda: next(_numbers))

    @cached_property
    def samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns points on the surface and their normals, float64 [S, 3]."""
        return surface_samples((self.mesh,), self.cell_size, seed=0, most=self.most_samples)[:2]

    @property
    def name(self) -> str:
        """Returns a name for pages, logs and archives. It has only letters, digits and ._- for any file name."""
        stem = Path(self.entry.mesh).stem if self.entry.mesh else self.entry.shape
        return f"{plain(str(stem))}_{self.number}"


@dataclass(frozen=True, eq=False)
class PlacedObstacle:
    """Holds a body at a place: position in domain units, rotation in degrees about the fixed x axis, then y, then z."""

    body: Body
    position: Vector
    rotation: Vector = (0.0, 0.0, 0.0)

    @cached_property
    def rotation_33(self) -> np.ndarray:
        return euler_rotation(self.rotation)

    @property
    def entry(self) -> ObstacleEntry:
        """Returns the entry for a scene file."""
        return dataclasses.replace(self.body.entry, position=self.position, rotation=self.rotation)

    def turned(self, degrees: float) -> "PlacedObstacle":
        """Returns the obstacle rotated further about the vertical."""
        matrix = euler_rotation((0.0, degrees, 0.0)) @ self.rotation_33
        return dataclasses.replace(self, rotation=triple(Rotation.from_matrix(matrix).as_euler("xyz", degrees=True)))

    def mesh(self, motion: Motion | None = None) -> Obstacle:
        """Returns the triangles at the obstacle's place."""
        mesh = self.body.mesh
        vertex_V3 = round_to_float32(rotate(mesh.vertex_V3, self.rotation_33) + np.array(self.position))
        return dataclasses.replace(mesh, name=self.body.name, vertex_V3=vertex_V3, motion=motion)

    @property
    def samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns samples at the obstacle's place. They are not kept, because past frames have many places."""
        point_S3, normal_S3 = self.body.samples
        matrix = self.rotation_33
        return rotate(point_S3, matrix) + np.array(self.position), rotate(normal_S3, matrix)


def plain(name: str) -> str:
    """Returns a name without characters that pages, terminals or file systems interpret, cut to LONGEST_STEM."""
    return re.sub("[^A-Za-z0-9_.-]+", "_", name)[:LONGEST_STEM]


def placed_by(
    entry: ObstacleEntry, folder: Path, cell_size: float, most_samples: int = MAXIMUM_SAMPLES
) -> PlacedObstacle:
    """Returns the obstacle of an entry. Raises ConfigError for a mesh that is unreadable or too large to sample."""
    if entry.mesh is not None:
        path = folder / entry.mesh
        mesh = load_mesh(path, scale=1.0 if entry.scale is None else entry.scale)
        mesh_file = path.read_bytes()
    else:
        assert entry.shape is not None and entry.size is not None
        mesh, mesh_file = shape_obstacle(entry.shape, entry.size), None
    body = Body(entry, dataclasses.replace(mesh, friction=entry.friction or 0.0), cell_size, mesh_file, most_samples)
    placed = PlacedObstacle(body, entry.position or (0.0, 0.0, 0.0), entry.rotation)
    _ = placed.samples
    return placed


def moved_from(before: PlacedObstacle, after: PlacedObstacle, frame_s: float) -> MovingObstacle | None:
    """Returns an obstacle that moves between two places within one frame, and is at rest afterwards.

    Returns None if the places are equal, and for a jump: a displacement of more than JUMP.
    """
    mesh, turn_33 = before.mesh(), after.rotation_33 @ before.rotation_33.T
    way_T3 = np.array([(0.0, 0.0, 0.0), np.subtract(after.position, before.position)])
    motion = Motion(np.array([0.0, frame_s]), way_T3, np.stack([np.eye(3), turn_33]), before.position)
    grid = grid_of_samples(*before.samples, before.body.cell_size)
    friction_K = np.full(len(grid.cell_K3), mesh.friction, np.float32)
    moving = MovingObstacle(dataclasses.replace(grid, friction_K=friction_K), mesh.corners, motion)
    return moving if 0 < motion.fastest(mesh.vertex_V3) * frame_s <= JUMP else None


def with_obstacles(
    scene: InitialState, obstacles: Sequence[PlacedObstacle], moving: Sequence[MovingObstacle] = ()
) -> InitialState:
    """Returns the scene with these obstacles at rest, and `moving` ones.

    Omits cells at rest that are more than one cell outside the domain.
    """
    grid, corners = _at_rest(tuple(obstacles), scene.obstacle_grid.cell_size, scene.domain_size)
    return dataclasses.replace(scene, obstacle_grid=grid, corners=corners, moving=tuple(moving))


@lru_cache(maxsize=1)
def _at_rest(
    obstacles: tuple[PlacedObstacle, ...], cell_size: float, domain_size: Vector
) -> tuple[ObstacleGrid, Callable[[], np.ndarray]]:
    """Returns the cells and corners of obstacles. While others are dragged they stay the same objects."""
    empty = (np.zeros((0, 3)), np.zeros((0, 3)))
    parts = [empty, *(obstacle.samples for obstacle in obstacles)]
    frictions = [0.0, *(obstacle.body.mesh.friction for obstacle in obstacles)]
    friction_S = np.repeat(frictions, [len(points) for points, _ in parts])
    point_S3, normal_S3 = (np.concatenate(part) for part in zip(*parts, strict=True))
    near = ((point_S3 >= -cell_size) & (point_S3 < np.array(domain_size) + cell_size)).all(axis=1)
    grid = grid_of_samples(point_S3[near], normal_S3[near], cell_size, friction_S[near])
    return grid, lambda: all_corners([obstacle.mesh() for obstacle in obstacles])
