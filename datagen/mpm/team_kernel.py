"""Frames of explicit MLS-MPM in one launch, a team of threads for each scene: the fast way on a GPU.

The method is that of datagen.mpm.mls_mpm, of whose parts it is made. What differs is who works: a scene of a few
thousand particles needs hundreds of steps a frame, each of a few microseconds' work, so a team runs a scene by itself,
step after step, without a launch or a look at other scenes in between. Scenes share nothing, so each takes its own
steps. A team is one thread block where there are many scenes, and several where there are few: these wait for each
other at a counter in global memory, so that all blocks of such a launch have to be at work at once.

Each block holds particles of its own. What each particle alone decides (strain, stress, contact with triangles) is done
by a thread for each; what passes between particles and nodes by four, one for each component of a node (x, y and z of
momentum or velocity, and mass): together they read and add up whole sectors of memory.

At each frame the particles are copied from one copy of the state to the other in the order of their cells, so that
neighbours in space are neighbours in memory. State is stored by field, `state[copy, field, particle]`.

With one thread a block it runs on a CPU too; the tests check it there against the other kernel.
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
    falls,
    find_hidden,
    ghost_place,
    initial_stiffness,
    mark,
    move,
    node_place,
    node_places,
    node_velocity,
    raise_maximum,
    respond,
    settle,
    settles,
    spline,
    weights,
)
from hgn.scene.material import MATERIAL_BITS, MATERIAL_MASK, SAND, WATER

LANES = 4  # threads that share a particle where it meets the nodes; each has one component of theirs
MASS = 3  # the component
WARP = 32
CPU_ITEMS = 512  # of a loop, that Taichi gives to a thread of a CPU at once: a block of one thread
MEETING = 64  # integers of a team: how many blocks have come, and half way on how often all were let go


@ti.func
def _wait(threads: ti.template()):
    """Until the whole block is here, and sees what each has written."""
    if ti.static(threads > 1):
        ti.simt.block.sync()


@ti.func
def _fence(threads: ti.template()):
    """What the block wrote is seen by whoever sees what this thread writes next, and the other way round."""
    if ti.static(threads > 1):
        ti.simt.grid.memfence()


@ti.func
def _await(meeting: ti.template(), entry: ti.i32, target: ti.i32, threads: ti.template()):
    while ti.atomic_max(meeting[entry], 0) < target:  # Taichi has no load that passes by the caches
        pass
    _fence(threads)


@ti.func
def _meet(
    team: ti.i32,
    lane: ti.i32,
    meetings: ti.template(),
    meeting: ti.template(),
    threads: ti.template(),
    several: ti.template(),
    blocks: ti.i32,
):
    """Until the whole team is here, and sees what each has written; `meetings` counts a block's own."""
    _wait(threads)
    if ti.static(several):
        if lane == 0:
            meetings += 1
            _fence(threads)
            ti.atomic_add(meeting[team * MEETING], 1)
            _await(meeting, team * MEETING, meetings * blocks, threads)
        _wait(threads)


@ti.func
def _choose(
    scene: ti.i32,
    scene_value: ti.template(),
    counter: ti.template(),
    setting: ti.template(),
    shape: ti.template(),
    live: ti.template(),
):
    choose_time_step(scene, scene_value, counter, setting, shape[SHAPE.maximum_substeps])
    if scene_value[scene, VALUE.begins] == 1.0:
        live[scene * LIVE.length + LIVE.blocks] = 0


@ti.func
def _meet_and_choose(
    team: ti.i32,
    lane: ti.i32,
    scene: ti.i32,
    meetings: ti.template(),
    choices: ti.template(),
    meeting: ti.template(),
    scene_value: ti.template(),
    counter: ti.template(),
    setting: ti.template(),
    shape: ti.template(),
    live: ti.template(),
    threads: ti.template(),
    several: ti.template(),
    blocks: ti.i32,
):
    """A meeting where the last block to come chooses the next step; `choices` counts them."""
    _wait(threads)
    if lane == 0:
        last = 1
        if ti.static(several):
            meetings += 1
            choices += 1
            _fence(threads)
            if ti.atomic_add(meeting[team * MEETING], 1) != meetings * blocks - 1:
                last = 0
        if last == 1:
            if ti.static(several):
                _fence(threads)
            _choose(scene, scene_value, counter, setting, shape, live)
            if ti.static(several):
                _fence(threads)
                ti.atomic_add(meeting[team * MEETING + MEETING // 2], 1)
        if ti.static(several):
            _await(meeting, team * MEETING + MEETING // 2, choices, threads)
    _wait(threads)


@ti.func
def _raise(
    lane: ti.i32,
    counter: ti.template(),
    scene: ti.i32,
    entry: ti.template(),
    value: ti.f32,
    threads: ti.template(),
):
    """raise_maximum for all threads of a block, one for a warp."""
    if ti.static(threads > 1):
        bits = ti.bit_cast(ti.max(value, 0.0), ti.i32)
        for step in ti.static((16, 8, 4, 2, 1)):
            bits = ti.max(bits, ti.simt.warp.shfl_down_i32(ti.u32(0xFFFFFFFF), bits, step))
        if lane % WARP == 0 and bits > 0:
            ti.atomic_max(counter[scene, entry], ti.cast(bits, ti.i64))  # without a look, which would be waited for
    else:
        raise_maximum(counter, scene, entry, value)


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
def _entry(place: ti.i32, component: ti.i32) -> ti.i32:
    return LANES * place + component


@ti.func
def _cell(x, scene: ti.i32, setting: ti.template(), shape: ti.template()):
    """Where the cell of a particle lies in the arrays of nodes: at its base node."""
    return node_place(base_node(x, setting[SETTING.inverse_cell_size]), scene, shape)


@ti.func
def _reorder(
    low: ti.i32,
    high: ti.i32,
    scene: ti.i32,
    first: ti.i32,
    copy: ti.i32,
    lane: ti.i32,
    stride: ti.i32,
    state: ti.template(),
    tag: ti.template(),
    rank: ti.template(),
    cell_count: ti.template(),
    setting: ti.template(),
    shape: ti.template(),
    fields: ti.template(),
    threads: ti.template(),
):
    """Copies a block's particles to the other copy, each to its place in the order of the cells."""
    p = low + lane
    while p < high:
        source = copy * fields * stride + first + p
        cell = _cell(_vector(state, source, stride, FIELD.position), scene, setting, shape)
        place = first + cell_count[cell] + rank[first + p]
        target = (1 - copy) * fields * stride + place
        for field in range(fields):
            state[target + field * stride] = state[source + field * stride]
        for i in ti.static(range(TAG.length)):
            tag[((1 - copy) * TAG.length + i) * stride + place] = tag[(copy * TAG.length + i) * stride + first + p]
        p += threads


@ti.func
def _gather(
    low: ti.i32,
    high: ti.i32,
    lane: ti.i32,
    scene: ti.i32,
    first: ti.i32,
    particles: ti.i32,
    stride: ti.i32,
    velocities: ti.i32,
    state: ti.template(),
    hidden: ti.template(),
    node: ti.template(),
    setting: ti.template(),
    shape: ti.template(),
    contact: ti.template(),
    ends: ti.i32,
    variant: ti.template(),
    threads: ti.template(),
):
    """Velocity and its gradient at each particle from the nodes around, at an interval's end their mass too, left in
    the state.
    """
    inverse_dx = setting[SETTING.inverse_cell_size]
    first_entry = velocities + LANES * scene * shape[SHAPE.scene_blocks] * BLOCK_NODES
    task = LANES * low + lane
    while task < LANES * high:
        p = task // LANES
        component = task % LANES
        place = particles + p
        if component < MASS or ends:
            scaled = _vector(state, place, stride, FIELD.position) * inverse_dx
            base = ti.floor(scaled - 0.5, ti.i32)
            fx = scaled - ti.cast(base, ti.f32)
            w0, w1, w2 = weights(fx)
            w = ti.static((w0, w1, w2))
            index_x, index_y, index_z = node_places(base, first_entry + component, shape, LANES)
            total = 0.0
            gradient = ti.Vector([0.0, 0.0, 0.0])
            for i in ti.static(range(3)):
                plane = 0.0
                plane_y = 0.0
                plane_z = 0.0
                for j in ti.static(range(3)):
                    line = 0.0
                    line_z = 0.0
                    for k in ti.static(range(3)):
                        share = w[k][2] * node[index_x[i] + index_y[j] + index_z[k]]
                        line += share
                        line_z += (k - fx[2]) * share
                    plane += w[j][1] * line
                    plane_y += w[j][1] * (j - fx[1]) * line
                    plane_z += w[j][1] * line_z
                total += w[i][0] * plane
                gradient += w[i][0] * ti.Vector([(i - fx[0]) * plane, plane_y, plane_z])
            if ti.static(bool(variant & VARIANT.sheets)):
                bits = hidden[first + p]
                if component == MASS:
                    bits = 0
                n = 0
                while bits != 0:
                    if bits & 1:
                        index = base + ti.Vector([n // 9, n // 3 % 3, n % 3])
                        offset = ti.cast(index, ti.f32) - scaled
                        seen = node[velocities + _entry(node_place(index, scene, shape), component)]
                        change = node[velocities + _entry(ghost_place(index, scene, contact, shape), component)] - seen
                        change *= spline(offset[0]) * spline(offset[1]) * spline(offset[2])
                        total += change
                        gradient += change * offset
                    bits >>= 1
                    n += 1
            if component == MASS:
                state[place + FIELD.mass * stride] = total
            else:
                state[place + (FIELD.velocity + component) * stride] = total
                for j in ti.static(range(3)):
                    state[place + (FIELD.affine + 3 * component + j) * stride] = 4.0 * inverse_dx * gradient[j]
        task += threads


@ti.func
def _strain(
    low: ti.i32,
    high: ti.i32,
    lane: ti.i32,
    scene: ti.i32,
    first: ti.i32,
    particles: ti.i32,
    tags: ti.i32,
    stride: ti.i32,
    step: ti.f32,
    begins: ti.f32,
    state: ti.template(),
    tag: ti.template(),
    hidden: ti.template(),
    block: ti.template(),
    live: ti.template(),
    counter: ti.template(),
    setting: ti.template(),
    law: ti.template(),
    shape: ti.template(),
    contact: ti.template(),
    contact_normal: ti.template(),
    variant: ti.template(),
    threads: ti.template(),
):
    """The materials' answer of each particle, left in place of C; in the first step of an interval also which nodes it
    touches.
    """
    solid = ti.static(has_solid(variant))
    largest = 0.0
    fastest = 0.0
    p = low + lane
    while p < high:
        place = particles + p
        stretch = ti.Matrix.zero(ti.f32, 3, 3)
        if begins == 1.0:
            x = _vector(state, place, stride, FIELD.position)
            if ti.static(bool(variant & VARIANT.sheets)):
                hidden[first + p] = find_hidden(x, scene, 0.0, contact, contact_normal, setting, shape, variant)
            mark(
                x, scene, setting[SETTING.inverse_cell_size], shape, block,
                shape[SHAPE.all_blocks] + scene * shape[SHAPE.scene_blocks], live, scene * LIVE.length + LIVE.blocks,
            )  # fmt: skip
        else:
            v = _vector(state, place, stride, FIELD.velocity)
            fastest = ti.max(fastest, v.dot(v))
            if ti.static(solid):
                stretch = _symmetric(state, place, stride, FIELD.stretch)
        F = ti.Matrix.identity(ti.f32, 3)
        if ti.static(solid):
            F = _matrix(state, place, stride, FIELD.deformation)
        row = 0
        if ti.static(bool(variant & VARIANT.several_laws)):
            row = tag[tags + TAG.law_row * stride + p]
        A, new_stretch, new_F, volume, stiffness = respond(
            _matrix(state, place, stride, FIELD.affine), stretch, F, state[place + FIELD.volume * stride],
            tag[tags + TAG.material * stride + p], row, step, begins, scene, counter, setting, law, variant,
        )  # fmt: skip
        _put_matrix(state, place, stride, FIELD.affine, A)
        if ti.static(solid):
            _put_matrix(state, place, stride, FIELD.deformation, new_F)
            _put_symmetric(state, place, stride, FIELD.stretch, new_stretch)
        state[place + FIELD.volume * stride] = volume
        largest = ti.max(largest, stiffness)
        p += threads
    _raise(lane, counter, scene, COUNT.stiffness_bits, largest, threads)
    _raise(lane, counter, scene, COUNT.speed_square_bits, fastest, threads)


@ti.func
def _scatter(
    low: ti.i32,
    high: ti.i32,
    lane: ti.i32,
    scene: ti.i32,
    first: ti.i32,
    particles: ti.i32,
    tags: ti.i32,
    stride: ti.i32,
    begins: ti.f32,
    state: ti.template(),
    tag: ti.template(),
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
    """Adds what each particle gives to its 27 nodes: momentum and mass, in later steps of an interval what forces
    change in momentum. A thread adds up what particles of one cell give that follow each other, of `run` in all.
    """
    dx = setting[SETTING.cell_size]
    inverse_dx = setting[SETTING.inverse_cell_size]
    first_entry = LANES * scene * shape[SHAPE.scene_blocks] * BLOCK_NODES
    task = lane
    tasks = (high - low + run - 1) // run * LANES
    while task < tasks:
        component = task % LANES
        p = low + task // LANES * run
        end = ti.min(p + run, high)
        if begins == 0.0 and component == MASS:
            p = end
        gain = ti.Vector([0.0 for _ in range(27)])
        base = ti.Vector([0, 0, 0])
        if p < end:
            base = base_node(_vector(state, particles + p, stride, FIELD.position), inverse_dx)
        while p < end:
            place = particles + p
            fx = _vector(state, place, stride, FIELD.position) * inverse_dx - ti.cast(base, ti.f32)
            w0, w1, w2 = weights(fx)
            w = ti.static((w0, w1, w2))
            A = ti.Vector([0.0, 0.0, 0.0])
            v = 1.0
            if component < MASS:
                A = dx * ti.Vector([state[place + (FIELD.affine + 3 * component + j) * stride] for j in range(3)])
                v = -A.dot(fx)
                if begins == 1.0:
                    v += state[place + (FIELD.velocity + component) * stride]
            scale = 1.0
            if ti.static(bool(variant & VARIANT.several_laws)):
                scale = law[tag[tags + TAG.law_row * stride + p] + CONSTANT.mass]
            bits = 0
            if ti.static(bool(variant & VARIANT.sheets)):
                bits = hidden[first + p]
            for i, j in ti.static(ti.ndrange(3, 3)):
                weight_xy = scale * w[i][0] * w[j][1]
                v_xy = v + A[0] * i + A[1] * j
                for k in ti.static(range(3)):
                    given = weight_xy * w[k][2] * (v_xy + A[2] * k)
                    if ti.static(bool(variant & VARIANT.sheets)):  # noqa: SIM102 (this one is the compiler's)
                        if (bits >> (9 * i + 3 * j + k)) & 1:
                            ghost = ghost_place(base + ti.Vector([i, j, k]), scene, contact, shape)
                            ti.atomic_add(node[_entry(ghost, component)], given)
                            given = 0.0
                    gain[9 * i + 3 * j + k] += given
            p += 1
            following = base
            if p < end:
                following = base_node(_vector(state, particles + p, stride, FIELD.position), inverse_dx)
            if p == end or (following != base).any():
                index_x, index_y, index_z = node_places(base, first_entry + component, shape, LANES)
                for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                    ti.atomic_add(node[index_x[i] + index_y[j] + index_z[k]], gain[9 * i + 3 * j + k])
                    gain[9 * i + 3 * j + k] = 0.0
                base = following
        task += threads


@ti.func
def _update_nodes(
    member: ti.i32,
    scene: ti.i32,
    velocities: ti.i32,
    begins: ti.f32,
    ends: ti.i32,
    block: ti.template(),
    live: ti.template(),
    node: ti.template(),
    fall,
    scene_value: ti.template(),
    shape: ti.template(),
    contact: ti.template(),
    contact_normal: ti.template(),
    variant: ti.template(),
    members: ti.i32,
):
    """New velocities of the nodes of all blocks that particles touch."""
    block_list = shape[SHAPE.all_blocks] + scene * shape[SHAPE.scene_blocks]
    count = live[scene * LIVE.length + LIVE.blocks] * BLOCK_NODES
    n = member
    while n < count:
        touched = block[block_list + n // BLOCK_NODES]
        local = n % BLOCK_NODES
        if local == 0:
            block[touched] = 0
        entry = -1
        node_fields = 1
        if ti.static(bool(variant & VARIANT.contact)):
            entry = contact[touched * BLOCK_NODES + local]
            if entry >= 0 and entry < shape[SHAPE.ghosts]:
                node_fields = 2
        for field in range(node_fields):
            place = _entry(touched * BLOCK_NODES + local, 0)
            if field == 1:
                place = _entry(shape[SHAPE.ghost_begin] + entry, 0)
            gain = ti.Vector([node[place + c] for c in range(3)])
            mass = node[place + MASS]
            before = ti.Vector([0.0, 0.0, 0.0])
            if begins == 0.0:
                before = ti.Vector([node[velocities + place + c] for c in range(3)])
            v = node_velocity(
                before, gain, mass, local, 2 * entry + field,
                block[block_list + shape[SHAPE.all_blocks] + n // BLOCK_NODES], fall, scene, scene_value, shape,
                contact_normal, variant,
            )  # fmt: skip
            for c in ti.static(range(3)):
                node[place + c] = 0.0
                node[velocities + place + c] = v[c]
            if ends:
                node[velocities + place + MASS] = mass
                node[place + MASS] = 0.0
        n += members


@ti.func
def _move(
    low: ti.i32,
    high: ti.i32,
    lane: ti.i32,
    scene: ti.i32,
    particles: ti.i32,
    tags: ti.i32,
    stride: ti.i32,
    state: ti.template(),
    tag: ti.template(),
    scene_value: ti.template(),
    counter: ti.template(),
    setting: ti.template(),
    shape: ti.template(),
    contact: ti.template(),
    contact_normal: ti.template(),
    variant: ti.template(),
    threads: ti.template(),
):
    """New positions; velocities as obstacles leave them."""
    largest = 0.0
    p = low + lane
    while p < high:
        place = particles + p
        x = _vector(state, place, stride, FIELD.position)
        moved, speed, speed_square = move(
            x, _vector(state, place, stride, FIELD.velocity), _matrix(state, place, stride, FIELD.affine), scene,
            scene_value, counter, setting, shape, contact, contact_normal, variant,
        )  # fmt: skip
        if ti.static(bool(variant & VARIANT.water)):  # noqa: SIM102 (this one is the compiler's)
            if tag[tags + TAG.material * stride + p] == WATER and settles(scene, scene_value, setting):
                volume = place + FIELD.volume * stride
                state[volume] = settle(
                    x, state[volume], state[place + FIELD.mass * stride], scene, scene_value, setting, shape
                )
        _put_vector(state, place, stride, FIELD.position, moved)
        _put_vector(state, place, stride, FIELD.velocity, speed)
        largest = ti.max(largest, speed_square)
        p += threads
    _raise(lane, counter, scene, COUNT.speed_square_bits, largest, threads)


@ti.kernel
def advance(
    frames: ti.i32,
    blocks: ti.i32,
    frame_s: ti.f32,
    state: Scalars,
    tag: Integers,
    rank: Integers,
    hidden: Integers,
    cell_count: Integers,
    cell_list: Integers,
    block: Integers,
    live: Integers,
    cells: Integers,
    meeting: Integers,
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
    several: ti.template(),
    run: ti.template(),
):
    """Advances every scene by `frames` frames, and writes each frame's positions to output[frame, particle, axis].

    Each scene has `blocks` blocks of `threads` threads; with `several` of them all blocks of the launch have to run at
    once. Arrays, with P particles and G nodes of all scenes: state [2 * fields * P], tag [2 * 3 * P]; rank, hidden (see
    grid_kernel.substep) and cell_list [P] are work space; node [2, G, 4] holds what comes to momentum in a step and to
    mass in an interval, zero between them, and then velocities, with the mass for an interval's end; cell_count [G],
    the flags in block [3 * G / 64], cells [2 * blocks * scenes] and meeting [MEETING * scenes] are zero at first;
    turn [scenes] says which scene
    comes when (long ones first). A scene that failed keeps still.
    """
    ti.loop_config(block_dim=threads)
    for item in range(turn.shape[0] * (blocks * ti.static(threads if threads > 1 else CPU_ITEMS))):
        fields = ti.static(FIELD.solid if has_solid(variant) else FIELD.fluid)
        items = ti.static(threads if threads > 1 else CPU_ITEMS)
        members = blocks * threads
        # a CPU's threads take a stretch of items each: blocks that wait for each other are not of the same
        team = item // items % turn.shape[0]
        part = item // items // turn.shape[0]
        lane = item % items
        member = part * threads + lane
        scene = turn[team]
        first = shape[SHAPE.part_begin + scene]
        count = shape[SHAPE.part_begin + scene + 1] - first
        share = (count + blocks - 1) // blocks
        low = ti.min(part * share, count)
        high = ti.min(low + share, count)
        stride = rank.shape[0]
        velocities = node.shape[0] // 2
        own = scene * LIVE.length
        copy = live[own + LIVE.copy]
        meetings = 0
        choices = 0
        segment = 2 * (team * blocks + part)
        frame = 0 if lane < threads else frames
        while frame < frames:
            going = counter[scene, COUNT.status] == STATUS.running
            if going:
                p = low + lane
                while p < high:
                    x = _vector(state, copy * fields * stride + first + p, stride, FIELD.position)
                    cell = _cell(x, scene, setting, shape)
                    rank_here = ti.atomic_add(cell_count[cell], 1)
                    rank[first + p] = rank_here
                    if rank_here == 0:
                        cell_list[first + low + ti.atomic_add(cells[segment], 1)] = cell
                    p += threads
                if member == 0:
                    live[own + LIVE.cursor] = 0
                    counter[scene, COUNT.frame_substeps] = ti.cast(0, ti.i64)
                    scene_value[scene, VALUE.remaining] = frame_s
                _meet(team, lane, meetings, meeting, threads, several, blocks)
                # the cells that a block came upon first stay together
                c = lane
                while c < cells[segment]:
                    ti.atomic_add(cells[segment + 1], cell_count[cell_list[first + low + c]])
                    c += threads
                _wait(threads)
                if lane == 0:
                    cells[segment + 1] = ti.atomic_add(live[own + LIVE.cursor], cells[segment + 1])
                _wait(threads)
                c = lane
                while c < cells[segment]:
                    cell = cell_list[first + low + c]
                    cell_count[cell] = ti.atomic_add(cells[segment + 1], cell_count[cell])
                    c += threads
                _meet(team, lane, meetings, meeting, threads, several, blocks)
                _reorder(
                    low, high, scene, first, copy, lane, stride, state, tag, rank, cell_count, setting, shape, fields,
                    threads,
                )  # fmt: skip
                copy = 1 - copy
                _meet_and_choose(
                        team, lane, scene, meetings, choices, meeting, scene_value, counter, setting, shape, live,
                        threads, several, blocks,
                    )  # fmt: skip
                c = lane
                while c < cells[segment]:
                    cell_count[cell_list[first + low + c]] = 0
                    c += threads
                _wait(threads)
                if lane == 0:
                    cells[segment] = 0
                    cells[segment + 1] = 0
            particles = copy * fields * stride + first
            tags = copy * TAG.length * stride + first
            while going:
                step = scene_value[scene, VALUE.time_step]
                begins = scene_value[scene, VALUE.begins]
                ends = scene_value[scene, VALUE.interval_remaining] == 0.0
                fall = falls(scene, scene_value)
                going = step > 0.0
                if going:
                    if begins == 0.0:
                        _gather(
                            low, high, lane, scene, first, particles, stride, velocities, state, hidden, node, setting,
                            shape, contact, False, variant, threads,
                        )  # fmt: skip
                        _wait(threads)
                    _strain(
                        low, high, lane, scene, first, particles, tags, stride, step, begins, state, tag, hidden, block,
                        live, counter, setting, law, shape, contact, contact_normal, variant, threads,
                    )  # fmt: skip
                    _wait(threads)
                    _scatter(
                        low, high, lane, scene, first, particles, tags, stride, begins, state, tag, hidden, node,
                        setting, law, shape, contact, variant, threads, run,
                    )  # fmt: skip
                    _meet(team, lane, meetings, meeting, threads, several, blocks)
                    # a thread that hardly has nodes of its own, while the others are at theirs
                    if not ends and member == members - 1:
                        _choose(scene, scene_value, counter, setting, shape, live)
                    _update_nodes(
                        member, scene, velocities, begins, ends, block, live, node, fall, scene_value, shape,
                        contact, contact_normal, variant, members,
                    )  # fmt: skip
                    _meet(team, lane, meetings, meeting, threads, several, blocks)
                    if ends:
                        _gather(
                            low, high, lane, scene, first, particles, stride, velocities, state, hidden, node, setting,
                            shape, contact, True, variant, threads,
                        )  # fmt: skip
                        _wait(threads)
                        _move(
                            low, high, lane, scene, particles, tags, stride, state, tag, scene_value, counter, setting,
                            shape, contact, contact_normal, variant, threads,
                        )  # fmt: skip
                        _meet_and_choose(
                            team, lane, scene, meetings, choices, meeting, scene_value, counter, setting, shape, live,
                            threads, several, blocks,
                        )  # fmt: skip
            p = low + lane
            while p < high:
                target = frame * stride + first + tag[tags + TAG.origin * stride + p]
                for axis in ti.static(range(3)):
                    output[3 * target + axis] = state[particles + p + (FIELD.position + axis) * stride]
                p += threads
            if member == 0:
                live[own + LIVE.copy] = copy
                if counter[scene, COUNT.status] == STATUS.running:
                    live[own + LIVE.frames] += 1
            frame += 1


@ti.kernel
def start_team(
    state: Scalars,
    tag: Integers,
    position: Scalars,
    velocity: Scalars,
    label: Integers,
    law_row: Integers,
    order: Integers,
    counter: ti.types.ndarray(dtype=ti.i64, ndim=2),
    law: Scalars,
    fields: ti.template(),
):
    """Particles at rest shape in the first copy, order[p] as p, and the maxima that the first time step needs."""
    for p in range(label.shape[0]):
        stride = label.shape[0]
        source = order[p]
        scene = label[source] >> MATERIAL_BITS
        material = label[source] & MATERIAL_MASK
        speed_square = 0.0
        for field in range(fields):
            state[p + field * stride] = 0.0
        for axis in ti.static(range(3)):
            state[p + (FIELD.position + axis) * stride] = position[3 * source + axis]
            state[p + (FIELD.velocity + axis) * stride] = velocity[3 * source + axis]
            speed_square += velocity[3 * source + axis] ** 2
            if ti.static(fields == FIELD.solid):
                state[p + (FIELD.deformation + 4 * axis) * stride] = 1.0
        state[p + FIELD.volume * stride] = 0.0 if material == SAND else 1.0
        tag[p + TAG.material * stride] = material
        tag[p + TAG.law_row * stride] = law_row[source]
        raise_maximum(counter, scene, COUNT.stiffness_bits, initial_stiffness(material, law, law_row[source]))
        raise_maximum(counter, scene, COUNT.speed_square_bits, speed_square)
