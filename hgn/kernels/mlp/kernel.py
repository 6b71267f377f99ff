"""Computes an MLP on rows, forward and backward: the encoder, the decoder, and the steps between levels.

Forward of row r: h = x A + gathered[index_r] + offset_octant + b; a = leaky(h); y = norm(a A2 + b2) (+ x).
Up to two products of y follow for the next kernels, with or without biases. Shape legend: R rows, W width.
"""

import triton
import triton.language as tl

from hgn.kernels.blocks import (
    LAST_TILE,
    finer_product,
    gathered_sum,
    inside,
    leaky,
    leaky_backward,
    listed,
    matrix,
    next_tile,
    normalise,
    normalise_backward,
    optional_vector,
    product,
    transposed,
    vector,
    vectors,
    weighted_sums,
)
from hgn.kernels.triton_compat import gdc_launch_dependents, gdc_wait, settle_keys


@triton.jit
def _shift(values, offset_at, octant, SIGN: tl.constexpr, WIDTH: tl.constexpr):
    """Returns SIGN times the sum over axes of (1/2 - bit) times the offset weights [3, W]. SIGN = 1: to the parent."""
    column = tl.arange(0, WIDTH)
    result = tl.zeros((octant.shape[0], WIDTH), tl.float32)
    for axis in tl.static_range(3):
        bit = (octant >> (2 - axis)) & 1
        weight = tl.load(values + offset_at + axis * WIDTH + column)
        result += (SIGN * (0.5 - bit.to(tl.float32)))[:, None] * weight[None, :]
    return result


@triton.jit
def _rows_of(x, tile, count, INPUT: tl.constexpr, BLOCK: tl.constexpr):
    """Loads a tile's rows of x [R, INPUT]."""
    row = tile * BLOCK + tl.arange(0, BLOCK)
    return tl.load(x + row[:, None] * INPUT + tl.arange(0, INPUT)[None, :], mask=(row < count)[:, None], other=0.0)


@triton.jit
def _three_rows(pointer, WIDTH: tl.constexpr):
    """Loads the matrix [3, W] at `pointer`, padded with zeros to the 16 rows of a product."""
    row = tl.arange(0, 16)
    return tl.load(pointer + row[:, None] * WIDTH + tl.arange(0, WIDTH)[None, :], mask=(row < 3)[:, None], other=0.0)


@triton.jit(do_not_specialize_on_alignment=["count_ptr"])
def mlp_forward(
    x, count_ptr, weights, values, first_weights, first_at, offset_at, bias_at, second_at, second_bias_at,
    norm_weight_at, norm_bias_at, gathered, index, octant, next_at_0, next_at_1, next_bias_at_0, next_bias_at_1,
    fraction, fraction_at_0, fraction_at_1, y, hidden, next_0, next_1,
    INPUT: tl.constexpr, WIDTH: tl.constexpr, OUT: tl.constexpr, GATHER: tl.constexpr, OFFSET: tl.constexpr,
    BIAS: tl.constexpr, NORM: tl.constexpr, RESIDUAL: tl.constexpr, NEXT: tl.constexpr, FRACTION: tl.constexpr,
    SAVE: tl.constexpr, FINE: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr, LOOP: tl.constexpr,
    OVERLAP: tl.constexpr,
):  # fmt: skip
    """Computes y [R, OUT] of x [R, INPUT] by the formula of the module.

    This is the encoder (paper step 0, with the products for steps 1 and 11), the messages to parents (3, 5, …) and from
    them (7, 9, …; GATHER), and the decoder (12). FINE: the MLP's own products are finer than PRECISION, and read the
    unrounded weights. FRACTION: the products of y are the particles' parts of pairs; the particles' fractions [R, 3]
    times the offsets' weights [3, W] are subtracted from the first product and added to the second one.
    LOOP: a program takes many tiles in turn, and reads its weights once. OVERLAP: a program starts before the previous
    launch has ended, and reads weights meanwhile.

    Rule: hgn.network.mlp.MLP; reference and test: tests/kernels/references.py, test_kernels_alone.py.
    """
    count = tl.load(count_ptr)
    if tl.program_id(0) * BLOCK >= count:
        return
    column, outs = tl.arange(0, WIDTH), tl.arange(0, OUT)
    if FRACTION:
        offsets_0 = _three_rows(values + fraction_at_0, WIDTH)
        offsets_1 = _three_rows(values + fraction_at_1, WIDTH)
    IN_PLACE: tl.constexpr = BLOCK > 16 and not LOOP  # loads vectors at their use: registers do not hold all of them
    if LOOP:
        lines = vectors(values, bias_at, next_bias_at_0, next_bias_at_1, bias_at, bias_at, WIDTH)
        bias, next_bias_0, next_bias_1 = vector(lines, 0), vector(lines, 1), vector(lines, 2)
        lines = vectors(values, second_bias_at, norm_weight_at, norm_bias_at, norm_bias_at, norm_bias_at, OUT)
        second_bias, norm_weight, norm_bias = vector(lines, 0), vector(lines, 1), vector(lines, 2)
    elif not IN_PLACE:
        bias = tl.load(values + bias_at + column)
        next_bias_0 = optional_vector(values, next_bias_at_0, WIDTH)
        next_bias_1 = optional_vector(values, next_bias_at_1, WIDTH)
        second_bias = tl.load(values + second_bias_at + outs)
        norm_weight, norm_bias = tl.load(values + norm_weight_at + outs), tl.load(values + norm_bias_at + outs)
    RESIDENT: tl.constexpr = LOOP or (OVERLAP and OUT == WIDTH and not IN_PLACE and not FINE)  # the decoder would spill
    if RESIDENT:
        first = transposed(first_weights + first_at, WIDTH, INPUT)
        second = transposed((values if FINE else weights) + second_at, OUT, WIDTH)
        if NEXT > 0:
            following_0 = transposed(weights + next_at_0, WIDTH, WIDTH)
        if NEXT > 1:
            following_1 = transposed(weights + next_at_1, WIDTH, WIDTH)
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    tile = tl.program_id(0)
    if LOOP:
        x_rows = _rows_of(x, tile, count, INPUT, BLOCK)
    while (tile * BLOCK < count) & (tile < LAST_TILE):
        row = tile * BLOCK + tl.arange(0, BLOCK)
        live = (row < count)[:, None]
        at = row[:, None] * WIDTH + column[None, :]
        if not LOOP:
            x_rows = _rows_of(x, tile, count, INPUT, BLOCK)
        x_tile = x_rows.to(tl.float32)
        if FRACTION:
            part = tl.arange(0, 16)
            fractions = tl.load(fraction + row[:, None] * 3 + part[None, :], mask=live & (part < 3)[None, :], other=0.0)
        if not RESIDENT:
            first = transposed(first_weights + first_at, WIDTH, INPUT)
        h = finer_product(x_tile, first, PRECISION) if FINE else product(x_tile, first, PRECISION)
        if GATHER:
            # A parent past the capacity is -1. The pass is then void, and the kernel reads nothing for the parent.
            where = tl.load(index + row, mask=row < count, other=-1)
            there = (where >= 0)[:, None]
            h += tl.load(gathered + where[:, None] * WIDTH + column[None, :], mask=there, other=0.0).to(tl.float32)
        if OFFSET != 0:
            h += _shift(values, offset_at, tl.load(octant + row, mask=row < count, other=0), OFFSET, WIDTH)
        if BIAS:
            if IN_PLACE:
                bias = tl.load(values + bias_at + column)
            h += inside(bias, tile)[None, :]
        a = leaky(h)
        if SAVE:
            tl.store(hidden + at, a, mask=live)
        if not RESIDENT:
            second = transposed((values if FINE else weights) + second_at, OUT, WIDTH)
        z = finer_product(a, second, PRECISION) if FINE else product(a, second, PRECISION)
        if IN_PLACE:
            second_bias = tl.load(values + second_bias_at + outs)
        z += inside(second_bias, tile)[None, :]
        if NORM:
            z, _rstd = normalise(z, OUT)
            if IN_PLACE:
                norm_weight, norm_bias = tl.load(values + norm_weight_at + outs), tl.load(values + norm_bias_at + outs)
            z = z * inside(norm_weight, tile)[None, :] + inside(norm_bias, tile)[None, :]
        if RESIDUAL:
            z += x_tile
        tl.store(y + row[:, None] * OUT + outs[None, :], z, mask=live)
        if LOOP:
            # This reads the next tile's rows early; a loop has registers for them.
            x_rows = _rows_of(x, tile + tl.num_programs(0), count, INPUT, BLOCK)
        if NEXT > 0:
            if not RESIDENT:
                following_0 = transposed(weights + next_at_0, WIDTH, WIDTH)
            if IN_PLACE:
                next_bias_0 = optional_vector(values, next_bias_at_0, WIDTH)
            if FRACTION:
                later = finer_product(-fractions, offsets_0, PRECISION)
                later = product(z, following_0, PRECISION, later) + inside(next_bias_0, tile)[None, :]
            else:
                later = product(z, following_0, PRECISION) + inside(next_bias_0, tile)[None, :]
            tl.store(next_0 + at, later, mask=live)
        if NEXT > 1:
            if not RESIDENT:
                following_1 = transposed(weights + next_at_1, WIDTH, WIDTH)
            if IN_PLACE:
                next_bias_1 = optional_vector(values, next_bias_at_1, WIDTH)
            if FRACTION:
                later = finer_product(fractions, offsets_1, PRECISION)
                later = product(z, following_1, PRECISION, later) + inside(next_bias_1, tile)[None, :]
            else:
                later = product(z, following_1, PRECISION) + inside(next_bias_1, tile)[None, :]
            tl.store(next_1 + at, later, mask=live)
        tile = next_tile(tile, not LOOP)


@triton.jit(do_not_specialize_on_alignment=["count_ptr"])
def mlp_backward(
    gradient, gradient_index, from_0, from_1, x_gradient, count_ptr, weights, values, totals, first_at,
    offset_at, second_at, second_bias_at, norm_weight_at, norm_bias_at, octant, next_at_0, next_at_1, hidden,
    hidden_gradient, second_gradient, unscale,
    WIDTH: tl.constexpr, OUT: tl.constexpr, GATHER: tl.constexpr, OFFSET: tl.constexpr, NORM: tl.constexpr,
    RESIDUAL: tl.constexpr, NEXT: tl.constexpr, INTO: tl.constexpr, BLOCK: tl.constexpr,
    PRECISION: tl.constexpr,
):  # fmt: skip
    """Computes the gradients of all inputs of mlp_forward.

    The gradient of y is `gradient` (row gradient_index_r if GATHER). With NEXT the part through the products of y is
    added, from their gradients from_0 and from_1. INTO: 0 no gradient of x, 1 write it, 2 add it. The gradients of norm
    and offset weights are multiplied by `unscale` and added to `totals`. The kernel stores hidden_gradient and
    second_gradient, from which other kernels compute the gradients of the weights.

    Rule: hgn.network.mlp.MLP; reference and test: tests/kernels/references.py, test_kernels_alone.py.
    """
    count = tl.load(count_ptr)
    if tl.program_id(0) * BLOCK >= count:
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = (row < count)[:, None]
    column = tl.arange(0, WIDTH)
    outs = tl.arange(0, OUT)
    at = row[:, None] * WIDTH + column[None, :]
    out_at = row[:, None] * OUT + outs[None, :]
    if GATHER:
        where = tl.load(gradient_index + row, mask=row < count, other=-1)
        there = (where >= 0)[:, None]
        dy = tl.load(gradient + where[:, None] * OUT + outs[None, :], mask=there, other=0.0).to(tl.float32)
    else:
        dy = tl.load(gradient + out_at, mask=live, other=0.0).to(tl.float32)
    if NEXT > 0:
        tile = tl.load(from_0 + at, mask=live, other=0.0).to(tl.float32)
        dy += product(tile, matrix(weights + next_at_0, WIDTH, WIDTH), PRECISION)
    if NEXT > 1:
        tile = tl.load(from_1 + at, mask=live, other=0.0).to(tl.float32)
        dy += product(tile, matrix(weights + next_at_1, WIDTH, WIDTH), PRECISION)
    a = tl.load(hidden + at, mask=live, other=0.0).to(tl.float32)
    if NORM:
        z = product(a, transposed(weights + second_at, OUT, WIDTH), PRECISION)
        z += tl.load(values + second_bias_at + outs)[None, :]
        normalised, rstd = normalise(z, OUT)
        summand = tl.arange(0, 16)[:, None]  # 16 is the smallest size of the matrix units
        whole = tl.where((summand == 0) & live.trans(), 1.0, 0.0)
        at_norm_weight = totals + norm_weight_at + summand * OUT + outs[None, :]
        at_norm_bias = totals + norm_bias_at + summand * OUT + outs[None, :]
        tl.atomic_add(at_norm_weight, weighted_sums(whole, dy * normalised, PRECISION) * unscale, mask=summand < 1)
        tl.atomic_add(at_norm_bias, weighted_sums(whole, dy, PRECISION) * unscale, mask=summand < 1)
        dz = normalise_backward(dy, normalised, rstd, tl.load(values + norm_weight_at + outs), OUT)
    else:
        dz = dy
    dz = tl.where(live, dz, 0.0)
    tl.store(second_gradient + out_at, dz, mask=live)
    dh = leaky_backward(product(dz, matrix(weights + second_at, OUT, WIDTH), PRECISION), a)
    tl.store(hidden_gradient + at, dh, mask=live)
    if OFFSET != 0:
        code = tl.load(octant + row, mask=row < count, other=0)[None, :]
        axis = tl.arange(0, 16)[:, None]
        side = OFFSET * (0.5 - ((code >> tl.maximum(2 - axis, 0)) & 1).to(tl.float32))
        sides = weighted_sums(side, dh, PRECISION) * unscale
        tl.atomic_add(totals + offset_at + axis * WIDTH + column[None, :], sides, mask=axis < 3)
    if INTO > 0:
        dx = product(dh, matrix(weights + first_at, WIDTH, WIDTH), PRECISION)
        if RESIDUAL:
            dx += dy
        if INTO > 1:
            dx += tl.load(x_gradient + at, mask=live, other=0.0)
        tl.store(x_gradient + at, dx, mask=live)


@triton.jit(do_not_specialize_on_alignment=["count_ptr"])
def clear_rows(x, count_ptr, WIDTH: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr):
    """Sets the rows of x [.., W] that are in use to zero. The capacity may be twice as large.

    Rule: hgn.network.mlp.MLP; reference and test: tests/kernels/references.py, test_kernels_alone.py.
    """
    count = tl.load(count_ptr)
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    zeros = tl.zeros((BLOCK, WIDTH), x.dtype.element_ty)
    tl.store(x + row[:, None] * WIDTH + tl.arange(0, WIDTH)[None, :], zeros, mask=(row < count)[:, None])
    if OVERLAP:
        gdc_wait()  # earlier kernels do not use these rows, but the next kernel relies on the end of all earlier ones


@triton.jit(do_not_specialize_on_alignment=["count_ptr"])
def gather_sums(
    x, table, count_ptr, y, capacity,
    SUM: tl.constexpr, EDGES: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Computes y: each row is the sum of the rows of x that the table [SUM, capacity] lists (-1: none).

    This kernel is for many rows. Its programs are small, so that many of them wait for memory at the same time. A
    kernel with products has registers for only two summands at a time.

    Rule: hgn.network.mlp.MLP; reference and test: tests/kernels/references.py, test_kernels_alone.py.
    """
    count = tl.load(count_ptr)
    if tl.program_id(0) * BLOCK >= count:
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    column = tl.arange(0, WIDTH)
    summands = listed(table, row, count, capacity, SUM, EDGES)
    tile = gathered_sum(x, summands, SUM, WIDTH, BLOCK)
    tl.store(y + row[:, None] * WIDTH + column[None, :], tile, mask=(row < count)[:, None])


@triton.jit(do_not_specialize_on_alignment=["count_ptr"])
def gather_project(
    x, table, count_ptr, weights, values, at_0, at_1, bias_at, y, next_0, next_1, capacity,
    SUM: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr, LOOP: tl.constexpr,
    OVERLAP: tl.constexpr,
):  # fmt: skip
    """Computes y and two products of y, the second one with a bias.

    y is x, or with SUM > 0 the sum of x's rows in the table [SUM, capacity] (-1: none). LOOP, OVERLAP: see mlp_forward.

    Rule: hgn.network.mlp.MLP; reference and test: tests/kernels/references.py, test_kernels_alone.py.
    """
    count = tl.load(count_ptr)
    if tl.program_id(0) * BLOCK >= count:
        return
    column = tl.arange(0, WIDTH)
    bias = tl.load(values + bias_at + column)
    RESIDENT: tl.constexpr = LOOP or (OVERLAP and BLOCK <= 16)
    if RESIDENT:
        first = transposed(weights + at_0, WIDTH, WIDTH)
        second = transposed(weights + at_1, WIDTH, WIDTH)
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    tile = tl.program_id(0)
    if SUM == 0:
        rows = _rows_of(x, tile, count, WIDTH, BLOCK)
    while (tile * BLOCK < count) & (tile < LAST_TILE):
        row = tile * BLOCK + tl.arange(0, BLOCK)
        live = (row < count)[:, None]
        at = row[:, None] * WIDTH + column[None, :]
        if SUM > 0:
            rows = gathered_sum(x, listed(table, row, count, capacity, SUM, False), SUM, WIDTH, BLOCK)
            tl.store(y + at, rows, mask=live)
        if not RESIDENT:
            first = transposed(weights + at_0, WIDTH, WIDTH)
        tl.store(next_0 + at, product(rows, first, PRECISION), mask=live)
        if not RESIDENT:
            second = transposed(weights + at_1, WIDTH, WIDTH)
        result = product(rows, second, PRECISION)
        if LOOP:
            # This reads the next tile's rows early; a loop has registers for them.
            rows = _rows_of(x, tile + tl.num_programs(0), count, WIDTH, BLOCK)
        tl.store(next_1 + at, result + inside(bias, tile)[None, :], mask=live)
        tile = next_tile(tile, not LOOP)


@triton.jit(do_not_specialize_on_alignment=["count_ptr"])
def gather_project_backward(
    x, table, count_ptr, weights, at_0, summed, other, other_at, gradient, capacity,
    SUM: tl.constexpr, EDGES: tl.constexpr, ADD: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr,
    PRECISION: tl.constexpr,
):  # fmt: skip
    """Computes summed = x, or the sum of x's rows that the table [SUM, capacity] lists; and gradient (+)= summed A.

    A are weights. With EDGES x is [capacity, SUM, W], and each listed row gives its entry of the opposite direction
    (`listed`). The product of `other` [capacity, W] with its own weights is then added to the gradient.

    Rule: hgn.network.mlp.MLP; reference and test: tests/kernels/references.py, test_kernels_alone.py.
    """
    count = tl.load(count_ptr)
    if tl.program_id(0) * BLOCK >= count:
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = (row < count)[:, None]
    column = tl.arange(0, WIDTH)
    at = row[:, None] * WIDTH + column[None, :]
    if SUM == 0:
        tile = tl.load(x + at, mask=live, other=0.0).to(tl.float32)
    else:
        tile = gathered_sum(x, listed(table, row, count, capacity, SUM, EDGES), SUM, WIDTH, BLOCK)
    tl.store(summed + at, tile, mask=live)
    result = product(tile, matrix(weights + at_0, WIDTH, WIDTH), PRECISION)
    if EDGES:
        tile = tl.load(other + at, mask=live, other=0.0).to(tl.float32)
        result += product(tile, matrix(weights + other_at, WIDTH, WIDTH), PRECISION)
    if ADD:
        result += tl.load(gradient + at, mask=live, other=0.0)
    tl.store(gradient + at, result, mask=live)


settle_keys(globals())
