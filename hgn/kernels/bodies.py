"""Computes the bodies in coarsest cells: centres of mass, inertia and rotation, for momentum and for rest.

Shape legend: N particles, C cells.
"""

import triton
import triton.language as tl

from hgn.kernels.triton_compat import settle_keys
from hgn.network.centres import POINT, THIN

THINNEST, SMALLEST = tl.constexpr(THIN), tl.constexpr(POINT)  # limits of a cell's contents for a known rotation


@triton.jit
def coarsest_cells(coarsest_of, cell_weight_of, row, live):
    """Returns the particles' coarsest cells [N, 8], each once and -1 elsewhere, and their weights [N, 8]."""
    at = row[:, None] * 8 + tl.arange(0, 8)[None, :]
    cell = tl.load(coarsest_of + at, mask=live[:, None], other=-1)
    return cell, tl.load(cell_weight_of + at, mask=cell >= 0, other=0.0)


@triton.jit
def adjugate(matrix, x, y, z):
    """Returns the determinant of a symmetric matrix xx, yy, zz, yz, xz, xy, and its adjugate times a vector."""
    xx, yy, zz, yz, xz, xy = matrix
    axx, ayy, azz = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    ayz, axz, axy = xy * xz - xx * yz, xy * yz - yy * xz, xz * yz - zz * xy
    product = (axx * x + axy * y + axz * z, axy * x + ayy * y + ayz * z, axz * x + ayz * y + azz * z)
    return xx * axx + xy * axy + xz * axz, product


@triton.jit
def rotation(inertia, x, y, z):
    """Returns how well moments about a centre determine a rotation, and its rate (hgn.network.centres.rotation).

    The inertia is in the order xx, yy, zz, yz, xz, xy.
    """
    xx, yy, zz = inertia[0], inertia[1], inertia[2]
    determinant, turn = adjugate(inertia, x, y, z)
    determinant = tl.maximum(determinant, 0.0)
    least = ((xx + yy + zz) / 3 + SMALLEST) * THINNEST
    inverse = 1 / (determinant + least * least * least)
    return determinant * inverse, turn[0] * inverse, turn[1] * inverse, turn[2] * inverse


@triton.jit
def inertia_of(xx, yy, zz, yz, xz, xy):
    """Returns the inertia of second moments about a centre, in the order of `rotation`."""
    return yy + zz, xx + zz, xx + yy, -yz, -xz, -xy


@triton.jit
def body_of(moments, cell, mask, inverse, OUT: tl.constexpr):
    """Returns centres of mass relative to centres of coarsest cells, and inertia over mass, in cell edges."""
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
    return x, y, z, inertia_of(xx, yy, zz, yz, xz, xy)


@triton.jit
def three_columns(table, cell, column, mask, factor, OUT: tl.constexpr):
    """Returns three neighbouring columns of the cells' rows, multiplied by `factor`."""
    at = table + cell * OUT + column
    x = tl.load(at, mask=mask, other=0.0) * factor
    y = tl.load(at + 1, mask=mask, other=0.0) * factor
    return x, y, tl.load(at + 2, mask=mask, other=0.0) * factor


@triton.jit
def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@triton.jit
def one_over(mass):
    """Returns 1 / mass, and 0 for a mass of 0."""
    return tl.where(mass > 0, 1 / tl.where(mass > 0, mass, 1.0), 0.0)


settle_keys(globals())
