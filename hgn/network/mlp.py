"""The building block of the paper's network (sec. 3.2, fig. 4): one hidden layer, LeakyReLU, LayerNorm.

The first layer acts on a concatenation of parts. It is linear, so each part can be multiplied before it is gathered:
once for each particle or cell, not for each pair or edge. The function is exactly the same, with less arithmetic.
`forward` is the plain definition; `project` and `finish` are its two halves.
"""

from collections.abc import Sequence

import torch
from torch import nn
from torch.compiler import is_exporting
from torch.nn import functional

LEAKY_SLOPE = 0.01
# CPU matrix libraries use other kernels for fewer rows, which sum in another order. Padding to MINIMUM_ROWS makes a
# scene's result bitwise independent of the other scenes of its batch.
MINIMUM_ROWS = 16


def linear(value: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None = None) -> torch.Tensor:
    """Returns the affine map of rows [..., in] to [..., out]. A row does not depend on the number of rows."""
    if not _few(value):
        return functional.linear(value, weight, bias)
    rows = value.shape[:-1].numel()
    flat = functional.pad(value.reshape(rows, value.shape[-1]), (0, 0, 0, MINIMUM_ROWS - rows))
    return functional.linear(flat, weight, bias)[:rows].reshape(*value.shape[:-1], len(weight))


def _few(value: torch.Tensor) -> bool:
    """Returns whether the rows are padded. An exported graph does not pad, because it has any number of rows."""
    return value.device.type == "cpu" and not is_exporting() and value.shape[:-1].numel() < MINIMUM_ROWS


class MLP(nn.Module):
    """A fully connected network on the concatenation of `parts`."""

    def __init__(
        self, parts: Sequence[int], hidden: int, out: int, layer_norm: bool = True, slope: float = LEAKY_SLOPE
    ) -> None:
        super().__init__()
        self.slope = slope  # slope of the activation below zero
        self.parts = tuple(parts)
        self.first = nn.Linear(sum(parts), hidden)
        self.second = nn.Linear(hidden, out)
        self.norm = nn.LayerNorm(out) if layer_norm else None

    def project(self, part: int, value: torch.Tensor) -> torch.Tensor:
        """Returns the first layer's product with one part, [..., parts[part]] -> [..., hidden], without the bias."""
        return linear(value, self.columns(part))

    def add_projection(self, hidden: torch.Tensor, part: int, value: torch.Tensor) -> torch.Tensor:
        """Adds `project(part, value)` of rows [R, parts[part]] to `hidden` [R, hidden], in place and in one pass."""
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
