"""Frames of explicit MLS-MPM in one launch, a team of threads for each scene: the fast way on a GPU.

The method is that of datagen.mpm.mls_mpm, of whose parts it is made. What differs is who works: a scene of a few
thousand particles needs hundreds of steps a frame, each of a few microseconds' work, so one thread block runs a
scene by itself, step after step, without a launch or a look at other scenes in between. Scenes share nothing, so
each takes its own steps, and hundreds of them fill the device.

Within a step particles are put in order by cell (a counting sort over the occupied cells alone), and the sums to
the grid are taken by cell: nine threads hold the 27 nodes that a cell's particles touch, add up all particles of the
cell, and then add each node's sum once. That leaves one atomic sum a node and cell instead of one a particle.

In the later steps of an interval particles stay in their cells: only strain, sums of forces and nodes are left to do.

Nodes are stored by blocks of 4 x 4 x 4 as [block, component, node in block]: what the threads of a warp add to nodes
next to each other falls into few sectors of memory, and the L2 cache of a GPU takes sums sector by sector.

State is stored by field, `state[copy, field, particle]`: at each frame the particles are copied from one copy to
the other in the order of their cells, so that neighbours in space stay neighbours in memory.

With one thread a team it runs on a CPU too; the tests check it there against the other kernel.
"""

import taichi as ti

from datagen.mpm.layout import (
    BLOCK_NODES,
    CONSTANT,
    COUNT,
    FIELD,
    LIVE,
    SETTING,
    SHAPE,
    STATUS,
    TAG,
    VALUE,
    VARIANT,
    has_solid,
)
from datagen.mpm.mls_mpm import (
    Integers,
    Scalars,
    Vectors,
    base_node,
    choose_time_step,
    find_hidden,
    ghost_place,
    initial_stiffness,
    interpolate,
    interpolate_hidden,
    mark,
    move,
    node_place,
    node_places,
    node_velocity,
    planar,
    raise_maximum,
    respond,
    settle,
    spline,
)
from hgn.scene.material import MATERIAL_BITS, MATERIAL_MASK, SAND, WATER

LANES = 9  # threads that share a cell; each holds the three nodes of one y and z
# Components of a node: what comes to its momentum in a step, from 0 on; its mass; its velocity, from VELOCITY on. The
# first are zero between steps, the mass between intervals.
MASS = 3
VELOCITY = 4
SETTLING = 7  # the mass, for the end of an interval
COMPONENTS = 8
HIDDEN_ROW = 1 | 1 << 9 | 1 << 18  # of a particle's hidden nodes, those of one y and z


@ti.func
def _wait(threads: ti.template()):
    """Until the whole team is here, and sees what each has written."""
    if ti.static(threads > 1):
        ti.simt.block.sync()


@ti.func
def _vector(state: ti.template(), place: ti.i32, stride: ti.i32, field: ti.template()):
    return ti.Vector([state[place + (field + i) * stride] for i in range(3)])


@ti.func
def _matrix(state: ti.template(), place: ti.i32, stride: ti.i32, field: ti.template()):
    return ti.Matrix([[state[place + (field + 3 * i + j) * stride] for j in range(3)] for i in range(3)])


@ti.func
def _put_vector(state: ti.template(), place: ti.i32, stride: ti.i32, field: ti.template(), value):
    for i in ti.static(range(3)):
        state[place + (field + i) * stride] = value[i]


@ti.func
def _put_matrix(state: ti.template(), place: ti.i32, stride: ti.i32, field: ti.template(), value):
    for i, j in ti.static(ti.ndrange(3, 3)):
        state[place + (field + 3 * i + j) * stride] = value[i, j]


@ti.func
def _symmetric(state: ti.template(), place: ti.i32, stride: ti.i32, field: ti.template()):
    """A matrix from xx, yy, zz, xy, xz, yz."""
    s = ti.Vector([state[place + (field + i) * stride] for i in range(6)])
    return ti.Matrix([[s[0], s[3], s[4]], [s[3], s[1], s[5]], [s[4], s[5], s[2]]])


@ti.func
def _put_symmetric(state: ti.template(), place: ti.i32, stride: ti.i32, field: ti.template(), value):
    for i, row, column in ti.static(((0, 0, 0), (1, 1, 1), (2, 2, 2), (3, 0, 1), (4, 0, 2), (5, 1, 2))):
        state[place + (field + i) * stride] = value[row, column]


@ti.func
def _first_node(scene: ti.i32, shape: ti.template()):
    return scene * shape[SHAPE.scene_blocks] * (BLOCK_NODES * COMPONENTS)


@ti.func
def _cell(x, scene: ti.i32, setting: ti.template(), shape: ti.template()):
    """Where the cell of a particle lies in the arrays of nodes: at its base node."""
    return node_place(base_node(x, setting[SETTING.inverse_cell_size]), scene, shape)


@ti.func
def _reorder(
    lane: ti.i32,
    first: ti.i32,
    count: ti.i32,
    copy: ti.i32,
    stride: ti.i32,
    state: ti.template(),
    tag: ti.template(),
    order: ti.template(),
    fields: ti.template(),
    threads: ti.template(),
):
    """Copies the particles to the other copy, in the order of the last step's cells."""
    s = lane
    while s < count:
        source = copy * fields * stride + first + order[first + s]
        target = (1 - copy) * fields * stride + first + s
        for field in range(fields):
            state[target + field * stride] = state[source + field * stride]
        source_tag = copy * TAG.length * stride + first + order[first + s]
        target_tag = (1 - copy) * TAG.length * stride + first + s
        for i in ti.static(range(TAG.length)):
            tag[target_tag + i * stride] = tag[source_tag + i * stride]
        s += threads


@ti.func
def _strain_and_sort(
    lane: ti.i32,
    scene: ti.i32,
    first: ti.i32,
    count: ti.i32,
    particles: ti.i32,
    tags: ti.i32,
    stride: ti.i32,
    step: ti.f32,
    state: ti.template(),
    tag: ti.template(),
    rank: ti.template(),
    hidden: ti.template(),
    cell_count: ti.template(),
    cell_list: ti.template(),
    block: ti.template(),
    live: ti.template(),
    node: ti.template(),
    scene_value: ti.template(),
    counter: ti.template(),
    setting: ti.template(),
    law: ti.template(),
    shape: ti.template(),
    contact: ti.template(),
    contact_normal: ti.template(),
    variant: ti.template(),
    threads: ti.template(),
):
    """The materials' answer of each particle (left in place of C), and in the first step of an interval its rank among
    the particles of its cell.
    """
    solid = ti.static(has_solid(variant))
    begins = scene_value[scene, VALUE.begins]
    velocities = _first_node(scene, shape) + VELOCITY * BLOCK_NODES
    largest = 0.0
    fastest = 0.0
    p = lane
    while p < count:
        place = particles + p
        x = _vector(state, place, stride, FIELD.position)
        C = ti.Matrix.zero(ti.f32, 3, 3)
        stretch = ti.Matrix.zero(ti.f32, 3, 3)
        if begins == 1.0:
            cell = _cell(x, scene, setting, shape)
            rank_here = ti.atomic_add(cell_count[cell], 1)
            rank[first + p] = rank_here
            if ti.static(bool(variant & VARIANT.sheets)):
                hidden[first + p] = find_hidden(x, scene, contact, contact_normal, setting, shape)
            if rank_here == 0:
                cell_list[first + ti.atomic_add(live[scene * LIVE.length + LIVE.cells], 1)] = cell
                mark(
                    x, scene, setting[SETTING.inverse_cell_size], shape, block,
                    shape[SHAPE.all_blocks] + scene * shape[SHAPE.scene_blocks], live,
                    scene * LIVE.length + LIVE.blocks,
                )  # fmt: skip
            C = _matrix(state, place, stride, FIELD.affine)
        else:
            v_now, C_now = interpolate(x, velocities, node, setting[SETTING.inverse_cell_size], shape, COMPONENTS)
            if ti.static(bool(variant & VARIANT.sheets)):
                v_now, C_now = interpolate_hidden(
                    x, v_now, C_now, hidden[first + p], scene, VELOCITY * BLOCK_NODES, node,
                    setting[SETTING.inverse_cell_size], shape, contact, COMPONENTS,
                )  # fmt: skip
            C = C_now
            fastest = ti.max(fastest, v_now.dot(v_now))
            if ti.static(solid):
                stretch = _symmetric(state, place, stride, FIELD.stretch)
        F = ti.Matrix.identity(ti.f32, 3)
        material = tag[tags + TAG.material * stride + p]
        row = tag[tags + TAG.law_row * stride + p]
        if ti.static(solid):
            F = _matrix(state, place, stride, FIELD.deformation)
        A, new_stretch, new_F, volume, stiffness = respond(
            C, stretch, F, state[place + FIELD.volume * stride], material, row, step, begins, scene, counter, setting,
            law, variant,
        )  # fmt: skip
        _put_matrix(state, place, stride, FIELD.affine, A)
        if ti.static(solid):
            _put_matrix(state, place, stride, FIELD.deformation, new_F)
            _put_symmetric(state, place, stride, FIELD.stretch, new_stretch)
        state[place + FIELD.volume * stride] = volume
        largest = ti.max(largest, stiffness)
        p += threads
    raise_maximum(counter, scene, COUNT.stiffness_bits, largest)
    raise_maximum(counter, scene, COUNT.speed_square_bits, fastest)


@ti.func
def _add_hidden(
    base,
    ahead: ti.i32,
    weight: ti.f32,
    v,
    begins: ti.f32,
    scene: ti.i32,
    node: ti.template(),
    shape: ti.template(),
    contact: ti.template(),
):
    """Adds what a particle gives to the second field of the node that lies `ahead` nodes along x from `base`."""
    place = planar(ghost_place(base + ti.Vector([ahead, 0, 0]), scene, contact, shape), COMPONENTS)
    for c in ti.static(range(3)):
        ti.atomic_add(node[place + c * BLOCK_NODES], weight * v[c])
    if begins == 1.0:
        ti.atomic_add(node[place + MASS * BLOCK_NODES], weight)


@ti.func
def _scatter(
    lane: ti.i32,
    scene: ti.i32,
    first: ti.i32,
    particles: ti.i32,
    tags: ti.i32,
    stride: ti.i32,
    state: ti.template(),
    tag: ti.template(),
    order: ti.template(),
    hidden: ti.template(),
    cell_begin: ti.template(),
    live: ti.template(),
    node: ti.template(),
    scene_value: ti.template(),
    setting: ti.template(),
    law: ti.template(),
    shape: ti.template(),
    contact: ti.template(),
    variant: ti.template(),
    threads: ti.template(),
):
    """Adds what each cell's particles give to its 27 nodes: mass and momentum, in later steps of an interval what
    forces change in it.
    """
    begins = scene_value[scene, VALUE.begins]
    dx = setting[SETTING.cell_size]
    inverse_dx = setting[SETTING.inverse_cell_size]
    tasks = live[scene * LIVE.length + LIVE.cells] * LANES
    task = lane
    while task < tasks:
        entry = task // LANES
        slot = task - entry * LANES
        offset_y = slot // 3
        offset_z = slot - 3 * offset_y
        sum_0 = ti.Vector([0.0, 0.0, 0.0, 0.0])
        sum_1 = ti.Vector([0.0, 0.0, 0.0, 0.0])
        sum_2 = ti.Vector([0.0, 0.0, 0.0, 0.0])
        base = ti.Vector([0, 0, 0])
        s = cell_begin[2 * (first + entry)]
        end = s + cell_begin[2 * (first + entry) + 1]
        while s < end:
            p = order[first + s]
            place = particles + p
            scaled = _vector(state, place, stride, FIELD.position) * inverse_dx
            base = ti.floor(scaled - 0.5, ti.i32)  # the same for all of them
            away = ti.cast(base, ti.f32) - scaled
            away_y = away[1] + ti.cast(offset_y, ti.f32)
            away_z = away[2] + ti.cast(offset_z, ti.f32)
            weight = spline(away_y) * spline(away_z)
            if ti.static(bool(variant & VARIANT.several_laws)):
                weight *= law[tag[tags + TAG.law_row * stride + p] + CONSTANT.mass]
            A = _matrix(state, place, stride, FIELD.affine) * dx
            ahead = ti.Vector([A[0, 0], A[1, 0], A[2, 0]])
            v_0 = begins * _vector(state, place, stride, FIELD.velocity) + A @ ti.Vector([away[0], away_y, away_z])
            v_1 = v_0 + ahead
            v_2 = v_1 + ahead
            weight_0 = weight * spline(away[0])
            weight_1 = weight * spline(away[0] + 1.0)
            weight_2 = weight * spline(away[0] + 2.0)
            if ti.static(bool(variant & VARIANT.sheets)):
                bits = hidden[first + p] >> slot
                if bits & HIDDEN_ROW != 0:
                    row_base = base + ti.Vector([0, offset_y, offset_z])
                    if bits & 1:
                        _add_hidden(row_base, 0, weight_0, v_0, begins, scene, node, shape, contact)
                        weight_0 = 0.0
                    if bits & (1 << 9):
                        _add_hidden(row_base, 1, weight_1, v_1, begins, scene, node, shape, contact)
                        weight_1 = 0.0
                    if bits & (1 << 18):
                        _add_hidden(row_base, 2, weight_2, v_2, begins, scene, node, shape, contact)
                        weight_2 = 0.0
            sum_0 += weight_0 * ti.Vector([v_0[0], v_0[1], v_0[2], 1.0])
            sum_1 += weight_1 * ti.Vector([v_1[0], v_1[1], v_1[2], 1.0])
            sum_2 += weight_2 * ti.Vector([v_2[0], v_2[1], v_2[2], 1.0])
            s += 1
        index_x, index_y, index_z = node_places(
            base + ti.Vector([0, offset_y, offset_z]), _first_node(scene, shape), shape, COMPONENTS
        )
        row = index_y[0] + index_z[0]
        for c in ti.static(range(MASS)):
            ti.atomic_add(node[index_x[0] + row + c * BLOCK_NODES], sum_0[c])
            ti.atomic_add(node[index_x[1] + row + c * BLOCK_NODES], sum_1[c])
            ti.atomic_add(node[index_x[2] + row + c * BLOCK_NODES], sum_2[c])
        if begins == 1.0:
            ti.atomic_add(node[index_x[0] + row + MASS * BLOCK_NODES], sum_0[MASS])
            ti.atomic_add(node[index_x[1] + row + MASS * BLOCK_NODES], sum_1[MASS])
            ti.atomic_add(node[index_x[2] + row + MASS * BLOCK_NODES], sum_2[MASS])
        task += threads


@ti.func
def _gather(
    lane: ti.i32,
    scene: ti.i32,
    first: ti.i32,
    count: ti.i32,
    particles: ti.i32,
    tags: ti.i32,
    stride: ti.i32,
    state: ti.template(),
    tag: ti.template(),
    order: ti.template(),
    hidden: ti.template(),
    node: ti.template(),
    scene_value: ti.template(),
    counter: ti.template(),
    setting: ti.template(),
    shape: ti.template(),
    contact: ti.template(),
    contact_normal: ti.template(),
    variant: ti.template(),
    threads: ti.template(),
):
    """New velocity, gradient and position of each particle."""
    velocities = _first_node(scene, shape) + VELOCITY * BLOCK_NODES
    largest = 0.0
    s = lane
    while s < count:
        p = order[first + s]
        place = particles + p
        x = _vector(state, place, stride, FIELD.position)
        v, C = interpolate(x, velocities, node, setting[SETTING.inverse_cell_size], shape, COMPONENTS)
        if ti.static(bool(variant & VARIANT.sheets)):
            v, C = interpolate_hidden(
                x, v, C, hidden[first + p], scene, VELOCITY * BLOCK_NODES, node,
                setting[SETTING.inverse_cell_size], shape, contact, COMPONENTS,
            )  # fmt: skip
        moved, speed, speed_square = move(
            x, v, C, scene, scene_value, counter, setting, shape, contact, contact_normal, variant
        )
        if ti.static(bool(variant & VARIANT.water)):  # noqa: SIM102 (this one is the compiler's)
            if tag[tags + TAG.material * stride + p] == WATER:
                volume = place + FIELD.volume * stride
                state[volume] = settle(
                    x, state[volume], _first_node(scene, shape), scene, node, SETTLING, scene_value, setting, shape,
                    COMPONENTS,
                )  # fmt: skip
        _put_vector(state, place, stride, FIELD.position, moved)
        _put_vector(state, place, stride, FIELD.velocity, speed)
        _put_matrix(state, place, stride, FIELD.affine, C)
        largest = ti.max(largest, speed_square)
        s += threads
    raise_maximum(counter, scene, COUNT.speed_square_bits, largest)


@ti.kernel
def advance(
    frames: ti.i32,
    frame_s: ti.f32,
    state: Scalars,
    tag: Integers,
    rank: Integers,
    order: Integers,
    hidden: Integers,
    cell_count: Integers,
    cell_list: Integers,
    cell_begin: Integers,
    block: Integers,
    live: Integers,
    node: Scalars,
    turn: Integers,
    scene_value: ti.types.ndarray(dtype=ti.f32, ndim=2),
    counter: ti.types.ndarray(dtype=ti.i64, ndim=2),
    setting: Scalars,
    law: Scalars,
    shape: Integers,
    contact: Integers,
    contact_normal: Vectors,
    output: Scalars,
    variant: ti.template(),
    threads: ti.template(),
):
    """Advances every scene by `frames` frames, and writes each frame's positions to output[frame, particle, axis].

    Arrays, with P particles and G nodes of all scenes: state [2 * fields * P], tag [2 * 3 * P]; rank, order, hidden
    (see grid_kernel.substep), cell_list [P], cell_begin [2 P] and node [8 G] (see COMPONENTS) are work space;
    cell_count [G] and the flags in block [3 * G / 64] are zero between steps; turn [scenes] says which scene comes when
    (long ones first). A scene that failed keeps still.
    """
    ti.loop_config(block_dim=threads)
    for thread in range(turn.shape[0] * threads):
        fields = ti.static(FIELD.solid if has_solid(variant) else FIELD.fluid)
        scene = turn[thread // threads]
        lane = thread % threads
        first = shape[SHAPE.part_begin + scene]
        count = shape[SHAPE.part_begin + scene + 1] - first
        stride = rank.shape[0]
        own = scene * LIVE.length
        for frame in range(frames):
            copy = live[own + LIVE.copy]
            if live[own + LIVE.ordered] == 1:
                _reorder(lane, first, count, copy, stride, state, tag, order, fields, threads)
                copy = 1 - copy
            _wait(threads)
            particles = copy * fields * stride + first
            tags = copy * TAG.length * stride + first
            if lane == 0:
                live[own + LIVE.copy] = copy
                live[own + LIVE.ordered] = 1
                counter[scene, COUNT.frame_substeps] = ti.cast(0, ti.i64)
                if counter[scene, COUNT.status] == STATUS.running:
                    scene_value[scene, VALUE.remaining] = frame_s
            # without this the compiler joins what one thread does before and inside the loop, and its team would
            # wait for it at another barrier
            _wait(threads)
            going = 1
            while going == 1:
                if lane == 0:
                    choose_time_step(scene, scene_value, counter, setting, shape[SHAPE.maximum_substeps])
                    if scene_value[scene, VALUE.begins] == 1.0:
                        live[own + LIVE.cells] = 0
                        live[own + LIVE.blocks] = 0
                        live[own + LIVE.cursor] = 0
                _wait(threads)
                step = scene_value[scene, VALUE.time_step]
                if step > 0.0:
                    begins = scene_value[scene, VALUE.begins] == 1.0
                    ends = scene_value[scene, VALUE.interval_remaining] == 0.0
                    _strain_and_sort(
                        lane, scene, first, count, particles, tags, stride, step, state, tag, rank, hidden,
                        cell_count, cell_list, block, live, node, scene_value, counter, setting, law, shape, contact,
                        contact_normal, variant, threads,
                    )  # fmt: skip
                    _wait(threads)
                    blocks = live[own + LIVE.blocks]
                    block_list = shape[SHAPE.all_blocks] + scene * shape[SHAPE.scene_blocks]
                    cells = live[own + LIVE.cells]
                    if begins:
                        c = lane
                        while c < cells:
                            cell = cell_list[first + c]
                            length = cell_count[cell]
                            begin = ti.atomic_add(live[own + LIVE.cursor], length)
                            cell_begin[2 * (first + c)] = begin
                            cell_begin[2 * (first + c) + 1] = length
                            cell_count[cell] = begin
                            c += threads
                        _wait(threads)
                        p = lane
                        while p < count:
                            cell = _cell(_vector(state, particles + p, stride, FIELD.position), scene, setting, shape)
                            order[first + cell_count[cell] + rank[first + p]] = p
                            p += threads
                        _wait(threads)
                    _scatter(
                        lane, scene, first, particles, tags, stride, state, tag, order, hidden, cell_begin, live,
                        node, scene_value, setting, law, shape, contact, variant, threads,
                    )  # fmt: skip
                    _wait(threads)
                    n = lane
                    while n < blocks * BLOCK_NODES:
                        touched = block[block_list + n // BLOCK_NODES]
                        if n % BLOCK_NODES == 0:
                            block[touched] = 0
                        local = n % BLOCK_NODES
                        entry = -1
                        node_fields = 1
                        if ti.static(bool(variant & VARIANT.contact)):
                            entry = contact[touched * BLOCK_NODES + local]
                            if entry >= 0 and entry < shape[SHAPE.ghosts]:
                                node_fields = 2
                        for field in range(node_fields):
                            place = planar(touched * BLOCK_NODES + local, COMPONENTS)
                            if field == 1:
                                place = planar(shape[SHAPE.ghost_begin] + entry, COMPONENTS)
                            gain = ti.Vector([node[place + c * BLOCK_NODES] for c in range(3)])
                            before = ti.Vector([0.0, 0.0, 0.0])
                            if not begins:
                                before = ti.Vector([node[place + (VELOCITY + c) * BLOCK_NODES] for c in range(3)])
                            v = node_velocity(
                                before, gain, node[place + MASS * BLOCK_NODES], local, 2 * entry + field, scene,
                                block[block_list + shape[SHAPE.all_blocks] + n // BLOCK_NODES], scene_value, setting,
                                shape, contact_normal, variant,
                            )  # fmt: skip
                            for c in ti.static(range(3)):
                                node[place + c * BLOCK_NODES] = 0.0
                                node[place + (VELOCITY + c) * BLOCK_NODES] = v[c]
                            if ends:
                                node[place + SETTLING * BLOCK_NODES] = node[place + MASS * BLOCK_NODES]
                                node[place + MASS * BLOCK_NODES] = 0.0
                        n += threads
                    if begins:
                        c = lane
                        while c < cells:
                            cell_count[cell_list[first + c]] = 0
                            c += threads
                    _wait(threads)
                    if ends:
                        _gather(
                            lane, scene, first, count, particles, tags, stride, state, tag, order, hidden, node,
                            scene_value,
                            counter, setting, shape, contact, contact_normal, variant, threads,
                        )  # fmt: skip
                        _wait(threads)
                else:
                    going = 0
            if lane == 0 and counter[scene, COUNT.status] == STATUS.running:
                live[own + LIVE.frames] += 1
            p = lane
            while p < count:
                target = frame * stride + first + tag[tags + TAG.origin * stride + p]
                for axis in ti.static(range(3)):
                    output[3 * target + axis] = state[particles + p + (FIELD.position + axis) * stride]
                p += threads
            _wait(threads)


@ti.kernel
def start_team(
    state: Scalars,
    tag: Integers,
    position: Scalars,
    velocity: Scalars,
    label: Integers,
    law_row: Integers,
    counter: ti.types.ndarray(dtype=ti.i64, ndim=2),
    law: Scalars,
    fields: ti.template(),
):
    """Particles at rest shape in the first copy, and the maxima that the first time step needs."""
    for p in range(label.shape[0]):
        stride = label.shape[0]
        scene = label[p] >> MATERIAL_BITS
        material = label[p] & MATERIAL_MASK
        speed_square = 0.0
        for field in range(fields):
            state[p + field * stride] = 0.0
        for axis in ti.static(range(3)):
            state[p + (FIELD.position + axis) * stride] = position[3 * p + axis]
            state[p + (FIELD.velocity + axis) * stride] = velocity[3 * p + axis]
            speed_square += velocity[3 * p + axis] ** 2
            if ti.static(fields == FIELD.solid):
                state[p + (FIELD.deformation + 4 * axis) * stride] = 1.0
        state[p + FIELD.volume * stride] = 0.0 if material == SAND else 1.0
        tag[p + TAG.material * stride] = material
        tag[p + TAG.law_row * stride] = law_row[p]
        raise_maximum(counter, scene, COUNT.stiffness_bits, initial_stiffness(material, law, law_row[p]))
        raise_maximum(counter, scene, COUNT.speed_square_bits, speed_square)
