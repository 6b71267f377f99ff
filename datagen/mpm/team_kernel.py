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
    BLOCK,
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
MEETING = 96  # integers of a team, in thirds: how many blocks have come, how often all were let go, its next scene
COPIED = 16  # fields at once
CHUNK = 32  # particles that follow each other, of one block of a team


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
                ti.atomic_add(meeting[team * MEETING + MEETING // 3], 1)
        if ti.static(several):
            _await(meeting, team * MEETING + MEETING // 3, choices, threads)
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
def _dealt(own: ti.i32, part: ti.i32, chunk: ti.i32, blocks: ti.i32) -> ti.i32:
    """Which of a scene's particles a block's own one is: they are dealt out in chunks, so that no block has all of
    what takes long.
    """
    return (own // chunk * blocks + part) * chunk + own % chunk


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
def _cell(x, scene: ti.i32, setting: ti.template(), shape: ti.template()) -> ti.i32:
    """The number of a particle's cell in the order: BLOCK of them above each other are a column. Material falls, so
    what follows in a column stays beside each other for longest.
    """
    base = base_node(x, setting[SETTING.inverse_cell_size])
    place = node_place(base, scene, shape)
    column = (place // BLOCK_NODES * BLOCK + (base[0] & 3)) * BLOCK + (base[2] & 3)
    return column * BLOCK + (base[1] & 3)


@ti.func
def _sort(
    owned: ti.i32,
    part: ti.i32,
    chunk: ti.i32,
    blocks: ti.i32,
    scene: ti.i32,
    first: ti.i32,
    copy: ti.i32,
    segment: ti.i32,
    team: ti.i32,
    lane: ti.i32,
    meetings: ti.template(),
    stride: ti.i32,
    state: ti.template(),
    tag: ti.template(),
    rank: ti.template(),
    cell_count: ti.template(),
    column_count: ti.template(),
    column_list: ti.template(),
    columns: ti.template(),
    live: ti.template(),
    meeting: ti.template(),
    setting: ti.template(),
    shape: ti.template(),
    fields: ti.template(),
    threads: ti.template(),
    several: ti.template(),
):
    """Copies all particles to the other copy, in the order of their columns; a meeting at its end."""
    own = lane
    while own < owned:
        p = _dealt(own, part, chunk, blocks)
        at = _cell(_vector(state, copy * fields * stride + first + p, stride, FIELD.position), scene, setting, shape)
        rank[first + p] = ti.atomic_add(cell_count[at], 1)
        if ti.atomic_add(column_count[at // BLOCK], 1) == 0:
            listed = ti.atomic_add(columns[segment], 1)
            column_list[first + _dealt(listed, part, chunk, blocks)] = at // BLOCK
        own += threads
    _meet(team, lane, meetings, meeting, threads, several, blocks)
    # the columns that a block came upon first stay together
    c = lane
    while c < columns[segment]:
        ti.atomic_add(columns[segment + 1], column_count[column_list[first + _dealt(c, part, chunk, blocks)]])
        c += threads
    _wait(threads)
    if lane == 0:
        columns[segment + 1] = ti.atomic_add(live[scene * LIVE.length + LIVE.cursor], columns[segment + 1])
    _wait(threads)
    c = lane
    while c < columns[segment]:
        column = column_list[first + _dealt(c, part, chunk, blocks)]
        begin = ti.atomic_add(columns[segment + 1], column_count[column])
        for n in range(BLOCK):
            count = cell_count[column * BLOCK + n]
            cell_count[column * BLOCK + n] = begin
            begin += count
        c += threads
    _meet(team, lane, meetings, meeting, threads, several, blocks)
    own = lane
    while own < owned:
        p = _dealt(own, part, chunk, blocks)
        source = copy * fields * stride + first + p
        at = _cell(_vector(state, source, stride, FIELD.position), scene, setting, shape)
        place = first + cell_count[at] + rank[first + p]
        target = (1 - copy) * fields * stride + place
        for group in ti.static(range(0, fields, COPIED)):
            values = ti.Vector([state[source + field * stride] for field in range(group, min(group + COPIED, fields))])
            for i in ti.static(range(values.n)):
                state[target + (group + i) * stride] = values[i]
        for i in ti.static(range(TAG.length)):
            tag[((1 - copy) * TAG.length + i) * stride + place] = tag[(copy * TAG.length + i) * stride + first + p]
        own += threads
    _meet(team, lane, meetings, meeting, threads, several, blocks)
    c = lane
    while c < columns[segment]:
        column = column_list[first + _dealt(c, part, chunk, blocks)]
        column_count[column] = 0
        for n in range(BLOCK):
            cell_count[column * BLOCK + n] = 0
        c += threads
    _wait(threads)
    if lane == 0:
        columns[segment] = 0
        columns[segment + 1] = 0
        live[scene * LIVE.length + LIVE.cursor] = 0


@ti.func
def _gather(
    owned: ti.i32,
    part: ti.i32,
    chunk: ti.i32,
    blocks: ti.i32,
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
    task = lane
    while task < LANES * owned:
        p = _dealt(task // LANES, part, chunk, blocks)
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
    own = lane
    while own < owned:
        p = _dealt(own, part, chunk, blocks)
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
        own += threads
    _raise(lane, counter, scene, COUNT.stiffness_bits, largest, threads)
    _raise(lane, counter, scene, COUNT.speed_square_bits, fastest, threads)


@ti.func
def _scatter(
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
    change in momentum. A thread adds up what `run` particles in their order give, in a window of nodes that goes up a
    column with them; what it leaves goes to the nodes.
    """
    dx = setting[SETTING.cell_size]
    inverse_dx = setting[SETTING.inverse_cell_size]
    first_entry = LANES * scene * shape[SHAPE.scene_blocks] * BLOCK_NODES
    task = lane
    tasks = (owned + run - 1) // run * LANES
    while task < tasks:
        component = task % LANES
        own = task // LANES * run
        p = _dealt(own, part, chunk, blocks)
        end = p + ti.min(run, owned - own)
        if begins == 0.0 and component == MASS:
            p = end
        gain = ti.Vector([0.0 for _ in range(27)])
        base = ti.Vector([0, 0, 0])
        x = ti.Vector([0.0, 0.0, 0.0])
        if p < end:
            x = _vector(state, particles + p, stride, FIELD.position)
            base = base_node(x, inverse_dx)
        while p < end:
            place = particles + p
            fx = x * inverse_dx - ti.cast(base, ti.f32)
            w0, w1, w2 = weights(fx)
            w = ti.static((w0, w1, w2))
            A = ti.Vector([0.0, 0.0, 0.0])
            v = 1.0
            if component < MASS:
                A = dx * ti.Vector([state[place + (FIELD.affine + 3 * component + j) * stride] for j in range(3)])
                v = -A.dot(fx)
                if begins == 1.0:
                    v += state[place + (FIELD.velocity + component) * stride]
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
                        ti.atomic_add(node[_entry(ghost, component)], weight * (v + A.dot(away)))
                    bits >>= 1
                    n += 1
            p += 1
            following = base
            if p < end:
                x = _vector(state, particles + p, stride, FIELD.position)
                following = base_node(x, inverse_dx)
            if p == end or (following != base).any():
                climbs = p < end and (following == base + ti.Vector([0, 1, 0])).all()
                index_x, index_y, index_z = node_places(base, first_entry + component, shape, LANES)
                for i, k in ti.static(ti.ndrange(3, 3)):
                    ti.atomic_add(node[index_x[i] + index_y[0] + index_z[k]], gain[9 * i + k])
                    gain[9 * i + k] = gain[9 * i + 3 + k]
                    gain[9 * i + 3 + k] = gain[9 * i + 6 + k]
                    gain[9 * i + 6 + k] = 0.0
                if not climbs:
                    for i, j, k in ti.static(ti.ndrange(3, 2, 3)):
                        ti.atomic_add(node[index_x[i] + index_y[j + 1] + index_z[k]], gain[9 * i + 3 * j + k])
                        gain[9 * i + 3 * j + k] = 0.0
                base = following
        task += threads


@ti.func
def _read_node(place: ti.i32, velocities: ti.i32, begins: ti.f32, node: ti.template()):
    """What came to its momentum, its mass, and its velocity before (none where an interval begins)."""
    before = ti.Vector([0.0, 0.0, 0.0])
    if begins == 0.0:
        before = ti.Vector([node[velocities + place + c] for c in range(3)])
    return ti.Vector([node[place + c] for c in range(3)]), node[place + MASS], before


@ti.func
def _write_node(place: ti.i32, velocities: ti.i32, v, mass: ti.f32, ends: ti.i32, node: ti.template()):
    for c in ti.static(range(3)):
        node[place + c] = 0.0
        node[velocities + place + c] = v[c]
    if ends:
        node[velocities + place + MASS] = mass
        node[place + MASS] = 0.0


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
        corner = block[block_list + shape[SHAPE.all_blocks] + n // BLOCK_NODES]
        local = n % BLOCK_NODES
        # all that is read, before anything is written: Taichi looks up where an array lies anew after each store
        place = _entry(touched * BLOCK_NODES + local, 0)
        entry = -1
        if ti.static(bool(variant & VARIANT.contact)):
            entry = contact[touched * BLOCK_NODES + local]
        gain, mass, before = _read_node(place, velocities, begins, node)
        if local == 0:
            block[touched] = 0
        if mass > 0.0 or begins == 1.0:
            v = node_velocity(
                before, gain, mass, local, 2 * entry, corner, fall, scene, scene_value, shape, contact_normal, variant
            )
            _write_node(place, velocities, v, mass, ends, node)
        if ti.static(bool(variant & VARIANT.sheets)):  # noqa: SIM102 (this one is the compiler's)
            if entry >= 0 and entry < shape[SHAPE.ghosts]:
                ghost = _entry(shape[SHAPE.ghost_begin] + entry, 0)
                gain_there, mass_there, before_there = _read_node(ghost, velocities, begins, node)
                v = node_velocity(
                    before_there, gain_there, mass_there, local, 2 * entry + 1, corner, fall, scene, scene_value,
                    shape, contact_normal, variant,
                )  # fmt: skip
                _write_node(ghost, velocities, v, mass_there, ends, node)
        n += members


@ti.func
def _move(
    owned: ti.i32,
    part: ti.i32,
    chunk: ti.i32,
    blocks: ti.i32,
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
    own = lane
    while own < owned:
        p = _dealt(own, part, chunk, blocks)
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
        own += threads
    _raise(lane, counter, scene, COUNT.speed_square_bits, largest, threads)


@ti.kernel
def advance(
    frames: ti.i32,
    teams: ti.i32,
    blocks: ti.i32,
    frame_s: ti.f32,
    state: Scalars,
    tag: Integers,
    rank: Integers,
    hidden: Integers,
    cell_count: Integers,
    column_count: Integers,
    column_list: Integers,
    block: Integers,
    live: Integers,
    columns: Integers,
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

    Each of `teams` has `blocks` blocks of `threads` threads, and takes one scene after another; with `several` blocks
    all of the launch have to run at once. Particles are sorted at the begin of each frame. Arrays, with P particles
    and G nodes of all scenes: state [2 * fields * P], tag [2 * 3 * P]; rank, hidden (see grid_kernel.substep) and
    column_list [P] are work space; node [2, G, 4] holds what comes to momentum in a step and to mass in an interval,
    zero between them, and then velocities, with the mass for an interval's end; cell_count [G], column_count [G / 4],
    the flags in block [3 * G / 64], columns [2 * blocks * teams] and meeting [MEETING * (teams + 1)] are zero at
    first; turn [scenes] says which scene comes when (long ones first). A scene that failed keeps still.
    """
    ti.loop_config(block_dim=threads)
    for item in range(teams * (blocks * ti.static(threads if threads > 1 else CPU_ITEMS))):
        fields = ti.static(FIELD.solid if has_solid(variant) else FIELD.fluid)
        items = ti.static(threads if threads > 1 else CPU_ITEMS)
        members = blocks * threads
        # a CPU's threads take a stretch of items each: blocks that wait for each other are not of the same
        team = item // items % teams
        part = item // items // teams
        lane = item % items
        member = part * threads + lane
        stride = rank.shape[0]
        velocities = node.shape[0] // 2
        meetings = 0
        choices = 0
        segment = 2 * (team * blocks + part)
        scenes = turn.shape[0] if lane < threads and frames > 0 else 0
        place_in_turn = team
        while place_in_turn < scenes:
            scene = turn[place_in_turn]
            first = shape[SHAPE.part_begin + scene]
            count = shape[SHAPE.part_begin + scene + 1] - first
            chunk = (count + blocks - 1) // blocks
            if chunk > 4 * CHUNK:
                chunk = CHUNK
            round_of_all = chunk * blocks
            owned = count // round_of_all * chunk + ti.min(ti.max(count % round_of_all - part * chunk, 0), chunk)
            live_at = scene * LIVE.length
            copy = live[live_at + LIVE.copy]
            frame = 0
            while frame < frames:
                going = counter[scene, COUNT.status] == STATUS.running
                sorted_already = False
                if going:
                    if member == 0:
                        counter[scene, COUNT.frame_substeps] = ti.cast(0, ti.i64)
                        scene_value[scene, VALUE.remaining] = frame_s
                    _meet_and_choose(
                        team, lane, scene, meetings, choices, meeting, scene_value, counter, setting, shape, live,
                        threads, several, blocks,
                    )  # fmt: skip
                particles = copy * fields * stride + first
                tags = copy * TAG.length * stride + first
                while going:
                    step = scene_value[scene, VALUE.time_step]
                    begins = scene_value[scene, VALUE.begins]
                    ends = scene_value[scene, VALUE.interval_remaining] == 0.0
                    fall = falls(scene, scene_value)
                    going = step > 0.0
                    if going:
                        if begins == 1.0:
                            if not sorted_already:
                                _sort(
                                    owned, part, chunk, blocks, scene, first, copy, segment, team, lane, meetings,
                                    stride, state, tag, rank, cell_count, column_count, column_list, columns, live,
                                    meeting, setting, shape, fields, threads, several,
                                )  # fmt: skip
                                copy = 1 - copy
                                particles = copy * fields * stride + first
                                tags = copy * TAG.length * stride + first
                                sorted_already = True
                        else:
                            _gather(
                                owned, part, chunk, blocks, lane, scene, first, particles, stride, velocities, state,
                                hidden, node, setting, shape, contact, False, variant, threads,
                            )  # fmt: skip
                            _wait(threads)
                        _strain(
                            owned, part, chunk, blocks, lane, scene, first, particles, tags, stride, step, begins,
                            state, tag, hidden, block, live, counter, setting, law, shape, contact, contact_normal,
                            variant, threads,
                        )  # fmt: skip
                        _wait(threads)
                        _scatter(
                            owned, part, chunk, blocks, lane, scene, first, particles, tags, stride, begins, state,
                            tag, hidden, node, setting, law, shape, contact, variant, threads, run,
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
                                owned, part, chunk, blocks, lane, scene, first, particles, stride, velocities, state,
                                hidden, node, setting, shape, contact, True, variant, threads,
                            )  # fmt: skip
                            _wait(threads)
                            _move(
                                owned, part, chunk, blocks, lane, scene, particles, tags, stride, state, tag,
                                scene_value, counter, setting, shape, contact, contact_normal, variant, threads,
                            )  # fmt: skip
                            _meet_and_choose(
                                team, lane, scene, meetings, choices, meeting, scene_value, counter, setting, shape,
                                live, threads, several, blocks,
                            )  # fmt: skip
                own = lane
                while own < owned:
                    p = _dealt(own, part, chunk, blocks)
                    target = frame * stride + first + tag[tags + TAG.origin * stride + p]
                    for axis in ti.static(range(3)):
                        output[3 * target + axis] = state[particles + p + (FIELD.position + axis) * stride]
                    own += threads
                if member == 0 and counter[scene, COUNT.status] == STATUS.running:
                    live[live_at + LIVE.frames] += 1
                frame += 1
            if member == 0:
                live[live_at + LIVE.copy] = copy
                meeting[team * MEETING + 2 * MEETING // 3] = teams + ti.atomic_add(meeting[teams * MEETING], 1)
            _meet(team, lane, meetings, meeting, threads, several, blocks)
            place_in_turn = meeting[team * MEETING + 2 * MEETING // 3]
            _meet(team, lane, meetings, meeting, threads, several, blocks)


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
