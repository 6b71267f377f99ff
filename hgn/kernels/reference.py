"""What the kernels' references share. A reference is plain PyTorch beside its kernel: it has the kernel's name, takes
the kernel's arguments by name, and returns what the kernel should leave in each buffer that it writes.

A reference computes in the type of what it is given, float64 in the tests, and there of parameters not rounded.
Gradients are those at the activations' signs that the kernel itself sees: of the hidden layer as it lies in memory, or
where a kernel computes it again, of what it computes, rounded as it rounds.
Shape legend: R rows, N particles, C cells, E edges, W width.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch.nn import functional

from hgn.network.grid import CORNER_83, DIRECTION_63
from hgn.network.mlp import LEAKY_SLOPE


@dataclass(frozen=True)
class Added:
    """What is added to the buffer `totals` from element `at` on, times the loss scale (1 / unscale).

    `summands` is the root of the sum of the squares of what was summed: where summands cancel, rounding counts by it.
    """

    at: int
    value: torch.Tensor
    summands: float = 0.0


@dataclass(frozen=True)
class ProgramSums:
    """What the rows from `first` on of the buffer `partial` [programs, ROWS, ...] add up to over all programs."""

    first: int
    value: torch.Tensor


# By the buffer's name, or one that says what is added. A tensor: the buffer's first elements (NaN: not promised).
Outputs = dict[str, torch.Tensor | Added | ProgramSums]


def rows(x: torch.Tensor, *shape: int) -> torch.Tensor:
    """The first elements of a buffer that may have more of them."""
    return x.flatten()[: math.prod(shape)].view(shape)


def part(parameters: torch.Tensor, at: int, *shape: int) -> torch.Tensor:
    """The parameter at a place of the packed ones."""
    return rows(parameters.flatten()[at:], *shape)


def nowhere(x: torch.Tensor, there: torch.Tensor) -> torch.Tensor:
    """x [..., W], of which nothing is promised but where `there` says so."""
    return torch.where(there[..., None], x, math.nan)


def leaky(h: torch.Tensor) -> torch.Tensor:
    return functional.leaky_relu(h, LEAKY_SLOPE)


def leaky_backward(gradient: torch.Tensor, positive: torch.Tensor) -> torch.Tensor:
    return torch.where(positive, gradient, LEAKY_SLOPE * gradient)


def normalised_rows(z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows of zero mean and unit variance, and one over the standard deviation."""
    centred = z - z.mean(-1, keepdim=True)
    rstd = (centred.square().mean(-1) + 1e-5).rsqrt()
    return centred * rstd[..., None], rstd


def norm_backward(
    gradient: torch.Tensor, z: torch.Tensor, weight_W: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Gradients of z, of the norm's weight and of its bias, by autograd."""
    with torch.enable_grad():
        z, weight_W = z.detach().requires_grad_(), weight_W.detach().requires_grad_()
        bias_W = torch.zeros_like(weight_W, requires_grad=True)
        y = functional.layer_norm(z, z.shape[-1:], weight_W, bias_W)
        first, second, third = torch.autograd.grad(y, (z, weight_W, bias_W), gradient)
    return first, second, third


def stored_norm_backward(
    gradient: torch.Tensor, normalised: torch.Tensor, rstd: torch.Tensor, weight_W: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The same from the stored output and one over its deviation; zero where there is no row (0)."""
    there = rstd != 0
    result = torch.zeros_like(gradient)
    values = norm_backward(gradient[there], normalised[there] / rstd[there][:, None], weight_W)
    result[there] = values[0]
    return result, values[1], values[2]


def listed_sums(x: torch.Tensor, table: torch.Tensor, edges: bool) -> torch.Tensor:
    """For each column of the table [SUM, R] the sum of x's rows that it lists (below zero: none).

    With `edges` x is [C, SUM, W]: of the row listed for a direction the opposite direction's part.
    """
    total = x.new_zeros(table.shape[1], x.shape[-1])
    for i, row in enumerate(table):
        values = x[:, i ^ 1] if edges else x
        total[row >= 0] += values[row[row >= 0]]
    return total


def corners(like: torch.Tensor) -> torch.Tensor:
    """The bits of a cell's eight corners [8, 3]."""
    return CORNER_83.to(like)


def directions(like: torch.Tensor) -> torch.Tensor:
    """The six neighbours of a cell [6, 3]."""
    return DIRECTION_63.to(like)
