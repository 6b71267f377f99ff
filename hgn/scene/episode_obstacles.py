"""The meshes of an episode's obstacles, rebuilt from its specification or from its obstacle cells.

Shape legend: K obstacle cells, F triangles.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from hgn.config import is_mesh_file
from hgn.scene.episode import Episode
from hgn.scene.motion import Motion
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.scene.rotation import quaternion_rotation
from hgn.scene.scene import Obstacle, all_corners
from hgn.scene.shapes import mesh_sha256, shape_obstacle
from hgn.scene.surface_field import surface_field
from hgn.schema import Vector


def obstacles_of_episode(episode: Episode) -> tuple[Obstacle, ...]:
    """Returns the meshes of an episode's obstacles. If only cells are known, returns a square for each cell."""
    meshes = known_obstacles(episode.specification)
    if meshes is None:
        return cell_obstacles(episode.obstacle_grid, episode.domain_size[2] / 2 if episode.dimensions == 2 else None)
    return meshes


def known_obstacles(specification: Mapping[str, Any]) -> tuple[Obstacle, ...] | None:
    """Returns the meshes of an episode's obstacles or None. Shards do not contain them.

    A random scene's meshes are rebuilt from its specification. Other scenes, or a missing mesh file, give none.
    """
    records = specification.get("obstacles", ())
    if specification.get("kind") != "random" or not all(_is_here(record) for record in records):
        return None
    return tuple(
        obstacle_of_record(record, f"obstacle_{index}_{Path(record['shape']).stem}")
        for index, record in enumerate(records)
    )


def corners_at_rest(specification: Mapping[str, Any]) -> np.ndarray:
    """Returns the triangle corners of the known obstacles that do not move, float64 [F, 3, 3]."""
    return all_corners([obstacle for obstacle in known_obstacles(specification) or () if obstacle.motion is None])


def obstacle_of_record(record: Mapping[str, Any], name: str) -> Obstacle:
    """Returns the obstacle that a random scene's specification describes."""
    position, rotation_33 = tuple(record["position"]), quaternion_rotation(tuple(record["quaternion"]))
    body = shape_obstacle(record["shape"], record["size"], position, rotation_33, name)
    motion = Motion.of_frames(record["keyframes"], position) if "keyframes" in record else None
    return replace(body, friction=record.get("friction") or 0.0, motion=motion)


def _is_here(record: dict[str, Any]) -> bool:
    shape = record["shape"]
    if not is_mesh_file(shape):
        return True
    return Path(shape).is_file() and mesh_sha256(shape) == record.get("sha256")


def field_of_episode(episode: Episode) -> ObstacleGrid:
    """Returns hgn.scene.surface_field of an episode's obstacles at rest. The last ones are cached."""
    return _field(episode.obstacle_grid, json.dumps(episode.specification), tuple(episode.domain_size))


@lru_cache(maxsize=256)
def _field(grid: ObstacleGrid, specification: str, domain_size: Vector) -> ObstacleGrid:
    """Takes no episode, because the cache would keep its positions in memory."""
    return field_around(grid, corners_at_rest(json.loads(specification)), domain_size)


def field_around(grid: ObstacleGrid, corner_F33: np.ndarray, domain_size: Vector) -> ObstacleGrid:
    """Returns hgn.scene.surface_field of triangles, or of the squares of `cell_obstacles` if there are none.

    A 2D set has the squares across the normals too: at their middles they are the section with its plane.
    """
    return surface_field(grid, corner_F33 if len(corner_F33) else all_corners(cell_obstacles(grid)), domain_size)


def cell_obstacles(grid: ObstacleGrid, plane_z: float | None = None) -> tuple[Obstacle, ...]:
    """Returns one square in each obstacle cell, for episodes without meshes.

    The square is perpendicular to the cell's normal. In a 2D set it is the cell's section with the plane at `plane_z`.
    """
    if not len(grid.cell_K3):
        return ()
    center_K3 = (grid.cell_K3 + 0.5) * grid.cell_size
    if plane_z is None:
        normal_K3 = grid.normal_K3.astype(np.float64)
        least_K3 = np.eye(3)[np.abs(normal_K3).argmin(axis=1)]
        side_K3 = np.cross(normal_K3, least_K3)
        side_K3 /= np.maximum(np.linalg.norm(side_K3, axis=1, keepdims=True), 1e-12)
        other_K3 = np.cross(normal_K3, side_K3)
    else:
        center_K3[:, 2] = plane_z
        side_K3, other_K3 = np.eye(3)[:2, None]
    half = 0.5 * grid.cell_size
    corner_K43 = np.stack(
        [center_K3 + half * (a * side_K3 + b * other_K3) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))], axis=1
    )
    first_K = 4 * np.arange(len(center_K3))
    triangle_F3 = np.concatenate([np.stack((first_K, first_K + i, first_K + i + 1), axis=1) for i in (1, 2)])
    return (Obstacle("cells", corner_K43.reshape(-1, 3), triangle_F3.astype(np.int32), closed=False),)
