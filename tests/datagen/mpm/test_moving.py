"""Tests moving obstacles: they move material with them, and no particle passes."""

import dataclasses

import numpy as np
import pytest
from mpm_scenes import BOX, CELL, CONFIG, QUAD, box_corners, particles, sheet, simulated

from datagen.mpm.solver import simulate
from hgn.config import MpmConfig
from hgn.scene.material import MATERIALS, SAND, SNOW, WATER
from hgn.scene.motion import Motion, turned, turning
from hgn.scene.rotation import euler_rotation, rotate
from hgn.scene.scene import Obstacle
from hgn.schema import ConfigError
from hgn.solver_method import SPEED_FRACTION

CELLS = 18
MIDDLE = np.full(3, CELL * CELLS / 2)
RATE_HZ = 60.0
TILT = euler_rotation((20.0, 0.0, 10.0))


def plate(height, rotation, closed):
    """A wide level sheet so many cells above the middle, or a box that ends there, turned about the middle."""
    corner, triangle = box_corners((-30, height - 20, -30), (30, height, 30)), BOX
    if not closed:
        corner, triangle = corner[[2, 6, 7, 3]], QUAD
    return Obstacle("plate", rotate(corner, rotation) * CELL + MIDDLE, triangle, closed)


def wide_sheet(floor):
    """A level one so many cells high, from wall to wall."""
    return sheet(floor * CELL, -9 * CELL, 30 * CELL)


def moving(obstacle, time, translation, degrees=None):
    rotation = np.stack([euler_rotation(angles) for angles in degrees or [(0, 0, 0)] * len(time)])
    motion = Motion(np.array(time, float), np.array(translation, float), rotation, tuple(MIDDLE))
    return dataclasses.replace(obstacle, motion=motion)


def block(material, low, size, rotation, obstacle, gravity):
    count = round(8 * np.prod(size))
    place = rotate(np.random.default_rng(0).uniform(0, 1, (count, 3)) * size + low, rotation) * CELL + MIDDLE
    domain = (CELLS * CELL,) * 3
    return particles(place, material, obstacles=(obstacle,), domain_size=domain, gravity=(0.0, -gravity, 0.0))


def paths(scenes, seconds):
    """In cells from the middle. A sheet that does not move lets tests share one compiled kernel."""
    place = np.full(3, 4.5 * CELL)
    beside = particles(place, obstacles=(wide_sheet(2.5),), domain_size=scenes[0].domain_size)
    outcomes = simulated([*scenes, beside], frames=1 + round(seconds * RATE_HZ))[:-1]
    return [(outcome.position_TN3.astype(np.float64) - MIDDLE) / CELL for outcome in outcomes]


def test_piston():
    """In a tube a sheet that rises hands the momentum m v over to whatever lies on it, within 5 %."""
    speed, start, seconds, wide, floor = 0.5, 0.1, 0.35, 4, 4.0
    size = np.array([wide, 1.5, wide])
    count = round(8 * np.prod(size))
    place = np.random.default_rng(0).uniform(0, 1, (count, 3)) * size + [2, floor + 0.02, 2]  # from wall to wall
    way = [0.0, speed * (seconds - start), 0.0]
    piston = moving(wide_sheet(floor), [start, seconds], [np.zeros(3), way])
    tube = {"domain_size": ((wide + 5) * CELL, 16 * CELL, (wide + 5) * CELL), "particles_per_cell": 8.0}
    scenes = [particles(place * CELL, kind, obstacles=(piston,), **tube) for kind in range(len(MATERIALS))]
    last = round(0.15 * RATE_HZ)
    for name, path in zip(MATERIALS, paths(scenes, seconds), strict=True):
        height = path[:, :, 1].mean(axis=1) * CELL
        assert (height[-1] - height[-1 - last]) / last * RATE_HZ == pytest.approx(speed, rel=0.05), name


def test_tilted_piston():
    """Fewer than one in a thousand particles pass tilted bodies that rise under snow and sand. Snow, which does not
    spread meanwhile, moves at their speed to within 5 %."""
    speed, start, seconds, height = 0.5, 0.1, 0.35, -4.0
    way = speed * (seconds - start) * TILT[:, 1]
    piston = moving(plate(height, TILT, True), [start, seconds], [np.zeros(3), way])
    piston = dataclasses.replace(piston, friction=1.0)
    scenes = [block(kind, (-3, height + 0.3, -3), (6, 1.5, 6), TILT, piston, 9.8) for kind in (SNOW, SAND)]
    last = round(0.15 * RATE_HZ)
    snow, sand = (path @ TILT[:, 1] - height for path in paths(scenes, seconds))
    rise = snow.mean(axis=1) * CELL
    assert (rise[-1] - rise[-1 - last]) / last * RATE_HZ == pytest.approx(speed, rel=0.05)
    for above in (snow, sand):
        assert (above[-1] < speed * (seconds - start) / CELL).mean() < 1e-3


def test_paddle():
    """A block before a smooth blade that turns ever faster, by a t² / 2, turns with it and slides along it, as a rigid
    body does: R'' = w² R + d a, with R along the blade to its centre and d across. Its angular momentum about the axis,
    w (R² + d² + k²) - d R', k its radius of gyration, is that within 5 %. Sand, which spreads over the blade, is swept
    along as well: less than one particle in a thousand comes through.
    """
    seconds, faster, middle = 0.3, 18.0, np.full(3, 12 * CELL)
    time = np.linspace(0, seconds, 21)
    corner = np.array([[0, -5, 0], [7, -5, 0], [7, 5, 0], [0, 5, 0]], float) * CELL + middle
    turns = np.stack([euler_rotation((0, np.degrees(faster * t * t / 2), 0)) for t in time])
    blade = Obstacle("blade", corner, QUAD, False, motion=Motion(time, np.zeros((21, 3)), turns, tuple(middle)))
    place = np.random.default_rng(0).uniform(0, 1, (192, 3)) * [2, 4, 3] + [1.5, -2, -3.1]
    room = {"obstacles": (blade,), "domain_size": (24 * CELL,) * 3, "gravity": (0.0, 0.0, 0.0)}
    scenes = [particles(place * CELL + middle, kind, **room) for kind in (SNOW, SAND)]
    across, gyration = -place[:, 2].mean(), place[:, [0, 2]].var(axis=0).sum()
    step, along, sliding, closed = 1e-4, place[:, 0].mean(), 0.0, []
    for turned_s in np.arange(step, seconds, step):
        rate = faster * turned_s
        sliding += step * (rate * rate * along + across * faster)
        along += step * sliding
        closed.append(rate * (along**2 + across**2 + gyration) - across * sliding)
    back = euler_rotation((0, -np.degrees(faster * seconds**2 / 2), 0))
    for kind, path in zip((SNOW, SAND), paths(scenes, seconds), strict=True):
        path += (MIDDLE - middle) / CELL
        end = rotate(path[-1], back)  # in the frame of the blade
        assert ((end[:, 2] > 0) & (end[:, 0] > 0)).mean() < 1e-3
        assert np.linalg.norm(path[-1].mean(axis=0) - path[0].mean(axis=0)) > 1
        if kind != SNOW:
            continue
        v, x = np.diff(path, axis=0) * RATE_HZ, 0.5 * (path[1:] + path[:-1])
        found = (x[:, :, 2] * v[:, :, 0] - x[:, :, 0] * v[:, :, 2]).mean(axis=1)
        for frame in (10, len(v) - 1):
            assert found[frame] == pytest.approx(closed[round((frame + 0.5) / RATE_HZ / step)], rel=0.05)


def test_poses_between_keyframes():
    """Translation is linear, turning constant; before and after the obstacle stands."""
    half = euler_rotation((0, 90, 0))
    motion = Motion(np.array([1.0, 2.0]), np.array([[0.0, 0, 0], [2, 0, 0]]), np.stack([np.eye(3), half]), (1, 0, 0))
    point = np.array([[2.0, 0, 0]])
    for time, share in ((0.0, 0.0), (1.0, 0.0), (1.5, 0.5), (2.0, 1.0), (5.0, 1.0)):
        moved = np.array([1 + 2 * share, 0, 0])
        expected = rotate(point - [1, 0, 0], euler_rotation((0, 90 * share, 0))) + moved
        assert np.allclose(motion.place(point, time), expected)
    for turn in ([0, 0, 0], [1e-9, 0, 0], [0.3, -2, 1], [np.pi, 0, 0]):
        assert np.allclose(turning(turned(np.array(turn))), turn, atol=1e-8)


def test_bad_motion_is_refused():
    """Keyframes out of order, obstacles that fly, and a fixed time step: one line each."""
    still = plate(-4.0, np.eye(3), False)
    with pytest.raises(ConfigError, match=r"keyframes must be in order of time.* got \[1.0, 0.5\]"):
        moving(still, [1.0, 0.5], [(0, 0, 0)] * 2)
    shot = moving(still, [0.0, 0.1], [(0, 0, 0), (0, 90, 0)])
    scene = block(SNOW, (-1, 0, -1), (2, 1, 2), np.eye(3), shot, 9.8)
    message = r"obstacles\[0\].keyframes of scene 0 must be no faster than 100 cells a frame"
    with pytest.raises(ConfigError, match=message):
        simulate([scene], CONFIG, 2, RATE_HZ)
    slow = moving(still, [0.0, 0.1], [(0, 0, 0), (0, 0.01, 0)])
    scene = dataclasses.replace(scene, obstacles=(slow,))
    with pytest.raises(ConfigError, match="fixed_time_step_s must be null if obstacles move"):
        simulate([scene], MpmConfig(device="cpu", fixed_time_step_s=1e-3), 2, RATE_HZ)


def test_scenes_at_rest_do_not_depend_on_moving_ones():
    """In a launch with a scene that moves, scenes at rest have the bits that they have without it."""
    lift = moving(wide_sheet(2.5), [0.0, 1.0], [np.zeros(3), np.array([0.0, 3.0, 0.0])])
    place = CELL * np.array([[4.5, height, 4.5] for height in (5, 6, 7, 8)])
    own = {"domain_size": (CELLS * CELL,) * 3}
    still = [particles(place + shift * CELL, range(4), obstacles=(wide_sheet(2.5),), **own) for shift in (0, 1)]
    moved = particles(place, range(4), obstacles=(lift,), **own)
    frames = []
    mixed = simulated([still[0], moved, still[1]], frames=4, on_frame=frames.append)
    assert frames == list(range(4))
    first, second = simulated(still, frames=4)
    for outcome, alone in zip(mixed, (first, *simulated([moved], frames=4), second), strict=True):
        assert np.array_equal(outcome.position_TN3, alone.position_TN3) and outcome.counters == alone.counters


def test_fast_obstacles_shorten_intervals():
    """Between two transfers an obstacle moves at most SPEED_FRACTION of a cell. Before, after and in a pause of the
    motion intervals are as long as without it. No particle before the obstacle comes through."""
    speed, time = 18.0, np.array([0.05, 0.07, 0.15, 0.17])
    way = speed * np.array([0.0, 0.02, 0.02, 0.04])
    lift = moving(wide_sheet(2.5), time, np.outer(way, [0.0, 1.0, 0.0]))
    room = {"domain_size": (CELLS * CELL, 4.0, CELLS * CELL), "gravity": (0.0, 0.0, 0.0)}
    far, near = CELL * np.array([[4.5, 30, 4.5]]), CELL * np.array([[4.5, 4, 4.5], [6.5, 9, 6.5]])
    slow, fast, struck = simulated(
        [
            particles(place, WATER, obstacles=(plate,), **room)
            for place, plate in ((far, wide_sheet(2.5)), (far, lift), (near, lift))
        ],
        frames=1 + round(0.25 * RATE_HZ),
    )
    least = way[-1] / CELL / SPEED_FRACTION - 0.04 * 30 / CELL
    assert least <= fast.counters["transfers"] - slow.counters["transfers"] <= 2 * least
    assert (struck.position_TN3[-1, :, 1] > 2.5 * CELL + way[-1]).all()
