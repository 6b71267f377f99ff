"""Computes the cells of one message passing step on a level (paper fig. 5), after its edges; forward and backward.

OVERLAP means the same as in hgn.kernels.edges.kernel. Shape legend: C cells, W width.
"""

import triton
import triton.language as tl

from hgn.kernels.blocks import (
    LAST_TILE,
    gathered_sum,
    inside,
    leaky_backward,
    leaky_operand,
    listed,
    matrix,
    next_tile,
    normalise_backward,
    normalise_once,
    nothing_to_do,
    once_both,
    product,
    transposed,
    vector,
    vectors,
    weighted_sums,
)
from hgn.kernels.triton_compat import gdc_launch_dependents, gdc_wait, settle_keys


@triton.jit(do_not_specialize_on_alignment=["count_ptr"])
def cell_mlp_forward(
    cell, total, count_ptr, weights, values, first_at, sum_first_at, bias_at, second_at, second_bias_at,
    norm_weight_at, norm_bias_at, next_at_0, next_at_1, next_bias_at, cell_out, hidden, normalised, rstd,
    next_0, next_1,
    NEXT: tl.constexpr, SAVE: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr,
    RESIDENT: tl.constexpr, LOOP: tl.constexpr, OVERLAP: tl.constexpr,
):  # fmt: skip
    """Computes paper steps 2, 4, … (fig. 5): the cells' new features and up to two products of them, all [C, W].

    The inputs are the cells' old features and the sums of their edges. The second product has a bias. RESIDENT: the
    program reads all weights before the first tile and keeps them. LOOP: a program has more than one tile.

    Rule: hgn.network.hgn.MessagePassing; reference and test: tests/kernels/references.py, test_kernels_alone.py.
    """
    if OVERLAP:
        gdc_launch_dependents()
    count = tl.load(count_ptr)
    if nothing_to_do(count, BLOCK):
        return
    column = tl.arange(0, WIDTH)
    IN_PLACE: tl.constexpr = BLOCK > 16 and not LOOP  # loads vectors at their use: registers do not hold all of them
    if LOOP:
        lines = vectors(values, bias_at, second_bias_at, norm_weight_at, norm_bias_at, next_bias_at, WIDTH)
        bias, second_bias, norm_weight, norm_bias = (
            vector(lines, 0),
            vector(lines, 1),
            vector(lines, 2),
            vector(lines, 3),
        )
        next_bias = vector(lines, 4)
    elif not IN_PLACE:
        bias, second_bias = tl.load(values + bias_at + column), tl.load(values + second_bias_at + column)
        norm_weight, norm_bias = tl.load(values + norm_weight_at + column), tl.load(values + norm_bias_at + column)
        next_bias = tl.load(values + next_bias_at + column)
    if RESIDENT:
        first = transposed(weights + first_at, WIDTH, WIDTH)
        sum_first = transposed(weights + sum_first_at, WIDTH, WIDTH)
        second = transposed(weights + second_at, WIDTH, WIDTH)
        if NEXT > 0:
            following_0 = transposed(weights + next_at_0, WIDTH, WIDTH)
        if NEXT > 1:
            following_1 = transposed(weights + next_at_1, WIDTH, WIDTH)
    tile = tl.program_id(0)
    while (tile * BLOCK < count) & (tile < LAST_TILE):
        if OVERLAP:
            gdc_wait()
        row = tile * BLOCK + tl.arange(0, BLOCK)
        here = (row < count)[:, None]
        at = row[:, None] * WIDTH + column[None, :]
        feature = tl.load(cell + at, mask=here, other=0.0)
        summed = tl.load(total + at, mask=here, other=0.0)
        if not IN_PLACE:
            feature = once_both(feature, summed, count < 0)
        if not RESIDENT:
            first = transposed(weights + first_at, WIDTH, WIDTH)
        h = product(feature, first, PRECISION)
        if not RESIDENT:
            sum_first = transposed(weights + sum_first_at, WIDTH, WIDTH)
        h += product(summed, sum_first, PRECISION)
        if IN_PLACE:
            bias = tl.load(values + bias_at + column)
        a = leaky_operand(h + inside(bias, tile)[None, :], PRECISION)
        if not RESIDENT:
            second = transposed(weights + second_at, WIDTH, WIDTH)
        z = product(a, second, PRECISION)
        if IN_PLACE:
            second_bias = tl.load(values + second_bias_at + column)
        z, row_rstd = normalise_once(z + inside(second_bias, tile)[None, :], WIDTH, PRECISION)
        if SAVE:
            tl.store(hidden + at, a, mask=here)
            tl.store(normalised + at, z, mask=here)
            tl.store(rstd + row, row_rstd, mask=row < count)
        if IN_PLACE:
            norm_weight, norm_bias = tl.load(values + norm_weight_at + column), tl.load(values + norm_bias_at + column)
        feature = feature.to(tl.float32) + (z * inside(norm_weight, tile)[None, :] + inside(norm_bias, tile)[None, :])
        tl.store(cell_out + at, feature, mask=here)
        if NEXT > 0:
            if not RESIDENT:
                following_0 = transposed(weights + next_at_0, WIDTH, WIDTH)
            tl.store(next_0 + at, product(feature, following_0, PRECISION), mask=here)
        if NEXT > 1:
            if not RESIDENT:
                following_1 = transposed(weights + next_at_1, WIDTH, WIDTH)
            if IN_PLACE:
                next_bias = tl.load(values + next_bias_at + column)
            z = product(feature, following_1, PRECISION) + inside(next_bias, tile)[None, :]
            tl.store(next_1 + at, z, mask=here)
        tile = next_tile(tile, IN_PLACE)
    if OVERLAP:
        gdc_wait()


@triton.jit(do_not_specialize_on_alignment=["count_ptr"])
def cell_mlp_backward(
    gradient, later_hidden_gradient, later_receive_gradient, neighbour, count_ptr, weights, values, totals,
    later_send_at, later_receive_at, first_at, sum_first_at, second_at, norm_weight_at, norm_bias_at, hidden,
    normalised, rstd, send_gradient, hidden_gradient, second_gradient, sum_gradient, capacity, unscale,
    LAST: tl.constexpr, GATHER: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr,
    RESIDENT: tl.constexpr, OVERLAP: tl.constexpr,
):  # fmt: skip
    """Replaces the gradient of cell_out in `gradient` [C, W] by that of `cell`.

    The incoming gradient lacks the parts through `send` and `receive` of the next step. The kernel adds them unless
    LAST. The outgoing gradient lacks the parts through `send` and `receive` of this step. send_gradient is the gradient
    through edges that start in a cell; without GATHER an earlier kernel has computed it. sum_gradient [C, W] is the
    gradient of the edges' sums. RESIDENT means the same as in cell_mlp_forward.

    Rule: hgn.network.hgn.MessagePassing; reference and test: tests/kernels/references.py, test_kernels_alone.py.
    """
    if OVERLAP:
        gdc_launch_dependents()
    count = tl.load(count_ptr)
    if nothing_to_do(count, BLOCK):
        return
    column = tl.arange(0, WIDTH)
    EARLY: tl.constexpr = BLOCK <= 16  # small tiles have registers to load everything first
    if EARLY:
        norm_weight = tl.load(values + norm_weight_at + column)
    if RESIDENT:
        if not LAST:
            later_send = matrix(weights + later_send_at, WIDTH, WIDTH)
            later_receive = matrix(weights + later_receive_at, WIDTH, WIDTH)
        second = matrix(weights + second_at, WIDTH, WIDTH)
        sum_first = matrix(weights + sum_first_at, WIDTH, WIDTH)
        first = matrix(weights + first_at, WIDTH, WIDTH)
    sums = tl.arange(0, 16)[:, None]  # one of these sums is used; 16 is the smallest size of the matrix units
    norm_weight_total, norm_bias_total = tl.zeros((16, WIDTH), tl.float32), tl.zeros((16, WIDTH), tl.float32)
    tile = tl.program_id(0)
    while (tile * BLOCK < count) & (tile < LAST_TILE):
        row = tile * BLOCK + tl.arange(0, BLOCK)
        here = (row < count)[:, None]
        at = row[:, None] * WIDTH + column[None, :]
        if not LAST and GATHER:
            summands = listed(neighbour, row, count, capacity, 6, True)
        if OVERLAP:
            gdc_wait()
        df = tl.load(gradient + at, mask=here, other=0.0)
        if EARLY:
            z = tl.load(normalised + at, mask=here, other=0.0)
            row_rstd = tl.load(rstd + row, mask=row < count, other=0.0)
            a = tl.load(hidden + at, mask=here, other=0.0)
            if not LAST:
                received = tl.load(later_receive_gradient + at, mask=here, other=0.0)
        if not LAST:
            if GATHER:
                # Edges that start in a cell are stored with their receivers, under the opposite direction.
                sent = gathered_sum(later_hidden_gradient, summands, 6, WIDTH, BLOCK)
                tl.store(send_gradient + at, sent, mask=here)
            else:
                sent = tl.load(send_gradient + at, mask=here, other=0.0)
            if not RESIDENT:
                later_send = matrix(weights + later_send_at, WIDTH, WIDTH)
            df += product(sent, later_send, PRECISION)
            if not EARLY:
                received = tl.load(later_receive_gradient + at, mask=here, other=0.0)
            if not RESIDENT:
                later_receive = matrix(weights + later_receive_at, WIDTH, WIDTH)
            df += product(received, later_receive, PRECISION)
        if not EARLY:
            z = tl.load(normalised + at, mask=here, other=0.0)
            row_rstd = tl.load(rstd + row, mask=row < count, other=0.0)
        z = z.to(tl.float32)
        whole = tl.where((sums == 0) & (row < count)[None, :], 1.0, 0.0)
        if tile >= 0:  # as in hgn.kernels.edges.kernel.edge_backward
            norm_weight_total += weighted_sums(whole, df * z, PRECISION)
            norm_bias_total += weighted_sums(whole, df, PRECISION)
        if not EARLY:
            norm_weight = tl.load(values + norm_weight_at + column)
        dz = normalise_backward(df, z, row_rstd, inside(norm_weight, tile), WIDTH)
        tl.store(second_gradient + at, dz, mask=here)
        if not RESIDENT:
            second = matrix(weights + second_at, WIDTH, WIDTH)
        dh = product(dz, second, PRECISION)
        if not EARLY:
            a = tl.load(hidden + at, mask=here, other=0.0)
        dh = leaky_backward(dh, a.to(tl.float32))
        tl.store(hidden_gradient + at, dh, mask=here)
        if not RESIDENT:
            sum_first = matrix(weights + sum_first_at, WIDTH, WIDTH)
        tl.store(sum_gradient + at, product(dh, sum_first, PRECISION), mask=here)
        if not RESIDENT:
            first = matrix(weights + first_at, WIDTH, WIDTH)
        df += product(dh, first, PRECISION)
        tl.store(gradient + at, df, mask=here)
        tile = next_tile(tile, not EARLY)
    if OVERLAP:
        gdc_wait()
    at_norm_weight = totals + norm_weight_at + sums * WIDTH + column[None, :]
    at_norm_bias = totals + norm_bias_at + sums * WIDTH + column[None, :]
    tl.atomic_add(at_norm_weight, norm_weight_total * unscale, mask=sums < 1, sem="relaxed")
    tl.atomic_add(at_norm_bias, norm_bias_total * unscale, mask=sums < 1, sem="relaxed")


settle_keys(globals())
