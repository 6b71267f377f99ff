"""Frames drawn by importance: the distribution, and weights that keep every expectation."""

import numpy as np
import pytest
from scene.test_episode import make_episode

from hgn.data.importance import FrameImportance


def moving(position_TN3, speed=0.0):
    """An episode without gravity that begins at this speed, in domain units per frame."""
    _, particles, _ = position_TN3.shape
    return make_episode(
        particles=particles,
        position_TN3=position_TN3.astype(np.float32),
        initial_velocity_N3=np.full((particles, 3), speed * 60, np.float32),
        material_N=np.zeros(particles, np.uint8),
        gravity=(0.0, 0.0, 0.0),
    )


def stopped(frames, at):
    """Particles that fly evenly, and are stopped at one frame."""
    time = np.minimum(np.arange(frames), at)[:, None, None]
    return moving(np.random.default_rng(0).random((1, 40, 3)) + 0.01 * time, 0.01)


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_what_happens_is_drawn_more_often(share):
    """A stop at frame n is the acceleration v^{n+1} - v^n: that frame gets the share and its even part of the rest;
    weights times chances are 1/F, so sums over what is drawn expect the even mean."""
    frames, at = 21, 7
    importance = FrameImportance.of(stopped(frames, at), share)
    chance = np.diff(importance.draws.cumulative_F, prepend=0.0)
    assert chance[at] == pytest.approx(share + (1 - share) / 20, rel=1e-3)
    assert chance[np.arange(20) != at] == pytest.approx((1 - share) / 20, rel=0.05)
    values = np.random.default_rng(1).random(20)
    draws = [importance.draw(slot, seed) for seed in range(400) for slot in range(20)]
    assert np.mean([values[frame] * weight for frame, weight in draws]) == pytest.approx(values.mean(), rel=0.02)
    weights = [weight for frame, weight in draws if frame == at]
    assert weights == pytest.approx([1 / (20 * chance[at])] * len(weights))


def test_one_epoch_covers_the_distribution():
    """Draws are stratified: in every epoch the number of draws of a frame equals its expectation to within one."""
    importance = FrameImportance.of(stopped(31, 12), 0.6)
    chance = np.diff(importance.draws.cumulative_F, prepend=0.0)
    for epoch in range(5):
        drawn = [importance.draw(slot, 1_000_003 * epoch + slot)[0] for slot in range(30)]
        assert (np.abs(np.bincount(drawn, minlength=30) - 30 * chance) < 2).all()


def test_where_nothing_happens_all_frames_are_alike():
    """Resting particles, and an episode of two frames, which has one to draw."""
    still = np.ones((5, 3, 3), np.float32)
    importance = FrameImportance.of(moving(still), 0.5)
    assert [importance.draw(slot, 9) for slot in range(4)] == [(slot, pytest.approx(1.0)) for slot in range(4)]
    assert FrameImportance.of(moving(still[:2]), 0.5).draw(0, 5) == (0, 1.0)
