"""Builds the grid hierarchy on the device: marks, numbers and tables of cells. Nothing here waits for the host.
With `network.inputs: local` hgn.kernels.grid.bodies divides the cells among bodies.

One array of slots holds all levels of all scenes. Each level has a box of cells around the domain with a border of
one cell, so that neighbours need no check of bounds. Shape legend: N particles, C cells of a level, L levels.
"""

from __future__ import annotations

import triton
import triton.language as tl

from hgn.kernels.geometry import GEOMETRY_COLUMNS, raise_disturbed, split_slot
from hgn.kernels.grid.bodies import body_of_slot, number_of
from hgn.kernels.grid.slots import OUT_OF_BOX, OVERFLOW, base_cell, cell_in, marked, number_in, slot_of, slots_of
from hgn.kernels.grid.surfaces import add_drift, add_friction, surface_normals, surfaces_of
from hgn.kernels.triton_compat import gdc_launch_dependents, gdc_wait, settle_keys


@triton.jit
def show_image(
    position, velocity, scene_of, domain, sign, particle_count, image_position, image_velocity, wall_shift,
    HISTORY: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the images of positions [N, 3] and velocity histories [N, 3 HISTORY], by the scenes' `sign` [S, 3].

    Rule: hgn.network.images; test: tests/kernels/test_images.py.
    """
    count = tl.load(particle_count)
    if tl.program_id(0) * BLOCK >= count:
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    column = tl.arange(0, COLUMNS)[None, :]
    live = (row < count)[:, None] & (column < 3 * HISTORY)
    scene = tl.load(scene_of + row, mask=row < count, other=0)
    entry = scene[:, None] * 3 + column % 3
    factor = tl.load(sign + entry, mask=live, other=1.0)
    at = row[:, None] * (3 * HISTORY) + column
    tl.store(image_velocity + at, factor * tl.load(velocity + at, mask=live, other=0.0), mask=live)
    is_place = live & (column < 3)
    at = row[:, None] * 3 + column
    shift = tl.where(factor < 0, tl.load(domain + entry, mask=is_place, other=0.0) + wall_shift, 0.0)
    x = tl.load(position + at, mask=is_place, other=0.0)
    tl.store(image_position + at, factor * x + shift, mask=is_place)


@triton.jit
def mark_cells(
    position, scene_of, origin, particle_count, low, geometry, occupied, reached, status, cell_size,
    LEVELS: tl.constexpr, BODIES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Marks the slots of the cells that particles reach, and of their ancestors, in one pass for all levels.

    With BODIES it marks the finest level only, and adds the bits of the corners that a particle reaches to `reached` at
    the particle's lowest cell.

    Rule: hgn.network.grid.build_hierarchy; test: tests/kernels/test_network.py.
    """
    count = tl.load(particle_count)
    if tl.program_id(0) * BLOCK >= count:
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = row < count
    scene = tl.load(scene_of + row, mask=live, other=0)
    x, y, z, fx, fy, fz, inside = base_cell(position, origin, scene, row, live, low, geometry, cell_size)
    lost = tl.sum((live & (inside == 0)).to(tl.int32), 0)
    if lost > 0:
        tl.atomic_or(status, OUT_OF_BOX)
    upper_x, upper_y, upper_z = x + (fx > 0).to(tl.int32), y + (fy > 0).to(tl.int32), z + (fz > 0).to(tl.int32)
    levels = ()
    for level in tl.static_range(1 if BODIES else LEVELS):
        levels = levels + (slots_of(geometry, level),)  # noqa: RUF005 - Triton does not support unpacking here
        # All levels are read before the first store, because the compiler would wait for each read after a store.
    for level in tl.static_range(1 if BODIES else LEVELS):
        slots = levels[level]
        for corner in tl.static_range(8):
            cx = (upper_x if corner >> 2 & 1 else x) >> level
            cy = (upper_y if corner >> 1 & 1 else y) >> level
            cz = (upper_z if corner & 1 else z) >> level
            # Of the corners with the same ancestor only the lowest stores: each store uses bandwidth of the L2 cache.
            first = inside
            if corner >> 2 & 1:
                first = first & (cx != x >> level)
            if corner >> 1 & 1:
                first = first & (cy != y >> level)
            if corner & 1:
                first = first & (cz != z >> level)
            tl.store(occupied + slot_of(cx, cy, cz, scene, slots), 1, mask=first)
    if BODIES:
        bits = tl.where(fz > 0, 3, 1)
        bits = tl.where(fy > 0, bits | bits << 2, bits)
        bits = tl.where(fx > 0, bits | bits << 4, bits)
        at = reached + slot_of(x, y, z, scene, levels[0])
        # Most particles find their bits there.
        lacks = inside & ((tl.load(at, mask=inside, other=255) & bits) != bits)
        tl.atomic_or(at, bits, mask=lacks, sem="relaxed")


@triton.jit
def _write_cells(table, cell, live, occupied, prefix_sum, slots, first, capacity, own_capacity, COUNT: tl.constexpr):
    """Writes the numbers of COUNT neighbours of each cell: those in `slots[i]` to row i of the table.

    The table is [COUNT, own_capacity]. All numbers are read before the first store, as in `mark_cells`.
    """
    there = ()
    for i in tl.static_range(COUNT):
        there = there + (marked(occupied, slots[i], live),)  # noqa: RUF005 - Triton does not support unpacking here
    numbers = ()
    for i in tl.static_range(COUNT):
        numbers = numbers + (number_in(prefix_sum, slots[i], first, capacity, there[i]),)  # noqa: RUF005
    for i in tl.static_range(COUNT):
        tl.store(table + i * own_capacity + cell, numbers[i], mask=live)


@triton.jit
def fill_tables(
    occupied, prefix_sum, geometry, slot_of_cell, neighbour, parent, octant, children, counts, needed, status,
    LEVELS: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the neighbours, parent and children of each active slot's cell, int32, -1 for none.

    Rule: hgn.network.grid.build_hierarchy; test: tests/kernels/test_network.py.
    """
    if OVERLAP:
        gdc_launch_dependents()  # kernels that need only the numbers of the cells may start
    level = tl.program_id(1)
    line = geometry + level * GEOMETRY_COLUMNS
    start, slots = tl.load(line), tl.load(line + 1)
    if tl.program_id(0) * BLOCK >= slots:
        return
    ny, nz, stride, capacity, at = (
        tl.load(line + 2),
        tl.load(line + 3),
        tl.load(line + 4),
        tl.load(line + 5),
        tl.load(line + 6),
    )
    first = tl.load(prefix_sum + start - 1, mask=level > 0, other=0)
    if tl.program_id(0) == 0:
        total = tl.load(prefix_sum + start + slots - 1) - first
        tl.store(needed + level, total)
        tl.store(counts + level, tl.minimum(total, capacity))
        if total > capacity:
            tl.atomic_or(status, OVERFLOW)
    local = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    slot = start + local
    cell = cell_in(occupied, prefix_sum, slot, first, capacity, local < slots)
    live = cell >= 0
    if tl.sum(live.to(tl.int32), 0) == 0:
        return
    tl.store(slot_of_cell + at + cell, local, mask=live)
    slots_around = ()
    for direction in tl.static_range(6):
        step = ny * nz
        if direction // 2 == 1:
            step = nz
        if direction // 2 == 2:
            step = step * 0 + 1
        if direction % 2 == 1:
            step = -step
        slots_around = slots_around + (slot + step,)  # noqa: RUF005
    _write_cells(neighbour + 6 * at, cell, live, occupied, prefix_sum, slots_around, first, capacity, capacity, 6)
    scene, x, y, z = split_slot(local, ny, nz, stride)
    tl.store(octant + at + cell, ((x & 1) * 2 + (y & 1)) * 2 + (z & 1), mask=live)
    if level < LEVELS - 1:
        above = line + GEOMETRY_COLUMNS
        above_y, above_z = tl.load(above + 2), tl.load(above + 3)
        above_slot = tl.load(above) + scene * tl.load(above + 4)
        above_slot += (((x >> 1) + 1) * above_y + (y >> 1) + 1) * above_z + (z >> 1) + 1
        above_first = tl.load(prefix_sum + tl.load(above) - 1)
        above_cell = cell_in(occupied, prefix_sum, above_slot, above_first, tl.load(above + 5), live)
        tl.store(parent + at + cell, above_cell, mask=live)
    if level > 0:
        below = line - GEOMETRY_COLUMNS
        below_y, below_z = tl.load(below + 2), tl.load(below + 3)
        below_first = tl.load(prefix_sum + tl.load(below) - 1, mask=level > 1, other=0)
        below_start = tl.load(below) + scene * tl.load(below + 4)
        slots_below = ()
        for child in tl.static_range(8):
            cx, cy, cz = 2 * x + (child >> 2 & 1), 2 * y + (child >> 1 & 1), 2 * z + (child & 1)
            below_slot = below_start + ((cx + 1) * below_y + cy + 1) * below_z + cz + 1
            slots_below = slots_below + (below_slot,)  # noqa: RUF005
        table = children + 8 * at
        _write_cells(table, cell, live, occupied, prefix_sum, slots_below, below_first, tl.load(below + 5), capacity, 8)


@triton.jit
def _coarsest_part(x, fraction, high, LEVELS: tl.constexpr):
    """Returns three results for one axis. x is the coordinate of the lower corners, `high` marks the upper ones.

    [N, 8], bool: false for an upper corner in the same coarsest cell as the lower one, which counts once.
    [N, 8]: the weight of the particle in the corner's coarsest cell.
    [N]: the particle's place relative to the middle of the lower corner's coarsest cell, in edges of this cell."""
    ABOVE: tl.constexpr = LEVELS - 1
    EDGE: tl.constexpr = 1 << ABOVE
    split = ((x + (fraction > 0).to(tl.int32)) >> ABOVE) != x >> ABOVE
    cell_weight = tl.where(split[:, None], tl.where(high, fraction[:, None], 1 - fraction[:, None]), 1.0)
    place = ((x & EDGE - 1).to(tl.float32) + fraction - 0.5 * (EDGE - 1)) / EDGE
    return (high == 0) | split[:, None], cell_weight, place


@triton.jit
def prepare_particles(
    position, velocity, scene_of, origin, particle_count, low, geometry, occupied, prefix_sum, cell_of,
    weight_of, fraction_of, motion, coarsest_of, cell_weight_of, place_of, moments, domain, obstacle_table,
    obstacle_cell_size, features, contact_of, disturbed, wall_friction, gravity, scale, friction, moving, poses,
    instant, surface_of, drift, links, table, numbers, mask, scenes, cell_size, reach, capacity, scene_position,
    scene_velocity, sign, HISTORY: tl.constexpr, LEVELS: tl.constexpr, MOTION: tl.constexpr, COLUMNS: tl.constexpr,
    NORMALS: tl.constexpr, OBSTACLES: tl.constexpr, SYMMETRY: tl.constexpr, REACH: tl.constexpr, FEATURES: tl.constexpr,
    FRICTION: tl.constexpr, FRICTION_AT: tl.constexpr, MOVING: tl.constexpr, BODIES: tl.constexpr,
    OVERLAP: tl.constexpr, IMAGE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the 8 finest cells of each particle, its weights in them, and its fraction within the lowest cell.

    With MOTION (relative inputs) it writes for each particle too: the features of surfaces; its contact [N];
    its coarsest cells `coarsest_of` [N, 8], where repeated cells are -1; its weights `cell_weight_of` in them; and
    its place [N, 3] from the middle of the lowest coarsest cell, in edges. It adds to cells: mass and momentum to the
    finest (`motion` [.., 4]); places, products xx, yy, zz, yz, xz, xy, and such products of normals to the coarsest
    (`moments` [C, COLUMNS]). It raises column 1 of the coarsest cells' `disturbed` [C, 2] to at least the contact times
    FULLY. With FRICTION, a number of columns, `add_friction` writes these from FRICTION_AT on and adds to `friction`
    [C, COLUMNS]. With MOVING it writes V (`surfaces_of`) to `surface_of` [N, 3], and `add_drift` adds V to `drift`
    [C, 8]. OBSTACLES and SYMMETRY mean the same as in prepare_features, REACH as in obstacle_normals.
    `scene_position`, `scene_velocity`, `sign` and IMAGE are those of surfaces_of.

    Rule: hgn.network.grid.build_hierarchy and hgn.network.relative; test: tests/kernels/test_network.py.
    """
    count = tl.load(particle_count)
    if tl.program_id(0) * BLOCK >= count:
        if OVERLAP:
            gdc_wait()
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = row < count
    scene = tl.load(scene_of + row, mask=live, other=0)
    if MOTION:
        surfaces, contact, surface = surfaces_of(
            position, velocity, domain, row, live, scene, obstacle_table, obstacle_cell_size, reach, moving, poses,
            instant, scenes, scene_position, scene_velocity, sign, HISTORY, OBSTACLES, SYMMETRY,
            4 if FRICTION > 0 else 3, REACH, MOVING, IMAGE,
        )  # fmt: skip
        tl.store(contact_of + row, contact, mask=live)
        column = tl.arange(0, 16)[None, :]
        at = features + row[:, None] * FEATURES + (3 * (HISTORY + LEVELS) + column)
        tl.store(at, surfaces, mask=live[:, None] & (column < 6 + 6 * NORMALS))
    x, y, z, fx, fy, fz, inside = base_cell(position, origin, scene, row, live, low, geometry, cell_size)
    slots = slots_of(geometry, 0)
    # All corners are in one tensor [BLOCK, 8], so that a thread stores neighbouring elements.
    corner = tl.arange(0, 8)[None, :]
    high_x, high_y, high_z = (corner >> 2 & 1) == 1, (corner >> 1 & 1) == 1, (corner & 1) == 1
    cx = x[:, None] + (high_x & (fx > 0)[:, None]).to(tl.int32)
    cy = y[:, None] + (high_y & (fy > 0)[:, None]).to(tl.int32)
    cz = z[:, None] + (high_z & (fz > 0)[:, None]).to(tl.int32)
    here = live[:, None] & (corner >= 0)
    cell = cell_in(
        occupied, prefix_sum, slot_of(cx, cy, cz, scene[:, None], slots), 0, capacity, inside[:, None] & (corner >= 0)
    )
    weight = tl.where(high_x, fx[:, None], 1 - fx[:, None])
    weight *= tl.where(high_y, fy[:, None], 1 - fy[:, None])
    weight *= tl.where(high_z, fz[:, None], 1 - fz[:, None])
    tl.store(fraction_of + row * 3, fx, mask=live)
    tl.store(fraction_of + row * 3 + 1, fy, mask=live)
    tl.store(fraction_of + row * 3 + 2, fz, mask=live)
    if MOTION:
        part = tl.arange(0, 4)[None, :]
        # Column 0 is the mass, columns 1 to 3 are the momentum.
        v = tl.load(velocity + row[:, None] * (3 * HISTORY) + part - 1, mask=live[:, None] & (part > 0), other=1.0)
        touched = ((cell >= 0) & (weight > 0))[:, :, None] & (part >= 0)[:, None, :]
        at = motion + cell[:, :, None] * 4 + part[:, None, :]
        tl.atomic_add(at, weight[:, :, None] * v[:, None, :], mask=touched, sem="relaxed")
        across_x, share_x, px = _coarsest_part(x, fx, high_x, LEVELS)
        across_y, share_y, py = _coarsest_part(y, fy, high_y, LEVELS)
        across_z, share_z, pz = _coarsest_part(z, fz, high_z, LEVELS)
        cell_weight = share_x * share_y * share_z
        above = slots_of(geometry, LEVELS - 1)
        slot = slot_of(cx >> LEVELS - 1, cy >> LEVELS - 1, cz >> LEVELS - 1, scene[:, None], above)
        across = inside[:, None] & across_x & across_y & across_z
        if BODIES and LEVELS > 1:
            body = body_of_slot(links, slot_of(x, y, z, scene, slots), inside)
            coarsest = number_of(table, numbers, mask, slot, body[:, None] + 0 * corner, across)
        else:
            first = tl.load(prefix_sum + above[0] - 1, mask=above[0] > 0, other=0)
            most = tl.load(geometry + (LEVELS - 1) * GEOMETRY_COLUMNS + 5)
            coarsest = cell_in(occupied, prefix_sum, slot, first, most, across)
        coarsest = tl.where(cell_weight > 0, coarsest, -1)
        tl.store(coarsest_of + row[:, None] * 8 + corner, coarsest, mask=here)
        tl.store(cell_weight_of + row[:, None] * 8 + corner, cell_weight, mask=here)
        tl.store(place_of + row * 3, px, mask=live)
        tl.store(place_of + row * 3 + 1, py, mask=live)
        tl.store(place_of + row * 3 + 2, pz, mask=live)
        px = px[:, None, None] - high_x[:, :, None].to(tl.float32)
        py = py[:, None, None] - high_y[:, :, None].to(tl.float32)
        pz = pz[:, None, None] - high_z[:, :, None].to(tl.float32)
        part = tl.arange(0, COLUMNS)[None, None, :]
        one = tl.where((part == 1) | (part == 4) | (part == 6), py, tl.where((part == 2) | (part == 5), pz, px))
        other = tl.where(part == 3, px, tl.where((part == 4) | (part == 8), py, tl.where(part < 3, 1.0, pz)))
        added = tl.where(part < 9, cell_weight[:, :, None] * one * other, 0.0)
        product = surface_normals(surfaces, BODIES)
        for i in tl.static_range(6):
            added = tl.where(part == 9 + i, cell_weight[:, :, None] * product[i][:, None, None], added)
        # The added columns are a multiple of four, because the hardware adds four at once.
        adds = (coarsest >= 0)[:, :, None] & ((part < 12) | (contact > 0)[:, None, None])
        tl.atomic_add(moments + coarsest[:, :, None] * COLUMNS + part, added, mask=adds, sem="relaxed")
        raise_disturbed(disturbed + 1, coarsest, contact)
        if FRICTION > 0:
            add_friction(
                surfaces, velocity, wall_friction, gravity, scale, scene, row, live, coarsest, cell_weight, friction,
                features + row * FEATURES + FRICTION_AT, HISTORY, FRICTION > 3, MOVING, BODIES, COLUMNS,
            )  # fmt: skip
        if MOVING > 0:
            add_drift(contact, surface, coarsest, cell_weight, drift)
            for i in tl.static_range(3):
                tl.store(surface_of + row * 3 + i, surface[i], mask=live)
    if OVERLAP:
        gdc_wait()  # needed by the next kernels, which read the tables that earlier kernels fill
    # With cells past the capacity the frame is void, but no access may be out of bounds.
    tl.store(cell_of + row[:, None] * 8 + corner, tl.maximum(cell, 0), mask=here)
    tl.store(weight_of + row[:, None] * 8 + corner, weight, mask=here)


settle_keys(globals())
