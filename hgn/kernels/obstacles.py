"""Obstacle normals at a place, from a scene's hash table on the device.

Row of the obstacle table of a scene, int64: addresses of its hash buckets (0: no obstacle), keys and normals, the
mask of the buckets, and the symmetry that it is seen under (hgn.scene.symmetry.Symmetry.code).
"""

import triton
import triton.language as tl

from hgn.kernels.triton_compat import settle_keys
from hgn.network.cell_keys import COORDINATE_LIMIT, HASH_PRIMES
from hgn.scene import symmetry as codes

OBSTACLE_COLUMNS = tl.constexpr(5)
CODE_BITS = tl.constexpr(codes.CODE_BITS)
CODE_MASK = tl.constexpr((1 << codes.CELL_BITS) - 1)  # of the cells in a symmetry's code
LIMIT = tl.constexpr(COORDINATE_LIMIT)
PRIME_X, PRIME_Y, PRIME_Z = (tl.constexpr(prime) for prime in HASH_PRIMES)


@triton.jit
def _find_obstacle(x, y, z, line, live):
    """Row of the obstacle cell (x, y, z) in its scene's hash table, -1 where there is none."""
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


@triton.jit
def _before_mirror(cell, symmetry, axis: tl.constexpr):
    """A cell's coordinate, in floats, from before the symmetry mirrored this axis."""
    part = symmetry >> CODE_BITS * axis
    last = (part >> 3 & CODE_MASK).to(tl.float32) - 1
    return tl.where((part >> 2 & 1) == 1, last - cell, cell)


@triton.jit
def _from_axis(x, y, z, symmetry, axis: tl.constexpr):
    """That of the image's coordinates x, y, z which comes from this axis of the scene."""
    z_or_y = tl.where((symmetry >> CODE_BITS & 3) == axis, y, z)
    return tl.where((symmetry & 3) == axis, x, z_or_y)


@triton.jit
def obstacle_normals(x, y, z, line, live, obstacle_cell_size, SYMMETRY: tl.constexpr):
    """The obstacle normals' three parts at positions of any shape, zeros where there is none; `line` is their scenes'
    row of the obstacle table. With SYMMETRY the positions are an image of the scene that the table is of: looked up
    there, normals brought back."""
    x = tl.floor(tl.div_rn(x, obstacle_cell_size))
    y = tl.floor(tl.div_rn(y, obstacle_cell_size))
    z = tl.floor(tl.div_rn(z, obstacle_cell_size))
    if SYMMETRY:
        symmetry = tl.load(line + OBSTACLE_COLUMNS - 1, mask=live, other=0)
        ix, iy, iz = _before_mirror(x, symmetry, 0), _before_mirror(y, symmetry, 1), _before_mirror(z, symmetry, 2)
        x = _from_axis(ix, iy, iz, symmetry, 0)
        y = _from_axis(ix, iy, iz, symmetry, 1)
        z = _from_axis(ix, iy, iz, symmetry, 2)
    near = live & (tl.abs(x) < LIMIT) & (tl.abs(y) < LIMIT) & (tl.abs(z) < LIMIT)
    x = tl.where(near, x, 0.0).to(tl.int64)
    y = tl.where(near, y, 0.0).to(tl.int64)
    z = tl.where(near, z, 0.0).to(tl.int64)
    near = near & (tl.load(line, mask=near, other=0) != 0)
    entry = _find_obstacle(x, y, z, line, near)
    at = tl.load(line + 2, mask=near, other=0).to(tl.pointer_type(tl.float32)) + entry * 3
    found = ()
    for axis in tl.static_range(3):
        if SYMMETRY:
            part = symmetry >> CODE_BITS * axis
            normal = tl.load(at + (part & 3), mask=entry >= 0, other=0.0)
            normal = tl.where((part >> 2 & 1) == 1, -normal, normal)
        else:
            normal = tl.load(at + axis, mask=entry >= 0, other=0.0)
        found = found + (normal,)  # noqa: RUF005 - Triton knows no unpacking here
    return found


settle_keys(globals())
