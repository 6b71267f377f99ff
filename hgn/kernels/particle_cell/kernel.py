"""Computes particle-cell pairs (paper steps 1 and 11), forward and backward: MLP, norm, weight and sum in one launch.

Row r of a tile is corner r % 8 of particle r // 8. Atomic additions sum up the parts of a cell. Their order may
differ between runs, and the last bits of the sums may differ too. Shape legend: N particles, W width.
"""

import triton
import triton.language as tl

from hgn.kernels.blocks import (
    added,
    chosen_rows,
    column_sums,
    high_and_low,
    inside,
    leaky_backward,
    leaky_operand,
    matrix,
    members,
    normalise_backward,
    normalise_once,
    product,
    transposed,
    weighted_sums,
)
from hgn.kernels.triton_compat import gdc_launch_dependents, gdc_wait, settle_keys


@triton.jit
def _offset(fraction, particle, corner, live, axis: tl.constexpr):
    """Returns the centre of the cell minus the position of the particle on an axis, in cell edges."""
    bit = (corner >> (2 - axis)) & 1
    return bit.to(tl.float32) - tl.load(fraction + particle * 3 + axis, mask=live, other=0.0)


@triton.jit
def _cell_of(tile, count, cell_of, ROWS: tl.constexpr):
    """Returns the cell of each row of a tile, which may be past the last tile."""
    pair = tile * ROWS + tl.arange(0, ROWS)
    return tl.load(cell_of + pair, mask=(pair >= 0) & (pair < count * 8), other=0)


@triton.jit
def _cells_of(tile, count, cell_of, weight_of, ROWS: tl.constexpr):
    """Returns the cell and the weight of each row of a tile."""
    pair = tile * ROWS + tl.arange(0, ROWS)
    live = pair < count * 8
    return tl.load(cell_of + pair, mask=live, other=0), tl.load(weight_of + pair, mask=live, other=0.0)


@triton.jit
def _particles(by_particle, tile, count, PARTICLES: tl.constexpr, SUMS: tl.constexpr, WIDTH: tl.constexpr):
    """Loads the rows [SUMS, W] of a tile's particles."""
    mine = tile * PARTICLES + tl.arange(0, SUMS)
    there = ((tl.arange(0, SUMS) < PARTICLES) & (mine < count))[:, None]
    return tl.load(by_particle + mine[:, None] * WIDTH + tl.arange(0, WIDTH)[None, :], mask=there, other=0.0)


@triton.jit
def _choice(PARTICLES: tl.constexpr, SUMS: tl.constexpr, SIGN: tl.constexpr):
    """Returns the matrix [8 PARTICLES, SUMS] that chooses a pair's particle.

    Spare columns hold the bits of the pair's corner, for the high and low parts of the offsets' weights (high_and_low).
    """
    ROWS: tl.constexpr = PARTICLES * 8
    spare = tl.arange(0, SUMS) - PARTICLES
    bit = ((tl.arange(0, ROWS) % 8)[:, None] >> (2 - spare % 3)[None, :]) & 1
    sides = tl.where((spare < 6)[None, :], SIGN * bit.to(tl.float32), 0.0)
    return tl.where((spare >= 0)[None, :], sides, chosen_rows(ROWS, 8, SUMS))


@triton.jit
def _first_layer(choice, rows, of_cells, TO_CELL: tl.constexpr, PRECISION: tl.constexpr):
    """Returns the first layer of a tile's pairs [ROWS, W] before its activation.
    The summands are the particles' rows, the offsets' rows, and without TO_CELL the cells' rows [ROWS, W]."""
    if TO_CELL:
        h = product(choice, rows, PRECISION)
    else:
        h = product(choice, rows, PRECISION, of_cells.to(tl.float32))
    return h


@triton.jit
def particle_cell_forward(
    by_particle, by_cell, particle, cell_of, weight_of, count_ptr, weights, values, offset_at, second_at,
    second_bias_at, norm_weight_at, norm_bias_at, hidden, normalised, rstd, out,
    TO_CELL: tl.constexpr, SAVE: tl.constexpr, WIDTH: tl.constexpr, PARTICLES: tl.constexpr,
    PRECISION: tl.constexpr, OVERLAP: tl.constexpr,
):  # fmt: skip
    """Computes the pairs of paper step 1 (TO_CELL) or 11.

    Step 1: out [C, W] += weight * MLP(by_particle_n + offset). Step 11: out [N, W] = particle + sum over the corners of
    weight * MLP(by_cell_c + by_particle_n - offset). by_particle and by_cell are products with first-layer weights.
    by_particle includes the particle's part of the offset, so that the pairs add only the bits of the corner.
    SAVE stores the inputs of particle_cell_backward: the normalised output [8 N, W], `rstd` [8 N] (one over its
    standard deviation), and the hidden layer. With BY_PRODUCT the backward pass computes the hidden layer again.

    Rule: hgn.network.hgn; reference and test: tests/kernels/references.py, test_kernels_alone.py.
    """
    ROWS: tl.constexpr = PARTICLES * 8
    SUMS: tl.constexpr = 16  # PARTICLES sums, three spare places, and padding for the matrix units
    count = tl.load(count_ptr)
    if tl.program_id(0) * PARTICLES >= count:
        return
    column = tl.arange(0, WIDTH)
    # The vectors are loaded once. In the loop each load would be waited for again.
    second_bias = tl.load(values + second_bias_at + column)
    norm_weight, norm_bias = tl.load(values + norm_weight_at + column), tl.load(values + norm_bias_at + column)
    # A matrix copies a particle's row to its pairs, if the product is exact. Its spare columns add the bits' rows.
    BY_PRODUCT: tl.constexpr = PRECISION != "tf32"
    SIGN: tl.constexpr = 1 if TO_CELL else -1
    if BY_PRODUCT:
        choice = _choice(PARTICLES, SUMS, SIGN)
        offsets = high_and_low(values + offset_at, PARTICLES, SUMS, WIDTH, PRECISION)
    else:
        offset_0 = tl.load(values + offset_at + column)
        offset_1 = tl.load(values + offset_at + WIDTH + column)
        offset_2 = tl.load(values + offset_at + 2 * WIDTH + column)
    second = transposed(weights + second_at, WIDTH, WIDTH)
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    tile = tl.program_id(0)
    # Loaded a tile ahead: the weights because they are few, the cells because other loads need them as addresses.
    cell, weight = _cells_of(tile, count, cell_of, weight_of, ROWS)
    if BY_PRODUCT:
        rows = _particles(by_particle, tile, count, PARTICLES, SUMS, WIDTH)
    while tile * PARTICLES < count:
        row = tl.arange(0, ROWS)
        owner = tile * PARTICLES + row // 8
        corner = row % 8
        live = owner < count
        here = live[:, None]
        later = tile + tl.num_programs(0)
        later_cell, later_weight = _cells_of(later, count, cell_of, weight_of, ROWS)
        if BY_PRODUCT:
            mine = tile * PARTICLES + tl.arange(0, SUMS)
            of_cells = rows
            if not TO_CELL:
                of_cells = tl.load(by_cell + cell[:, None] * WIDTH + column[None, :], mask=here, other=0.0)
            h = _first_layer(choice, rows.to(tl.float32) + offsets, of_cells, TO_CELL, PRECISION)
            rows = _particles(by_particle, later, count, PARTICLES, SUMS, WIDTH)
        else:
            h = tl.load(by_particle + owner[:, None] * WIDTH + column[None, :], mask=here, other=0.0)
            if not TO_CELL:
                h = added(h, tl.load(by_cell + cell[:, None] * WIDTH + column[None, :], mask=here, other=0.0))
            h = h.to(tl.float32)
            h += (SIGN * (corner >> 2)).to(tl.float32)[:, None] * inside(offset_0, tile)[None, :]
            h += (SIGN * (corner >> 1 & 1)).to(tl.float32)[:, None] * inside(offset_1, tile)[None, :]
            h += (SIGN * (corner & 1)).to(tl.float32)[:, None] * inside(offset_2, tile)[None, :]
        a = leaky_operand(h, PRECISION)
        pair_at = (owner * 8 + corner)[:, None] * WIDTH + column[None, :]
        if SAVE and not BY_PRODUCT:
            tl.store(hidden + pair_at, a, mask=here)
        z = product(a, second, PRECISION)
        z, row_rstd = normalise_once(z + inside(second_bias, tile)[None, :], WIDTH, PRECISION)
        if SAVE:
            tl.store(normalised + pair_at, z, mask=here)
            tl.store(rstd + owner * 8 + corner, row_rstd, mask=live)
        z = z * inside(norm_weight, tile)[None, :] + inside(norm_bias, tile)[None, :]
        if TO_CELL:
            z = z * weight[:, None]
            # A pair of weight zero may have the index of another cell. It adds nothing.
            touched = (live & (weight != 0))[:, None]
            tl.atomic_add(out + cell[:, None] * WIDTH + column[None, :], z, mask=touched, sem="relaxed")
        else:
            if PRECISION == "tf32" and not SAVE:
                # Here a reduction makes the sum: rounding the operands of a product would cost more.
                mine = tile * PARTICLES + tl.arange(0, PARTICLES)
                ends = (mine < count)[:, None]
                summed = tl.sum(tl.reshape(z * weight[:, None], (PARTICLES, 8, WIDTH)), 1)
            else:
                mine = tile * PARTICLES + tl.arange(0, SUMS)
                ends = ((tl.arange(0, SUMS) < PARTICLES) & (mine < count))[:, None]
                summed = weighted_sums(members(SUMS, ROWS, 8) * weight[None, :], z, PRECISION)
            at = mine[:, None] * WIDTH + column[None, :]
            tl.store(out + at, summed + tl.load(particle + at, mask=ends, other=0.0), mask=ends)
        tile, cell, weight = later, later_cell, later_weight


@triton.jit
def _pairs_of(tile, count, cell_of, weight_of, fraction, ROWS: tl.constexpr):
    """Returns the cell, the weight and the three parts of the offset of each row of a tile."""
    row = tl.arange(0, ROWS)
    owner = tile * (ROWS // 8) + row // 8
    corner = row % 8
    live = owner < count
    cell, weight = _cells_of(tile, count, cell_of, weight_of, ROWS)
    side_0 = _offset(fraction, owner, corner, live, 0)
    side_1 = _offset(fraction, owner, corner, live, 1)
    side_2 = _offset(fraction, owner, corner, live, 2)
    return cell, weight, side_0, side_1, side_2


@triton.jit
def particle_cell_backward(
    gradient, by_particle, by_cell, cell_of, weight_of, fraction, count_ptr, weights, values, totals, offset_at,
    second_at, norm_weight_at, norm_bias_at, hidden, normalised, rstd, second_gradient, by_particle_gradient,
    by_cell_gradient, unscale,
    TO_CELL: tl.constexpr, WIDTH: tl.constexpr, PARTICLES: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Computes the gradients of by_particle and by_cell from that of `out` ([C, W] if TO_CELL, else [N, W]).

    Atomic additions sum up the gradients of by_cell. The kernel stores second_gradient [8 N, W] for the weight
    gradients. If the hidden layer was not stored, the kernel computes it again, to the same bits.

    Rule: hgn.network.hgn; reference and test: tests/kernels/references.py, test_kernels_alone.py.
    """
    ROWS: tl.constexpr = PARTICLES * 8
    SUMS: tl.constexpr = 16  # as in particle_cell_forward
    count = tl.load(count_ptr)
    if tl.program_id(0) * PARTICLES >= count:
        return
    column = tl.arange(0, WIDTH)
    second = matrix(weights + second_at, WIDTH, WIDTH)
    norm_weight = tl.load(values + norm_weight_at + column)
    sums = tl.arange(0, SUMS)
    norm_weight_total, norm_bias_total = tl.zeros((8, WIDTH), tl.float32), tl.zeros((8, WIDTH), tl.float32)
    side_total = tl.zeros((SUMS, WIDTH), tl.float32)
    BY_PRODUCT: tl.constexpr = PRECISION != "tf32"  # as in particle_cell_forward
    if BY_PRODUCT:
        SIGN: tl.constexpr = 1 if TO_CELL else -1
        choice = _choice(PARTICLES, SUMS, SIGN)
    tile = tl.program_id(0)
    # Loaded a tile ahead, because other loads need cells as addresses. As loop variables they take few registers.
    cell, weight, side_0, side_1, side_2 = _pairs_of(tile, count, cell_of, weight_of, fraction, ROWS)
    while tile * PARTICLES < count:
        row = tl.arange(0, ROWS)
        owner = tile * PARTICLES + row // 8
        corner = row % 8
        live = owner < count
        here = live[:, None]
        pair_at = (owner * 8 + corner)[:, None] * WIDTH + column[None, :]
        # All loads come before the first use: the compiler keeps their order, and waits at the first use.
        z = tl.load(normalised + pair_at, mask=here, other=0.0)
        if BY_PRODUCT:
            rows = _particles(by_particle, tile, count, PARTICLES, SUMS, WIDTH)
        else:
            a = tl.load(hidden + pair_at, mask=here, other=0.0)
        row_rstd = tl.load(rstd + owner * 8 + corner, mask=live, other=0.0)
        if TO_CELL:
            dy = tl.load(gradient + cell[:, None] * WIDTH + column[None, :], mask=here, other=0.0)
        else:
            dy = tl.load(gradient + owner[:, None] * WIDTH + column[None, :], mask=here, other=0.0)
        dy, z = dy * weight[:, None], z.to(tl.float32)
        if tile >= 0:  # always true, unknown to the compiler; otherwise it delays these sums and keeps their operands
            norm_weight_total += column_sums(dy * z, ROWS, WIDTH, 8)
            norm_bias_total += column_sums(dy, ROWS, WIDTH, 8)
        dz = normalise_backward(dy, z, row_rstd, inside(norm_weight, tile), WIDTH)
        tl.store(second_gradient + pair_at, dz, mask=here)
        later = _pairs_of(tile + tl.num_programs(0), count, cell_of, weight_of, fraction, ROWS)
        if BY_PRODUCT:
            of_cells = rows
            if not TO_CELL:
                of_cells = tl.load(by_cell + cell[:, None] * WIDTH + column[None, :], mask=here, other=0.0)
        dh = product(dz, second, PRECISION)
        if BY_PRODUCT:
            rows = rows.to(tl.float32) + high_and_low(values + offset_at, PARTICLES, SUMS, WIDTH, PRECISION)
            a = leaky_operand(_first_layer(choice, rows, of_cells, TO_CELL, PRECISION), PRECISION)
        dh = leaky_backward(dh, a.to(tl.float32))
        if not TO_CELL:
            touched = (live & (weight != 0))[:, None]
            tl.atomic_add(by_cell_gradient + cell[:, None] * WIDTH + column[None, :], dh, mask=touched, sem="relaxed")
        # The last three of these sums are the gradients of the offsets' weights. The others are by particle.
        chosen = members(SUMS, ROWS, 8)
        chosen = tl.where((sums == SUMS - 3)[:, None], side_0[None, :], chosen)
        chosen = tl.where((sums == SUMS - 2)[:, None], side_1[None, :], chosen)
        chosen = tl.where((sums == SUMS - 1)[:, None], side_2[None, :], chosen)
        summed = weighted_sums(chosen, dh, PRECISION)
        mine = tile * PARTICLES + sums
        ends = ((sums < PARTICLES) & (mine < count))[:, None]
        tl.store(by_particle_gradient + mine[:, None] * WIDTH + column[None, :], summed, mask=ends)
        side_total += summed
        tile += tl.num_programs(0)
        cell, weight, side_0, side_1, side_2 = later
    tl.atomic_add(totals + norm_weight_at + column, tl.sum(norm_weight_total, 0) * unscale, sem="relaxed")
    tl.atomic_add(totals + norm_bias_at + column, tl.sum(norm_bias_total, 0) * unscale, sem="relaxed")
    axis = sums[:, None] - (SUMS - 3)
    sign = unscale if TO_CELL else -unscale
    at = totals + offset_at + axis * WIDTH + column[None, :]
    tl.atomic_add(at, side_total * sign, mask=axis >= 0, sem="relaxed")


@triton.jit
def _weight_tile(
    total, lines, cell, tile, count, second_gradient, by_particle, by_cell, cell_of, choice, offsets,
    TO_CELL: tl.constexpr, WIDTH: tl.constexpr, PARTICLES: tl.constexpr, SUMS: tl.constexpr,
    PRECISION: tl.constexpr,
):  # fmt: skip
    """Adds a tile's part of the gradients to `total` and `lines`. Returns both and the cells of the next tile."""
    ROWS: tl.constexpr = PARTICLES * 8
    column = tl.arange(0, WIDTH)
    pair = tile * ROWS + tl.arange(0, ROWS)
    here = (pair < count * 8)[:, None]
    dz = tl.load(second_gradient + pair[:, None] * WIDTH + column[None, :], mask=here, other=0.0)
    rows = _particles(by_particle, tile, count, PARTICLES, SUMS, WIDTH)
    of_cells = rows
    if not TO_CELL:
        of_cells = tl.load(by_cell + cell[:, None] * WIDTH + column[None, :], mask=here, other=0.0)
        # The cells are loaded a tile ahead, because other loads need them as addresses.
        cell = _cell_of(tile - tl.num_programs(0), count, cell_of, ROWS)
    a = leaky_operand(_first_layer(choice, rows.to(tl.float32) + offsets, of_cells, TO_CELL, PRECISION), PRECISION)
    lines += column_sums(dz.to(tl.float32), ROWS, WIDTH, 8)
    return product(tl.trans(dz), a, PRECISION, total), lines, cell


@triton.jit
def particle_cell_weight_gradient(
    second_gradient, by_particle, by_cell, cell_of, count_ptr, values, totals, offset_at, second_at,
    second_bias_at, unscale,
    TO_CELL: tl.constexpr, WIDTH: tl.constexpr, PARTICLES: tl.constexpr, PRECISION: tl.constexpr,
    PIPELINED: tl.constexpr,
):  # fmt: skip
    """Computes the gradients of the second layer and its bias, as weight_gradient does.

    It computes a hidden layer that was not stored, to the same bits, from the particles' rows, an eighth of the layer's
    bytes. It begins with the last tile, whose data from particle_cell_backward are still in the L2 cache.
    PIPELINED: a counted loop copies tiles to shared memory two ahead. Triton 3.6's interpreter has no such loops.

    Rule: hgn.network.hgn; reference and test: tests/kernels/references.py, test_kernels_alone.py.
    """
    SUMS: tl.constexpr = 16
    count = tl.load(count_ptr)
    if tl.program_id(0) * PARTICLES >= count:
        return
    column = tl.arange(0, WIDTH)
    SIGN: tl.constexpr = 1 if TO_CELL else -1
    choice = _choice(PARTICLES, SUMS, SIGN)
    offsets = high_and_low(values + offset_at, PARTICLES, SUMS, WIDTH, PRECISION)
    total = tl.zeros((WIDTH, WIDTH), tl.float32)
    lines = tl.zeros((8, WIDTH), tl.float32)
    last = tl.cdiv(count, PARTICLES) - 1
    cell = _cell_of(last - tl.program_id(0), count, cell_of, PARTICLES * 8)
    if PIPELINED:
        for number in tl.range(tl.program_id(0), last + 1, tl.num_programs(0), num_stages=3):
            total, lines, cell = _weight_tile(
                total, lines, cell, last - number, count, second_gradient, by_particle, by_cell, cell_of,
                choice, offsets, TO_CELL, WIDTH, PARTICLES, SUMS, PRECISION,
            )  # fmt: skip
    else:
        tile = last - tl.program_id(0)
        while tile >= 0:
            total, lines, cell = _weight_tile(
                total, lines, cell, tile, count, second_gradient, by_particle, by_cell, cell_of, choice,
                offsets, TO_CELL, WIDTH, PARTICLES, SUMS, PRECISION,
            )  # fmt: skip
            tile -= tl.num_programs(0)
    tl.atomic_add(totals + second_bias_at + column, tl.sum(lines, 0) * unscale, sem="relaxed")
    at = totals + second_at + column[:, None] * WIDTH + column[None, :]
    tl.atomic_add(at, total * unscale, sem="relaxed")


settle_keys(globals())
