"""What the kernels share: matrix products at a chosen precision, layer normalisation and its gradient.

Precision is a compile-time name: "tf32" rounds operands to 10 bits of mantissa with float32's range (weights come
rounded, see nearest_tf32), "half" to 10 bits with float16's range, "tf32x3" makes float32 of three TF32 products
(Triton's plain float32 product takes minutes to compile at this size), and "ieee" is what it is in the interpreter.
Sums are float32 always.
"""

from __future__ import annotations

import triton
import triton.language as tl

from hgn.kernels.keys import settle_keys

LEAKY = tl.constexpr(0.01)  # hgn.network.fcn.LEAKY_SLOPE
EPSILON = tl.constexpr(1e-5)  # torch.nn.LayerNorm's


@triton.jit
def nearest_tf32(x):
    """float32 rounded to 10 bits of mantissa, ties away from zero, as cvt.rna does.

    The matrix units drop the other bits, which alone would make every operand too small by 2^-12 on average.
    """
    bits = x.to(tl.int32, bitcast=True)
    rounded = ((bits + 0x1000) & -0x2000).to(tl.float32, bitcast=True)
    return tl.where(x == x, rounded, x)  # a NaN's bits would overflow


@triton.jit
def product(x, w, PRECISION: tl.constexpr):
    """x [R, K] @ w [K, N] in float32 accumulation."""
    if PRECISION == "half":
        result = tl.dot(x.to(tl.float16), w.to(tl.float16))
    elif PRECISION == "tf32":
        result = tl.dot(nearest_tf32(x.to(tl.float32)), w, input_precision="tf32")
    else:
        result = tl.dot(x.to(tl.float32), w.to(tl.float32), input_precision=PRECISION)
    return result


@triton.jit
def finer_product(x, w, PRECISION: tl.constexpr):
    """The same for float32 operands of moderate size, to 20 bits where `product` keeps 10: three products in float16.

    An operand is a float16 and the float16 of what that leaves.
    """
    if PRECISION == "half" or PRECISION == "tf32":
        x_high, w_high = x.to(tl.float16), w.to(tl.float16)
        x_low = (x - x_high.to(tl.float32)).to(tl.float16)
        w_low = (w - w_high.to(tl.float32)).to(tl.float16)
        result = tl.dot(x_high, w_low)
        result = tl.dot(x_low, w_high, result)
        result = tl.dot(x_high, w_high, result)
    else:
        result = product(x, w, PRECISION)
    return result


@triton.jit
def weighted_sums(w, x, PRECISION: tl.constexpr):
    """w [S, R] @ x [R, W]: S sums of x's rows, in float32 of operands rounded as those of `product`.

    Sums inside a tile run on the matrix units: as reductions they pass the rows from thread to thread.
    """
    if PRECISION == "half":
        result = tl.dot(w.to(tl.float16), x.to(tl.float16))
    elif PRECISION == "tf32":
        result = tl.dot(nearest_tf32(w), nearest_tf32(x), input_precision="tf32")
    else:
        result = tl.dot(w, x, input_precision=PRECISION)
    return result


@triton.jit
def members(SUMS: tl.constexpr, ROWS: tl.constexpr, EACH: tl.constexpr):
    """[SUMS, ROWS]: one where a row is among the EACH of a sum, else zero."""
    return tl.where(tl.arange(0, ROWS)[None, :] // EACH == tl.arange(0, SUMS)[:, None], 1.0, 0.0)


@triton.jit
def matrix(pointer, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """The row-major matrix [ROWS, COLUMNS] at `pointer`."""
    row = tl.arange(0, ROWS)
    column = tl.arange(0, COLUMNS)
    return tl.load(pointer + row[:, None] * COLUMNS + column[None, :])


@triton.jit
def transposed(pointer, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """The transpose [COLUMNS, ROWS] of the row-major matrix [ROWS, COLUMNS] at `pointer`."""
    row = tl.arange(0, ROWS)
    column = tl.arange(0, COLUMNS)
    return tl.load(pointer + row[None, :] * COLUMNS + column[:, None])


@triton.jit
def inside(vector, tile):
    """`vector`, as a value of the loop over tiles: else it is laid out for the matrix units before the loop, where each
    thread holds a quarter of it, and registers spill. Tiles are numbered from 0."""
    return tl.where(tile >= 0, vector, 0.0)


@triton.jit
def leaky(h):
    return tl.where(h > 0, h, LEAKY * h)


@triton.jit
def leaky_backward(gradient, a):
    """The gradient before the activation; `a` is its output, which has the sign of its input."""
    return tl.where(a > 0, gradient, LEAKY * gradient)


@triton.jit
def normalise(z, WIDTH: tl.constexpr):
    """Rows of zero mean and unit variance, and one over the standard deviation."""
    centred = z - (tl.sum(z, 1) / WIDTH)[:, None]
    scale = 1.0 / tl.sqrt(tl.sum(centred * centred, 1) / WIDTH + EPSILON)
    return centred * scale[:, None], scale


@triton.jit
def normalise_backward(gradient, normalised, scale, gamma, WIDTH: tl.constexpr):
    """The gradient before the normalisation, from the gradient after its gain `gamma` [W]."""
    inner = gradient * gamma[None, :]
    mean = tl.sum(inner, 1) / WIDTH
    slope = tl.sum(inner * normalised, 1) / WIDTH
    return (inner - mean[:, None] - normalised * slope[:, None]) * scale[:, None]


@triton.jit
def gathered_sum(
    x,
    table,
    row,
    count,
    capacity,
    SUM: tl.constexpr,
    EDGES: tl.constexpr,
    WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """The sums [BLOCK, W] of x's rows that the table [SUM, capacity] lists for each of `row` (-1: none).

    With EDGES, x is [capacity, SUM, W], and of the row listed for a direction the opposite direction's part is taken.
    """
    column = tl.arange(0, WIDTH)
    even, odd = tl.zeros((BLOCK, WIDTH), tl.float32), tl.zeros((BLOCK, WIDTH), tl.float32)
    for i in tl.static_range(SUM):
        where = tl.load(table + i * capacity + row, mask=row < count, other=-1)
        there = (where >= 0)[:, None]
        if EDGES:
            where = where * SUM + (i ^ 1)
        part = tl.load(x + where[:, None] * WIDTH + column[None, :], mask=there, other=0.0).to(tl.float32)
        if i % 2 == 0:
            even += part
        else:
            odd += part
    return added(even, odd)


@triton.jit
def added(x, y):
    """x + y in float32, as a reduction: so they are added where they were loaded, after both loads began.

    Of a plain sum the compiler takes each part to the matrix units' layout by itself, one after the other.
    """
    return tl.sum(tl.join(x.to(tl.float32), y.to(tl.float32)), 2)


settle_keys(globals())
