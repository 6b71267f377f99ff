"""Computes the forward pass of the hierarchical graph network on a CPU, in blocks of rows, without gradients.

hgn.network.hgn is the reference. Each core computes whole blocks. A block of a level is a run of cells with the edges
that end in them. A message passing step computes its edges, their sums, the cell network and the products for the next
step. Pairs of particles and cells are sorted by cell. Blocks therefore write to disjoint rows, and the order of sums
does not depend on the number of threads. With a compiler, C code computes rows in one pass (hgn.cpu.compiled).
Shape legend: N particles, P pairs of particles and cells, C cells, E directed edges, W width.
"""

import itertools
from collections.abc import Callable
from functools import partial

import torch
from torch import nn

from hgn.cpu.block_threads import for_each, single_threaded
from hgn.cpu.compiled import rows_class
from hgn.cpu.rows import Hidden, Rows, Segments
from hgn.network.base import Prediction
from hgn.network.features import ParticleState
from hgn.network.grid import CORNER_83, DIRECTION_63, GridHierarchy, Level
from hgn.network.hgn import HierarchicalGraphNetwork

# The number of rows of edges or pairs in a block. At width 128 an intermediate result of a block takes 2 MB. Smaller
# blocks would fit into faster caches, but each operation takes some microseconds of Python, during which all other
# threads wait, and compiled rows transpose their matrices for each block.
ROWS_AT_ONCE = 4096
FEWEST_ROWS = 256  # smallest number of rows in a block; for fewer, waking a thread takes longer than the work


def prediction(
    network: HierarchicalGraphNetwork, state: ParticleState, origin_S3: torch.Tensor | None = None
) -> Prediction:
    """Returns the result of the network's own `prediction`, without gradients."""
    with torch.no_grad():
        return network.predicted(state, origin_S3, partial(propagate, network))


def propagate(network: HierarchicalGraphNetwork, particle_NW: torch.Tensor, grid: GridHierarchy) -> torch.Tensor:
    """Returns the decoder's output [N, 3 or 9] for latent particles: steps 1 to 12 of the paper."""
    # The offset is from a cell to its parent's centre, in fine cells, as in hgn.network.hgn.
    parent_offset_83 = 0.5 - CORNER_83.to(particle_NW)
    rows_of = rows_class(network.config.width, particle_NW.dtype)
    with torch.no_grad(), single_threaded() as threads:
        cells = [_Cells(level, threads) for level in grid.levels]
        cell_CW = _to_cells(rows_of(network.particle_to_cell), particle_NW, grid, threads)
        cells_down: list[torch.Tensor] = []
        for i, level in enumerate(cells):
            cell_CW = _passed(rows_of, network.passing_down[i], cell_CW, level, threads)
            if i + 1 == len(cells):
                break
            parent_C = grid.levels[i].parent_C
            assert parent_C is not None
            cells_down.append(cell_CW)
            message_CW = _to_parents(rows_of(network.fine_to_coarse[i]), cell_CW, level, parent_offset_83, threads)
            cell_CW = cell_CW.new_zeros(grid.levels[i + 1].cell_count, cell_CW.shape[1])
            cell_CW.index_add_(0, parent_C, message_CW)
        for i in reversed(range(len(cells_down))):
            rows = rows_of(network.coarse_to_fine[i])
            cell_CW = _to_children(rows, cell_CW, cells_down[i], cells[i], -parent_offset_83, threads)
            cell_CW = _passed(rows_of, network.passing_up[i], cell_CW, cells[i], threads)
        rows, decode = rows_of(network.cell_to_particle), rows_of(network.decode)
        return _to_particles(rows, decode, particle_NW, cell_CW, grid, threads)


class _Cells:
    """Holds a level in blocks of cells, each with the edges that end in them."""

    def __init__(self, level: Level, threads: int) -> None:
        count = level.cell_count
        self.blocks = _Blocks(level.receiver_E, count, threads)
        # An edge is a sum of table rows: of its sender, its receiver, and in the first step its direction.
        ends_E3 = torch.stack([level.sender_E, level.receiver_E + count, level.direction_E + 2 * count], -1)
        self.ends_of_first, self.ends_of_others = self.blocks.indices(ends_E3), self.blocks.indices(ends_E3[:, :2])
        self.segments = self.blocks.segments()
        self.level = level


def _passed(
    rows_of: Callable[[nn.Module], Rows], passing: nn.Module, cell_CW: torch.Tensor, cells: _Cells, threads: int
) -> torch.Tensor:
    """Returns the cells after the message passing of one level; the reference is MessagePassing.forward."""
    assert isinstance(passing.edge, nn.ModuleList) and isinstance(passing.cell, nn.ModuleList)
    networks = list(zip(map(rows_of, passing.edge), map(rows_of, passing.cell), strict=True))
    blocks, count = cells.blocks, len(cell_CW)
    result_CW, hidden_CW, sum_CW = cell_CW.clone(), torch.empty_like(cell_CW), torch.zeros_like(cell_CW)
    own, hidden, sums = map(blocks.split, (result_CW, hidden_CW, sum_CW))
    edges: list[torch.Tensor | None] = [None] * len(blocks)
    # A step reads the values that other blocks' cells had before the step. Steps therefore use two tables in turn.
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
        ends_E, each = (cells.ends_of_others, 2) if step else (cells.ends_of_first, 3)
        seen = Hidden(tables[(step + 1) % 2], ends_E[block], each, 2, edges[block])
        # Each step adds its messages to the sums and to the edges. The edges of the last step are not needed.
        if step + 1 == len(networks):
            edge.add_sums(sums[block], seen, cells.segments[block])
        else:
            edges[block] = edge.output_and_add_sums(sums[block], seen, cells.segments[block], edges[block])
        cell.output(own[block], Hidden(hidden[block], None, 1, 1, sums[block]), own[block])
        if step + 1 < len(networks):
            project(step + 1, block)

    for_each(partial(project, 0), range(len(blocks)), threads)
    for step in range(len(networks)):
        for_each(partial(update, step), range(len(blocks)), threads)
    return result_CW


def _to_parents(
    rows: Rows, cell_CW: torch.Tensor, cells: _Cells, offset_83: torch.Tensor, threads: int
) -> torch.Tensor:
    """Returns the message of each cell to its parent [C, W]."""
    assert cells.level.octant_C is not None
    offset_8W = rows.project(1, offset_83, rows.first_bias)
    message_CW = torch.empty_like(cell_CW)
    octant, own, message = map(cells.blocks.split, (cells.level.octant_C, cell_CW, message_CW))

    def send(block: int) -> None:
        rows.output(message[block], Hidden(offset_8W, octant[block], 1, 0, own[block]))

    for_each(send, range(len(cells.blocks)), threads)
    return message_CW


def _to_children(
    rows: Rows, coarse_CW: torch.Tensor, down_CW: torch.Tensor, cells: _Cells, offset_83: torch.Tensor, threads: int
) -> torch.Tensor:
    """Returns the cells on the way up from their parents' features and their own features on the way down."""
    assert cells.level.parent_C is not None and cells.level.octant_C is not None
    count = len(coarse_CW)
    table_CW = coarse_CW.new_empty(count + len(offset_83), coarse_CW.shape[1])
    _project(rows, table_CW[:count], threads, (0, coarse_CW))
    rows.project_into(table_CW[count:], 2, offset_83, rows.first_bias)
    ends_C2 = torch.stack([cells.level.parent_C, cells.level.octant_C + count], -1)
    result_CW = torch.empty_like(down_CW)
    ends = [ends.flatten() for ends in cells.blocks.split(ends_C2)]
    down, result = map(cells.blocks.split, (down_CW, result_CW))

    def receive(block: int) -> None:
        rows.output(result[block], Hidden(table_CW, ends[block], 2, 1, down[block]), down[block])

    for_each(receive, range(len(cells.blocks)), threads)
    return result_CW


def _to_cells(rows: Rows, particle_NW: torch.Tensor, grid: GridHierarchy, threads: int) -> torch.Tensor:
    """Returns the finest cells [C, W] (step 1 of the paper)."""
    particles, count = len(particle_NW), grid.levels[0].cell_count
    cell_P, pair_P = torch.sort(grid.cells.flatten().int(), stable=True)  # takes half as long as int64
    blocks = _Blocks(cell_P, count, threads)
    ends = blocks.indices(torch.stack([pair_P >> 3, (pair_P & 7) + particles], -1))
    # The table has the products of the hidden layer with particles and with corners.
    table_NW = particle_NW.new_empty(particles + len(CORNER_83), particle_NW.shape[1])
    table_NW[particles:] = rows.project(1, CORNER_83.to(particle_NW), rows.first_bias)
    _project(rows, table_NW[:particles], threads, (0, particle_NW), (1, -grid.fraction_N3))
    sum_CW = particle_NW.new_zeros(count, particle_NW.shape[1])
    sums = blocks.split(sum_CW)
    segments = blocks.segments(grid.groups.weight_N8.flatten()[pair_P])

    def add(block: int) -> None:
        rows.add_sums(sums[block], Hidden(table_NW, ends[block], 2), segments[block])

    for_each(add, range(len(blocks)), threads)
    return sum_CW


def _to_particles(
    rows: Rows, decode: Rows, particle_NW: torch.Tensor, cell_CW: torch.Tensor, grid: GridHierarchy, threads: int
) -> torch.Tensor:
    """Returns the decoder's output [N, 3 or 9] (steps 11 and 12 of the paper)."""
    count, others, particles = len(cell_CW), len(cell_CW) + len(CORNER_83), len(particle_NW)
    # The table has the products of the hidden layer with cells, corners and particles.
    table_KW = particle_NW.new_empty(others + particles, particle_NW.shape[1])
    _project(rows, table_KW[:count], threads, (0, cell_CW))
    table_KW[count:others] = rows.first_bias - rows.project(2, CORNER_83.to(particle_NW))
    _project(rows, table_KW[others:], threads, (1, particle_NW), (2, grid.fraction_N3))
    runs = _runs(particles, ROWS_AT_ONCE // 8, threads)
    result, after_NW = particle_NW.new_empty(particles, len(decode.second_bias)), particle_NW.clone()
    own_N1 = (torch.arange(particles) + others)[:, None]
    all_of = (grid.cells, own_N1, grid.groups.weight_N8, after_NW, result)
    cell, own, weight, after, results = (x.split_with_sizes(runs) for x in all_of)
    corner_8, offset = torch.arange(8) + count, torch.arange(0, 8 * max(runs) + 1, 8)

    def add(run: int) -> None:
        ends_N83 = torch.stack(torch.broadcast_tensors(cell[run], corner_8, own[run]), -1)
        segments = Segments(8 * runs[run], offset[: runs[run] + 1], weight[run].flatten())
        rows.add_sums(after[run], Hidden(table_KW, ends_N83.flatten(), 3), segments)
        results[run].copy_(decode.finish(decode.project(0, after[run], decode.first_bias)))

    for_each(add, range(len(runs)), threads)
    return result


def _project(rows: Rows, out_RW: torch.Tensor, threads: int, *values: tuple[int, torch.Tensor]) -> None:
    """Writes the sum of products of the first layer's parts with values, without the bias."""
    runs = _runs(len(out_RW), ROWS_AT_ONCE, threads)
    out, *split = (x.split_with_sizes(runs) for x in (out_RW, *(value for _, value in values)))
    (first, *others) = (part for part, _ in values)

    def project(run: int) -> None:
        rows.project_into(out[run], first, split[0][run])
        for part, value in zip(others, split[1:], strict=True):
            rows.add_projection(out[run], part, value[run])

    for_each(project, range(len(runs)), threads)


class _Blocks:
    """Splits cells into runs with about equal numbers of rows. The rows are sorted by cell."""

    def __init__(self, cell_R: torch.Tensor, count: int, threads: int) -> None:
        rows = len(cell_R)
        offset_C1 = torch.searchsorted(cell_R, torch.arange(count + 1, dtype=cell_R.dtype))
        wanted = torch.tensor(_runs(rows, ROWS_AT_ONCE, threads)[:-1], dtype=torch.int64).cumsum(0)
        cut = torch.searchsorted(offset_C1, wanted).clamp_(max=count)
        places = [[0, 0], *torch.stack([cut, offset_C1[cut]], -1).tolist(), [count, rows]]
        places = [a for a, b in itertools.pairwise(places) if b[0] > a[0]] + places[-1:]
        self.cells = [b[0] - a[0] for a, b in itertools.pairwise(places)]  # number of cells of each block
        self.rows = [b[1] - a[1] for a, b in itertools.pairwise(places)]
        self.offset = [offset_C1[a[0] : b[0] + 1] - a[1] for a, b in itertools.pairwise(places)]

    def __len__(self) -> int:
        return len(self.cells)

    def split(self, value_C: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return value_C.split_with_sizes(self.cells)

    def indices(self, index_RK: torch.Tensor) -> list[torch.Tensor]:
        """Returns the indices of each block's rows, flattened."""
        return [index.flatten() for index in index_RK.split_with_sizes(self.rows)]

    def segments(self, weight_R: torch.Tensor | None = None) -> list[Segments]:
        """Returns the rows of each block grouped by cell, with their weights."""
        weights = [None] * len(self) if weight_R is None else weight_R.split_with_sizes(self.rows)
        return [Segments(*x) for x in zip(self.rows, self.offset, weights, strict=True)]


def _runs(rows: int, at_once: int, threads: int) -> list[int]:
    """Returns the lengths of nearly equal runs of about `at_once` rows. Each thread gets the same number of runs."""
    count = -(-rows // (at_once * threads)) * threads
    count = max(1, min(count, rows // min(at_once, FEWEST_ROWS)))
    return [(i + 1) * rows // count - i * rows // count for i in range(count)]
