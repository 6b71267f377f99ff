"""Obstacles that move: material goes along with them, and none comes through."""

import dataclasses

import numpy as np
import pytest

from datagen.mpm.grid_launch import motion_parts
from datagen.mpm.solver import Simulated, simulate
from hgn.config import MpmConfig
from hgn.scene.material import SAND, SNOW, WATER
from hgn.scene.motion import Motion, turned, turning
from hgn.scene.rotation import euler_rotation, rotate
from hgn.scene.scene import Obstacle, Scene
from hgn.schema import ConfigError

CELL, CELLS = 1 / 16, 18
MIDDLE = np.full(3, CELL * CELLS / 2)
CONFIG = MpmConfig(device="cpu")
RATE_HZ = 60.0
QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
TILT = euler_rotation((20.0, 0.0, 10.0))


def plate(height: float, rotation: np.ndarray, closed: bool) -> Obstacle:
    """A wide level sheet so many cells above the middle, or a box that ends there, turned about the middle."""
    corner = np.array([[x, y, z] for x in (-30, 30) for y in (height - 20, height) for z in (-30, 30)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangle = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32)
    if not closed:
        corner, triangle = corner[[2, 6, 7, 3]], QUAD
    return Obstacle("plate", rotate(corner, rotation) * CELL + MIDDLE, triangle, closed)


def moving(obstacle: Obstacle, time: list, translation: list, degrees: list | None = None) -> Obstacle:
    rotation = np.stack([euler_rotation(angles) for angles in degrees or [(0, 0, 0)] * len(time)])
    motion = Motion(np.array(time, float), np.array(translation, float), rotation, tuple(MIDDLE))
    return dataclasses.replace(obstacle, motion=motion)


def block(material: int, low: tuple, size: tuple, rotation: np.ndarray, obstacle: Obstacle, gravity: float) -> Scene:
    count = round(8 * np.prod(size))
    place = np.random.default_rng(0).uniform(0, 1, (count, 3)) * size + low
    return Scene(
        (rotate(place, rotation) * CELL + MIDDLE).astype(np.float32), np.zeros((count, 3), np.float32),
        np.full(count, material, np.uint8), (obstacle,), (CELLS * CELL,) * 3, CELL, (0.0, -gravity, 0.0),
    )  # fmt: skip


def paths(scenes: list[Scene], seconds: float) -> list[np.ndarray]:
    """Places in cells from the middle."""
    outcomes = simulate(scenes, CONFIG, 1 + round(seconds * RATE_HZ), RATE_HZ)
    assert all(isinstance(outcome, Simulated) for outcome in outcomes), outcomes
    return [(outcome.position_TN3.astype(np.float64) - MIDDLE) / CELL for outcome in outcomes]


def test_piston() -> None:
    """A sheet and a tilted body that rise under snow, sand and water hand over the momentum m v along their way, within
    5 %, and less than one in a thousand particles comes through them.
    """
    speed, start, seconds, height = 0.5, 0.1, 0.35, -4.0
    cases = [(SNOW, False, np.eye(3)), (WATER, False, np.eye(3)), (SNOW, True, TILT), (SAND, True, TILT)]
    scenes = []
    for material, closed, rotation in cases:
        up = rotation[:, 1]
        way = speed * (seconds - start) * up
        piston = moving(plate(height, rotation, closed), [start, seconds], [np.zeros(3), way])
        piston = dataclasses.replace(piston, friction=1.0)
        scenes.append(block(material, (-3, height + 0.3, -3), (6, 1.5, 6), rotation, piston, 9.8))
    for (material, _, rotation), path in zip(cases, paths(scenes, seconds), strict=True):
        above = path @ rotation[:, 1] - height
        rise = above.mean(axis=1)
        last = round(0.15 * RATE_HZ)
        gained = (rise[-1] - rise[-1 - last]) * CELL / last * RATE_HZ
        settling = 0.0 if material == SNOW else 0.1 * speed  # water and sand spread meanwhile
        assert 0.95 * speed - settling <= gained <= 1.05 * speed, (material, gained)
        assert (above[-1] < speed * (seconds - start) / CELL).mean() < 1e-3, material


def test_paddle() -> None:
    """A blade from an upright axis to beyond the walls sweeps snow and water before it as it turns; less than one
    particle in a thousand comes through.
    """
    corner = np.array([[0, -12, 0], [12, -12, 0], [12, 12, 0], [0, 12, 0]], float) * CELL + MIDDLE
    blade = moving(Obstacle("blade", corner, QUAD, False), [0.0, 0.3], [(0, 0, 0)] * 2, [(0, 0, 0), (0, 60, 0)])
    scenes = [block(kind, (1, -2, -3.3), (3, 4, 3), np.eye(3), blade, 0.0) for kind in (SNOW, WATER)]
    for path in paths(scenes, 0.3):
        end = rotate(path[-1], euler_rotation((0, -60, 0)))  # in the frame of the blade
        assert ((end[:, 2] > 0) & (end[:, 0] > 0)).mean() < 1e-3
        assert np.linalg.norm(path[-1].mean(axis=0) - path[0].mean(axis=0)) > 1


def test_poses_between_keyframes() -> None:
    """Translation is linear, turning constant; before and after the obstacle stands. Rates are those of the poses."""
    half = euler_rotation((0, 90, 0))
    motion = Motion(np.array([1.0, 2.0]), np.array([[0.0, 0, 0], [2, 0, 0]]), np.stack([np.eye(3), half]), (1, 0, 0))
    point = np.array([[2.0, 0, 0]])
    for time, share in ((0.0, 0.0), (1.0, 0.0), (1.5, 0.5), (2.0, 1.0), (5.0, 1.0)):
        moved = np.array([1 + 2 * share, 0, 0])
        expected = rotate(point - [1, 0, 0], euler_rotation((0, 90 * share, 0))) + moved
        assert np.allclose(motion.place(point, time), expected)
    turn, velocity, pivot = motion.rates(1.25, 1.75)
    assert np.allclose(turn, [0, np.pi / 2, 0]) and np.allclose(velocity, [2, 0, 0]) and np.allclose(pivot, [1.5, 0, 0])
    for turn in ([0, 0, 0], [1e-9, 0, 0], [0.3, -2, 1], [np.pi, 0, 0]):
        assert np.allclose(turning(turned(np.array(turn))), turn, atol=1e-8)


def test_bad_motion_is_refused() -> None:
    """Keyframes out of order, obstacles that fly, and a fixed time step: one line each."""
    still = plate(-4.0, np.eye(3), False)
    with pytest.raises(ConfigError, match=r"keyframes must be in order of time.* got \[1.0, 0.5\]"):
        moving(still, [1.0, 0.5], [(0, 0, 0)] * 2)
    shot = moving(still, [0.0, 0.1], [(0, 0, 0), (0, 90, 0)])
    scene = block(SNOW, (-1, 0, -1), (2, 1, 2), np.eye(3), shot, 9.8)
    with pytest.raises(
        ConfigError, match=r"obstacles\[0\].keyframes of scene 0 must be no faster than 100 cells a frame"
    ):
        motion_parts([scene], 0.0, 1 / RATE_HZ)
    slow = moving(still, [0.0, 0.1], [(0, 0, 0), (0, 0.01, 0)])
    scene = dataclasses.replace(scene, obstacles=(slow,))
    with pytest.raises(ConfigError, match="time_step must be adaptive where obstacles move"):
        simulate([scene], MpmConfig(device="cpu", time_step="fixed"), 2, RATE_HZ)
