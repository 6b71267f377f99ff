"""Leaks through obstacles: paths that cross a triangle, depth behind it, gaps at rest, and projections.

A sheet from wall to wall, a cone and a bowl, at eight offsets within a cell and in three orientations, are hit by a
block of each material at 3 and at 10 m/s: 432 scenes in one batch, each in a domain little larger than its obstacle.
Depth is of particles that a closed body holds out, gap of those that lie within three cells above the obstacle at the
end.
Shape legend: T frames, N particles, F triangles.
"""

from __future__ import annotations

import dataclasses
import itertools
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np

from datagen.mpm.collider import build_collider
from datagen.mpm.solver import SceneFailure, Simulated, simulate
from datagen.mpm.sweep import near_pairs
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
IMPACT_FRAMES, LATER = 120, 8  # after so many frames every eighth is looked at
DOMAIN_CELLS = 32
CENTRE = np.array([16.0, 11, 16])  # of an obstacle without offset, in cells
SIZE, SHEET = 12.8, 80.0  # of obstacles and of sheets, in cells
GAP_CELLS = 1.5  # between obstacle and block
NEAR_CELLS, NEAR_PARTICLES = 3.0, 20
WAYS_AT_ONCE = 2_000_000
FINER = 4
PROCESSES_FROM_FRAMES = 20_000  # of all scenes
CROSSED_AT_MOST, DEPTH_AT_MOST, GAP_AT_MOST = 1e-3, 0.25, 1.0  # fraction of the paths; cells; cells
AT_REST_S = 3.0  # from when on a gap is one at rest


def leaks(base: MpmConfig, seconds: float, block_cells: float, offsets: int = len(OFFSETS)) -> list[Row]:
    """A row for each shape, orientation, material and speed: the share of paths of all offsets that cross; of depth
    and projections the worst. From AT_REST_S on also a row for the gap of each shape, orientation and material.
    """
    keys = list(itertools.product(SHAPES, ORIENTATIONS, range(len(PAPER_MATERIALS)), SPEEDS))
    frames = 1 + max(1, round(seconds * FRAME_RATE_HZ))
    # Taichi's process cannot be forked; a few scenes are done sooner here
    many = len(keys) * offsets * frames >= PROCESSES_FROM_FRAMES
    workers = max(1, available_cpus() - 1)
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) if many else ThreadPoolExecutor() as pool:
        scenes = [scene(*key, offset, block_cells) for key in keys for offset in OFFSETS[:offsets]]
        colliders = list(pool.map(build_collider, scenes, [base.collider_band_cells] * len(scenes)))
        outcomes = simulate(scenes, base, frames, FRAME_RATE_HZ, colliders=colliders)
        measured = list(pool.map(_measure, scenes, map(_looked_at, outcomes)))
    rows: list[Row] = []
    gaps: dict[str, float] = {}
    for index, (shape, turn, kind, speed) in enumerate(keys):
        own = slice(index * offsets, (index + 1) * offsets)
        causes = [outcome.cause for outcome in outcomes[own] if isinstance(outcome, SceneFailure)]
        case = f"{shape} {turn}, {MATERIALS[kind]}"
        rows.append(_row(f"leak, {case} at {speed:g} m/s", measured[own], causes))
        gap = max(item.get("gap_cells", 0.0) for item in measured[own])
        gaps[f"gap, {case}"] = max(gap, gaps.get(f"gap, {case}", 0.0))
    if seconds >= AT_REST_S:
        beyond = "cells, of the lowest twentieth of what lies on it"
        rows += [within(name, GAP_AT_MOST, gap, beyond) for name, gap in gaps.items() if gap]
    return rows


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
    """A block of `size` cells above an obstacle in the middle of a small domain; a sheet reaches from wall to wall."""
    centre = CENTRE + np.asarray(offset)
    side = SHEET if shape == "sheet" else SIZE
    obstacle = shape_obstacle(SHAPES[shape], side * CELL, tuple(centre * CELL), euler_rotation(ORIENTATIONS[turn]))
    low, domain_size = DOMAIN_CELLS / 2 - size / 2, (DOMAIN_CELLS * CELL,) * 3
    # what a tilted sheet rises by under the block
    top = min(float(obstacle.vertex_V3[:, 1].max()) / CELL, centre[1] + (size if shape == "sheet" else np.inf))
    corner, sides = (low, top + GAP_CELLS, low), (size, size, size)
    return block(kind, corner, sides, (0, -speed, 0), obstacles=(obstacle,), domain_size=domain_size)


def _looked_at(outcome: Simulated | SceneFailure) -> Simulated | SceneFailure:
    """All frames of the impact, fewer later, and the last."""
    if isinstance(outcome, SceneFailure):
        return outcome
    path = outcome.position_TN3
    path = np.concatenate([path[:IMPACT_FRAMES], path[IMPACT_FRAMES::LATER], path[-1:]])
    return dataclasses.replace(outcome, position_TN3=path)


def _measure(scene: Scene, outcome: Simulated | SceneFailure) -> dict[str, float]:
    """Of a scene that was stopped nothing."""
    if isinstance(outcome, SceneFailure):
        return {}
    (obstacle,), end, counters = scene.obstacles, outcome.position_TN3[-1], outcome.counters
    distance, above = _distances(end, obstacle)
    depth = np.quantile(np.where(contains(end, obstacle), distance, 0.0), 0.99) if obstacle.closed else 0.0
    near = distance[above & (distance < NEAR_CELLS)]  # of what rests on it, the lowest layer
    return {
        "crossed": crossing_paths(outcome.position_TN3, obstacle.vertex_V3[obstacle.triangle_F3], rim(obstacle)),
        "depth_p99_cells": float(depth),
        "gap_cells": float(np.quantile(near, 0.05)) if len(near) >= NEAR_PARTICLES else 0.0,
        "projections": counters["surface_projections"] / (counters["substeps"] * scene.particle_count),
    }


def _distances(point_N3: np.ndarray, obstacle: Obstacle) -> tuple[np.ndarray, np.ndarray]:
    """How far each point is from the obstacle, in cells, and whether it lies above its nearest place there."""
    best, above = np.full(len(point_N3), np.inf), np.zeros(len(point_N3), bool)
    for corner in obstacle.vertex_V3[obstacle.triangle_F3]:
        foot = closest_points(point_N3.astype(np.float64), np.broadcast_to(corner, (len(point_N3), 3, 3)))
        distance = np.linalg.norm(point_N3 - foot, axis=1) / CELL
        above = np.where(distance < best, point_N3[:, 1] > foot[:, 1], above)
        best = np.minimum(best, distance)
    return best, above


def crossing_paths(path_TN3: np.ndarray, triangle_F33: np.ndarray, rim_E23: np.ndarray | None = None) -> float:
    """The fraction of particles with a way from frame to frame that crosses triangles (Möller, Trumbore 1997) an odd
    number of times: the straight line between two places on one side of a bent surface may cut it twice. One that
    begins or ends nearer to an edge of `rim_E23` than it is long is left out: it may have led around it.

    Ways are looked up by cells, short ones by finer cells: only those that begin within two cells of a triangle's box
    are tried against it. One longer than a cell is tried against all.
    """
    count = path_TN3.shape[1]
    start = path_TN3[:-1].reshape(-1, 3).astype(np.float64) / CELL
    way = np.diff(path_TN3.astype(np.float64), axis=0).reshape(-1, 3) / CELL
    particle = np.tile(np.arange(count), len(path_TN3) - 1)
    triangle = triangle_F33 / CELL
    crossings = np.zeros(len(start), np.int64)
    longest = np.abs(way).max(axis=1)
    long = np.flatnonzero(longest > 1)
    for corner in range(len(triangle)):
        crossings[long] += _crosses(start[long], way[long], triangle[np.full(len(long), corner)])
    short = longest <= 1 / FINER
    for scale, chosen in ((1, (longest <= 1) & ~short), (FINER, short)):
        crossings[chosen] = _count_crossings(scale * start[chosen], scale * way[chosen], scale * triangle)
    odd = np.flatnonzero(crossings % 2)
    if rim_E23 is not None and len(rim_E23):
        length = np.linalg.norm(way[odd], axis=1)
        edge = (rim_E23 / CELL)[:, [0, 1, 1]].repeat(len(odd), axis=0)  # closest_points takes segments too
        near = np.zeros(len(odd), bool)
        for place in (start[odd], start[odd] + way[odd]):
            many = np.tile(place, (len(rim_E23), 1))
            away = np.linalg.norm(many - closest_points(many, edge), axis=1).reshape(len(rim_E23), -1)
            near |= away.min(axis=0, initial=np.inf) <= length
        odd = odd[~near]
    crossed = np.zeros(count, bool)
    crossed[particle[odd]] = True
    return float(crossed.mean())


def _count_crossings(start_P3: np.ndarray, way_P3: np.ndarray, triangle_F33: np.ndarray) -> np.ndarray:
    """How many triangles each way leads through, int64 [P]; no way may be longer than one along an axis."""
    crossings = np.zeros(len(start_P3), np.int64)
    if not len(start_P3):
        return crossings
    low = np.floor(start_P3.min(axis=0)).astype(np.int64)
    shape = tuple(np.floor(start_P3.max(axis=0)).astype(np.int64) - low + 1)
    cell = np.ravel_multi_index((np.floor(start_P3).astype(np.int64) - low).T, shape)
    order = np.argsort(cell, kind="stable")
    cell = cell[order]
    for place, owner in near_pairs(triangle_F33 - low, 2.0, shape):
        flat = np.ravel_multi_index(tuple(place), shape)
        begin, end = np.searchsorted(cell, flat), np.searchsorted(cell, flat, side="right")
        for part in np.array_split(np.arange(len(flat)), 1 + int((end - begin).sum()) // WAYS_AT_ONCE):
            many = (end - begin)[part]
            within = np.arange(many.sum()) - np.repeat(np.cumsum(many) - many, many)
            own = order[np.repeat(begin[part], many) + within]
            hit = _crosses(start_P3[own], way_P3[own], triangle_F33[np.repeat(owner[part], many)])
            crossings += np.bincount(own[hit], minlength=len(start_P3))
    return crossings


def rim(obstacle: Obstacle) -> np.ndarray:
    """The edges that only one triangle has, [E, 2, 3]."""
    edges = np.sort(np.asarray(obstacle.triangle_F3)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edge, uses = np.unique(edges, axis=0, return_counts=True)
    return np.asarray(obstacle.vertex_V3, np.float64)[edge[uses == 1]]


def _crosses(start_P3: np.ndarray, way_P3: np.ndarray, triangle_P33: np.ndarray) -> np.ndarray:
    """Which ways lead through their triangle, bool [P]."""
    edge_1, edge_2 = triangle_P33[:, 1] - triangle_P33[:, 0], triangle_P33[:, 2] - triangle_P33[:, 0]
    normal = np.cross(edge_1, edge_2)
    before, step = _inner(start_P3 - triangle_P33[:, 0], normal), _inner(way_P3, normal)
    passes = np.flatnonzero((before > 0) != (before + step > 0))
    edge_1, edge_2, normal = edge_1[passes], edge_2[passes], normal[passes]
    fraction = -before[passes] / step[passes]
    place = start_P3[passes] + fraction[:, None] * way_P3[passes] - triangle_P33[passes, 0]
    u = _inner(np.cross(place, edge_2), normal) / _inner(normal, normal)
    v = _inner(np.cross(edge_1, place), normal) / _inner(normal, normal)
    hit = np.zeros(len(start_P3), bool)
    hit[passes[(u >= 0) & (v >= 0) & (u + v <= 1)]] = True
    return hit


def _inner(a_P3: np.ndarray, b_P3: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("pi,pi->p", a_P3, b_P3))
