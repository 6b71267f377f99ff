"""The building block of the paper's network (sec. 3.2, fig. 4): one hidden layer, LeakyReLU, LayerNorm.

The first layer acts on a concatenation of parts. Since it is linear, each part can be multiplied where it lives
(once a particle or a cell) and only the products be gathered to pairs or edges: exactly the same function
for a fraction of the arithmetic. `forward` is the plain definition, `project` and `finish` are its halves.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn
from torch.compiler import is_exporting
from torch.nn import functional

LEAKY_SLOPE = 0.01
# For a handful of rows, CPU matrix libraries take other kernels, which sum in another order. Padding keeps a scene's
# result independent, to the last bit, of what shares its batch.
MINIMUM_ROWS = 16


def linear(value: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None = None) -> torch.Tensor:
    """Returns the affine map of rows [R, in] (or [..., in]) to [R, out]; a row does not depend on the number of
    rows."""
    if not _few(value):
        return functional.linear(value, weight, bias)
    rows = value.shape[:-1].numel()
    flat = functional.pad(value.reshape(rows, value.shape[-1]), (0, 0, 0, MINIMUM_ROWS - rows))
    return functional.linear(flat, weight, bias)[:rows].reshape(*value.shape[:-1], len(weight))


def _few(value: torch.Tensor) -> bool:
    """Returns whether the rows are padded. An exported graph, which serves all sizes, does not pad."""
    return value.device.type == "cpu" and not is_exporting() and value.shape[:-1].numel() < MINIMUM_ROWS


class MLP(nn.Module):
    """A fully connected network on the concatenation of `parts`."""

    def __init__(
        self, parts: Sequence[int], hidden: int, out: int, layer_norm: bool = True, slope: float = LEAKY_SLOPE
    ) -> None:
        super().__init__()
        self.slope = slope  # of the activation below zero
        self.parts = tuple(parts)
        self.first = nn.Linear(sum(parts), hidden)
        self.second = nn.Linear(hidden, out)
        self.norm = nn.LayerNorm(out) if layer_norm else None

    def project(self, part: int, value: torch.Tensor) -> torch.Tensor:
        """Returns the first layer's product with one part, [..., parts[part]] -> [..., hidden], without the bias."""
        return linear(value, self.columns(part))

    def add_projection(self, hidden: torch.Tensor, part: int, value: torch.Tensor) -> torch.Tensor:
        """Adds that product with rows [R, parts[part]] to `hidden` [R, hidden], in place and in one pass."""
        if not _few(value):
            return hidden.addmm_(value, self.columns(part).T)
        return hidden.add_(self.project(part, value))

    def finish(self, hidden: torch.Tensor) -> torch.Tensor:
        """Returns the output [..., out] from the sum of all projections, bias included. Overwrites `hidden`."""
        out = linear(functional.leaky_relu_(hidden, self.slope), self.second.weight, self.second.bias)
        return out if self.norm is None else self.norm(out)

    def forward(self, *values: torch.Tensor) -> torch.Tensor:
        """Computes the definition: concatenation, two layers, norm."""
        return self.finish(linear(torch.cat(values, dim=-1), self.first.weight, self.first.bias))

    def columns(self, part: int) -> torch.Tensor:
        start = sum(self.parts[:part])
        return self.first.weight[:, start : start + self.parts[part]]
