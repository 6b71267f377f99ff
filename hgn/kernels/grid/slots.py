"""Slots of cells: places in one array for all levels and scenes (hgn.kernels.grid.kernel), and the cells in them."""

import triton
import triton.language as tl

from hgn.kernels.geometry import GEOMETRY_COLUMNS
from hgn.kernels.triton_compat import settle_keys

OVERFLOW = tl.constexpr(1)  # status bit: a level has more active cells than its capacity
OUT_OF_BOX = tl.constexpr(2)  # status bit: a particle is not finite or outside the cell box


@triton.jit
def _base(position, origin, scene, row, live, axis: tl.constexpr, cell_size):
    x = tl.load(position + row * 3 + axis, mask=live, other=0.0)
    u = tl.div_rn(x - tl.load(origin + scene * 3 + axis, mask=live, other=0.0), cell_size) - 0.5
    base = tl.floor(u)
    return base, u - base


@triton.jit
def base_cell(position, origin, scene, row, live, low, geometry, cell_size):
    """Returns the lowest of each particle's 8 cells, the particle's fractions in it, and whether the cell box contains
    all 8. Cells are counted from the box's first one. The lowest cell is 0 if the box does not contain all 8."""
    x, fx = _base(position, origin, scene, row, live, 0, cell_size)
    y, fy = _base(position, origin, scene, row, live, 1, cell_size)
    z, fz = _base(position, origin, scene, row, live, 2, cell_size)
    # The subtraction is in float32, because the cell of a position far outside may exceed int32.
    x, y, z = x - tl.load(low), y - tl.load(low + 1), z - tl.load(low + 2)
    nx, ny, nz = tl.load(geometry + 7) - 3, tl.load(geometry + 2) - 3, tl.load(geometry + 3) - 3
    inside = live & (x >= 0) & (y >= 0) & (z >= 0) & (x < nx) & (y < ny) & (z < nz)
    x = tl.where(inside, x, 0.0).to(tl.int32)
    y = tl.where(inside, y, 0.0).to(tl.int32)
    z = tl.where(inside, z, 0.0).to(tl.int32)
    return x, y, z, fx, fy, fz, inside


@triton.jit
def slots_of(geometry, level: tl.constexpr):
    """Reads once the numbers of a level that `slot_of` needs. The compiler would read them again for each slot."""
    line = geometry + level * GEOMETRY_COLUMNS
    return tl.load(line), tl.load(line + 2), tl.load(line + 3), tl.load(line + 4)


@triton.jit
def slot_of(x, y, z, scene, slots):
    """Returns the slot of a cell of a scene. `slots` is the result of `slots_of`."""
    start, ny, nz, stride = slots
    return start + scene * stride + ((x + 1) * ny + (y + 1)) * nz + z + 1


@triton.jit
def marked(occupied, slot, ask):
    """Returns whether the cell in a slot is active."""
    return ask & (tl.load(occupied + slot, mask=ask, other=0) > 0)


@triton.jit
def number_in(prefix_sum, slot, first, capacity, there):
    """Returns the number of the cell in a slot, -1 if it is not active."""
    cell = tl.load(prefix_sum + slot, mask=there, other=0) - 1 - first
    return tl.where(there & (cell < capacity), cell, -1)


@triton.jit
def cell_in(occupied, prefix_sum, slot, first, capacity, ask):
    """Returns the number of the cell in a slot where `ask` is true, -1 if the cell is not active."""
    return number_in(prefix_sum, slot, first, capacity, marked(occupied, slot, ask))


settle_keys(globals())
