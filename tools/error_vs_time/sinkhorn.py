"""The debiased Sinkhorn divergence between two clouds of particles (Feydy et al. 2019).

An optimal-transport distance that ignores the identity of particles: it is small if a rollout looks right although its
particles are elsewhere than the reference's. S(a, b) = OT(a, b) - OT(a, a) / 2 - OT(b, b) / 2, each with entropy blur².
Shape legend: B pairs of clouds, N, M particles.
"""

import math
from collections.abc import Sequence

import torch

SCALING = 0.8  # the blur's ratio between steps, from the clouds' size down
LARGEST = 10.0  # blur, for the precision of float32
FINAL_STEPS = 20  # at the last blur
ENTRIES_AT_ONCE = 1 << 26  # of costs


def sinkhorn_divergences(pairs: Sequence[tuple[torch.Tensor, torch.Tensor]], blur: float) -> list[float]:
    """Returns the mean squared distance that mass has to move, for each pair; NaN if positions are not finite.

    Zero for equal clouds, the square of the shift for a shifted one. `blur` is the length below which clouds are not
    distinguished. Needs memory and time of N x M; pairs of equal numbers of particles are computed together.
    """
    divergences = [math.nan] * len(pairs)
    of_size: dict[tuple[int, int], list[int]] = {}
    for i, (first_N3, second_M3) in enumerate(pairs):
        of_size.setdefault((len(first_N3), len(second_M3)), []).append(i)
    for (n, m), indices in of_size.items():
        together = max(1, ENTRIES_AT_ONCE // (max(n, m) ** 2))
        for start in range(0, len(indices), together):
            some = indices[start : start + together]
            first_BN3, second_BM3 = (torch.stack([pairs[i][side] for i in some]) for side in (0, 1))
            for i, value in zip(some, _divergences(first_BN3, second_BM3, blur).tolist(), strict=True):
                divergences[i] = value
    return divergences


def _divergences(first_BN3: torch.Tensor, second_BM3: torch.Tensor, blur: float) -> torch.Tensor:
    both = torch.cat([first_BN3, second_BM3], dim=1)
    finite_B = both.isfinite().flatten(1).all(1)
    size_B = (both.amax(1) - both.amin(1)).norm(dim=-1)
    blurs = _blurs(float(size_B[finite_B].clamp(max=LARGEST).max()) if finite_B.any() else 0.0, blur)
    f_BN, g_BM = _potentials(_squared(first_BN3, second_BM3), blurs)
    own_BN = _symmetric_potential(_squared(first_BN3, first_BN3), blurs)
    own_BM = _symmetric_potential(_squared(second_BM3, second_BM3), blurs)
    return torch.where(finite_B, (f_BN - own_BN).mean(1) + (g_BM - own_BM).mean(1), math.nan)


def _blurs(size: float, blur: float) -> list[float]:
    """Returns decreasing blurs from the size of the clouds, which converge sooner, and FINAL_STEPS of the last."""
    steps = max(0, math.ceil(math.log(blur / size) / math.log(SCALING))) if blur < size else 0
    return [size * SCALING**k for k in range(steps)] + [blur] * FINAL_STEPS


def _potentials(cost_BNM: torch.Tensor, blurs: Sequence[float]) -> tuple[torch.Tensor, torch.Tensor]:
    f_BN, g_BM = cost_BNM.new_zeros(cost_BNM.shape[:2]), cost_BNM.new_zeros(cost_BNM.shape[0], cost_BNM.shape[2])
    turned_BMN = cost_BNM.transpose(1, 2)
    for blur in blurs:
        # both from the old potentials, averaged: symmetric in the clouds, without oscillation
        next_f_BN, next_g_BM = _soft_minimum(cost_BNM, g_BM, blur), _soft_minimum(turned_BMN, f_BN, blur)
        f_BN, g_BM = 0.5 * (f_BN + next_f_BN), 0.5 * (g_BM + next_g_BM)
    return _soft_minimum(cost_BNM, g_BM, blurs[-1]), _soft_minimum(turned_BMN, f_BN, blurs[-1])


def _symmetric_potential(cost_BNN: torch.Tensor, blurs: Sequence[float]) -> torch.Tensor:
    f_BN = cost_BNN.new_zeros(cost_BNN.shape[:2])
    for blur in blurs:
        f_BN = 0.5 * (f_BN + _soft_minimum(cost_BNN, f_BN, blur))
    return _soft_minimum(cost_BNN, f_BN, blurs[-1])


def _soft_minimum(cost_BNM: torch.Tensor, g_BM: torch.Tensor, blur: float) -> torch.Tensor:
    """-ε log mean exp((g - c) / ε) over M, with ε = blur²."""
    exponent_BNM = (g_BM[:, None] - cost_BNM).div_(blur**2)
    return -(blur**2) * (torch.logsumexp(exponent_BNM, dim=2) - math.log(cost_BNM.shape[2]))


def _squared(first_BN3: torch.Tensor, second_BM3: torch.Tensor) -> torch.Tensor:
    # by differences: a matrix product would be rounded to TF32
    return torch.cdist(first_BN3, second_BM3, compute_mode="donot_use_mm_for_euclid_dist").square()
