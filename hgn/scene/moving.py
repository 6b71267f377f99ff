"""Obstacles in motion: the cells of each are computed once, in its first pose, and then move with it.

Shape legend: F triangles.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from hgn.scene.barrier import Barrier, barrier_of_pieces, barrier_pieces
from hgn.scene.episode import Episode
from hgn.scene.episode_obstacles import obstacle_of_record
from hgn.scene.motion import Motion
from hgn.scene.obstacle_grid import ObstacleGrid, build_obstacle_grid
from hgn.scene.scene import Obstacle
from hgn.scene.surface_field import surface_field


@dataclass(frozen=True, eq=False)
class MovingObstacle:
    """An obstacle in its pose of the scene file, and its motion from there."""

    grid: ObstacleGrid
    corner_F33: np.ndarray  # float64, domain units
    motion: Motion

    @cached_property
    def field(self) -> ObstacleGrid:
        """Returns hgn.scene.surface_field around the obstacle."""
        return surface_field(self.grid, self.corner_F33)

    def surfaces(self, distance: bool) -> ObstacleGrid:
        """Returns the field with `distance` (network.obstacle_distance), else the paper's cells."""
        return self.field if distance else self.grid

    def barrier(self, clearance: float) -> Barrier:
        """Returns the barrier of its triangles. Raises: ConfigError for an invalid clearance."""
        cell_size = self.grid.cell_size
        return barrier_of_pieces(barrier_pieces(self.corner_F33, cell_size), cell_size, clearance)


def at_rest(obstacles: Sequence[Obstacle]) -> tuple[Obstacle, ...]:
    """Returns those obstacles that do not move."""
    return tuple(obstacle for obstacle in obstacles if obstacle.motion is None)


def moving_obstacles(obstacles: Sequence[Obstacle], cell_size: float) -> tuple[MovingObstacle, ...]:
    """Returns those obstacles that move. Raises: ConfigError as `build_obstacle_grid`."""
    return tuple(
        MovingObstacle(build_obstacle_grid((body,), cell_size, seed=0), body.corners, body.motion)
        for body in obstacles
        if body.motion is not None
    )


def moving_of_episode(episode: Episode) -> tuple[MovingObstacle, ...]:
    """Returns the moving obstacles of a random scene's episode, from its specification. The last ones are cached."""
    if episode.specification.get("kind") != "random":
        return ()
    other = {"friction": episode.solver.get("settings", {}).get("collider_friction")}  # where a record has none
    records = [json.dumps(other | record) for record in episode.specification["obstacles"] if "keyframes" in record]
    return tuple(_moving_of_record(record, episode.obstacle_grid.cell_size) for record in records)


@lru_cache(maxsize=1024)
def _moving_of_record(record: str, cell_size: float) -> MovingObstacle:
    return moving_obstacles([obstacle_of_record(json.loads(record), "moving")], cell_size)[0]
