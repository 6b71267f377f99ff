"""Computes obstacle normals and friction at a place from a scene's hash table on the device.

The obstacle table has a row of int64 numbers for each scene: addresses of its hash buckets (0: no obstacle), keys and
cell values, the mask of the buckets, and the symmetry of the image of the scene (hgn.scene.symmetry.Symmetry.code).
"""

import triton
import triton.language as tl

from hgn.kernels.cell_hash import find_cell
from hgn.kernels.triton_compat import settle_keys
from hgn.scene import symmetry as codes

OBSTACLE_COLUMNS = tl.constexpr(5)
BARRIER_COLUMNS = tl.constexpr(7)  # columns of the barrier table
CODE_BITS = tl.constexpr(codes.CODE_BITS)
CODE_MASK = tl.constexpr((1 << codes.CELL_BITS) - 1)  # mask of the cells in a symmetry's code


@triton.jit
def _before_mirror(cell, symmetry, axis: tl.constexpr):
    """Returns a cell's coordinate, in floats, before the symmetry mirrored this axis."""
    part = symmetry >> CODE_BITS * axis
    last = (part >> 3 & CODE_MASK).to(tl.float32) - 1
    return tl.where((part >> 2 & 1) == 1, last - cell, cell)


@triton.jit
def _from_axis(x, y, z, symmetry, axis: tl.constexpr):
    """Returns the coordinate of the image's x, y, z that comes from this axis of the scene."""
    z_or_y = tl.where((symmetry >> CODE_BITS & 3) == axis, y, z)
    return tl.where((symmetry & 3) == axis, x, z_or_y)


@triton.jit
def obstacle_normals(
    x, y, z, line, live, obstacle_cell_size, SYMMETRY: tl.constexpr, ROW: tl.constexpr, REACH: tl.constexpr
):
    """Returns x, y and z of the obstacle normals at positions of any shape, and friction if ROW is 4; zeros without an
    obstacle. With REACH above 0 the table has a distance after the ROW values of a cell, and normals are multiplied by
    the nearness, as in hgn.network.obstacles.
    `line` is the scenes' row of the obstacle table. With SYMMETRY positions and normals are those of an image of the
    scene. The function looks the positions up in the scene itself."""
    px, py, pz = tl.div_rn(x, obstacle_cell_size), tl.div_rn(y, obstacle_cell_size), tl.div_rn(z, obstacle_cell_size)
    x, y, z = tl.floor(px), tl.floor(py), tl.floor(pz)
    px, py, pz = px - x - 0.5, py - y - 0.5, pz - z - 0.5
    if SYMMETRY:
        symmetry = tl.load(line + OBSTACLE_COLUMNS - 1, mask=live, other=0)
        ix, iy, iz = _before_mirror(x, symmetry, 0), _before_mirror(y, symmetry, 1), _before_mirror(z, symmetry, 2)
        x = _from_axis(ix, iy, iz, symmetry, 0)
        y = _from_axis(ix, iy, iz, symmetry, 1)
        z = _from_axis(ix, iy, iz, symmetry, 2)
    entry = find_cell(x, y, z, line, live)
    at = tl.load(line + 2, mask=entry >= 0, other=0).to(tl.pointer_type(tl.float32)) + entry * (ROW + (REACH > 0))
    found = ()
    for axis in tl.static_range(3):
        if SYMMETRY:
            part = symmetry >> CODE_BITS * axis
            normal = tl.load(at + (part & 3), mask=entry >= 0, other=0.0)
            normal = tl.where((part >> 2 & 1) == 1, -normal, normal)
        else:
            normal = tl.load(at + axis, mask=entry >= 0, other=0.0)
        found = found + (normal,)  # noqa: RUF005 - Triton does not support unpacking here
    for column in tl.static_range(3, ROW):
        found = found + (tl.load(at + column, mask=entry >= 0, other=0.0),)  # noqa: RUF005
    if REACH > 0:
        distance = found[0] * px + found[1] * py + found[2] * pz + tl.load(at + ROW, mask=entry >= 0, other=REACH)
        near = tl.maximum(1 - tl.abs(distance) / REACH, 0.0)
        side = tl.where(distance < 0, -near, near)
        seen = found[0] * side, found[1] * side, found[2] * side
        for column in tl.static_range(3, ROW):
            seen = seen + (tl.where(near > 0, found[column], 0.0),)  # noqa: RUF005
        found = seen
    return found


settle_keys(globals())
