"""Singular value decomposition of 3 x 3 matrices in float32, for Taichi kernels.

Jacobi rotations diagonalise AᵀA. Then the columns of A V are made orthogonal, from the largest to the smallest. So
A = U diag(sigma) Vᵀ holds to a few float32 roundings of the largest singular value, also for singular and inverted A. U
and V are rotations. An inverted A gives its smallest singular value a minus sign.
"""

import taichi as ti

SWEEPS = 6
# square of an off-diagonal term relative to a_pp a_qq; smaller terms are rounding errors
OFF_DIAGONAL_SQUARE = 1e-14


@ti.func
def _inverse_root(x: ti.f32) -> ti.f32:
    """Returns 1 / sqrt(x) correct to rounding. A GPU's own function is less accurate."""
    y = ti.rsqrt(x)
    return y * (1.5 - 0.5 * x * y * y)


@ti.func
def _rotate(S: ti.template(), V: ti.template(), p: ti.template(), q: ti.template()):
    r = ti.static(3 - p - q)
    apq = S[p, q]
    # the rotation has half the angle whose tangent is 2 a_pq / (a_qq - a_pp), so at most 45 degrees
    difference = S[q, q] - S[p, p]
    inverse = _inverse_root(difference * difference + 4.0 * apq * apq)
    square = 0.5 + 0.5 * ti.abs(difference) * inverse
    inverse_c = _inverse_root(square)
    c = square * inverse_c
    s = apq * inverse * inverse_c
    if difference < 0.0:
        s = -s
    t = s * inverse_c
    S[p, p] -= t * apq
    S[q, q] += t * apq
    S[p, q] = 0.0
    S[q, p] = 0.0
    spr = S[p, r]
    sqr = S[q, r]
    S[p, r] = c * spr - s * sqr
    S[q, r] = s * spr + c * sqr
    S[r, p] = S[p, r]
    S[r, q] = S[q, r]
    for i in ti.static(range(3)):
        vp = V[i, p]
        vq = V[i, q]
        V[i, p] = c * vp - s * vq
        V[i, q] = s * vp + c * vq


@ti.func
def _significant(S: ti.template(), p: ti.template(), q: ti.template()) -> ti.i32:
    return S[p, q] * S[p, q] > OFF_DIAGONAL_SQUARE * ti.abs(S[p, p] * S[q, q])


@ti.func
def _swap_columns(B: ti.template(), V: ti.template(), square: ti.template(), p: ti.template(), q: ti.template()):
    """Orders columns p < q by descending length. If it swaps them, one changes its sign, so that V stays a rotation."""
    if square[p] < square[q]:
        square[p], square[q] = square[q], square[p]
        for i in ti.static(range(3)):
            bp = B[i, p]
            B[i, p] = B[i, q]
            B[i, q] = -bp
            vp = V[i, p]
            V[i, p] = V[i, q]
            V[i, q] = -vp


@ti.func
def _perpendicular(u: ti.template()) -> ti.math.vec3:
    """Returns a unit vector perpendicular to the unit vector u."""
    other = ti.Vector([1.0, 0.0, 0.0])
    if ti.abs(u[0]) > 0.6:
        other = ti.Vector([0.0, 1.0, 0.0])
    out = u.cross(other)
    return out / out.norm()


@ti.func
def svd3(A: ti.template()):
    """Returns U, sigma, V of a finite matrix. sigma descends in size; except for rounding only its last is negative."""
    scale = 0.0
    for i, j in ti.static(ti.ndrange(3, 3)):
        scale = ti.max(scale, ti.abs(A[i, j]))
    V = ti.Matrix.identity(ti.f32, 3)
    U = ti.Matrix.identity(ti.f32, 3)
    sigma = ti.Vector([0.0, 0.0, 0.0])
    if scale > 0.0:
        B = A * (1.0 / scale) if scale > 1e-30 else A / scale
        S = B.transpose() @ B
        sweep = 0
        while sweep < SWEEPS:
            rotated = 0
            if _significant(S, 0, 1):
                _rotate(S, V, 0, 1)
                rotated = 1
            if _significant(S, 0, 2):
                _rotate(S, V, 0, 2)
                rotated = 1
            if _significant(S, 1, 2):
                _rotate(S, V, 1, 2)
                rotated = 1
            sweep = SWEEPS if rotated == 0 else sweep + 1
        B = B @ V
        square = ti.Vector([0.0, 0.0, 0.0])
        for j in ti.static(range(3)):
            square[j] = B[0, j] * B[0, j] + B[1, j] * B[1, j] + B[2, j] * B[2, j]
        _swap_columns(B, V, square, 0, 1)
        _swap_columns(B, V, square, 0, 2)
        _swap_columns(B, V, square, 1, 2)
        b0 = ti.Vector([B[0, 0], B[1, 0], B[2, 0]])
        b1 = ti.Vector([B[0, 1], B[1, 1], B[2, 1]])
        b2 = ti.Vector([B[0, 2], B[1, 2], B[2, 2]])
        u0 = b0 * _inverse_root(square[0])
        b1 -= u0 * u0.dot(b1)
        length_square = b1.dot(b1)
        u1 = _perpendicular(u0)
        if length_square > 1e-14:  # relative to the largest entry's square; a shorter column's direction is rounding
            u1 = b1 * _inverse_root(length_square)
            u1 -= u0 * u0.dot(u1)
            u1 *= _inverse_root(u1.dot(u1))
        u2 = u0.cross(u1)
        for i in ti.static(range(3)):
            U[i, 0] = u0[i]
            U[i, 1] = u1[i]
            U[i, 2] = u2[i]
        sigma = scale * ti.Vector([u0.dot(b0), u1.dot(b1), u2.dot(b2)])
    return U, sigma, V
