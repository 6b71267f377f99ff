"""Targets of simulated frames: the data's motion at the simulated positions."""

import math

import pytest
import torch

from hgn.training import pushforward_targets
from hgn.training.pushforward_targets import (
    LIMIT,
    PULL,
    SHAPE_PULL,
    moved_velocities,
    neighbour_means,
    pushforward_windows,
    rigidly_moved,
)

HISTORY, CELL, SPACING = 5, 0.1, 0.045


def block(side=8):
    """Particles of a cube, on a lattice with small random offsets."""
    axis = torch.arange(side, dtype=torch.float64) * SPACING
    point_N3 = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    generator = torch.Generator().manual_seed(side)
    return 0.5 + point_N3 + 0.004 * torch.randn(point_N3.shape, generator=generator, dtype=torch.float64)


def turned(point_N3, angle):
    """The points turned about the z axis through their centre."""
    rotation = torch.eye(3, dtype=torch.float64)
    rotation[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    centre = point_N3.mean(0)
    return centre + (point_N3 - centre) @ rotation.T


def targets(true_TN3, simulated_FN3, bodies=(), material_N=None):
    materials = torch.zeros(true_TN3.shape[1], dtype=torch.int64) if material_N is None else material_N
    return pushforward_windows(true_TN3, simulated_FN3, CELL, materials, bodies)[:, -1]


def expansion(before_N3, after_N3):
    """The relative growth of volume, by a fit to all particles."""
    offset, moved = before_N3 - before_N3.mean(0), after_N3 - after_N3.mean(0)
    return float(torch.linalg.det(torch.linalg.lstsq(offset, moved).solution)) - 1


def still(point_N3, frames=1):
    return point_N3.repeat(HISTORY + frames + 2, 1, 1)


def test_windows_contain_the_simulated_frames():
    """The inputs are the last frames, true ones before the start. Without errors the target is the next true frame."""
    generator = torch.Generator().manual_seed(0)
    true = block(3) + 0.01 * torch.rand(HISTORY + 4 + 2, 27, 3, generator=generator, dtype=torch.float64)
    simulated = true[HISTORY + 1 : -1].clone()
    windows = pushforward_windows(true, simulated, CELL, torch.zeros(27, dtype=torch.int64))
    assert windows.shape == (4, HISTORY + 2, 27, 3)
    torch.testing.assert_close(windows, true.unfold(0, HISTORY + 2, 1)[1:].permute(0, 3, 1, 2))
    for k, window in enumerate(pushforward_windows(true, simulated + 0.02, CELL, torch.zeros(27, dtype=torch.int64))):
        frames = [*true[: HISTORY + 1], *(simulated + 0.02)]
        assert all(torch.equal(window[i], frames[k + 1 + i]) for i in range(HISTORY + 1))


@pytest.mark.parametrize("lag", [0.05, 0.25])
def test_a_body_that_lags_in_its_turn_is_not_compressed(lag):
    """It turns on as fast as the data. With the velocities of its particles in the data it would lose 2 % of its
    volume in a frame at a lag of 0.25 radians."""
    start, speed = block(), 0.1
    true = torch.stack([turned(start, speed * frame) for frame in range(HISTORY + 3)])
    simulated = turned(start, speed * (HISTORY + 1) - lag)
    naive = simulated + true[-1] - true[-2]
    assert expansion(simulated, naive) < -0.9 * speed * 2 * math.sin(lag) + speed**2
    (target,) = targets(true, simulated[None])
    assert abs(expansion(simulated, target)) < 2.5 * PULL * speed * lag + PULL * lag**2  # of chords, second order
    ahead = turned(start, speed * (HISTORY + 2) - lag + PULL * lag)
    inner = (start - start.mean(0)).norm(dim=1) < 2 * CELL  # position errors below the limit
    torch.testing.assert_close(target[inner], ahead[inner], rtol=0, atol=1.2e-3)
    assert (naive - ahead)[inner].norm(dim=1).max() > 0.02 * lag


@pytest.mark.parametrize("scale", [0.95, 1.03])
def test_a_wrong_volume_is_corrected(scale):
    """By PULL of the difference, in compressed and expanded material."""
    start = block()
    simulated = start.mean(0) + scale * (start - start.mean(0))
    (target,) = targets(still(start), simulated[None])
    wanted = (1 + PULL * (1 / scale - 1)) ** 3 - 1
    assert expansion(simulated, target) == pytest.approx(wanted, rel=0.02)


def test_elastic_bodies_return_to_their_shape():
    """Two bodies, one stretched and turned by more than the limit, one moved: each regains SHAPE_PULL of its shape and
    PULL of its place, and its shape does not depend on how far it has turned."""
    start, other = block(5), block(5) + torch.tensor([0.6, 0.0, 0.0], dtype=torch.float64)
    true = torch.cat([start, other])
    stretch = torch.tensor([0.9, 1.06, 1.0], dtype=torch.float64)
    turned_start = turned(start, 1.0)
    bent = turned(start.mean(0) + stretch * (start - start.mean(0)), 1.0)
    shift = torch.tensor([0.0, 0.02, 0.0], dtype=torch.float64)
    simulated = torch.cat([bent, other + shift])
    bodies = (torch.arange(125), torch.arange(125, 250))
    (target,) = targets(still(true), simulated[None], bodies)
    wanted = (
        bent + SHAPE_PULL * (turned_start - bent) + PULL * (start - turned_start).clamp(-LIMIT * CELL, LIMIT * CELL)
    )
    torch.testing.assert_close(target[:125], wanted, rtol=0, atol=2e-3)
    torch.testing.assert_close(target[125:], other + (1 - PULL) * shift, rtol=0, atol=1e-9)
    flipped = simulated.clone()
    flipped[:, 2] = 2 * flipped[:, 2].mean() - flipped[:, 2]  # a mirror image is no rotation
    moved = rigidly_moved(true[None, :125], flipped[None, :125])[0]
    torch.testing.assert_close(torch.pdist(moved), torch.pdist(true[:125]))
    assert (moved - flipped[:125]).norm(dim=1).mean() > SPACING


def test_materials_do_not_share_motion(monkeypatch):
    """Velocities and errors of another material, at the same place, are not used; nor does the size of groups change
    the result."""
    start = block(6)
    true = still(start)
    true[-1] += torch.tensor([0.03, 0.0, 0.0], dtype=torch.float64) * (torch.arange(216) % 2)[:, None]
    simulated = true[-2] + 0.01 * torch.sin(40 * start)
    materials = torch.arange(216) % 2
    (both,) = targets(true, simulated[None], material_N=materials)
    for material in (0, 1):
        mine = materials == material
        (alone,) = targets(true[:, mine], simulated[None, mine])
        torch.testing.assert_close(both[mine], alone, rtol=0, atol=1e-12)
    monkeypatch.setattr(pushforward_targets, "TOGETHER", 1)
    monkeypatch.setattr(pushforward_targets, "ROWS", 7)
    monkeypatch.setattr(pushforward_targets, "ENTRIES", 100)
    torch.testing.assert_close(targets(true, simulated[None], material_N=materials)[0], both, rtol=0, atol=1e-12)


def test_sums_are_those_of_a_loop():
    """Weights 1 - r^2 / R^2; a particle alone keeps its value and its velocity."""
    generator = torch.Generator().manual_seed(3)
    position = torch.rand(2, 40, 3, generator=generator, dtype=torch.float64) * 0.3
    position[:, 0] = 5.0
    value = torch.rand(2, 40, 4, generator=generator, dtype=torch.float64)
    found = neighbour_means(position, value, torch.zeros(40, dtype=torch.int32), CELL)
    for frame in range(2):
        for i in range(40):
            weight = (1 - (position[frame] - position[frame, i]).square().sum(-1) / CELL**2).clamp(min=0)
            wanted = (weight[:, None] * value[frame]).sum(0) / weight.sum()
            torch.testing.assert_close(found[frame, i], wanted, rtol=0, atol=1e-9)
    velocity = value[..., :3]
    moved = moved_velocities(position, velocity, torch.full_like(velocity, 0.02), torch.zeros(40), CELL)
    torch.testing.assert_close(moved[:, 0], velocity[:, 0])
