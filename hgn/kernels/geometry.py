"""Computes levels, slots and middles of the grid, for the kernels of cells.

The geometry table has a row for each level: first slot, number of slots, window cells in y and z with borders, slots of
a scene, capacity, first cell in tables, window cells in x with borders.
"""

import triton
import triton.language as tl

from hgn.kernels.triton_compat import settle_keys

GEOMETRY_COLUMNS = tl.constexpr(8)
FULLY = tl.constexpr(1 << 24)  # number that stands for the disturbance 1 of a coarsest cell


@triton.jit
def split_slot(local, ny, nz, stride):
    """Returns the scene and the cell of a slot, counted from the level's first. A window's borders begin at cell -1."""
    inside = local % stride
    return local // stride, inside // (ny * nz) - 1, inside // nz % ny - 1, inside % nz - 1


@triton.jit
def most_around(disturbed, felt, part: tl.constexpr, neighbour, cell, there, capacity):
    """Writes the maximum over a coarsest cell and those across its faces to a column of `felt` [C, 2], from 0 to 1.
    The inputs are the same column of `disturbed` [C, 2], in units of FULLY."""
    most = tl.load(disturbed + cell * 2 + part, mask=there, other=0)
    for slot in tl.static_range(6):
        other = tl.load(neighbour + slot * capacity + cell, mask=there, other=-1)
        most = tl.maximum(most, tl.load(disturbed + other * 2 + part, mask=other >= 0, other=0))
    tl.store(felt + cell * 2 + part, most.to(tl.float32) / FULLY, mask=there)


@triton.jit
def lowest_middle(k, axis: tl.constexpr, low, place_of, row, live, LEVELS: tl.constexpr, SHIFT: tl.constexpr):
    """Returns along one axis the number of the lowest middle around a particle, and the place from it in cell edges.
    The middles count from 0. They lie between cells 2^SHIFT times as large as the coarsest ones. `k` is the number of
    the particle's own coarsest cell in the window."""
    first = tl.load(low + axis) >> LEVELS - 1
    place = tl.load(place_of + row * 3 + axis, mask=live, other=0.0)
    lowest = tl.floor(place)
    k += first + lowest.to(tl.int32)
    wide = k >> SHIFT
    return wide - (first - 1 >> SHIFT), ((k - (wide << SHIFT)).to(tl.float32) + place - lowest) * (1.0 / (1 << SHIFT))


@triton.jit
def middles_around(base, gate, spot, geometry, LEVELS: tl.constexpr):
    """Returns the slots [N, 8] of all middles around particles, the places from them, and the weights.
    The inputs are the lowest slots, the gates and the spots."""
    line = geometry + (LEVELS - 1) * GEOMETRY_COLUMNS
    corner = tl.arange(0, 8)[None, :]
    axes, weight = (), gate[:, None]
    for i in tl.static_range(3):
        place = spot[i][:, None] - (corner >> 2 - i & 1).to(tl.float32)
        weight = weight * (1 - tl.abs(place))
        axes = axes + (place,)  # noqa: RUF005 - Triton knows no unpacking here
    across = (corner >> 2 & 1) * tl.load(line + 2) + (corner >> 1 & 1)
    slot = base[:, None] + across * tl.load(line + 3) + (corner & 1)
    return slot, axes, weight


@triton.jit
def raise_disturbed(disturbed, cell, own):
    """Raises the first of two numbers of cells [N, 8] in `disturbed` to the maximum over the particles [N] in them."""
    own = (own * FULLY).to(tl.int32)[:, None]
    # Most cells already have this value from another particle.
    mask = (cell >= 0) & (tl.load(disturbed + cell * 2, mask=cell >= 0, other=FULLY) < own)
    tl.atomic_max(disturbed + cell * 2, own + 0 * cell, mask=mask, sem="relaxed")


settle_keys(globals())
