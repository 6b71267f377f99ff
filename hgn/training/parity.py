"""Compares training kernels with PyTorch on the first batch, before the first update (bounds: hgn.runtime.parity).

It compares the outputs, and for each parameter tensor the gradient of the mean absolute output, whose terms do not
cancel. Gradients of a sum with random signs are badly conditioned: rounding to 11 bits changes them by up to 0.7.
With friction the gradient of `relative.balanced` jumps where a body at rest or in motion is about to stick (k = 1 in
hgn.network.own_physics), and rounding decides on which side it is. So the kernels' backward pass begins with PyTorch's
output of the decoder, for which both are on the same side.
No tensor may exceed its bound. The root mean square of all errors is compared with that of the changes in PyTorch when
parameters change by up to ROUNDING, plus LEAST_CHANGE. Right kernels have at most 1.1 times this, and kernels whose
backward pass lacks a direction of edges at least 2.6 times.

Shape legend: N particles of all scenes, K outputs of the decoder, S scenes.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from hgn.data.episode_tensors import EpisodeTensors
from hgn.kernels.update.op import Updates
from hgn.network.elastic import RestShape
from hgn.network.features import ParticleState
from hgn.network.grid import GridHierarchy
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.network.moving import MovingObstacles
from hgn.network.obstacles import ObstacleCells
from hgn.runtime.parity import GRADIENTS, OUTPUTS, relative_error, require_error, require_parity
from hgn.scene.material import INPUT_PARAMETERS
from hgn.scene.symmetry import Symmetry
from hgn.training.symmetry import moving_under, obstacles_under

CHECKED_PARTICLES = 200_000  # largest number of particles to check; autograd needs memory
ROUNDING = 2.0**-11  # relative change of parameters, as fp16 and tf32 round them
CHANGES, LEAST_CHANGE = 2.0, 0.01  # largest ratio, and what is added to the changes


def require_update_parity(
    updates: Updates,
    episodes: Sequence[EpisodeTensors],
    symmetries: Sequence[Symmetry] | None = None,
    frames: Sequence[int] = (),
) -> tuple[float, float]:
    """Returns the relative errors of outputs and gradients on the batch of `updates`: `episodes` under `symmetries`, in
    `frames`.

    The errors are NaN for a batch of more than CHECKED_PARTICLES. Raises: ParityError if an error exceeds its bound.
    """
    network, fused, count = updates.network, updates.fused, int(updates.buffers.count)
    if count > CHECKED_PARTICLES:
        return math.nan, math.nan
    state, origin_S3 = _state(updates, episodes, symmetries, count)
    own = [episode.moving for episode in episodes]
    moving = MovingObstacles.of(own, frames, episodes[0].frame_s, updates.config)
    if moving is not None:
        moving = moving if symmetries is None else moving_under(moving, symmetries)
        state = replace(state, moving=moving.to(updates.device))
    output_N3, decoded_NK = _predicted(network, state, origin_S3)
    weight_N3 = output_N3.detach().sign() * updates.loss_weight_N[:count, None]
    (weight_NK,) = torch.autograd.grad(output_N3, decoded_NK, weight_N3, retain_graph=True)
    expected = _gradients(network, decoded_NK, weight_NK)
    output_error = require_parity(
        fused.output[:count, :3], output_N3.detach(), OUTPUTS, updates.precision, section="training."
    )
    if network.config.relative:
        fused.grid.sum_C.zero_()
        fused.output[:count, : decoded_NK.shape[1]] = decoded_NK.detach()
        fused.grid.balance(fused.output, fused.particle_count)
    fused.output_gradient[:count].zero_()
    fused.output_gradient[:count, :3] = weight_N3 / fused.unscale
    fused.backward()
    gradients = [torch.zeros_like(gradient) for gradient in expected]
    updates.packed.scatter(fused.totals[: updates.packed.size], gradients)
    errors = _errors(gradients, expected)
    rounded = _rounded(network)
    changes = _errors(_gradients(rounded, _predicted(rounded, state, origin_S3)[1], weight_NK), expected)
    together = replace(GRADIENTS, bound=CHANGES * (_rms(changes) + LEAST_CHANGE))
    for error, quantity in ((_rms(errors), together), (max(errors), GRADIENTS)):
        gradient_error = require_error(error, quantity, updates.precision, section="training.")
    if updates.device.type == "cuda":
        del output_N3, expected, gradients
        torch.cuda.empty_cache()  # free memory determines where episodes are stored
    return output_error, gradient_error


def _predicted(
    network: HierarchicalGraphNetwork, state: ParticleState, origin_S3: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the network's outputs and those of its decoder, from which `relative.balanced` computes them."""
    decoded: list[torch.Tensor] = []

    def propagate(particle_NW: torch.Tensor, grid: GridHierarchy) -> torch.Tensor:
        decoded.append(network.propagate(particle_NW, grid))
        return decoded[0]

    prediction = network.predicted(state, origin_S3, propagate)
    return prediction.acceleration_N3, decoded[0]


def _gradients(
    network: HierarchicalGraphNetwork, decoded_NK: torch.Tensor, weight_NK: torch.Tensor
) -> list[torch.Tensor]:
    """Returns the gradients of the weighted sum of the decoder's outputs with respect to the parameters."""
    parameters = list(network.parameters())
    gradients = torch.autograd.grad(decoded_NK, parameters, weight_NK, allow_unused=True)
    return [torch.zeros_like(p) if g is None else g for p, g in zip(parameters, gradients, strict=True)]


def _rounded(network: HierarchicalGraphNetwork) -> HierarchicalGraphNetwork:
    """Returns a copy whose parameters differ by random factors, because stored parameters may be rounded already."""
    rounded, generator = copy.deepcopy(network), torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in rounded.parameters():
            change = ROUNDING * (2 * torch.rand(parameter.shape, generator=generator) - 1)
            parameter.mul_(1 + change.to(parameter))
    return rounded


def _errors(computed: list[torch.Tensor], expected: list[torch.Tensor]) -> list[float]:
    return [relative_error(x, y, GRADIENTS.least) for x, y in zip(computed, expected, strict=True)]


def _rms(errors: list[float]) -> float:
    return math.hypot(*errors) / len(errors) ** 0.5


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
