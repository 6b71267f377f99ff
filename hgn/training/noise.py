"""Input noise and grid jitter (paper sec. 3.3), each drawn from the sample's own seed.

Shape legend: W = m + 2 window frames (m velocities), N particles, S scenes.
"""

from __future__ import annotations

import math

import torch

from hgn.data.batch import Batch

# Of other streams than the particles' own noise: the same seed would tie them to the first particles' noise.
JITTER_STREAM, SHARED_STREAM = 0x5DEECE66D, 0x2545F4914F


def random_walk(shape_MN3: tuple[int, int, int], std_last: float, generator: torch.Generator) -> torch.Tensor:
    """Velocity noise [m, N, 3], oldest first: a random walk whose last step has standard deviation `std_last`."""
    steps_MN3 = torch.randn(shape_MN3, generator=generator, device=generator.device)
    return steps_MN3.cumsum(0) * (std_last / math.sqrt(shape_MN3[0]))


def perturbed_window(batch: Batch, std_last: float, shared: float = 0.0) -> torch.Tensor:
    """A copy of the batch's window with noise in its question, [W, N, 3]; the batch stays as it is.

    The walk runs through the velocities, positions follow as their sums. The next position moves with the
    last one, so the target becomes v_true^{n+1} - v_noisy^n: the network learns to undo the velocity error
    (the rule of GNS, Sanchez-Gonzalez et al. 2020). `shared` is the share of the variance that all particles of a
    scene have in common: in a rollout the error of a whole body is one, which independent noise never shows.
    """
    window_WN3 = batch.window_WN3
    if std_last == 0:
        return window_WN3
    shift = []
    for count, seed in zip(batch.particles_S, batch.seeds_S, strict=True):
        generator = torch.Generator(window_WN3.device).manual_seed(seed)
        history = len(window_WN3) - 2
        velocity_MN3 = random_walk((history, count, 3), std_last * math.sqrt(1 - shared), generator)
        if shared > 0:
            generator.manual_seed(seed ^ SHARED_STREAM)
            velocity_MN3 = velocity_MN3 + random_walk((history, 1, 3), std_last * math.sqrt(shared), generator)
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
