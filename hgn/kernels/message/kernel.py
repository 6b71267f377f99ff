"""One message-passing iteration on a level (paper fig. 5), forward and backward: its edges and its cells in turn.

A tile of the edge kernels has ROWS rows, eight for each cell of which six can hold an edge that ends in it, or six if
DENSE (64 rows: ten cells instead of eight). A program takes one tile after the other and reads its weights once.
Edge arrays are [capacity, 6, W], [c, d] for the edge to cell c from its neighbour in direction d. Sums over edges are
made inside the tile and by gathers in fixed order: no atomics, the same result every time.
OVERLAP: a program starts while the kernel before still runs, reads its weights, and waits for that kernel's end before
it reads or writes anything else; every program waits, so that a kernel has ended only when all before it have.
Shape legend: C cells, W width.
"""

from __future__ import annotations

import triton
import triton.language as tl
from triton.language.extra.cuda import gdc_launch_dependents, gdc_wait

from hgn.kernels.blocks import (
    added,
    gathered_sum,
    inside,
    leaky,
    leaky_backward,
    matrix,
    members,
    normalise,
    normalise_backward,
    product,
    transposed,
    weighted_sums,
)
from hgn.kernels.keys import settle_keys

FIRST_WAVE = tl.constexpr(128)  # programs that run at once on an H100, one on each processor


@triton.jit
def _nothing_to_do(count_ptr, BLOCK: tl.constexpr):
    """Whether a program beyond the first wave has no rows: it waits to know, instead of reading weights for nothing."""
    beyond = tl.program_id(0) >= FIRST_WAVE
    if beyond:
        gdc_wait()
    count = tl.load(count_ptr, mask=beyond, other=2147483647)
    return tl.program_id(0) * BLOCK >= count


@triton.jit(do_not_specialize_on_alignment=["count_ptr"])
def edge_forward(
    send,
    receive,
    edge_in,
    neighbour,
    count_ptr,
    weights,
    values,
    own_at,
    bias_at,
    second_at,
    second_bias_at,
    gain_at,
    shift_at,
    edge_out,
    sum_out,
    hidden,
    normalised,
    deviation,
    capacity,
    FIRST: tl.constexpr,
    STORE_EDGE: tl.constexpr,
    SAVE: tl.constexpr,
    WIDTH: tl.constexpr,
    ROWS: tl.constexpr,
    DENSE: tl.constexpr,
    PRECISION: tl.constexpr,
    OVERLAP: tl.constexpr,
):
    """The edges' new features and their sums by receiver [C, W]; send and receive [C, W] are the cells' products with
    the edge network's first two parts.

    FIRST: edges have no features yet, their unit offset takes the place. The last iteration stores no edges. SAVE keeps
    what edge_backward reads: the hidden layer, the normalised output and one over its deviation.
    """
    if OVERLAP:
        gdc_launch_dependents()
    else:
        count = tl.load(count_ptr)
    SUMS: tl.constexpr = max(16, ROWS // 4)  # the least that the matrix units take
    SLOTS: tl.constexpr = 6 if DENSE else 8
    BLOCK: tl.constexpr = ROWS // SLOTS
    column = tl.arange(0, WIDTH)
    if OVERLAP:
        if _nothing_to_do(count_ptr, BLOCK):
            return
    else:
        if tl.program_id(0) * BLOCK >= count:
            return
    # vectors once: in the loop each would be waited for again
    bias, second_bias = tl.load(values + bias_at + column), tl.load(values + second_bias_at + column)
    gain, shift = tl.load(values + gain_at + column), tl.load(values + shift_at + column)
    if not FIRST:
        own = transposed(weights + own_at, WIDTH, WIDTH)
    second = transposed(weights + second_at, WIDTH, WIDTH)
    if OVERLAP:
        gdc_wait()
        count = tl.load(count_ptr)
    tile = tl.program_id(0)
    while tile * BLOCK < count:
        owner = tile * BLOCK + tl.arange(0, ROWS) // SLOTS
        slot = tl.arange(0, ROWS) % SLOTS
        holds = (owner < count) & (slot < 6) & (tl.arange(0, ROWS) < SLOTS * BLOCK)
        other = tl.load(neighbour + slot * capacity + owner, mask=holds, other=-1)
        there = (other >= 0)[:, None]
        if DENSE:
            place = tile * (6 * BLOCK) + tl.arange(0, ROWS)
        else:
            place = owner * 6 + slot
        edge_at = place[:, None] * WIDTH + column[None, :]
        # all loads before the first use: the compiler keeps their order, and waits at the first
        received = tl.load(receive + owner[:, None] * WIDTH + column[None, :], mask=there, other=0.0)
        sent = tl.load(send + other[:, None] * WIDTH + column[None, :], mask=there, other=0.0)
        if not FIRST:
            edge = tl.load(edge_in + edge_at, mask=there, other=0.0)
        h = added(received, sent) + inside(bias, tile)[None, :]
        if FIRST:
            for axis in tl.static_range(3):
                # receiver minus sender: the opposite of where the sender lies
                side = tl.where(slot // 2 == axis, 2.0 * (slot % 2) - 1.0, 0.0)
                h += side[:, None] * tl.load(values + own_at + axis * WIDTH + column)[None, :]
        else:
            h += product(edge, own, PRECISION)
        a = leaky(h)
        if SAVE:
            # zeros, not old values, where there is no edge: they meet zero gradients in the weights' products
            tl.store(hidden + edge_at, tl.where(there, a, 0.0), mask=holds[:, None])
        z = product(a, second, PRECISION)
        z, scale = normalise(z + inside(second_bias, tile)[None, :], WIDTH)
        if SAVE:
            tl.store(normalised + edge_at, z, mask=there)
            tl.store(deviation + place, scale, mask=other >= 0)
        z = z * inside(gain, tile)[None, :] + inside(shift, tile)[None, :]
        if not FIRST:
            z += edge.to(tl.float32)
        z = tl.where(there, z, 0.0)
        if STORE_EDGE:
            if SAVE:
                tl.store(edge_out + edge_at, z, mask=holds[:, None])
            else:
                tl.store(edge_out + edge_at, z, mask=there)
        if not DENSE and PRECISION == "tf32" and not SAVE:
            # as a reduction: rounding the product's operands would spill registers here
            mine = tile * BLOCK + tl.arange(0, BLOCK)
            ends = (mine < count)[:, None]
            total = tl.sum(tl.reshape(z, (BLOCK, 8, WIDTH)), 1)
        else:
            mine = tile * BLOCK + tl.arange(0, SUMS)
            ends = ((tl.arange(0, SUMS) < BLOCK) & (mine < count))[:, None]
            total = weighted_sums(members(SUMS, ROWS, SLOTS), z, PRECISION)
        tl.store(sum_out + mine[:, None] * WIDTH + column[None, :], total, mask=ends)
        tile += tl.num_programs(0)


@triton.jit(do_not_specialize_on_alignment=["count_ptr"])
def cell_forward(
    cell,
    total,
    count_ptr,
    weights,
    values,
    first_at,
    sum_first_at,
    bias_at,
    second_at,
    second_bias_at,
    gain_at,
    shift_at,
    next_at_0,
    next_at_1,
    cell_out,
    hidden,
    normalised,
    deviation,
    next_0,
    next_1,
    NEXT: tl.constexpr,
    SAVE: tl.constexpr,
    WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
    PRECISION: tl.constexpr,
    OVERLAP: tl.constexpr,
):
    """The cells' new features from theirs and their edges' sums, both [C, W], and up to two products of them."""
    if OVERLAP:
        gdc_launch_dependents()
        if _nothing_to_do(count_ptr, BLOCK):
            return
        first = transposed(weights + first_at, WIDTH, WIDTH)
        sum_first = transposed(weights + sum_first_at, WIDTH, WIDTH)
        second = transposed(weights + second_at, WIDTH, WIDTH)
        if NEXT > 0:
            following_0 = transposed(weights + next_at_0, WIDTH, WIDTH)
        if NEXT > 1:
            following_1 = transposed(weights + next_at_1, WIDTH, WIDTH)
        gdc_wait()
    count = tl.load(count_ptr)
    if tl.program_id(0) * BLOCK >= count:
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = (row < count)[:, None]
    column = tl.arange(0, WIDTH)
    at = row[:, None] * WIDTH + column[None, :]
    feature = tl.load(cell + at, mask=here, other=0.0).to(tl.float32)
    summed = tl.load(total + at, mask=here, other=0.0).to(tl.float32)
    if not OVERLAP:
        first = transposed(weights + first_at, WIDTH, WIDTH)
    h = product(feature, first, PRECISION)
    if not OVERLAP:
        sum_first = transposed(weights + sum_first_at, WIDTH, WIDTH)
    h += product(summed, sum_first, PRECISION)
    a = leaky(h + tl.load(values + bias_at + column)[None, :])
    if not OVERLAP:
        second = transposed(weights + second_at, WIDTH, WIDTH)
    z = product(a, second, PRECISION)
    z, scale = normalise(z + tl.load(values + second_bias_at + column)[None, :], WIDTH)
    if SAVE:
        tl.store(hidden + at, a, mask=here)
        tl.store(normalised + at, z, mask=here)
        tl.store(deviation + row, scale, mask=row < count)
    z = z * tl.load(values + gain_at + column)[None, :] + tl.load(values + shift_at + column)[None, :]
    feature += z
    tl.store(cell_out + at, feature, mask=here)
    if NEXT > 0:
        if not OVERLAP:
            following_0 = transposed(weights + next_at_0, WIDTH, WIDTH)
        tl.store(next_0 + at, product(feature, following_0, PRECISION), mask=here)
    if NEXT > 1:
        if not OVERLAP:
            following_1 = transposed(weights + next_at_1, WIDTH, WIDTH)
        tl.store(next_1 + at, product(feature, following_1, PRECISION), mask=here)


@triton.jit(do_not_specialize_on_alignment=["count_ptr"])
def cell_backward(
    gradient,
    later_hidden_gradient,
    later_receive_gradient,
    neighbour,
    count_ptr,
    weights,
    values,
    totals,
    later_send_at,
    later_receive_at,
    first_at,
    sum_first_at,
    second_at,
    gain_at,
    shift_at,
    hidden,
    normalised,
    deviation,
    send_gradient,
    hidden_gradient,
    second_gradient,
    sum_gradient,
    capacity,
    unscale,
    LAST: tl.constexpr,
    WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
    PRECISION: tl.constexpr,
    OVERLAP: tl.constexpr,
):
    """In place: `gradient` [C, W] comes in as the gradient of cell_out, less what reaches it through `send` and
    `receive` of the following iteration (added here unless LAST; what comes from the edges that start in a cell is left
    in send_gradient), and leaves as that of `cell`, again less what goes through its own.

    sum_gradient [C, W] is that of the edges' sums.
    """
    if OVERLAP:
        gdc_launch_dependents()
        if _nothing_to_do(count_ptr, BLOCK):
            return
        if not LAST:
            later_send = matrix(weights + later_send_at, WIDTH, WIDTH)
            later_receive = matrix(weights + later_receive_at, WIDTH, WIDTH)
        second = matrix(weights + second_at, WIDTH, WIDTH)
        sum_first = matrix(weights + sum_first_at, WIDTH, WIDTH)
        first = matrix(weights + first_at, WIDTH, WIDTH)
        gdc_wait()
    count = tl.load(count_ptr)
    if tl.program_id(0) * BLOCK >= count:
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = (row < count)[:, None]
    column = tl.arange(0, WIDTH)
    at = row[:, None] * WIDTH + column[None, :]
    df = tl.load(gradient + at, mask=here, other=0.0)
    if not LAST:
        # the edges that start here: each in its receiver's row, seen from there in the opposite direction
        sent = gathered_sum(later_hidden_gradient, neighbour, row, count, capacity, 6, True, WIDTH, BLOCK)
        tl.store(send_gradient + at, sent, mask=here)
        if not OVERLAP:
            later_send = matrix(weights + later_send_at, WIDTH, WIDTH)
        df += product(sent, later_send, PRECISION)
        received = tl.load(later_receive_gradient + at, mask=here, other=0.0).to(tl.float32)
        if not OVERLAP:
            later_receive = matrix(weights + later_receive_at, WIDTH, WIDTH)
        df += product(received, later_receive, PRECISION)
    z = tl.load(normalised + at, mask=here, other=0.0).to(tl.float32)
    scale = tl.load(deviation + row, mask=row < count, other=0.0)
    tl.atomic_add(totals + gain_at + column, tl.sum(df * z, 0) * unscale, sem="relaxed")
    tl.atomic_add(totals + shift_at + column, tl.sum(df, 0) * unscale, sem="relaxed")
    dz = normalise_backward(df, z, scale, tl.load(values + gain_at + column), WIDTH)
    tl.store(second_gradient + at, dz, mask=here)
    if not OVERLAP:
        second = matrix(weights + second_at, WIDTH, WIDTH)
    dh = product(dz, second, PRECISION)
    dh = leaky_backward(dh, tl.load(hidden + at, mask=here, other=0.0).to(tl.float32))
    tl.store(hidden_gradient + at, dh, mask=here)
    if not OVERLAP:
        sum_first = matrix(weights + sum_first_at, WIDTH, WIDTH)
    tl.store(sum_gradient + at, product(dh, sum_first, PRECISION), mask=here)
    if not OVERLAP:
        first = matrix(weights + first_at, WIDTH, WIDTH)
    df += product(dh, first, PRECISION)
    tl.store(gradient + at, df, mask=here)


@triton.jit(do_not_specialize_on_alignment=["count_ptr"])
def edge_backward(
    sum_gradient,
    edge_gradient,
    neighbour,
    count_ptr,
    weights,
    values,
    totals,
    own_at,
    second_at,
    gain_at,
    shift_at,
    hidden,
    normalised,
    deviation,
    hidden_gradient,
    second_gradient,
    receive_gradient,
    capacity,
    unscale,
    FIRST: tl.constexpr,
    LAST: tl.constexpr,
    WIDTH: tl.constexpr,
    ROWS: tl.constexpr,
    DENSE: tl.constexpr,
    PRECISION: tl.constexpr,
    OVERLAP: tl.constexpr,
):
    """In place: edge_gradient [C, 6, W] comes in as that of edge_out, less the sums' part (there is none if LAST), and
    leaves as that of edge_in (if there is one: not FIRST). receive_gradient [C, W] is that of `receive`."""
    if OVERLAP:
        gdc_launch_dependents()
    else:
        count = tl.load(count_ptr)
    SUMS: tl.constexpr = max(16, ROWS // 4)  # the least that the matrix units take
    SLOTS: tl.constexpr = 6 if DENSE else 8
    BLOCK: tl.constexpr = ROWS // SLOTS
    column = tl.arange(0, WIDTH)
    if OVERLAP:
        if _nothing_to_do(count_ptr, BLOCK):
            return
    else:
        if tl.program_id(0) * BLOCK >= count:
            return
    second = matrix(weights + second_at, WIDTH, WIDTH)
    if not FIRST:
        own = matrix(weights + own_at, WIDTH, WIDTH)
    gain = tl.load(values + gain_at + column)
    gain_total, shift_total = tl.zeros((WIDTH,), tl.float32), tl.zeros((WIDTH,), tl.float32)
    if FIRST:
        side_total = tl.zeros((16, WIDTH), tl.float32)
    if OVERLAP:
        gdc_wait()
        count = tl.load(count_ptr)
    tile = tl.program_id(0)
    while tile * BLOCK < count:
        owner = tile * BLOCK + tl.arange(0, ROWS) // SLOTS
        slot = tl.arange(0, ROWS) % SLOTS
        holds = (owner < count) & (slot < 6) & (tl.arange(0, ROWS) < SLOTS * BLOCK)
        other = tl.load(neighbour + slot * capacity + owner, mask=holds, other=-1)
        there = (other >= 0)[:, None]
        if DENSE:
            place = tile * (6 * BLOCK) + tl.arange(0, ROWS)
        else:
            place = owner * 6 + slot
        edge_at = place[:, None] * WIDTH + column[None, :]
        sum_at = owner[:, None] * WIDTH + column[None, :]
        # all loads before the first use: the compiler keeps their order, and waits at the first
        de = tl.load(sum_gradient + sum_at, mask=there, other=0.0)
        z = tl.load(normalised + edge_at, mask=there, other=0.0)
        if not LAST:
            later = tl.load(edge_gradient + edge_at, mask=there, other=0.0)
        a = tl.load(hidden + edge_at, mask=there, other=0.0)
        scale = tl.load(deviation + place, mask=other >= 0, other=0.0)
        if not LAST:
            de = added(de, later)
        de, z = de.to(tl.float32), z.to(tl.float32)
        gain_total += tl.sum(de * z, 0)
        shift_total += tl.sum(de, 0)
        dz = normalise_backward(de, z, scale, inside(gain, tile), WIDTH)
        tl.store(second_gradient + edge_at, dz, mask=holds[:, None])
        dh = product(dz, second, PRECISION)
        dh = leaky_backward(dh, a.to(tl.float32))
        tl.store(hidden_gradient + edge_at, dh, mask=holds[:, None])
        if FIRST:
            sign = 2.0 * (slot % 2) - 1.0
            axis = tl.arange(0, 16)[:, None]
            side_total += weighted_sums(tl.where(slot[None, :] // 2 == axis, sign[None, :], 0.0), dh, PRECISION)
        else:
            de = product(dh, own, PRECISION)
            # read again: registers are dearer than a cache
            de += tl.load(sum_gradient + sum_at, mask=there, other=0.0).to(tl.float32)
            if not LAST:
                de += tl.load(edge_gradient + edge_at, mask=there, other=0.0).to(tl.float32)
            tl.store(edge_gradient + edge_at, de, mask=there)
        mine = tile * BLOCK + tl.arange(0, SUMS)
        ends = ((tl.arange(0, SUMS) < BLOCK) & (mine < count))[:, None]
        received = weighted_sums(members(SUMS, ROWS, SLOTS), dh, PRECISION)
        tl.store(receive_gradient + mine[:, None] * WIDTH + column[None, :], received, mask=ends)
        tile += tl.num_programs(0)
    tl.atomic_add(totals + gain_at + column, gain_total * unscale, sem="relaxed")
    tl.atomic_add(totals + shift_at + column, shift_total * unscale, sem="relaxed")
    if FIRST:
        axis = tl.arange(0, 16)[:, None]
        at = totals + own_at + axis * WIDTH + column[None, :]
        tl.atomic_add(at, side_total * unscale, mask=axis < 3, sem="relaxed")


settle_keys(globals())
