"""Cells in hash buckets: how a scene's are put there, and how the device finds them.

Row of a table of scenes, int64: it begins with the addresses of the buckets (0: no cells), of their keys, and of what
belongs to each, and the mask of the buckets.
Shape legend: K cells, B buckets.
"""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl

from hgn.kernels.triton_compat import settle_keys
from hgn.network.cell_keys import COORDINATE_LIMIT, HASH_PRIMES, pack

LIMIT = tl.constexpr(COORDINATE_LIMIT)
PRIME_X, PRIME_Y, PRIME_Z = (tl.constexpr(prime) for prime in HASH_PRIMES)


def in_buckets(cell_K3: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Of cells int [K, 3] their buckets int32 [B + 1], the cells of bucket b from bucket_B[b] to bucket_B[b + 1], and
    in that order their keys int64 [K] and which they were, int64 [K].
    """
    count = len(cell_K3)
    mask = (1 << max(4, math.ceil(math.log2(2 * max(count, 1))))) - 1
    shifted_K3 = cell_K3.long() + COORDINATE_LIMIT
    x, y, z = (shifted_K3 * torch.tensor(HASH_PRIMES, device=shifted_K3.device)).unbind(-1)
    mixed = x ^ y ^ z
    place_K = (mixed ^ mixed >> 15) & mask
    order_K = torch.argsort(place_K, stable=True)
    size_B = torch.bincount(place_K, minlength=mask + 1)
    bucket_B = torch.cat([size_B.new_zeros(1), size_B.cumsum(0)]).int()
    key_K = pack(torch.zeros_like(place_K), cell_K3.long())
    return bucket_B, key_K[order_K].contiguous(), order_K


@triton.jit
def find_cell(x, y, z, line, live):
    """Place of the cell (x, y, z) among its scene's, -1 where it is not there; `line` is the scene's row."""
    key = ((x + LIMIT) * (2 * LIMIT) + y + LIMIT) * (2 * LIMIT) + z + LIMIT
    mixed = (x + LIMIT) * PRIME_X ^ (y + LIMIT) * PRIME_Y ^ (z + LIMIT) * PRIME_Z
    place = (mixed ^ mixed >> 15) & tl.load(line + 3, mask=live, other=0)
    bucket = tl.load(line, mask=live, other=0).to(tl.pointer_type(tl.int32))
    entry_key = tl.load(line + 1, mask=live, other=0).to(tl.pointer_type(tl.int64))
    start = tl.load(bucket + place, mask=live, other=0)
    end = tl.load(bucket + place + 1, mask=live, other=0)
    entry = tl.zeros_like(start) - 1
    ask = live & (start < end)
    while tl.max(ask.to(tl.int32)) > 0:
        here = tl.load(entry_key + start, mask=ask, other=-1)
        entry = tl.where(ask & (here == key), start, entry)
        start += 1
        ask = ask & (start < end)
    return entry


settle_keys(globals())
