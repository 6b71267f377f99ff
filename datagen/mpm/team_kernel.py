"""Frames of explicit MLS-MPM in one launch, a team of threads for each scene: the fast way on a GPU.

The method is that of datagen.mpm.mls_mpm, of whose parts it is made. What differs is who works: a scene of a few
thousand particles needs hundreds of steps a frame, each of a few microseconds' work, so a team runs a scene by itself,
step after step, without a launch or a look at other scenes in between. Scenes share nothing, so each takes its own
steps. A team is one thread block or several, which share a scene's particles and wait for each other
(datagen.mpm.team_meeting), so that all blocks of such a launch have to be at work at once; it takes one scene after
another.

What each particle alone decides (strain, stress, contact with triangles) is done by a thread for each. At each frame
the particles are copied from one copy of the state to the other in the order of their cells, so that neighbours in
space are neighbours in memory.

With one thread a block it runs on a CPU too; the tests check it there against the other kernel.
"""

import taichi as ti

from datagen.mpm.device_memory import load, store
from datagen.mpm.layout import COUNT, FIELD, LIVE, SETTING, SHAPE, STATUS, TAG, VALUE, VARIANT, has_solid
from datagen.mpm.mls_mpm import (
    Integers,
    Scalars,
    Vectors,
    find_hidden,
    initial_stiffness,
    mark,
    move,
    respond,
    settle,
    settles,
)
from datagen.mpm.multiple_time_stepping import own_step
from datagen.mpm.team_lists import gives_now, list_acting, mark_going_on, start_lists
from datagen.mpm.team_meeting import (
    ACTING,
    LEAVES,
    MEETING,
    SEGMENT,
    TURN,
    await_scene,
    choose,
    leave_scene,
    meet_and_choose,
    meet_team,
    raise_by_warps,
    take_turn,
    wait,
)
from datagen.mpm.team_particles import (
    dealt,
    get_matrix,
    get_symmetric,
    get_vector,
    put_matrix,
    put_symmetric,
    put_vector,
    sort,
)
from datagen.mpm.team_transfers import gather, scatter, update_nodes
from datagen.mpm.time_step import raise_maximum
from hgn.scene.material import MATERIAL_BITS, MATERIAL_MASK, SAND, WATER

CPU_ITEMS = 512  # of a loop, that Taichi gives to a thread of a CPU at once: a block of one thread
CHUNK = 32  # particles that follow each other, of one block of a team


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
    segment: ti.i32,
    velocities: ti.i32,
    step: ti.f32,
    begins: ti.f32,
    own_steps: ti.i32,
    some_wait: ti.i32,
    state: ti.template(),
    tag: ti.template(),
    column_list: ti.template(),
    giving: ti.template(),
    columns: ti.template(),
    strained: ti.template(),
    covered: ti.template(),
    spread: ti.template(),
    response: ti.template(),
    hidden: ti.template(),
    node: ti.template(),
    block: ti.template(),
    live: ti.template(),
    scene_value: ti.template(),
    counter: ti.template(),
    setting: ti.template(),
    law: ti.template(),
    shape: ti.template(),
    contact: ti.template(),
    contact_normal: ti.template(),
    variant: ti.template(),
    threads: ti.template(),
    run: ti.template(),
):
    """The materials' answer of each particle that acts to the gradient of the nodes' velocities, left in place of C; in
    the first step of an interval to C, and also which nodes it touches. Where particles take steps of their own, those
    act that list_acting found, else all.
    """
    solid = ti.static(has_solid(variant))
    intervals = ti.static(not variant & VARIANT.each_step)
    largest = 0.0
    held = 0.0
    fastest = 0.0
    acting_count = owned
    if ti.static(intervals and run > 1):  # noqa: SIM102 (this one is the compiler's)
        if own_steps:
            acting_count = columns[segment + ACTING]
    own = lane
    while own < acting_count:
        p = dealt(own, part, chunk, blocks)
        own += threads
        if ti.static(intervals):  # noqa: SIM102 (this one is the compiler's)
            if own_steps:
                if ti.static(run > 1):
                    p = column_list[first + p]
                elif not gives_now(
                    p, first, step, scene, particles, stride, some_wait, state, covered, spread, giving, block,
                    counter, scene_value, setting, shape,
                ):  # fmt: skip
                    continue
        place = particles + p
        x = get_vector(state, place, stride, FIELD.position)
        C = ti.Matrix.zero(ti.f32, 3, 3)
        stretch = ti.Matrix.zero(ti.f32, 3, 3)
        if begins == 1.0:
            C = get_matrix(state, place, stride, FIELD.affine)
            if ti.static(bool(variant & VARIANT.sheets)):
                hidden[first + p] = find_hidden(x, scene, 0.0, contact, contact_normal, setting, shape, variant)
            mark(
                x, scene, setting[SETTING.inverse_cell_size], shape, block,
                shape[SHAPE.all_blocks] + scene * shape[SHAPE.scene_blocks], live, scene * LIVE.length + LIVE.blocks,
            )  # fmt: skip
        else:
            bits = 0
            if ti.static(bool(variant & VARIANT.sheets)):
                bits = hidden[first + p]
            v, found_C, _ = gather(x, bits, scene, velocities, node, setting, shape, contact, variant)
            C = found_C
            fastest = ti.max(fastest, v.dot(v))
            if ti.static(solid):
                stretch = get_symmetric(state, place, stride, FIELD.stretch)
        F = ti.Matrix.identity(ti.f32, 3)
        if ti.static(solid):
            F = get_matrix(state, place, stride, FIELD.deformation)
        row = 0
        if ti.static(bool(variant & VARIANT.several_laws)):
            row = tag[tags + TAG.law_row * stride + p]
        material = tag[tags + TAG.material * stride + p]
        old_volume = load(state, place + FIELD.volume * stride)
        length, acting, many, spreads = step, step, 1.0, 0
        if ti.static(intervals):
            length, until, acts_until, many, spreads, acting = own_step(
                strained[first + p], covered[first + p], spread[first + p], x, C, old_volume, material, row, begins,
                step, scene, counter, shape, block, 3 * shape[SHAPE.all_blocks], scene_value, setting, law, variant,
            )  # fmt: skip
            strained[first + p] = until
            covered[first + p] = acts_until
            spread[first + p] = spreads
        answer, new_stretch, new_F, volume, stiffness = respond(
            C, stretch, F, old_volume, material, row, length, scene, counter, setting, law, variant
        )
        if ti.static(intervals) and spreads:
            for i, j, k in ti.static(((0, 0, 0), (1, 1, 1), (2, 2, 2), (3, 0, 1), (4, 0, 2), (5, 1, 2))):
                response[first + p + i * stride] = answer[j, k]
        put_matrix(state, place, stride, FIELD.affine, begins * C + acting * answer)
        if ti.static(solid):
            put_matrix(state, place, stride, FIELD.deformation, new_F)
            if ti.static(intervals):
                put_symmetric(state, place, stride, FIELD.stretch, new_stretch)
        store(state, place + FIELD.volume * stride, volume)
        largest = ti.max(largest, stiffness)
        if many > 1.0:
            held = ti.max(held, stiffness)
    raise_by_warps(lane, counter, scene, COUNT.stiffness_bits, largest, threads)
    raise_by_warps(lane, counter, scene, COUNT.held_stiffness_bits, held, threads)
    raise_by_warps(lane, counter, scene, COUNT.speed_square_bits, fastest, threads)


@ti.func
def _move(
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
    velocities: ti.i32,
    state: ti.template(),
    tag: ti.template(),
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
    """New velocities and their gradients, as obstacles leave them, and new positions."""
    largest = 0.0
    own = lane
    while own < owned:
        p = dealt(own, part, chunk, blocks)
        place = particles + p
        x = get_vector(state, place, stride, FIELD.position)
        bits = 0
        if ti.static(bool(variant & VARIANT.sheets)):
            bits = hidden[first + p]
        v, C, mass = gather(x, bits, scene, velocities, node, setting, shape, contact, variant)
        moved, speed, speed_square = move(
            x, v, C, scene, scene_value, counter, setting, shape, contact, contact_normal, variant
        )
        if ti.static(bool(variant & VARIANT.water)):  # noqa: SIM102 (this one is the compiler's)
            if tag[tags + TAG.material * stride + p] == WATER and settles(scene, scene_value, setting):
                volume = place + FIELD.volume * stride
                store(state, volume, settle(x, load(state, volume), mass, scene, scene_value, setting, shape))
        put_vector(state, place, stride, FIELD.position, moved)
        put_vector(state, place, stride, FIELD.velocity, speed)
        put_matrix(state, place, stride, FIELD.affine, C)
        largest = ti.max(largest, speed_square)
        own += threads
    raise_by_warps(lane, counter, scene, COUNT.speed_square_bits, largest, threads)


@ti.kernel
def advance(
    frames: ti.i32,
    stretch: ti.i32,
    teams: ti.i32,
    blocks: ti.i32,
    patience: ti.i32,
    frame_s: ti.f32,
    state_address: ti.u64,
    node_address: ti.u64,
    node_entries: ti.i32,
    tag: Integers,
    rank: Integers,
    strained: Scalars,
    covered: Scalars,
    spread: Integers,
    response: Scalars,
    hidden: Integers,
    cell_count: Integers,
    column_count: Integers,
    column_list: Integers,
    block: Integers,
    live: Integers,
    columns: Integers,
    meeting: Integers,
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

    Each of `teams` has `blocks` blocks of `threads` threads, and takes one scene after another, `stretch` frames of
    each until it is its turn again; with `several` blocks all of the launch have to run at once. Particles are sorted
    at the begin of each frame. With P particles and G nodes of all scenes there are at addresses (see device_memory)
    state [2 * fields * P], and node [2, G, 4], which holds what comes to momentum in a step and to mass in an interval,
    zero between them, and then velocities, with the mass for an interval's end. Arrays: tag [2 * 3 * P]; rank, spread,
    response [6 * P], hidden (see grid_kernel.substep) and column_list [P] are work space; cell_count [G], column_count
    [G / 4], the flags in block [8 * G / 64], columns [6 * blocks * teams] and meeting [MEETING * (teams + 1) + scenes]
    are zero at first; turn [scenes] says which scene comes when (long ones first). A scene that failed keeps still.
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
        velocities = node_entries // 2
        state = state_address
        node = node_address
        meetings = 0
        choices = 0
        at = (team + 1) * MEETING
        segment = SEGMENT * (team * blocks + part)
        scenes = turn.shape[0]
        turns = 0
        place_in_turn = 0
        if lane < threads:
            if member == 0:
                take_turn(at, meeting)
            # whether all blocks are at work at once shows before anything is simulated
            meet_team(at, lane, meetings, meeting, columns, segment, patience, threads, several, blocks)
            if frames > 0 and columns[segment + LEAVES] == 0:
                turns = scenes * ((frames + stretch - 1) // stretch)
                place_in_turn = meeting[at + TURN]
        while place_in_turn < turns:
            scene = turn[place_in_turn % scenes]
            first = shape[SHAPE.part_begin + scene]
            count = shape[SHAPE.part_begin + scene + 1] - first
            chunk = (count + blocks - 1) // blocks
            if chunk > 4 * CHUNK:
                chunk = CHUNK
            round_of_all = chunk * blocks
            owned = count // round_of_all * chunk + ti.min(ti.max(count % round_of_all - part * chunk, 0), chunk)
            live_at = scene * LIVE.length
            copy = live[live_at + LIVE.copy]
            frame = place_in_turn // scenes * stretch
            end = ti.min(frame + stretch, frames)
            while frame < end:
                going = counter[scene, COUNT.status] == STATUS.running
                sorted_already = False
                if going:
                    if member == 0:
                        counter[scene, COUNT.frame_substeps] = ti.cast(0, ti.i64)
                        scene_value[scene, VALUE.remaining] = frame_s
                    meet_and_choose(
                        at, lane, scene, meetings, choices, meeting, columns, segment, patience, scene_value, counter,
                        setting, shape, live, threads, several, blocks,
                    )  # fmt: skip
                particles = copy * fields * stride + first
                tags = copy * TAG.length * stride + first
                while going:
                    step = scene_value[scene, VALUE.time_step]
                    begins, left, own_steps, some_wait = 1.0, 0.0, False, False
                    if ti.static(not variant & VARIANT.each_step):
                        begins = scene_value[scene, VALUE.begins]
                        left = scene_value[scene, VALUE.interval_remaining]
                        synchronised = scene_value[scene, VALUE.synchronised] == 1.0
                        own_steps = begins == 0.0 and synchronised
                        some_wait = left > 0.0 and synchronised
                    ends = left == 0.0
                    whole = scene_value[scene, VALUE.whole_step]
                    gravity_time = scene_value[scene, VALUE.gravity_time]
                    fallen = scene_value[scene, VALUE.fallen]
                    now = ti.cast(counter[scene, COUNT.substeps], ti.i32)
                    going = step > 0.0 and columns[segment + LEAVES] == 0
                    if going:
                        if begins == 1.0 and not sorted_already:
                            sort(
                                owned, part, chunk, blocks, scene, first, copy, segment, at, lane, meetings, stride,
                                state, tag, rank, cell_count, column_count, column_list, columns, live, meeting,
                                patience, setting, shape, fields, threads, several,
                            )  # fmt: skip
                            copy = 1 - copy
                            particles = copy * fields * stride + first
                            tags = copy * TAG.length * stride + first
                            sorted_already = True
                        listed = ti.static(not variant & VARIANT.each_step and run > 1)
                        if ti.static(listed):  # noqa: SIM102 (this one is the compiler's)
                            if own_steps:
                                list_acting(
                                    owned, part, chunk, blocks, lane, scene, first, segment, step, covered,
                                    spread, column_list, rank, columns, scene_value, threads,
                                )  # fmt: skip
                                wait(threads)
                                if some_wait:
                                    mark_going_on(
                                        owned, part, chunk, blocks, lane, scene, first, segment, particles, stride,
                                        state, column_list, columns, block, counter, setting, shape, threads,
                                    )  # fmt: skip
                        _strain(
                            owned, part, chunk, blocks, lane, scene, first, particles, tags, stride, segment,
                            velocities, step, begins, own_steps, some_wait, state, tag, column_list, rank, columns,
                            strained, covered, spread, response, hidden, node, block, live, scene_value, counter,
                            setting, law, shape, contact, contact_normal, variant, threads, run,
                        )  # fmt: skip
                        wait(threads)
                        scatter(
                            owned, part, chunk, blocks, lane, scene, first, particles, tags, stride, segment, begins,
                            own_steps, step, state, tag, rank, columns, response, hidden, node, setting, law, shape,
                            contact, variant, threads, run,
                        )  # fmt: skip
                        meet_team(at, lane, meetings, meeting, columns, segment, patience, threads, several, blocks)
                        if ti.static(listed):
                            start_lists(lane, segment, columns)
                        # a thread that hardly has nodes of its own, while the others are at theirs
                        if not ends and member == members - 1:
                            choose(scene, scene_value, counter, setting, shape, live)
                        update_nodes(
                            member, scene, velocities, begins, ends, some_wait, now, whole, left, gravity_time, fallen,
                            block, live, node, scene_value, shape, contact, contact_normal, variant, members,
                        )  # fmt: skip
                        meet_team(at, lane, meetings, meeting, columns, segment, patience, threads, several, blocks)
                        if ends:
                            _move(
                                owned, part, chunk, blocks, lane, scene, first, particles, tags, stride, velocities,
                                state, tag, hidden, node, scene_value, counter, setting, shape, contact,
                                contact_normal, variant, threads,
                            )  # fmt: skip
                            meet_and_choose(
                                at, lane, scene, meetings, choices, meeting, columns, segment, patience, scene_value,
                                counter, setting, shape, live, threads, several, blocks,
                            )  # fmt: skip
                own = lane
                while own < owned:
                    p = dealt(own, part, chunk, blocks)
                    target = frame * stride + first + tag[tags + TAG.origin * stride + p]
                    for axis in ti.static(range(3)):
                        output[3 * target + axis] = load(state, particles + p + (FIELD.position + axis) * stride)
                    own += threads
                if member == 0 and counter[scene, COUNT.status] == STATUS.running:
                    live[live_at + LIVE.frames] += 1
                frame += 1
                if columns[segment + LEAVES] != 0:
                    frame = end
                    turns = 0
            if member == 0:
                live[live_at + LIVE.copy] = copy
                take_turn(at, meeting)
            leave_scene((teams + 1) * MEETING + scene, lane, meeting, threads)
            meet_team(at, lane, meetings, meeting, columns, segment, patience, threads, several, blocks)
            place_in_turn = meeting[at + TURN]
            if place_in_turn >= scenes and place_in_turn < turns:
                await_scene(
                    (teams + 1) * MEETING + turn[place_in_turn % scenes], place_in_turn // scenes * blocks, lane,
                    meeting, columns, segment, threads,
                )  # fmt: skip
            meet_team(at, lane, meetings, meeting, columns, segment, patience, threads, several, blocks)


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
