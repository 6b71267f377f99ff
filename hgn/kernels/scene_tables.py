"""Holds obstacles of a batch's scenes on the device: cells in hash buckets, and a table with a row for each scene.

Shape legend: K cells of a scene or of all, B hash buckets, E entries of the cells' lists, F triangles, S scenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from hgn.kernels import obstacles
from hgn.network.barriers import Barriers
from hgn.network.cell_keys import in_buckets, unpack
from hgn.network.obstacles import ObstacleCells
from hgn.scene.barrier import Barrier
from hgn.scene.obstacle_grid import ObstacleGrid

OBSTACLE_COLUMNS, BARRIER_COLUMNS = obstacles.OBSTACLE_COLUMNS.value, obstacles.BARRIER_COLUMNS.value


@dataclass(frozen=True, eq=False)
class SceneHash:
    """Holds the obstacle or barrier cells of one scene. Bucket b has the entries bucket_B[b] to bucket_B[b + 1]."""

    bucket_B: torch.Tensor  # int32
    key_K: torch.Tensor  # int64
    # An obstacle cell has its normal, then friction and distance where the network has them, float32 [K, 3 to 5]. A
    # barrier cell has the range of its list of triangles, int32.
    value_K: torch.Tensor
    lists: tuple[torch.Tensor, ...] = ()  # a barrier's lists, int32 [E], and triangles, float32 [F, 24]
    last: int = 0  # last column of the row: bits of a barrier's cell size, or the obstacles' symmetry, set later

    @staticmethod
    def of_obstacles(cell_K3: torch.Tensor, value_KV: torch.Tensor) -> SceneHash:
        """Returns the hash of cells int [K, 3] with rows [K, 3 to 5] as of ObstacleCells.rows, on their device."""
        bucket_B, key_K, order_K = in_buckets(cell_K3)
        return SceneHash(bucket_B, key_K, value_KV[order_K].float().contiguous())

    @staticmethod
    def of_grid(grid: ObstacleGrid, friction: bool = False) -> SceneHash | None:
        """Returns the hash of a scene's obstacle cells, or None without cells. With `friction` cells have theirs."""
        values = [grid.normal_K3]
        if friction:
            values.append(np.zeros((len(grid.cell_K3), 1)) if grid.friction_K is None else grid.friction_K[:, None])
        if grid.distance_K is not None:
            values.append(grid.distance_K[:, None])
        tensors = torch.from_numpy(grid.cell_K3), torch.from_numpy(np.concatenate(values, axis=1))
        return SceneHash.of_obstacles(*tensors) if len(grid.cell_K3) else None

    @staticmethod
    def of_barrier(barrier: Barrier) -> SceneHash | None:
        """Returns the hash of a scene's barrier, or None without triangles."""
        if not len(barrier.row_F24):
            return None
        lists = (barrier.cell_Q3, barrier.start_Q, barrier.triangle_E, barrier.row_F24)
        return SceneHash._of_lists([torch.from_numpy(part) for part in lists], barrier.cell_size)

    @staticmethod
    def _of_lists(lists: Sequence[torch.Tensor], cell_size: float) -> SceneHash:
        cell_K3, start_K, triangle_E, row_F24 = lists
        bucket_B, key_K, order_K = in_buckets(cell_K3)
        range_K2 = torch.stack([start_K[:-1], start_K[1:]], dim=1)[order_K].int().contiguous()
        triangles = (triangle_E.int(), row_F24.float().contiguous())
        return SceneHash(bucket_B, key_K, range_K2, triangles, int(np.float32(cell_size).view(np.int32)))

    def to(self, device: torch.device) -> SceneHash:
        bucket_B, key_K, value_K, *lists = (
            tensor.to(device) for tensor in (self.bucket_B, self.key_K, self.value_K, *self.lists)
        )
        return SceneHash(bucket_B, key_K, value_K, tuple(lists), self.last)

    def row(self) -> list[int]:
        """Returns the scene's row of a table: addresses, mask of the buckets, addresses of lists, last column.
        The row is valid while this object lives."""
        cells, lists = [self.bucket_B, self.key_K, self.value_K], self.lists
        mask = len(self.bucket_B) - 2
        return [*(part.data_ptr() for part in cells), mask, *(part.data_ptr() for part in lists), self.last]


class SceneTable:
    """Holds a row for each scene of a batch, int64 [S, columns], for the kernels. A scene without cells has zeros.

    A kernel may rewrite the rows on the device.
    """

    def __init__(
        self, hashes: Sequence[SceneHash | None], columns: int, device: torch.device, cell_size: float = 0.0
    ) -> None:
        """Takes the edge length `cell_size` of obstacle cells."""
        self._hashes = [entry and entry.to(device) for entry in hashes]
        rows = [entry.row() if entry is not None else [0] * columns for entry in self._hashes]
        self.row_SC = torch.tensor(rows, dtype=torch.int64, device=device)
        self.cell_size = cell_size
        self._source: ObstacleCells | Barriers | None = None  # the object of which the table was made

    @staticmethod
    def of_obstacles(cells: ObstacleCells, scenes: int, friction: bool = False) -> SceneTable:
        """Returns the table of a batch's obstacle cells, on their device. With `friction` cells have theirs."""
        scene_K, cell_K3 = unpack(cells.key_K)
        counts = torch.bincount(scene_K, minlength=scenes).tolist()
        parts = zip(cell_K3.split(counts), cells.rows(friction).split(counts), strict=True)
        hashes = [SceneHash.of_obstacles(cell, value) if len(cell) else None for cell, value in parts]
        table = SceneTable(hashes, OBSTACLE_COLUMNS, cells.key_K.device, cells.cell_size)
        table._source = cells
        return table

    @staticmethod
    def of_barriers(barriers: Barriers | None, scenes: int, device: torch.device) -> SceneTable:
        """Returns the table of a batch's barriers, on their device. With None the scenes have no barriers."""
        if barriers is None:
            return SceneTable([None] * scenes, BARRIER_COLUMNS, device)
        scene_K, cell_K3 = unpack(barriers.key_Q)
        cells = torch.bincount(scene_K, minlength=scenes).tolist()
        triangles = torch.bincount(barriers.scene_F, minlength=scenes).tolist()
        first_cell, first_triangle = np.cumsum([0, *cells]).tolist(), np.cumsum([0, *triangles]).tolist()
        first_entry = barriers.start_Q[first_cell].tolist()
        hashes: list[SceneHash | None] = []
        for scene in range(scenes):
            (k, k_end), (e, e_end), (f, f_end) = (
                first[scene : scene + 2] for first in (first_cell, first_entry, first_triangle)
            )
            start_K, triangle_E = barriers.start_Q[k : k_end + 1] - e, barriers.triangle_E[e:e_end] - f
            lists = cell_K3[k:k_end], start_K, triangle_E, barriers.row_F24[f:f_end]
            hashes.append(SceneHash._of_lists(lists, barriers.cell_size) if triangles[scene] else None)
        table = SceneTable(hashes, BARRIER_COLUMNS, barriers.key_Q.device)
        table._source = barriers
        return table

    def is_of(self, source: ObstacleCells | Barriers | None) -> bool:
        """Returns whether the table was made of this same object, or False for None, whose table is cheap to make."""
        return source is not None and self._source is source

    def take(self, other: SceneTable) -> None:
        """Copies the rows of another table into its own rows."""
        self.row_SC.copy_(other.row_SC)
        self._hashes, self._source = other._hashes, other._source
