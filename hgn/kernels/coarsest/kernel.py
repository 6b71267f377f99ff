"""What the coarsest cells add to the accelerations of relative inputs, so that momentum holds, and its gradient.

Shape legend: N particles, C coarsest cells; geometry as in hgn.kernels.geometry.
"""

from __future__ import annotations

import triton
import triton.language as tl

from hgn.kernels.geometry import FULLY, GEOMETRY_COLUMNS
from hgn.kernels.triton_compat import settle_keys


@triton.jit
def _coarsest_cells(cell_of, parent, geometry, row, here, LEVELS: tl.constexpr):
    """The coarsest cells above the particles' eight, [N, 8]."""
    cell = tl.load(cell_of + row[:, None] * 8 + tl.arange(0, 8)[None, :], mask=here, other=0)
    for level in tl.static_range(LEVELS - 1):
        first = tl.load(geometry + level * GEOMETRY_COLUMNS + 6)
        # a parent past the capacity: the frame is void, but nothing may be read out of bounds
        cell = tl.maximum(tl.load(parent + first + cell, mask=here, other=0), 0)
    return cell


@triton.jit
def sum_coarsest(
    x, cell_of, weight_of, parent, neighbour, geometry, counts, disturbed, felt, sums, particle_count, capacity,
    LEVELS: tl.constexpr, OUT: tl.constexpr, USED: tl.constexpr, FEEL: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adds the first USED columns of the particles' rows of x [N, OUT] to their coarsest cells' sums [C, OUT], with
    their weights. With FEEL felt [C, 2] is how disturbed and how touched a coarsest cell and those across its faces are
    at most, 0 to 1. Programs for as many particles as for coarsest cells.

    Reference: hgn.network.relative.balanced and disturbance; test: tests/kernels/test_relative.py.
    """
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    if FEEL:
        there = row < tl.load(counts + LEVELS - 1)
        part = tl.arange(0, 2)[None, :]
        most = tl.load(disturbed + row[:, None] * 2 + part, mask=there[:, None], other=0)
        for slot in tl.static_range(6):
            other = tl.load(neighbour + slot * capacity + row, mask=there, other=-1)[:, None]
            most = tl.maximum(most, tl.load(disturbed + other * 2 + part, mask=other >= 0, other=0))
        tl.store(felt + row[:, None] * 2 + part, most.to(tl.float32) / FULLY, mask=there[:, None])
    count = tl.load(particle_count)
    if tl.program_id(0) * BLOCK >= count:
        return
    live = row < count
    corner = tl.arange(0, 8)[None, :]
    here = live[:, None] & (corner >= 0)
    cell = _coarsest_cells(cell_of, parent, geometry, row, here, LEVELS)
    weight = tl.load(weight_of + row[:, None] * 8 + corner, mask=here, other=0.0)
    # most of a particle's cells lie below one: only the first of them adds, for all
    same = cell[:, :, None] == cell[:, None, :]
    earlier = same & (tl.arange(0, 8)[None, None, :] < tl.arange(0, 8)[None, :, None])
    share = tl.sum(tl.where(same, weight[:, None, :], 0.0), 2)
    share = tl.where(tl.max(earlier.to(tl.int32), 2) > 0, 0.0, share)
    column = tl.arange(0, OUT)[None, :]
    value = tl.load(x + row[:, None] * OUT + column, mask=live[:, None] & (column < USED), other=0.0)
    adds = (share > 0)[:, :, None] & (column < USED)[:, None, :]
    at = sums + cell[:, :, None] * OUT + column[:, None, :]
    tl.atomic_add(at, share[:, :, None] * value[:, None, :], mask=adds, sem="relaxed")


@triton.jit
def balance_cells(
    sums, felt, motion, neighbour, geometry, counts, table, capacity,
    LEVELS: tl.constexpr, OUT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """What the coarsest cells add to their particles' accelerations, and how disturbed they are, in columns 0 to 3 of
    table [C, OUT]; of the sums of what particles put out.

    Reference: hgn.network.relative.balanced; test: tests/kernels/test_relative.py.
    """
    count = tl.load(counts + LEVELS - 1)
    if tl.program_id(0) * BLOCK >= count:
        return
    cell, there, mass, inverse, disturbed, touched = _coarsest_of(felt, motion, geometry, count, LEVELS, BLOCK)
    column = tl.arange(0, 4)[None, :]
    used = there[:, None] & (column < 3)
    change = -(1 - touched)[:, None] * inverse[:, None] * tl.load(sums + cell[:, None] * OUT + column, used, other=0.0)
    for slot in tl.static_range(6):
        axis = slot // 2
        stress = tl.where(column == axis, 3 + axis, 9 - column - axis)  # of xx, yy, zz, yz, xz, xy behind the three
        own = tl.load(sums + cell[:, None] * OUT + stress, mask=used, other=0.0) * inverse[:, None]
        other, share, beside = _across(neighbour, felt, motion, geometry, cell, there, mass, slot, capacity, LEVELS)
        theirs = tl.load(sums + other[:, None] * OUT + stress, mask=used & (other >= 0)[:, None], other=0.0)
        change += share[:, None] * (own + theirs * beside[:, None])
    value = tl.where(column < 3, disturbed[:, None] * change, disturbed[:, None])
    tl.store(table + cell[:, None] * OUT + column, value, mask=there[:, None])


@triton.jit
def balance_cells_backward(
    sums, felt, motion, neighbour, geometry, counts, table, capacity,
    LEVELS: tl.constexpr, OUT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """What the coarsest cells add to the gradients of their particles' outputs, and how disturbed they are, in columns
    0 to 9 of table [C, OUT]; of the sums of the gradients of what `balance_cells` leads to.

    Reference: hgn.network.relative.balanced; test: tests/kernels/test_relative.py.
    """
    count = tl.load(counts + LEVELS - 1)
    if tl.program_id(0) * BLOCK >= count:
        return
    cell, there, mass, inverse, disturbed, touched = _coarsest_of(felt, motion, geometry, count, LEVELS, BLOCK)
    column = tl.arange(0, OUT)[None, :]
    mean = there[:, None] & (column < 3)
    value = -(1 - touched)[:, None] * tl.load(sums + cell[:, None] * OUT + column, mask=mean, other=0.0)
    for slot in tl.static_range(6):
        axis = slot // 2
        # the component of the force that a column of stress makes across this face
        part = tl.where(column == 3 + axis, axis, 9 - axis - column)
        makes = (column == 3 + axis) | ((column >= 6) & (column < 9) & (part >= 0) & (part < 3) & (part != axis))
        makes = there[:, None] & makes
        own = tl.load(sums + cell[:, None] * OUT + part, mask=makes, other=0.0)
        other, share, beside = _across(neighbour, felt, motion, geometry, cell, there, mass, slot, capacity, LEVELS)
        theirs = tl.load(sums + other[:, None] * OUT + part, mask=makes & (other >= 0)[:, None], other=0.0)
        value += share[:, None] * (own - mass[:, None] * beside[:, None] * theirs)
    value = tl.where(column == 9, disturbed[:, None], (disturbed * inverse)[:, None] * value)
    tl.store(table + cell[:, None] * OUT + column, value, mask=there[:, None])


@triton.jit
def _coarsest_of(felt, motion, geometry, count, LEVELS: tl.constexpr, BLOCK: tl.constexpr):
    """This program's coarsest cells: their masses, one over these, disturbed and touched, [BLOCK] each."""
    cell = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = cell < count
    mass = _mass(motion, geometry, cell, there, LEVELS)
    disturbed = tl.load(felt + cell * 2, mask=there, other=0.0)
    return cell, there, mass, _inverse(mass), disturbed, tl.load(felt + cell * 2 + 1, mask=there, other=0.0)


@triton.jit
def _mass(motion, geometry, cell, there, LEVELS: tl.constexpr):
    first = tl.load(geometry + (LEVELS - 1) * GEOMETRY_COLUMNS + 6)
    return tl.load(motion + (first + cell) * 4, mask=there, other=0.0)


@triton.jit
def _inverse(mass):
    """One over it, 0 of 0."""
    return tl.where(mass > 0, 1 / tl.where(mass > 0, mass, 1.0), 0.0)


@triton.jit
def _across(
    neighbour, felt, motion, geometry, cell, there, mass, slot: tl.constexpr, capacity, LEVELS: tl.constexpr
):  # fmt: skip
    """Of the cells across a face: their numbers, half their share of both masses as far as they are disturbed, with the
    sign of the direction, and one over their masses."""
    other = tl.load(neighbour + slot * capacity + cell, mask=there, other=-1)
    beside = _mass(motion, geometry, other, other >= 0, LEVELS)
    disturbed = tl.load(felt + other * 2, mask=other >= 0, other=0.0)
    half: tl.constexpr = 0.5 - slot % 2
    share = half * disturbed * beside / tl.where(beside > 0, mass + beside, 1.0)
    return other, share, _inverse(beside)


@triton.jit
def add_coarsest(
    x, table, cell_of, weight_of, parent, geometry, particle_count,
    LEVELS: tl.constexpr, OUT: tl.constexpr, USED: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Multiplies columns 0 to 2 of the particles' rows of x [N, OUT] by column USED of the coarsest cells' table
    [C, OUT], and adds its columns before that, each with the particles' weights. COLUMNS: a power of two above USED.

    Reference: hgn.network.relative.balanced; test: tests/kernels/test_relative.py.
    """
    count = tl.load(particle_count)
    if tl.program_id(0) * BLOCK >= count:
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    corner = tl.arange(0, 8)[None, :]
    here = (row < count)[:, None] & (corner >= 0)
    cell = _coarsest_cells(cell_of, parent, geometry, row, here, LEVELS)
    weight = tl.load(weight_of + row[:, None] * 8 + corner, mask=here, other=0.0)
    column = tl.arange(0, COLUMNS)[None, :]
    at = table + cell[:, :, None] * OUT + column[:, None, :]
    found = tl.load(at, mask=here[:, :, None] & (column <= USED)[:, None, :], other=0.0)
    total = tl.sum(weight[:, :, None] * found, 1)
    factor = tl.sum(tl.where(column == USED, total, 0.0), 1)
    live = (row < count)[:, None]
    at = x + row[:, None] * OUT + column
    total += factor[:, None] * tl.load(at, mask=live & (column < 3), other=0.0)
    tl.store(at, total, mask=live & (column < USED))


settle_keys(globals())
