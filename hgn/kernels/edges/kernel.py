"""Computes the edges of one message passing step on a level (paper fig. 5), forward and backward.

A tile has ROWS rows. Each cell has eight rows, and up to six of them are edges that end in it. With DENSE each cell has
six rows, so that 64 rows hold ten cells instead of eight. A program takes many tiles in turn and reads its weights
once. Edge arrays are [capacity, 6, W]: entry [c, d] is the edge to cell c from its neighbour in direction d. A tile
computes its sums over edges itself, or gathers them in a fixed order. Atomics add only gradients of parameters.
OVERLAP: a program starts while the previous kernel runs. It reads its weights and the results of the grid's kernels
(count, neighbours). It waits for the end of the previous kernel before any other access. At least one kernel without
OVERLAP runs after those of the grid. Every program with rows waits, and the first program always waits. A kernel
therefore ends only after all earlier ones. The wait is inside the loop over tiles, because the compiler then lays out
the weights for the matrix units before the wait. AHEAD: a program loads the next tile's rows when the registers of this
tile's rows are free. The wait and the loads of the first tile are then before the loop. Shape legend: C cells, W width.
"""

import triton
import triton.language as tl

from hgn.kernels.blocks import (
    added,
    chosen_rows,
    column_sums,
    elements,
    high_and_low,
    inside,
    leaky_backward,
    leaky_operand,
    matrix,
    members,
    normalise_backward,
    normalise_once,
    nothing_to_do,
    product,
    transposed,
    weighted_sums,
)
from hgn.kernels.triton_compat import gdc_launch_dependents, gdc_wait, settle_keys


@triton.jit
def _edges_of(tile, count, ROWS: tl.constexpr, SLOTS: tl.constexpr):
    """Returns the index of the edge in each row of a tile, and whether the row has an edge."""
    row = tl.arange(0, ROWS)
    BLOCK: tl.constexpr = ROWS // SLOTS
    holds = (tile * BLOCK + row // SLOTS < count) & (row % SLOTS < 6) & (row < SLOTS * BLOCK)
    place = tile * (6 * BLOCK) + (row if SLOTS == 6 else row // SLOTS * 6 + row % SLOTS)
    return place, holds


@triton.jit
def _senders(neighbour, slot, owner, used, count, capacity):
    """Returns the cells from which edges come, -1 for none."""
    return tl.load(neighbour + slot * capacity + owner, mask=used & (owner < count), other=-1)


@triton.jit
def _edge_rows(
    send, receive, edge_in, tile, owner, slot, other, count,
    FIRST: tl.constexpr, BY_PRODUCT: tl.constexpr, WIDTH: tl.constexpr, SUMS: tl.constexpr, BLOCK: tl.constexpr,
    WIDE: tl.constexpr,
):  # fmt: skip
    """Loads a tile's rows of `receive` (by cell if BY_PRODUCT, else by edge), of `send`, and unless FIRST of edges."""
    column = tl.arange(0, WIDTH)
    there = (other >= 0)[:, None]
    # All loads come before the first use: the compiler keeps their order, and waits at the first use.
    if BY_PRODUCT:
        member = tl.arange(0, SUMS)
        mine = tile * BLOCK + member
        mine_there = ((member < BLOCK) & (mine < count))[:, None]
        received = tl.load(receive + mine[:, None] * WIDTH + column[None, :], mask=mine_there, other=0.0)
    else:
        received = tl.load(receive + owner[:, None] * WIDTH + column[None, :], mask=there, other=0.0)
    sent = tl.load(send + other[:, None] * WIDTH + column[None, :], mask=there, other=0.0)
    if FIRST:
        edge = sent
    else:
        edge_at = elements(owner * 6 + slot, WIDTH, WIDE)
        edge = tl.load(edge_in + edge_at, mask=there, other=0.0)
    return received, sent, edge


@triton.jit(do_not_specialize_on_alignment=["count_ptr"])
def edge_forward(
    send, receive, edge_in, neighbour, count_ptr, weights, values, own_at, second_at, second_bias_at,
    norm_weight_at, norm_bias_at, edge_out, sum_out, hidden, normalised, rstd, capacity,
    FIRST: tl.constexpr, STORE_EDGE: tl.constexpr, SAVE: tl.constexpr, WIDTH: tl.constexpr, ROWS: tl.constexpr,
    DENSE: tl.constexpr, PRECISION: tl.constexpr, OVERLAP: tl.constexpr, AHEAD: tl.constexpr, WIDE: tl.constexpr,
):  # fmt: skip
    """Computes paper steps 2, 4, … (fig. 5): the edges' new features [C, 6, W] and their sums by receiver [C, W].

    send and receive [C, W] are the products of the cells with the first two parts of the edge MLP; receive includes the
    bias. FIRST: edges have no features yet, and their unit offset replaces them. The last step stores no edges.
    SAVE stores the inputs of edge_backward: hidden layer and normalised output [C, 6, W], and `rstd` [C, 6] (1 / std).

    Rule: hgn.network.hgn.MessagePassing; reference and test: tests/kernels/references.py, test_kernels_alone.py.
    """
    if OVERLAP:
        gdc_launch_dependents()
    SUMS: tl.constexpr = max(16, ROWS // 4)  # 16 is the smallest size of the matrix units
    SLOTS: tl.constexpr = 6 if DENSE else 8
    BLOCK: tl.constexpr = ROWS // SLOTS
    column = tl.arange(0, WIDTH)
    count = tl.load(count_ptr)
    if nothing_to_do(count, BLOCK):
        return
    slot = tl.arange(0, ROWS) % SLOTS
    used = (slot < 6) & (tl.arange(0, ROWS) < SLOTS * BLOCK)
    owner = tl.program_id(0) * BLOCK + tl.arange(0, ROWS) // SLOTS
    other = _senders(neighbour, slot, owner, used, count, capacity)
    # The vectors are loaded once. In the loop each load would be waited for again.
    second_bias = tl.load(values + second_bias_at + column)
    norm_weight, norm_bias = tl.load(values + norm_weight_at + column), tl.load(values + norm_bias_at + column)
    # A matrix copies a cell's row to its edges, if the product is exact. Its spare columns add the sides' rows.
    BY_PRODUCT: tl.constexpr = PRECISION != "tf32"
    if BY_PRODUCT:
        receiver = chosen_rows(ROWS, SLOTS, SUMS)
        member = tl.arange(0, SUMS)
        if FIRST:
            # The offset is receiver minus sender, which is opposite to the direction of the sender.
            spare = member[None, :] - BLOCK
            side = (slot % 2 * 2 - 1).to(tl.float32)[:, None]
            on_axis = (spare >= 0) & (spare < 6) & (spare % 3 == (slot // 2)[:, None])
            receiver = tl.where(spare >= 0, tl.where(on_axis, side, 0.0), receiver)
            sides = high_and_low(values + own_at, BLOCK, SUMS, WIDTH, PRECISION)
    if not FIRST:
        own = transposed(weights + own_at, WIDTH, WIDTH)
    second = transposed(weights + second_at, WIDTH, WIDTH)
    tile = tl.program_id(0)
    if AHEAD:
        later = _senders(neighbour, slot, owner + tl.num_programs(0) * BLOCK, used, count, capacity)
        if OVERLAP:
            gdc_wait()
        received, sent, edge = _edge_rows(
            send, receive, edge_in, tile, owner, slot, other, count, FIRST, BY_PRODUCT, WIDTH, SUMS, BLOCK, WIDE
        )
    while tile * BLOCK < count:
        if OVERLAP and not AHEAD:
            gdc_wait()
        holds = used & (owner < count)
        # The senders of a later tile, which its loads need as addresses. In tf32 no registers are free for them.
        later_owner = owner + tl.num_programs(0) * BLOCK
        if AHEAD:
            last = _senders(neighbour, slot, later_owner + tl.num_programs(0) * BLOCK, used, count, capacity)
        elif PRECISION == "tf32":
            other = _senders(neighbour, slot, owner, used, count, capacity)
            later = other
        else:
            later = _senders(neighbour, slot, later_owner, used, count, capacity)
        there = (other >= 0)[:, None]
        place = owner * 6 + slot
        edge_at = elements(place, WIDTH, WIDE)
        if not AHEAD:
            received, sent, edge = _edge_rows(
                send, receive, edge_in, tile, owner, slot, other, count, FIRST, BY_PRODUCT, WIDTH, SUMS, BLOCK, WIDE
            )
        if BY_PRODUCT:
            if FIRST:
                received = received.to(tl.float32) + sides
            h = product(receiver, received, PRECISION, sent.to(tl.float32))
        else:
            h = added(received, sent).to(tl.float32)
            if FIRST:
                for axis in tl.static_range(3):
                    side = tl.where(slot // 2 == axis, 2.0 * (slot % 2) - 1.0, 0.0)
                    h += side[:, None] * tl.load(values + own_at + axis * WIDTH + column)[None, :]
        if not FIRST:
            h = product(edge, own, PRECISION, h)
        a = leaky_operand(h, PRECISION)
        if SAVE:
            # Rows without an edge are stored too. The weight gradients multiply them by zero gradients.
            tl.store(hidden + edge_at, a, mask=holds[:, None])
        z = product(a, second, PRECISION)
        z, row_rstd = normalise_once(z + inside(second_bias, tile)[None, :], WIDTH, PRECISION)
        if SAVE:
            tl.store(normalised + edge_at, z, mask=there)
            tl.store(rstd + place, tl.where(other >= 0, row_rstd, 0.0), mask=holds)
        z = z * inside(norm_weight, tile)[None, :] + inside(norm_bias, tile)[None, :]
        if not FIRST:
            if AHEAD:
                z = added(edge, z.to(edge.dtype))
            else:
                z += edge.to(tl.float32)
        if AHEAD:
            received, sent, edge = _edge_rows(
                send, receive, edge_in, tile + tl.num_programs(0), later_owner, slot, later, count, FIRST,
                BY_PRODUCT, WIDTH, SUMS, BLOCK, WIDE,
            )  # fmt: skip
        if STORE_EDGE:
            if SAVE:
                tl.store(edge_out + edge_at, z, mask=holds[:, None])
            else:
                tl.store(edge_out + edge_at, z, mask=there)
        if not DENSE and PRECISION == "tf32" and not SAVE:
            # Here a reduction makes the sum: rounding a product's operands would spill registers.
            mine = tile * BLOCK + tl.arange(0, BLOCK)
            ends = (mine < count)[:, None]
            total = tl.sum(tl.reshape(tl.where(there, z, 0.0), (BLOCK, 8, WIDTH)), 1)
        else:
            mine = tile * BLOCK + tl.arange(0, SUMS)
            ends = ((tl.arange(0, SUMS) < BLOCK) & (mine < count))[:, None]
            among = tl.where((other >= 0)[None, :], members(SUMS, ROWS, SLOTS), 0.0)
            total = weighted_sums(among, z, PRECISION)
        tl.store(sum_out + mine[:, None] * WIDTH + column[None, :], total, mask=ends)
        owner, other = later_owner, later
        if AHEAD:
            later = last
        tile += tl.num_programs(0)
    if OVERLAP:
        gdc_wait()


@triton.jit(do_not_specialize_on_alignment=["count_ptr"])
def edge_backward(
    sum_gradient, edge_gradient, count_ptr, weights, values, totals, own_at, second_at, norm_weight_at,
    norm_bias_at, hidden, normalised, rstd, hidden_gradient, second_gradient, receive_gradient, unscale,
    FIRST: tl.constexpr, LAST: tl.constexpr, WIDTH: tl.constexpr, ROWS: tl.constexpr, DENSE: tl.constexpr,
    PRECISION: tl.constexpr, OVERLAP: tl.constexpr,
):  # fmt: skip
    """Replaces the gradient of edge_out in edge_gradient [C, 6, W] by that of edge_in (unless FIRST).

    The incoming gradient lacks the part through the sums; with LAST there is none. receive_gradient [C, W] is the
    gradient of `receive`. `rstd` is zero where there is no edge. It is read a tile ahead, because other reads need it.

    Rule: hgn.network.hgn.MessagePassing; reference and test: tests/kernels/references.py, test_kernels_alone.py.
    """
    if OVERLAP:
        gdc_launch_dependents()
    SUMS: tl.constexpr = max(16, ROWS // 4)  # 16 is the smallest size of the matrix units
    SLOTS: tl.constexpr = 6 if DENSE else 8
    BLOCK: tl.constexpr = ROWS // SLOTS
    column = tl.arange(0, WIDTH)
    count = tl.load(count_ptr)
    if nothing_to_do(count, BLOCK):
        return
    second = matrix(weights + second_at, WIDTH, WIDTH)
    if not FIRST:
        own = matrix(weights + own_at, WIDTH, WIDTH)
    norm_weight = tl.load(values + norm_weight_at + column)
    norm_weight_total, norm_bias_total = tl.zeros((8, WIDTH), tl.float32), tl.zeros((8, WIDTH), tl.float32)
    if FIRST:
        side_total = tl.zeros((16, WIDTH), tl.float32)
    tile = tl.program_id(0)
    place, holds = _edges_of(tile, count, ROWS, SLOTS)
    row_rstd = tl.load(rstd + place, mask=holds, other=0.0)
    while tile * BLOCK < count:
        slot = tl.arange(0, ROWS) % SLOTS
        place, holds = _edges_of(tile, count, ROWS, SLOTS)
        there = (row_rstd != 0)[:, None]
        if OVERLAP:
            gdc_wait()
        edge_at = place[:, None] * WIDTH + column[None, :]
        # All loads come before the first use: the compiler keeps their order, and waits at the first use.
        z = tl.load(normalised + edge_at, mask=there, other=0.0)
        if not LAST:
            later = tl.load(edge_gradient + edge_at, mask=there, other=0.0)
        owner = tile * BLOCK + tl.arange(0, ROWS) // SLOTS
        de = tl.load(sum_gradient + owner[:, None] * WIDTH + column[None, :], mask=there, other=0.0)
        row_rstd = tl.load(rstd + place, mask=holds, other=0.0)
        if not LAST:
            de = added(de, later)
        dy, z = de.to(tl.float32), z.to(tl.float32)
        if tile >= 0:  # always true, unknown to the compiler; otherwise it delays these sums and keeps their operands
            norm_weight_total += column_sums(dy * z, ROWS, WIDTH, 8)
            norm_bias_total += column_sums(dy, ROWS, WIDTH, 8)
        dz = normalise_backward(dy, z, row_rstd, inside(norm_weight, tile), WIDTH)
        # No registers are free for this load earlier. It runs during the product.
        a = tl.load(hidden + edge_at, mask=there, other=0.0)
        tl.store(second_gradient + edge_at, dz, mask=holds[:, None])
        later_place, later_holds = _edges_of(tile + tl.num_programs(0), count, ROWS, SLOTS)
        later_rstd = tl.load(rstd + later_place, mask=later_holds, other=0.0)
        dh = product(dz, second, PRECISION)
        dh = leaky_backward(dh, a.to(tl.float32))
        tl.store(hidden_gradient + edge_at, dh, mask=holds[:, None])
        if FIRST:
            sign = 2.0 * (slot % 2) - 1.0
            axis = tl.arange(0, 16)[:, None]
            side_total += weighted_sums(tl.where(slot[None, :] // 2 == axis, sign[None, :], 0.0), dh, PRECISION)
        else:
            through = product(dh, own, PRECISION)
            if PRECISION == "fp16":
                de = added(de, through.to(de.dtype))
            else:
                # This repeats a read, because a register costs more than a read of the cache.
                owner = tile * BLOCK + tl.arange(0, ROWS) // SLOTS
                de = through + tl.load(sum_gradient + owner[:, None] * WIDTH + column[None, :], mask=there, other=0.0)
                if not LAST:
                    de += tl.load(edge_gradient + edge_at, mask=there, other=0.0)
            tl.store(edge_gradient + edge_at, de, mask=there)
        mine = tile * BLOCK + tl.arange(0, SUMS)
        ends = ((tl.arange(0, SUMS) < BLOCK) & (mine < count))[:, None]
        received = weighted_sums(members(SUMS, ROWS, SLOTS), dh, PRECISION)
        tl.store(receive_gradient + mine[:, None] * WIDTH + column[None, :], received, mask=ends)
        tile += tl.num_programs(0)
        row_rstd = later_rstd
    if OVERLAP:
        gdc_wait()
    tl.atomic_add(totals + norm_weight_at + column, tl.sum(norm_weight_total, 0) * unscale, sem="relaxed")
    tl.atomic_add(totals + norm_bias_at + column, tl.sum(norm_bias_total, 0) * unscale, sem="relaxed")
    if FIRST:
        axis = tl.arange(0, 16)[:, None]
        at = totals + own_at + axis * WIDTH + column[None, :]
        tl.atomic_add(at, side_total * unscale, mask=axis < 3, sem="relaxed")


settle_keys(globals())
