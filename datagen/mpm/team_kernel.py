"""Frames of explicit MLS-MPM in one launch, with a team of threads for each scene: the fastest way on a GPU.

The method and its parts are those of datagen.mpm.mls_mpm. A scene of a few thousand particles needs hundreds of short
substeps per frame. So a team computes all substeps of a scene in one launch, independently of other scenes. A team is
one or several thread blocks that share a scene's particles and wait for each other (datagen.mpm.team_sync). If it
has several, all blocks of a launch must run concurrently. A team computes one scene after another.

One thread for each particle computes strain, stress and contact with triangles. Each frame sorts the particles by
their cells into the other copy of the state. Neighbours in space are then neighbours in memory.

With one thread per block the kernel also runs on a CPU, where tests compare it with the other kernel.
"""

from collections import namedtuple

import taichi as ti

from datagen.mpm.device_memory import load, store
from datagen.mpm.layout import COUNT, FIELD, LIVE, SETTING, SHAPE, STATUS, TAG, VALUE, VARIANT, has_solid
from datagen.mpm.mls_mpm import (
    Integers,
    Scalars,
    Vectors,
    find_hidden,
    initial_stiffness,
    move,
    respond,
    settle,
    settles,
)
from datagen.mpm.multiple_time_stepping import own_step
from datagen.mpm.nodes import mark
from datagen.mpm.team_lists import gives_now, list_acting, mark_going_on, start_lists
from datagen.mpm.team_particles import (
    Share,
    Thread,
    dealt,
    get_matrix,
    get_symmetric,
    get_vector,
    put_matrix,
    put_symmetric,
    put_vector,
    sort,
)
from datagen.mpm.team_sync import (
    ACTING,
    LEAVES,
    SEGMENT,
    SYNC_LENGTH,
    TURN,
    await_scene,
    choose,
    leave_scene,
    raise_by_warps,
    sync_and_choose,
    sync_team,
    take_turn,
    wait,
)
from datagen.mpm.team_transfers import gather, scatter, update_nodes
from datagen.mpm.time_step import raise_maximum
from hgn.scene.material import MATERIAL_BITS, MATERIAL_MASK, SAND, WATER

CPU_ITEMS = 512  # consecutive loop items that Taichi gives to a CPU thread; they form a block of one thread
CHUNK = 32  # number of consecutive particles that belong to the same block of a team


# The arguments of `advance`, passed to its functions as one. Taichi resolves the names during compilation.
TeamArrays = namedtuple(
    "TeamArrays",
    [
        "state", "node", "tag", "rank", "strained", "covered", "spread", "response", "hidden", "cell_count",
        "column_count", "column_list", "block", "live", "columns", "sync", "turn", "scene_value",
        "counter", "setting", "law", "shape", "contact", "contact_normal", "pose", "output", "variant",
        "threads", "several", "run", "giving",
    ],
)  # fmt: skip


@ti.func
def _strain(
    share: ti.template(), thread: ti.template(), particles: ti.i32, tags: ti.i32, step: ti.f32, begins: ti.f32,
    own_steps: ti.i32, some_wait: ti.i32, arrays: ti.template(),
):  # fmt: skip
    """Computes the materials' response for the particles that act in this substep, and writes it over their C.

    In the first substep of an interval it uses C, and marks the blocks of the particles' nodes. In later substeps it
    uses the gradient of the nodes' velocities. With `own_steps` the particles that begin a step act, otherwise all.
    """
    solid = ti.static(has_solid(arrays.variant))
    intervals = ti.static(not arrays.variant & VARIANT.each_step)
    largest = 0.0
    held = 0.0
    fastest = 0.0
    acting_count = share.owned
    if ti.static(intervals and arrays.run > 1):  # noqa: SIM102 (this one is the compiler's)
        if own_steps:
            acting_count = arrays.columns[thread.segment + ACTING]
    own = thread.lane
    while own < acting_count:
        p = dealt(own, thread, share.chunk)
        own += arrays.threads
        if ti.static(intervals):  # noqa: SIM102 (this one is the compiler's)
            if own_steps:
                if ti.static(arrays.run > 1):
                    p = arrays.column_list[share.first + p]
                elif not gives_now(p, share, step, particles, thread.stride, some_wait, arrays):
                    continue
        place = particles + p
        x = get_vector(arrays.state, place, thread.stride, FIELD.position)
        C = ti.Matrix.zero(ti.f32, 3, 3)
        stretch = ti.Matrix.zero(ti.f32, 3, 3)
        if begins == 1.0:
            C = get_matrix(arrays.state, place, thread.stride, FIELD.affine)
            if ti.static(bool(arrays.variant & VARIANT.sheets)):
                arrays.hidden[share.first + p] = find_hidden(x, share.scene, arrays)
            mark(
                x, share.scene, arrays.setting[SETTING.inverse_cell_size], arrays,
                arrays.shape[SHAPE.all_blocks] + share.scene * arrays.shape[SHAPE.scene_blocks], arrays.live,
                share.scene * LIVE.length + LIVE.blocks,
            )  # fmt: skip
        else:
            bits = 0
            if ti.static(bool(arrays.variant & VARIANT.sheets)):
                bits = arrays.hidden[share.first + p]
            v, found_C, _ = gather(x, bits, share.scene, thread.velocities, arrays)
            C = found_C
            fastest = ti.max(fastest, v.dot(v))
            if ti.static(solid):
                stretch = get_symmetric(arrays.state, place, thread.stride, FIELD.stretch)
        F = ti.Matrix.identity(ti.f32, 3)
        if ti.static(solid):
            F = get_matrix(arrays.state, place, thread.stride, FIELD.deformation)
        row = 0
        if ti.static(bool(arrays.variant & VARIANT.several_laws)):
            row = arrays.tag[tags + TAG.law_row * thread.stride + p]
        material = arrays.tag[tags + TAG.material * thread.stride + p]
        old_volume = load(arrays.state, place + FIELD.volume * thread.stride)
        length, acting, many, spreads = step, step, 1.0, 0
        if ti.static(intervals):
            length, until, acts_until, many, spreads, acting = own_step(
                arrays.strained[share.first + p], arrays.covered[share.first + p], arrays.spread[share.first + p], x,
                C, old_volume, material, row, begins, step, share.scene, arrays, 3 * arrays.shape[SHAPE.all_blocks],
            )  # fmt: skip
            arrays.strained[share.first + p] = until
            arrays.covered[share.first + p] = acts_until
            arrays.spread[share.first + p] = spreads
        answer, new_stretch, new_F, volume, stiffness = respond(
            C, stretch, F, old_volume, material, row, length, share.scene, arrays
        )
        if ti.static(intervals) and spreads:
            for i, j, k in ti.static(((0, 0, 0), (1, 1, 1), (2, 2, 2), (3, 0, 1), (4, 0, 2), (5, 1, 2))):
                arrays.response[share.first + p + i * thread.stride] = answer[j, k]
        put_matrix(arrays.state, place, thread.stride, FIELD.affine, begins * C + acting * answer)
        if ti.static(solid):
            put_matrix(arrays.state, place, thread.stride, FIELD.deformation, new_F)
            if ti.static(intervals):
                put_symmetric(arrays.state, place, thread.stride, FIELD.stretch, new_stretch)
        store(arrays.state, place + FIELD.volume * thread.stride, volume)
        largest = ti.max(largest, stiffness)
        if many > 1.0:
            held = ti.max(held, stiffness)
    raise_by_warps(thread.lane, arrays, share.scene, COUNT.stiffness_bits, largest)
    raise_by_warps(thread.lane, arrays, share.scene, COUNT.held_stiffness_bits, held)
    raise_by_warps(thread.lane, arrays, share.scene, COUNT.speed_square_bits, fastest)


@ti.func
def _move(share: ti.template(), thread: ti.template(), particles: ti.i32, tags: ti.i32, arrays: ti.template()):
    """Computes new velocities and their gradients after contact with obstacles, and new positions."""
    largest = 0.0
    own = thread.lane
    while own < share.owned:
        p = dealt(own, thread, share.chunk)
        place = particles + p
        x = get_vector(arrays.state, place, thread.stride, FIELD.position)
        bits = 0
        if ti.static(bool(arrays.variant & VARIANT.sheets)):
            bits = arrays.hidden[share.first + p]
        v, C, mass = gather(x, bits, share.scene, thread.velocities, arrays)
        moved, speed, speed_square = move(x, v, C, share.scene, arrays)
        if ti.static(bool(arrays.variant & VARIANT.water)):  # noqa: SIM102 (this one is the compiler's)
            if arrays.tag[tags + TAG.material * thread.stride + p] == WATER and settles(share.scene, arrays):
                volume = place + FIELD.volume * thread.stride
                store(arrays.state, volume, settle(x, load(arrays.state, volume), mass, share.scene, arrays))
        put_vector(arrays.state, place, thread.stride, FIELD.position, moved)
        put_vector(arrays.state, place, thread.stride, FIELD.velocity, speed)
        put_matrix(arrays.state, place, thread.stride, FIELD.affine, C)
        largest = ti.max(largest, speed_square)
        own += arrays.threads
    raise_by_warps(thread.lane, arrays, share.scene, COUNT.speed_square_bits, largest)


@ti.kernel
def advance(
    frames: ti.i32, stretch: ti.i32, teams: ti.i32, blocks: ti.i32, patience: ti.i32, frame_s: ti.f32,
    state_address: ti.u64, node_address: ti.u64, node_entries: ti.i32, tag: Integers, rank: Integers,
    strained: Scalars, covered: Scalars, spread: Integers, response: Scalars, hidden: Integers,
    cell_count: Integers, column_count: Integers, column_list: Integers, block: Integers, live: Integers,
    columns: Integers, sync: Integers, turn: Integers, scene_value: ti.types.ndarray(dtype=ti.f32, ndim=2),
    counter: ti.types.ndarray(dtype=ti.i64, ndim=2), setting: Scalars, law: Scalars, shape: Integers,
    contact: Integers, contact_normal: Vectors, pose: Scalars, output: Scalars, variant: ti.template(),
    threads: ti.template(), several: ti.template(), run: ti.template(),
):  # fmt: skip
    """Advances every scene by `frames` frames, and writes each frame's positions to output[frame, particle, axis].

    Each of `teams` teams has `blocks` blocks of `threads` threads. A team computes `stretch` frames of one scene, then
    of another, until all are done. `several`: a team has more than one block. Particles are sorted at the start of each
    frame. P and G are the numbers of particles and nodes of all scenes.

    At addresses (see device_memory): state [2 * fields * P]; node [2, G, 4]. node[0] has changes of momentum in a step
    and of mass in an interval (zero between them); node[1] has velocities, and at an interval's end the mass.
    Arrays: tag [2 * 3 * P]; work space rank, spread, response [6 * P], hidden (see grid_kernel.substep) and column_list
    [P]; zero at first are cell_count [G], column_count [G / 4], the flags in block [8 * G / 64], columns
    [6 * blocks * teams] and sync [SYNC_LENGTH * (teams + 1) + scenes]; turn [scenes] is the order of the scenes, long
    ones first. Scenes that failed do not change.
    """
    ti.loop_config(block_dim=threads)
    for item in range(teams * (blocks * ti.static(threads if threads > 1 else CPU_ITEMS))):
        fields = ti.static(FIELD.solid if has_solid(variant) else FIELD.fluid)
        items = ti.static(threads if threads > 1 else CPU_ITEMS)
        members = blocks * threads
        # a CPU thread gets consecutive items, so blocks that wait for each other must not have the same CPU thread
        team = item // items % teams
        part = item // items // teams
        lane = item % items
        member = part * threads + lane
        stride = rank.shape[0]
        velocities = node_entries // 2
        state = state_address
        node = node_address
        arrays = ti.static(TeamArrays(
            state, node, tag, rank, strained, covered, spread, response, hidden, cell_count, column_count,
            column_list, block, live, columns, sync, turn, scene_value, counter, setting, law, shape, contact,
            contact_normal, pose, output, variant, threads, several, run, rank,
        ))  # fmt: skip
        syncs = 0
        choices = 0
        at = (team + 1) * SYNC_LENGTH
        segment = SEGMENT * (team * blocks + part)
        thread = ti.static(Thread(lane, part, blocks, member, members, stride, velocities, at, segment, patience))
        scenes = turn.shape[0]
        turns = 0
        place_in_turn = 0
        if lane < threads:
            if member == 0:
                take_turn(at, sync)
            # this barrier detects, before the simulation, blocks that do not run concurrently
            sync_team(thread, syncs, arrays)
            if frames > 0 and columns[segment + LEAVES] == 0:
                turns = scenes * ((frames + stretch - 1) // stretch)
                place_in_turn = sync[at + TURN]
        while place_in_turn < turns:
            scene = turn[place_in_turn % scenes]
            first = shape[SHAPE.part_begin + scene]
            count = shape[SHAPE.part_begin + scene + 1] - first
            chunk = (count + blocks - 1) // blocks
            if chunk > 4 * CHUNK:
                chunk = CHUNK
            round_of_all = chunk * blocks
            owned = count // round_of_all * chunk + ti.min(ti.max(count % round_of_all - part * chunk, 0), chunk)
            share = ti.static(Share(scene, first, chunk, owned))
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
                        scene_value[scene, VALUE.frame_end] = (live[live_at + LIVE.frames] + 1) * frame_s
                    sync_and_choose(thread, scene, syncs, choices, arrays)
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
                            sort(share, thread, copy, syncs, arrays, fields)
                            copy = 1 - copy
                            particles = copy * fields * stride + first
                            tags = copy * TAG.length * stride + first
                            sorted_already = True
                        listed = ti.static(not variant & VARIANT.each_step and run > 1)
                        if ti.static(listed):  # noqa: SIM102 (this one is the compiler's)
                            if own_steps:
                                list_acting(share, thread, step, arrays)
                                wait(threads)
                                if some_wait:
                                    mark_going_on(share, thread, particles, arrays)
                        _strain(share, thread, particles, tags, step, begins, own_steps, some_wait, arrays)
                        wait(threads)
                        scatter(share, thread, particles, tags, begins, own_steps, step, arrays)
                        sync_team(thread, syncs, arrays)
                        if ti.static(listed):
                            start_lists(thread, columns)
                        # the last thread has the fewest nodes, so it chooses the next step while others update theirs
                        if not ends and member == members - 1:
                            choose(scene, arrays)
                        update_nodes(
                            thread, scene, begins, ends, some_wait, now, whole, left, gravity_time, fallen, arrays
                        )
                        sync_team(thread, syncs, arrays)
                        if ends:
                            _move(share, thread, particles, tags, arrays)
                            sync_and_choose(thread, scene, syncs, choices, arrays)
                own = lane
                while own < owned:
                    p = dealt(own, thread, chunk)
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
                take_turn(at, sync)
            leave_scene((teams + 1) * SYNC_LENGTH + scene, lane, arrays)
            sync_team(thread, syncs, arrays)
            place_in_turn = sync[at + TURN]
            if place_in_turn >= scenes and place_in_turn < turns:
                entry = (teams + 1) * SYNC_LENGTH + turn[place_in_turn % scenes]
                await_scene(entry, place_in_turn // scenes * blocks, thread, arrays)
            sync_team(thread, syncs, arrays)


@ti.kernel
def start_team(
    state: Scalars, tag: Integers, position: Scalars, velocity: Scalars, label: Integers, law_row: Integers,
    order: Integers, counter: ti.types.ndarray(dtype=ti.i64, ndim=2), law: Scalars, fields: ti.template(),
):  # fmt: skip
    """Writes undeformed particles into the first copy, particle order[p] at p, and the maxima for the first step."""
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
