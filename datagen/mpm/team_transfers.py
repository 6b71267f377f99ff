"""Transfers between the particles of a team's scene and its nodes.

A thread reads whole nodes. In the transfer to nodes several threads share a particle, one for each component of a node:
momentum along x, y, z, and in the first substep of an interval mass. Together they write sectors of memory.
"""

import taichi as ti

from datagen.mpm.device_memory import add, load, load4, store4
from datagen.mpm.layout import BLOCK_NODES, CONSTANT, FIELD, LIVE, SETTING, SHAPE, TAG, VARIANT
from datagen.mpm.mls_mpm import node_velocity
from datagen.mpm.multiple_time_stepping import change_of
from datagen.mpm.nodes import base_node, ghost_place, node_place, node_places, second_field, spline, weights
from datagen.mpm.team_lists import IDLE
from datagen.mpm.team_particles import dealt, get_vector
from datagen.mpm.team_sync import GIVING
from datagen.mpm.time_step import falls

LANES = 4  # number of components of a node
MASS = 3  # number of the component mass


@ti.func
def _vector(entries):
    return ti.Vector([entries[axis] for axis in range(MASS)])


@ti.func
def gather(x, bits: ti.i32, scene: ti.i32, velocities: ti.i32, arrays: ti.template()):
    """Returns velocity, its gradient and mass at x from the surrounding nodes. A sheet hides those in `bits`."""
    inverse_dx = arrays.setting[SETTING.inverse_cell_size]
    scaled = x * inverse_dx
    base = ti.floor(scaled - 0.5, ti.i32)
    fx = scaled - ti.cast(base, ti.f32)
    w0, w1, w2 = weights(fx)
    w = ti.static((w0, w1, w2))
    first_entry = velocities + LANES * scene * arrays.shape[SHAPE.scene_blocks] * BLOCK_NODES
    index_x, index_y, index_z = node_places(base, first_entry, arrays.shape, LANES)
    total = ti.Vector([0.0, 0.0, 0.0, 0.0])
    gradient_x = ti.Vector([0.0, 0.0, 0.0])
    gradient_y = ti.Vector([0.0, 0.0, 0.0])
    gradient_z = ti.Vector([0.0, 0.0, 0.0])
    for i in ti.static(range(3)):
        plane = ti.Vector([0.0, 0.0, 0.0, 0.0])
        plane_y = ti.Vector([0.0, 0.0, 0.0])
        plane_z = ti.Vector([0.0, 0.0, 0.0])
        for j in ti.static(range(3)):
            line = ti.Vector([0.0, 0.0, 0.0, 0.0])
            line_z = ti.Vector([0.0, 0.0, 0.0])
            for k in ti.static(range(3)):
                node = load4(arrays.node, index_x[i] + index_y[j] + index_z[k])
                line += w[k][2] * node
                line_z += w[k][2] * (k - fx[2]) * _vector(node)
            plane += w[j][1] * line
            plane_y += w[j][1] * (j - fx[1]) * _vector(line)
            plane_z += w[j][1] * line_z
        total += w[i][0] * plane
        gradient_x += w[i][0] * ((i - fx[0]) * _vector(plane))
        gradient_y += w[i][0] * plane_y
        gradient_z += w[i][0] * plane_z
    v = _vector(total)
    gradient = ti.Matrix.cols([gradient_x, gradient_y, gradient_z])
    if ti.static(bool(arrays.variant & VARIANT.sheets)):
        left = bits
        n = 0
        while left != 0:
            if left & 1:
                index = base + ti.Vector([n // 9, n // 3 % 3, n % 3])
                offset = ti.cast(index, ti.f32) - scaled
                seen = load4(arrays.node, velocities + LANES * node_place(index, scene, arrays.shape))
                change = _vector(load4(arrays.node, velocities + LANES * ghost_place(index, scene, arrays)) - seen)
                change *= spline(offset[0]) * spline(offset[1]) * spline(offset[2])
                v += change
                gradient += change.outer_product(offset)
            left >>= 1
            n += 1
    return v, 4.0 * inverse_dx * gradient, total[MASS]


@ti.func
def _entry(at: ti.i32, first: ti.i32, own_steps: ti.i32, arrays: ti.template()) -> ti.i32:
    """Returns entry `at` of `giving` (team_lists) if particles take their own steps, else `at`."""
    entry = at
    if ti.static(not arrays.variant & VARIANT.each_step):  # noqa: SIM102 (this one is the compiler's)
        if own_steps:
            entry = arrays.giving[first + at]
    return entry


@ti.func
def _particle(entry: ti.i32) -> ti.i32:
    return ti.max(entry, -1 - entry)


@ti.func
def scatter(
    share: ti.template(), thread: ti.template(), particles: ti.i32, tags: ti.i32, begins: ti.f32, own_steps: ti.i32,
    step: ti.f32, arrays: ti.template(),
):  # fmt: skip
    """Adds the contributions of particles to their 27 nodes: momentum and mass.

    After the first substep of an interval particles add only the impulse of forces. With `own_steps` only the particles
    of `giving` (team_lists) contribute. A thread sums over `run` particles in their order, in a window of 27 nodes that
    moves up a column of nodes with them. It writes the nodes that leave the window.
    """
    dx = arrays.setting[SETTING.cell_size]
    inverse_dx = arrays.setting[SETTING.inverse_cell_size]
    first_entry = LANES * share.scene * arrays.shape[SHAPE.scene_blocks] * BLOCK_NODES
    lanes, count = LANES, share.owned
    if ti.static(not arrays.variant & VARIANT.each_step):
        if begins == 0.0:
            lanes = MASS
        if ti.static(arrays.run > 1):  # noqa: SIM102 (this one is the compiler's)
            if own_steps:
                count = arrays.columns[thread.segment + GIVING]
    task = thread.lane
    tasks = (count + arrays.run - 1) // arrays.run * lanes
    while task < tasks:
        component = task % lanes
        own = task // lanes * arrays.run
        at = dealt(own, thread, share.chunk)
        end = at + ti.min(arrays.run, count - own)
        entry = _entry(at, share.first, own_steps, arrays)
        task += arrays.threads
        if entry == IDLE:
            continue
        p = _particle(entry)
        gain = ti.Vector([0.0 for _ in range(27)])
        x = get_vector(arrays.state, particles + p, thread.stride, FIELD.position)
        base = base_node(x, inverse_dx)
        while at < end:
            place = particles + p
            fx = x * inverse_dx - ti.cast(base, ti.f32)
            w0, w1, w2 = weights(fx)
            w = ti.static((w0, w1, w2))
            A = ti.Vector([0.0, 0.0, 0.0])
            v = 1.0
            if component < MASS:
                if entry >= 0:
                    A = ti.Vector(
                        [
                            load(arrays.state, place + (FIELD.affine + 3 * component + j) * thread.stride)
                            for j in range(3)
                        ]
                    )
                else:  # stress that acts evenly: xx, yy, zz, xy, xz, yz
                    for j in ti.static(range(3)):
                        which = j if component == j else 2 + component + j
                        A[j] = step * arrays.response[share.first + p + which * thread.stride]
                A *= dx
                v = -A.dot(fx)
                if begins == 1.0:
                    v += load(arrays.state, place + (FIELD.velocity + component) * thread.stride)
            if ti.static(bool(arrays.variant & VARIANT.several_laws)):
                scale = arrays.law[arrays.tag[tags + TAG.law_row * thread.stride + p] + CONSTANT.mass]
                v *= scale
                A *= scale
            bits = 0
            if ti.static(bool(arrays.variant & VARIANT.sheets)):
                bits = arrays.hidden[share.first + p]
            for i in ti.static(range(3)):
                weight = ti.Vector([w[i][0] * w[j][1] * w[k][2] for j in range(3) for k in range(3)])
                if ti.static(bool(arrays.variant & VARIANT.sheets)):
                    hidden = bits >> 9 * i & 511
                    if hidden != 0:  # most particles see all nodes
                        for n in ti.static(range(9)):
                            weight[n] = 0.0 if hidden >> n & 1 else weight[n]
                v_x = v + A[0] * i if i > 0 else v
                for j in ti.static(range(3)):
                    v_xy = v_x + A[1] * j if j > 0 else v_x
                    for k in ti.static(range(3)):
                        gain[9 * i + 3 * j + k] += weight[3 * j + k] * (v_xy + A[2] * k if k > 0 else v_xy)
            if ti.static(bool(arrays.variant & VARIANT.sheets)):
                n = 0
                while bits != 0:
                    if bits & 1:
                        corner = ti.Vector([n // 9, n // 3 % 3, n % 3])
                        away = ti.cast(corner, ti.f32)
                        weight = spline(away[0] - fx[0]) * spline(away[1] - fx[1]) * spline(away[2] - fx[2])
                        ghost = ghost_place(base + corner, share.scene, arrays)
                        add(arrays.node, LANES * ghost + component, weight * (v + A.dot(away)))
                    bits >>= 1
                    n += 1
            at += 1
            following = base
            if at < end:
                entry = _entry(at, share.first, own_steps, arrays)
                p = _particle(entry)
                x = get_vector(arrays.state, particles + p, thread.stride, FIELD.position)
                following = base_node(x, inverse_dx)
            if at == end or (following != base).any():
                climbs = at < end and (following == base + ti.Vector([0, 1, 0])).all()
                index_x, index_y, index_z = node_places(base, first_entry + component, arrays.shape, LANES)
                for i, k in ti.static(ti.ndrange(3, 3)):
                    add(arrays.node, index_x[i] + index_y[0] + index_z[k], gain[9 * i + k])
                    gain[9 * i + k] = gain[9 * i + 3 + k]
                    gain[9 * i + 3 + k] = gain[9 * i + 6 + k]
                    gain[9 * i + 6 + k] = 0.0
                if not climbs:
                    for i, j, k in ti.static(ti.ndrange(3, 2, 3)):
                        add(arrays.node, index_x[i] + index_y[j + 1] + index_z[k], gain[9 * i + 3 * j + k])
                        gain[9 * i + 3 * j + k] = 0.0
                base = following


@ti.func
def _read_node(place: ti.i32, velocities: ti.i32, begins: ti.f32, node: ti.template()):
    """Returns a node's gain of momentum, its mass, and its earlier velocity, zero at the start of an interval.

    Component MASS of the latter is the time in this interval for which the node has already received gravity.
    """
    before = ti.Vector([0.0, 0.0, 0.0, 0.0])
    if begins == 0.0:
        before = load4(node, velocities + place)
    gain = load4(node, place)
    return _vector(gain), gain[MASS], before


@ti.func
def _write_node(place: ti.i32, velocities: ti.i32, v, mass: ti.f32, ends: ti.i32, fallen: ti.f32, node: ti.template()):
    store4(node, place, 0.0, 0.0, 0.0, 0.0 if ends else mass)
    store4(node, velocities + place, v[0], v[1], v[2], mass if ends else fallen)


@ti.func
def _update(
    place: ti.i32, facing: ti.i32, gain, mass: ti.f32, before, velocities: ti.i32, local: ti.i32, corner: ti.i32,
    scene: ti.i32, begins: ti.f32, ends: ti.i32, gravity_time: ti.f32, lead: ti.f32, fallen: ti.f32,
    arrays: ti.template(),
):  # fmt: skip
    ahead = before[MASS] - fallen if begins == 0.0 else 0.0
    fall = falls(gravity_time + lead - ahead, scene, arrays.scene_value)
    v = node_velocity(_vector(before), gain, mass, local, facing, corner, fall, scene, arrays)
    _write_node(place, velocities, v, mass, ends, fallen + gravity_time + lead, arrays.node)


@ti.func
def update_nodes(
    thread: ti.template(), scene: ti.i32, begins: ti.f32, ends: ti.i32, some_wait: ti.i32, now: ti.i32,
    whole_step: ti.f32, left: ti.f32, gravity_time: ti.f32, fallen: ti.f32, arrays: ti.template(),
):  # fmt: skip
    """Computes the nodes' new velocities in all touched blocks, with `some_wait` only in those that change now."""
    block_list = arrays.shape[SHAPE.all_blocks] + scene * arrays.shape[SHAPE.scene_blocks]
    count = arrays.live[scene * LIVE.length + LIVE.blocks] * BLOCK_NODES
    n = thread.member
    while n < count:
        touched = arrays.block[block_list + n // BLOCK_NODES]
        corner = arrays.block[block_list + arrays.shape[SHAPE.all_blocks] + n // BLOCK_NODES]
        local = n % BLOCK_NODES
        n += thread.members
        many = 1.0
        if some_wait:
            many = change_of(arrays.block[3 * arrays.shape[SHAPE.all_blocks] + touched], now)
            if many == 0.0:
                continue
        lead = ti.min((many - 1.0) * whole_step, left)
        # all reads come before writes, because Taichi loads an array's address again after each store
        place = LANES * (touched * BLOCK_NODES + local)
        entry = -1
        if ti.static(bool(arrays.variant & VARIANT.contact)):
            entry = arrays.contact[touched * BLOCK_NODES + local]
        gain, mass, before = _read_node(place, thread.velocities, begins, arrays.node)
        if local == 0:
            arrays.block[touched] = 0
        if mass > 0.0:  # other nodes keep an earlier velocity, which has weight 0 for every particle
            _update(
                place, 2 * entry, gain, mass, before, thread.velocities, local, corner, scene, begins, ends,
                gravity_time, lead, fallen, arrays,
            )  # fmt: skip
        if ti.static(bool(arrays.variant & VARIANT.sheets)):
            second = second_field(touched * BLOCK_NODES + local, scene, arrays)
            if second >= 0:
                ghost = LANES * (arrays.shape[SHAPE.ghost_begin] + second)
                gain_there, mass_there, before_there = _read_node(ghost, thread.velocities, begins, arrays.node)
                _update(
                    ghost, 2 * entry + 1, gain_there, mass_there, before_there, thread.velocities, local, corner, scene,
                    begins, ends, gravity_time, lead, fallen, arrays,
                )  # fmt: skip
