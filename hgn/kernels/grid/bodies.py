"""Divides the cells of the coarser levels among bodies, with `network.inputs: local`.

A body is a set of finest cells that particles connect. Its number is the lowest slot of its cells. Links lead from
slots to lower slots of the same body (union-find). A link is LAST - slot; in the lowest slot it is 0.

A coarser cell belongs to one body, so a slot of a coarser level may have several cells. An ordered hash table (Amble
and Knuth 1974) contains them: an entry is (slot << SLOT_BITS) + body, 0 where it is free. An entry keeps the largest
key that reached it, and smaller keys go on to the next entry. So the order of insertions does not change the table.

Rule: hgn.network.grid.build_hierarchy; test: tests/kernels/test_network.py.
Shape legend: N particles, C cells of a level, L levels, T entries of the table.
"""

import triton
import triton.language as tl

from hgn.kernels.cell_hash import PRIME_X, PRIME_Y
from hgn.kernels.geometry import GEOMETRY_COLUMNS, split_slot
from hgn.kernels.grid.slots import (
    OVERFLOW,
    cell_in,
    marked,
    number_in,
    slot_of,
    slots_of,
)
from hgn.kernels.triton_compat import gdc_launch_dependents, settle_keys

SLOT_BITS = tl.constexpr(31)
LAST = tl.constexpr((1 << 31) - 1)


@triton.jit
def _body(links, slot, ask):
    """Follows the links of slots to the lowest slots of their bodies."""
    link = tl.load(links + slot, mask=ask, other=0, volatile=True)
    while tl.max(tl.max(link, 1), 0) > 0:
        slot = tl.where(link > 0, -link + LAST, slot)
        link = tl.load(links + slot, mask=ask, other=0, volatile=True)
    return slot


@triton.jit
def body_of_slot(links, slot, ask):
    """Returns the body of an active finest cell, after `insert_cells`."""
    link = tl.load(links + slot, mask=ask, other=0)
    return tl.where(link > 0, -link + LAST, slot)


@triton.jit
def unite_cells(reached, links, geometry, BLOCK: tl.constexpr):
    """Links the cells that a particle reaches. `reached` has for a slot the bits of the corners that particles reach
    whose lowest cell it contains."""
    local = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)[:, None]
    bits = tl.load(reached + local, mask=local < tl.load(geometry + 1), other=0)
    if tl.max(tl.max(bits, 1), 0) == 0:
        return
    corner = tl.arange(0, 8)[None, :]
    ny, nz = tl.load(geometry + 2), tl.load(geometry + 3)
    ask = (bits >> corner & 1) > 0
    slot = local + ((corner >> 2 & 1) * ny + (corner >> 1 & 1)) * nz + (corner & 1)
    body = _body(links, tl.where(ask, slot, local), ask)
    least = tl.min(tl.where(ask, body, LAST), 1)[:, None] + 0 * corner
    apart = ask & (body != least)
    while tl.max(tl.max(apart.to(tl.int32), 1), 0) > 0:
        high, low = tl.maximum(body, least), tl.minimum(body, least)
        before = tl.atomic_max(links + high, -low + LAST, mask=apart, sem="relaxed")
        # If the upper slot was no longer the lowest of its body, the body that it led to is linked too.
        body = tl.where(apart & (before > 0), -before + LAST, low)
        least = low
        apart = apart & (body != least)


@triton.jit
def _entry(slot, body, mask):
    """Returns the key of a cell and the first place in the table for it."""
    slot, body = slot.to(tl.int64), body.to(tl.int64)
    mixed = slot * PRIME_X ^ body * PRIME_Y
    return (slot << SLOT_BITS) + body, ((mixed ^ mixed >> 15) & mask).to(tl.int32)


@triton.jit
def number_of(table, numbers, mask, slot, body, ask):
    """Returns the number of the cell of a coarser level that a body has in a slot; -1 where `ask` is false."""
    key, place = _entry(slot, body, mask)
    result = 0 * place - 1
    while tl.max(tl.max(ask.to(tl.int32), 1), 0) > 0:
        here = tl.load(table + place, mask=ask, other=0)
        found = ask & (here == key)
        result = tl.where(found, tl.load(numbers + place, mask=found, other=-1), result)
        ask = ask & (here != key) & (here != 0)
        place = (place + 1) & mask
    return result


@triton.jit
def insert_cells(
    occupied, prefix_sum, geometry, links, table, mask, LEVELS: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """Links each finest cell to the lowest slot of its body, and enters its ancestors into the table."""
    local = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)[:, None]
    # The table has entries for the ancestors of as many finest cells as the level's capacity.
    live = cell_in(occupied, prefix_sum, local, 0, tl.load(geometry + 5), local < tl.load(geometry + 1)) >= 0
    if tl.sum(tl.sum(live.to(tl.int32), 1), 0) == 0:
        return
    body = _body(links, local, live)
    tl.store(links + local, -body + LAST, mask=live & (body != local))
    scene, x, y, z = split_slot(local, tl.load(geometry + 2), tl.load(geometry + 3), tl.load(geometry + 4))
    for level in tl.static_range(1, LEVELS):
        slot = slot_of(x >> level, y >> level, z >> level, scene, slots_of(geometry, level))
        key, place = _entry(slot, body, mask)
        rest = live
        while tl.max(tl.max(rest.to(tl.int32), 1), 0) > 0:
            before = tl.atomic_max(table + place, key, mask=rest, sem="relaxed")
            rest = rest & (before != 0) & (before != key)
            key = tl.where(rest & (before < key), before, key)  # the smaller key goes on
            place = (place + 1) & mask


@triton.jit
def number_cells(table, numbers, geometry, needed, status, LEVELS: tl.constexpr, BLOCK: tl.constexpr):
    """Numbers the cells of coarser levels, and adds their count to `needed` [L]. Numbers past the capacity are -1."""
    entry = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    key = tl.load(table + entry)
    if tl.max(key, 0) == 0:
        return
    slot = (key >> SLOT_BITS).to(tl.int32)
    for level in tl.static_range(1, LEVELS):
        line = geometry + level * GEOMETRY_COLUMNS
        start, slots, capacity = tl.load(line), tl.load(line + 1), tl.load(line + 5)
        own = ((key > 0) & (slot >= start) & (slot < start + slots)).to(tl.int32)
        count = tl.sum(own, 0)
        if count > 0:
            first = tl.atomic_add(needed + level, count, sem="relaxed")
            number = first + tl.cumsum(own, 0) - 1
            tl.store(numbers + entry, tl.where(number < capacity, number, -1), mask=own > 0)
            if first + count > capacity:
                tl.atomic_or(status, OVERFLOW)


@triton.jit
def join_cells(
    occupied, prefix_sum, geometry, links, table, numbers, mask, slot_of_cell, neighbour, parent, octant, children,
    counts, needed, status, LEVELS: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes neighbours, parent and children of all cells, int32. `neighbour` and `children` must be -1 before.

    Finest cells write the entries of their ancestors too. Neighbours belong to the same body. On a coarser level they
    have finest cells on both sides of their common face, next to each other.
    """
    if OVERLAP:
        gdc_launch_dependents()  # kernels that need only the numbers of the cells may start
    slots, capacity = tl.load(geometry + 1), tl.load(geometry + 5)
    if tl.program_id(0) == 0:
        total = tl.load(prefix_sum + slots - 1)
        tl.store(needed, total)
        tl.store(counts, tl.minimum(total, capacity))
        if total > capacity:
            tl.atomic_or(status, OVERFLOW)
        for level in tl.static_range(1, LEVELS):
            most = tl.load(geometry + level * GEOMETRY_COLUMNS + 5)
            tl.store(counts + level, tl.minimum(tl.load(needed + level), most))
    local = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)[:, None]
    cell = cell_in(occupied, prefix_sum, local, 0, capacity, local < slots)
    live = cell >= 0
    if tl.sum(tl.sum(live.to(tl.int32), 1), 0) == 0:
        return
    ny, nz, stride = tl.load(geometry + 2), tl.load(geometry + 3), tl.load(geometry + 4)
    scene, x, y, z = split_slot(local, ny, nz, stride)
    body = body_of_slot(links, local, live)
    tl.store(slot_of_cell + cell, local, mask=live)
    below, below_there, below_at, below_octant = cell, live, 0, ((x & 1) * 2 + (y & 1)) * 2 + (z & 1)
    tl.store(octant + cell, below_octant, mask=live)
    ancestors = (cell,)
    for level in tl.static_range(1, LEVELS):
        line = geometry + level * GEOMETRY_COLUMNS
        most, at = tl.load(line + 5), tl.load(line + 6)
        kx, ky, kz = x >> level, y >> level, z >> level
        slot = slot_of(kx, ky, kz, scene, slots_of(geometry, level))
        own = number_of(table, numbers, mask, slot, body, live)
        ancestors = ancestors + (own,)  # noqa: RUF005 - Triton does not support unpacking here
        there = own >= 0
        tl.store(parent + below_at + below, own, mask=below_there)
        tl.store(children + 8 * at + below_octant * most + own, below, mask=there & below_there)
        tl.store(slot_of_cell + at + own, slot - tl.load(line), mask=there)
        below, below_there, below_at, below_octant = own, there, at, ((kx & 1) * 2 + (ky & 1)) * 2 + (kz & 1)
        tl.store(octant + at + own, below_octant, mask=there)
    for direction in tl.static_range(6):
        step, along = ny * nz, x
        if direction // 2 == 1:
            step, along = nz, y
        elif direction // 2 == 2:
            step, along = nz * 0 + 1, z
        beside = local - step if direction % 2 == 1 else local + step
        joined = marked(occupied, beside, live)
        joined = joined & (body_of_slot(links, beside, joined) == body)
        other = number_in(prefix_sum, beside, 0, capacity, joined)
        tl.store(neighbour + direction * capacity + cell, other, mask=joined)
        for level in tl.static_range(1, LEVELS):
            line = geometry + level * GEOMETRY_COLUMNS
            most, at, last = tl.load(line + 5), tl.load(line + 6), (1 << level) - 1
            across = joined & ((along & last) == (0 if direction % 2 == 1 else last))
            kx = (x >> level) + (1 - 2 * (direction % 2) if direction // 2 == 0 else 0)
            ky = (y >> level) + (1 - 2 * (direction % 2) if direction // 2 == 1 else 0)
            kz = (z >> level) + (1 - 2 * (direction % 2) if direction // 2 == 2 else 0)
            slot = slot_of(kx, ky, kz, scene, slots_of(geometry, level))
            other = number_of(table, numbers, mask, slot, body, across)
            own = ancestors[level]
            tl.store(neighbour + 6 * at + direction * most + own, other, mask=across & (own >= 0))


settle_keys(globals())
