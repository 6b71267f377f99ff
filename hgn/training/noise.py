"""Input noise and grid jitter (paper sec. 3.3), each drawn from the sample's own seed.

Shape legend: W = m + 2 window frames (m velocities), N particles, S scenes, K waves.
"""

from __future__ import annotations

import math

import torch

from hgn.config import SMOOTH_CELLS, SMOOTH_WAVES
from hgn.data.batch import Batch

# Of other streams than the particles' own noise: the same seed would tie them to the first particles' noise.
JITTER_STREAM, SMOOTH_STREAM = 0x5DEECE66D, 0x2545F4914F


def random_walk(shape_MN3: tuple[int, int, int], std_last: float, generator: torch.Generator) -> torch.Tensor:
    """Velocity noise [m, N, 3], oldest first: a random walk whose last step has standard deviation `std_last`."""
    steps_MN3 = torch.randn(shape_MN3, generator=generator, device=generator.device)
    return steps_MN3.cumsum(0) * (std_last / math.sqrt(shape_MN3[0]))


def smooth_walk(
    position_N3: torch.Tensor, history: int, std_last: float, cell_size: float, generator: torch.Generator
) -> torch.Tensor:
    """Velocity noise [m, N, 3] that neighbours have in common: a sum of plane waves, random Fourier features (Rahimi,
    Recht 2007), whose amplitudes walk as `random_walk` does; over waves its standard deviation is the same everywhere.
    """
    waves, device = SMOOTH_WAVES, generator.device
    direction_K3 = torch.randn(waves, 3, generator=generator, device=device)
    length_K = torch.rand(waves, generator=generator, device=device)
    phase_K = 2 * math.pi * torch.rand(waves, generator=generator, device=device)
    shortest, longest = (cells * cell_size for cells in SMOOTH_CELLS)
    number_K = 2 * math.pi / shortest * torch.exp(-math.log(longest / shortest) * length_K)
    wave_K3 = direction_K3 * (number_K / direction_K3.norm(dim=1))[:, None]
    height_NK = torch.cos(position_N3.float() @ wave_K3.T + phase_K)
    amplitude_MK3 = random_walk((history, waves, 3), std_last * math.sqrt(2 / waves), generator)
    return height_NK @ amplitude_MK3


def perturbed_window(batch: Batch, std_last: float, smooth: float = 0.0, cell_size: float = 1.0) -> torch.Tensor:
    """A copy of the batch's window with noise in its question, [W, N, 3]; the batch stays as it is.

    The walk runs through the velocities, positions follow as their sums. The next position moves with the
    last one, so the target becomes v_true^{n+1} - v_noisy^n: the network learns to undo the velocity error
    (the rule of GNS, Sanchez-Gonzalez et al. 2020). `smooth` is the share of the variance that neighbours have in
    common: in a rollout a body's particles err together, which independent noise, averaged over them, never shows.
    Each scene's noise is `batch.noise_S` times that.
    """
    window_WN3 = batch.window_WN3
    if std_last == 0:
        return window_WN3
    shift = []
    first = 0
    scales = batch.noise_S or (1.0,) * len(batch.seeds_S)
    for count, seed, scale in zip(batch.particles_S, batch.seeds_S, scales, strict=True):
        generator = torch.Generator(window_WN3.device).manual_seed(seed)
        history = len(window_WN3) - 2
        velocity_MN3 = random_walk((history, count, 3), scale * std_last * math.sqrt(1 - smooth), generator)
        if smooth > 0:
            generator.manual_seed(seed ^ SMOOTH_STREAM)
            position_N3 = window_WN3[-2, first : first + count]
            std = scale * std_last * math.sqrt(smooth)
            velocity_MN3 = velocity_MN3 + smooth_walk(position_N3, history, std, cell_size, generator)
        first += count
        position_MN3 = velocity_MN3.cumsum(0)
        shift.append(torch.cat([torch.zeros_like(position_MN3[:1]), position_MN3, position_MN3[-1:]]))
    return window_WN3 + torch.cat(shift, dim=1)


def jittered_origin(batch: Batch, cell_size: float) -> torch.Tensor:
    """Grid origins uniform in [-cell_size, 0]^3, one for each scene, [S, 3]."""
    origins = []
    for seed in batch.seeds_S:
        generator = torch.Generator().manual_seed(seed ^ JITTER_STREAM)
        origins.append(-cell_size * torch.rand(3, generator=generator))
    return torch.stack(origins).to(batch.window_WN3)
