"""Computes surfaces near particles for relative inputs: nearness of walls, obstacle normals, and friction.

Shape legend: N particles, C coarsest cells.
"""

from __future__ import annotations

import triton
import triton.language as tl

from hgn.kernels.blocks import with_column
from hgn.kernels.obstacles import OBSTACLE_COLUMNS, obstacle_normals
from hgn.kernels.triton_compat import settle_keys
from hgn.network.relative import STEPS_AHEAD, WALL_LIMIT

NEAREST, STEPS = tl.constexpr(WALL_LIMIT), tl.constexpr(STEPS_AHEAD)


@triton.jit
def surfaces_of(
    position, velocity, domain, row, live, scene, obstacle_table, obstacle_cell_size, reach,
    HISTORY: tl.constexpr, OBSTACLES: tl.constexpr, SYMMETRY: tl.constexpr, ROW: tl.constexpr,
):  # fmt: skip
    """Returns two results. The first is [N, 16]: six nearnesses of walls, the normal at the particle, the normal ahead,
    friction at the particle and ahead with ROW = 4, and zeros. The second is the contact of the particle [N]: 0 if no
    surface is within reach, at most 1."""
    column = tl.arange(0, 16)
    axis, upper, walls = column % 3, (column >= 3)[None, :], live[:, None] & (column < 6)[None, :]
    v = tl.load(velocity + row[:, None] * (3 * HISTORY) + axis[None, :], mask=walls, other=0.0)
    place = tl.load(position + row[:, None] * 3 + axis[None, :], mask=walls, other=0.0)
    size = tl.load(domain + scene[:, None] * 3 + axis[None, :], mask=walls, other=0.0)
    distance = tl.where(upper, size - place, place) + tl.minimum(tl.where(upper, -v, v), 0.0)
    value = tl.where(walls, tl.minimum(tl.maximum(1 - distance / reach, 0.0), NEAREST), 0.0)
    touch = tl.minimum(2 * tl.max(value, 1), 1.0)
    if OBSTACLES:
        # The probes are the present position, and steps along the path to the next frame.
        quarters = tl.arange(0, 8)[None, :]
        asked = live[:, None] & (quarters <= STEPS)
        at = position + row[:, None] * 3 + 0 * quarters
        v_at = velocity + row[:, None] * (3 * HISTORY) + 0 * quarters
        time = quarters.to(tl.float32) / STEPS
        x = tl.load(at, mask=asked, other=0.0) + tl.load(v_at, mask=asked, other=0.0) * time
        y = tl.load(at + 1, mask=asked, other=0.0) + tl.load(v_at + 1, mask=asked, other=0.0) * time
        z = tl.load(at + 2, mask=asked, other=0.0) + tl.load(v_at + 2, mask=asked, other=0.0) * time
        line = obstacle_table + scene[:, None] * OBSTACLE_COLUMNS + 0 * quarters
        normal = obstacle_normals(x, y, z, line, asked, obstacle_cell_size, SYMMETRY, ROW)
        found = (normal[0] != 0) | (normal[1] != 0) | (normal[2] != 0)
        ahead = tl.min(tl.where(found & (quarters > 0), quarters, 8), 1)
        for i in tl.static_range(ROW):
            value = with_column(value, 6 + i if i < 3 else 12, tl.sum(tl.where(quarters == 0, normal[i], 0.0), 1))
            there = tl.sum(tl.where(quarters == ahead[:, None], normal[i], 0.0), 1)
            value = with_column(value, 9 + i if i < 3 else 13, there)
        touch = tl.where(tl.max(found.to(tl.int32), 1) > 0, 1.0, touch)
    return value, touch


@triton.jit
def _first(surfaces, COUNT: tl.constexpr):
    """Returns the normal of `surfaces_of` at the particle, or ahead if it is 0; with COUNT = 4 also the friction."""
    column = tl.arange(0, 16)[None, :]
    here = tl.sum(tl.where((column >= 6) & (column < 9), tl.abs(surfaces), 0.0), 1) > 0
    first = ()
    for i in tl.static_range(COUNT):
        at = tl.where(here, 6 + i if i < 3 else 12, 9 + i if i < 3 else 13)[:, None]
        first = first + (tl.sum(tl.where(column == at, surfaces, 0.0), 1),)  # noqa: RUF005
    return first


@triton.jit
def surface_normals(surfaces):
    """Returns products xx, yy, zz, yz, xz, xy of the normals of `surfaces_of`, summed over a particle's surfaces."""
    column = tl.arange(0, 16)[None, :]
    near = ()
    for i in tl.static_range(3):
        sides = tl.where((column == i) | (column == i + 3), tl.minimum(2 * surfaces, 1.0), 0.0)
        near = near + (tl.sum(sides, 1),)  # noqa: RUF005 - Triton knows no unpacking here
    x, y, z = _first(surfaces, 3)
    return near[0] + x * x, near[1] + y * y, near[2] + z * z, y * z, x * z, x * y


@triton.jit
def add_friction(
    surfaces, velocity, wall_friction, gravity, scale, scene, row, live, cell, share, sums, features,
    HISTORY: tl.constexpr, NORMALS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Writes the columns of friction to `features` [N]: the obstacle cells' with NORMALS, then the walls'.

    Adds to the sums [C, COLUMNS], with the particles' weights `share` in their coarsest cells: products xx, yy, zz, yz,
    xz, xy of obstacle normals times friction; nearness of the six walls times friction; velocity plus gravity; and its
    square. Rule: hgn.network.own_physics.surface_friction; test: tests/kernels/test_network.py.
    """
    column = tl.arange(0, COLUMNS)[None, :]
    x, y, z, rough = _first(surfaces, 4)
    value = 0.0 * surfaces
    square = 0.0 * x
    product = x * x, y * y, z * z, y * z, x * z, x * y
    for i in tl.static_range(6):
        value = with_column(value, i, rough * product[i])
    if NORMALS:
        for i in tl.static_range(2):
            tl.store(features + i, tl.sum(tl.where(column == 12 + i, surfaces, 0.0), 1), mask=live)
    for i in tl.static_range(3):
        wall = tl.load(wall_friction + scene * 3 + i, mask=live, other=0.0)
        lower = tl.sum(tl.where(column == i, surfaces, 0.0), 1)
        upper = tl.sum(tl.where(column == 3 + i, surfaces, 0.0), 1)
        tl.store(features + 2 * NORMALS + i, tl.maximum(lower, upper) * wall, mask=live)
        value = with_column(value, 6 + i, tl.minimum(2 * lower, 1.0) * wall)
        value = with_column(value, 9 + i, tl.minimum(2 * upper, 1.0) * wall)
        v = tl.load(velocity + row * (3 * HISTORY) + i, mask=live, other=0.0)
        v = (v + tl.load(gravity + scene * 3 + i, mask=live, other=0.0)) / tl.load(scale)
        value = with_column(value, 12 + i, v)
        square += v * v
    value = with_column(value, 15, square)
    at = sums + cell[:, :, None] * COLUMNS + column[:, None, :]
    added = share[:, :, None] * value[:, None, :]
    tl.atomic_add(at, added, mask=(cell >= 0)[:, :, None] & (column >= 0)[:, None, :], sem="relaxed")


settle_keys(globals())
