"""Sums over the rows of each segment, and the spreading of one row to its whole segment: each the other's gradient.

The rows of a segment lie together, so that a sum needs no atomic additions and has a fixed order.
Shape legend: E rows, N segments, W width.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch


@dataclass(frozen=True, eq=False)
class Segments:
    """Segment i holds the rows offset_N1[i] to offset_N1[i + 1] - 1.

    Rows beyond the last offset belong to none (room of a fixed size that is not full); no gradients then.
    """

    offset_N1: torch.Tensor  # int64 [N + 1], ascending from 0
    segment_E: torch.Tensor  # int64, the segment of each row; any valid index beyond the last offset

    @property
    def count(self) -> int:
        return len(self.offset_N1) - 1

    def blocks(self, rows: int) -> list[Block]:
        """Runs of whole segments of about `rows` rows each; waits for the device where there are several."""
        total = len(self.segment_E)
        if total <= rows:
            return [Block(slice(0, self.count), slice(0, total), self)]
        wanted = torch.arange(rows, total, rows, device=self.offset_N1.device)
        cut = torch.searchsorted(self.offset_N1, wanted).clamp_(max=self.count)
        places = [(0, 0), *torch.stack([cut, self.offset_N1[cut]], dim=-1).tolist(), (self.count, total)]
        blocks = []
        for (first, first_row), (last, last_row) in itertools.pairwise(places):
            if last > first:
                part = Segments(
                    self.offset_N1[first : last + 1] - first_row, self.segment_E[first_row:last_row] - first
                )
                blocks.append(Block(slice(first, last), slice(first_row, last_row), part))
        return blocks

    def sum(self, row_EW: torch.Tensor) -> torch.Tensor:
        """The sum of the rows of each segment, [N, W]; zero where it has none."""
        result: torch.Tensor = _Sum.apply(row_EW, self)
        return result

    def spread(self, value_NW: torch.Tensor) -> torch.Tensor:
        """Each segment's value at its rows, [E, W]."""
        result: torch.Tensor = _Spread.apply(value_NW, self)
        return result


@dataclass(frozen=True, eq=False)
class Block:
    """Some consecutive segments, their rows, and themselves counted from zero."""

    segments: slice
    rows: slice
    part: Segments


def _sum(row_EW: torch.Tensor, segments: Segments) -> torch.Tensor:
    if row_EW.device.type == "cpu":  # the faster way there, in the same order
        rows = int(segments.offset_N1[-1])
        sum_NW = row_EW.new_zeros(segments.count, row_EW.shape[1])
        return sum_NW.index_add_(0, segments.segment_E[:rows], row_EW[:rows])
    return torch.segment_reduce(row_EW.contiguous(), "sum", offsets=segments.offset_N1, axis=0, unsafe=True)


class _Sum(torch.autograd.Function):
    @staticmethod
    def forward(context, row_EW, segments):  # type: ignore[no-untyped-def]
        context.segments = segments
        return _sum(row_EW, segments)

    @staticmethod
    def backward(context, gradient_NW):  # type: ignore[no-untyped-def]
        return gradient_NW.index_select(0, context.segments.segment_E), None


class _Spread(torch.autograd.Function):
    @staticmethod
    def forward(context, value_NW, segments):  # type: ignore[no-untyped-def]
        context.segments = segments
        return value_NW.index_select(0, segments.segment_E)

    @staticmethod
    def backward(context, gradient_EW):  # type: ignore[no-untyped-def]
        return _sum(gradient_EW, context.segments), None
