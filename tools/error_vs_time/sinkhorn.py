"""The debiased Sinkhorn divergence between two clouds of particles (Feydy et al. 2019).

An optimal-transport distance that does not care which particle is which: small where a rollout looks right although no
particle is where the reference has it. S(a, b) = OT(a, b) - OT(a, a) / 2 - OT(b, b) / 2, each with entropy blur².
Shape legend: N, M particles.
"""

from __future__ import annotations

import math

import torch

SCALING = 0.8  # the blur's ratio between steps, from the clouds' size down
FINAL_STEPS = 20  # at the last blur


def sinkhorn_divergence(first_N3: torch.Tensor, second_M3: torch.Tensor, blur: float) -> float:
    """In units of length squared: the mean squared distance that mass has to move. NaN where positions are not finite.

    Zero for equal clouds, the square of the shift for a shifted one. `blur` is the length below which matter may be
    mixed up. Costs memory and time of N x M.
    """
    if not (bool(first_N3.isfinite().all()) and bool(second_M3.isfinite().all())):
        return math.nan
    both = torch.cat([first_N3, second_M3])
    size = float((both.amax(0) - both.amin(0)).norm())
    steps = max(0, math.ceil(math.log(blur / size) / math.log(SCALING))) if size > blur else 0
    blurs = [size * SCALING**k for k in range(steps)] + [blur] * FINAL_STEPS
    cost_NM = _squared(first_N3, second_M3)
    f_N, g_M = _potentials(cost_NM, blurs)
    own_N = _symmetric_potential(_squared(first_N3, first_N3), blurs)
    own_M = _symmetric_potential(_squared(second_M3, second_M3), blurs)
    return float((f_N - own_N).mean() + (g_M - own_M).mean())


def _potentials(cost_NM: torch.Tensor, blurs: list[float]) -> tuple[torch.Tensor, torch.Tensor]:
    f_N, g_M = cost_NM.new_zeros(len(cost_NM)), cost_NM.new_zeros(cost_NM.shape[1])
    for blur in blurs:
        # Both from the old ones, averaged: symmetric in the clouds, and it does not oscillate.
        next_f_N, next_g_M = _soft_minimum(cost_NM, g_M, blur), _soft_minimum(cost_NM.T, f_N, blur)
        f_N, g_M = 0.5 * (f_N + next_f_N), 0.5 * (g_M + next_g_M)
    return _soft_minimum(cost_NM, g_M, blurs[-1]), _soft_minimum(cost_NM.T, f_N, blurs[-1])


def _symmetric_potential(cost_NN: torch.Tensor, blurs: list[float]) -> torch.Tensor:
    f_N = cost_NN.new_zeros(len(cost_NN))
    for blur in blurs:
        f_N = 0.5 * (f_N + _soft_minimum(cost_NN, f_N, blur))
    return _soft_minimum(cost_NN, f_N, blurs[-1])


def _soft_minimum(cost_NM: torch.Tensor, g_M: torch.Tensor, blur: float) -> torch.Tensor:
    """-ε log mean exp((g - c) / ε) over M, with ε = blur²."""
    epsilon = blur * blur
    return -epsilon * (torch.logsumexp((g_M - cost_NM) / epsilon, dim=1) - math.log(cost_NM.shape[1]))


def _squared(first_N3: torch.Tensor, second_M3: torch.Tensor) -> torch.Tensor:
    # By differences: as a matrix product it would round in TF32.
    return torch.cdist(first_N3, second_M3, compute_mode="donot_use_mm_for_euclid_dist").square()
