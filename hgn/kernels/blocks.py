"""What the kernels share: matrix products at a chosen precision, layer normalisation and its gradient.

Precision is a compile-time name: "tf32" rounds operands to 10 bits of mantissa with float32's range (weights come
rounded, see nearest_tf32), "fp16" to 10 bits with float16's range, "fp32" not at all, for tests.
Sums are float32 always.
"""

from __future__ import annotations

import triton
import triton.language as tl

from hgn.kernels.triton_compat import interpreting, settle_keys

# In tests: Triton takes minutes to compile float32's own product natively, or fails at it.
FP32_PRODUCT = tl.constexpr("ieee" if interpreting() else "tf32x3")
LEAKY = tl.constexpr(0.01)  # hgn.network.mlp.LEAKY_SLOPE
LAST_TILE = tl.constexpr(1 << 20)  # beyond all: elements are addressed in int32
EPSILON = tl.constexpr(1e-5)  # torch.nn.LayerNorm's


@triton.jit
def elements(row, WIDTH: tl.constexpr, WIDE: tl.constexpr):
    """Returns the places of the rows' elements [R, W] in a tensor; WIDE: it has more than int32 can count."""
    at = row[:, None] * WIDTH
    if WIDE:
        at = row.to(tl.int64)[:, None] * WIDTH
    return at + tl.arange(0, WIDTH)[None, :]


@triton.jit
def nearest_tf32(x):
    """float32 rounded to 10 bits of mantissa, ties away from zero, as cvt.rna does.

    The matrix units drop the other bits, which alone would make every operand too small by 2^-12 on average.
    """
    bits = x.to(tl.int32, bitcast=True)
    rounded = ((bits + 0x1000) & -0x2000).to(tl.float32, bitcast=True)
    return tl.where(x == x, rounded, x)  # a NaN's bits would overflow


@triton.jit
def product(x, w, PRECISION: tl.constexpr, total=None):
    """x [R, K] @ w [K, N] in float32 accumulation, added to the float32 `total` if there is one."""
    if PRECISION == "fp16":
        result = tl.dot(x.to(tl.float16), w.to(tl.float16), total)
    elif PRECISION == "tf32":
        result = tl.dot(nearest_tf32(x.to(tl.float32)), w, total, input_precision="tf32")
    else:
        result = tl.dot(x.to(tl.float32), w.to(tl.float32), total, input_precision=FP32_PRODUCT)
    return result


@triton.jit
def finer_product(x, w, PRECISION: tl.constexpr):
    """The same for float32 operands of moderate size, to 20 bits where `product` keeps 10: three products in float16.

    An operand is a float16 and the float16 of what that leaves.
    """
    if PRECISION == "fp16" or PRECISION == "tf32":
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
    if PRECISION == "fp16":
        result = tl.dot(w.to(tl.float16), x.to(tl.float16))
    elif PRECISION == "tf32":
        result = tl.dot(nearest_tf32(w), nearest_tf32(x), input_precision="tf32")
    else:
        result = tl.dot(w, x, input_precision=FP32_PRODUCT)
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
def vectors(pointer, at_0, at_1, at_2, at_3, at_4, WIDTH: tl.constexpr):
    """Up to five vectors [WIDTH], as rows of a matrix [8, WIDTH] from which `vector` takes them, for a loop over tiles;
    zeros where the place is below zero.

    A plain load with fewer elements than threads the compiler repeats in each layout that it is used in, and each stays
    in registers, of which there are too few. It does not repeat one of this size.
    """
    row = tl.arange(0, 8)
    at = tl.where(row == 0, at_0, tl.where(row == 1, at_1, tl.where(row == 2, at_2, tl.where(row == 3, at_3, at_4))))
    return tl.load(pointer + at[:, None] + tl.arange(0, WIDTH)[None, :], mask=(at >= 0)[:, None], other=0.0)


@triton.jit
def optional_vector(pointer, at, WIDTH: tl.constexpr):
    """The vector [WIDTH] at place `at`, zeros where that is below zero."""
    place = at + tl.zeros((WIDTH,), tl.int32)  # a mask of one number Triton 3.9's interpreter does not take
    return tl.load(pointer + place + tl.arange(0, WIDTH), mask=place >= 0, other=0.0)


@triton.jit
def vector(matrix, number: tl.constexpr):
    return tl.sum(tl.where(tl.arange(0, 8)[:, None] == number, matrix, 0.0), 0)


@triton.jit
def once_both(x, y, never):
    """x, in the place where both x and y are loaded; `never` is false, but not known to be.

    The compiler takes what it loaded to shared memory at once, and waits for it, before it begins the next load.
    """
    return added(x, tl.where(never, y.to(x.dtype), 0.0))


@triton.jit
def nothing_to_do(count, BLOCK: tl.constexpr):
    """Returns whether a program has no rows. The first one stays, and waits for the previous kernel if all are idle."""
    return (tl.program_id(0) * BLOCK >= count) & (tl.program_id(0) > 0)


@triton.jit
def inside(vector, tile):
    """`vector`, as a value of the loop over tiles: else it is laid out for the matrix units before the loop, where each
    thread holds a quarter of it, and registers spill. Tiles are numbered from 0."""
    return tl.where(tile >= 0, vector, 0.0)


@triton.jit
def next_tile(tile, ONCE: tl.constexpr):
    """The program's tile after this one. ONCE: there is none, and the compiler sees it: it drops the loop, before which
    it would work out addresses that take up registers."""
    if ONCE:
        tile = tile * 0 + LAST_TILE
    else:
        tile += tl.num_programs(0)
    return tile


@triton.jit
def leaky(h):
    return tl.maximum(h, h * LEAKY)  # two instructions, where a choice by sign takes three


@triton.jit
def leaky_operand(h, PRECISION: tl.constexpr):
    """leaky(h) for a product: in fp16 of float16 numbers, two in an instruction."""
    if PRECISION == "fp16":
        h = h.to(tl.float16)
        a = leaky(h)
    else:
        a = leaky(h)
    return a


@triton.jit
def leaky_backward(gradient, a):
    """The gradient before the activation; `a` is its output, which has the sign of its input."""
    return tl.where(a > 0, gradient, gradient * LEAKY)


@triton.jit
def normalise(z, WIDTH: tl.constexpr):
    """Rows of zero mean and unit variance, and one over the standard deviation."""
    centred = z - (tl.sum(z, 1) / WIDTH)[:, None]
    rstd = 1.0 / tl.sqrt(tl.sum(centred * centred, 1) / WIDTH + EPSILON)
    return centred * rstd[:, None], rstd


@triton.jit
def normalise_once(z, WIDTH: tl.constexpr, PRECISION: tl.constexpr):
    """The same, at the lower precisions with both sums at once: cancellation costs less than their operands' rounding
    as long as a row's mean is within some ten standard deviations."""
    if PRECISION == "fp16":
        mean = tl.sum(z, 1) / WIDTH
        variance = tl.maximum(tl.sum(z * z, 1) / WIDTH - mean * mean, 0.0)
        rstd = 1.0 / tl.sqrt(variance + EPSILON)
        z = z * rstd[:, None] - (mean * rstd)[:, None]
    else:
        z, rstd = normalise(z, WIDTH)
    return z, rstd


@triton.jit
def with_column(value, number, x):
    """`value` [N, F] with the column x [N] in place of one of its own."""
    column = tl.arange(0, value.shape[1])
    return tl.where((column == number)[None, :], x[:, None], value)


@triton.jit
def chosen_rows(ROWS: tl.constexpr, EACH: tl.constexpr, CHOICES: tl.constexpr):
    """[ROWS, CHOICES]: one where a choice is a row's, EACH rows after one another having the same, else zero.

    A product with it is exact, and spares reading a row as often as it is used.
    """
    return tl.where(tl.arange(0, ROWS)[:, None] // EACH == tl.arange(0, CHOICES)[None, :], 1.0, 0.0)


@triton.jit
def high_and_low(pointer, FIRST: tl.constexpr, SUMS: tl.constexpr, WIDTH: tl.constexpr, PRECISION: tl.constexpr):
    """[SUMS, W]: from row FIRST on the rows of the matrix [3, W] at `pointer` as operands of a product, and after them
    what that rounds away of them; zeros elsewhere."""
    row = tl.arange(0, SUMS)
    place = row - FIRST
    inside = (place >= 0) & (place < 6)
    rows = tl.load(
        pointer + (place % 3)[:, None] * WIDTH + tl.arange(0, WIDTH)[None, :], mask=inside[:, None], other=0.0
    )
    if PRECISION == "fp16":
        high = rows.to(tl.float16).to(tl.float32)
        rows = tl.where((place < 3)[:, None], high, rows - high)
    else:
        rows = tl.where((place < 3)[:, None], rows, 0.0)
    return rows


@triton.jit
def normalise_backward(gradient, normalised, rstd, gamma, WIDTH: tl.constexpr):
    """The gradient before the normalisation, from the gradient after its weight `gamma` [W]."""
    inner = gradient * gamma[None, :]
    mean = tl.sum(inner, 1) / WIDTH
    slope = tl.sum(inner * normalised, 1) / WIDTH
    return (inner - mean[:, None] - normalised * slope[:, None]) * rstd[:, None]


@triton.jit
def column_sums(x, ROWS: tl.constexpr, WIDTH: tl.constexpr, APART: tl.constexpr):
    """Sums [APART, W] over the rows of x [ROWS, W], each of every APART-th row, for whoever adds up many tiles first.

    With two rows a warp (as many as 16-byte loads of 128 float16 take) a thread adds its own rows only; a whole sum
    passes them from thread to thread, with barriers, in each tile.
    """
    return tl.sum(tl.reshape(x, (ROWS // APART, APART, WIDTH)), 0)


@triton.jit
def listed(table, row, count, capacity, SUM: tl.constexpr, EDGES: tl.constexpr):
    """For each of `row` the rows that the table [SUM, capacity] lists, as a tuple; below zero: none.

    With EDGES they are rows of [capacity, SUM, W]: of the row listed for a direction the opposite direction's part.
    """
    summands = ()
    for i in tl.static_range(SUM):
        where = tl.load(table + i * capacity + row, mask=row < count, other=-1)
        if EDGES:
            where = where * SUM + (i ^ 1)
        summands = summands + (where,)  # noqa: RUF005 - Triton knows no unpacking here
    return summands


@triton.jit
def gathered_sum(x, summands, SUM: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr):
    """The sums [BLOCK, W] of x's rows `summands` by `listed`."""
    column = tl.arange(0, WIDTH)
    # so many reads begin before the first is waited for
    TOGETHER: tl.constexpr = SUM if BLOCK <= 16 else 2
    for start in tl.static_range(0, SUM, TOGETHER):
        parts = ()
        for i in tl.static_range(start, start + TOGETHER):
            where = summands[i]
            part = tl.load(x + where[:, None] * WIDTH + column[None, :], mask=(where >= 0)[:, None], other=0.0)
            parts = parts + (part,)  # noqa: RUF005
        for i in tl.static_range(0, TOGETHER, 2):
            two = added(parts[i].to(tl.float32), parts[i + 1].to(tl.float32))
            if start + i == 0:
                total = two
            else:
                total = added(total, two)
    return total


@triton.jit
def settled(total):
    """A product as it is, in a loop whose next tiles are copied to shared memory meanwhile; no instruction.

    For a product that nothing in the loop reads the compiler waits one round later. Of a tile that is read twice, by
    the product and by others, it keeps one buffer too few for that (Triton 3.6 and 3.9): the tile after the next would
    be copied over the one that is being multiplied. The interpreter knows no such thing.
    """
    return tl.inline_asm_elementwise("", "=f,0", [total], dtype=tl.float32, is_pure=True, pack=1)


@triton.jit
def added(x, y):
    """x + y in their type, as a reduction: so they are added where they were loaded, after both loads began.

    Of a plain sum the compiler takes each part to the matrix units' layout by itself, one after the other.
    """
    return tl.sum(tl.join(x, y), 2)


settle_keys(globals())
