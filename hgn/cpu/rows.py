"""Computes rows of an MLP in PyTorch without gradients: gathers from a table, multiplies, normalises, sums by segment.

This is the reference for hgn.cpu.compiled. If only sums are needed, gain and shift of the norm are applied to the sums.
Shape legend: R rows, K rows of a table, S segments, W width.
"""

from functools import cached_property, lru_cache
from typing import NamedTuple

import torch
from torch import nn

from hgn.network.mlp import MINIMUM_ROWS, MLP, linear


class Hidden(NamedTuple):
    """Holds a hidden layer before its activation: sums of `each` rows of a table, plus a product with a value."""

    table_KW: torch.Tensor
    chosen: torch.Tensor | None  # int64 [R * each]; None: all rows of the table, and the table may be overwritten
    each: int
    part: int = 0
    value_RW: torch.Tensor | None = None  # the factor of part `part` of the first layer; None: no product


class Segments(NamedTuple):
    """Holds runs of rows that are summed, each row times its weight."""

    rows: int
    offset: torch.Tensor  # [S + 1], int64: first row of each run, then the number of rows
    weight_R: torch.Tensor | None  # None: all weights are one


class Rows:
    """Computes an MLP of rows [R, W]. It reads the parameters once per frame, because module attributes are slow."""

    def __init__(self, network: nn.Module) -> None:
        assert isinstance(network, MLP)
        first, second = network.first, network.second
        self.parts = first.weight.T.split_with_sizes(network.parts)  # [in, out]
        self.first_bias, self.slope = first.bias, network.slope
        self.second: torch.Tensor = second.weight.T
        self.second_bias: torch.Tensor = second.bias
        self.norm = None if network.norm is None else (network.norm.weight, network.norm.bias, network.norm.eps)

    def project(self, part: int, value: torch.Tensor, bias: torch.Tensor | None = None) -> torch.Tensor:
        return _product(value, self.parts[part], bias)

    def project_into(self, out: torch.Tensor, part: int, value: torch.Tensor, bias: torch.Tensor | None = None) -> None:
        if len(value) < MINIMUM_ROWS:
            out.copy_(_product(value, self.parts[part], bias))
        elif bias is None:
            torch.mm(value, self.parts[part], out=out)
        else:
            torch.addmm(bias, value, self.parts[part], out=out)

    def add_projection(self, hidden: torch.Tensor, part: int, value: torch.Tensor) -> torch.Tensor:
        if len(value) < MINIMUM_ROWS:
            return hidden.add_(_product(value, self.parts[part]))
        return hidden.addmm_(value, self.parts[part])

    def finish(self, hidden: torch.Tensor) -> torch.Tensor:
        """Returns the output of a hidden layer, and overwrites the hidden layer."""
        out = _product(nn.functional.leaky_relu_(hidden, self.slope), self.second, self.second_bias)
        if self.norm is None:
            return out
        gain, shift, epsilon = self.norm
        return torch.layer_norm(out, gain.shape, gain, shift, epsilon)

    def output(self, out_RW: torch.Tensor, hidden: Hidden, residual_RW: torch.Tensor | None = None) -> None:
        """Writes the output plus the residual into `out_RW`, which may be the same tensor as the residual."""
        rows_RW = self.finish(self._hidden(hidden))
        if residual_RW is None:
            out_RW.copy_(rows_RW)
        else:
            torch.add(rows_RW, residual_RW, out=out_RW)

    def add_sums(self, sum_SW: torch.Tensor, hidden: Hidden, segments: Segments) -> None:
        """Adds the sums of the outputs to `sum_SW`."""
        assert self.norm is not None
        gain, shift, epsilon = self.norm
        matrix, bias = self._centred
        rows_RW = _product(nn.functional.leaky_relu_(self._hidden(hidden), self.slope), matrix, bias)
        scale_R = torch.linalg.vector_norm(rows_RW, dim=1).square_()
        scale_R.mul_(1 / rows_RW.shape[1]).add_(epsilon).rsqrt_()
        if segments.weight_R is None:
            total_S1 = segments.offset.diff()[:, None]
        else:
            total_S1 = _summed(segments.weight_R[:, None], segments.offset)
            scale_R.mul_(segments.weight_R)
        sum_SW.add_(_summed(rows_RW, segments.offset, scale_R).mul_(gain).addcmul_(total_S1, shift))

    def output_and_add_sums(
        self, sum_SW: torch.Tensor, hidden: Hidden, segments: Segments, residual_RW: torch.Tensor | None
    ) -> torch.Tensor:
        """Returns outputs plus residual, which it may overwrite. Adds the sums of the outputs to `sum_SW`."""
        assert segments.weight_R is None
        rows_RW = self.finish(self._hidden(hidden))
        sum_SW.add_(_summed(rows_RW, segments.offset))
        return rows_RW if residual_RW is None else residual_RW.add_(rows_RW)

    def _hidden(self, hidden: Hidden) -> torch.Tensor:
        table_KW, chosen, each, part, value_RW = hidden
        if chosen is None:
            rows_RW = table_KW
        elif each == 1:
            rows_RW = table_KW.index_select(0, chosen)
        else:
            rows_RW = _summed(table_KW, _steps(len(chosen) + 1, each), chosen=chosen)
        return rows_RW if value_RW is None else self.add_projection(rows_RW, part, value_RW)

    @cached_property
    def _centred(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the second layer minus its mean over the outputs, which gives the numerator of the norm."""
        return self.second - self.second.mean(1, keepdim=True), self.second_bias - self.second_bias.mean()


def _product(value: torch.Tensor, matrix: torch.Tensor, bias: torch.Tensor | None = None) -> torch.Tensor:
    """Returns rows times a matrix plus bias, independent of the number of rows, as hgn.network.mlp.linear."""
    if len(value) < MINIMUM_ROWS:
        return linear(value, matrix.T, bias)
    return torch.mm(value, matrix) if bias is None else torch.addmm(bias, value, matrix)


def _summed(
    table_KW: torch.Tensor,
    offset: torch.Tensor,
    weight_R: torch.Tensor | None = None,
    chosen: torch.Tensor | None = None,
) -> torch.Tensor:
    """Returns the sums [S, W] of runs of rows, or of chosen rows, in one pass."""
    chosen = _steps(len(table_KW)) if chosen is None else chosen
    result: torch.Tensor = torch.embedding_bag(
        table_KW, chosen, offset, per_sample_weights=weight_R, include_last_offset=True
    )[0]
    return result


@lru_cache(64)
def _steps(end: int, step: int = 1) -> torch.Tensor:
    """Returns the multiples of `step` below `end`, cached because blocks of the same size recur."""
    with torch.inference_mode(False):
        return torch.arange(0, end, step)
