"""Computes the part of the accelerations that coarsest cells add so that momentum is conserved, and its gradients.

Shape legend: N particles, C coarsest cells. The geometry table is that of hgn.kernels.geometry.
"""

import triton
import triton.language as tl

from hgn.kernels.bodies import body_of, coarsest_cells, cross, inertia_of, one_over, rotation, three_columns
from hgn.kernels.coarsest.friction import along_surfaces, dot, removed_along, slip_of, with_friction
from hgn.kernels.geometry import GEOMETRY_COLUMNS, most_around
from hgn.kernels.triton_compat import gdc_launch_dependents, gdc_wait, settle_keys
from hgn.network.relative import OUTPUTS

DECODED = tl.constexpr(OUTPUTS)


@triton.jit
def _coarsest_places(place_of, row, live):
    """Returns the particles' places relative to the middles of their coarsest cells, three [N, 8], in cell edges."""
    corner = tl.arange(0, 8)[None, :]
    at = place_of + row * 3
    x = tl.load(at, mask=live, other=0.0)[:, None] - (corner >> 2 & 1).to(tl.float32)
    y = tl.load(at + 1, mask=live, other=0.0)[:, None] - (corner >> 1 & 1).to(tl.float32)
    return x, y, tl.load(at + 2, mask=live, other=0.0)[:, None] - (corner & 1).to(tl.float32)


@triton.jit
def sum_coarsest(
    x, coarsest_of, cell_weight_of, place_of, neighbour, counts, disturbed, spread, sums, particle_count, capacity,
    LEVELS: tl.constexpr, OUT: tl.constexpr, USED: tl.constexpr, SPREAD: tl.constexpr,
    OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adds the first USED columns of the rows of x [N, OUT], with their weights, to the coarsest cells' sums [C, OUT].

    The next three columns are the moments of columns 0 to 2 about the cells' middles. With SPREAD the kernel writes
    the disturbance of coarsest cells to spread [C, 2] too (`most_around`). Programs cover particles and coarsest cells.

    Rule: hgn.network.relative.balanced and disturbance; test: tests/kernels/test_relative.py.
    """
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    if SPREAD:
        most_around(disturbed, spread, 0, neighbour, row, row < tl.load(counts + LEVELS - 1), capacity)
    live = row < tl.load(particle_count)
    cell, cell_weight = coarsest_cells(coarsest_of, cell_weight_of, row, live)
    px, py, pz = _coarsest_places(place_of, row, live)
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    column = tl.arange(0, OUT)[None, :]
    value = tl.load(x + row[:, None] * OUT + column, mask=live[:, None] & (column < USED), other=0.0)
    part = column[:, None, :]
    added = cell_weight[:, :, None] * value[:, None, :]
    vx, vy, vz = three_columns(x, row, 0, live, 1.0, OUT)
    vx, vy, vz = vx[:, None], vy[:, None], vz[:, None]
    added = tl.where(part == USED, (cell_weight * (py * vz - pz * vy))[:, :, None], added)
    added = tl.where(part == USED + 1, (cell_weight * (pz * vx - px * vz))[:, :, None], added)
    added = tl.where(part == USED + 2, (cell_weight * (px * vy - py * vx))[:, :, None], added)
    # The added columns are a multiple of four, because the hardware adds four at once.
    adds = (cell >= 0)[:, :, None] & (part < (USED + 6) // 4 * 4)
    tl.atomic_add(sums + cell[:, :, None] * OUT + part, added, mask=adds, sem="relaxed")


@triton.jit
def _pairs(
    moments, neighbour, motion, geometry, cell, there, mass, centre, inertia, capacity,
    LEVELS: tl.constexpr, OUT: tl.constexpr,
):  # fmt: skip
    """Returns properties of the cells across the six faces, [C, 8] with two unused columns, in this order: number; one
    over its mass; axis and sign of the direction; the own cell's fraction of both masses; product of both fractions;
    centre of mass from its middle; and from the own centre of mass; inertia of both about their common centre."""
    slot = tl.arange(0, 8)[None, :]
    other = tl.load(neighbour + slot * capacity + cell[:, None], mask=there[:, None] & (slot < 6), other=-1)
    found = other >= 0
    beside = _mass(motion, geometry, other, found, LEVELS)
    inverse = one_over(beside)
    axis, sign = slot // 2, 1.0 - 2.0 * (slot % 2).to(tl.float32)
    part = tl.where(found, mass[:, None] * one_over(mass[:, None] + beside), 0.0)
    both = part * (1 - part)
    x, y, z, theirs = body_of(moments, other, found, inverse, OUT)
    middle = (x, y, z)
    x = x + tl.where(axis == 0, sign, 0.0) - centre[0][:, None]
    y = y + tl.where(axis == 1, sign, 0.0) - centre[1][:, None]
    z = z + tl.where(axis == 2, sign, 0.0) - centre[2][:, None]
    apart = inertia_of(x * x, y * y, z * z, y * z, x * z, x * y)
    total = ()
    for i in tl.static_range(6):
        whole = both * apart[i] + part * inertia[i][:, None] + (1 - part) * theirs[i]
        total = total + (whole,)  # noqa: RUF005 - Triton does not support unpacking here
    return other, inverse, axis, sign, part, both, middle, (x, y, z), total


@triton.jit
def balance(
    sums, moments, spread, motion, neighbour, geometry, counts, table, friction, fraction, capacity, few, rare,
    LEVELS: tl.constexpr, OUT: tl.constexpr, FRICTION: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Computes the table [C, OUT] of the coarsest cells from sums of particles' outputs.

    Columns 0 to 2 are the acceleration that a cell adds to its particles at its middle. Column 3 is the factor of the
    particles' own output. Columns 4 to 6 are the rate of rotation that the cell adds. FRICTION: see removed_along.

    Rule: hgn.network.relative.balanced; test: tests/kernels/test_relative.py.
    """
    count = tl.load(counts + LEVELS - 1)
    if tl.program_id(0) * BLOCK >= count:
        return
    cell, there, mass, inverse = _coarsest_of(motion, geometry, count, LEVELS, BLOCK)
    x, y, z, inertia = body_of(moments, cell, there, inverse, OUT)
    centre = (x, y, z)
    other, beside, axis, sign, part, both, _, apart, whole = _pairs(
        moments, neighbour, motion, geometry, cell, there, mass, centre, inertia, capacity, LEVELS, OUT
    )
    # The code above depends only on places.
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    disturbed, contact = _disturbance(spread, cell, there)
    free = 1 - contact
    half = 0.5 * tl.load(spread + other * 2, mask=other >= 0, other=0.0)
    mean = three_columns(sums, cell, 0, there, inverse, OUT)
    moment = three_columns(sums, cell, DECODED, there, inverse, OUT)
    lever = cross(centre, mean)
    known, wx, wy, wz = rotation(inertia, moment[0] - lever[0], moment[1] - lever[1], moment[2] - lever[2])
    traction = ()
    for i in tl.static_range(3):
        column = tl.where(axis == i, 3 + i, 9 - axis - i)  # column of xx, yy, zz, yz, xz, xy behind the accelerations
        own = tl.load(sums + cell[:, None] * OUT + column, mask=other >= 0, other=0.0) * inverse[:, None]
        theirs = tl.load(sums + other * OUT + column, mask=other >= 0, other=0.0) * beside
        traction = traction + (sign * (own + theirs),)  # noqa: RUF005
    lever = cross(apart, traction)
    felt_by, tx, ty, tz = rotation(whole, -both * lever[0], -both * lever[1], -both * lever[2])
    swing = cross((tx, ty, tz), apart)
    share = half * (1 - part)
    turn = (
        -disturbed * (free * wx + tl.sum(half * tx, 1)),
        -disturbed * (free * wy + tl.sum(half * ty, 1)),
        -disturbed * (free * wz + tl.sum(half * tz, 1)),
    )
    lever = cross(turn, centre)
    line = table + cell * OUT
    ratio, matrix = slip_of(moments, cell, there, few, rare, OUT)
    along = along_surfaces(matrix, mean)
    if FRICTION:
        impulse = ()
        for i in tl.static_range(3):
            impulse = impulse + (tl.sum(share * (felt_by * traction[i] + swing[i]), 1),)  # noqa: RUF005
        along = removed_along(
            friction, fraction, cell, there, inverse, ratio, matrix, disturbed, contact, along, impulse, OUT
        )  # fmt: skip
    for i in tl.static_range(3):
        pushed = tl.sum(share * (felt_by * traction[i] + swing[i]), 1) - free * known * mean[i]
        pushed -= contact * along[i]
        tl.store(line + i, disturbed * pushed - lever[i], mask=there)
        tl.store(line + 4 + i, turn[i], mask=there)
    tl.store(line + 3, disturbed * (contact + free * known), mask=there)


@triton.jit
def balance_backward(
    sums, moments, spread, motion, neighbour, geometry, counts, table, friction, fraction, capacity, few, rare,
    LEVELS: tl.constexpr, OUT: tl.constexpr, FRICTION: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Computes the table [C, OUT] from sums of gradients of the result of `balance` and of their moments.

    Columns 0 to 8 are the gradients that cells add to their particles' outputs at the cells' middles. Column 9 is the
    factor of the accelerations' own gradient. Columns 10 to 12 are the rate of rotation of the added gradient.

    Rule: hgn.network.relative.balanced; test: tests/kernels/test_relative.py.
    """
    count = tl.load(counts + LEVELS - 1)
    if tl.program_id(0) * BLOCK >= count:
        return
    cell, there, mass, inverse = _coarsest_of(motion, geometry, count, LEVELS, BLOCK)
    x, y, z, inertia = body_of(moments, cell, there, inverse, OUT)
    centre = (x, y, z)
    other, beside, axis, sign, part, both, middle, apart, whole = _pairs(
        moments, neighbour, motion, geometry, cell, there, mass, centre, inertia, capacity, LEVELS, OUT
    )
    disturbed, contact = _disturbance(spread, cell, there)
    free = 1 - contact
    half = 0.5 * tl.load(spread + other * 2, mask=other >= 0, other=0.0)
    # The code above depends only on places.
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    mean = three_columns(sums, cell, 0, there, inverse, OUT)
    moment = three_columns(sums, cell, 3, there, inverse, OUT)
    lever = cross(centre, mean)
    moment = (moment[0] - lever[0], moment[1] - lever[1], moment[2] - lever[2])
    known, wx, wy, wz = rotation(inertia, moment[0], moment[1], moment[2])
    factor = -disturbed * free
    turn = (factor * wx, factor * wy, factor * wz)
    lever = cross(turn, centre)
    line = table + cell * OUT
    _, matrix = slip_of(moments, cell, there, few, rare, OUT)
    along = along_surfaces(matrix, mean)
    if FRICTION:
        slope = dot(mean, three_columns(fraction, cell, 0, there, 1.0, OUT))
        k = tl.load(fraction + cell * OUT + 3, mask=there, other=0.0)
        by_mean = three_columns(fraction, cell, 4, there, 1.0, OUT)
    for i in tl.static_range(3):
        own = factor * known * mean[i] - lever[i]
        own -= disturbed * contact * along[i]
        if FRICTION:
            own += k * disturbed * contact * along[i] + slope * by_mean[i]
        tl.store(line + i, own, mask=there)
        tl.store(line + 10 + i, turn[i], mask=there)
    tl.store(line + 9, disturbed * (contact + free * known), mask=there)
    their_mean = three_columns(sums, other, 0, other >= 0, beside, OUT)
    their_moment = three_columns(sums, other, 3, other >= 0, beside, OUT)
    lever = cross(middle, their_mean)
    if FRICTION:
        mean = with_friction(fraction, cell, there, mean, OUT)
        their_mean = with_friction(fraction, other, other >= 0, their_mean, OUT)
    gap = (mean[0][:, None] - their_mean[0], mean[1][:, None] - their_mean[1], mean[2][:, None] - their_mean[2])
    swing = cross(apart, gap)
    turned = ()
    for i in tl.static_range(3):
        own = part * moment[i][:, None] + (1 - part) * (their_moment[i] - lever[i])
        turned = turned + (both * swing[i] - own,)  # noqa: RUF005
    felt_by, tx, ty, tz = rotation(whole, turned[0], turned[1], turned[2])
    swing = cross((tx, ty, tz), apart)
    share = half * (1 - part) * sign
    push = ()
    for i in tl.static_range(3):
        push = push + (share * (felt_by * gap[i] - swing[i]),)  # noqa: RUF005
    for i in tl.static_range(3):
        tl.store(line + 3 + i, disturbed * tl.sum(tl.where(axis == i, push[i], 0.0), 1), mask=there)
        # A shear has parts from the faces on two axes.
        shear = tl.where(axis == (i + 2) % 3, push[(i + 1) % 3], 0.0)
        shear = tl.where(axis == (i + 1) % 3, push[(i + 2) % 3], shear)
        tl.store(line + 6 + i, disturbed * tl.sum(shear, 1), mask=there)


@triton.jit
def _coarsest_of(motion, geometry, count, LEVELS: tl.constexpr, BLOCK: tl.constexpr):
    """Returns this program's coarsest cells, whether they exist, their masses, and one over the masses."""
    cell = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = cell < count
    mass = _mass(motion, geometry, cell, there, LEVELS)
    return cell, there, mass, one_over(mass)


@triton.jit
def _disturbance(spread, cell, there):
    """Returns the disturbance of cells (column 0 of `spread`), and their disturbance by surfaces (column 1)."""
    return tl.load(spread + cell * 2, mask=there, other=0.0), tl.load(spread + cell * 2 + 1, mask=there, other=0.0)


@triton.jit
def _mass(motion, geometry, cell, there, LEVELS: tl.constexpr):
    first = tl.load(geometry + (LEVELS - 1) * GEOMETRY_COLUMNS + 6)
    return tl.load(motion + (first + cell) * 4, mask=there, other=0.0)


@triton.jit
def add_coarsest(
    x, table, coarsest_of, cell_weight_of, place_of, particle_count,
    OUT: tl.constexpr, USED: tl.constexpr, COLUMNS: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Applies the coarsest cells' table [C, OUT] to the particles' rows of x [N, OUT].

    Multiplies columns 0 to 2 by the table's column USED. Adds its columns before USED, with weights `cell_weight_of`,
    and the rotation about the cells' middles in the three columns after it. COLUMNS: a power of two above USED.

    Rule: hgn.network.relative.balanced; test: tests/kernels/test_relative.py.
    """
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = row < tl.load(particle_count)
    cell, cell_weight = coarsest_cells(coarsest_of, cell_weight_of, row, live)
    place = _coarsest_places(place_of, row, live)
    column = tl.arange(0, COLUMNS)[None, :]
    own = tl.load(x + row[:, None] * OUT + column, mask=live[:, None] & (column < 3), other=0.0)
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    at = table + cell[:, :, None] * OUT + column[:, None, :]
    found = tl.load(at, mask=(cell >= 0)[:, :, None] & (column <= USED)[:, None, :], other=0.0)
    total = tl.sum(cell_weight[:, :, None] * found, 1)
    factor = tl.sum(tl.where(column == USED, total, 0.0), 1)
    swing = cross(three_columns(table, cell, USED + 1, cell >= 0, cell_weight, OUT), place)
    for i in tl.static_range(3):
        total += tl.where(column == i, tl.sum(swing[i], 1)[:, None], 0.0)
    tl.store(x + row[:, None] * OUT + column, total + factor[:, None] * own, mask=live[:, None] & (column < USED))


settle_keys(globals())
