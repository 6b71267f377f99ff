"""Items of random scenes: placed obstacles, filled groups, and checks of their distances.

Shape legend: N particles, P points, V vertices.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hgn.config import SceneConfig, is_mesh_file
from hgn.scene.distance import contains
from hgn.scene.funnel import Quaternion
from hgn.scene.group import Region, fill, particle_count
from hgn.scene.material import material_index
from hgn.scene.own_physics import with_drawn_physics
from hgn.scene.rotation import quaternion_rotation, rotate
from hgn.scene.scene import Obstacle, Scene
from hgn.scene.shapes import mesh_sha256, shape_obstacle, unit_shape
from hgn.scene.surface import point_tree, split_long_edges
from hgn.schema import Vector

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

CLEARANCE_CELLS = 2.0  # smallest distance between obstacles, groups and walls, in solver cells
SURFACE_DETAIL = 0.045  # longest edge of the pieces of a surface for distances, relative to the obstacle's size
FEW = 32  # the first test of an overlap uses every FEW-th point
ROUNDING = 1e-6  # relative margin that keeps values within their bounds when they are rounded to float32


@dataclass(frozen=True)
class Placed:
    """An obstacle with points of its surface. Every surface point is within `gap` of one of them."""

    obstacle: Obstacle
    point_P3: np.ndarray
    gap: float
    low: np.ndarray
    high: np.ndarray
    record: dict[str, Any]

    @functools.cached_property
    def tree(self) -> cKDTree:
        return point_tree(self.point_P3)


def place_shape(shape: str, size: float, position: Vector, quaternion: Quaternion, index: int) -> Placed:
    """Returns obstacle number `index` of a scene: a built-in shape or a mesh file with its size and position."""
    rotation_33 = quaternion_rotation(quaternion)
    obstacle = shape_obstacle(shape, size, position, rotation_33, f"obstacle_{index}_{Path(shape).stem}")
    unit_surface_P3, unit_gap = unit_surface_points(shape)
    point_P3 = rotate(size * unit_surface_P3, rotation_33) + np.array(position)
    low_3, high_3 = obstacle.vertex_V3.min(axis=0), obstacle.vertex_V3.max(axis=0)
    record: dict[str, Any] = {"shape": shape, "size": size}
    record |= {"position": list(position), "quaternion": list(quaternion)}
    record |= {"sha256": mesh_sha256(shape)} if is_mesh_file(shape) else {}
    return Placed(obstacle, point_P3, size * unit_gap, low_3, high_3, record)


def too_near(item: Placed, other: Placed, clearance: float) -> bool:
    bound = clearance + item.gap + other.gap  # if all points are this far apart, the surfaces keep the clearance
    if (item.low > other.high + bound).any() or (item.high < other.low - bound).any():
        return False
    point, obstacle = item.point_P3, item.obstacle
    point = point[((point >= other.low - bound) & (point <= other.high + bound)).all(axis=1)]
    for subset in (point[::FEW], point):  # most overlaps already show at a few points
        if np.isfinite(other.tree.query(subset, distance_upper_bound=bound)[0]).any():
            return True
    # the surfaces do not meet, so a body contains the other body exactly if it contains its first vertex
    holds = contains(obstacle.vertex_V3[:1], other.obstacle) | contains(other.obstacle.vertex_V3[:1], obstacle)
    return bool(holds.any())


def blocked(region: Region, item: Placed, clearance: float) -> bool:
    bound = clearance + item.gap
    centre = np.array(region.centre)
    if (centre - region.reach > item.high + bound).any() or (centre + region.reach < item.low - bound).any():
        return False
    if (region.distances(item.point_P3) < bound).any():
        return True
    return bool(contains(centre[None], item.obstacle)[0])


@dataclass(frozen=True, eq=False)
class Body:
    """The particles of a group."""

    position_N3: np.ndarray
    velocity_3: np.ndarray
    material: str
    record: dict[str, Any]


def filled(
    config: SceneConfig, shape: str, region: Region, material: str, velocity_3: np.ndarray, *, rng: np.random.Generator
) -> Body:
    """Returns a group that fills a region with random particles."""
    count = particle_count(region, config.particles_per_cell, config.cell_size)
    size = (2 * region.reach).tolist()
    record = {
        "shape": shape,
        "size": size if shape == "box" else size[0],
        "position": list(region.centre),
        "material": material,
        "velocity": velocity_3.tolist(),
        "particle_count": count,
    }
    return Body(fill(region, count, rng), velocity_3, material, record)


def thrown(body: Body, velocity_3: np.ndarray) -> Body:
    velocity_3 = velocity_3 + 0.0  # turns -0.0 into 0.0
    return replace(body, velocity_3=velocity_3, record=body.record | {"velocity": velocity_3.tolist()})


def assemble(
    config: SceneConfig,
    seed: int,
    gravity: Vector,
    obstacles: list[Placed],
    bodies: list[Body],
    layout: str | None = None,
) -> Scene:
    """Returns the scene of placed items. `layout` is the scene's kind; None if the config names no kinds."""
    none = np.zeros((0, 3), np.float32)
    counts = [len(body.position_N3) for body in bodies]
    materials = np.array([material_index(body.material) for body in bodies], np.uint8)
    velocities = np.array([body.velocity_3 for body in bodies], np.float32).reshape(-1, 3)
    scene = Scene(
        position_N3=np.concatenate([none, *(body.position_N3 for body in bodies)]),
        velocity_N3=np.repeat(velocities, counts, axis=0),
        material_N=np.repeat(materials, counts),
        obstacles=tuple(item.obstacle for item in obstacles),
        domain_size=config.domain_size,
        cell_size=config.cell_size,
        gravity=gravity,
        seed=seed,
        particles_per_cell=config.particles_per_cell,
        specification={
            "kind": "random",
            "seed": seed,
            "obstacles": [item.record for item in obstacles],
            "groups": [body.record for body in bodies],
            **({} if layout is None else {"layout": layout}),
        },
    )
    return with_drawn_physics(scene, config.own_physics, seed) if config.own_physics else scene


@functools.cache
def unit_surface_points(shape: str) -> tuple[np.ndarray, float]:
    """Returns points on the shape of size 1, and the largest distance of its surface from the nearest of them."""
    vertex, triangle, _ = unit_shape(shape)
    pieces = split_long_edges(vertex[triangle], SURFACE_DETAIL)
    centroid = (pieces[:, 0] + pieces[:, 1] + pieces[:, 2]) / 3
    offset = pieces - centroid[:, None]  # the farthest point of a triangle from its centroid is a corner
    return centroid, float(np.sqrt((offset * offset).sum(axis=2).max())) + ROUNDING


def choice(options: Sequence[str], rng: np.random.Generator) -> str:
    """Returns one of the options with equal probabilities."""
    return options[int(rng.random() * len(options))]
