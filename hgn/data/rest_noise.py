"""How much noise a sample gets, by how much happens in it.

Noise hides from a network what it errs by less: at rest its bias stays at a twentieth of the noise, and over thousands
of frames what should lie still creeps. Where little happens, the noise's scale is drawn from a wide range (as the
levels of a denoiser are: Song & Ermon 2019), and errors count in units of it, so that each scale weighs the same.
"""

from __future__ import annotations

import torch

from hgn.config import TrainingConfig
from hgn.system.splitmix import splitmix64

REST_STREAM = 0x9E6D62D06F6A9A9B  # of other streams than noise, jitter, symmetry and frame


def noise_at_rest(training: TrainingConfig, acceleration: float, seed: int) -> tuple[float, float]:
    """Scale of a sample's noise, and the weight of its loss.

    `acceleration` is the root mean square of what is asked for, domain units per frame squared. Where it is a share
    r < 1 of `noise_std`, the scale is log-uniform between max(r, training.noise_at_rest) and 1, drawn from the sample's
    seed alone, and the weight is 1 / scale^2; elsewhere both are 1.
    """
    if training.noise_at_rest == 1.0 or training.noise_std == 0.0:
        return 1.0, 1.0
    smallest = max(acceleration / training.noise_std, training.noise_at_rest)
    if not smallest < 1.0:
        return 1.0, 1.0
    scale = smallest ** (splitmix64(seed ^ REST_STREAM) / 2.0**64)
    return scale, 1.0 / scale**2


def asked_acceleration(window_FWN3: torch.Tensor) -> torch.Tensor:
    """Root mean square of the acceleration in the last three frames of each window, [F]."""
    acceleration_FN3 = window_FWN3[:, -1] - 2 * window_FWN3[:, -2] + window_FWN3[:, -3]
    return acceleration_FN3.square().mean((1, 2)).sqrt()
