"""Computes the part of a force along surfaces in coarsest cells, and how much of it remains with friction.

The rule is hgn.network.own_physics.friction_fraction, whose letters are used here. Shape legend: C coarsest cells.
"""

import triton
import triton.language as tl

from hgn.kernels.bodies import adjugate, three_columns
from hgn.kernels.triton_compat import settle_keys
from hgn.network import own_physics

TINY = tl.constexpr(own_physics.TINY)


@triton.jit
def slip_of(moments, cell, there, few, rare, OUT: tl.constexpr):
    """Returns 1 / (FEW + RARE tr P) of cells, and the inverse of Q (hgn.network.relative.slip): xx, yy, zz, yz, xz, xy.
    In `moments` the products of normals follow the second moments."""
    xx, yy, zz = three_columns(moments, cell, 9, there, 1.0, OUT)
    yz, xz, xy = three_columns(moments, cell, 12, there, 1.0, OUT)
    ratio = 1 / (few + rare * (xx + yy + zz))
    return ratio, (1 + xx * ratio, 1 + yy * ratio, 1 + zz * ratio, yz * ratio, xz * ratio, xy * ratio)


@triton.jit
def along_surfaces(matrix, vector):
    """Returns Q times vectors: the part of them that surfaces do not remove. `matrix` is the inverse of Q."""
    determinant, free = adjugate(matrix, vector[0], vector[1], vector[2])
    inverse = 1 / determinant
    return free[0] * inverse, free[1] * inverse, free[2] * inverse


@triton.jit
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def _rough(friction, cell, there, ratio, force, OUT: tl.constexpr):
    """Returns B, and the matrix of its derivatives by the force c T: xx, yy, zz, yz, xz, xy."""
    xx, yy, zz = three_columns(friction, cell, 0, there, ratio, OUT)
    yz, xz, xy = three_columns(friction, cell, 3, there, ratio, OUT)
    lower = three_columns(friction, cell, 6, there, ratio, OUT)
    upper = three_columns(friction, cell, 9, there, ratio, OUT)
    wall = ()
    for i in tl.static_range(3):  # only the wall from which the force points away has friction
        pushes = tl.where(force[i] >= 0, lower[i], 0.0) + tl.where(force[i] <= 0, upper[i], 0.0)
        wall = wall + (pushes,)  # noqa: RUF005 - Triton does not support unpacking here
    matrix = xx + wall[0], yy + wall[1], zz + wall[2], yz, xz, xy
    return _product(matrix, force), matrix


@triton.jit
def _product(matrix, vector):
    xx, yy, zz, yz, xz, xy = matrix
    x, y, z = vector
    return xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z


@triton.jit
def removed_along(
    friction, fraction, cell, there, inverse, ratio, matrix, disturbed, contact, along, impulse, OUT: tl.constexpr
):
    """Returns the part of T = Q R that surfaces remove, (1 - k) T. `along` is T, and `impulse` A without the factor d.

    Writes to `fraction` [C, OUT] for the backward pass: T, k, and the derivatives of k by R and by A, both times c.
    """
    c = disturbed * contact
    force = c * along[0], c * along[1], c * along[2]
    x, y, z = three_columns(friction, cell, 12, there, inverse, OUT)
    variance = tl.load(friction + cell * OUT + 15, mask=there, other=0.0) * inverse - (x * x + y * y + z * z)
    variance = tl.maximum(variance, 0.0)
    free = x + disturbed * impulse[0], y + disturbed * impulse[1], z + disturbed * impulse[2]
    free = along_surfaces(matrix, along_surfaces(matrix, free))  # Q u
    slipping = along_surfaces(matrix, force)  # Q c T
    bound, slopes = _rough(friction, cell, there, ratio, force, OUT)
    limit, length = tl.sqrt(dot(bound, bound)), tl.sqrt(dot(force, force))
    cone = limit / tl.maximum(tl.maximum(limit, length), TINY)
    # b solves square b^2 + slope b = variance / 4; the two forms of the solution avoid cancellation
    square, slope = dot(slipping, slipping), dot(slipping, free)
    root = tl.sqrt(tl.maximum(slope * slope + square * variance, TINY))
    slowed = 0.5 * (root - slope) / tl.maximum(square, TINY)
    turned = 0.5 * variance / tl.where(slope > 0, root + slope, 1.0)
    slowest = tl.where(slope > 0, turned, slowed)
    part = tl.minimum(cone, slowest)
    # Derivatives of b by Q c T and by Q u are those of the equation that b solves.
    ratio_of = tl.where(cone <= slowest, 0.0, part / root)
    by_limit = _product(slopes, bound)
    by_cone = (cone <= slowest) & (limit < length)
    inverse_limit = tl.where(by_cone, 1 / tl.maximum(limit * length, TINY), 0.0)
    inverse_square = tl.where(by_cone, cone / tl.maximum(length * length, TINY), 0.0)
    by_force, by_free = (), ()
    for i in tl.static_range(3):
        by_force = by_force + (-ratio_of * (2 * part * slipping[i] + free[i]),)  # noqa: RUF005
        by_free = by_free + (-ratio_of * slipping[i],)  # noqa: RUF005
    by_force = along_surfaces(matrix, by_force)
    by_mean = ()
    for i in tl.static_range(3):
        total = by_force[i] + by_limit[i] * inverse_limit - force[i] * inverse_square
        by_mean = by_mean + (c * c * total,)  # noqa: RUF005
    by_mean = along_surfaces(matrix, by_mean)
    by_impulse = along_surfaces(matrix, along_surfaces(matrix, by_free))
    line = fraction + cell * OUT
    tl.store(line + 3, part, mask=there)
    for i in tl.static_range(3):
        tl.store(line + i, along[i], mask=there)
        tl.store(line + 4 + i, by_mean[i], mask=there)
        tl.store(line + 7 + i, c * by_impulse[i], mask=there)
    return along[0] - part * along[0], along[1] - part * along[1], along[2] - part * along[2]


@triton.jit
def with_friction(fraction, cell, there, mean, OUT: tl.constexpr):
    """Returns the gradient by A of cells, [C] or across faces [C, 8], from the gradient of their accelerations.
    Both are without the factor d."""
    slope = dot(mean, three_columns(fraction, cell, 0, there, 1.0, OUT))
    x, y, z = three_columns(fraction, cell, 7, there, slope, OUT)
    return mean[0] + x, mean[1] + y, mean[2] + z


settle_keys(globals())
