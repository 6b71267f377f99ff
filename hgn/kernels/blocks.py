"""Holds functions that several kernels use, such as matrix products at a chosen precision and layer normalisation.

With tf32 operands have 10 bits of mantissa and float32's range; the host rounds weights beforehand (nearest_tf32). With
fp16 operands have 10 bits and float16's range. With fp32, only for tests, nothing is rounded. Sums are always float32.
"""

import triton
import triton.language as tl

from hgn.kernels.triton_compat import interpreting, settle_keys

# Only tests use fp32. Triton takes minutes to compile float32's native product, or fails.
FP32_PRODUCT = tl.constexpr("ieee" if interpreting() else "tf32x3")
LEAKY = tl.constexpr(0.01)  # hgn.network.mlp.LEAKY_SLOPE
LAST_TILE = tl.constexpr(1 << 20)  # above all tile numbers if BLOCK * WIDTH >= 2048: int32 addresses 2^31 elements
EPSILON = tl.constexpr(1e-5)  # torch.nn.LayerNorm's


@triton.jit
def elements(row, WIDTH: tl.constexpr, WIDE: tl.constexpr):
    """Returns the indices of the rows' elements [R, W] in a tensor. WIDE: int32 cannot count all its elements."""
    at = row[:, None] * WIDTH
    if WIDE:
        at = row.to(tl.int64)[:, None] * WIDTH
    return at + tl.arange(0, WIDTH)[None, :]


@triton.jit
def nearest_tf32(x):
    """Returns float32 rounded to 10 bits of mantissa, ties away from zero, as the instruction cvt.rna does.

    The matrix units only drop the other bits. Without rounding, operands would be too small by 2^-11.5 on average.
    """
    bits = x.to(tl.int32, bitcast=True)
    rounded = ((bits + 0x1000) & -0x2000).to(tl.float32, bitcast=True)
    return tl.where(x == x, rounded, x)  # the bits of a NaN would overflow


@triton.jit
def product(x, w, PRECISION: tl.constexpr, total=None):
    """Returns x [R, K] @ w [K, N] accumulated in float32, plus the float32 `total` if it is given."""
    if PRECISION == "fp16":
        result = tl.dot(x.to(tl.float16), w.to(tl.float16), total)
    elif PRECISION == "tf32":
        result = tl.dot(nearest_tf32(x.to(tl.float32)), w, total, input_precision="tf32")
    else:
        result = tl.dot(x.to(tl.float32), w.to(tl.float32), total, input_precision=FP32_PRODUCT)
    return result


@triton.jit
def finer_product(x, w, PRECISION: tl.constexpr):
    """Returns x @ w for float32 operands in float16's range, to 20 bits instead of 10, by three products in float16.

    Each operand is split into a float16 number and the remainder in float16.
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
    """Returns w [S, R] @ x [R, W]: S weighted sums of x's rows in float32. Operands are rounded as those of `product`.

    The matrix units compute sums inside a tile. Reductions would pass the rows from thread to thread.
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
    """Returns a matrix [SUMS, ROWS] of zeros and ones. Its product with rows [ROWS, W] sums up EACH rows at a time."""
    return tl.where(tl.arange(0, ROWS)[None, :] // EACH == tl.arange(0, SUMS)[:, None], 1.0, 0.0)


@triton.jit
def matrix(pointer, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """Loads the row-major matrix [ROWS, COLUMNS] at `pointer`."""
    row = tl.arange(0, ROWS)
    column = tl.arange(0, COLUMNS)
    return tl.load(pointer + row[:, None] * COLUMNS + column[None, :])


@triton.jit
def transposed(pointer, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """Loads the transpose [COLUMNS, ROWS] of the row-major matrix [ROWS, COLUMNS] at `pointer`."""
    row = tl.arange(0, ROWS)
    column = tl.arange(0, COLUMNS)
    return tl.load(pointer + row[None, :] * COLUMNS + column[:, None])


@triton.jit
def vectors(pointer, at_0, at_1, at_2, at_3, at_4, WIDTH: tl.constexpr):
    """Loads up to five vectors [WIDTH] as rows of a matrix [8, WIDTH], for kernels with a loop over tiles.

    A row is zero if its place is below zero. If a plain load has fewer elements than the program has threads, the
    compiler repeats the load for each layout that uses it, and each copy takes registers. It repeats no larger load.
    """
    row = tl.arange(0, 8)
    at = tl.where(row == 0, at_0, tl.where(row == 1, at_1, tl.where(row == 2, at_2, tl.where(row == 3, at_3, at_4))))
    return tl.load(pointer + at[:, None] + tl.arange(0, WIDTH)[None, :], mask=(at >= 0)[:, None], other=0.0)


@triton.jit
def optional_vector(pointer, at, WIDTH: tl.constexpr):
    """Loads the vector [WIDTH] at place `at`, or zeros if `at` is below zero."""
    place = at + tl.zeros((WIDTH,), tl.int32)  # Triton 3.9's interpreter does not accept a scalar mask
    return tl.load(pointer + place + tl.arange(0, WIDTH), mask=place >= 0, other=0.0)


@triton.jit
def vector(matrix, number: tl.constexpr):
    return tl.sum(tl.where(tl.arange(0, 8)[:, None] == number, matrix, 0.0), 0)


@triton.jit
def once_both(x, y, never):
    """Returns x unchanged. `never` is always false, but the compiler cannot know this, and waits for both x and y.

    Otherwise it waits for x, and moves x to shared memory, before it begins the load of y.
    """
    return added(x, tl.where(never, y.to(x.dtype), 0.0))


@triton.jit
def nothing_to_do(count, BLOCK: tl.constexpr):
    """Returns whether a program has no rows and may end. The first one never may: it waits for the previous kernel."""
    return (tl.program_id(0) * BLOCK >= count) & (tl.program_id(0) > 0)


@triton.jit
def inside(vector, tile):
    """Returns `vector` unchanged. The condition is always true, because tiles are numbered from 0. The compiler cannot
    know this, and computes the result in each round of the loop over tiles. Otherwise each thread would keep a quarter
    of the vector in the layout of the matrix units from before the loop, and registers would spill."""
    return tl.where(tile >= 0, vector, 0.0)


@triton.jit
def next_tile(tile, ONCE: tl.constexpr):
    """Returns the program's next tile. With ONCE a program has one tile, and the compiler removes the loop."""
    if ONCE:
        tile = tile * 0 + LAST_TILE
    else:
        tile += tl.num_programs(0)
    return tile


@triton.jit
def leaky(h):
    return tl.maximum(h, h * LEAKY)  # takes two instructions; a choice by sign takes three


@triton.jit
def leaky_operand(h, PRECISION: tl.constexpr):
    """Returns leaky(h) as a product's operand. In fp16 it computes in float16, two numbers per instruction."""
    if PRECISION == "fp16":
        h = h.to(tl.float16)
        a = leaky(h)
    else:
        a = leaky(h)
    return a


@triton.jit
def leaky_backward(gradient, a):
    """Returns the gradient before the activation. Its output `a` has the sign of its input."""
    return tl.where(a > 0, gradient, gradient * LEAKY)


@triton.jit
def normalise(z, WIDTH: tl.constexpr):
    """Returns rows scaled to zero mean and unit variance, and one over the standard deviation."""
    centred = z - (tl.sum(z, 1) / WIDTH)[:, None]
    rstd = 1.0 / tl.sqrt(tl.sum(centred * centred, 1) / WIDTH + EPSILON)
    return centred * rstd[:, None], rstd


@triton.jit
def normalise_once(z, WIDTH: tl.constexpr, PRECISION: tl.constexpr):
    """Returns the same as `normalise`, and in fp16 computes both sums in one pass. The cancellation then costs less
    precision than the rounding of operands if the |mean| of a row is below about ten standard deviations."""
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
    """Returns `value` [N, F] with column `number` replaced by x [N]."""
    column = tl.arange(0, value.shape[1])
    return tl.where((column == number)[None, :], x[:, None], value)


@triton.jit
def chosen_rows(ROWS: tl.constexpr, EACH: tl.constexpr, CHOICES: tl.constexpr):
    """Returns a matrix [ROWS, CHOICES] of zeros and ones. Its product with [CHOICES, W] repeats each row EACH times.

    The product is exact for rows that its precision does not round, and loads each row only once.
    """
    return tl.where(tl.arange(0, ROWS)[:, None] // EACH == tl.arange(0, CHOICES)[None, :], 1.0, 0.0)


@triton.jit
def high_and_low(pointer, FIRST: tl.constexpr, SUMS: tl.constexpr, WIDTH: tl.constexpr, PRECISION: tl.constexpr):
    """Returns rows [SUMS, W] for the matrix [3, W] at `pointer`. Rows FIRST to FIRST + 2 are its rows, in fp16 rounded.
    In fp16 the next three rows are the parts that the rounding removes. All other rows are zero."""
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
    """Returns the gradient before the normalisation from the gradient after the multiplication by `gamma` [W]."""
    inner = gradient * gamma[None, :]
    mean = tl.sum(inner, 1) / WIDTH
    slope = tl.sum(inner * normalised, 1) / WIDTH
    return (inner - mean[:, None] - normalised * slope[:, None]) * rstd[:, None]


@triton.jit
def column_sums(x, ROWS: tl.constexpr, WIDTH: tl.constexpr, APART: tl.constexpr):
    """Returns sums [APART, W] over every APART-th row of x [ROWS, W], which the caller adds up over many tiles.

    If a warp loads two rows at a time (16 bytes a thread, 128 float16 a row), a thread adds only rows that it has
    loaded. A sum over all rows would pass them from thread to thread, with barriers, in each tile.
    """
    return tl.sum(tl.reshape(x, (ROWS // APART, APART, WIDTH)), 0)


@triton.jit
def listed(table, row, count, capacity, SUM: tl.constexpr, EDGES: tl.constexpr):
    """Returns SUM listed rows for each element of `row`, as a tuple, from the table [SUM, capacity]; negative: no row.

    With EDGES the table lists cells, and the results are rows of the edges [capacity, SUM, W]: for entry i of the table
    edge i ^ 1 of the listed cell, which has the opposite direction.
    """
    summands = ()
    for i in tl.static_range(SUM):
        where = tl.load(table + i * capacity + row, mask=row < count, other=-1)
        if EDGES:
            where = where * SUM + (i ^ 1)
        summands = summands + (where,)  # noqa: RUF005 - Triton does not support unpacking here
    return summands


@triton.jit
def gathered_sum(x, summands, SUM: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr):
    """Returns the sums [BLOCK, W] of the rows `summands` of x, which `listed` returns."""
    column = tl.arange(0, WIDTH)
    # The kernel begins this number of reads before it waits for the first one.
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
    """Returns a product unchanged, without an instruction, in a loop whose next tiles are copied to shared memory.

    If nothing in the loop reads the product, the compiler waits for it one round later. If another operation, such as
    column_sums, reads the same tile, the compiler then has one buffer too few (Triton 3.6 and 3.9): it would copy the
    tile after the next over the tile that is being multiplied. The interpreter does not need this function.
    """
    return tl.inline_asm_elementwise("", "=f,0", [total], dtype=tl.float32, is_pure=True, pack=1)


@triton.jit
def added(x, y):
    """Returns x + y in their type by a reduction, which adds them in the layout of their loads, after both loads began.

    For a plain sum the compiler would first convert x and y, one after the other, to the matrix units' layout.
    """
    return tl.sum(tl.join(x, y), 2)


settle_keys(globals())
