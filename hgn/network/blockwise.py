"""A frame of the hierarchical graph network on a CPU: the same function in blocks of rows, each on one core.

What belongs to the same cells is done block by block of cells, from one exchange with other cells to the next: a step
of message passing takes the edges that end there, their sums, the cells' network and the products with the cells that
the next step needs. Pairs of particles and cells are taken in the order of their cells on the way to cells. So blocks
write to different places, and sums have one order whatever the threads.
Norms of pairs commute with their sums as far as gain and shift go, so those are left to the sums.
There are no gradients: nothing is kept for them. hgn.network.network says what is computed, step by step.
Shape legend: N particles, P pairs of particles and cells, C cells, E directed edges, W width.
"""

from __future__ import annotations

import itertools
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import nn

from hgn.network.cores import for_each, single_threaded
from hgn.network.fcn import FCN, MINIMUM_ROWS, linear
from hgn.network.grid import CORNER_83, DIRECTION_63, GridHierarchy, Level

if TYPE_CHECKING:
    from hgn.network.network import HierarchicalGraphNetwork

# Rows of edges or pairs of a block: at width 128 an intermediate result takes a megabyte. Smaller blocks stay in faster
# caches, but each operation costs some microseconds of Python, in which all other threads wait.
ROWS_AT_ONCE = 2048
FEWEST_ROWS = 256  # worth a thread's waking


def propagate(network: HierarchicalGraphNetwork, particle_NW: torch.Tensor, grid: GridHierarchy) -> torch.Tensor:
    """Latent particles and their grids to normalised accelerations [N, 3]: steps 1 to 12, without gradients."""
    # Towards the parent's centre, in fine cells, as in hgn.network.network.
    parent_offset_83 = 0.5 - CORNER_83.to(particle_NW)
    with torch.no_grad(), single_threaded() as threads:
        cells = [_Cells(level, threads) for level in grid.levels]
        cell_CW = _to_cells(network.particle_to_cell, particle_NW, grid, threads)
        kept: list[torch.Tensor] = []
        for i, level in enumerate(cells):
            cell_CW = _passed(network.passing_down[i], cell_CW, level, threads)
            if i + 1 == len(cells):
                break
            parent_C = grid.levels[i].parent_C
            assert parent_C is not None
            kept.append(cell_CW)
            message_CW = _to_parents(_Weights(network.fine_to_coarse[i]), cell_CW, level, parent_offset_83, threads)
            cell_CW = cell_CW.new_zeros(grid.levels[i + 1].cell_count, cell_CW.shape[1])
            cell_CW.index_add_(0, parent_C, message_CW)
        for i in reversed(range(len(kept))):
            cell_CW = _to_children(
                _Weights(network.coarse_to_fine[i]), cell_CW, kept[i], cells[i], -parent_offset_83, threads
            )
            cell_CW = _passed(network.passing_up[i], cell_CW, cells[i], threads)
        return _to_particles(network, particle_NW, cell_CW, grid, threads)


class _Cells:
    """A level in blocks of cells with the edges that end in them."""

    def __init__(self, level: Level, threads: int) -> None:
        count = level.cell_count
        self.blocks = _Blocks(level.receiver_E, count, threads)
        # Rows of a table of all cells as senders, all as receivers, and the directions: what an edge sums of it.
        ends_E3 = torch.stack([level.sender_E, level.receiver_E + count, level.direction_E + 2 * count], -1)
        self.ends = _ends(ends_E3[:, :2], self.blocks.rows), _ends(ends_E3, self.blocks.rows)
        self.edges = self.blocks.split(torch.bincount(level.receiver_E, minlength=count)[:, None])  # of each cell
        self.level = level


def _passed(passing: nn.Module, cell_CW: torch.Tensor, cells: _Cells, threads: int) -> torch.Tensor:
    """Message passing on one level, as MessagePassing.forward."""
    assert isinstance(passing.edge, nn.ModuleList) and isinstance(passing.cell, nn.ModuleList)
    *edge_networks, last = passing.edge
    networks = list(zip([*map(_Weights, edge_networks), _Summed(last)], map(_Weights, passing.cell), strict=True))
    blocks, count = cells.blocks, len(cell_CW)
    result_CW, hidden_CW = cell_CW.clone(), torch.empty_like(cell_CW)
    own, hidden = blocks.split(result_CW), blocks.split(hidden_CW)
    edges: list[torch.Tensor | None] = [None] * len(blocks)
    sums: list[torch.Tensor | None] = [None] * len(blocks)
    # A step reads what the cells of other blocks were before it, and writes what its own are after: tables in turns.
    tables = cell_CW.new_empty(2, 2 * count + len(DIRECTION_63), cell_CW.shape[1])
    tables[1, 2 * count :] = networks[0][0].project(2, -DIRECTION_63.to(cell_CW))
    ends = [(blocks.split(table[:count]), blocks.split(table[count : 2 * count])) for table in tables]

    def project(step: int, block: int) -> None:
        edge, cell = networks[step]
        senders, receivers = ends[(step + 1) % 2]
        edge.project_into(senders[block], 0, own[block])
        edge.project_into(receivers[block], 1, own[block], edge.first_bias)
        cell.project_into(hidden[block], 0, own[block], cell.first_bias)

    def update(step: int, block: int) -> None:
        edge, cell = networks[step]
        rows_EW = _sums_of(tables[(step + 1) % 2], cells.ends[step == 0][block])
        before_EW, before_CW = edges[block], sums[block]
        if before_EW is not None:
            edge.add_projection(rows_EW, 2, before_EW)
        if isinstance(edge, _Summed):  # the last step: nothing but sums is wanted of its edges
            sum_CW = edge.sums(rows_EW, blocks, block, cells.edges[block])
            sum_CW = sum_CW if before_CW is None else sum_CW.add_(before_CW)
        else:
            rows_EW = edge.finish(rows_EW)
            edges[block] = rows_EW = rows_EW if before_EW is None else before_EW.add_(rows_EW)
            sums[block] = sum_CW = blocks.sums(block, rows_EW)
        cell.add_projection(hidden[block], 1, sum_CW)
        own[block].add_(cell.finish(hidden[block]))
        if step + 1 < len(networks):
            project(step + 1, block)

    for_each(partial(project, 0), range(len(blocks)), threads)
    for step in range(len(networks)):
        for_each(partial(update, step), range(len(blocks)), threads)
    return result_CW


class _Weights:
    """An FCN's matrices, taken once a frame: attributes of modules cost as much as a small product."""

    def __init__(self, network: nn.Module) -> None:
        assert isinstance(network, FCN)
        first, second = network.first, network.second
        self.parts = first.weight.T.split(network.parts)
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
        """Overwrites `hidden`."""
        out = _product(nn.functional.leaky_relu_(hidden, self.slope), self.second, self.second_bias)
        if self.norm is None:
            return out
        gain, shift, epsilon = self.norm
        return torch.layer_norm(out, gain.shape, gain, shift, epsilon)


class _Summed(_Weights):
    """Those of a network with a norm of which only weighted sums of rows are wanted.

    Its second layer is less its mean over the outputs: what the norm divides.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__(network)
        assert self.norm is not None
        self.gain, self.shift, self.epsilon = self.norm
        self.second = self.second - self.second.mean(1, keepdim=True)
        self.second_bias = self.second_bias - self.second_bias.mean()

    def centred(self, hidden_RW: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Rows [R, W] and what the norm multiplies each by [R]. Overwrites `hidden_RW`."""
        out_RW = _product(nn.functional.leaky_relu_(hidden_RW, self.slope), self.second, self.second_bias)
        square_R = torch.linalg.vector_norm(out_RW, dim=1).square_()
        return out_RW, square_R.mul_(1 / out_RW.shape[1]).add_(self.epsilon).rsqrt_()

    def sums(
        self,
        hidden_RW: torch.Tensor,
        blocks: _Blocks,
        block: int,
        weights_C1: torch.Tensor,
        weight_R: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Sums of each cell's rows times their weights [cells, W]; `weights_C1` are the weights' sums."""
        out_RW, scale_R = self.centred(hidden_RW)
        scale_R = scale_R if weight_R is None else scale_R.mul_(weight_R)
        return blocks.sums(block, out_RW, scale_R).mul_(self.gain).addcmul_(weights_C1, self.shift)


def _product(value: torch.Tensor, matrix: torch.Tensor, bias: torch.Tensor | None = None) -> torch.Tensor:
    """Rows times a matrix plus bias, each row computed alike however few there are, as hgn.network.fcn.linear."""
    if len(value) < MINIMUM_ROWS:
        return linear(value, matrix.T, bias)
    return torch.mm(value, matrix) if bias is None else torch.addmm(bias, value, matrix)


def _to_parents(
    network: _Weights, cell_CW: torch.Tensor, cells: _Cells, offset_83: torch.Tensor, threads: int
) -> torch.Tensor:
    """What each cell sends to its parent [C, W]."""
    assert cells.level.octant_C is not None
    offset_8W = network.project(1, offset_83, network.first_bias)
    message_CW = torch.empty_like(cell_CW)
    octant, own, message = map(cells.blocks.split, (cells.level.octant_C, cell_CW, message_CW))

    def send(block: int) -> None:
        rows_CW = network.project(0, own[block]).add_(offset_8W.index_select(0, octant[block]))
        message[block].copy_(network.finish(rows_CW))

    for_each(send, range(len(cells.blocks)), threads)
    return message_CW


def _to_children(
    network: _Weights,
    coarse_CW: torch.Tensor,
    kept_CW: torch.Tensor,
    cells: _Cells,
    offset_83: torch.Tensor,
    threads: int,
) -> torch.Tensor:
    """The cells on the way up, from their parents and what they were on the way down."""
    assert cells.level.parent_C is not None and cells.level.octant_C is not None
    parent_CW = network.project(0, coarse_CW)
    table_CW = torch.cat([parent_CW, network.project(2, offset_83, network.first_bias)])
    ends_C2 = torch.stack([cells.level.parent_C, cells.level.octant_C + len(coarse_CW)], -1)
    result_CW = torch.empty_like(kept_CW)
    ends = _ends(ends_C2, cells.blocks.cells)
    kept, result = map(cells.blocks.split, (kept_CW, result_CW))

    def receive(block: int) -> None:
        rows_CW = network.add_projection(_sums_of(table_CW, ends[block]), 1, kept[block])
        torch.add(network.finish(rows_CW), kept[block], out=result[block])

    for_each(receive, range(len(cells.blocks)), threads)
    return result_CW


def _to_cells(module: FCN, particle_NW: torch.Tensor, grid: GridHierarchy, threads: int) -> torch.Tensor:
    """Step 1: the finest cells [C, W]."""
    network = _Summed(module)
    particles, count = len(particle_NW), grid.levels[0].cell_count
    cell_P, pair_P = torch.sort(grid.cell_N8.flatten().int(), stable=True)  # half the time of int64
    blocks = _Blocks(cell_P, count, threads)
    weight_P = grid.weight_N8.flatten()[pair_P]
    ends = _ends(torch.stack([pair_P >> 3, (pair_P & 7) + particles], -1), blocks.rows)
    weight = weight_P.split(blocks.rows)
    # The particles' share of the hidden layer, and the corners'.
    table_NW = particle_NW.new_empty(particles + len(CORNER_83), particle_NW.shape[1])
    table_NW[particles:] = network.project(1, CORNER_83.to(particle_NW), network.first_bias)
    runs = _runs(particles, ROWS_AT_ONCE, threads)
    latent, offset, share = (x.split(runs) for x in (particle_NW, -grid.fraction_N3, table_NW[:particles]))
    sum_CW = particle_NW.new_empty(count, particle_NW.shape[1])
    weights_C1 = particle_NW.new_zeros(count).index_add_(0, cell_P, weight_P)[:, None]
    sums, weights = blocks.split(sum_CW), blocks.split(weights_C1)

    def project(run: int) -> None:
        network.project_into(share[run], 0, latent[run])
        network.add_projection(share[run], 1, offset[run])

    def add(block: int) -> None:
        rows_PW = _sums_of(table_NW, ends[block])
        sums[block].copy_(network.sums(rows_PW, blocks, block, weights[block], weight[block]))

    for_each(project, range(len(runs)), threads)
    for_each(add, range(len(blocks)), threads)
    return sum_CW


def _to_particles(
    network: HierarchicalGraphNetwork,
    particle_NW: torch.Tensor,
    cell_CW: torch.Tensor,
    grid: GridHierarchy,
    threads: int,
) -> torch.Tensor:
    """Steps 11 and 12: normalised accelerations [N, 3]."""
    gather, decode, width = _Summed(network.cell_to_particle), _Weights(network.decode), particle_NW.shape[1]
    cells, particles = len(cell_CW), len(particle_NW)
    # The share of the hidden layer of cells, of corners, and of a run's particles.
    corner_8W = gather.first_bias - gather.project(2, CORNER_83.to(particle_NW))
    shared_CW = torch.cat([gather.project(0, cell_CW), corner_8W])
    runs = _runs(particles, ROWS_AT_ONCE // 8, threads)
    result_N3 = particle_NW.new_empty(particles, 3)
    latent, offset, result = (x.split(runs) for x in (particle_NW, grid.fraction_N3, result_N3))
    corner_N8 = (torch.arange(8) + cells).expand(particles, 8)
    pairs = [8 * length for length in runs]
    ends = _ends(torch.stack([grid.cell_N8, corner_N8], -1).flatten(0, 1), pairs)
    weight = grid.weight_N8.flatten().split(pairs)

    def add(run: int) -> None:
        hidden_NW = gather.add_projection(gather.project(1, latent[run]), 2, offset[run])
        rows_PW = _sums_of(shared_CW, ends[run])
        rows_PW.view(-1, 8, width).add_(hidden_NW[:, None])
        rows_PW, scale_P = gather.centred(rows_PW)
        change_NW = torch.bmm(scale_P.mul_(weight[run]).view(-1, 1, 8), rows_PW.view(-1, 8, width))[:, 0]
        # Weights sum to 1, so the norm's shift is added once.
        after_NW = torch.addcmul(latent[run] + gather.shift, change_NW, gather.gain)
        result[run].copy_(decode.finish(decode.project(0, after_NW, decode.first_bias)))

    for_each(add, range(len(runs)), threads)
    return result_N3


class _Blocks:
    """Runs of cells with about as many rows each; rows are in ascending order of their cells."""

    def __init__(self, cell_R: torch.Tensor, count: int, threads: int) -> None:
        rows = len(cell_R)
        offset_C1 = torch.searchsorted(cell_R, torch.arange(count + 1, dtype=cell_R.dtype))
        wanted = torch.tensor(_runs(rows, ROWS_AT_ONCE, threads)[:-1], dtype=torch.int64).cumsum(0)
        cut = torch.searchsorted(offset_C1, wanted).clamp_(max=count)
        places = [[0, 0], *torch.stack([cut, offset_C1[cut]], -1).tolist(), [count, rows]]
        places = [a for a, b in itertools.pairwise(places) if b[0] > a[0]] + places[-1:]
        self.cells = [b[0] - a[0] for a, b in itertools.pairwise(places)]  # of each block
        self.rows = [b[1] - a[1] for a, b in itertools.pairwise(places)]
        self.offset = [offset_C1[a[0] : b[0]] - a[1] for a, b in itertools.pairwise(places)]
        self.row = [torch.arange(length) for length in self.rows]

    def __len__(self) -> int:
        return len(self.cells)

    def split(self, value_C: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return value_C.split(self.cells)

    def sums(self, block: int, row_RW: torch.Tensor, weight_R: torch.Tensor | None = None) -> torch.Tensor:
        """The sum of each cell's rows, times their weights, in a block [cells, W]."""
        return torch.embedding_bag(row_RW, self.row[block], self.offset[block], per_sample_weights=weight_R)[0]


def _ends(index_RK: torch.Tensor, rows: list[int]) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """What _sums_of takes of each block of rows."""
    each = index_RK.shape[1]
    first_R = torch.arange(0, max(rows) * each, each)
    return [(index.flatten(), first_R[: len(index)]) for index in index_RK.split(rows)]


def _sums_of(table_KW: torch.Tensor, ends: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    """For each row of indices the sum of those rows of the table [R, W], in one pass."""
    return torch.embedding_bag(table_KW, *ends)[0]


def _runs(rows: int, at_once: int, threads: int) -> list[int]:
    """Lengths of nearly equal runs: of about `at_once` rows, as many for each thread, but none of a few rows only."""
    count = -(-rows // (at_once * threads)) * threads
    count = max(1, min(count, rows // min(at_once, FEWEST_ROWS)))
    return [(i + 1) * rows // count - i * rows // count for i in range(count)]
