"""Computes the part of a frame after the network's output: rest, integration, walls and obstacles.

The rules are those of hgn.step.reference. A frame is integrated only if no earlier frame reported an error.
Shape legend: N particles, K middles of coarsest or larger cells, T frames between two synchronisations with the host.
"""

import triton
import triton.language as tl

from hgn.kernels.bodies import body_of, coarsest_cells, cross, one_over, rotation, three_columns
from hgn.kernels.geometry import GEOMETRY_COLUMNS, lowest_middle, middles_around, split_slot
from hgn.kernels.obstacles import BARRIER_COLUMNS
from hgn.kernels.step.barriers import between_walls, stopped_by_moving, stopped_by_obstacles, wall_limit
from hgn.kernels.triton_compat import gdc_launch_dependents, gdc_wait, settle_keys
from hgn.network import images
from hgn.network.origins import FRACTION_BITS, STEPS
from hgn.step.reference import LEAST, SURE

RATES = tl.constexpr(8)  # number of columns of the sums and of the table of rest
SURELY, TINY = tl.constexpr(SURE), tl.constexpr(LEAST)
DIVERGED = tl.constexpr(4)
X_STEP, Y_STEP, Z_STEP = (tl.constexpr(step) for step in STEPS)
DROPPED_BITS, FRACTION_UNIT = tl.constexpr(32 - FRACTION_BITS), tl.constexpr(1 / 2**FRACTION_BITS)
MIRRORS = tl.constexpr(images.MIRRORS)
SCENE_BLOCK = tl.constexpr(32)  # scenes that `advance` handles together


@triton.jit
def _lowest(base_of, gate_of, spot_of, row, live):
    """Returns the slots of the lowest middles around particles, the gates, and the places from the middles in edges."""
    spot = three_columns(spot_of, row, 0, live, 1.0, 3)
    return tl.load(base_of + row, mask=live, other=0), tl.load(gate_of + row, mask=live, other=0.0), spot


@triton.jit
def _add_bodies(sums, slot, place, weight, value, BODIES: tl.constexpr, COLUMNS: tl.constexpr):
    """Adds to the sums of middles [K, COLUMNS] the particles' values and the moments place x value.
    With BODIES the particles' masses, places and products of places xx, yy, zz, yz, xz, xy come first."""
    at: tl.constexpr = 10 * BODIES
    moment = cross(place, (value[0][:, None], value[1][:, None], value[2][:, None]))
    column = tl.arange(0, COLUMNS)[None, None, :]
    added = tl.zeros((slot.shape[0], 8, COLUMNS), tl.float32)
    if BODIES:
        added = tl.where(column == 0, weight[:, :, None], added)
        for i in tl.static_range(3):
            one, other = place[(i + 1) % 3], place[(i + 2) % 3]
            added = tl.where(column == 1 + i, (weight * place[i])[:, :, None], added)
            added = tl.where(column == 4 + i, (weight * place[i] * place[i])[:, :, None], added)
            added = tl.where(column == 7 + i, (weight * one * other)[:, :, None], added)
    for i in tl.static_range(3):
        added = tl.where(column == at + i, (weight * value[i][:, None])[:, :, None], added)
        added = tl.where(column == at + 3 + i, (weight * moment[i])[:, :, None], added)
    # The last columns add zeros, because the hardware adds four columns at once.
    there = (weight > 0)[:, :, None] & (column < COLUMNS)
    tl.atomic_add(sums + slot[:, :, None] * COLUMNS + column, added, mask=there, sem="relaxed")


@triton.jit
def _deforming(table, slot, place, weight, value):
    """Returns the part of the particles' values that deforms the bodies around them, by the table [K, RATES]."""
    there = weight > 0
    base = three_columns(table, slot, 0, there, weight, RATES)
    swing = cross(three_columns(table, slot, 4, there, weight, RATES), place)
    factor = tl.sum(tl.load(table + slot * RATES + 3, mask=there, other=0.0) * weight, 1)
    result = ()
    for i in tl.static_range(3):
        part = factor * value[i] - tl.sum(base[i] + swing[i], 1)
        result = result + (part,)  # noqa: RUF005 - Triton does not support unpacking here
    return result


@triton.jit
def _displaced(x, velocity, scale, row, live, OUT: tl.constexpr, HISTORY: tl.constexpr):
    """Returns the next displacements in units of `scale`: columns 0 to 2 of x [N, OUT] plus the newest velocity."""
    ax, ay, az = three_columns(x, row, 0, live, 1.0, OUT)
    vx, vy, vz = three_columns(velocity, row, 0, live, 1 / tl.load(scale), 3 * HISTORY)
    return ax + vx, ay + vy, az + vz


@triton.jit
def sum_displacements(
    x, velocity, scale, material_of, coarsest_of, cell_weight_of, place_of, spread, slot_of_cell, geometry, low,
    base_of, gate_of, spot_of, sums, particle_count,
    OUT: tl.constexpr, HISTORY: tl.constexpr, LEVELS: tl.constexpr, SHIFT: tl.constexpr, RESTING: tl.constexpr,
    COLUMNS: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adds each particle to the sums [K, COLUMNS] of the middles around it, with its next displacement as value.

    `_add_bodies` defines the columns; hgn.kernels.geometry defines middles and spots. The kernel writes the slot of the
    lowest middle to `base_of` [N], the spot to `spot_of` [N, 3], and the gate to `gate_of` [N]. The gate is 0 for
    materials whose bit is not set in RESTING; -1 has all bits.

    Rule: hgn.step.reference.Deformation; test: tests/kernels/test_relative.py.
    """
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = row < tl.load(particle_count)
    line = geometry + (LEVELS - 1) * GEOMETRY_COLUMNS
    cell, cell_weight = coarsest_cells(coarsest_of, cell_weight_of, row, live)
    gate = tl.sum(cell_weight * tl.load(spread + cell * 2 + 1, mask=cell >= 0, other=0.0), 1)
    if RESTING != -1:
        gate *= (RESTING >> tl.load(material_of + row, mask=live, other=0) & 1).to(tl.float32)
    own = tl.load(coarsest_of + row * 8, mask=live, other=-1)
    local = tl.load(slot_of_cell + tl.load(line + 6) + own, mask=own >= 0, other=0)
    ny, nz, stride = tl.load(line + 2), tl.load(line + 3), tl.load(line + 4)
    scene, kx, ky, kz = split_slot(local, ny, nz, stride)
    bx, x_spot = lowest_middle(kx, 0, low, place_of, row, live, LEVELS, SHIFT)
    by, y_spot = lowest_middle(ky, 1, low, place_of, row, live, LEVELS, SHIFT)
    bz, z_spot = lowest_middle(kz, 2, low, place_of, row, live, LEVELS, SHIFT)
    base, spot = scene * stride + (bx * ny + by) * nz + bz, (x_spot, y_spot, z_spot)
    base, gate = tl.where(own >= 0, base, 0), tl.where(own >= 0, gate, 0.0)
    slot, place, weight = middles_around(base, gate, spot, geometry, LEVELS)
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    tl.store(base_of + row, base, mask=live)
    tl.store(gate_of + row, gate, mask=live)
    for i in tl.static_range(3):
        tl.store(spot_of + row * 3 + i, spot[i], mask=live)
    value = _displaced(x, velocity, scale, row, live, OUT, HISTORY)
    _add_bodies(sums, slot, place, weight, value, True, COLUMNS)


@triton.jit
def find_deformation(
    bodies, sums, table, count,
    AT: tl.constexpr, COLUMNS: tl.constexpr, BODIES: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Computes the table [K, RATES] of the middles from the sums [K, COLUMNS] of a field, and of `bodies` [K, BODIES].

    The field begins at column AT. The table holds the subtracted motion (columns 0 to 2), the factor of a particle's
    own motion (3), and the subtracted rate of rotation (4 to 6).

    Rule: hgn.step.reference.Deformation; test: tests/kernels/test_relative.py.
    """
    middle = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = middle < count
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    inverse = one_over(tl.load(bodies + middle * BODIES, mask=there, other=0.0))
    x, y, z, inertia = body_of(bodies + 1, middle, there, inverse, BODIES)
    centre = (x, y, z)
    mean = three_columns(sums, middle, AT, there, inverse, COLUMNS)
    moment = three_columns(sums, middle, AT + 3, there, inverse, COLUMNS)
    lever = cross(centre, mean)
    known, wx, wy, wz = rotation(inertia, moment[0] - lever[0], moment[1] - lever[1], moment[2] - lever[2])
    share = 1 / tl.maximum(known, SURELY)
    turn = (share * wx, share * wy, share * wz)
    lever = cross(turn, centre)
    line = table + middle * RATES
    for i in tl.static_range(3):
        tl.store(line + i, share * known * mean[i] - lever[i], mask=there)
        tl.store(line + 4 + i, turn[i], mask=there)
    tl.store(line + 3, share * known, mask=there)


@triton.jit
def slow_displacements(
    x, velocity, scale, scene_of, gravity, threshold, slow, table, base_of, gate_of, spot_of, geometry, sums,
    particle_count,
    OUT: tl.constexpr, HISTORY: tl.constexpr, LEVELS: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the slow part of the deformation to `slow` [N, 3], and adds it with its moments to the sums [K, RATES].

    The table of the middles gives the deformation.

    Rule: hgn.step.reference.rest; test: tests/kernels/test_relative.py.
    """
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = row < tl.load(particle_count)
    value = _displaced(x, velocity, scale, row, live, OUT, HISTORY)
    scene = tl.load(scene_of + row, mask=live, other=0)
    gx, gy, gz = three_columns(gravity, scene, 0, live, threshold / tl.load(scale), 3)
    limit = gx * gx + gy * gy + gz * gz
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    base, gate, spot = _lowest(base_of, gate_of, spot_of, row, live)
    slot, place, weight = middles_around(base, gate, spot, geometry, LEVELS)
    d = _deforming(table, slot, place, weight, value)
    ratio = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) / tl.maximum(limit, TINY)
    phi = tl.where(limit > 0, tl.minimum(tl.maximum(2 - ratio, 0.0), 1.0), 0.0)
    stopped = ()
    for i in tl.static_range(3):
        stopped = stopped + (phi * d[i],)  # noqa: RUF005 - Triton does not support unpacking here
        tl.store(slow + row * 3 + i, stopped[i], mask=live)
    _add_bodies(sums, slot, place, weight, stopped, False, RATES)


@triton.jit
def stop_slow(
    x, slow, table, base_of, gate_of, spot_of, geometry, particle_count,
    OUT: tl.constexpr, LEVELS: tl.constexpr, OVERLAP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Subtracts the part of `slow` [N, 3] that deforms, by the table of the middles, from columns 0 to 2 of x [N, OUT].

    Rule: hgn.step.reference.Deformation; test: tests/kernels/test_relative.py.
    """
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = row < tl.load(particle_count)
    base, gate, spot = _lowest(base_of, gate_of, spot_of, row, live)
    slot, place, weight = middles_around(base, gate, spot, geometry, LEVELS)
    own = three_columns(x, row, 0, live, 1.0, OUT)
    value = three_columns(slow, row, 0, live, 1.0, 3)
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    part = _deforming(table, slot, place, weight, value)
    for i in tl.static_range(3):
        tl.store(x + row * OUT + i, own[i] - part[i], mask=live)


# integration


@triton.jit
def integrate(
    output, position, velocity, scene_of, domain, gravity, mean, std, particle_count, status, lost, frame, path,
    near, far, barrier_table, moving, poses, instant, scenes, within, slack, least_crease, sign, OUT: tl.constexpr,
    HISTORY: tl.constexpr, COLUMNS: tl.constexpr, WALLED_AXES: tl.constexpr, SURFACES: tl.constexpr,
    MOVING: tl.constexpr, OVERLAP: tl.constexpr, IMAGE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Computes v += a, x += v, and writes the new positions into path [T, N, 3] at `frame`.

    The acceleration a is gravity plus std times the output plus mean. With IMAGE the output is that of an image by the
    scenes' `sign` [S, 3]. If the status is not zero, nothing changes.
    `lost` counts the coordinates of particles that are not finite or farther from the domain than its own size. If
    there are any, `advance` ends the simulation. All others stay between the walls of the first WALLED_AXES axes,
    `near` and `far` from the planes. With SURFACES particles also stay outside the obstacles of `barrier_table`
    (`stopped_by_obstacles`). With MOVING, which needs SURFACES, moving obstacles act before the walls.

    Rule: hgn.step.reference.advanced; test: tests/kernels/test_rollout.py, tests/kernels/test_barriers.py.
    """
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    count = tl.load(particle_count)
    if tl.program_id(0) * BLOCK >= count:
        return
    if tl.load(status) != 0:
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    column = tl.arange(0, COLUMNS)[None, :]  # velocities, newest first; those of a particle lie side by side
    axis, newest = column % 3, column < 3
    live = (row < count)[:, None] & (column < 3 * HISTORY)
    live_axis = live & newest
    entry = row[:, None] * 3 + axis
    at = velocity + row[:, None] * (3 * HISTORY) + column
    v = tl.load(at - tl.where(newest, 0, 3), mask=live, other=0.0)
    a = tl.load(output + row[:, None] * OUT + axis, mask=live_axis, other=0.0)
    a = a * tl.load(std + axis) + tl.load(mean + axis)
    scene = tl.load(scene_of + row, mask=row < count, other=0)
    if IMAGE:
        a *= tl.load(sign + scene[:, None] * 3 + axis, mask=live_axis, other=1.0)
    a += tl.load(gravity + scene[:, None] * 3 + axis, mask=live_axis, other=0.0)
    v = tl.where(newest, v + a, v)
    before = tl.load(position + entry, mask=live_axis, other=0.0)
    x = before + v
    size = tl.load(domain + scene[:, None] * 3 + axis, mask=live_axis, other=1.0)
    inside = (x > -size) & (x < 2 * size)  # NaN counts as outside
    if WALLED_AXES > 0 and MOVING == 0:
        stopped, limit = wall_limit(x, before, size, near, far)
        stopped = stopped & live_axis & (axis < WALLED_AXES)
        v = tl.where(stopped, limit - before, v)
        x = tl.where(stopped, limit, x)
    if SURFACES > 0:
        bx, by, bz = three_columns(position, row, 0, row < count, 1.0, 3)
    now = tl.load(frame).to(tl.int64)
    tl.debug_barrier()  # all threads have read the frame before one writes
    tl.store(at, v, mask=live)
    tl.store(position + entry, x, mask=live_axis)
    tl.store(path + now * count * 3 + entry, x, mask=live_axis)
    outside = tl.sum(tl.sum((live_axis & (inside == 0)).to(tl.int32), 1), 0)
    if outside > 0:
        tl.atomic_add(lost, outside)
    if SURFACES > 0:
        tl.debug_barrier()  # positions are read again, a particle a thread; above, several threads share a particle
        x, y, z = three_columns(position, row, 0, row < count, 1.0, 3)
        width, height, depth = three_columns(domain, scene, 0, row < count, 1.0, 3)
        line = barrier_table + scene * BARRIER_COLUMNS
        free = (x, y, z)
        if MOVING > 0:
            x, y, z = stopped_by_moving(
                (bx, by, bz), free, (width, height, depth), scene, row < count, moving, poses, instant, scenes, within,
                slack, least_crease, SURFACES, MOVING,
            )  # fmt: skip
            x = between_walls(x, bx, width, near, far, WALLED_AXES > 0)
            y = between_walls(y, by, height, near, far, WALLED_AXES > 1)
            z = between_walls(z, bz, depth, near, far, WALLED_AXES > 2)
        ends = stopped_by_obstacles(
            bx, by, bz, x, y, z, width, height, depth, line, row < count, within, slack, least_crease, near, far,
            SURFACES, WALLED_AXES > 0,
        )  # fmt: skip
        begins = (bx, by, bz)
        for k in tl.static_range(3):
            moved = (row < count) & (ends[k] != free[k])
            tl.store(position + row * 3 + k, ends[k], mask=moved)
            tl.store(path + now * count * 3 + row * 3 + k, ends[k], mask=moved)
            tl.store(velocity + row * (3 * HISTORY) + k, ends[k] - begins[k], mask=moved)


@triton.jit
def advance(
    status, lost, frame, frame_of, origin, scenes, origin_range, sign, gravity, image_gravity,
    DIMENSIONS: tl.constexpr, IMAGES: tl.constexpr, OVERLAP: tl.constexpr,
):  # fmt: skip
    """Increments the frame if it was integrated, and sets the status to DIVERGED if coordinates were lost.

    It then also increments the frames `frame_of` of all scenes, int64, and writes the origins of their next grids, and
    with IMAGES, a number, the signs and gravities of their next images.

    Rule: hgn.runtime.torch_stepper and hgn.network.origins; test: tests/kernels/test_origins.py.
    """
    if OVERLAP:
        gdc_wait()
    if tl.load(status) == 0:
        tl.store(frame, tl.load(frame) + 1)
        for first in range(0, scenes, SCENE_BLOCK):
            scene = first + tl.arange(0, SCENE_BLOCK)
            there = scene < scenes
            number = tl.load(frame_of + scene, mask=there, other=0) + 1
            tl.store(frame_of + scene, number, mask=there)
            for axis in tl.static_range(DIMENSIONS):
                step = (X_STEP, Y_STEP, Z_STEP)[axis]
                fraction = ((number * step & 0xFFFFFFFF) >> DROPPED_BITS).to(tl.float32) * FRACTION_UNIT
                tl.store(origin + scene * 3 + axis, fraction * -origin_range, mask=there)
                if IMAGES > 0:
                    factor = fraction * 0 + 1
                    for i in tl.static_range(IMAGES):
                        if MIRRORS >> 3 * i + axis & 1:
                            factor = tl.where(number % IMAGES == i, -1.0, factor)
                    own = tl.load(gravity + scene * 3 + axis, mask=there, other=0.0)
                    tl.store(sign + scene * 3 + axis, factor, mask=there)
                    tl.store(image_gravity + scene * 3 + axis, factor * own, mask=there)
        if tl.load(lost) > 0:
            tl.store(status, DIVERGED)


settle_keys(globals())
