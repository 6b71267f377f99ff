"""The obstacles that nothing passes, where the kernels find them: hgn.kernels.barriers has a row of a scene.

Shape legend: B buckets, Q cells, E entries of their lists, F triangles, S scenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from hgn.kernels import barriers as barrier_lookup
from hgn.network.barriers import Barriers
from hgn.network.cell_keys import in_buckets, unpack
from hgn.scene.barrier import Barrier

BARRIER_COLUMNS = barrier_lookup.BARRIER_COLUMNS.value


@dataclass(frozen=True, eq=False)
class BarrierHash:
    """One scene's barrier, its cells in hash buckets."""

    bucket_B: torch.Tensor  # int32
    key_Q: torch.Tensor  # int64
    span_Q2: torch.Tensor  # int32: where a cell's list begins and ends
    triangle_E: torch.Tensor  # int32
    row_F24: torch.Tensor  # float32, as in hgn.scene.barrier
    cell_size: float

    @staticmethod
    def of(barrier: Barrier) -> BarrierHash | None:
        """Of a scene's barrier; none where nothing is in it."""
        if not len(barrier.row_F24):
            return None
        parts = (barrier.cell_Q3, barrier.start_Q, barrier.triangle_E, barrier.row_F24)
        cell_Q3, start_Q, triangle_E, row_F24 = map(torch.from_numpy, parts)
        return BarrierHash._of(cell_Q3, start_Q, triangle_E, row_F24, barrier.cell_size)

    @staticmethod
    def _of(
        cell_Q3: torch.Tensor,
        start_Q: torch.Tensor,
        triangle_E: torch.Tensor,
        row_F24: torch.Tensor,
        cell_size: float,
    ) -> BarrierHash:
        bucket_B, key_Q, order_Q = in_buckets(cell_Q3)
        span_Q2 = torch.stack([start_Q[:-1], start_Q[1:]], dim=1)[order_Q].int().contiguous()
        return BarrierHash(bucket_B, key_Q, span_Q2, triangle_E.int(), row_F24.float().contiguous(), cell_size)

    def to(self, device: torch.device) -> BarrierHash:
        bucket_B, key_Q, span_Q2 = self.bucket_B.to(device), self.key_Q.to(device), self.span_Q2.to(device)
        return BarrierHash(
            bucket_B, key_Q, span_Q2, self.triangle_E.to(device), self.row_F24.to(device), self.cell_size
        )

    def row(self) -> list[int]:
        """This scene's row of a barrier table; valid as long as this object lives."""
        pointers = [tensor.data_ptr() for tensor in (self.bucket_B, self.key_Q, self.span_Q2)]
        lists = [tensor.data_ptr() for tensor in (self.triangle_E, self.row_F24)]
        return [*pointers, len(self.bucket_B) - 2, *lists, int(np.float32(self.cell_size).view(np.int32))]


class BarrierTable:
    """The barriers of the scenes of a batch, for the kernels; its rows may be rewritten on the device."""

    def __init__(self, hashes: Sequence[BarrierHash | None], device: torch.device) -> None:
        self._hashes = [entry.to(device) if entry is not None else None for entry in hashes]
        rows = [entry.row() if entry is not None else [0] * BARRIER_COLUMNS for entry in self._hashes]
        self.row_S7 = torch.tensor(rows, dtype=torch.int64, device=device)
        self._barriers: Barriers | None = None  # that it was made of, unless of hashes

    def is_of(self, barriers: Barriers | None) -> bool:
        """Whether it was made of this very object; never of none, for which a table takes no time."""
        return barriers is not None and self._barriers is barriers

    def take(self, other: BarrierTable) -> None:
        """Makes its rows those of another table, in place."""
        self.row_S7.copy_(other.row_S7)
        self._hashes, self._barriers = other._hashes, other._barriers

    @staticmethod
    def of(barriers: Barriers | None, scenes: int, device: torch.device) -> BarrierTable:
        """Of a batch's barriers, on their device; without any, of scenes that have none."""
        if barriers is None:
            return BarrierTable([None] * scenes, device)
        scene_Q, cell_Q3 = unpack(barriers.key_Q)
        cells = torch.bincount(scene_Q, minlength=scenes).tolist()
        triangles = torch.bincount(barriers.scene_F, minlength=scenes).tolist()
        first_cell, first_triangle = np.cumsum([0, *cells]).tolist(), np.cumsum([0, *triangles]).tolist()
        first_entry = barriers.start_Q[first_cell].tolist()
        hashes: list[BarrierHash | None] = []
        for scene in range(scenes):
            (q, q_end), (e, e_end), (f, f_end) = (
                first[scene : scene + 2] for first in (first_cell, first_entry, first_triangle)
            )
            start_Q, triangle_E = barriers.start_Q[q : q_end + 1] - e, barriers.triangle_E[e:e_end] - f
            parts = cell_Q3[q:q_end], start_Q, triangle_E, barriers.row_F24[f:f_end], barriers.cell_size
            hashes.append(BarrierHash._of(*parts) if triangles[scene] else None)
        table = BarrierTable(hashes, barriers.key_Q.device)
        table._barriers = barriers
        return table
