"""Finds cells in a scene's hash buckets (hgn.network.cell_keys.in_buckets) on the device.

A row of a table of scenes, int64, begins with four numbers: the addresses of the buckets (0: no cells), of their keys,
and of the values of the cells, and the mask of the buckets.
"""

import triton
import triton.language as tl

from hgn.kernels.triton_compat import settle_keys
from hgn.network.cell_keys import COORDINATE_LIMIT, HASH_PRIMES

LIMIT = tl.constexpr(COORDINATE_LIMIT)
PRIME_X, PRIME_Y, PRIME_Z = (tl.constexpr(prime) for prime in HASH_PRIMES)


@triton.jit
def find_cell(x, y, z, line, live):
    """Returns the index of the cell (x, y, z), whole numbers in floats, among its scene's cells, or -1.
    `line` is the scene's row of the table."""
    near = live & (tl.abs(x) < LIMIT) & (tl.abs(y) < LIMIT) & (tl.abs(z) < LIMIT)
    x = tl.where(near, x, 0.0).to(tl.int64)
    y = tl.where(near, y, 0.0).to(tl.int64)
    z = tl.where(near, z, 0.0).to(tl.int64)
    address = tl.load(line, mask=near, other=0)
    near = near & (address != 0)
    key = ((x + LIMIT) * (2 * LIMIT) + y + LIMIT) * (2 * LIMIT) + z + LIMIT
    mixed = (x + LIMIT) * PRIME_X ^ (y + LIMIT) * PRIME_Y ^ (z + LIMIT) * PRIME_Z
    place = (mixed ^ mixed >> 15) & tl.load(line + 3, mask=near, other=0)
    bucket = address.to(tl.pointer_type(tl.int32))
    entry_key = tl.load(line + 1, mask=near, other=0).to(tl.pointer_type(tl.int64))
    start = tl.load(bucket + place, mask=near, other=0)
    end = tl.load(bucket + place + 1, mask=near, other=0)
    entry = tl.zeros_like(start) - 1
    ask = near & (start < end)
    while tl.max(ask.to(tl.int32)) > 0:
        here = tl.load(entry_key + start, mask=ask, other=-1)
        entry = tl.where(ask & (here == key), start, entry)
        start += 1
        ask = ask & (start < end)
    return entry


settle_keys(globals())
