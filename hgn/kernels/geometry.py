"""Computes levels, slots and middles of the grid, for the kernels of cells.

The geometry table has a row for each level: first slot, number of slots, box cells in y and z with borders, slots of
a scene, capacity, first cell in tables, box cells in x with borders. *Middles* are the centres of every 2^SHIFT-th
coarsest cell along each axis. A *spot* is a particle's place relative to the lowest of the eight middles around it."""

import triton
import triton.language as tl

from hgn.kernels.triton_compat import settle_keys

GEOMETRY_COLUMNS = tl.constexpr(8)
FULLY = tl.constexpr(1 << 24)  # number that stands for the disturbance 1 of a coarsest cell


@triton.jit
def split_slot(local, ny, nz, stride):
    """Returns the scene and the cell of a slot, counted from the level's first. A box's borders begin at cell -1."""
    inside = local % stride
    return local // stride, inside // (ny * nz) - 1, inside // nz % ny - 1, inside % nz - 1


@triton.jit
def add_above(sums, parent, geometry, cell, there, LEVELS: tl.constexpr):
    """Adds the values of finest cells to all cells above them, in `sums` [.., 4] of all levels."""
    part = tl.arange(0, 4)[None, :]
    value = tl.load(sums + cell[:, None] * 4 + part, mask=there[:, None], other=0.0)
    for level in tl.static_range(1, LEVELS):
        line = geometry + level * GEOMETRY_COLUMNS
        # A parent past the capacity is -1.
        cell = tl.load(parent + tl.load(line - GEOMETRY_COLUMNS + 6) + cell, mask=there, other=-1)
        there = there & (cell >= 0)
        at = sums + (tl.load(line + 6) + cell)[:, None] * 4 + part
        tl.atomic_add(at, value, mask=there[:, None], sem="relaxed")


@triton.jit
def most_around(disturbed, spread, part: tl.constexpr, neighbour, cell, there, capacity):
    """Writes to column `part` of `spread` [C, 2] the maximum of column `part` of `disturbed` [C, 2], divided by FULLY,
    over a coarsest cell and the cells across its faces."""
    most = tl.load(disturbed + cell * 2 + part, mask=there, other=0)
    for slot in tl.static_range(6):
        other = tl.load(neighbour + slot * capacity + cell, mask=there, other=-1)
        most = tl.maximum(most, tl.load(disturbed + other * 2 + part, mask=other >= 0, other=0))
    tl.store(spread + cell * 2 + part, most.to(tl.float32) / FULLY, mask=there)


@triton.jit
def lowest_middle(k, axis: tl.constexpr, low, place_of, row, live, LEVELS: tl.constexpr, SHIFT: tl.constexpr):
    """Returns the lowest middle around a particle along one axis, counted from 0, and the particle's spot, in
    distances of two middles. `k` is the number of the particle's coarsest cell in the box."""
    first = tl.load(low + axis) >> LEVELS - 1
    place = tl.load(place_of + row * 3 + axis, mask=live, other=0.0)
    lowest = tl.floor(place)
    k += first + lowest.to(tl.int32)
    wide = k >> SHIFT
    return wide - (first - 1 >> SHIFT), ((k - (wide << SHIFT)).to(tl.float32) + place - lowest) * (1.0 / (1 << SHIFT))


@triton.jit
def middles_around(base, gate, spot, geometry, LEVELS: tl.constexpr):
    """Returns the slots [N, 8] of the middles around particles, places relative to these, and trilinear weights.
    `base` are the slots of the lowest middles, `gate` and `spot` those of the particles."""
    line = geometry + (LEVELS - 1) * GEOMETRY_COLUMNS
    corner = tl.arange(0, 8)[None, :]
    axes, weight = (), gate[:, None]
    for i in tl.static_range(3):
        place = spot[i][:, None] - (corner >> 2 - i & 1).to(tl.float32)
        weight = weight * (1 - tl.abs(place))
        axes = axes + (place,)  # noqa: RUF005 - Triton does not support unpacking here
    across = (corner >> 2 & 1) * tl.load(line + 2) + (corner >> 1 & 1)
    slot = base[:, None] + across * tl.load(line + 3) + (corner & 1)
    return slot, axes, weight


@triton.jit
def raise_disturbed(disturbed, cell, own):
    """Raises the first of two numbers of cells [N, 8] in `disturbed` to at least the particles' own [N] times FULLY."""
    own = (own * FULLY).to(tl.int32)[:, None]
    # Most cells already have this value from another particle.
    mask = (cell >= 0) & (tl.load(disturbed + cell * 2, mask=cell >= 0, other=FULLY) < own)
    tl.atomic_max(disturbed + cell * 2, own + 0 * cell, mask=mask, sem="relaxed")


settle_keys(globals())
