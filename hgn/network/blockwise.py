"""A frame of the hierarchical graph network on a CPU: the same function in blocks of rows, one on each core.

What belongs to the same cells is done block by block of cells, from one exchange with other cells to the next: a step
of message passing takes the edges that end there, their sum, the cells' network and the products with the cells that
the next step needs. Pairs of particles and cells are taken in the order of their cells. So sums of blocks never meet,
their order does not depend on threads, and intermediate results stay in a core's cache.
Needs no gradients: nothing is kept for them. hgn.network.network says what is computed, step by step.
Shape legend: N particles, P pairs of particles and cells, C cells, E directed edges, W width.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch

from hgn.network.cores import for_each, single_threaded
from hgn.network.fcn import FCN
from hgn.network.grid import CORNER_83, DIRECTION_63, GridHierarchy, Level

if TYPE_CHECKING:
    from hgn.network.network import HierarchicalGraphNetwork, MessagePassing

# Rows of edges or pairs of a block: at width 128 an intermediate result takes a quarter of a megabyte.
ROWS_AT_ONCE = 512


class Block(NamedTuple):
    """Consecutive cells (or particles), and the rows that belong to them (edges that end there, or pairs)."""

    cells: slice
    rows: slice


def blocks_of(offset_C1: torch.Tensor, threads: int) -> list[Block]:
    """Cells in blocks of about ROWS_AT_ONCE rows, as many for each thread. Cell c has rows offset_C1[c] to the next."""
    cells, rows = len(offset_C1) - 1, int(offset_C1[-1])
    count = -(-rows // ROWS_AT_ONCE)
    count = max(1, count if count <= 1 else -(-count // threads) * threads)
    wanted = torch.arange(1, count) * rows // count
    cut = torch.searchsorted(offset_C1, wanted).clamp_(max=cells)
    places = [(0, 0), *torch.stack([cut, offset_C1[cut]], dim=-1).tolist(), (cells, rows)]
    return [Block(slice(c, d), slice(p, q)) for (c, p), (d, q) in itertools.pairwise(places) if d > c]


class Ends(NamedTuple):
    """What a step of message passing needs of the cells as they are before it, each with its bias [C, W]."""

    sender_CW: torch.Tensor
    receiver_CW: torch.Tensor
    cell_CW: torch.Tensor


def _fcn(module: torch.nn.Module) -> FCN:
    assert isinstance(module, FCN)
    return module


def _offsets(index_R: torch.Tensor, count: int) -> torch.Tensor:
    """Where the rows of each index begin, and their number, [count + 1]; they are in ascending order."""
    return torch.searchsorted(index_R, torch.arange(count + 1))


class Blockwise:
    """One frame's work."""

    def __init__(self, network: HierarchicalGraphNetwork, threads: int) -> None:
        self.network = network
        self.threads = threads

    def propagate(self, particle_NW: torch.Tensor, grid: GridHierarchy) -> torch.Tensor:
        """Latent particles and their grids to normalised accelerations [N, 3]: steps 1 to 12."""
        network, levels = self.network, grid.levels
        parent_offset_83 = 0.5 - CORNER_83.to(particle_NW)
        blocks = [blocks_of(_offsets(level.receiver_E, level.cell_count), self.threads) for level in levels]
        cell_CW = self.to_cells(particle_NW, grid)
        kept: list[torch.Tensor] = []
        for i, level in enumerate(levels):
            cell_CW = self.passed(network.passing_down[i], cell_CW, level, blocks[i])
            if level.parent_C is None or level.octant_C is None:
                break
            kept.append(cell_CW)
            cell_CW = self.coarser(_fcn(network.fine_to_coarse[i]), cell_CW, parent_offset_83, level, blocks[i], levels[i + 1].cell_count)
        for i in reversed(range(len(kept))):
            cell_CW = self.finer(_fcn(network.coarse_to_fine[i]), cell_CW, kept[i], -parent_offset_83, levels[i], blocks[i])
            cell_CW = self.passed(network.passing_up[i], cell_CW, levels[i], blocks[i])
        return self.to_particles(particle_NW, cell_CW, grid)

    def to_cells(self, particle_NW: torch.Tensor, grid: GridHierarchy) -> torch.Tensor:
        network, cells = self.network.particle_to_cell, grid.levels[0].cell_count
        corner_8W = network.project(1, CORNER_83.to(particle_NW)) + network.first.bias
        cell_P, pair_P = torch.sort(grid.cell_N8.flatten(), stable=True)
        particle_P, corner_P = pair_P >> 3, pair_P & 7
        weight_P1 = grid.weight_N8.flatten()[pair_P][:, None]
        projected_NW = torch.empty_like(particle_NW)
        sum_CW = torch.zeros(cells, particle_NW.shape[1], dtype=particle_NW.dtype)

        def project(rows: slice) -> None:
            hidden_NW = network.project(0, particle_NW[rows])
            projected_NW[rows] = network.add_projection(hidden_NW, 1, -grid.fraction_N3[rows])

        def add(block: Block) -> None:
            rows = block.rows
            hidden_PW = projected_NW.index_select(0, particle_P[rows]).add_(corner_8W.index_select(0, corner_P[rows]))
            message_PW = network.finish(hidden_PW).mul_(weight_P1[rows])
            sum_CW[block.cells].index_add_(0, cell_P[rows] - block.cells.start, message_PW)

        for_each(project, _runs(len(particle_NW), self.threads), self.threads)
        for_each(add, blocks_of(_offsets(cell_P, cells), self.threads), self.threads)
        return sum_CW

    def passed(
        self, passing: torch.nn.Module, cell_CW: torch.Tensor, level: Level, blocks: list[Block]
    ) -> torch.Tensor:
        edge_networks, cell_networks = [[_fcn(n) for n in p] for p in (passing.edge, passing.cell)]
        offset_6W = edge_networks[0].project(2, -DIRECTION_63.to(cell_CW))
        cell_CW = cell_CW.clone()
        edge_EW = cell_CW.new_empty(len(level.sender_E), cell_CW.shape[1])
        ends = Ends(*(torch.empty_like(cell_CW) for _ in range(3)))
        old = ends

        def project(m: int, cells: slice, own_CW: torch.Tensor, ends: Ends) -> None:
            edge, cell = edge_networks[m], cell_networks[m]
            ends.sender_CW[cells] = edge.project(0, own_CW)
            torch.add(edge.project(1, own_CW), edge.first.bias, out=ends.receiver_CW[cells])
            torch.add(cell.project(0, own_CW), cell.first.bias, out=ends.cell_CW[cells])

        for_each(lambda block: project(0, block.cells, cell_CW[block.cells], ends), blocks, self.threads)
        for m in range(len(edge_networks)):
            old, ends = ends, Ends(*(torch.empty_like(cell_CW) for _ in range(3)))

            def step(block: Block, m=m, old=old, ends=ends) -> None:
                cells, rows = block
                edge, cell = edge_networks[m], cell_networks[m]
                sum_CW = cell_CW.new_zeros(cells.stop - cells.start, cell_CW.shape[1])
                if rows.stop > rows.start:
                    receiver_E = level.receiver_E[rows]
                    hidden_EW = old.sender_CW.index_select(0, level.sender_E[rows])
                    hidden_EW += old.receiver_CW.index_select(0, receiver_E)
                    if m == 0:
                        hidden_EW += offset_6W.index_select(0, level.direction_E[rows])
                        edge_EW[rows] = edge.finish(hidden_EW)
                    else:
                        edge.add_projection(hidden_EW, 2, edge_EW[rows])
                        edge_EW[rows] += edge.finish(hidden_EW)
                    sum_CW.index_add_(0, receiver_E - cells.start, edge_EW[rows])
                hidden_CW = old.cell_CW[cells]
                cell.add_projection(hidden_CW, 1, sum_CW)
                own_CW = cell_CW[cells]
                own_CW += cell.finish(hidden_CW)
                if m + 1 < len(edge_networks):
                    project(m + 1, cells, own_CW, ends)

            for_each(step, blocks, self.threads)
        return cell_CW

    def coarser(self, network, cell_CW, offset_83, level, blocks, count):
        offset_8W = network.project(1, offset_83) + network.first.bias
        message_CW = torch.empty_like(cell_CW)

        def message(block: Block) -> None:
            hidden_CW = network.project(0, cell_CW[block.cells])
            hidden_CW += offset_8W.index_select(0, level.octant_C[block.cells])
            message_CW[block.cells] = network.finish(hidden_CW)

        for_each(message, blocks, self.threads)
        return cell_CW.new_zeros(count, cell_CW.shape[1]).index_add_(0, level.parent_C, message_CW)

    def finer(self, network, coarse_CW, kept_CW, offset_83, level, blocks):
        offset_8W = network.project(2, offset_83) + network.first.bias
        parent_CW = network.project(0, coarse_CW)
        cell_CW = torch.empty_like(kept_CW)

        def begin(block: Block) -> None:
            cells = block.cells
            hidden_CW = parent_CW.index_select(0, level.parent_C[cells])
            network.add_projection(hidden_CW, 1, kept_CW[cells])
            hidden_CW += offset_8W.index_select(0, level.octant_C[cells])
            torch.add(network.finish(hidden_CW), kept_CW[cells], out=cell_CW[cells])

        for_each(begin, blocks, self.threads)
        return cell_CW

    def to_particles(self, particle_NW: torch.Tensor, cell_CW: torch.Tensor, grid: GridHierarchy) -> torch.Tensor:
        network, decode = self.network.cell_to_particle, self.network.decode
        cell_CW = network.project(0, cell_CW)
        corner_8W = network.project(2, CORNER_83.to(particle_NW)) - network.first.bias
        result_N3 = particle_NW.new_empty(len(particle_NW), 3)

        def add(rows: slice) -> None:
            hidden_NW = network.project(1, particle_NW[rows])
            network.add_projection(hidden_NW, 2, grid.fraction_N3[rows])
            hidden_N8W = cell_CW.index_select(0, grid.cell_N8[rows].flatten()).unflatten(0, (-1, 8))
            hidden_N8W += hidden_NW[:, None]
            hidden_N8W -= corner_8W
            change_NW = network.finish(hidden_N8W).mul_(grid.weight_N8[rows, :, None]).sum(1)
            result_N3[rows] = decode(change_NW.add_(particle_NW[rows]))

        for_each(add, _runs(8 * len(particle_NW), self.threads, 8), self.threads)
        return result_N3


def _runs(rows: int, threads: int, each: int = 1) -> list[slice]:
    """Nearly equal runs of rows, `each` together"""
    total = rows // each
    count = -(-rows // ROWS_AT_ONCE)
    count = max(1, count if count <= 1 else -(-count // threads) * threads)
    return [slice(i * total // count, (i + 1) * total // count) for i in range(count)]


def propagate(network: HierarchicalGraphNetwork, particle_NW: torch.Tensor, grid: GridHierarchy) -> torch.Tensor:
    with single_threaded() as threads:
        return Blockwise(network, threads).propagate(particle_NW, grid)
