"""Leaks through obstacles: paths that cross a triangle, depth behind it, gaps at rest, and projections.

A sheet, a cone and a bowl, at eight offsets within a cell and in three orientations, are hit by a block of each
material at 3 and at 10 m/s. Depth and gap are of particles that a closed body holds out.
Shape legend: T frames, N particles, F triangles.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from datagen.mpm.solver import SceneFailure, Simulated, simulate
from hgn.config import MpmConfig
from hgn.scene.distance import closest_points, contains
from hgn.scene.material import MATERIALS
from hgn.scene.rotation import euler_rotation
from hgn.scene.scene import Obstacle, Scene
from hgn.scene.shapes import shape_obstacle
from tools.stability.row import Row
from tools.stability.solver_scenes import CELL, block

SHAPES = {"sheet": "square", "cone": "cone", "bowl": "half_sphere"}
ORIENTATIONS = {"aligned": (0.0, 0.0, 0.0), "tilted": (27.0, 0.0, 13.0), "turned over": (180.0, 40.0, 0.0)}
OFFSETS = tuple((0.125 * i, 0.37 * i % 1, 0.61 * i % 1) for i in range(8))  # of a cell
SPEEDS = (3.0, 10.0)
FRAME_RATE_HZ = 60.0
SIZE = 0.4
CROSSED_AT_MOST, DEPTH_AT_MOST, GAP_AT_MOST = 1e-3, 0.25, 1.0  # fraction of the paths; cells; cells


def leaks(base: MpmConfig, seconds: float, block_cells: float) -> list[Row]:
    """A row for each shape, orientation, material and speed, over all offsets."""
    keys = [
        (shape, turn, kind, speed)
        for shape in SHAPES
        for turn in ORIENTATIONS
        for kind in range(len(MATERIALS))
        for speed in SPEEDS
    ]
    scenes = [_scene(*key, offset, block_cells) for key in keys for offset in OFFSETS]
    frames = 1 + round(seconds * FRAME_RATE_HZ)
    outcomes = simulate(scenes, base, frames, FRAME_RATE_HZ)
    with ThreadPoolExecutor() as pool:
        found = list(pool.map(_measure, scenes, outcomes))
    rows = []
    for index, (shape, turn, kind, speed) in enumerate(keys):
        own = found[index * len(OFFSETS) : (index + 1) * len(OFFSETS)]
        rows.append(_row(f"leak, {shape} {turn}, {MATERIALS[kind]} at {speed:g} m/s", own, base))
    return rows


def _row(name: str, found: list[dict[str, float] | str], base: MpmConfig) -> Row:
    stopped = [item for item in found if isinstance(item, str)]
    if stopped:
        return Row(name, CROSSED_AT_MOST, "stopped", False, stopped[0])
    own = [item for item in found if not isinstance(item, str)]
    worst = {key: max(item[key] for item in own) for key in own[0]}
    held = worst["crossed"] <= CROSSED_AT_MOST and worst["depth_p99_cells"] <= DEPTH_AT_MOST
    held = held and worst["gap_cells"] <= GAP_AT_MOST
    beyond = (
        f"99 % of depths {worst['depth_p99_cells']:.2g} cells, gap {worst['gap_cells']:.2g} cells, "
        f"{worst['projections']:.1e} projections a particle-step"
    )
    return Row(name, CROSSED_AT_MOST, worst["crossed"], held, beyond, {key: float(worst[key]) for key in worst})


def _scene(shape: str, turn: str, kind: int, speed: float, offset: tuple[float, float, float], size: float) -> Scene:
    centre = tuple(0.5 + CELL * shift - (0.12 if axis == 1 else 0.0) for axis, shift in enumerate(offset))
    obstacle = shape_obstacle(SHAPES[shape], SIZE, centre, euler_rotation(ORIENTATIONS[turn]))  # type: ignore[arg-type]
    low = 32 - size / 2
    height = float(obstacle.vertex_V3[:, 1].max()) / CELL + 1.5
    return block(kind, (low, height, low), (size, size, size), (0, -speed, 0), obstacles=(obstacle,))


def _measure(scene: Scene, outcome: Simulated | SceneFailure) -> dict[str, float] | str:
    if isinstance(outcome, SceneFailure):
        return outcome.cause
    (obstacle,) = scene.obstacles
    path = outcome.position_TN3
    crossed = _crossing_paths(path, obstacle.vertex_V3[obstacle.triangle_F3])
    depth, gap = 0.0, 0.0
    end = path[-1]
    distance = _distances(end, obstacle) / CELL
    if obstacle.closed:
        inside = contains(end, obstacle)
        depth = float(np.quantile(np.where(inside, distance, 0.0), 0.99))
    near = distance[distance < 2.0]
    if len(near) >= 20:  # of what rests on it, the lowest layer
        gap = float(np.quantile(near, 0.05))
    steps = outcome.counters["substeps"] * scene.particle_count
    return {
        "crossed": crossed,
        "depth_p99_cells": depth,
        "gap_cells": gap,
        "projections": outcome.counters["surface_projections"] / steps,
    }


def _distances(point_N3: np.ndarray, obstacle: Obstacle) -> np.ndarray:
    triangle_F33 = obstacle.vertex_V3[obstacle.triangle_F3]
    best = np.full(len(point_N3), np.inf)
    for corner in triangle_F33:
        foot = closest_points(point_N3.astype(np.float64), np.broadcast_to(corner, (len(point_N3), 3, 3)))
        best = np.minimum(best, np.linalg.norm(point_N3 - foot, axis=1))
    return best


def _crossing_paths(path_TN3: np.ndarray, triangle_F33: np.ndarray) -> float:
    """The fraction of particles whose way from frame to frame crosses a triangle (Möller, Trumbore 1997)."""
    start, way = path_TN3[:-1].astype(np.float64), np.diff(path_TN3.astype(np.float64), axis=0)
    crossed = np.zeros(path_TN3.shape[1], bool)
    inner: Callable[[np.ndarray, np.ndarray], np.ndarray] = lambda a, b: np.einsum("...i,...i->...", a, b)  # noqa: E731
    for corner in triangle_F33:
        edge_1, edge_2 = corner[1] - corner[0], corner[2] - corner[0]
        normal = np.cross(edge_1, edge_2)
        before, step = (start - corner[0]) @ normal, way @ normal
        near = (before > 0) != (before + step > 0)
        frame, particle = np.nonzero(near)
        if not len(frame):
            continue
        fraction = -before[near] / step[near]
        place = start[frame, particle] + fraction[:, None] * way[frame, particle] - corner[0]
        u = inner(np.cross(place, edge_2), normal) / inner(normal, normal)
        v = inner(np.cross(edge_1, place), normal) / inner(normal, normal)
        crossed[particle[(u >= 0) & (v >= 0) & (u + v <= 1)]] = True
    return float(crossed.mean())
