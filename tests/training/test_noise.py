"""Noise injection, loss weights of quiet frames, and grid jitter."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scene.test_episode import make_episode

from hgn.config import NetworkConfig, TrainingConfig
from hgn.data.batch import make_batch
from hgn.training.noise import (
    jittered_origin,
    perturbed_window,
    quiet_weight,
    random_walk,
    target_acceleration,
)

STD = 0.000848528


def episode(particles, frames=12, seed=0):
    rng = np.random.default_rng(seed)
    steps = rng.normal(0, 1e-3, (frames, particles, 3))
    return make_episode(
        cells=0,
        position_TN3=(0.5 + steps.cumsum(0)).astype(np.float32),
        initial_velocity_N3=rng.normal(0, 0.1, (particles, 3)).astype(np.float32),
        material_N=rng.integers(0, 3, particles).astype(np.uint8),
        domain_size=(1.0, 1.0, 1.0),
    )


def batch_of(*episodes, frame=6, seeds=None):
    pairs = [(e, frame) for e in episodes]
    return make_batch(pairs, NetworkConfig(), seeds or tuple(range(1, len(pairs) + 1)))


def test_walk_has_the_papers_spread():
    """Over 1e5 draws the last velocity's noise has standard deviation std within 2 %; earlier ones grow as a random
    walk, sqrt(k / m) of it, with independent steps."""
    walk_MN3 = random_walk((5, 100_000, 3), STD, torch.Generator().manual_seed(0))
    for k in range(5):
        expected = STD * math.sqrt((k + 1) / 5)
        assert abs(float(walk_MN3[k].std()) / expected - 1) < 0.02
    steps = torch.diff(walk_MN3, dim=0, prepend=torch.zeros(1, 100_000, 3)).flatten(1)
    correlation = torch.corrcoef(steps)
    assert float((correlation - torch.eye(5)).abs().max()) < 0.02


def test_correlated_noise():
    """The waves have the configured fraction of the variance, and the particles' independent walks have the rest.
    Neighbours share the waves. Distant particles and other scenes do not. With fraction 0 the noise is bitwise the
    uncorrelated one."""
    still = np.random.default_rng(3).uniform(0.1, 0.9, (1, 4_000, 3)).astype(np.float32)
    scene = replace(episode(4_000), position_TN3=np.repeat(still, 12, 0))
    cell_size = 0.035

    def last_velocity(smooth, seed):
        batch = batch_of(scene, scene, seeds=(seed, seed + 1))
        noise_WN3 = perturbed_window(batch, STD, smooth, cell_size).double() - batch.window_WN3.double()
        return noise_WN3[-2] - noise_WN3[-3]

    noise_scale_SN3 = torch.stack([last_velocity(1.0, seed) for seed in range(0, 400, 2)]).view(400, 4_000, 3)
    assert abs(float(noise_scale_SN3.square().mean().sqrt()) / STD - 1) < 0.05
    distance_NN = np.linalg.norm(still[0, :200, None] - still[0, None], axis=-1)
    correlation_NN = torch.einsum("snx,smx->nm", noise_scale_SN3[:, :200], noise_scale_SN3) / (3 * 400 * STD**2)
    near, far = torch.from_numpy((distance_NN > 0) & (distance_NN < 0.02)), torch.from_numpy(distance_NN > 0.8)
    assert float(correlation_NN[near].mean()) > 0.9 and abs(float(correlation_NN[far].mean())) < 0.3
    mixed_N3 = last_velocity(0.36, 8)
    own_N3 = mixed_N3 - 0.6 * last_velocity(1.0, 8)
    assert abs(float(own_N3.std()) / (0.8 * STD) - 1) < 0.02
    batch = batch_of(scene, episode(300, seed=1))
    assert torch.equal(perturbed_window(batch, STD, 0.0), perturbed_window(batch, STD))


def test_history_before_the_start_is_ballistic():
    """Before frame 0 the particles flew freely into their initial state: constant acceleration g dt^2."""
    stored = episode(30)
    batch = batch_of(stored, frame=0)
    velocity = batch.state().velocity_NM3.double()
    expected = torch.from_numpy(stored.initial_velocity_N3).double() / 60
    gravity = torch.tensor([0.0, -9.8 / 3600, 0.0], dtype=torch.float64)
    for k in range(5):
        torch.testing.assert_close(velocity[:, k], expected - (k + 0.5) * gravity, rtol=0, atol=3e-7)
    torch.testing.assert_close(batch.gravity_S3[0].double(), gravity, rtol=1e-6, atol=0)


def test_noise_in_the_window_is_that_walk():
    """Positions are the sums of the velocity noise; the oldest position is exact; the next one moves with the last, so
    that the target is v_true^{n+1} - v_noisy^n. A sample's noise depends on its seed alone. With noise off, the window
    is used as it is; the episode's arrays stay as they are."""
    stored, other = episode(20_000), episode(30, seed=1)
    stored.position_TN3.setflags(write=False)
    before, batch = stored.position_TN3.tobytes(), batch_of(stored, seeds=(7,))
    noisy = perturbed_window(batch, STD)
    noise_WN3 = noisy.double() - batch.window_WN3.double()
    assert not noise_WN3[0].any()
    velocity_noise = noise_WN3[1:-1] - noise_WN3[:-2]
    assert abs(float(velocity_noise[-1].std()) / STD - 1) < 0.02
    torch.testing.assert_close(noise_WN3[-1], noise_WN3[-2], rtol=0, atol=2e-7)
    true_next = batch.window_WN3[-1] - batch.window_WN3[-2]
    expected = true_next - batch.state(noisy).velocity_NM3[:, 0]
    torch.testing.assert_close(batch.acceleration(noisy), expected, rtol=0, atol=3e-7)
    assert torch.equal(perturbed_window(batch_of(other, stored, seeds=(9, 7)), STD)[:, 30:], noisy)
    assert not torch.equal(perturbed_window(batch_of(stored, seeds=(8,)), STD), noisy)
    assert perturbed_window(batch, 0.0) is batch.window_WN3
    batch.window_WN3.add_(1.0)
    assert stored.position_TN3.tobytes() == before


def test_jitter_fills_a_cell():
    """Grid origins are uniform in [-R, 0]^3, one for each scene, and belong to the sample. In the loss a scene with
    many particles counts as much as one with few."""
    stored = episode(2)
    origins = jittered_origin(batch_of(*[stored] * 2000, seeds=tuple(range(2000))), 0.035)
    assert origins.shape == (2000, 3)
    assert float(origins.max()) <= 0 and float(origins.min()) >= -0.035
    torch.testing.assert_close(origins.mean(0), torch.full((3,), -0.0175), rtol=0.05, atol=0)
    assert torch.equal(jittered_origin(batch_of(stored, seeds=(5,)), 0.035)[0], origins[5])
    value = torch.tensor([2.0] * 10 + [4.0] * 30)
    mean = batch_of(episode(10), episode(30, seed=1)).mean_over_scenes(value)
    torch.testing.assert_close(mean, torch.tensor(3.0))


def test_what_is_asked_for():
    """Root mean square over axes and particles of the last acceleration of each window."""
    time = torch.arange(7.0)
    window_7N3 = torch.zeros(7, 4, 3)
    window_7N3[:, 0, 1] = 0.3 * time**2  # 0.6 a frame squared, of one of 12 coordinates
    still_7N3 = window_7N3[:, [1, 1, 1, 1]] + time[:, None, None]
    found = target_acceleration(torch.stack([window_7N3, still_7N3]))
    torch.testing.assert_close(found, torch.tensor([0.6 / 12**0.5, 0.0]))


def test_what_rests_counts_more():
    """Below `quiet_acceleration` the loss weight of a sample is the ratio of this value to its acceleration, at most
    QUIET_WEIGHT. By default all weights are 1."""
    quiet = TrainingConfig(quiet_acceleration=1e-3)
    asked = (1.0, 1e-3, 5e-4, 1e-4, 1e-6, 0.0)
    assert [quiet_weight(quiet, acceleration) for acceleration in asked] == pytest.approx([1, 1, 2, 4, 4, 4])
    assert quiet_weight(quiet, float("nan")) == quiet_weight(TrainingConfig(), 0.0) == 1.0
