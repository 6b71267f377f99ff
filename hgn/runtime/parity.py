"""How far apart two computations of the same thing are, and how far backend triton may be from PyTorch."""

from __future__ import annotations

import math

import torch

GRADIENT_BOUND = 0.3  # relative error of all gradients, of the norm
OUTPUT_BOUND = 0.05  # relative error of the network's outputs; both round, and wrong kernels miss it by far


def relative_error(found: torch.Tensor, expected: torch.Tensor) -> float:
    """Of the norm. Where nothing is expected: 0 if nothing is found, else infinite."""
    difference, size = float((found - expected).norm()), float(expected.norm())
    if size > 0:
        return difference / size
    return 0.0 if difference == 0 else math.inf
