"""How much noise a sample gets, by how much happens in it."""

import numpy as np
import pytest
import torch

from hgn.config import TrainingConfig
from hgn.training.noise import noise_scale, quiet_weight, target_acceleration


@pytest.mark.parametrize(("acceleration", "smallest"), [(0.0, 0.02), (1e-5, 0.02), (1e-4, 0.1), (5e-4, 0.5)])
def test_scales_are_log_uniform_down_to_what_happens(acceleration, smallest):
    """From the larger of the least scale and the frame's own acceleration up to 1, each seed its own; errors count in
    units of the noise."""
    training = TrainingConfig(noise_std=1e-3, noise_min_scale=0.02)
    drawn = [noise_scale(training, acceleration, seed) for seed in range(4000)]
    assert drawn[7] == noise_scale(training, acceleration, 7)
    scales = np.array([scale for scale, _ in drawn])
    assert smallest <= scales.min() < smallest * 1.01 and 0.99 < scales.max() <= 1
    share = np.sort(np.log(scales) / np.log(smallest))
    assert np.abs(share - np.linspace(0, 1, len(share))).max() < 0.03
    assert [weight for _, weight in drawn] == pytest.approx(1 / scales**2)


def test_elsewhere_noise_is_as_asked():
    """Where more happens than the noise, where no other scale is asked for, and without noise."""
    training = TrainingConfig(noise_std=1e-3, noise_min_scale=0.02)
    assert noise_scale(training, 1e-3, 5) == noise_scale(training, 0.1, 5) == (1.0, 1.0)
    assert noise_scale(TrainingConfig(noise_std=1e-3), 0.0, 5) == (1.0, 1.0)
    assert noise_scale(TrainingConfig(noise_std=0.0, noise_min_scale=0.02), 0.0, 5) == (1.0, 1.0)
    assert noise_scale(training, float("nan"), 5) == (1.0, 1.0)


def test_what_is_asked_for():
    """Root mean square over axes and particles of the last acceleration of each window."""
    time = torch.arange(7.0)
    window_7N3 = torch.zeros(7, 4, 3)
    window_7N3[:, 0, 1] = 0.3 * time**2  # 0.6 a frame squared, of one of 12 coordinates
    still_7N3 = window_7N3[:, [1, 1, 1, 1]] + time[:, None, None]
    found = target_acceleration(torch.stack([window_7N3, still_7N3]))
    torch.testing.assert_close(found, torch.tensor([0.6 / 12**0.5, 0.0]))


def test_what_rests_counts_more():
    """Below `quiet_acceleration` a sample counts as often as its acceleration is smaller, up to `quiet_weight`, without
    noise and beside the weight that noise gives it; by default all count alike."""
    quiet = TrainingConfig(noise_std=0.0, quiet_acceleration=1e-3)
    asked = (1.0, 1e-3, 5e-4, 1e-4, 1e-6, 0.0)
    assert [quiet_weight(quiet, acceleration) for acceleration in asked] == pytest.approx([1, 1, 2, 4, 4, 4])
    assert noise_scale(quiet, 5e-4, 5) == (1.0, quiet_weight(quiet, 5e-4))
    assert quiet_weight(quiet, float("nan")) == quiet_weight(TrainingConfig(), 0.0) == 1.0
    noisy = TrainingConfig(noise_std=1e-3, noise_min_scale=0.02, quiet_acceleration=1e-3)
    scale, weight = noise_scale(noisy, 4e-4, 5)
    assert scale < 1 and weight == pytest.approx(2.5 / scale**2)
