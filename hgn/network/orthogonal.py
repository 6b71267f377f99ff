"""Square blocks of the weights and their orthogonalisation, for the steps of the Muon optimiser.

Shape legend: K blocks, W width.
"""

import math

import torch

from hgn.network.base import ParticleNetwork
from hgn.network.mlp import MLP

# Keller Jordan 2024 (Muon): the largest slope at zero for which singular values end between 0.7 and 1.2
COEFFICIENTS = (3.4445, -4.7750, 2.0315)
ITERATIONS = 5
EPSILON = 1e-7
MOMENTUM = 0.95
RELATIVE_STEP = 0.2  # rms of a step in learning rates, as Adam's is in practice (Liu et al. 2025)


def square_blocks(network: ParticleNetwork) -> torch.Tensor:
    """Returns the indices of all latent-to-latent blocks in the concatenated parameters, int64 [K, W, W].

    A first layer on several parts consists of several matrices side by side. Each is a block, except in the encoder.
    """
    width = network.config.width
    start, total = {}, 0
    for parameter in network.parameters():
        start[id(parameter)] = total
        total += parameter.numel()

    def places(weight: torch.Tensor) -> torch.Tensor:
        return torch.arange(weight.numel()).view(weight.shape) + start[id(weight)]

    blocks = []
    for module in network.modules():
        if isinstance(module, MLP):
            first = () if module is network.encode else places(module.first.weight).split(module.parts, dim=1)
            blocks += [piece for piece in (*first, places(module.second.weight)) if piece.shape == (width, width)]
    return torch.stack(blocks) if blocks else torch.zeros(0, width, width, dtype=torch.int64)


def step_size(width: int) -> float:
    """Returns the length of a step along an orthogonal matrix (elements of rms width^-1/2), in learning rates."""
    return RELATIVE_STEP * math.sqrt(width)


def normalised(matrix_KWW: torch.Tensor) -> torch.Tensor:
    """Scales matrices to Frobenius norm 1. Then no singular value is above 1."""
    return matrix_KWW / (matrix_KWW.norm(dim=(1, 2), keepdim=True) + EPSILON)


def orthogonalised(matrix_KWW: torch.Tensor) -> torch.Tensor:
    """Returns approximately U V^T of the SVD of matrices of norm 1.

    Singular vectors stay, and singular values become nearly 1. The iterations are those of Newton and Schulz, of odd
    degree five, with three products each.
    """
    a, b, c = COEFFICIENTS
    x_KWW = matrix_KWW
    for _ in range(ITERATIONS):
        square_KWW = torch.bmm(x_KWW, x_KWW.mT)
        factor_KWW = torch.baddbmm(square_KWW, square_KWW, square_KWW, beta=b, alpha=c)
        x_KWW = torch.baddbmm(x_KWW, factor_KWW, x_KWW, beta=a)
    return x_KWW
