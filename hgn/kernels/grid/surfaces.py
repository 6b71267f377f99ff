"""Computes surfaces near particles for relative inputs: nearness of walls, obstacle normals, and friction.

Shape legend: N particles, C coarsest cells.
"""

from __future__ import annotations

import triton
import triton.language as tl

from hgn.kernels.blocks import with_column
from hgn.kernels.bodies import three_columns
from hgn.kernels.obstacles import OBSTACLE_COLUMNS, obstacle_normals
from hgn.kernels.poses import LATER, PLACE, POSES, RECORD, surface_motion, turned, undone
from hgn.kernels.triton_compat import settle_keys
from hgn.network.own_physics import FREE_NEARNESS, FULL_NEARNESS
from hgn.network.relative import STEPS_AHEAD, WALL_LIMIT

NEAREST, STEPS = tl.constexpr(WALL_LIMIT), tl.constexpr(STEPS_AHEAD)
FREE, FULL = tl.constexpr(FREE_NEARNESS), tl.constexpr(FULL_NEARNESS)


@triton.jit
def _with_moving(
    normal, position, velocity, row, live, scene, moving, poses, instant, scenes, time, asked, obstacle_cell_size,
    HISTORY: tl.constexpr, SYMMETRY: tl.constexpr, ROW: tl.constexpr, REACH: tl.constexpr, LAYERS: tl.constexpr,
):  # fmt: skip
    """Returns the normal, friction, and V (hgn.network.moving) at fractions `time` of paths [N, 8]. `normal` has those
    of obstacles at rest. LAYERS moving obstacles are added (MovingObstacles.met)."""
    place = three_columns(position, row, 0, live, 1.0, 3)
    v = three_columns(velocity, row, 0, live, 1.0, 3 * HISTORY)
    nx, ny, nz, none = normal[0], normal[1], normal[2], 0.0 * time
    rough = normal[3] if ROW > 3 else none
    ux, uy, uz = none, none, none
    count = ((nx != 0) | (ny != 0) | (nz != 0)).to(tl.float32)
    first = tl.load(instant) * scenes * LAYERS
    for layer in range(LAYERS):
        number = (first + layer * scenes + scene).to(tl.int64)
        pose = poses + number * (2 * RECORD) + POSES
        own, surface = undone(pose, place, live, 0, PLACE), surface_motion(pose, place, live)
        way = turned(pose + LATER, (v[0] - surface[0], v[1] - surface[1], v[2] - surface[2]), live, True)
        x = own[0][:, None] + way[0][:, None] * time
        y = own[1][:, None] + way[1][:, None] * time
        z = own[2][:, None] + way[2][:, None] * time
        line = moving + (number * RECORD)[:, None] + 0 * time.to(tl.int32)
        seen = obstacle_normals(x, y, z, line, asked, obstacle_cell_size, SYMMETRY, ROW, REACH)
        there = ((seen[0] != 0) | (seen[1] != 0) | (seen[2] != 0)).to(tl.float32)
        own = turned(pose[:, None] + 0 * time.to(tl.int32), seen, asked, False)
        count += there
        nx, ny, nz = nx + there * own[0], ny + there * own[1], nz + there * own[2]
        if ROW > 3:
            rough += there * seen[3]
        ux += there * surface[0][:, None]
        uy += there * surface[1][:, None]
        uz += there * surface[2][:, None]
    # A sum of several normals longer than 1 is shortened to 1. Friction and V are means.
    longer = tl.where(count > 1, tl.maximum(nx * nx + ny * ny + nz * nz, 1.0), 1.0)
    scale, part = 1 / tl.sqrt_rn(longer), 1 / tl.maximum(count, 1.0)
    return nx * scale, ny * scale, nz * scale, rough * part, ux * part, uy * part, uz * part


@triton.jit
def surfaces_of(
    position, velocity, domain, row, live, scene, obstacle_table, obstacle_cell_size, reach, moving, poses, instant,
    scenes, scene_position, scene_velocity, sign, HISTORY: tl.constexpr, OBSTACLES: tl.constexpr,
    SYMMETRY: tl.constexpr, ROW: tl.constexpr, REACH: tl.constexpr, MOVING: tl.constexpr, IMAGE: tl.constexpr,
):  # fmt: skip
    """Returns three results. The first is [N, 16]: six nearnesses of walls, the normal at the particle, the normal
    ahead, friction at the particle and ahead with ROW = 4, and zeros. The second is the contact of the particle [N]: 0
    if no surface is within reach, at most 1. The third is V (hgn.network.moving), three components [N], if MOVING, the
    largest number of moving obstacles of a scene, is not 0. With IMAGE `position` and `velocity` are those of the image
    by the scenes' `sign` [S, 3]. Obstacles are looked up by `scene_position` and `scene_velocity`, without image."""
    column = tl.arange(0, 16)
    axis, upper, walls = column % 3, (column >= 3)[None, :], live[:, None] & (column < 6)[None, :]
    v = tl.load(velocity + row[:, None] * (3 * HISTORY) + axis[None, :], mask=walls, other=0.0)
    place = tl.load(position + row[:, None] * 3 + axis[None, :], mask=walls, other=0.0)
    size = tl.load(domain + scene[:, None] * 3 + axis[None, :], mask=walls, other=0.0)
    distance = tl.where(upper, size - place, place) + tl.minimum(tl.where(upper, -v, v), 0.0)
    value = tl.where(walls, tl.minimum(tl.maximum(1 - distance / reach, 0.0), NEAREST), 0.0)
    near = tl.max(value, 1)
    contact = tl.minimum(2 * near, 1.0)
    surface = contact, contact, contact
    if OBSTACLES or MOVING > 0:
        # The probes are the present position, and steps along the path to the next frame.
        quarters = tl.arange(0, 8)[None, :]
        asked = live[:, None] & (quarters <= STEPS)
        time = quarters.to(tl.float32) / STEPS
        if OBSTACLES:
            at = scene_position + row[:, None] * 3 + 0 * quarters
            v_at = scene_velocity + row[:, None] * (3 * HISTORY) + 0 * quarters
            x = tl.load(at, mask=asked, other=0.0) + tl.load(v_at, mask=asked, other=0.0) * time
            y = tl.load(at + 1, mask=asked, other=0.0) + tl.load(v_at + 1, mask=asked, other=0.0) * time
            z = tl.load(at + 2, mask=asked, other=0.0) + tl.load(v_at + 2, mask=asked, other=0.0) * time
            line = obstacle_table + scene[:, None] * OBSTACLE_COLUMNS + 0 * quarters
            normal = obstacle_normals(x, y, z, line, asked, obstacle_cell_size, SYMMETRY, ROW, REACH)
        else:
            none = 0.0 * time + 0.0 * contact[:, None]
            normal = none, none, none, none
        if MOVING > 0:
            normal = _with_moving(
                normal, scene_position, scene_velocity, row, live, scene, moving, poses, instant, scenes,
                time + 0.0 * contact[:, None], asked, obstacle_cell_size, HISTORY, SYMMETRY, ROW, REACH, MOVING,
            )  # fmt: skip
        if IMAGE:
            shown = ()
            for i in tl.static_range(ROW if MOVING == 0 else 7):
                factor = tl.load(sign + scene * 3 + (i if i < 3 else (i + 2) % 3), mask=live, other=1.0)[:, None]
                shown = shown + (normal[i] if i == 3 else factor * normal[i],)  # noqa: RUF005
            normal = shown
        found = (normal[0] != 0) | (normal[1] != 0) | (normal[2] != 0)
        ahead = tl.min(tl.where(found & (quarters > 0), quarters, 8), 1)
        for i in tl.static_range(ROW):
            value = with_column(value, 6 + i if i < 3 else 12, tl.sum(tl.where(quarters == 0, normal[i], 0.0), 1))
            there = tl.sum(tl.where(quarters == ahead[:, None], normal[i], 0.0), 1)
            value = with_column(value, 9 + i if i < 3 else 13, there)
        if REACH > 0:
            for first in tl.static_range(6, 12, 3):
                of_normal = (column >= first)[None, :] & (column < first + 3)[None, :]
                near = tl.maximum(near, tl.sqrt_rn(tl.sum(tl.where(of_normal, value * value, 0.0), 1)))
            contact = tl.minimum(2 * near, 1.0)
        else:
            contact = tl.where(tl.max(found.to(tl.int32), 1) > 0, 1.0, contact)
        if MOVING > 0:
            here = tl.max((found & (quarters == 0)).to(tl.int32), 1) > 0
            met = found & (quarters == tl.where(here, 0, ahead)[:, None])
            surface = tl.sum(tl.where(met, normal[4], 0.0), 1), tl.sum(tl.where(met, normal[5], 0.0), 1)
            surface = surface + (tl.sum(tl.where(met, normal[6], 0.0), 1),)  # noqa: RUF005
    return value, contact, surface


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
def _wall_contact(nearness, LOCAL: tl.constexpr):
    """Rule: hgn.network.own_physics.wall_contact."""
    FIRST: tl.constexpr = FREE if LOCAL else 0.0
    return tl.minimum(tl.maximum((nearness - FIRST) / (FULL - FIRST), 0.0), 1.0)


@triton.jit
def surface_normals(surfaces, LOCAL: tl.constexpr):
    """Returns products xx, yy, zz, yz, xz, xy of the normals of `surfaces_of`, summed over a particle's surfaces."""
    column = tl.arange(0, 16)[None, :]
    near = ()
    for i in tl.static_range(3):
        sides = tl.where((column == i) | (column == i + 3), _wall_contact(surfaces, LOCAL), 0.0)
        near = near + (tl.sum(sides, 1),)  # noqa: RUF005 - Triton does not support unpacking here
    x, y, z = _first(surfaces, 3)
    return near[0] + x * x, near[1] + y * y, near[2] + z * z, y * z, x * z, x * y


@triton.jit
def add_friction(
    surfaces, velocity, wall_friction, gravity, scale, scene, row, live, cell, cell_weight, sums, features,
    HISTORY: tl.constexpr, NORMALS: tl.constexpr, MOVING: tl.constexpr, LOCAL: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Writes the columns of friction to `features` [N]: the obstacle cells' with NORMALS, then the walls'.

    Adds to the sums [C, COLUMNS], with the particles' `cell_weight` in their coarsest cells: products xx, yy, zz, yz,
    xz, xy of obstacle normals times friction; nearness of the six walls times friction; velocity plus gravity; and its
    square. With MOVING prepare_relative_features adds the last two, because V of particles of a pile is not known yet.
    Rule: hgn.network.own_physics.surface_friction; test: tests/kernels/test_network.py.
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
        value = with_column(value, 6 + i, _wall_contact(lower, LOCAL) * wall)
        value = with_column(value, 9 + i, _wall_contact(upper, LOCAL) * wall)
        if MOVING == 0:
            v = tl.load(velocity + row * (3 * HISTORY) + i, mask=live, other=0.0)
            v = (v + tl.load(gravity + scene * 3 + i, mask=live, other=0.0)) / tl.load(scale)
            value = with_column(value, 12 + i, v)
            square += v * v
    value = with_column(value, 15, square)
    at = sums + cell[:, :, None] * COLUMNS + column[:, None, :]
    added = cell_weight[:, :, None] * value[:, None, :]
    tl.atomic_add(at, added, mask=(cell >= 0)[:, :, None] & (column >= 0)[:, None, :], sem="relaxed")


@triton.jit
def add_drift(contact, surface, cell, cell_weight, drift):
    """Adds contact times V to columns 0 to 2 of the coarsest cells' `drift` [C, 8], and the contact to column 3."""
    column = tl.arange(0, 4)[None, :]
    value = tl.where(column == 3, contact[:, None], 0.0)
    for i in tl.static_range(3):
        value = with_column(value, i, contact * surface[i])
    there = ((cell >= 0) & (contact > 0)[:, None])[:, :, None] & (column >= 0)[:, None, :]
    at = drift + cell[:, :, None] * 8 + column[:, None, :]
    tl.atomic_add(at, cell_weight[:, :, None] * value[:, None, :], mask=there, sem="relaxed")


settle_keys(globals())
