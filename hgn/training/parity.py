"""Compares training kernels with PyTorch on the first batch, before the first update (bounds: hgn.runtime.parity).

It compares the outputs, and for each parameter tensor the gradient of the mean absolute output, whose terms do not
cancel. Gradients of a sum with random signs are badly conditioned: rounding to 11 bits changes them by up to 0.7.

Shape legend: N particles of all scenes, S scenes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from hgn.data.episode_tensors import EpisodeTensors
from hgn.kernels.update.op import Updates
from hgn.network.elastic import RestShape
from hgn.network.features import ParticleState
from hgn.network.moving import MovingObstacles
from hgn.network.obstacles import ObstacleCells
from hgn.runtime.parity import GRADIENTS, OUTPUTS, require_parity
from hgn.scene.material import INPUT_PARAMETERS
from hgn.scene.symmetry import Symmetry
from hgn.training.symmetry import moving_under, obstacles_under

CHECKED_PARTICLES = 200_000  # largest number of particles to check; autograd needs memory


def require_update_parity(
    updates: Updates,
    episodes: Sequence[EpisodeTensors],
    symmetries: Sequence[Symmetry] | None = None,
    frames: Sequence[int] = (),
) -> tuple[float, float]:
    """Returns the relative errors of outputs and gradients on the batch of `updates`, which has images of `episodes`
    in `frames`.

    The errors are NaN for a batch of more than CHECKED_PARTICLES. Raises: ParityError if an error exceeds its bound.
    """
    network, fused, count = updates.network, updates.fused, int(updates.buffers.count)
    if count > CHECKED_PARTICLES:
        return math.nan, math.nan
    state, origin_S3 = _state(updates, episodes, symmetries, count)
    own, seen = [episode.moving for episode in episodes], updates.config.obstacle_features
    moving = MovingObstacles.of(own, frames, episodes[0].frame_s, seen)
    if moving is not None:
        moving = moving if symmetries is None else moving_under(moving, symmetries)
        state = replace(state, moving=moving.to(updates.device))
    parameters = list(network.parameters())
    output_N3 = network.normalised_acceleration(state, origin_S3)
    weight_N3 = output_N3.detach().sign() * updates.share_N[:count, None]
    slopes = torch.autograd.grad((output_N3 * weight_N3).sum(), parameters, allow_unused=True)
    output_error = require_parity(
        fused.output[:count, :3], output_N3.detach(), OUTPUTS, updates.precision, section="training."
    )
    fused.output_gradient[:count].zero_()
    fused.output_gradient[:count, :3] = weight_N3 / fused.unscale
    fused.backward()
    gradients = [torch.zeros_like(parameter) for parameter in parameters]
    updates.packed.scatter(fused.totals[: updates.packed.size], gradients)
    gradient_error = max(
        require_parity(
            own, torch.zeros_like(own) if slope is None else slope, GRADIENTS, updates.precision, section="training."
        )
        for own, slope in zip(gradients, slopes, strict=True)
    )
    if updates.device.type == "cuda":
        del output_N3, slopes
        torch.cuda.empty_cache()  # free memory determines where episodes are stored
    return output_error, gradient_error


def _state(
    updates: Updates, episodes: Sequence[EpisodeTensors], symmetries: Sequence[Symmetry] | None, count: int
) -> tuple[ParticleState, torch.Tensor]:
    """Returns the batch as PyTorch's input, noise and jitter included."""
    config = updates.config
    obstacles = ObstacleCells.of([episode.obstacle_grid for episode in episodes])
    if obstacles is not None and symmetries is not None:
        obstacles = obstacles_under(obstacles, symmetries)
    particles = updates.buffers
    columns_NP, rest_NR = particles.parameter_NP, particles.rest_NR
    state = ParticleState(
        position_N3=particles.position_N3[:count],
        velocity_NM3=particles.velocity_NV[:count].view(count, config.velocity_history, 3),
        material_N=particles.material_N[:count].long(),
        scene_N=particles.scene_N[:count].long(),
        domain_S3=particles.domain_S3,
        gravity_S3=particles.gravity_S3,
        obstacles=obstacles and obstacles.to(updates.device),
        wall_friction_S3=particles.wall_friction_S3,
        parameter_NP=columns_NP if columns_NP is None else columns_NP[:count, : len(INPUT_PARAMETERS)],
        rest=None if rest_NR is None else RestShape.unpacked(rest_NR[:count], particles.position_N3[:count]),
    )
    return state, particles.origin_S3
