"""What the kernels of cells know of the grid's levels.

Row of the geometry table of a level: first slot, slots, cells of the window in y and z with borders, slots of a
scene, capacity, first cell in tables, window cells in x with borders.
"""

import triton.language as tl

GEOMETRY_COLUMNS = tl.constexpr(8)
FULLY = tl.constexpr(1 << 24)  # how disturbed a coarsest cell is, where it is so wholly
