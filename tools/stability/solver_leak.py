"""Leaks through obstacles: paths across a triangle, depths in closed bodies, gaps at rest, and projections.

Blocks of each material hit a sheet, a cone and a bowl at 3 and at 10 m/s, at eight offsets within a cell and in three
orientations: 432 scenes in one batch. Gaps are of the particles within three cells above the obstacle at the end.
Shape legend: T frames, N particles, F triangles.
"""

from __future__ import annotations

import dataclasses
import itertools
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np

from datagen.mpm.collider import build_collider
from datagen.mpm.solver import SceneFailure, Simulated, simulate
from hgn.config import MpmConfig
from hgn.scene.distance import closest_points, contains
from hgn.scene.material import MATERIALS, PAPER_MATERIALS
from hgn.scene.rotation import euler_rotation
from hgn.scene.scene import Obstacle, Scene
from hgn.scene.shapes import shape_obstacle
from hgn.system.machine import available_cpus
from tools.stability.row import Row, within
from tools.stability.solver_scenes import CELL, ORIENTATIONS, block

SHAPES = {"sheet": "square", "cone": "cone", "bowl": "half_sphere"}
OFFSETS = tuple((0.125 * i, 0.37 * i % 1, 0.61 * i % 1) for i in range(8))  # of a cell
SPEEDS = (3.0, 10.0)
FRAME_RATE_HZ = 240.0
IMPACT_FRAMES, LATER = 120, 8  # first frames, all of which are measured; stride of the later ones
DOMAIN_CELLS = 32
CENTRE = np.array([16.0, 11, 16])  # of an obstacle without offset, cells
SIZE, SHEET = 12.8, 80.0  # of obstacles and of sheets, in cells
GAP_CELLS = 1.5  # between obstacle and block
NEAR_CELLS, NEAR_PARTICLES = 3.0, 20
BLOCK_CELLS, SECONDS = 4.0, 5.0
PROCESSES_FROM_FRAMES = 20_000  # of all scenes
CROSSED_AT_MOST, DEPTH_AT_MOST, GAP_AT_MOST = 1e-3, 0.25, 1.0  # fraction of the paths; cells; cells
AT_REST_S = 3.0  # time from which on gaps are measured


def leaks(base: MpmConfig) -> Iterator[Row]:
    """Yields the fraction of paths that cross, by shape, orientation, material and speed, over all offsets.

    Depths and projections are the worst. Gaps follow, by shape, orientation and material.
    """
    keys = list(itertools.product(SHAPES, ORIENTATIONS, range(len(PAPER_MATERIALS)), SPEEDS))
    frames, offsets = 1 + max(1, round(SECONDS * FRAME_RATE_HZ)), len(OFFSETS)
    many = len(keys) * offsets * frames >= PROCESSES_FROM_FRAMES  # starting processes takes seconds
    workers = max(1, available_cpus() - 1)
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) if many else ThreadPoolExecutor() as pool:
        scenes = [scene(*key, offset, BLOCK_CELLS) for key in keys for offset in OFFSETS]
        colliders = list(pool.map(build_collider, scenes, [base.choices.collider_band_cells] * len(scenes)))
        outcomes = simulate(scenes, base, frames, FRAME_RATE_HZ, colliders=colliders)
        measured = list(pool.map(_measure, scenes, map(_thinned, outcomes)))
    gaps: dict[str, float] = {}
    for index, (shape, turn, kind, speed) in enumerate(keys):
        own = slice(index * offsets, (index + 1) * offsets)
        causes = [outcome.cause for outcome in outcomes[own] if isinstance(outcome, SceneFailure)]
        case = f"{shape} {turn}, {MATERIALS[kind]}"
        yield _row(f"leak, {case} at {speed:g} m/s", measured[own], causes)
        gap = max(item.get("gap_cells", 0.0) for item in measured[own])
        gaps[f"gap, {case}"] = max(gap, gaps.get(f"gap, {case}", 0.0))
    if SECONDS >= AT_REST_S:
        beyond = "cells, of the lowest twentieth of the particles on it"
        yield from (within(name, GAP_AT_MOST, gap, beyond) for name, gap in gaps.items() if gap)


def _row(name: str, measured: Sequence[dict[str, float]], causes: Sequence[str]) -> Row:
    if causes:
        return Row(name, CROSSED_AT_MOST, "stopped", False, causes[0])
    worst = {key: max(item[key] for item in measured) for key in measured[0]}
    worst["crossed"] = sum(item["crossed"] for item in measured) / len(measured)
    depth, projections = worst["depth_p99_cells"], worst["projections"]
    held = worst["crossed"] <= CROSSED_AT_MOST and depth <= DEPTH_AT_MOST
    beyond = f"99 % of depths {depth:.2g} cells, {projections:.1e} projections a particle-step"
    return Row(name, CROSSED_AT_MOST, worst["crossed"], held, beyond, worst)


def scene(shape: str, turn: str, kind: int, speed: float, offset: Sequence[float], size: float) -> Scene:
    """Returns a block of `size` cells above an obstacle in a small domain; a sheet reaches from wall to wall."""
    centre = CENTRE + np.asarray(offset)
    side = SHEET if shape == "sheet" else SIZE
    obstacle = shape_obstacle(SHAPES[shape], side * CELL, tuple(centre * CELL), euler_rotation(ORIENTATIONS[turn]))
    low, domain_size = DOMAIN_CELLS / 2 - size / 2, (DOMAIN_CELLS * CELL,) * 3
    # a tilted sheet rises under the block
    top = min(float(obstacle.vertex_V3[:, 1].max()) / CELL, centre[1] + (size if shape == "sheet" else np.inf))
    corner, sides = (low, top + GAP_CELLS, low), (size, size, size)
    return block(kind, corner, sides, (0, -speed, 0), obstacles=(obstacle,), domain_size=domain_size)


def _thinned(outcome: Simulated | SceneFailure) -> Simulated | SceneFailure:
    """Keeps all frames of the impact, some later ones, and the last."""
    if isinstance(outcome, SceneFailure):
        return outcome
    path = outcome.position_TN3
    path = np.concatenate([path[:IMPACT_FRAMES], path[IMPACT_FRAMES::LATER], path[-1:]])
    return dataclasses.replace(outcome, position_TN3=path)


def _measure(scene: Scene, outcome: Simulated | SceneFailure) -> dict[str, float]:
    """Returns the figures of a scene, none of a stopped one."""
    if isinstance(outcome, SceneFailure):
        return {}
    (obstacle,), end, counters = scene.obstacles, outcome.position_TN3[-1], outcome.counters
    distance, above = _distances(end, obstacle)
    depth = np.quantile(np.where(contains(end, obstacle), distance, 0.0), 0.99) if obstacle.closed else 0.0
    near = distance[above & (distance < NEAR_CELLS)]  # the lowest layer of resting particles
    return {
        "crossed": crossing_paths(outcome.position_TN3, obstacle.vertex_V3[obstacle.triangle_F3], rim(obstacle)),
        "depth_p99_cells": float(depth),
        "gap_cells": float(np.quantile(near, 0.05)) if len(near) >= NEAR_PARTICLES else 0.0,
        "projections": counters["surface_projections"] / (counters["substeps"] * scene.particle_count),
    }


def _distances(point_N3: np.ndarray, obstacle: Obstacle) -> tuple[np.ndarray, np.ndarray]:
    """Returns each point's distance from the obstacle, in cells, and whether it is above the nearest place there."""
    best, above = np.full(len(point_N3), np.inf), np.zeros(len(point_N3), bool)
    for corner in obstacle.vertex_V3[obstacle.triangle_F3]:
        foot = closest_points(point_N3.astype(np.float64), np.broadcast_to(corner, (len(point_N3), 3, 3)))
        distance = np.linalg.norm(point_N3 - foot, axis=1) / CELL
        above = np.where(distance < best, point_N3[:, 1] > foot[:, 1], above)
        best = np.minimum(best, distance)
    return best, above


def crossing_paths(path_TN3: np.ndarray, triangle_F33: np.ndarray, rim_E23: np.ndarray | None = None) -> float:
    """Returns the fraction of particles that cross a surface of triangles (Möller, Trumbore 1997).

    A straight step from frame to frame crosses if it cuts an odd number of triangles: between two places on one side
    of a bent surface it may cut two. A step is ignored if its length exceeds its distance from an edge of `rim_E23`:
    the particle may have moved around the edge.
    """
    count = path_TN3.shape[1]
    path_TN3 = path_TN3.astype(np.float64) / CELL
    start, end = path_TN3[:-1].reshape(-1, 3), path_TN3[1:].reshape(-1, 3)
    low, high = np.minimum(start, end), np.maximum(start, end)
    crossings = np.zeros(len(start), np.int64)
    for corner in triangle_F33 / CELL:
        near = np.flatnonzero(((low <= corner.max(axis=0)) & (high >= corner.min(axis=0))).all(axis=1))
        crossings[near] += _crosses(start[near], end[near] - start[near], corner)
    odd = np.flatnonzero(crossings % 2)
    if rim_E23 is not None and len(rim_E23):
        length = np.linalg.norm(end[odd] - start[odd], axis=1)
        edge = (rim_E23 / CELL)[:, [0, 1, 1]].repeat(len(odd), axis=0)  # closest_points also takes segments
        near = np.zeros(len(odd), bool)
        for place in (start[odd], end[odd]):
            many = np.tile(place, (len(rim_E23), 1))
            away = np.linalg.norm(many - closest_points(many, edge), axis=1).reshape(len(rim_E23), -1)
            near |= away.min(axis=0, initial=np.inf) <= length
        odd = odd[~near]
    crossed = np.zeros(count, bool)
    crossed[odd % count] = True
    return float(crossed.mean())


def rim(obstacle: Obstacle) -> np.ndarray:
    """Returns the edges of only one triangle, [E, 2, 3]."""
    edges = np.sort(np.asarray(obstacle.triangle_F3)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edge, uses = np.unique(edges, axis=0, return_counts=True)
    return np.asarray(obstacle.vertex_V3, np.float64)[edge[uses == 1]]


def _crosses(start_P3: np.ndarray, way_P3: np.ndarray, triangle_33: np.ndarray) -> np.ndarray:
    """Returns which steps cut a triangle, bool [P]."""
    edge_1, edge_2 = triangle_33[1:] - triangle_33[0]
    normal = np.cross(edge_1, edge_2)
    before, step = (start_P3 - triangle_33[0]) @ normal, way_P3 @ normal
    passes = np.flatnonzero((before > 0) != (before + step > 0))
    fraction = -before[passes] / step[passes]
    place = start_P3[passes] + fraction[:, None] * way_P3[passes] - triangle_33[0]
    u = np.cross(place, edge_2) @ normal / (normal @ normal)
    v = np.cross(edge_1, place) @ normal / (normal @ normal)
    hit = np.zeros(len(start_P3), bool)
    hit[passes[(u >= 0) & (v >= 0) & (u + v <= 1)]] = True
    return hit
