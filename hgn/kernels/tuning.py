"""Chooses the rows and warps of the kernels' programs, and the number of programs that run at once on an H100.

The choices change speed, never results.
"""

from dataclasses import dataclass, replace

import triton

PROCESSORS = 132  # number of processors of an H100
RESIDENT_PROGRAMS = 2 * PROCESSORS
FEW_ROWS = 64 * PROCESSORS
LIGHT_BLOCK = (64, 4)  # rows and warps of a program that keeps two weights; two such programs fit on a processor


def many(rows: int) -> bool:
    """Returns whether this number of rows keeps all processors busy with large tiles."""
    return rows >= FEW_ROWS


@dataclass(frozen=True)
class Tuning:
    """Holds rows, warps and other choices of the programs."""

    cell_block: int  # cells of a tile of edges, with eight rows each
    cell_warps: int
    few_cell_block: int  # as cell_block, on a level with few cells
    few_cell_warps: int
    row_block: int
    row_warps: int
    row_backward_warps: int
    pair_particles: int  # particles of a tile, with eight rows each; at most 13
    pair_warps: int
    few_cells: int = 0  # a level with up to this number of cells has few cells
    small_block: int = 16  # rows of a tile if there are few rows
    small_warps: int = 8
    dense: bool = False  # tiles of edges have six rows a cell instead of eight
    overlap: bool = False  # kernels of a message step read their weights before the previous kernel ends
    loops: bool = False  # with many rows a program keeps all its weights and computes many blocks in turn
    gather_block: int = 0  # rows of a kernel that sums neighbours of many rows; 0: no such kernel
    cell_backward_block: int = 0  # rows of a backward tile with many rows; 0: as for few rows
    cell_backward_warps: int = 8
    half_cells: bool = False  # cells are rounded between kernels, as edges always are
    # Sums of particles in cells are rounded, which halves L2 traffic; in training only the pairs' gradients are.
    half_sums: bool = False
    light_programs: int = 2  # programs on a processor of kernels with one weight: pairs forward, first edges
    light_registers: int | None = None  # largest number of registers per thread with which these programs fit
    weight_registers: int | None = None  # largest number per thread in weight gradients; with 128 two programs fit

    @staticmethod
    def of(precision: str) -> "Tuning":
        """Returns the fastest choices on an H100 at width 128."""
        if precision == "fp32":
            return Tuning(8, 4, 8, 4, 16, 4, 4, 2, 4, 1056, dense=True, loops=True, gather_block=16)
        if precision == "tf32":  # operands have twice the size
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
        """Returns the rows and warps of a program for this total number of rows."""
        if not many(rows):
            return self.small_block, self.small_warps
        return self.row_block, self.row_backward_warps if backward else self.row_warps

    def edge_tile(self, cells: int) -> tuple[int, int]:
        """Returns the cells and warps of a tile of edges. Levels with few cells have small tiles."""
        few = cells <= self.few_cells
        return (self.few_cell_block, self.few_cell_warps) if few else (self.cell_block, self.cell_warps)

    def edge_cells(self, block: int) -> int:
        """Returns the number of cells in a tile of edges with rows for `block` cells of eight rows."""
        return 8 * block // 6 if self.dense else block

    def gathers(self, rows: int) -> bool:
        """Returns whether a separate kernel sums the neighbours of this number of rows."""
        return self.gather_block > 0 and many(rows)

    def loops_over(self, rows: int, block: int, least: int = 1) -> bool:
        """Returns whether a program keeps all its weights and takes at least `least` blocks in turn."""
        return self.loops and many(rows) and rows >= (least - 1) * PROCESSORS * block

    def row_programs(self, rows: int, block: int, loops: bool, at_once: int = 1) -> tuple[int]:
        """Returns the number of programs. `at_once` programs that keep their weights fill a processor."""
        programs = triton.cdiv(rows, block)
        return (min(programs, PROCESSORS * at_once) if loops else programs,)

    def programs(self, rows: int, block: int, at_once: int = 2) -> tuple[int]:
        """Returns the number of programs that take blocks in turn, of which `at_once` run on a processor."""
        return (min(triton.cdiv(rows, block), RESIDENT_PROGRAMS * at_once // 2),)
