"""Particle-cell pairs (paper steps 1 and 11), forward and backward: pair FCN, norm, weight and sum in one launch.

Row r of a tile is corner r % 8 of particle r // 8. Sums to cells are atomic additions, whose order, and with it the
last bits, may differ from run to run. Shape legend: N particles, W width.
"""

from __future__ import annotations

import triton
import triton.language as tl

from hgn.kernels.blocks import (
    added,
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


@triton.jit
def _offset(fraction, particle, corner, live, axis: tl.constexpr):
    """Cell centre minus particle, in cells."""
    bit = (corner >> (2 - axis)) & 1
    return bit.to(tl.float32) - tl.load(fraction + particle * 3 + axis, mask=live, other=0.0)


@triton.jit
def pairs_forward(
    by_particle,
    by_cell,
    particle,
    cell_of,
    weight_of,
    fraction,
    count_ptr,
    weights,
    values,
    offset_at,
    second_at,
    second_bias_at,
    gain_at,
    shift_at,
    hidden,
    normalised,
    deviation,
    out,
    TO_CELL: tl.constexpr,
    SAVE: tl.constexpr,
    WIDTH: tl.constexpr,
    PARTICLES: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """TO_CELL: out [C, W] += weight * FCN(by_particle_n + offset). Otherwise out [N, W] = particle + sum over the
    corners of weight * FCN(by_cell_c + by_particle_n - offset). The by_… are products with first-layer weights.

    SAVE keeps what pairs_backward reads: the hidden layer and the normalised output [8 N, W], one over its deviation.
    """
    ROWS: tl.constexpr = PARTICLES * 8
    SUMS: tl.constexpr = 16  # the least that the matrix units take; room for PARTICLES sums and three more
    count = tl.load(count_ptr)
    if tl.program_id(0) * PARTICLES >= count:
        return
    column = tl.arange(0, WIDTH)
    # vectors once: in the loop each would be waited for again
    second_bias = tl.load(values + second_bias_at + column)
    gain, shift = tl.load(values + gain_at + column), tl.load(values + shift_at + column)
    offset_0 = tl.load(values + offset_at + column)
    offset_1 = tl.load(values + offset_at + WIDTH + column)
    offset_2 = tl.load(values + offset_at + 2 * WIDTH + column)
    second = transposed(weights + second_at, WIDTH, WIDTH)
    tile = tl.program_id(0)
    while tile * PARTICLES < count:
        row = tl.arange(0, ROWS)
        owner = tile * PARTICLES + row // 8
        corner = row % 8
        live = owner < count
        here = live[:, None]
        cell = tl.load(cell_of + owner * 8 + corner, mask=live, other=0)
        h = tl.load(by_particle + owner[:, None] * WIDTH + column[None, :], mask=here, other=0.0)
        if not TO_CELL:
            h = added(h, tl.load(by_cell + cell[:, None] * WIDTH + column[None, :], mask=here, other=0.0))
        sign = 1.0 if TO_CELL else -1.0
        h = h.to(tl.float32)
        h += (sign * _offset(fraction, owner, corner, live, 0))[:, None] * inside(offset_0, tile)[None, :]
        h += (sign * _offset(fraction, owner, corner, live, 1))[:, None] * inside(offset_1, tile)[None, :]
        h += (sign * _offset(fraction, owner, corner, live, 2))[:, None] * inside(offset_2, tile)[None, :]
        a = leaky(h)
        pair_at = (owner * 8 + corner)[:, None] * WIDTH + column[None, :]
        if SAVE:
            tl.store(hidden + pair_at, a, mask=here)
        z = product(a, second, PRECISION)
        z, scale = normalise(z + inside(second_bias, tile)[None, :], WIDTH)
        if SAVE:
            tl.store(normalised + pair_at, z, mask=here)
            tl.store(deviation + owner * 8 + corner, scale, mask=live)
        z = z * inside(gain, tile)[None, :] + inside(shift, tile)[None, :]
        weight = tl.load(weight_of + owner * 8 + corner, mask=live, other=0.0)
        z = z * weight[:, None]
        if TO_CELL:
            # a weight of zero points at a cell that may be another's: it adds nothing
            touched = (live & (weight != 0))[:, None]
            tl.atomic_add(out + cell[:, None] * WIDTH + column[None, :], z, mask=touched, sem="relaxed")
        else:
            if PRECISION == "tf32" and not SAVE:
                # as a reduction: rounding the product's operands would cost more
                mine = tile * PARTICLES + tl.arange(0, PARTICLES)
                ends = (mine < count)[:, None]
                summed = tl.sum(tl.reshape(z, (PARTICLES, 8, WIDTH)), 1)
            else:
                mine = tile * PARTICLES + tl.arange(0, SUMS)
                ends = ((tl.arange(0, SUMS) < PARTICLES) & (mine < count))[:, None]
                summed = weighted_sums(members(SUMS, ROWS, 8), z, PRECISION)
            at = mine[:, None] * WIDTH + column[None, :]
            tl.store(out + at, summed + tl.load(particle + at, mask=ends, other=0.0), mask=ends)
        tile += tl.num_programs(0)


@triton.jit
def pairs_backward(
    gradient,
    cell_of,
    weight_of,
    fraction,
    count_ptr,
    weights,
    values,
    totals,
    offset_at,
    second_at,
    gain_at,
    shift_at,
    hidden,
    normalised,
    deviation,
    second_gradient,
    by_particle_gradient,
    by_cell_gradient,
    unscale,
    TO_CELL: tl.constexpr,
    WIDTH: tl.constexpr,
    PARTICLES: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """From the gradient of `out` ([C, W] if TO_CELL, else [N, W]) to those of by_particle, and of by_cell by atomics.

    second_gradient [8 N, W] is left for the weight product.
    """
    ROWS: tl.constexpr = PARTICLES * 8
    SUMS: tl.constexpr = 16  # the least that the matrix units take; room for PARTICLES sums and three more
    count = tl.load(count_ptr)
    if tl.program_id(0) * PARTICLES >= count:
        return
    column = tl.arange(0, WIDTH)
    second = matrix(weights + second_at, WIDTH, WIDTH)
    gain = tl.load(values + gain_at + column)
    sums = tl.arange(0, SUMS)
    gain_total, shift_total = tl.zeros((WIDTH,), tl.float32), tl.zeros((WIDTH,), tl.float32)
    side_total = tl.zeros((SUMS, WIDTH), tl.float32)
    tile = tl.program_id(0)
    while tile * PARTICLES < count:
        row = tl.arange(0, ROWS)
        owner = tile * PARTICLES + row // 8
        corner = row % 8
        live = owner < count
        here = live[:, None]
        pair_at = (owner * 8 + corner)[:, None] * WIDTH + column[None, :]
        cell = tl.load(cell_of + owner * 8 + corner, mask=live, other=0)
        weight = tl.load(weight_of + owner * 8 + corner, mask=live, other=0.0)
        # all loads before the first use: the compiler keeps their order, and waits at the first
        z = tl.load(normalised + pair_at, mask=here, other=0.0)
        a = tl.load(hidden + pair_at, mask=here, other=0.0)
        scale = tl.load(deviation + owner * 8 + corner, mask=live, other=0.0)
        if TO_CELL:
            dy = tl.load(gradient + cell[:, None] * WIDTH + column[None, :], mask=here, other=0.0)
        else:
            dy = tl.load(gradient + owner[:, None] * WIDTH + column[None, :], mask=here, other=0.0)
        dy, z = dy * weight[:, None], z.to(tl.float32)
        gain_total += tl.sum(dy * z, 0)
        shift_total += tl.sum(dy, 0)
        dz = normalise_backward(dy, z, scale, inside(gain, tile), WIDTH)
        tl.store(second_gradient + pair_at, dz, mask=here)
        dh = product(dz, second, PRECISION)
        dh = leaky_backward(dh, a.to(tl.float32))
        if not TO_CELL:
            touched = (live & (weight != 0))[:, None]
            tl.atomic_add(by_cell_gradient + cell[:, None] * WIDTH + column[None, :], dh, mask=touched, sem="relaxed")
        # the sums over a particle's pairs, and in the last rows those of the offsets' weights
        chosen = members(SUMS, ROWS, 8)
        for axis in tl.static_range(3):
            side = _offset(fraction, owner, corner, live, axis)
            chosen = tl.where((sums == SUMS - 3 + axis)[:, None], side[None, :], chosen)
        summed = weighted_sums(chosen, dh, PRECISION)
        mine = tile * PARTICLES + sums
        ends = ((sums < PARTICLES) & (mine < count))[:, None]
        tl.store(by_particle_gradient + mine[:, None] * WIDTH + column[None, :], summed, mask=ends)
        side_total += summed
        tile += tl.num_programs(0)
    tl.atomic_add(totals + gain_at + column, gain_total * unscale, sem="relaxed")
    tl.atomic_add(totals + shift_at + column, shift_total * unscale, sem="relaxed")
    axis = sums[:, None] - (SUMS - 3)
    sign = unscale if TO_CELL else -unscale
    at = totals + offset_at + axis * WIDTH + column[None, :]
    tl.atomic_add(at, side_total * sign, mask=axis >= 0, sem="relaxed")


settle_keys(globals())
