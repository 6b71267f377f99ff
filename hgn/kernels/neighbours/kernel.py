"""Neighbour lists on the device (hgn.network.neighbours): keys of cells, runs of candidates, two walks through them.

Keys are those of hgn.network.cell_keys; a particle's candidates are 25 runs of the particles sorted by key. The first
walk counts neighbours, the second writes them down. Nothing here waits for the host.
Shape legend: N particles, E directed edges.
"""

from __future__ import annotations

import triton
import triton.language as tl

from hgn.kernels.triton_compat import settle_keys
from hgn.network import cell_keys, neighbours

COORDINATE_BITS = tl.constexpr(cell_keys.COORDINATE_BITS)
COORDINATE_LIMIT = tl.constexpr(cell_keys.COORDINATE_LIMIT)
REACH = tl.constexpr(neighbours.REACH)
RUNS = tl.constexpr(25)
BEHIND = tl.constexpr(0x7FFFFFFFFFFFFFFF)  # the key of rows without a particle
OVERFLOW = tl.constexpr(1)  # more edges than there is room for
OUT_OF_WINDOW = tl.constexpr(2)  # a particle is not finite or too far from the origin


@triton.jit
def pack_cells(position, scene_of, particle_count, key, status, size, particles, BLOCK: tl.constexpr):
    """key [N], int64, of each particle's cell; rows beyond particle_count come behind all.

    Reference: hgn.network.neighbours.neighbour_list; test: tests/kernels/test_neighbours.py.
    """
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = row < tl.load(particle_count)
    packed = tl.load(scene_of + row, mask=live, other=0).to(tl.int64)
    inside = live
    for axis in tl.static_range(3):
        x = tl.load(position + row * 3 + axis, mask=live, other=0.0)
        cell = tl.floor(tl.div_rn(x, size))
        inside = inside & (tl.abs(cell) < COORDINATE_LIMIT - REACH - 1)  # NaN is not
        cell = tl.where(inside, cell, 0.0).to(tl.int64)
        packed = (packed << COORDINATE_BITS) | (cell + COORDINATE_LIMIT)
    lost = tl.sum((live & (inside == 0)).to(tl.int32), 0)
    if lost > 0:
        tl.atomic_or(status, OUT_OF_WINDOW)
    tl.store(key + row, tl.where(live, packed, BEHIND), mask=row < particles)


@triton.jit
def find_runs(
    key, particle_count, run_end, run_shift, particles, SIDE: tl.constexpr, STEPS: tl.constexpr, BLOCK: tl.constexpr
):
    """Of each sorted particle's runs of candidates, int32 [N, SIDE]: where each ends when they are counted one after
    the other, and what takes such a number to a place in the sorted particles. SIDE is RUNS, and empty ones.

    Reference: hgn.network.neighbours.neighbour_list; test: tests/kernels/test_neighbours.py.
    """
    count = tl.load(particle_count)
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = (place < count)[:, None]
    run = tl.arange(0, SIDE)
    width: tl.constexpr = 2 * REACH + 1
    column = ((run // width - REACH).to(tl.int64) << 2 * COORDINATE_BITS) - REACH
    column += (run % width - REACH).to(tl.int64) << COORDINATE_BITS
    own = tl.load(key + place, mask=place < count, other=0)
    wanted = own[:, None] + column[None, :]
    bound = ()
    for end in tl.static_range(2):  # the first key that is not below the run's, and the first above them
        low = tl.zeros((BLOCK, SIDE), tl.int32)
        high = low + count
        for _ in tl.static_range(STEPS):
            middle = (low + high) // 2
            open_ = low < high
            below = tl.load(key + middle, mask=open_, other=0) < wanted + end * width
            low = tl.where(open_ & below, middle + 1, low)
            high = tl.where(open_ & (below == 0), middle, high)
        bound = bound + (low,)  # noqa: RUF005 - Triton knows no unpacking here
    length = tl.where(live & (run < RUNS)[None, :], bound[1] - bound[0], 0)
    after = tl.cumsum(length, 1)
    at = place[:, None] * SIDE + run[None, :]
    tl.store(run_end + at, after, mask=(place < particles)[:, None])
    tl.store(run_shift + at, bound[0] - after + length, mask=(place < particles)[:, None])


@triton.jit
def walk_neighbours(
    position, run_end, run_shift, counts, offset, sender_of, receiver_of, particles, capacity, square_radius,
    FILL: tl.constexpr, SIDE: tl.constexpr, BLOCK: tl.constexpr, CANDIDATES: tl.constexpr,
):  # fmt: skip
    """counts [N], int64, of each sorted particle, itself among them; with FILL sender and receiver [E] of each edge,
    int64, grouped by receiver, none beyond `capacity`. Positions are in the sorted order.

    Reference: hgn.network.neighbours.neighbour_list; test: tests/kernels/test_neighbours.py.
    """
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = place < particles
    at = place[:, None] * SIDE + tl.arange(0, SIDE)[None, :]
    end = tl.load(run_end + at, mask=live[:, None], other=0)
    shift = tl.load(run_shift + at, mask=live[:, None], other=0)
    total = tl.max(end, 1)
    most = tl.max(total, 0)
    x = tl.load(position + place * 3, mask=live, other=0.0)
    y = tl.load(position + place * 3 + 1, mask=live, other=0.0)
    z = tl.load(position + place * 3 + 2, mask=live, other=0.0)
    neighbours_before = tl.zeros((BLOCK,), tl.int32)
    if FILL:
        first = tl.load(offset + place, mask=live, other=0)
    begun = most * 0
    while begun < most:
        number = begun + tl.arange(0, CANDIDATES)
        run = tl.sum((number[None, :, None] >= end[:, None, :]).to(tl.int32), 2)
        mine = run[:, :, None] == tl.arange(0, SIDE)[None, None, :]
        sender = number[None, :] + tl.sum(tl.where(mine, shift[:, None, :], 0), 2)
        there = number[None, :] < total[:, None]
        dx = tl.load(position + sender * 3, mask=there, other=0.0) - x[:, None]
        dy = tl.load(position + sender * 3 + 1, mask=there, other=0.0) - y[:, None]
        dz = tl.load(position + sender * 3 + 2, mask=there, other=0.0) - z[:, None]
        near = there & (dx * dx + dy * dy + dz * dz < square_radius)
        counted = near.to(tl.int32)
        if FILL:
            row = first[:, None] + (neighbours_before[:, None] + tl.cumsum(counted, 1) - counted).to(tl.int64)
            fits = near & (row < capacity)
            tl.store(sender_of + row, sender.to(tl.int64), mask=fits)
            tl.store(receiver_of + row, tl.zeros_like(row) + place[:, None], mask=fits)
        neighbours_before += tl.sum(counted, 1)
        begun += CANDIDATES
    if not FILL:
        tl.store(counts + place, neighbours_before.to(tl.int64), mask=live)


@triton.jit
def check_room(offset, particles, capacity, needed, status):
    """Writes down how many edges there are, and whether they have room.

    Reference: hgn.network.neighbours.neighbour_list; test: tests/kernels/test_neighbours.py.
    """
    total = tl.load(offset + particles)
    tl.store(needed, total.to(tl.int32))
    if total > capacity:
        tl.atomic_or(status, OVERFLOW)


settle_keys(globals())
