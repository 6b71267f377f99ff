"""Sums over the rows of each segment, and copies of one row to its segment: each is the other's gradient.

The rows of a segment are contiguous, so a sum needs no atomic additions and has a fixed order.
Shape legend: E rows, N segments, W width.
"""

from dataclasses import dataclass

import torch


@dataclass(frozen=True, eq=False)
class Segments:
    """Segment i contains the rows offset_N1[i] to offset_N1[i + 1] - 1."""

    offset_N1: torch.Tensor  # int64 [N + 1], ascending from 0
    segment_E: torch.Tensor  # int64, the segment of each row

    @property
    def count(self) -> int:
        return len(self.offset_N1) - 1

    def sum(self, row_EW: torch.Tensor) -> torch.Tensor:
        """Returns the sum of the rows of each segment, [N, W]; zero for an empty segment."""
        result: torch.Tensor = _Sum.apply(row_EW, self)
        return result

    def spread(self, value_NW: torch.Tensor) -> torch.Tensor:
        """Returns each segment's value for all of its rows, [E, W]."""
        result: torch.Tensor = _Spread.apply(value_NW, self)
        return result


def _sum(row_EW: torch.Tensor, segments: Segments) -> torch.Tensor:
    if row_EW.device.type == "cpu":  # faster on a CPU; sums in the same order
        return row_EW.new_zeros(segments.count, row_EW.shape[1]).index_add_(0, segments.segment_E, row_EW)
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
