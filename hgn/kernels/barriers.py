"""What walls and obstacles that nothing passes let a particle's way in a frame be, from a scene's table on the device.

The rule is that of hgn.runtime.holding and hgn.network.barriers.

Row of the barrier table of a scene, int64: addresses of the hash buckets of its cells (0: no obstacle), of their keys
and of where their lists begin and end, the mask of the buckets, addresses of the lists and of the triangles' rows, and
the bits of the cells' size in float32.
"""

import triton
import triton.language as tl

from hgn.kernels.cell_hash import LIMIT, find_cell
from hgn.kernels.triton_compat import settle_keys
from hgn.scene import barrier

BARRIER_COLUMNS = tl.constexpr(7)
ROW = tl.constexpr(barrier.ROW)
ONE = tl.constexpr(0x3F800000)  # its bits in float32
NO_TRIANGLE = tl.constexpr(0x7FFFFFFF)


@triton.jit
def wall_limit(x, before, size, near, far):
    """Whether a wall is in the way from `before` to x on an axis, and where it holds it."""
    low, high = tl.where(before < near, before, near), tl.where(before > size - far, before, size - far)
    inside = (x > -size) & (x < 2 * size)  # NaN is outside
    return inside & ((x < low) | (x > high)), tl.where(x < low, low, high)


@triton.jit
def _between_walls(x, before, size, near, far, WALLED: tl.constexpr):
    if WALLED:
        stopped, limit = wall_limit(x, before, size, near, far)
        x = tl.where(stopped, limit, x)
    return x


@triton.jit
def _distance(row, x, y, z, live):
    """Before the plane that lies at `row`, and above 0 in front of it."""
    across = tl.load(row, mask=live, other=0.0) * x + tl.load(row + 1, mask=live, other=0.0) * y
    across += tl.load(row + 2, mask=live, other=0.0) * z
    return across - tl.load(row + 3, mask=live, other=0.0)


@triton.jit
def _covers(row, x, y, z, live):
    """Whether a triangle covers a place in its plane."""
    inside = live & (x >= tl.load(row + 16, mask=live, other=0.0)) & (x <= tl.load(row + 20, mask=live, other=0.0))
    inside = inside & (y >= tl.load(row + 17, mask=live, other=0.0)) & (y <= tl.load(row + 21, mask=live, other=0.0))
    inside = inside & (z >= tl.load(row + 18, mask=live, other=0.0)) & (z <= tl.load(row + 22, mask=live, other=0.0))
    for plane in tl.static_range(4, 16, 4):
        inside = inside & (_distance(row + plane, x, y, z, inside) <= 0)
    return inside


@triton.jit
def _stopped(bx, by, bz, x, y, z, line, live, within, slack):
    """Which ways from (bx, by, bz) to (x, y, z) the first triangle on them stops, and where they end then."""
    bits = tl.load(line + 6, mask=live, other=ONE)
    cell_size = bits.to(tl.int32).to(tl.float32, bitcast=True)
    span = tl.load(line + 2, mask=live, other=0).to(tl.pointer_type(tl.int32))
    lists = tl.load(line + 4, mask=live, other=0).to(tl.pointer_type(tl.int32))
    rows = tl.load(line + 5, mask=live, other=0).to(tl.pointer_type(tl.float32))
    wx, wy, wz = x - bx, y - by, z - bz
    length = tl.sqrt_rn(wx * wx + wy * wy + wz * wz)
    pieces = tl.maximum(tl.ceil(tl.div_rn(length, cell_size)), 1.0)
    piece, least = tl.zeros_like(x), tl.zeros_like(x) + 2.0
    first = tl.zeros_like(x).to(tl.int32) + NO_TRIANGLE
    ex, ey, ez = x, y, z
    while tl.max(live.to(tl.int32)) > 0:
        share = tl.div_rn(piece + 0.5, pieces)  # at the piece's middle
        cx = tl.floor(tl.div_rn(bx + share * wx, cell_size))
        cy = tl.floor(tl.div_rn(by + share * wy, cell_size))
        cz = tl.floor(tl.div_rn(bz + share * wz, cell_size))
        near = live & (tl.abs(cx) < LIMIT) & (tl.abs(cy) < LIMIT) & (tl.abs(cz) < LIMIT)
        cx = tl.where(near, cx, 0.0).to(tl.int64)
        cy = tl.where(near, cy, 0.0).to(tl.int64)
        cz = tl.where(near, cz, 0.0).to(tl.int64)
        cell = find_cell(cx, cy, cz, line, near)
        entry = tl.load(span + 2 * cell, mask=cell >= 0, other=0)
        end = tl.load(span + 2 * cell + 1, mask=cell >= 0, other=0)
        ask = entry < end
        while tl.max(ask.to(tl.int32)) > 0:
            triangle = tl.load(lists + entry, mask=ask, other=0)
            row = rows + triangle * ROW
            nx = tl.load(row, mask=ask, other=0.0)
            ny = tl.load(row + 1, mask=ask, other=0.0)
            nz = tl.load(row + 2, mask=ask, other=0.0)
            distance = nx * bx + ny * by + nz * bz - tl.load(row + 3, mask=ask, other=0.0)
            side = tl.where(distance >= 0, 1.0, -1.0)
            distance = side * distance
            approach = -side * (nx * wx + ny * wy + nz * wz)
            left = distance - approach
            comes_near = ask & (approach > 0) & (left < within)
            closing = tl.maximum(approach, 1e-30)
            comes = tl.minimum(tl.maximum(tl.div_rn(distance - within, closing), 0.0), 1.0)
            passes = tl.minimum(tl.maximum(tl.div_rn(distance, closing), 0.0), 1.0)
            here = _covers(row, bx + comes * wx, by + comes * wy, bz + comes * wz, comes_near)
            passing = comes_near & (left < 0) & (here == 0)
            there = _covers(row, bx + passes * wx, by + passes * wy, bz + passes * wz, passing)
            time = tl.where(here, comes, passes)
            sooner = (time < least) | ((time == least) & (triangle < first))
            sooner = sooner & (here | there)
            shift = side * (tl.minimum(distance, within) + slack - left)
            ex = tl.where(sooner, x + shift * nx, ex)
            ey = tl.where(sooner, y + shift * ny, ey)
            ez = tl.where(sooner, z + shift * nz, ez)
            least, first = tl.where(sooner, time, least), tl.where(sooner, triangle, first)
            entry += 1
            ask = ask & (entry < end)
        piece += 1.0
        live = live & (piece < pieces)
    return first < NO_TRIANGLE, ex, ey, ez


@triton.jit
def kept_apart(
    bx, by, bz, x, y, z, width, height, depth, line, live, within, slack, near, far,
    SURFACES: tl.constexpr, WALLED: tl.constexpr,
):  # fmt: skip
    """Where ways from (bx, by, bz) to (x, y, z) end, which are between the walls, in domains of so much width, height
    and depth: up to SURFACES triangles stop one after the other, and walls, where WALLED, again; what others are then
    in the way of stays where it was. `line` is the scenes' row of the barrier table; all are vectors of particles.
    What is out of range is not held.

    Triangles stop what comes within `within` of them, and put it farther by `slack`.
    """
    live = live & (x > -width) & (x < 2 * width) & (y > -height) & (y < 2 * height)
    live = live & (z > -depth) & (z < 2 * depth)  # NaN is not
    live = live & (tl.load(line, mask=live, other=0) != 0)
    bx, by, bz = tl.where(live, bx, 0.0), tl.where(live, by, 0.0), tl.where(live, bz, 0.0)
    ex, ey, ez = tl.where(live, x, 0.0), tl.where(live, y, 0.0), tl.where(live, z, 0.0)
    ask, surface = live, tl.zeros_like(ex)
    while tl.max(ask.to(tl.int32)) > 0:
        hit, mx, my, mz = _stopped(bx, by, bz, ex, ey, ez, line, ask, within, slack)
        ask = ask & hit
        mx = _between_walls(mx, bx, width, near, far, WALLED)
        my = _between_walls(my, by, height, near, far, WALLED)
        mz = _between_walls(mz, bz, depth, near, far, WALLED)
        free = surface < SURFACES
        ex = tl.where(ask, tl.where(free, mx, bx), ex)
        ey = tl.where(ask, tl.where(free, my, by), ey)
        ez = tl.where(ask, tl.where(free, mz, bz), ez)
        ask = ask & free
        surface += 1.0
    return tl.where(live, ex, x), tl.where(live, ey, y), tl.where(live, ez, z)


settle_keys(globals())
