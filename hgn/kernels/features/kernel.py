"""Computes features of particles on the device: the paper's absolute ones, or relative ones and the motion of cells.

hgn.kernels.grid writes the inputs from the grid. Shape legend: N particles, C cells of a level, L levels.
"""

from __future__ import annotations

import triton
import triton.language as tl

from hgn.kernels.blocks import with_column
from hgn.kernels.bodies import one_over, three_columns
from hgn.kernels.geometry import GEOMETRY_COLUMNS, add_above, most_around, raise_disturbed
from hgn.kernels.obstacles import OBSTACLE_COLUMNS, obstacle_normals
from hgn.kernels.triton_compat import gdc_launch_dependents, gdc_wait, settle_keys
from hgn.network import elastic
from hgn.scene import rest_shape

STRETCH, NEIGHBOURS = tl.constexpr(elastic.STRETCH), tl.constexpr(rest_shape.NEIGHBOURS)


@triton.jit
def sum_motion(
    motion, parent, geometry, counts, disturbed, spread, neighbour, drift, coarsest_capacity,
    LEVELS: tl.constexpr, MOVING: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adds mass and momentum of the finest cells to all cells above them, in `motion` [.., 4] of all levels.

    A second set of programs writes the nearness of surfaces to the coarsest cells' `spread` [C, 2] (`most_around`), and
    with MOVING the mean V (hgn.network.moving) of a cell and those across its faces to columns 4 to 6 of `drift`.

    Rule: hgn.network.relative; test: tests/kernels/test_network.py.
    """
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    count = tl.load(counts)
    if tl.program_id(0) * BLOCK >= count:
        return
    cell = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    if tl.program_id(1) == 1:  # these programs run at the same time as those of the sums
        there = cell < tl.load(counts + LEVELS - 1)
        most_around(disturbed, spread, 1, neighbour, cell, there, coarsest_capacity)
        if MOVING > 0:
            x, y, z = three_columns(drift, cell, 0, there, 1.0, 8)
            contacts = tl.load(drift + cell * 8 + 3, mask=there, other=0.0)
            for slot in tl.static_range(6):
                other = tl.load(neighbour + slot * coarsest_capacity + cell, mask=there, other=-1)
                more = three_columns(drift, other, 0, other >= 0, 1.0, 8)
                x, y, z = x + more[0], y + more[1], z + more[2]
                contacts += tl.load(drift + other * 8 + 3, mask=other >= 0, other=0.0)
            inverse = one_over(contacts)
            tl.store(drift + cell * 8 + 4, x * inverse, mask=there)
            tl.store(drift + cell * 8 + 5, y * inverse, mask=there)
            tl.store(drift + cell * 8 + 6, z * inverse, mask=there)
        return
    add_above(motion, parent, geometry, cell, cell < count, LEVELS)


@triton.jit
def prepare_features(
    position, velocity, scene_of, material_of, domain, particle_count, mean, std, obstacle_table,
    obstacle_cell_size, features, wall_maximum,
    HISTORY: tl.constexpr, NORMALS: tl.constexpr, OBSTACLES: tl.constexpr, SYMMETRY: tl.constexpr,
    FEATURES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the absolute features [N, FEATURES]: velocities, normal if NORMALS, walls, one-hot material.

    Without OBSTACLES the normals are zero. SYMMETRY means the same as in obstacle_normals.

    Rule: hgn.network.features; test: tests/kernels/test_network.py.
    """
    count = tl.load(particle_count)
    if tl.program_id(0) * BLOCK >= count:
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = row < count
    scene = tl.load(scene_of + row, mask=live, other=0)
    column = tl.arange(0, FEATURES)
    axis = column % 3
    here = live[:, None]
    # The 3 * HISTORY velocities have component `axis` of velocity k in column 3 k + axis.
    is_velocity = column < 3 * HISTORY
    v = tl.load(velocity + row[:, None] * (3 * HISTORY) + column[None, :], mask=here & is_velocity[None, :], other=0.0)
    centred = v - tl.load(mean + axis)[None, :]
    value = tl.where(
        is_velocity[None, :], tl.div_rn(centred, tl.load(std + axis)[None, :] + tl.zeros_like(centred)), 0.0
    )
    WALLS: tl.constexpr = 3 * HISTORY + 3 * NORMALS
    if OBSTACLES:
        x = tl.load(position + row * 3, mask=live, other=0.0)
        y = tl.load(position + row * 3 + 1, mask=live, other=0.0)
        z = tl.load(position + row * 3 + 2, mask=live, other=0.0)
        line = obstacle_table + scene * OBSTACLE_COLUMNS
        normal = obstacle_normals(x, y, z, line, live, obstacle_cell_size, SYMMETRY, 3, 0.0)
        for i in tl.static_range(3):
            value = with_column(value, 3 * HISTORY + i, normal[i])
    is_wall = (column >= WALLS) & (column < WALLS + 6)
    place = tl.load(position + row[:, None] * 3 + axis[None, :], mask=here & is_wall[None, :], other=0.0)
    size = tl.load(domain + scene[:, None] * 3 + axis[None, :], mask=here & is_wall[None, :], other=0.0)
    distance = tl.where((column >= WALLS + 3)[None, :], size - place, place)
    distance = tl.minimum(tl.maximum(distance, -wall_maximum), wall_maximum) / wall_maximum
    value = tl.where(is_wall[None, :], distance, value)
    material = tl.load(material_of + row, mask=live, other=0)
    value = tl.where((column[None, :] - (WALLS + 6)) == material[:, None], 1.0, value)
    tl.store(features + row[:, None] * FEATURES + column[None, :], value, mask=here)


@triton.jit
def _asinh(x):
    """Returns asinh(x), exactly odd, with float32's precision near zero too: log(1 + y) by Kahan's method."""
    size = tl.abs(x)
    y = size + size * size / (1 + tl.sqrt(1 + size * size))
    one = 1 + y
    rounded = one - 1
    result = tl.where(rounded == 0, y, tl.log(one) * (y / tl.where(rounded == 0, 1.0, rounded)))
    return tl.where(x < 0, -result, result)


@triton.jit
def deform(position, rest, particle_count, scale, columns, WIDTH: tl.constexpr, AT: tl.constexpr, BLOCK: tl.constexpr):
    """Writes the columns of elastic bodies to `columns` [N, WIDTH] from AT on. `rest` is RestShape.packed.

    Rule: hgn.network.elastic; test: tests/kernels/test_network.py.
    """
    count = tl.load(particle_count)
    if tl.program_id(0) * BLOCK >= count:
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = row < count
    part = tl.arange(0, 4)[None, :]
    numbers = rest + row * (5 * NEIGHBOURS)
    x, y, z = three_columns(position, row, 0, live, 1.0, 3)
    sum_x = tl.zeros((BLOCK, 4), tl.float32)  # a row of F and a component of e (hgn.network.elastic)
    sum_y, sum_z, most = sum_x, sum_x, row * 0 - 1
    for k in tl.static_range(NEIGHBOURS):
        other = tl.load(numbers + k, mask=live, other=-1)
        there = other >= 0
        most = tl.maximum(most, other)
        bits = tl.load(numbers[:, None] + NEIGHBOURS + 4 * k + part, mask=there[:, None], other=0)
        weight = bits.to(tl.float32, bitcast=True)
        sum_x += weight * tl.where(there, tl.load(position + other * 3, mask=there, other=0.0) - x, 0.0)[:, None]
        sum_y += weight * tl.where(there, tl.load(position + other * 3 + 1, mask=there, other=0.0) - y, 0.0)[:, None]
        sum_z += weight * tl.where(there, tl.load(position + other * 3 + 2, mask=there, other=0.0) - z, 0.0)[:, None]
    factor = tl.where(most >= 0, 0.5 / STRETCH, 0.0)
    fx = tl.where(part < 3, sum_x, 0.0)
    fy = tl.where(part < 3, sum_y, 0.0)
    fz = tl.where(part < 3, sum_z, 0.0)
    unit = tl.load(scale)
    store = columns + row * WIDTH + AT
    tl.store(store, _asinh((tl.sum(fx * fx, 1) - 1) * factor), mask=live)
    tl.store(store + 1, _asinh((tl.sum(fy * fy, 1) - 1) * factor), mask=live)
    tl.store(store + 2, _asinh((tl.sum(fz * fz, 1) - 1) * factor), mask=live)
    tl.store(store + 3, _asinh(tl.sum(fy * fz, 1) * factor), mask=live)
    tl.store(store + 4, _asinh(tl.sum(fx * fz, 1) * factor), mask=live)
    tl.store(store + 5, _asinh(tl.sum(fx * fy, 1) * factor), mask=live)
    tl.store(store + 6, _asinh(tl.sum(sum_x - fx, 1) / unit), mask=live)
    tl.store(store + 7, _asinh(tl.sum(sum_y - fy, 1) / unit), mask=live)
    tl.store(store + 8, _asinh(tl.sum(sum_z - fz, 1) / unit), mask=live)


@triton.jit
def _add_slip(v, gravity, scale, scene, live, cell, cell_weight, sums, COLUMNS: tl.constexpr):
    """Adds to the sums [C, COLUMNS] the columns of `add_friction` that depend on velocity, for the velocity `v`."""
    column = tl.arange(0, 4)[None, :]
    value = 0.0 * v[0][:, None] + 0.0 * column
    square = 0.0 * v[0]
    for i in tl.static_range(3):
        w = (v[i] + tl.load(gravity + scene * 3 + i, mask=live, other=0.0)) / tl.load(scale)
        value = with_column(value, i, w)
        square += w * w
    value = with_column(value, 3, square)
    at = sums + cell[:, :, None] * COLUMNS + 12 + column[:, None, :]
    there = (cell >= 0)[:, :, None] & (column >= 0)[:, None, :]
    tl.atomic_add(at, cell_weight[:, :, None] * value[:, None, :], mask=there, sem="relaxed")


@triton.jit
def prepare_relative_features(
    velocity, scene_of, material_of, gravity, particle_count, scale, cell_of, weight_of, coarsest_of, cell_weight_of,
    motion, parent, geometry, features, contact_of, disturbed, spread, parameter_of, surface_of, drift, friction, quiet,
    HISTORY: tl.constexpr, LEVELS: tl.constexpr, NORMALS: tl.constexpr, FRICTION: tl.constexpr,
    FRICTION_AT: tl.constexpr, PARAMETERS: tl.constexpr, PARAMETERS_AT: tl.constexpr, MOVING: tl.constexpr,
    COLUMNS: tl.constexpr, FEATURES: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes each particle's relative features [N, FEATURES], which neither a boost nor a shift changes.

    They are: changes of velocity minus gravity; the velocity relative to the cells around on each level, whose mass and
    momentum are in `motion`; near a surface the velocity, weighted by `spread` of the coarsest cells; the columns of
    surfaces and the FRICTION columns from FRICTION_AT on, which prepare_particles wrote; the one-hot material; and the
    PARAMETERS columns of `parameter_of` from PARAMETERS_AT on. Velocities are written as asinh(velocity / `scale`).
    The kernel raises column 0 of the coarsest cells' `disturbed` [C, 2] to their particles' disturbance, times FULLY.
    With MOVING the velocity near a surface is relative to the surface, and `_add_slip` adds it to `friction`.

    Rule: hgn.network.relative; test: tests/kernels/test_network.py.
    """
    HISTORIES: tl.constexpr = 3 * (HISTORY - 1)
    CONTACT: tl.constexpr = HISTORIES + 3 * LEVELS
    WALLS: tl.constexpr = CONTACT + 3
    MATERIAL: tl.constexpr = WALLS + 6 + 6 * NORMALS
    count = tl.load(particle_count)
    if tl.program_id(0) * BLOCK >= count:
        if OVERLAP:
            gdc_wait()
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = row < count
    here = live[:, None]
    scene = tl.load(scene_of + row, mask=live, other=0)
    column = tl.arange(0, FEATURES)
    axis = column % 3
    is_history = here & (column < HISTORIES)[None, :]
    at = velocity + row[:, None] * (3 * HISTORY) + column[None, :]
    value = tl.load(at, mask=is_history, other=0.0) - tl.load(at + 3, mask=is_history, other=0.0)
    value -= tl.load(gravity + scene[:, None] * 3 + axis[None, :], mask=is_history, other=0.0)
    corner = tl.arange(0, 8)[None, :]
    corners = here & (corner >= 0)
    if OVERLAP:
        gdc_wait()
    cell = tl.load(cell_of + row[:, None] * 8 + corner, mask=corners, other=0)
    weight = tl.load(weight_of + row[:, None] * 8 + corner, mask=corners, other=0.0)
    for level in tl.static_range(LEVELS):
        first = tl.load(geometry + level * GEOMETRY_COLUMNS + 6)
        at = motion + (first + cell) * 4
        mass = tl.load(at, mask=corners, other=0.0)
        share = tl.where(mass > 0, weight / tl.where(mass > 0, mass, 1.0), 0.0)
        for i in tl.static_range(3):
            around = tl.sum(share * tl.load(at + 1 + i, mask=corners, other=0.0), 1)
            own = tl.load(velocity + row * (3 * HISTORY) + i, mask=live, other=0.0)
            value = with_column(value, HISTORIES + 3 * level + i, own - around)
        if level < LEVELS - 1:
            # With a parent past the capacity the frame is void, but no access may be out of bounds.
            cell = tl.maximum(tl.load(parent + first + cell, mask=corners, other=0), 0)
    is_contact = here & ((column >= CONTACT) & (column < WALLS))[None, :]
    v = tl.load(velocity + row[:, None] * (3 * HISTORY) + axis[None, :], mask=is_contact, other=0.0)
    contact = tl.load(contact_of + row, mask=live, other=0.0)
    coarsest = tl.load(coarsest_of + row[:, None] * 8 + corner, mask=corners, other=-1)
    cell_weight = tl.load(cell_weight_of + row[:, None] * 8 + corner, mask=coarsest >= 0, other=0.0)
    gate_part = cell_weight * tl.load(spread + coarsest * 2 + 1, mask=coarsest >= 0, other=0.0)
    gate = tl.sum(gate_part, 1)
    if MOVING > 0:
        around = three_columns(drift, coarsest, 4, coarsest >= 0, one_over(gate)[:, None] * gate_part, 8)
        surface = three_columns(surface_of, row, 0, live, contact, 3)
        slip = three_columns(velocity, row, 0, live, 1.0, 3 * HISTORY)
        relative = ()
        for i in tl.static_range(3):
            own = slip[i] - (surface[i] + (1 - contact) * tl.sum(around[i], 1))
            relative = relative + (own,)  # noqa: RUF005 - Triton does not support unpacking here
            v = with_column(v, CONTACT + i, own)
        if FRICTION > 0:
            _add_slip(relative, gravity, scale, scene, live, coarsest, cell_weight, friction, COLUMNS)
    value = tl.where(is_contact, v, value)
    value = _asinh(tl.div_rn(value, tl.load(scale) + tl.zeros_like(value)))
    value = tl.where(is_contact, value * gate[:, None], value)
    moved = tl.where((column < CONTACT)[None, :], value / quiet, 0.0)
    raise_disturbed(disturbed, coarsest, tl.minimum(contact + tl.sum(moved * moved, 1), 1.0))
    material = tl.load(material_of + row, mask=live, other=0)
    value = tl.where((column[None, :] - MATERIAL) == material[:, None], 1.0, value)
    own = (column < WALLS) | (column >= MATERIAL)
    if FRICTION > 0:
        own = own & ((column < FRICTION_AT) | (column >= FRICTION_AT + FRICTION))
    if PARAMETERS > 0:
        is_parameter = here & ((column >= PARAMETERS_AT) & (column < PARAMETERS_AT + PARAMETERS))[None, :]
        at = parameter_of + row[:, None] * PARAMETERS + (column - PARAMETERS_AT)[None, :]
        value = tl.where(is_parameter, tl.load(at, mask=is_parameter, other=0.0), value)
    tl.store(features + row[:, None] * FEATURES + column[None, :], value, mask=here & own[None, :])


settle_keys(globals())
