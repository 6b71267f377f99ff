"""Obstacles that nothing passes, on the device against hgn.step.reference."""

import numpy as np
import pytest
import torch
from equality import assert_same
from kernels.engines import device
from network.barrier_scenes import CELL, CLEARANCE, DOMAIN, ball, barriers_of, crossings, gutter, scattered, square

from hgn.config import NetworkConfig
from hgn.kernels.buffers import OUT
from hgn.kernels.grid.op import CellBox, DeviceGrid, DeviceParticles
from hgn.kernels.scene_tables import BARRIER_COLUMNS, SceneHash, SceneTable
from hgn.kernels.step.op import DeviceStep
from hgn.network.features import ParticleState
from hgn.scene.barrier import build_barrier
from hgn.scene.rotation import euler_rotation
from hgn.step.reference import advanced, first_stop
from hgn.step_config import StepConfig

NO_CORNERS = np.zeros((0, 3, 3))
SLOPE = square((0.0,) * 3, 1, 0.2) @ euler_rotation((0, 0, 30)).T + np.array((0.32, 0.42, 0.5))


def both(before_N3, after_N3, scene_N, barriers, table, walls=None):
    """Where ways end by PyTorch, and on the device, float32 [N, 3]."""
    where, count = device(), len(before_N3)
    before_N3, after_N3 = (torch.as_tensor(x, dtype=torch.float32).to(where) for x in (before_N3, after_N3))
    scene_N = torch.as_tensor(scene_N).to(where)
    domain_S3 = torch.ones(int(scene_N.max()) + 1, 3, device=where)
    velocity_NM3 = torch.zeros(count, 5, 3, device=where)
    state = ParticleState(
        before_N3, velocity_NM3, scene_N, scene_N, domain_S3, torch.zeros_like(domain_S3), None, barriers=barriers
    )
    step = StepConfig(wall_clearance=walls, obstacle_clearance=CLEARANCE)
    expected_N3 = advanced(state, after_N3 - before_N3, step, 3).position_N3
    return expected_N3.cpu().numpy(), integrated(state, after_N3 - before_N3, step, table).cpu().numpy()


def integrated(state, way_N3, step, table):
    """Positions after a frame on the device, from rest by these ways."""
    count, where = len(way_N3), device()
    config = NetworkConfig(levels=1, velocity_history=1)
    box = CellBox.around((0.0,) * 3, (1.0,) * 3, config.cell_size, 1)
    grid = DeviceGrid(config, box, (16,), state.scene_count, count, where)
    one, zero_3 = torch.ones(1, dtype=torch.int32, device=where), way_N3.new_zeros(3)
    output = way_N3.new_zeros(count, OUT)
    output[:, :3] = way_N3
    particles = DeviceParticles(
        state.position_N3.clone(), way_N3.new_zeros(count, 3), state.scene_N.int(), state.scene_N.int(),
        torch.zeros_like(state.domain_S3), state.domain_S3, state.gravity_S3, count * one, state.frame_S,
    )  # fmt: skip
    path_TN3 = way_N3.new_zeros(1, count, 3)
    DeviceStep(step, grid, table, 0.0).integrate(
        output, particles, (zero_3, zero_3 + 1), lost=0 * one, frame=0 * one, path_TN3=path_TN3
    )
    torch.testing.assert_close(path_TN3[0], particles.position_N3, rtol=0, atol=0, equal_nan=True)
    return particles.position_N3


def table_of(*scenes):
    """Of the scenes' corners, each scene by itself."""
    hashes = [SceneHash.of_barrier(build_barrier(corner_F33, CELL, CLEARANCE, DOMAIN)) for corner_F33 in scenes]
    return SceneTable(hashes, BARRIER_COLUMNS, device())


def on_device(barriers):
    return barriers and barriers.to(device())


def met(seed):
    """A few of the ways among scattered obstacles that are stopped, and of the others."""
    corner_F33, *ways = scattered(seed, 1000)
    before_N3, after_N3 = (torch.as_tensor(x, dtype=torch.float32) for x in ways)
    hit_N, *_ = first_stop(barriers_of(corner_F33), before_N3, after_N3, torch.zeros(len(before_N3), dtype=torch.int64))
    chosen_N = torch.where(hit_N, torch.cumsum(hit_N, 0) <= 6, torch.cumsum(~hit_N, 0) <= 8)
    return corner_F33, before_N3[chosen_N].numpy(), after_N3[chosen_N].numpy()


def within(count=8):
    """Ways in a gutter of 60 degrees, and in a ball of many triangles, of which one passes more than stop it; and one
    that a slope leads into a wall."""
    generator = np.random.default_rng(0)
    begin_N3 = generator.uniform((0.498, 0.404, 0.45), (0.502, 0.406, 0.55), (count, 3))
    angle_N = generator.uniform(0, 2 * np.pi, count)
    around_N3 = np.stack([np.cos(angle_N), 0 * angle_N, np.sin(angle_N)], 1)
    middle = np.array([0.5, 0.503, 0.5])  # ways in the equator would meet two triangles in one moment
    return (
        (gutter(60), begin_N3, begin_N3 + generator.normal((0, -0.01, 0.01), 0.002, (count, 3))),
        (ball(12, 0.3) + 0.5, middle + 0.29 * around_N3, middle + 0.32 * np.roll(around_N3, 1, 0)),
        (SLOPE, np.array([(0.33, 0.5, 0.5)]), np.array([(0.301, 0.38, 0.5)])),
    )


def test_ways_end_where_the_reference_ends_them():
    """Paths of several scenes between walls end where PyTorch's end, to rounding, and cross no triangle. The scenes
    have scattered obstacles, none, a gutter, where paths end along the crease, a ball, and a slope. Paths that meet
    nothing are bitwise unchanged, and so are particles that are not finite. A batch's table contains the tables of its
    scenes."""
    corners, befores, afters = (list(x) for x in zip(met(0), met(1), *within(), strict=True))
    corners[1] = NO_CORNERS
    befores[1][0], afters[1][0] = (0.5, 0.3, 0.5), (0.5, 0.1, 0.5)
    afters[0][-2:] = [[np.nan] * 3, [2.5] * 3]
    scene_N = np.repeat(np.arange(5), [len(before_N3) for before_N3 in befores])
    before_N3, after_N3 = (np.concatenate(x).astype(np.float32) for x in (befores, afters))
    after_N3 = before_N3 + (after_N3 - before_N3)  # as the integration rounds it
    barriers = on_device(barriers_of(*corners))
    table = SceneTable.of_barriers(barriers, 5, device())
    for found, expected in zip(table._hashes, table_of(*corners)._hashes, strict=True):
        assert_same(found and vars(found), expected and vars(expected))
    expected_N3, found_N3 = both(before_N3, after_N3, scene_N, barriers, table, (0.3, 0.3))
    np.testing.assert_allclose(found_N3, expected_N3, rtol=0, atol=2e-6)
    same_N = ~(expected_N3 != after_N3).any(-1) | np.isnan(after_N3[:, 0])
    np.testing.assert_array_equal(found_N3[same_N], after_N3[same_N])
    stopped, passed = [], []
    for scene, corner_F33 in enumerate(corners):
        own_N = (scene_N == scene) & (np.abs(found_N3) < 1).all(1)
        stopped.append((~same_N & own_N).sum())
        passed.append(crossings(before_N3[own_N].astype(float), found_N3[own_N].astype(float), corner_F33))
    assert min(stopped) > 0 and stopped[0] > 3 and passed == [0] * 5 and same_N[scene_N == 0].sum() > 4
    in_gutter, in_ball = (found_N3[scene_N == scene] for scene in (2, 3))
    assert in_gutter[:, 2] - afters[2][:, 2] == pytest.approx(0, abs=1e-6) and (in_gutter[:, 1] > 0.4).all()
    assert (np.linalg.norm(in_ball - 0.5, axis=1) < 0.3).all()
    assert 0.3 <= found_N3[scene_N == 4][0, 0] < 0.301  # the wall acts on what the slope shifts


def test_a_table_takes_the_rows_of_another():
    """In place: obstacles come where none were, others take their place, and go."""
    first, second = square((0.5,) * 3, 1), square((0.5, 0.4, 0.5), 1)
    before_N3, after_N3 = np.full((1, 3), (0.5, 0.6, 0.52)), np.full((1, 3), (0.5, 0.3, 0.52))
    table = SceneTable.of_barriers(None, 1, device())
    address = table.row_SC.data_ptr()
    for corners, height in ((None, 0.3), ((first,), 0.501), ((second,), 0.401), (None, 0.3)):
        barriers = None if corners is None else on_device(barriers_of(*corners))
        table.take(SceneTable.of_barriers(barriers, 1, device()))
        expected_N3, found_N3 = both(before_N3, after_N3, np.zeros(1, np.int64), barriers, table)
        assert found_N3[0] == pytest.approx((0.5, height, 0.52), abs=1e-6)
        assert found_N3 == pytest.approx(expected_N3, abs=1e-6) and table.row_SC.data_ptr() == address
