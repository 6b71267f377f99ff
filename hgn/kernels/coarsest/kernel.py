"""What the coarsest cells add to the accelerations of relative inputs, so that momentum holds, and its gradient.

Shape legend: N particles, C coarsest cells; geometry as in hgn.kernels.geometry.
"""

from __future__ import annotations

import triton
import triton.language as tl

from hgn.kernels.geometry import GEOMETRY_COLUMNS, most_around, split_slot
from hgn.kernels.triton_compat import gdc_launch_dependents, gdc_wait, settle_keys
from hgn.network.relative import OUTPUTS, POINT, THIN
from hgn.network.rest import LEAST, SURE

THINNEST, SMALLEST = tl.constexpr(THIN), tl.constexpr(POINT)  # of a cell's contents, for a rotation to be known
DECODED = tl.constexpr(OUTPUTS)
RATES = tl.constexpr(8)  # columns of what `rest` sums up and spreads
SURELY, TINY = tl.constexpr(SURE), tl.constexpr(LEAST)


@triton.jit
def _coarsest_cells(coarsest_of, share_of, row, live):
    """The particles' coarsest cells, each once and -1 elsewhere, and their shares of these, [N, 8] each."""
    at = row[:, None] * 8 + tl.arange(0, 8)[None, :]
    cell = tl.load(coarsest_of + at, mask=live[:, None], other=-1)
    return cell, tl.load(share_of + at, mask=cell >= 0, other=0.0)


@triton.jit
def _coarsest_places(place_of, row, live):
    """Where particles are in these cells, three [N, 8]: from the cells' middles, in edges."""
    corner = tl.arange(0, 8)[None, :]
    at = place_of + row * 3
    x = tl.load(at, mask=live, other=0.0)[:, None] - (corner >> 2 & 1).to(tl.float32)
    y = tl.load(at + 1, mask=live, other=0.0)[:, None] - (corner >> 1 & 1).to(tl.float32)
    return x, y, tl.load(at + 2, mask=live, other=0.0)[:, None] - (corner & 1).to(tl.float32)


@triton.jit
def sum_coarsest(
    x, coarsest_of, share_of, place_of, neighbour, counts, disturbed, felt, sums, particle_count, capacity,
    LEVELS: tl.constexpr, OUT: tl.constexpr, USED: tl.constexpr, FEEL: tl.constexpr,
    OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adds the first USED columns of the particles' rows of x [N, OUT] to their coarsest cells' sums [C, OUT], with
    their shares. The next three columns are the moments of columns 0 to 2 about the cells' middles. With FEEL
    felt [C, 2] is told how disturbed coarsest cells are (`most_around`; how touched was told before).
    Programs for as many particles as for coarsest cells.

    Reference: hgn.network.relative.balanced and disturbance; test: tests/kernels/test_relative.py.
    """
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    if FEEL:
        most_around(disturbed, felt, 0, neighbour, row, row < tl.load(counts + LEVELS - 1), capacity)
    live = row < tl.load(particle_count)
    cell, share = _coarsest_cells(coarsest_of, share_of, row, live)
    px, py, pz = _coarsest_places(place_of, row, live)
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    column = tl.arange(0, OUT)[None, :]
    value = tl.load(x + row[:, None] * OUT + column, mask=live[:, None] & (column < USED), other=0.0)
    part = column[:, None, :]
    added = share[:, :, None] * value[:, None, :]
    vx, vy, vz = _three(x, row, 0, live, 1.0, OUT)
    vx, vy, vz = vx[:, None], vy[:, None], vz[:, None]
    added = tl.where(part == USED, (share * (py * vz - pz * vy))[:, :, None], added)
    added = tl.where(part == USED + 1, (share * (pz * vx - px * vz))[:, :, None], added)
    added = tl.where(part == USED + 2, (share * (px * vy - py * vx))[:, :, None], added)
    # up to a multiple of four, which are added at once
    adds = (cell >= 0)[:, :, None] & (part < (USED + 6) // 4 * 4)
    tl.atomic_add(sums + cell[:, :, None] * OUT + part, added, mask=adds, sem="relaxed")


@triton.jit
def _adjugate(matrix, x, y, z):
    """The determinant of a symmetric matrix xx, yy, zz, yz, xz, xy, and its adjugate times a vector."""
    xx, yy, zz, yz, xz, xy = matrix
    axx, ayy, azz = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    ayz, axz, axy = xy * xz - xx * yz, xy * yz - yy * xz, xz * yz - zz * xy
    product = (axx * x + axy * y + axz * z, axy * x + ayy * y + ayz * z, axz * x + ayz * y + azz * z)
    return xx * axx + xy * axy + xz * axz, product


@triton.jit
def _rotation(inertia, x, y, z):
    """How well a rotation is known, and the rate at which it turns, of moments about a centre: as
    hgn.network.relative.rotation. The inertia is xx, yy, zz, yz, xz, xy."""
    xx, yy, zz = inertia[0], inertia[1], inertia[2]
    determinant, turn = _adjugate(inertia, x, y, z)
    determinant = tl.maximum(determinant, 0.0)
    least = ((xx + yy + zz) / 3 + SMALLEST) * THINNEST
    inverse = 1 / (determinant + least * least * least)
    return determinant * inverse, turn[0] * inverse, turn[1] * inverse, turn[2] * inverse


@triton.jit
def _inertia(xx, yy, zz, yz, xz, xy):
    """Of second moments about a centre."""
    return yy + zz, xx + zz, xx + yy, -yz, -xz, -xy


@triton.jit
def _body(moments, cell, mask, inverse, OUT: tl.constexpr):
    """Centres of mass in coarsest cells, from their middles, and the inertia over the mass, in their edges."""
    at = moments + cell * OUT
    x = tl.load(at, mask=mask, other=0.0) * inverse
    y = tl.load(at + 1, mask=mask, other=0.0) * inverse
    z = tl.load(at + 2, mask=mask, other=0.0) * inverse
    xx = tl.load(at + 3, mask=mask, other=0.0) * inverse - x * x
    yy = tl.load(at + 4, mask=mask, other=0.0) * inverse - y * y
    zz = tl.load(at + 5, mask=mask, other=0.0) * inverse - z * z
    yz = tl.load(at + 6, mask=mask, other=0.0) * inverse - y * z
    xz = tl.load(at + 7, mask=mask, other=0.0) * inverse - x * z
    xy = tl.load(at + 8, mask=mask, other=0.0) * inverse - x * y
    return x, y, z, _inertia(xx, yy, zz, yz, xz, xy)


@triton.jit
def _three(table, cell, column, mask, factor, OUT: tl.constexpr):
    """Three neighbouring columns of the cells' rows, times a factor."""
    at = table + cell * OUT + column
    x = tl.load(at, mask=mask, other=0.0) * factor
    y = tl.load(at + 1, mask=mask, other=0.0) * factor
    return x, y, tl.load(at + 2, mask=mask, other=0.0) * factor


@triton.jit
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@triton.jit
def _slip(moments, cell, there, few, rare, mean, OUT: tl.constexpr):
    """What surfaces leave free of the cells' means, as hgn.network.relative.slip, of the
    products of normals behind the second moments."""
    xx, yy, zz = _three(moments, cell, 9, there, 1.0, OUT)
    yz, xz, xy = _three(moments, cell, 12, there, 1.0, OUT)
    ratio = 1 / (few + rare * (xx + yy + zz))
    matrix = 1 + xx * ratio, 1 + yy * ratio, 1 + zz * ratio, yz * ratio, xz * ratio, xy * ratio
    determinant, free = _adjugate(matrix, mean[0], mean[1], mean[2])
    inverse = 1 / determinant
    return free[0] * inverse, free[1] * inverse, free[2] * inverse


@triton.jit
def _pairs(
    moments, neighbour, motion, geometry, cell, there, mass, centre, inertia, capacity,
    LEVELS: tl.constexpr, OUT: tl.constexpr,
):  # fmt: skip
    """Of the cells across the faces [C, 8], the last two of which are none: their numbers, one over their masses, the
    axis and the sign of the direction to them, this cell's share of both masses, the product of both shares, their
    centres of mass from their middles, how far these are apart, and the inertia of both about the centre of all."""
    slot = tl.arange(0, 8)[None, :]
    other = tl.load(neighbour + slot * capacity + cell[:, None], mask=there[:, None] & (slot < 6), other=-1)
    found = other >= 0
    beside = _mass(motion, geometry, other, found, LEVELS)
    inverse = _inverse(beside)
    axis, sign = slot // 2, 1.0 - 2.0 * (slot % 2).to(tl.float32)
    part = tl.where(found, mass[:, None] * _inverse(mass[:, None] + beside), 0.0)
    both = part * (1 - part)
    x, y, z, theirs = _body(moments, other, found, inverse, OUT)
    middle = (x, y, z)
    x = x + tl.where(axis == 0, sign, 0.0) - centre[0][:, None]
    y = y + tl.where(axis == 1, sign, 0.0) - centre[1][:, None]
    z = z + tl.where(axis == 2, sign, 0.0) - centre[2][:, None]
    apart = _inertia(x * x, y * y, z * z, y * z, x * z, x * y)
    total = ()
    for i in tl.static_range(6):
        whole = both * apart[i] + part * inertia[i][:, None] + (1 - part) * theirs[i]
        total = total + (whole,)  # noqa: RUF005 - Triton knows no unpacking here
    return other, inverse, axis, sign, part, both, middle, (x, y, z), total


@triton.jit
def balance(
    sums, moments, felt, motion, neighbour, geometry, counts, table, capacity, few, rare,
    LEVELS: tl.constexpr, OUT: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """What the coarsest cells add to their particles' accelerations at their middles, of the sums of what these put
    out, in columns 0 to 2 of table [C, OUT], the factor of these particles' own in column 3, and the rate of rotation
    that cells add in columns 4 to 6.

    Reference: hgn.network.relative.balanced; test: tests/kernels/test_relative.py.
    """
    count = tl.load(counts + LEVELS - 1)
    if tl.program_id(0) * BLOCK >= count:
        return
    cell, there, mass, inverse = _coarsest_of(motion, geometry, count, LEVELS, BLOCK)
    x, y, z, inertia = _body(moments, cell, there, inverse, OUT)
    centre = (x, y, z)
    other, beside, axis, sign, part, both, _, apart, whole = _pairs(
        moments, neighbour, motion, geometry, cell, there, mass, centre, inertia, capacity, LEVELS, OUT
    )
    # until here of places alone
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    disturbed, touched = _felt(felt, cell, there)
    free = 1 - touched
    half = 0.5 * tl.load(felt + other * 2, mask=other >= 0, other=0.0)
    mean = _three(sums, cell, 0, there, inverse, OUT)
    moment = _three(sums, cell, DECODED, there, inverse, OUT)
    lever = _cross(centre, mean)
    known, wx, wy, wz = _rotation(inertia, moment[0] - lever[0], moment[1] - lever[1], moment[2] - lever[2])
    traction = ()
    for i in tl.static_range(3):
        column = tl.where(axis == i, 3 + i, 9 - axis - i)  # of xx, yy, zz, yz, xz, xy behind the accelerations
        own = tl.load(sums + cell[:, None] * OUT + column, mask=other >= 0, other=0.0) * inverse[:, None]
        theirs = tl.load(sums + other * OUT + column, mask=other >= 0, other=0.0) * beside
        traction = traction + (sign * (own + theirs),)  # noqa: RUF005
    lever = _cross(apart, traction)
    felt_by, tx, ty, tz = _rotation(whole, -both * lever[0], -both * lever[1], -both * lever[2])
    swing = _cross((tx, ty, tz), apart)
    share = half * (1 - part)
    turn = (
        -disturbed * (free * wx + tl.sum(half * tx, 1)),
        -disturbed * (free * wy + tl.sum(half * ty, 1)),
        -disturbed * (free * wz + tl.sum(half * tz, 1)),
    )
    lever = _cross(turn, centre)
    line = table + cell * OUT
    along = _slip(moments, cell, there, few, rare, mean, OUT)
    for i in tl.static_range(3):
        pushed = tl.sum(share * (felt_by * traction[i] + swing[i]), 1) - free * known * mean[i]
        pushed -= touched * along[i]
        tl.store(line + i, disturbed * pushed - lever[i], mask=there)
        tl.store(line + 4 + i, turn[i], mask=there)
    tl.store(line + 3, disturbed * (touched + free * known), mask=there)


@triton.jit
def balance_backward(
    sums, moments, felt, motion, neighbour, geometry, counts, table, capacity, few, rare,
    LEVELS: tl.constexpr, OUT: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The same of the sums of the gradients of what `balance` leads to, and of their moments: in columns 0 to 8 of
    table [C, OUT] what coarsest cells add to the gradients of their particles' outputs at their middles, in column 9
    the factor of the accelerations' own, and in columns 10 to 12 the rate of rotation.

    Reference: hgn.network.relative.balanced; test: tests/kernels/test_relative.py.
    """
    count = tl.load(counts + LEVELS - 1)
    if tl.program_id(0) * BLOCK >= count:
        return
    cell, there, mass, inverse = _coarsest_of(motion, geometry, count, LEVELS, BLOCK)
    x, y, z, inertia = _body(moments, cell, there, inverse, OUT)
    centre = (x, y, z)
    other, beside, axis, sign, part, both, middle, apart, whole = _pairs(
        moments, neighbour, motion, geometry, cell, there, mass, centre, inertia, capacity, LEVELS, OUT
    )
    disturbed, touched = _felt(felt, cell, there)
    free = 1 - touched
    half = 0.5 * tl.load(felt + other * 2, mask=other >= 0, other=0.0)
    # until here of places alone
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    mean = _three(sums, cell, 0, there, inverse, OUT)
    moment = _three(sums, cell, 3, there, inverse, OUT)
    lever = _cross(centre, mean)
    moment = (moment[0] - lever[0], moment[1] - lever[1], moment[2] - lever[2])
    known, wx, wy, wz = _rotation(inertia, moment[0], moment[1], moment[2])
    factor = -disturbed * free
    turn = (factor * wx, factor * wy, factor * wz)
    lever = _cross(turn, centre)
    line = table + cell * OUT
    along = _slip(moments, cell, there, few, rare, mean, OUT)
    for i in tl.static_range(3):
        own = factor * known * mean[i] - lever[i]
        own -= disturbed * touched * along[i]
        tl.store(line + i, own, mask=there)
        tl.store(line + 10 + i, turn[i], mask=there)
    tl.store(line + 9, disturbed * (touched + free * known), mask=there)
    their_mean = _three(sums, other, 0, other >= 0, beside, OUT)
    their_moment = _three(sums, other, 3, other >= 0, beside, OUT)
    lever = _cross(middle, their_mean)
    gap = (mean[0][:, None] - their_mean[0], mean[1][:, None] - their_mean[1], mean[2][:, None] - their_mean[2])
    swing = _cross(apart, gap)
    turned = ()
    for i in tl.static_range(3):
        own = part * moment[i][:, None] + (1 - part) * (their_moment[i] - lever[i])
        turned = turned + (both * swing[i] - own,)  # noqa: RUF005
    felt_by, tx, ty, tz = _rotation(whole, turned[0], turned[1], turned[2])
    swing = _cross((tx, ty, tz), apart)
    share = half * (1 - part) * sign
    push = ()
    for i in tl.static_range(3):
        push = push + (share * (felt_by * gap[i] - swing[i]),)  # noqa: RUF005
    for i in tl.static_range(3):
        tl.store(line + 3 + i, disturbed * tl.sum(tl.where(axis == i, push[i], 0.0), 1), mask=there)
        # a shear is of two faces
        shear = tl.where(axis == (i + 2) % 3, push[(i + 1) % 3], 0.0)
        shear = tl.where(axis == (i + 1) % 3, push[(i + 2) % 3], shear)
        tl.store(line + 6 + i, disturbed * tl.sum(shear, 1), mask=there)


@triton.jit
def _coarsest_of(motion, geometry, count, LEVELS: tl.constexpr, BLOCK: tl.constexpr):
    """This program's coarsest cells: their masses, and one over these, [BLOCK] each."""
    cell = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = cell < count
    mass = _mass(motion, geometry, cell, there, LEVELS)
    return cell, there, mass, _inverse(mass)


@triton.jit
def _felt(felt, cell, there):
    """How disturbed and how touched cells are."""
    return tl.load(felt + cell * 2, mask=there, other=0.0), tl.load(felt + cell * 2 + 1, mask=there, other=0.0)


@triton.jit
def _mass(motion, geometry, cell, there, LEVELS: tl.constexpr):
    first = tl.load(geometry + (LEVELS - 1) * GEOMETRY_COLUMNS + 6)
    return tl.load(motion + (first + cell) * 4, mask=there, other=0.0)


@triton.jit
def _inverse(mass):
    """One over it, 0 of 0."""
    return tl.where(mass > 0, 1 / tl.where(mass > 0, mass, 1.0), 0.0)


@triton.jit
def add_coarsest(
    x, table, coarsest_of, share_of, place_of, particle_count,
    OUT: tl.constexpr, USED: tl.constexpr, COLUMNS: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Multiplies columns 0 to 2 of the particles' rows of x [N, OUT] by column USED of the coarsest cells' table
    [C, OUT], and adds its columns before that, each with the particles' shares, and the rotation in columns USED + 1 to
    USED + 3 about the cells' middles. COLUMNS: a power of two above USED.

    Reference: hgn.network.relative.balanced; test: tests/kernels/test_relative.py.
    """
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = row < tl.load(particle_count)
    cell, share = _coarsest_cells(coarsest_of, share_of, row, live)
    place = _coarsest_places(place_of, row, live)
    column = tl.arange(0, COLUMNS)[None, :]
    own = tl.load(x + row[:, None] * OUT + column, mask=live[:, None] & (column < 3), other=0.0)
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    at = table + cell[:, :, None] * OUT + column[:, None, :]
    found = tl.load(at, mask=(cell >= 0)[:, :, None] & (column <= USED)[:, None, :], other=0.0)
    total = tl.sum(share[:, :, None] * found, 1)
    factor = tl.sum(tl.where(column == USED, total, 0.0), 1)
    swing = _cross(_three(table, cell, USED + 1, cell >= 0, share, OUT), place)
    for i in tl.static_range(3):
        total += tl.where(column == i, tl.sum(swing[i], 1)[:, None], 0.0)
    tl.store(x + row[:, None] * OUT + column, total + factor[:, None] * own, mask=live[:, None] & (column < USED))


# rest, behind `balance`: P, two numbers of P, and P again, for P does not grow and is its own adjoint


@triton.jit
def _lowest(base_of, gate_of, spot_of, row, live):
    """The slots of the lowest middles around particles, their gates, and their places from there, in edges."""
    spot = _three(spot_of, row, 0, live, 1.0, 3)
    return tl.load(base_of + row, mask=live, other=0), tl.load(gate_of + row, mask=live, other=0.0), spot


@triton.jit
def _split(k, axis: tl.constexpr, low, place_of, row, live, LEVELS: tl.constexpr, SHIFT: tl.constexpr):
    """Along an axis, from the number in the window of a particle's own coarsest cell: the number of the lowest middle
    around it, of cells 2^SHIFT times as large, from 0 on, and its place from there, in their edges."""
    first = tl.load(low + axis) >> LEVELS - 1
    place = tl.load(place_of + row * 3 + axis, mask=live, other=0.0)
    lowest = tl.floor(place)
    k += first + lowest.to(tl.int32)
    wide = k >> SHIFT
    return wide - (first - 1 >> SHIFT), ((k - (wide << SHIFT)).to(tl.float32) + place - lowest) * (1.0 / (1 << SHIFT))


@triton.jit
def _middles(base, gate, spot, geometry, LEVELS: tl.constexpr):
    """From the lowest slots, the gates and the spots of particles, the slots [N, 8] of all middles around them, their
    places from there, and their weights."""
    line = geometry + (LEVELS - 1) * GEOMETRY_COLUMNS
    corner = tl.arange(0, 8)[None, :]
    axes, weight = (), gate[:, None]
    for i in tl.static_range(3):
        place = spot[i][:, None] - (corner >> 2 - i & 1).to(tl.float32)
        weight = weight * (1 - tl.abs(place))
        axes = axes + (place,)  # noqa: RUF005 - Triton knows no unpacking here
    across = (corner >> 2 & 1) * tl.load(line + 2) + (corner >> 1 & 1)
    slot = base[:, None] + across * tl.load(line + 3) + (corner & 1)
    return slot, axes, weight


@triton.jit
def _add_bodies(sums, slot, place, weight, value, BODIES: tl.constexpr, COLUMNS: tl.constexpr):
    """Adds values of particles and their moments to middles' sums [K, COLUMNS]: behind mass, places and their products
    xx, yy, zz, yz, xz, xy with BODIES."""
    at: tl.constexpr = 10 * BODIES
    moment = _cross(place, (value[0][:, None], value[1][:, None], value[2][:, None]))
    column = tl.arange(0, COLUMNS)[None, None, :]
    added = tl.zeros((slot.shape[0], 8, COLUMNS), tl.float32)
    if BODIES:
        added = tl.where(column == 0, weight[:, :, None], added)
        for i in tl.static_range(3):
            one, other = place[(i + 1) % 3], place[(i + 2) % 3]
            added = tl.where(column == 1 + i, (weight * place[i])[:, :, None], added)
            added = tl.where(column == 4 + i, (weight * place[i] * place[i])[:, :, None], added)
            added = tl.where(column == 7 + i, (weight * one * other)[:, :, None], added)
    for i in tl.static_range(3):
        added = tl.where(column == at + i, (weight * value[i][:, None])[:, :, None], added)
        added = tl.where(column == at + 3 + i, (weight * moment[i])[:, :, None], added)
    # columns of zeros are added too, four at once
    there = (weight > 0)[:, :, None] & (column < COLUMNS)
    tl.atomic_add(sums + slot[:, :, None] * COLUMNS + column, added, mask=there, sem="relaxed")


@triton.jit
def _deforming(table, slot, place, weight, value):
    """The part of values of particles that deforms what touches, by the middles' table [K, RATES]."""
    there = weight > 0
    base = _three(table, slot, 0, there, weight, RATES)
    swing = _cross(_three(table, slot, 4, there, weight, RATES), place)
    factor = tl.sum(tl.load(table + slot * RATES + 3, mask=there, other=0.0) * weight, 1)
    result = ()
    for i in tl.static_range(3):
        part = factor * value[i] - tl.sum(base[i] + swing[i], 1)
        result = result + (part,)  # noqa: RUF005 - Triton knows no unpacking here
    return result


@triton.jit
def _displaced(x, velocity, scale, row, live, OUT: tl.constexpr, HISTORY: tl.constexpr, MOVING: tl.constexpr):
    """Columns 0 to 2 of x [N, OUT], and with MOVING the newest velocities in its unit besides."""
    ax, ay, az = _three(x, row, 0, live, 1.0, OUT)
    if MOVING:
        vx, vy, vz = _three(velocity, row, 0, live, 1 / tl.load(scale), 3 * HISTORY)
        ax, ay, az = ax + vx, ay + vy, az + vz
    return ax, ay, az


@triton.jit
def sum_displacements(
    x, velocity, scale, material_of, coarsest_of, share_of, place_of, felt, slot_of_cell, geometry, low, base_of,
    gate_of, spot_of, sums, particle_count,
    OUT: tl.constexpr, HISTORY: tl.constexpr, LEVELS: tl.constexpr, SHIFT: tl.constexpr, RESTING: tl.constexpr,
    COLUMNS: tl.constexpr, FORWARD: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adds the particles' next displacements over `scale`, or with FORWARD off their gradients alone, to the sums
    [K, COLUMNS] of the middles around them of cells 2^SHIFT times as large as coarsest ones, moments too; forward with
    the bodies' own. There the lowest of these slots goes into `base_of` [N], the place from there into `spot_of`
    [N, 3], and the gate into `gate_of` [N]: 0 for materials whose bit is not in RESTING; with -1 all are.

    Reference: hgn.network.rest; test: tests/kernels/test_relative.py.
    """
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = row < tl.load(particle_count)
    if FORWARD:
        line = geometry + (LEVELS - 1) * GEOMETRY_COLUMNS
        cell, share = _coarsest_cells(coarsest_of, share_of, row, live)
        gate = tl.sum(share * tl.load(felt + cell * 2 + 1, mask=cell >= 0, other=0.0), 1)
        if RESTING != -1:
            gate *= (RESTING >> tl.load(material_of + row, mask=live, other=0) & 1).to(tl.float32)
        own = tl.load(coarsest_of + row * 8, mask=live, other=-1)
        local = tl.load(slot_of_cell + tl.load(line + 6) + own, mask=own >= 0, other=0)
        ny, nz, stride = tl.load(line + 2), tl.load(line + 3), tl.load(line + 4)
        scene, kx, ky, kz = split_slot(local, ny, nz, stride)
        bx, x_spot = _split(kx, 0, low, place_of, row, live, LEVELS, SHIFT)
        by, y_spot = _split(ky, 1, low, place_of, row, live, LEVELS, SHIFT)
        bz, z_spot = _split(kz, 2, low, place_of, row, live, LEVELS, SHIFT)
        base, spot = scene * stride + (bx * ny + by) * nz + bz, (x_spot, y_spot, z_spot)
        base, gate = tl.where(own >= 0, base, 0), tl.where(own >= 0, gate, 0.0)
    else:
        base, gate, spot = _lowest(base_of, gate_of, spot_of, row, live)
    slot, place, weight = _middles(base, gate, spot, geometry, LEVELS)
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    if FORWARD:
        tl.store(base_of + row, base, mask=live)
        tl.store(gate_of + row, gate, mask=live)
        for i in tl.static_range(3):
            tl.store(spot_of + row * 3 + i, spot[i], mask=live)
    value = _displaced(x, velocity, scale, row, live, OUT, HISTORY, FORWARD)
    _add_bodies(sums, slot, place, weight, value, FORWARD, COLUMNS)


@triton.jit
def find_deformation(
    bodies, sums, table, count,
    AT: tl.constexpr, COLUMNS: tl.constexpr, BODIES: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """From a field's sums [K, COLUMNS] at the middles of cells, from column AT on, and `bodies` [K, BODIES] to
    their table [K, RATES]: what is subtracted there, the factor of a particle's own in column 3, and the rate of
    rotation that is subtracted in columns 4 to 6.

    Reference: hgn.network.rest; test: tests/kernels/test_relative.py.
    """
    middle = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = middle < count
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    inverse = _inverse(tl.load(bodies + middle * BODIES, mask=there, other=0.0))
    x, y, z, inertia = _body(bodies + 1, middle, there, inverse, BODIES)
    centre = (x, y, z)
    mean = _three(sums, middle, AT, there, inverse, COLUMNS)
    moment = _three(sums, middle, AT + 3, there, inverse, COLUMNS)
    lever = _cross(centre, mean)
    known, wx, wy, wz = _rotation(inertia, moment[0] - lever[0], moment[1] - lever[1], moment[2] - lever[2])
    share = 1 / tl.maximum(known, SURELY)
    turn = (share * wx, share * wy, share * wz)
    lever = _cross(turn, centre)
    line = table + middle * RATES
    for i in tl.static_range(3):
        tl.store(line + i, share * known * mean[i] - lever[i], mask=there)
        tl.store(line + 4 + i, turn[i], mask=there)
    tl.store(line + 3, share * known, mask=there)


@triton.jit
def slow_displacements(
    x, velocity, scale, scene_of, gravity, threshold, rate, slow, table, base_of, gate_of, spot_of, geometry, sums,
    particle_count,
    OUT: tl.constexpr, HISTORY: tl.constexpr, LEVELS: tl.constexpr, FORWARD: tl.constexpr, OVERLAP: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """What of the deformation by the middles' table is slow goes into `slow` [N, 3], and with its moments to the sums
    [K, RATES]; all of it into `rate` [N, 3]. With FORWARD off gradients go the same way back, by the rates of before.

    Reference: hgn.network.rest; test: tests/kernels/test_relative.py.
    """
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = row < tl.load(particle_count)
    value = _displaced(x, velocity, scale, row, live, OUT, HISTORY, FORWARD)
    gx, gy, gz = _three(gravity, tl.load(scene_of + row, mask=live, other=0), 0, live, threshold / tl.load(scale), 3)
    limit = gx * gx + gy * gy + gz * gz
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    base, gate, spot = _lowest(base_of, gate_of, spot_of, row, live)
    slot, place, weight = _middles(base, gate, spot, geometry, LEVELS)
    part = _deforming(table, slot, place, weight, value)
    d = part
    if not FORWARD:
        d = _three(rate, row, 0, live, 1.0, 3)
    ratio = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) / tl.maximum(limit, TINY)
    phi = tl.where(limit > 0, tl.minimum(tl.maximum(2 - ratio, 0.0), 1.0), 0.0)
    along = 0.0 * phi
    if not FORWARD:
        inner = (d[0] * part[0] + d[1] * part[1] + d[2] * part[2]) / tl.maximum(limit, TINY)
        along = tl.where((phi > 0) & (phi < 1), 2 * inner, 0.0)
    stopped = ()
    for i in tl.static_range(3):
        if FORWARD:
            tl.store(rate + row * 3 + i, d[i], mask=live)
        stopped = stopped + (phi * part[i] - along * d[i],)  # noqa: RUF005
        tl.store(slow + row * 3 + i, stopped[i], mask=live)
    _add_bodies(sums, slot, place, weight, stopped, False, RATES)


@triton.jit
def stop_slow(
    x, slow, table, base_of, gate_of, spot_of, geometry, particle_count,
    OUT: tl.constexpr, LEVELS: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Takes what of `slow` [N, 3] deforms, by the middles' table, off columns 0 to 2 of x [N, OUT].

    Reference: hgn.network.rest; test: tests/kernels/test_relative.py.
    """
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = row < tl.load(particle_count)
    base, gate, spot = _lowest(base_of, gate_of, spot_of, row, live)
    slot, place, weight = _middles(base, gate, spot, geometry, LEVELS)
    own = _three(x, row, 0, live, 1.0, OUT)
    value = _three(slow, row, 0, live, 1.0, 3)
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    part = _deforming(table, slot, place, weight, value)
    for i in tl.static_range(3):
        tl.store(x + row * OUT + i, own[i] - part[i], mask=live)


settle_keys(globals())
