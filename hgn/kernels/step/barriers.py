"""Stops the paths of a frame at walls, obstacles and moving obstacles, as hgn.step.reference.constrained does.

The barrier table has a row of int64 numbers for each scene. The row holds, in this order: the address of the hash
buckets of the cells (0: no obstacle), of their keys, and of the ranges of their lists; the mask of the buckets; the
addresses of the lists and of the rows of the triangles; and the bits of the cell size in float32.
"""

import triton
import triton.language as tl

from hgn.kernels.bodies import three_columns
from hgn.kernels.cell_hash import find_cell
from hgn.kernels.poses import BARRIER, LATER, LATER_PLACE, PIVOT, PLACE, POSES, RECORD, plus, turned, undone
from hgn.kernels.triton_compat import settle_keys
from hgn.scene import barrier

ROW = tl.constexpr(barrier.ROW)
ONE = tl.constexpr(0x3F800000)  # bits of 1.0 in float32
NO_TRIANGLE = tl.constexpr(0x7FFFFFFF)


@triton.jit
def wall_limit(x, before, size, near, far):
    """Returns whether a wall stops the path from `before` to x on an axis, and the coordinate at which it stops it."""
    low, high = tl.where(before < near, before, near), tl.where(before > size - far, before, size - far)
    inside = (x > -size) & (x < 2 * size)  # NaN is outside
    return inside & ((x < low) | (x > high)), tl.where(x < low, low, high)


@triton.jit
def between_walls(x, before, size, near, far, WALLED: tl.constexpr):
    if WALLED:
        stopped, limit = wall_limit(x, before, size, near, far)
        x = tl.where(stopped, limit, x)
    return x


@triton.jit
def _distance(row, x, y, z, live):
    """Returns the signed distance from the plane at `row`, positive in front of it."""
    across = tl.load(row, mask=live, other=0.0) * x + tl.load(row + 1, mask=live, other=0.0) * y
    across += tl.load(row + 2, mask=live, other=0.0) * z
    return across - tl.load(row + 3, mask=live, other=0.0)


@triton.jit
def _covers(row, x, y, z, live):
    """Returns whether a triangle covers a place in its plane."""
    inside = live & (x >= tl.load(row + 16, mask=live, other=0.0)) & (x <= tl.load(row + 20, mask=live, other=0.0))
    inside = inside & (y >= tl.load(row + 17, mask=live, other=0.0)) & (y <= tl.load(row + 21, mask=live, other=0.0))
    inside = inside & (z >= tl.load(row + 18, mask=live, other=0.0)) & (z <= tl.load(row + 22, mask=live, other=0.0))
    for plane in tl.static_range(4, 16, 4):
        inside = inside & (_distance(row + plane, x, y, z, inside) <= 0)
    return inside


@triton.jit
def _first_stop(bx, by, bz, x, y, z, line, live, within, slack):
    """Returns which paths from (bx, by, bz) to (x, y, z) a triangle stops, the shifts of their ends along unit normals,
    and the fraction of each path before the first triangle. The rule is hgn.step.reference.first_stop."""
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
        share = tl.div_rn(piece + 0.5, pieces)  # the fraction of the path at the middle of the piece
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
            nx, ny, nz = three_columns(rows, triangle, 0, ask, 1.0, ROW)
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
            sx = tl.where(sooner, side * nx, sx)
            sy = tl.where(sooner, side * ny, sy)
            sz = tl.where(sooner, side * nz, sz)
            free = tl.where(meets | crosses, tl.minimum(free, contact), free)
            least, first = tl.where(sooner, time, least), tl.where(sooner, triangle, first)
            entry += 1
            ask = ask & (entry < end)
        piece += 1.0
        live = live & (piece < pieces)
    return first < NO_TRIANGLE, shift, sx, sy, sz, free


@triton.jit
def stopped_by_obstacles(
    bx, by, bz, x, y, z, width, height, depth, line, live, within, slack, least_crease, near, far,
    SURFACES: tl.constexpr, WALLED: tl.constexpr,
):  # fmt: skip
    """Returns the ends of paths from (bx, by, bz) to (x, y, z) between the walls and outside obstacles.

    The domains have this width, height and depth. Up to SURFACES triangles stop a path one after the other. With
    WALLED the walls apply after each shift. After SURFACES shifts the path ends at the next triangle that it meets.
    `line` is the scenes' row of the barrier table. All arguments are vectors of particles. Particles out of range are
    not constrained. Triangles stop particles within the distance `within`, and move them away by `slack`. Planes whose
    squared sine is at most `least_crease` count as one.
    """
    live = live & (x > -width) & (x < 2 * width) & (y > -height) & (y < 2 * height)
    live = live & (z > -depth) & (z < 2 * depth)  # NaN fails these comparisons
    live = live & (tl.load(line, mask=live, other=0) != 0)
    bx, by, bz = tl.where(live, bx, 0.0), tl.where(live, by, 0.0), tl.where(live, bz, 0.0)
    ex, ey, ez = tl.where(live, x, 0.0), tl.where(live, y, 0.0), tl.where(live, z, 0.0)
    ask, surface = live, tl.zeros_like(ex)
    lx, ly, lz = tl.zeros_like(ex), tl.zeros_like(ex), tl.zeros_like(ex)  # normals of the last shifts
    while tl.max(ask.to(tl.int32)) > 0:
        hit, shift, nx, ny, nz, free = _first_stop(bx, by, bz, ex, ey, ez, line, ask, within, slack)
        ask = ask & hit
        cosine = nx * lx + ny * ly + nz * lz
        ax, ay, az = nx - cosine * lx, ny - cosine * ly, nz - cosine * lz  # along the planes of the last shifts
        square = ax * ax + ay * ay + az * az
        crease = (cosine < 0) & (square > least_crease)
        farther = tl.div_rn(shift, tl.maximum(square, least_crease))
        mx = between_walls(tl.where(crease, ex + farther * ax, ex + shift * nx), bx, width, near, far, WALLED)
        my = between_walls(tl.where(crease, ey + farther * ay, ey + shift * ny), by, height, near, far, WALLED)
        mz = between_walls(tl.where(crease, ez + farther * az, ez + shift * nz), bz, depth, near, far, WALLED)
        slides = surface < SURFACES
        ex = tl.where(ask, tl.where(slides, mx, bx + free * (ex - bx)), ex)
        ey = tl.where(ask, tl.where(slides, my, by + free * (ey - by)), ey)
        ez = tl.where(ask, tl.where(slides, mz, bz + free * (ez - bz)), ez)
        lx, ly, lz = nx, ny, nz
        ask = ask & slides
        surface += 1.0
    return tl.where(live, ex, x), tl.where(live, ey, y), tl.where(live, ez, z)


@triton.jit
def stopped_by_moving(
    before, free, size, scene, live, moving, poses, instant, scenes, within, slack, least_crease,
    SURFACES: tl.constexpr, LAYERS: tl.constexpr,
):  # fmt: skip
    """Returns the ends of paths from `before` to `free` that LAYERS moving obstacles stop, relative to each of them."""
    for k in tl.static_range(3):
        live = live & (free[k] > -size[k]) & (free[k] < 2 * size[k])  # NaN fails these comparisons
    ex, ey, ez = tl.where(live, free[0], 0.0), tl.where(live, free[1], 0.0), tl.where(live, free[2], 0.0)
    endless, first = tl.zeros_like(ex) + float("inf"), tl.load(instant) * scenes * LAYERS
    for layer in range(LAYERS):
        number = (first + layer * scenes + scene).to(tl.int64)
        pose = poses + number * (2 * RECORD) + POSES
        begin = undone(pose, before, live, 0, PLACE)
        own = undone(pose, (ex, ey, ez), live, LATER, LATER_PLACE)
        end = stopped_by_obstacles(
            begin[0], begin[1], begin[2], own[0], own[1], own[2], endless, endless, endless,
            moving + number * RECORD + BARRIER, live, within, slack, least_crease, 0.0, 0.0, SURFACES, False,
        )  # fmt: skip
        stopped = live & ((end[0] != own[0]) | (end[1] != own[1]) | (end[2] != own[2]))
        put = plus(turned(pose + LATER, plus(end, pose + PIVOT, live, -1), live, False), pose + LATER_PLACE, live, 1)
        ex, ey, ez = tl.where(stopped, put[0], ex), tl.where(stopped, put[1], ey), tl.where(stopped, put[2], ez)
    return tl.where(live, ex, free[0]), tl.where(live, ey, free[1]), tl.where(live, ez, free[2])


settle_keys(globals())
