"""Input noise and grid jitter (paper sec. 3.3), each drawn from the sample's own seed.

Backend torch draws the noise in this module (`perturbed_window`, called by hgn.training.torch_updates). Backend triton
draws it in hgn.kernels.update (`Updates._assemble`, kernels `draw_waves` and `assemble_batch`). `quiet_weight` returns
a sample's loss weight for both backends.
Shape legend: W = m + 2 window frames (m velocities), N particles, F windows, S scenes, K waves.
"""

import math

import torch

from hgn.config import CORRELATED_WAVELENGTHS, CORRELATED_WAVES, TrainingConfig
from hgn.data.batch import Batch

# Keys of the other random streams. Without a key these would repeat the numbers of the particles' noise.
JITTER_STREAM, WAVE_STREAM = 0x5DEECE66D, 0x2545F4914F

SMALLEST_ACCELERATION = 1e-30  # avoids a division by 0
QUIET_WEIGHT = 4.0  # largest loss weight of a frame below training.quiet_acceleration


def quiet_weight(training: TrainingConfig, acceleration: float) -> float:
    """Returns the loss weight of a sample whose target has this root mean square.

    Errors at rest are much smaller than errors of impacts, so they hardly change the mean loss. But they are the same
    in every frame, so resting bodies creep over thousands of frames.
    """
    if not acceleration < training.quiet_acceleration:
        return 1.0
    return min(QUIET_WEIGHT, training.quiet_acceleration / max(acceleration, SMALLEST_ACCELERATION))


def target_acceleration(window_FWN3: torch.Tensor) -> torch.Tensor:
    """Returns the root mean square of the acceleration in the last three frames of each window, [F]."""
    acceleration_FN3 = window_FWN3[:, -1] - 2 * window_FWN3[:, -2] + window_FWN3[:, -3]
    return acceleration_FN3.square().mean((1, 2)).sqrt()


def random_walk(shape_MN3: tuple[int, int, int], std_last: float, generator: torch.Generator) -> torch.Tensor:
    """Returns velocity noise [m, N, 3], oldest first: a random walk that ends with standard deviation `std_last`."""
    steps_MN3 = torch.randn(shape_MN3, generator=generator, device=generator.device)
    return steps_MN3.cumsum(0) * (std_last / math.sqrt(shape_MN3[0]))


def correlated_walk(
    position_N3: torch.Tensor, history: int, std_last: float, cell_size: float, generator: torch.Generator
) -> torch.Tensor:
    """Returns velocity noise [m, N, 3] that is similar for neighbours, with the same standard deviation everywhere.

    It is a sum of plane waves, random Fourier features (Rahimi, Recht 2007). Amplitudes follow a `random_walk`.
    """
    waves, device = CORRELATED_WAVES, generator.device
    direction_K3 = torch.randn(waves, 3, generator=generator, device=device)
    length_K = torch.rand(waves, generator=generator, device=device)
    phase_K = 2 * math.pi * torch.rand(waves, generator=generator, device=device)
    shortest, longest = (cells * cell_size for cells in CORRELATED_WAVELENGTHS)
    number_K = 2 * math.pi / shortest * torch.exp(-math.log(longest / shortest) * length_K)
    wave_K3 = direction_K3 * (number_K / direction_K3.norm(dim=1))[:, None]
    height_NK = torch.cos(position_N3.float() @ wave_K3.T + phase_K)
    amplitude_MK3 = random_walk((history, waves, 3), std_last * math.sqrt(2 / waves), generator)
    return height_NK @ amplitude_MK3


def perturbed_window(
    batch: Batch, std_last: float, correlated: float = 0.0, cell_size: float = 1.0, dimensions: int = 3
) -> torch.Tensor:
    """Returns a copy of the batch's window with noise in its input frames, [W, N, 3].

    The random walk is added to the velocities, and its sums to the positions. The next position is shifted like the
    last one, so the target becomes v_true^{n+1} - v_noisy^n. The network learns to undo the velocity error, as in GNS
    (Sanchez-Gonzalez et al. 2020). `correlated` is the fraction of the variance that neighbours have in common. In a
    rollout the errors of a body's particles are correlated; independent noise averages out over a body. Unused axes
    (`dimensions` and above) have no noise.
    """
    window_WN3 = batch.window_WN3
    if std_last == 0:
        return window_WN3
    shift = []
    first = 0
    for count, seed in zip(batch.particles_S, batch.seeds_S, strict=True):
        generator = torch.Generator(window_WN3.device).manual_seed(seed)
        history = len(window_WN3) - 2
        velocity_MN3 = random_walk((history, count, 3), std_last * math.sqrt(1 - correlated), generator)
        if correlated > 0:
            generator.manual_seed(seed ^ WAVE_STREAM)
            position_N3 = window_WN3[-2, first : first + count]
            std = std_last * math.sqrt(correlated)
            velocity_MN3 = velocity_MN3 + correlated_walk(position_N3, history, std, cell_size, generator=generator)
        first += count
        velocity_MN3[..., dimensions:] = 0.0
        position_MN3 = velocity_MN3.cumsum(0)
        shift.append(torch.cat([torch.zeros_like(position_MN3[:1]), position_MN3, position_MN3[-1:]]))
    return window_WN3 + torch.cat(shift, dim=1)


def jittered_origin(batch: Batch, cell_size: float, dimensions: int = 3) -> torch.Tensor:
    """Returns grid origins uniform in [-cell_size, 0]^3, [S, 3]; 0 on unused axes (`dimensions` and above)."""
    origins = []
    for seed in batch.seeds_S:
        generator = torch.Generator().manual_seed(seed ^ JITTER_STREAM)
        origins.append(-cell_size * torch.rand(3, generator=generator))
    origin_S3 = torch.stack(origins)
    origin_S3[:, dimensions:] = 0.0
    return origin_S3.to(batch.window_WN3)
