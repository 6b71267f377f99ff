"""What the kernels of cells know of the grid's levels.

Row of the geometry table of a level: first slot, slots, cells of the window in y and z with borders, slots of a
scene, capacity, first cell in tables, window cells in x with borders.
"""

import triton
import triton.language as tl

from hgn.kernels.triton_compat import settle_keys

GEOMETRY_COLUMNS = tl.constexpr(8)
FULLY = tl.constexpr(1 << 24)  # how disturbed a coarsest cell is, where it is so wholly


@triton.jit
def split_slot(local, ny, nz, stride):
    """Of a slot of a level, counted from its first: the scene, and the cell in its window, which borders are -1 of."""
    inside = local % stride
    return local // stride, inside // (ny * nz) - 1, inside // nz % ny - 1, inside % nz - 1


@triton.jit
def most_around(disturbed, felt, part: tl.constexpr, neighbour, cell, there, capacity):
    """What a coarsest cell and those across its faces have at most in one column of `disturbed` [C, 2], in units of
    FULLY, goes into that of `felt` [C, 2], from 0 to 1."""
    most = tl.load(disturbed + cell * 2 + part, mask=there, other=0)
    for slot in tl.static_range(6):
        other = tl.load(neighbour + slot * capacity + cell, mask=there, other=-1)
        most = tl.maximum(most, tl.load(disturbed + other * 2 + part, mask=other >= 0, other=0))
    tl.store(felt + cell * 2 + part, most.to(tl.float32) / FULLY, mask=there)


settle_keys(globals())
