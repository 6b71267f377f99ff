"""What walls and obstacles that nothing passes let a particle's way in a frame be, from a scene's table on the device.

The rule is that of hgn.runtime.holding and hgn.network.barriers.

Row of the barrier table of a scene, int64: addresses of the hash buckets of its cells (0: no obstacle), of their keys
and of where their lists begin and end, the mask of the buckets, addresses of the lists and of the triangles' rows, and
the bits of the cells' size in float32.
"""

import triton
import triton.language as tl

from hgn.kernels.cell_hash import find_cell
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
    """Which ways from (bx, by, bz) to (x, y, z) a triangle stops; by how much their ends are to be shifted along which
    unit normals; and the share of a way on which nothing is met."""
    bits = tl.load(line + 6, mask=live, other=ONE)
    cell_size = bits.to(tl.int32).to(tl.float32, bitcast=True)
    span = tl.load(line + 2, mask=live, other=0).to(tl.pointer_type(tl.int32))
    lists = tl.load(line + 4, mask=live, other=0).to(tl.pointer_type(tl.int32))
    rows = tl.load(line + 5, mask=live, other=0).to(tl.pointer_type(tl.float32))
    wx, wy, wz = x - bx, y - by, z - bz
    length = tl.sqrt_rn(wx * wx + wy * wy + wz * wz)
    pieces = tl.maximum(tl.ceil(tl.div_rn(length, cell_size)), 1.0)
    piece, least, free = tl.zeros_like(x), tl.zeros_like(x) + 2.0, tl.zeros_like(x) + 1.0
    first = tl.zeros_like(x).to(tl.int32) + NO_TRIANGLE
    shift, sx, sy, sz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    while tl.max(live.to(tl.int32)) > 0:
        share = tl.div_rn(piece + 0.5, pieces)  # at the piece's middle
        cx = tl.floor(tl.div_rn(bx + share * wx, cell_size))
        cy = tl.floor(tl.div_rn(by + share * wy, cell_size))
        cz = tl.floor(tl.div_rn(bz + share * wz, cell_size))
        cell = find_cell(cx, cy, cz, line, live)
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
            contact = tl.minimum(tl.maximum(tl.div_rn(distance - within, closing), 0.0), 1.0)
            crossing = tl.minimum(tl.maximum(tl.div_rn(distance, closing), 0.0), 1.0)
            meets = _covers(row, bx + contact * wx, by + contact * wy, bz + contact * wz, comes_near)
            passing = comes_near & (left < 0) & (meets == 0)
            crosses = _covers(row, bx + crossing * wx, by + crossing * wy, bz + crossing * wz, passing)
            time = tl.where(meets, contact, crossing)
            sooner = (time < least) | ((time == least) & (triangle < first))
            sooner = sooner & (meets | crosses)
            shift = tl.where(sooner, tl.minimum(distance, within) + slack - left, shift)
            sx, sy, sz = (
                tl.where(sooner, side * nx, sx),
                tl.where(sooner, side * ny, sy),
                tl.where(sooner, side * nz, sz),
            )
            free = tl.where(meets | crosses, tl.minimum(free, contact), free)
            least, first = tl.where(sooner, time, least), tl.where(sooner, triangle, first)
            entry += 1
            ask = ask & (entry < end)
        piece += 1.0
        live = live & (piece < pieces)
    return first < NO_TRIANGLE, shift, sx, sy, sz, free


@triton.jit
def kept_apart(
    bx, by, bz, x, y, z, width, height, depth, line, live, within, slack, least_crease, near, far,
    SURFACES: tl.constexpr, WALLED: tl.constexpr,
):  # fmt: skip
    """Where ways from (bx, by, bz) to (x, y, z) end, which are between the walls, in domains of so much width, height
    and depth: up to SURFACES triangles stop one after the other, and walls, where WALLED, again; what a further one
    stops ends where it meets one. `line` is the scenes' row of the barrier table; all are vectors of particles. What is
    out of range is not held.

    Triangles stop what comes within `within` of them, and put it farther by `slack`. Planes whose squared sine is at
    most `least_crease` are one.
    """
    live = live & (x > -width) & (x < 2 * width) & (y > -height) & (y < 2 * height)
    live = live & (z > -depth) & (z < 2 * depth)  # NaN is not
    live = live & (tl.load(line, mask=live, other=0) != 0)
    bx, by, bz = tl.where(live, bx, 0.0), tl.where(live, by, 0.0), tl.where(live, bz, 0.0)
    ex, ey, ez = tl.where(live, x, 0.0), tl.where(live, y, 0.0), tl.where(live, z, 0.0)
    ask, surface = live, tl.zeros_like(ex)
    lx, ly, lz = tl.zeros_like(ex), tl.zeros_like(ex), tl.zeros_like(ex)  # the normals of the shifts before
    while tl.max(ask.to(tl.int32)) > 0:
        hit, shift, nx, ny, nz, free = _stopped(bx, by, bz, ex, ey, ez, line, ask, within, slack)
        ask = ask & hit
        cosine = nx * lx + ny * ly + nz * lz
        ax, ay, az = nx - cosine * lx, ny - cosine * ly, nz - cosine * lz  # along the last planes
        square = ax * ax + ay * ay + az * az
        crease = (cosine < 0) & (square > least_crease)
        farther = tl.div_rn(shift, tl.maximum(square, least_crease))
        mx = _between_walls(tl.where(crease, ex + farther * ax, ex + shift * nx), bx, width, near, far, WALLED)
        my = _between_walls(tl.where(crease, ey + farther * ay, ey + shift * ny), by, height, near, far, WALLED)
        mz = _between_walls(tl.where(crease, ez + farther * az, ez + shift * nz), bz, depth, near, far, WALLED)
        slides = surface < SURFACES
        ex = tl.where(ask, tl.where(slides, mx, bx + free * (ex - bx)), ex)
        ey = tl.where(ask, tl.where(slides, my, by + free * (ey - by)), ey)
        ez = tl.where(ask, tl.where(slides, mz, bz + free * (ez - bz)), ez)
        lx, ly, lz = nx, ny, nz
        ask = ask & slides
        surface += 1.0
    return tl.where(live, ex, x), tl.where(live, ey, y), tl.where(live, ez, z)


settle_keys(globals())
