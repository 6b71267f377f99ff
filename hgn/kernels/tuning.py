"""The rows and warps of the kernels' programs, and how many programs an H100 runs at the same time.

They change speed, never results.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import triton

PROCESSORS = 132  # an H100's
RESIDENT_PROGRAMS = 2 * PROCESSORS
FEW_ROWS = 64 * PROCESSORS
LIGHT_BLOCK = (64, 4)  # rows and warps of a program that keeps two weights, of which two fit on a processor


def many(rows: int) -> bool:
    """Returns whether this number of rows keeps all processors busy with large tiles."""
    return rows >= FEW_ROWS


@dataclass(frozen=True)
class Tuning:
    """Rows and warps of a program."""

    cell_block: int  # cells of a tile of edges, eight rows each
    cell_warps: int
    few_cell_block: int  # the same on a level of few cells
    few_cell_warps: int
    row_block: int
    row_warps: int
    row_backward_warps: int
    pair_particles: int  # eight rows each, at most 13
    pair_warps: int
    few_cells: int = 0  # up to which a level's cells are few
    small_block: int = 16  # where there are few rows
    small_warps: int = 8
    dense: bool = False  # six rows a cell in the tiles of edges, not eight
    overlap: bool = False  # kernels of a message step read their weights before their turn
    loops: bool = False  # where there are many rows, a program keeps all weights and takes one block after the other
    gather_block: int = (
        0  # of a kernel for the sums of many rows' neighbours; 0: the kernel that reads them computes them
    )
    cell_backward_block: int = 0  # where there are many rows; 0: as of other rows
    cell_backward_warps: int = 8
    half_cells: bool = False  # cells too are rounded between kernels, as edges are
    # And particles are added to them rounded, half the traffic of the L2 cache: in training only the pairs' gradients.
    half_sums: bool = False
    light_programs: int = 2  # on a processor, of kernels with one weight: pairs forward, edges of a first iteration
    light_registers: int | None = None  # of a thread, so that these programs fit
    weight_registers: int | None = None  # of a thread of the weights' products: 128 for two programs on a processor

    @staticmethod
    def of(precision: str) -> Tuning:
        """Returns the fastest choices on an H100 at width 128."""
        if precision == "fp32":
            return Tuning(8, 4, 8, 4, 16, 4, 4, 2, 4, 1056, dense=True, loops=True, gather_block=16)
        if precision == "tf32":  # operands of twice the size
            return Tuning(8, 8, 4, 8, 64, 8, 8, 8, 8, 528)
        half = Tuning(8, 4, 2, 4, 128, 8, 8, 8, 4, 1056, dense=True, overlap=True, loops=True)
        return replace(
            half,
            light_programs=3,
            light_registers=168,
            gather_block=16,
            cell_backward_block=64,
            cell_backward_warps=4,
            weight_registers=128,
            half_cells=True,
            half_sums=True,
        )

    def row_tile(self, rows: int, backward: bool = False) -> tuple[int, int]:
        """Returns rows and warps of a program, for this number of rows in all."""
        if not many(rows):
            return self.small_block, self.small_warps
        return self.row_block, self.row_backward_warps if backward else self.row_warps

    def edge_tile(self, cells: int) -> tuple[int, int]:
        """Returns cells and warps of a tile of edges; tiles are small where there are few."""
        few = cells <= self.few_cells
        return (self.few_cell_block, self.few_cell_warps) if few else (self.cell_block, self.cell_warps)

    def edge_cells(self, block: int) -> int:
        """Returns the cells of a tile of edges that has rows for `block` cells of eight rows each."""
        return 8 * block // 6 if self.dense else block

    def gathers(self, rows: int) -> bool:
        """Returns whether sums over the neighbours of this number of rows have a kernel of their own."""
        return self.gather_block > 0 and many(rows)

    def loops_over(self, rows: int, block: int, least: int = 1) -> bool:
        """Returns whether a program keeps all its weights and takes several blocks, at least `least`."""
        return self.loops and many(rows) and rows >= (least - 1) * PROCESSORS * block

    def row_programs(self, rows: int, block: int, loops: bool, at_once: int = 1) -> tuple[int]:
        """Returns the number of programs; `at_once` programs that keep their weights fill a processor."""
        programs = triton.cdiv(rows, block)
        return (min(programs, PROCESSORS * at_once) if loops else programs,)

    def programs(self, rows: int, block: int, at_once: int = 2) -> tuple[int]:
        """Returns the number of programs that take one block after the other; `at_once` run on a processor."""
        return (min(triton.cdiv(rows, block), RESIDENT_PROGRAMS * at_once // 2),)
