"""What passes between the particles of a team's scene and its nodes.

Nodes are read whole. Where particles give to them four threads share a particle, one for each component of a node (x, y
and z of momentum, and mass): together they add up whole sectors of memory.
"""

import taichi as ti

from datagen.mpm.device_memory import add, load, load4, store4
from datagen.mpm.layout import BLOCK_NODES, CONSTANT, FIELD, LIVE, SETTING, SHAPE, TAG, VARIANT
from datagen.mpm.mls_mpm import (
    base_node,
    ghost_place,
    node_place,
    node_places,
    node_velocity,
    spline,
    weights,
)
from datagen.mpm.multiple_time_stepping import change_of
from datagen.mpm.team_lists import IDLE
from datagen.mpm.team_meeting import GIVING
from datagen.mpm.team_particles import dealt, get_vector
from datagen.mpm.time_step import falls

LANES = 4  # components of a node, and threads that share a particle where it gives to nodes
MASS = 3  # the component


@ti.func
def _vector(entries):
    return ti.Vector([entries[axis] for axis in range(MASS)])


@ti.func
def gather(
    x,
    bits: ti.i32,
    scene: ti.i32,
    velocities: ti.i32,
    node: ti.template(),
    setting: ti.template(),
    shape: ti.template(),
    contact: ti.template(),
    variant: ti.template(),
):
    """Velocity, its gradient and the mass at x from the nodes around, of which sheets hide `bits`."""
    inverse_dx = setting[SETTING.inverse_cell_size]
    scaled = x * inverse_dx
    base = ti.floor(scaled - 0.5, ti.i32)
    fx = scaled - ti.cast(base, ti.f32)
    w0, w1, w2 = weights(fx)
    w = ti.static((w0, w1, w2))
    first_entry = velocities + LANES * scene * shape[SHAPE.scene_blocks] * BLOCK_NODES
    index_x, index_y, index_z = node_places(base, first_entry, shape, LANES)
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
                share = w[k][2] * load4(node, index_x[i] + index_y[j] + index_z[k])
                line += share
                line_z += (k - fx[2]) * _vector(share)
            plane += w[j][1] * line
            plane_y += w[j][1] * (j - fx[1]) * _vector(line)
            plane_z += w[j][1] * line_z
        total += w[i][0] * plane
        gradient_x += w[i][0] * ((i - fx[0]) * _vector(plane))
        gradient_y += w[i][0] * plane_y
        gradient_z += w[i][0] * plane_z
    v = _vector(total)
    gradient = ti.Matrix.cols([gradient_x, gradient_y, gradient_z])
    if ti.static(bool(variant & VARIANT.sheets)):
        left = bits
        n = 0
        while left != 0:
            if left & 1:
                index = base + ti.Vector([n // 9, n // 3 % 3, n % 3])
                offset = ti.cast(index, ti.f32) - scaled
                seen = load4(node, velocities + LANES * node_place(index, scene, shape))
                change = _vector(load4(node, velocities + LANES * ghost_place(index, scene, contact, shape)) - seen)
                change *= spline(offset[0]) * spline(offset[1]) * spline(offset[2])
                v += change
                gradient += change.outer_product(offset)
            left >>= 1
            n += 1
    return v, 4.0 * inverse_dx * gradient, total[MASS]


@ti.func
def _entry(at: ti.i32, first: ti.i32, own_steps: ti.i32, giving: ti.template(), variant: ti.template()) -> ti.i32:
    """A particle that gives in this substep: as team_lists has it where some take steps of their own, else all do."""
    entry = at
    if ti.static(not variant & VARIANT.each_step):  # noqa: SIM102 (this one is the compiler's)
        if own_steps:
            entry = giving[first + at]
    return entry


@ti.func
def _particle(entry: ti.i32) -> ti.i32:
    return ti.max(entry, -1 - entry)


@ti.func
def scatter(
    owned: ti.i32,
    part: ti.i32,
    chunk: ti.i32,
    blocks: ti.i32,
    lane: ti.i32,
    scene: ti.i32,
    first: ti.i32,
    particles: ti.i32,
    tags: ti.i32,
    stride: ti.i32,
    segment: ti.i32,
    begins: ti.f32,
    own_steps: ti.i32,
    step: ti.f32,
    state: ti.template(),
    tag: ti.template(),
    giving: ti.template(),
    columns: ti.template(),
    response: ti.template(),
    hidden: ti.template(),
    node: ti.template(),
    setting: ti.template(),
    law: ti.template(),
    shape: ti.template(),
    contact: ti.template(),
    variant: ti.template(),
    threads: ti.template(),
    run: ti.template(),
):
    """Adds what particles give to their 27 nodes: momentum and mass; in later steps of an interval, of those alone that
    team_lists has, what forces change in momentum. A thread adds up what `run` particles in their order give, in a
    window of nodes that goes up a column with them; what it leaves goes to the nodes.
    """
    dx = setting[SETTING.cell_size]
    inverse_dx = setting[SETTING.inverse_cell_size]
    first_entry = LANES * scene * shape[SHAPE.scene_blocks] * BLOCK_NODES
    lanes, count = LANES, owned
    if ti.static(not variant & VARIANT.each_step):
        if begins == 0.0:
            lanes = MASS
        if ti.static(run > 1):  # noqa: SIM102 (this one is the compiler's)
            if own_steps:
                count = columns[segment + GIVING]
    task = lane
    tasks = (count + run - 1) // run * lanes
    while task < tasks:
        component = task % lanes
        own = task // lanes * run
        at = dealt(own, part, chunk, blocks)
        end = at + ti.min(run, count - own)
        entry = _entry(at, first, own_steps, giving, variant)
        task += threads
        if entry == IDLE:
            continue
        p = _particle(entry)
        gain = ti.Vector([0.0 for _ in range(27)])
        x = get_vector(state, particles + p, stride, FIELD.position)
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
                    A = ti.Vector([load(state, place + (FIELD.affine + 3 * component + j) * stride) for j in range(3)])
                else:  # what acts evenly, of xx, yy, zz, xy, xz, yz
                    for j in ti.static(range(3)):
                        which = j if component == j else 2 + component + j
                        A[j] = step * response[first + p + which * stride]
                A *= dx
                v = -A.dot(fx)
                if begins == 1.0:
                    v += load(state, place + (FIELD.velocity + component) * stride)
            if ti.static(bool(variant & VARIANT.several_laws)):
                scale = law[tag[tags + TAG.law_row * stride + p] + CONSTANT.mass]
                v *= scale
                A *= scale
            bits = 0
            if ti.static(bool(variant & VARIANT.sheets)):
                bits = hidden[first + p]
            for i, j in ti.static(ti.ndrange(3, 3)):
                weight_xy = w[i][0] * w[j][1]
                v_xy = v + A[0] * i + A[1] * j
                for k in ti.static(range(3)):
                    given = weight_xy * w[k][2] * (v_xy + A[2] * k)
                    if ti.static(bool(variant & VARIANT.sheets)):
                        given = 0.0 if (bits >> (9 * i + 3 * j + k)) & 1 else given
                    gain[9 * i + 3 * j + k] += given
            if ti.static(bool(variant & VARIANT.sheets)):
                n = 0
                while bits != 0:
                    if bits & 1:
                        corner = ti.Vector([n // 9, n // 3 % 3, n % 3])
                        away = ti.cast(corner, ti.f32)
                        weight = spline(away[0] - fx[0]) * spline(away[1] - fx[1]) * spline(away[2] - fx[2])
                        ghost = ghost_place(base + corner, scene, contact, shape)
                        add(node, LANES * ghost + component, weight * (v + A.dot(away)))
                    bits >>= 1
                    n += 1
            at += 1
            following = base
            if at < end:
                entry = _entry(at, first, own_steps, giving, variant)
                p = _particle(entry)
                x = get_vector(state, particles + p, stride, FIELD.position)
                following = base_node(x, inverse_dx)
            if at == end or (following != base).any():
                climbs = at < end and (following == base + ti.Vector([0, 1, 0])).all()
                index_x, index_y, index_z = node_places(base, first_entry + component, shape, LANES)
                for i, k in ti.static(ti.ndrange(3, 3)):
                    add(node, index_x[i] + index_y[0] + index_z[k], gain[9 * i + k])
                    gain[9 * i + k] = gain[9 * i + 3 + k]
                    gain[9 * i + 3 + k] = gain[9 * i + 6 + k]
                    gain[9 * i + 6 + k] = 0.0
                if not climbs:
                    for i, j, k in ti.static(ti.ndrange(3, 2, 3)):
                        add(node, index_x[i] + index_y[j + 1] + index_z[k], gain[9 * i + 3 * j + k])
                        gain[9 * i + 3 * j + k] = 0.0
                base = following


@ti.func
def _read_node(place: ti.i32, velocities: ti.i32, begins: ti.f32, node: ti.template()):
    """What came to its momentum, its mass, and its velocity before (none where an interval begins), with the time that
    it has fallen in this interval.
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
    place: ti.i32,
    facing: ti.i32,
    gain,
    mass: ti.f32,
    before,
    velocities: ti.i32,
    local: ti.i32,
    corner: ti.i32,
    scene: ti.i32,
    begins: ti.f32,
    ends: ti.i32,
    gravity_time: ti.f32,
    lead: ti.f32,
    fallen: ti.f32,
    node: ti.template(),
    scene_value: ti.template(),
    shape: ti.template(),
    contact_normal: ti.template(),
    variant: ti.template(),
):
    ahead = before[MASS] - fallen if begins == 0.0 else 0.0
    fall = falls(gravity_time + lead - ahead, scene, scene_value)
    v = node_velocity(
        _vector(before), gain, mass, local, facing, corner, fall, scene, scene_value, shape, contact_normal, variant
    )
    _write_node(place, velocities, v, mass, ends, fallen + gravity_time + lead, node)


@ti.func
def update_nodes(
    member: ti.i32,
    scene: ti.i32,
    velocities: ti.i32,
    begins: ti.f32,
    ends: ti.i32,
    some_wait: ti.i32,
    now: ti.i32,
    whole_step: ti.f32,
    left: ti.f32,
    gravity_time: ti.f32,
    fallen: ti.f32,
    block: ti.template(),
    live: ti.template(),
    node: ti.template(),
    scene_value: ti.template(),
    shape: ti.template(),
    contact: ti.template(),
    contact_normal: ti.template(),
    variant: ti.template(),
    members: ti.i32,
):
    """New velocities of the nodes of all blocks that particles touch; within an interval of those alone whose particles
    act.
    """
    block_list = shape[SHAPE.all_blocks] + scene * shape[SHAPE.scene_blocks]
    count = live[scene * LIVE.length + LIVE.blocks] * BLOCK_NODES
    n = member
    while n < count:
        touched = block[block_list + n // BLOCK_NODES]
        corner = block[block_list + shape[SHAPE.all_blocks] + n // BLOCK_NODES]
        local = n % BLOCK_NODES
        n += members
        many = 1.0
        if some_wait:
            many = change_of(block[3 * shape[SHAPE.all_blocks] + touched], now)
            if many == 0.0:
                continue
        lead = ti.min((many - 1.0) * whole_step, left)
        # all that is read, before anything is written: Taichi looks up where an array lies anew after each store
        place = LANES * (touched * BLOCK_NODES + local)
        entry = -1
        if ti.static(bool(variant & VARIANT.contact)):
            entry = contact[touched * BLOCK_NODES + local]
        gain, mass, before = _read_node(place, velocities, begins, node)
        if local == 0:
            block[touched] = 0
        if mass > 0.0:  # others keep a velocity of before, in which no particle has a share
            _update(
                place, 2 * entry, gain, mass, before, velocities, local, corner, scene, begins, ends, gravity_time,
                lead, fallen, node, scene_value, shape, contact_normal, variant,
            )  # fmt: skip
        if ti.static(bool(variant & VARIANT.sheets)):  # noqa: SIM102 (this one is the compiler's)
            if entry >= 0 and entry < shape[SHAPE.ghosts]:
                ghost = LANES * (shape[SHAPE.ghost_begin] + entry)
                gain_there, mass_there, before_there = _read_node(ghost, velocities, begins, node)
                _update(
                    ghost, 2 * entry + 1, gain_there, mass_there, before_there, velocities, local, corner, scene,
                    begins, ends, gravity_time, lead, fallen, node, scene_value, shape, contact_normal, variant,
                )  # fmt: skip
