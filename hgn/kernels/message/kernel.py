"""One message-passing iteration on the cells of a level (paper fig. 5), forward and backward, in one launch each.

A program owns BLOCK cells and the up to six edges that end in each: a tile of 8 BLOCK rows, of which six in eight can
hold an edge. Edge arrays are [capacity, 6, W], [c, d] for the edge to cell c from its neighbour in direction d. Sums
over edges are reductions inside the tile and gathers in fixed order: no atomics, the same result every time.
Shape legend: C cells, W width.
"""

from __future__ import annotations

import triton
import triton.language as tl

from hgn.kernels.blocks import leaky, leaky_backward, matrix, normalise, normalise_backward, product, transposed


@triton.jit
def message_forward(
    cell,
    send,
    receive,
    edge_in,
    neighbour,
    count_ptr,
    weights,
    values,
    own_at,
    edge_bias_at,
    edge_second_at,
    edge_second_bias_at,
    edge_gain_at,
    edge_shift_at,
    cell_first_at,
    sum_first_at,
    cell_bias_at,
    cell_second_at,
    cell_second_bias_at,
    cell_gain_at,
    cell_shift_at,
    next_at_0,
    next_at_1,
    cell_out,
    edge_out,
    edge_hidden,
    sum_out,
    cell_hidden,
    next_0,
    next_1,
    capacity,
    FIRST: tl.constexpr,
    STORE_EDGE: tl.constexpr,
    NEXT: tl.constexpr,
    SAVE: tl.constexpr,
    WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """send and receive [C, W] are the cells' products with the edge network's first two parts.

    FIRST: edges have no features yet, their unit offset takes the place. The last iteration stores no edges.
    """
    count = tl.load(count_ptr)
    if tl.program_id(0) * BLOCK >= count:
        return
    ROWS: tl.constexpr = BLOCK * 8
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = (row < count)[:, None]
    column = tl.arange(0, WIDTH)
    at = row[:, None] * WIDTH + column[None, :]
    owner = tl.program_id(0) * BLOCK + tl.arange(0, ROWS) // 8
    slot = tl.arange(0, ROWS) % 8
    holds = (owner < count) & (slot < 6)
    other = tl.load(neighbour + slot * capacity + owner, mask=holds, other=-1)
    there = (other >= 0)[:, None]
    edge_at = (owner * 6 + slot)[:, None] * WIDTH + column[None, :]
    receive_at = owner[:, None] * WIDTH + column[None, :]
    h = tl.load(receive + receive_at, mask=there, other=0.0).to(tl.float32)
    h += tl.load(send + other[:, None] * WIDTH + column[None, :], mask=there, other=0.0).to(tl.float32)
    h += tl.load(values + edge_bias_at + column)[None, :]
    if FIRST:
        for axis in tl.static_range(3):
            # receiver minus sender: the opposite of where the sender lies
            side = tl.where(slot // 2 == axis, 2.0 * (slot % 2) - 1.0, 0.0)
            h += side[:, None] * tl.load(values + own_at + axis * WIDTH + column)[None, :]
    else:
        edge = tl.load(edge_in + edge_at, mask=there, other=0.0).to(tl.float32)
        h += product(edge, transposed(weights + own_at, WIDTH, WIDTH), PRECISION)
    a = leaky(h)
    if SAVE:
        # zeros, not old values, where there is no edge: they meet zero gradients in the weights' products
        tl.store(edge_hidden + edge_at, tl.where(there, a, 0.0), mask=holds[:, None])
    z = product(a, transposed(weights + edge_second_at, WIDTH, WIDTH), PRECISION)
    z, _scale = normalise(z + tl.load(values + edge_second_bias_at + column)[None, :], WIDTH)
    z = z * tl.load(values + edge_gain_at + column)[None, :] + tl.load(values + edge_shift_at + column)[None, :]
    if not FIRST:
        # read again: registers are dearer than a cache
        z += tl.load(edge_in + edge_at, mask=there, other=0.0).to(tl.float32)
    z = tl.where(there, z, 0.0)
    if STORE_EDGE:
        if SAVE:
            tl.store(edge_out + edge_at, z, mask=holds[:, None])
        else:
            tl.store(edge_out + edge_at, z, mask=there)
    total = tl.sum(tl.reshape(z, (BLOCK, 8, WIDTH)), 1)
    feature = tl.load(cell + at, mask=here, other=0.0).to(tl.float32)
    h = product(feature, transposed(weights + cell_first_at, WIDTH, WIDTH), PRECISION)
    h += product(total, transposed(weights + sum_first_at, WIDTH, WIDTH), PRECISION)
    a = leaky(h + tl.load(values + cell_bias_at + column)[None, :])
    if SAVE:
        tl.store(sum_out + at, total, mask=here)
        tl.store(cell_hidden + at, a, mask=here)
    z = product(a, transposed(weights + cell_second_at, WIDTH, WIDTH), PRECISION)
    z, _scale = normalise(z + tl.load(values + cell_second_bias_at + column)[None, :], WIDTH)
    z = z * tl.load(values + cell_gain_at + column)[None, :] + tl.load(values + cell_shift_at + column)[None, :]
    feature += z
    tl.store(cell_out + at, feature, mask=here)
    if NEXT > 0:
        y = product(feature, transposed(weights + next_at_0, WIDTH, WIDTH), PRECISION)
        tl.store(next_0 + at, y, mask=here)
    if NEXT > 1:
        y = product(feature, transposed(weights + next_at_1, WIDTH, WIDTH), PRECISION)
        tl.store(next_1 + at, y, mask=here)


@triton.jit
def message_backward(
    gradient,
    later_hidden_gradient,
    send_gradient,
    edge_gradient,
    neighbour,
    count_ptr,
    weights,
    values,
    totals,
    later_send_at,
    receive_at,
    own_at,
    edge_second_at,
    edge_second_bias_at,
    edge_gain_at,
    edge_shift_at,
    cell_first_at,
    sum_first_at,
    cell_second_at,
    cell_second_bias_at,
    cell_gain_at,
    cell_shift_at,
    edge_hidden,
    cell_hidden,
    edge_hidden_gradient,
    edge_second_gradient,
    cell_hidden_gradient,
    cell_second_gradient,
    receive_gradient,
    capacity,
    unscale,
    FIRST: tl.constexpr,
    LAST: tl.constexpr,
    WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """In place: `gradient` [C, W] comes in as the gradient of cell_out, less what reaches it through `send` of the
    following iteration (gathered here unless LAST, and left in send_gradient), and leaves as that of `cell`, again less
    what goes through its own `send`. edge_gradient [C, 6, W] likewise: of edge_out (none if LAST), then of edge_in.
    """
    count = tl.load(count_ptr)
    if tl.program_id(0) * BLOCK >= count:
        return
    ROWS: tl.constexpr = BLOCK * 8
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = (row < count)[:, None]
    column = tl.arange(0, WIDTH)
    at = row[:, None] * WIDTH + column[None, :]
    owner = tl.program_id(0) * BLOCK + tl.arange(0, ROWS) // 8
    slot = tl.arange(0, ROWS) % 8
    holds = (owner < count) & (slot < 6)
    other = tl.load(neighbour + slot * capacity + owner, mask=holds, other=-1)
    there = (other >= 0)[:, None]
    edge_at = (owner * 6 + slot)[:, None] * WIDTH + column[None, :]

    cell_a = tl.load(cell_hidden + at, mask=here, other=0.0).to(tl.float32)
    df = tl.load(gradient + at, mask=here, other=0.0)
    if not LAST:
        # the edges that start here: each in its receiver's row, seen from there in the opposite direction
        away = (other * 6 + (slot ^ 1))[:, None] * WIDTH + column[None, :]
        sent = tl.load(later_hidden_gradient + away, mask=there, other=0.0).to(tl.float32)
        sent = tl.sum(tl.reshape(sent, (BLOCK, 8, WIDTH)), 1)
        tl.store(send_gradient + at, sent, mask=here)
        df += product(sent, matrix(weights + later_send_at, WIDTH, WIDTH), PRECISION)
    cell_second = matrix(weights + cell_second_at, WIDTH, WIDTH)
    z = product(cell_a, tl.trans(cell_second), PRECISION)
    z, scale = normalise(z + tl.load(values + cell_second_bias_at + column)[None, :], WIDTH)
    tl.atomic_add(totals + cell_gain_at + column, tl.sum(df * z, 0) * unscale)
    tl.atomic_add(totals + cell_shift_at + column, tl.sum(df, 0) * unscale)
    dz = normalise_backward(df, z, scale, tl.load(values + cell_gain_at + column), WIDTH)
    dz = tl.where(here, dz, 0.0)
    tl.store(cell_second_gradient + at, dz, mask=here)
    sum_first = matrix(weights + sum_first_at, WIDTH, WIDTH)
    dh = leaky_backward(product(dz, cell_second, PRECISION), cell_a)
    tl.store(cell_hidden_gradient + at, dh, mask=here)
    a = tl.load(edge_hidden + edge_at, mask=there, other=0.0).to(tl.float32)
    dsum = product(dh, sum_first, PRECISION)
    df += product(dh, matrix(weights + cell_first_at, WIDTH, WIDTH), PRECISION)

    second = matrix(weights + edge_second_at, WIDTH, WIDTH)
    z = product(a, tl.trans(second), PRECISION) + tl.load(values + edge_second_bias_at + column)[None, :]
    z, scale = normalise(z, WIDTH)
    de = tl.reshape(tl.broadcast_to(dsum[:, None, :], (BLOCK, 8, WIDTH)), (ROWS, WIDTH))
    if not LAST:
        de += tl.load(edge_gradient + edge_at, mask=there, other=0.0)
    de = tl.where(there, de, 0.0)
    tl.atomic_add(totals + edge_gain_at + column, tl.sum(de * z, 0) * unscale)
    tl.atomic_add(totals + edge_shift_at + column, tl.sum(de, 0) * unscale)
    dz = normalise_backward(de, z, scale, tl.load(values + edge_gain_at + column), WIDTH)
    tl.store(edge_second_gradient + edge_at, dz, mask=holds[:, None])
    dh = leaky_backward(product(dz, second, PRECISION), a)
    tl.store(edge_hidden_gradient + edge_at, dh, mask=holds[:, None])
    if FIRST:
        for axis in tl.static_range(3):
            side = tl.where(slot // 2 == axis, 2.0 * (slot % 2) - 1.0, 0.0) * unscale
            tl.atomic_add(totals + own_at + axis * WIDTH + column, tl.sum(dh * side[:, None], 0))
    else:
        de += product(dh, matrix(weights + own_at, WIDTH, WIDTH), PRECISION)
        tl.store(edge_gradient + edge_at, de, mask=there)
    dreceive = tl.sum(tl.reshape(dh, (BLOCK, 8, WIDTH)), 1)
    tl.store(receive_gradient + at, dreceive, mask=here)
    df += product(dreceive, matrix(weights + receive_at, WIDTH, WIDTH), PRECISION)
    tl.store(gradient + at, df, mask=here)
