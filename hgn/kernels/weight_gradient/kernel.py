"""Computes weight and bias gradients: products A^T B over rows, and column sums of A, divided into chunks of rows.

The job table has a row for each product: offsets of A, B and the result, index in `counts`, widths of A and B, number
of rows per counted particle or cell, offset of the column sums (-1: none). Offsets count elements.
"""

import triton
import triton.language as tl

from hgn.kernels.blocks import FP32_PRODUCT, column_sums, settled
from hgn.kernels.triton_compat import settle_keys

JOB_COLUMNS = 8


@triton.jit
def weight_gradient(
    left, right, totals, jobs, chunk_job, chunk_first, counts, unscale,
    TILE: tl.constexpr, CHUNK: tl.constexpr, STEP: tl.constexpr, PRECISION: tl.constexpr,
    PIPELINED: tl.constexpr,
):  # fmt: skip
    """Adds, in program i, chunk i's part of its job's A^T B [width A, width B] to `totals`. Widths are at most TILE.

    PIPELINED: the compiler copies tiles to shared memory two ahead. The interpreter cannot do this.

    Rule: torch.nn.Linear; reference and test: tests/kernels/references.py, test_kernels_alone.py.
    """
    job = jobs + tl.load(chunk_job + tl.program_id(0)) * 8
    first = tl.load(chunk_first + tl.program_id(0))
    rows = tl.load(counts + tl.load(job + 3)) * tl.load(job + 6)
    if first >= rows:
        return
    a_at = tl.multiple_of(tl.load(job), 16)
    b_at = tl.multiple_of(tl.load(job + 1), 16)
    out_at = tl.multiple_of(tl.load(job + 2), 16)
    a_width = tl.multiple_of(tl.load(job + 4), 16)
    b_width = tl.multiple_of(tl.load(job + 5), 16)
    column = tl.arange(0, TILE)
    total = tl.zeros((TILE, TILE), tl.float32)
    lines = tl.zeros((16, TILE), tl.float32)
    last = tl.minimum(rows, first + CHUNK)
    for start in range(0, CHUNK, STEP):
        row = first + start + tl.arange(0, STEP)
        place = row[:, None]
        live = (row < last)[:, None]
        a = tl.load(left + a_at + place * a_width + column[None, :], mask=live & (column < a_width)[None, :], other=0.0)
        b = tl.load(
            right + b_at + place * b_width + column[None, :], mask=live & (column < b_width)[None, :], other=0.0
        )
        lines += column_sums(a.to(tl.float32), STEP, TILE, 16)
        if PRECISION == "fp16":
            total = tl.dot(tl.trans(a.to(tl.float16)), b.to(tl.float16), total)
        elif PRECISION == "tf32":
            total = tl.dot(tl.trans(a), b, total, input_precision="tf32")
        else:
            total = tl.dot(tl.trans(a), b, total, input_precision=FP32_PRODUCT)
        if PIPELINED:
            total = settled(total)
    bias_at = tl.load(job + 7)
    if bias_at >= 0:
        tl.atomic_add(totals + bias_at + column, tl.sum(lines, 0) * unscale, mask=column < a_width, sem="relaxed")
    at = out_at + column[:, None] * b_width + column[None, :]
    mask = (column < a_width)[:, None] & (column < b_width)[None, :]
    tl.atomic_add(totals + at, total * unscale, mask=mask, sem="relaxed")


settle_keys(globals())
