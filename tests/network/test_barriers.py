"""Obstacles that nothing passes: where ways end that meet triangles, and that none is passed."""

import numpy as np
import pytest
import torch
from network.barrier_scenes import CELL, CLEARANCE, DOMAIN, ball, barriers_of, crossings, gutter, scattered, square

from hgn.network.features import ParticleState
from hgn.scene.barrier import CELLS, MARGIN, build_barrier
from hgn.scene.rotation import euler_rotation
from hgn.schema import ConfigError
from hgn.step import reference
from hgn.step.reference import SLACK, FreeMotion, constrained, pairs_of_boxes
from hgn.step_config import StepConfig

MORE, RIM = SLACK * CLEARANCE, MARGIN * CLEARANCE


def ended(before, after, barriers, dtype=torch.float64, scene=None, **changes):
    """Where straight ways end that are held, [N, 3], and the velocities."""
    before_N3, after_N3 = (torch.as_tensor(np.atleast_2d(x), dtype=dtype) for x in (before, after))
    count = len(before_N3)
    scene_N = torch.zeros(count, dtype=torch.int64) if scene is None else torch.as_tensor(scene)
    domain_S3 = torch.ones(int(scene_N.max()) + 1, 3, dtype=dtype)
    velocity_NM3 = torch.zeros(count, 5, 3, dtype=dtype)
    state = ParticleState(
        before_N3, velocity_NM3, scene_N, scene_N, domain_S3, torch.zeros_like(domain_S3), None, barriers=barriers
    )
    step = StepConfig(**({"obstacle_clearance": CLEARANCE} | changes))
    motion = constrained(state, FreeMotion(after_N3, after_N3 - before_N3), step, 3)
    return motion.position_N3.numpy(), motion.velocity_N3.numpy()


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(
    ("before", "after", "end"),
    [  # distance from the square's plane, and a place along it
        ((0.05, 0.0), (-0.05, 0.02), (CLEARANCE, 0.02)),  # stopped, and what is along it is kept
        ((0.05, 0.0), (0.02, 0.02), (0.02, 0.02)),  # does not come so far
        ((0.05, 0.0), (CLEARANCE / 2, 0.0), (CLEARANCE, 0.0)),  # comes too near
        ((CLEARANCE / 4, 0.0), (-0.1, 0.01), (CLEARANCE / 4 + MORE, 0.01)),  # begins nearer: stays as near
        ((CLEARANCE / 4, 0.0), (CLEARANCE / 2, 0.0), (CLEARANCE / 2, 0.0)),  # or leaves
        ((0.3, 0.0), (-0.6, 0.0), (CLEARANCE, 0.0)),  # many cells in a frame
        ((0.05, 0.13), (-0.05, 0.13), (-0.05, 0.13)),  # beyond the rim
        ((0.05, 0.125 + RIM / 2), (-0.05, 0.125 + RIM / 2), (CLEARANCE, 0.125 + RIM / 2)),  # at the rim
        ((0.05, 0.125 + 2 * RIM), (-0.05, 0.125 + 2 * RIM), (-0.05, 0.125 + 2 * RIM)),
        ((CLEARANCE / 4, 0.135), (-CLEARANCE / 4, 0.115), (CLEARANCE / 4 + MORE, 0.115)),  # along it, from beyond
    ],
)
def test_a_square(before, after, end, axis, sign):
    """In closed form, from both sides, across each axis."""

    def place(distance, along):
        at = np.full(3, 0.5)
        at[axis] += sign * distance
        at[(axis + 1) % 3] += along
        return at

    position_13, velocity_13 = ended(place(*before), place(*after), barriers_of(square((0.5,) * 3, axis)))
    assert position_13[0] == pytest.approx(place(*end), rel=0, abs=1e-7)  # rows are float32
    assert velocity_13[0] == pytest.approx(position_13[0] - place(*before), rel=0, abs=1e-12)


SLOPE = square((0.0,) * 3, 1, 0.2) @ euler_rotation((0, 0, 30)).T + 0.5
ROOM = (square((0.5, 0.4, 0.5), 1), square((0.4, 0.5, 0.5), 0), square((0.5, 0.5, 0.4), 2))  # floor, wall, back


@pytest.mark.parametrize(
    ("squares", "way", "end", "within"),
    [
        (ROOM[:2], ((0.45, 0.45, 0.45), (0.35, 0.33, 0.41)), (0.401, 0.401, 0.41), 1e-7),
        (ROOM, ((0.45, 0.45, 0.45), (0.35, 0.33, 0.31)), (0.401,) * 3, 1e-7),
        # a way that meets a slope and, behind it, a floor slides down the slope: the floor would have it elsewhere
        ((square((0.6, 0.35, 0.5), 1, 0.4), SLOPE), ((0.5, 0.6, 0.5), (0.55, 0.33, 0.5)), (0.4634, 0.48, 0.5), 1e-4),
        (ROOM[:1], ((0.5, 0.55, 0.5), (0.5, -2.0, 0.5)), (0.5, -2.0, 0.5), 0),  # what has come apart is not held
        (ROOM[:1], ((0.5, 0.55, 0.5), (np.nan,) * 3), (np.nan,) * 3, 0),
    ],
)
def test_where_a_way_ends(squares, way, end, within):
    """At the clearance from each square that it meets; what is left is along them."""
    position_13, _ = ended(*way, barriers_of(np.concatenate(squares)))
    assert position_13[0] == pytest.approx(end, rel=0, abs=within, nan_ok=True)


def quad(*corners):
    """Two triangles of four corners, [2, 3, 3]."""
    return np.array(corners, float)[[[0, 1, 2], [0, 2, 3]]]


def rolled(begin_N3, velocity_N3, gravity_3, barriers, frames, dtype=torch.float32, **changes):
    """Where particles without any other forces are after so many frames, and their velocities."""
    position_N3, velocity_N3 = np.asarray(begin_N3, float), np.asarray(velocity_N3, float)
    for _ in range(frames):
        after_N3 = position_N3 + velocity_N3 + gravity_3
        position_N3, velocity_N3 = (
            x_N3.astype(float) for x_N3 in ended(position_N3, after_N3, barriers, dtype, **changes)
        )
    return position_N3, velocity_N3


@pytest.mark.parametrize(
    ("clearance", "turn", "dtype"),
    [(1e-3, (0, 0, 0), torch.float32), (4e-3, (20, 40, 70), torch.float32), (1e-3, (20, 40, 70), torch.float64)],
)
def test_what_slides_leaves_a_table(clearance, turn, dtype):
    """A convex edge of 90 degrees has no lip: all that slides on a table's top falls beside it, and none through it."""
    turn_33, generator = euler_rotation(turn), np.random.default_rng(0)
    top = quad((-0.2, 0, -0.2), (0, 0, -0.2), (0, 0, 0.2), (-0.2, 0, 0.2))
    side = quad((0, 0, -0.2), (0, -0.2, -0.2), (0, -0.2, 0.2), (0, 0, 0.2))
    barriers = barriers_of(np.concatenate([top, side]) @ turn_33.T + 0.5, clearance=clearance)
    begin_N3 = generator.uniform((-0.08, clearance / 2, -0.1), (-0.04, 3 * clearance, 0.1), (60, 3))
    velocity_N3 = np.tile((0.004, -0.0005, 0.0), (60, 1)) @ turn_33.T
    gravity_3 = turn_33 @ (0.0, -0.0002, 0.0)
    position_N3, _ = rolled(
        begin_N3 @ turn_33.T + 0.5, velocity_N3, gravity_3, barriers, 40, dtype, obstacle_clearance=clearance
    )
    place_N3 = (position_N3 - 0.5) @ turn_33
    assert (place_N3[:, 0] > 0).all() and (place_N3[:, 1] < 0).all()


@pytest.mark.parametrize("degrees", [40, 60, 90, 170])
def test_what_flows_along_a_gutter_does_not_stop(degrees):
    """Between two sheets that meet below at an angle: what is along the crease is kept."""
    half, barriers, generator = np.radians(degrees / 2), barriers_of(gutter(degrees)), np.random.default_rng(0)
    begin_N3 = np.stack(
        [np.full(50, 0.5), np.full(50, 0.4 + 0.0015 / np.sin(half)), generator.uniform(0.4, 0.45, 50)], 1
    )
    position_N3, velocity_N3 = rolled(begin_N3, np.tile((0.0, 0.0, 0.003), (50, 1)), (0.0, -3e-4, 0.0), barriers, 30)
    assert position_N3[:, 2] - begin_N3[:, 2] == pytest.approx(0.09, rel=1e-3)
    assert (position_N3[:, 1] > 0.4).all() and velocity_N3[:, 2] == pytest.approx(0.003, rel=1e-3)


@pytest.mark.parametrize(("speed", "kept"), [(0.003, 0.99), (0.01, 0.95), (0.03, 0.5)])
def test_fine_bowls_do_not_stop_what_slides(speed, kept):
    """Within a ball of 14,400 triangles, of which a frame's way passes up to five: speed along it is kept, most
    of it where a way passes more than three."""
    barriers, generator = barriers_of(ball(60, 0.3) + 0.5), np.random.default_rng(0)
    angle_N, height_N = generator.uniform(0, 2 * np.pi, 50), generator.uniform(-0.05, 0.05, 50)
    radius_N = np.sqrt((0.3 * np.cos(np.pi / 60) ** 2 - 0.0015) ** 2 - height_N**2)
    begin_N3 = 0.5 + np.stack([radius_N * np.cos(angle_N), height_N, radius_N * np.sin(angle_N)], 1)
    velocity_N3 = speed * np.stack([-np.sin(angle_N), 0 * angle_N, np.cos(angle_N)], 1)
    position_N3, velocity_N3 = rolled(begin_N3, velocity_N3, np.zeros(3), barriers, 20)
    assert (np.linalg.norm(velocity_N3, axis=1) > kept * speed).all()
    assert (np.linalg.norm(position_N3 - 0.5, axis=1) < 0.3).all()


def test_narrow_channels_hold_what_is_in_them():
    """Sheets may be closer together than the clearance. No particle between them passes, and a path across them ends at
    the first sheet."""
    sheets = np.concatenate([square((0.5, 0.5 + offset * CLEARANCE, 0.5), 1) for offset in (0, 0.8)])
    position_13, velocity_13 = ended((0.5, 0.5 + 0.4 * CLEARANCE, 0.5), (0.51, 0.45, 0.5), barriers_of(sheets))
    assert 0.5 < position_13[0, 1] < 0.5 + 0.8 * CLEARANCE and abs(velocity_13[0, 1]) < CLEARANCE


@pytest.mark.parametrize(
    ("dtype", "walls"), [(torch.float32, (0.3, 0.3)), (torch.float32, None), (torch.float64, None)]
)
def test_no_triangle_is_passed(dtype, walls):
    """Of ways of 1e-4 to half the domain none passes a triangle, by another test of it than the one that stops them;
    without it dozens do. Walls hold too."""
    for seed in range(2):
        corner_F33, before_N3, after_N3 = scattered(seed)
        assert crossings(before_N3, after_N3, corner_F33) > 60
        begun_N3 = before_N3.astype(np.float32).astype(np.float64)
        position_N3, velocity_N3 = ended(begun_N3, after_N3, barriers_of(corner_F33), dtype, wall_clearance=walls)
        assert crossings(begun_N3, position_N3.astype(np.float64), corner_F33) == 0
        free_N = (position_N3 == after_N3.astype(position_N3.dtype)).all(-1)
        assert 0.4 < free_N.mean() < 0.98
        moved_N3 = position_N3.astype(np.float64) - begun_N3
        assert velocity_N3 == pytest.approx(moved_N3, abs=2e-7)
        if walls is not None:
            low_N3, high_N3 = np.minimum(begun_N3, walls[0]), np.maximum(begun_N3, 1 - walls[1])
            assert (position_N3 >= low_N3 - 1e-6).all() and (position_N3 <= high_N3 + 1e-6).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_slope_stops_a_way_once(dtype):
    """A path that meets a rotated square slides along it, whatever the rounding. A path with free space ahead never
    ends at its start."""
    generator = np.random.default_rng(3)
    turn_33 = euler_rotation((20, 40, 70))
    corner_F33 = (square((0.0,) * 3, 1, 0.6) @ turn_33.T + 0.5).astype(np.float32)
    begun_N3 = generator.uniform(-0.1, 0.1, (2000, 3))
    begun_N3[:, 1] = CLEARANCE * 10 ** generator.uniform(-1, 1, 2000)
    way_N3 = np.array([0.02, -0.05, 0.01]) * generator.uniform(0.5, 1, (2000, 1))
    before_N3, after_N3 = (x_N3 @ turn_33.T + 0.5 for x_N3 in (begun_N3, begun_N3 + way_N3))
    position_N3, _ = ended(before_N3, after_N3, barriers_of(corner_F33), dtype)
    expected_N3 = begun_N3 + way_N3 * (1, 0, 1)
    expected_N3[:, 1] = np.minimum(begun_N3[:, 1], CLEARANCE - MORE) + MORE
    assert (position_N3 - 0.5) @ turn_33 == pytest.approx(expected_N3, rel=0, abs=3e-7)


def all_pairs(barriers, before_N3, after_N3, scene_N):
    """Each particle and each triangle."""
    particles, triangles = len(before_N3), len(barriers.row_F24)
    return torch.arange(particles).repeat_interleave(triangles), torch.arange(triangles).repeat(particles)


def reaching(count=150):
    """Ways as long as a list's cell, whose middles lie just within a cell, and small squares at their ends, half a cell
    away in the next."""
    generator, size = np.random.default_rng(0), CELLS * CELL
    axis_N, cell_N3 = generator.integers(0, 3, count), generator.integers(8, 24, (count, 3))
    along_N3 = np.eye(3)[axis_N] * generator.choice([-1, 1], (count, 1))
    middle_N3 = (cell_N3 + 0.5 + 0.499 * along_N3) * size
    squares = [square(at, axis, 0.002) for at, axis in zip(middle_N3 + 0.495 * size * along_N3, axis_N, strict=True)]
    return np.concatenate(squares), middle_N3 - 0.499 * size * along_N3, middle_N3 + 0.499 * size * along_N3


def test_lists_hold_all_that_is_met(monkeypatch):
    """Particles end in the same place with the pairs of an exported graph, and the first of them with all triangles
    tested."""
    for corner_F33, *ways in (scattered(0), scattered(7), reaching()):
        barriers = barriers_of(corner_F33)
        for pairs, count in ((all_pairs, 200), (lambda *given: pairs_of_boxes(*given), 2000)):
            before_N3, after_N3 = (x_N3[:count] for x_N3 in ways)
            listed_N3 = ended(before_N3, after_N3, barriers)[0]
            with monkeypatch.context() as patch:
                patch.setattr("hgn.step.reference._pairs", pairs)
                assert np.array_equal(listed_N3, ended(before_N3, after_N3, barriers)[0])
    assert (listed_N3 != after_N3).any(1).all()


def test_pairs_in_memory_are_bounded(monkeypatch):
    """A mesh of 1 MB may have 100,000 triangles near each particle. Paths are stopped in parts, with equal results."""
    corner_F33, before_N3, after_N3 = scattered(0)
    barriers, sizes, covers = barriers_of(corner_F33), [], reference._covers
    expected = ended(before_N3, after_N3, barriers)
    monkeypatch.setattr(reference, "PAIRS_AT_ONCE", 500, raising=False)
    monkeypatch.setattr(reference, "_covers", lambda row, place: sizes.append(len(row)) or covers(row, place))
    np.testing.assert_array_equal(ended(before_N3, after_N3, barriers), expected)
    assert sum(sizes) > 5000 and max(sizes) <= 500


def test_obstacles_that_are_none():
    """Nothing, and triangles without area, make no barrier; a bad clearance is refused."""
    nothing, flat = np.zeros((0, 3, 3)), np.array([[[0.2] * 3, [0.3] * 3, [0.4] * 3]])
    assert barriers_of(nothing, nothing) is None and barriers_of(flat) is None
    for clearance in (0.0, 0.02, float("nan")):
        with pytest.raises(ConfigError, match=r"obstacle_clearance must be above 0 and at most a cell \(0.015625\)"):
            build_barrier(square((0.5,) * 3, 0), CELL, clearance, DOMAIN)


def test_obstacles_that_are_split_hold_where_they_were_split():
    """Triangles larger than 16 cells are cut; ways through the cuts are stopped."""
    corner_F33 = square((0.5, 0.5, 0.5), 1, size=0.9)
    generator = np.random.default_rng(0)
    before_N3 = np.stack([generator.uniform(0.1, 0.9, 1000), np.full(1000, 0.52), generator.uniform(0.1, 0.9, 1000)], 1)
    before_N3[:500, 0] = before_N3[:500, 2]  # along a diagonal, where cuts are
    position_N3, _ = ended(before_N3, before_N3 - (0.0, 0.05, 0.0), barriers_of(corner_F33))
    assert position_N3[:, 1] == pytest.approx(0.5 + CLEARANCE, abs=1e-7)
