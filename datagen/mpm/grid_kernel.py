"""One substep of explicit MLS-MPM for a batch of scenes, as a single Taichi kernel.

The method is that of datagen.mpm.mls_mpm. On a CPU each part of a scene's particles is scattered into its own copy of
the grid, and the copies are summed in order. So threads change the result only by the number of copies, at most
MAXIMUM_PARTS. On a GPU all particles are scattered into one copy with atomics.
"""

from collections import namedtuple

import taichi as ti

from datagen.mpm.body_kernel import move_bodies
from datagen.mpm.layout import BLOCK_NODES, CONSTANT, COUNT, SETTING, SHAPE, STATUS, VALUE, VARIANT, has_solid
from datagen.mpm.mls_mpm import (
    Integers,
    Matrices,
    Nodes,
    Scalars,
    Vectors,
    find_hidden,
    initial_stiffness,
    is_fluid,
    move,
    node_velocity,
    respond,
    settle,
    settles,
)
from datagen.mpm.multiple_time_stepping import acts, change_of, mark_changed, own_step
from datagen.mpm.nodes import ghost_place, interpolate, interpolate_hidden, mark, node_places, second_field, weights
from datagen.mpm.time_step import choose_time_step, falls, raise_maximum
from hgn.scene.material import MATERIAL_BITS, MATERIAL_MASK, SAND, WATER

# The arguments of `substep`, passed to its functions as one. Taichi resolves the names during compilation.
GridArrays = namedtuple(
    "GridArrays",
    [
        "position", "velocity", "affine", "deformation", "volume", "strained", "covered", "spread",
        "response", "label", "law_row", "hidden", "scene_value", "counter", "setting", "law", "shape", "node",
        "gain", "fallen", "block", "contact", "contact_normal", "pose", "variant",
    ],
)  # fmt: skip


@ti.func
def _particle_to_grid(p: ti.i32, copy: ti.i32, scene: ti.i32, step: ti.f32, arrays: ti.template()):
    """Updates a particle's deformation if it acts, and adds its contribution to the nodes of one copy of the grid.

    It contributes momentum and mass in the first substep of an interval, and only the impulse of its stress later.
    """
    dx = arrays.setting[SETTING.cell_size]
    inverse_dx = arrays.setting[SETTING.inverse_cell_size]
    material = arrays.label[p] & MATERIAL_MASK
    row = 0
    if ti.static(bool(arrays.variant & VARIANT.several_laws)):
        row = arrays.law_row[p]
    begins = arrays.scene_value[scene, VALUE.begins]
    hidden_here = 0
    if ti.static(bool(arrays.variant & VARIANT.sheets)):
        if begins == 1.0:
            arrays.hidden[p] = find_hidden(arrays.position[p], scene, arrays)
        hidden_here = arrays.hidden[p]
    marks = 3 * arrays.shape[SHAPE.all_blocks] + 2
    A = ti.Matrix.zero(ti.f32, 3, 3)
    if acts(arrays.covered[p], begins, step, scene, arrays.scene_value):
        F = ti.Matrix.identity(ti.f32, 3)
        if ti.static(has_solid(arrays.variant)):
            if ti.static(not arrays.variant & VARIANT.water) or not is_fluid(material):
                F = arrays.deformation[p]
        C = arrays.affine[p]
        stretch = ti.Matrix.zero(ti.f32, 3, 3)
        if begins == 0.0:
            stretch = arrays.affine[p]  # until the interval ends, the array of C contains the stretch
            v_now, C_now = interpolate(
                arrays.position[p], scene * arrays.shape[SHAPE.scene_blocks] * BLOCK_NODES, arrays, inverse_dx
            )
            if ti.static(bool(arrays.variant & VARIANT.sheets)):
                v_now, C_now = interpolate_hidden(
                    arrays.position[p], v_now, C_now, hidden_here, scene, arrays, inverse_dx
                )
            C = C_now
            raise_maximum(arrays.counter, scene, COUNT.speed_square_bits, v_now.dot(v_now))
        length, until, acts_until, many, spreads, acting = own_step(
            arrays.strained[p], arrays.covered[p], arrays.spread[p], arrays.position[p], C, arrays.volume[p], material,
            row, begins, step, scene, arrays, marks,
        )  # fmt: skip
        arrays.strained[p] = until
        arrays.covered[p] = acts_until
        arrays.spread[p] = spreads
        answer, new_stretch, new_F, new_volume, stiffness = respond(
            C, stretch, F, arrays.volume[p], material, row, length, scene, arrays
        )
        if spreads:
            arrays.response[p] = answer
        A = begins * C + acting * answer
        if many > 1.0:
            raise_maximum(arrays.counter, scene, COUNT.held_stiffness_bits, stiffness)
        if arrays.scene_value[scene, VALUE.interval_remaining] > 0.0:
            arrays.affine[p] = new_stretch
        arrays.volume[p] = new_volume
        if ti.static(has_solid(arrays.variant)):
            if ti.static(not arrays.variant & VARIANT.water) or not is_fluid(material):
                arrays.deformation[p] = new_F
        raise_maximum(arrays.counter, scene, COUNT.stiffness_bits, stiffness)
    else:
        A = step * arrays.response[p]
        if arrays.scene_value[scene, VALUE.interval_remaining] > 0.0:
            now = ti.cast(arrays.counter[scene, COUNT.substeps], ti.i32)
            mark_changed(arrays.position[p], scene, now, 1.0, inverse_dx, arrays, marks)

    x = arrays.position[p] * inverse_dx
    base = ti.floor(x - 0.5, ti.i32)
    fx = x - ti.cast(base, ti.f32)
    w0, w1, w2 = weights(fx)
    first_node = (copy + scene * arrays.shape[SHAPE.scene_blocks]) * BLOCK_NODES
    index_x, index_y, index_z = node_places(base, first_node, arrays.shape, 1)
    w = ti.static((w0, w1, w2))
    A *= dx
    v = begins * arrays.velocity[p] - A @ fx
    for i, j in ti.static(ti.ndrange(3, 3)):
        wxy = w[i][0] * w[j][1]
        vxy = ti.Vector([v[a] + A[a, 0] * i + A[a, 1] * j for a in range(3)])
        for k in ti.static(range(3)):
            weight = wxy * w[k][2]
            vxyz = ti.Vector([vxy[a] + A[a, 2] * k for a in range(3)])
            share = ti.Vector([weight * vxyz[0], weight * vxyz[1], weight * vxyz[2], weight * begins])
            if ti.static(bool(arrays.variant & VARIANT.several_laws)):
                share *= arrays.law[row + CONSTANT.mass]
            target = index_x[i] + index_y[j] + index_z[k]
            if ti.static(bool(arrays.variant & VARIANT.sheets)):
                if (hidden_here >> (9 * i + 3 * j + k)) & 1:
                    target = copy * BLOCK_NODES + ghost_place(base + ti.Vector([i, j, k]), scene, arrays)
            if ti.static(bool(arrays.variant & VARIANT.atomic)):
                for a in ti.static(range(3)):
                    ti.atomic_add(arrays.gain[target][a], share[a])
                if begins == 1.0:
                    ti.atomic_add(arrays.gain[target][3], share[3])
            else:
                old = arrays.gain[target]
                arrays.gain[target] = old + share


@ti.func
def _mass_around(x, first_node: ti.i32, arrays: ti.template(), inverse_dx: ti.f32) -> ti.f32:
    """Returns the mass interpolated from the nodes around x."""
    scaled = x * inverse_dx
    base = ti.floor(scaled - 0.5, ti.i32)
    w0, w1, w2 = weights(scaled - ti.cast(base, ti.f32))
    w = ti.static((w0, w1, w2))
    index_x, index_y, index_z = node_places(base, first_node, arrays.shape, 1)
    mass = 0.0
    for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
        mass += w[i][0] * w[j][1] * w[k][2] * arrays.node[index_x[i] + index_y[j] + index_z[k]][3]
    return mass


@ti.func
def _grid_to_particle(p: ti.i32, scene: ti.i32, arrays: ti.template(), is_water: ti.i32):
    """Computes a particle's new velocity and its gradient, then its new position."""
    x = arrays.position[p]
    first_node = scene * arrays.shape[SHAPE.scene_blocks] * BLOCK_NODES
    v, C = interpolate(x, first_node, arrays, arrays.setting[SETTING.inverse_cell_size])
    if ti.static(bool(arrays.variant & VARIANT.sheets)):
        v, C = interpolate_hidden(x, v, C, arrays.hidden[p], scene, arrays, arrays.setting[SETTING.inverse_cell_size])
    moved, speed, speed_square = move(x, v, C, scene, arrays)
    raise_maximum(arrays.counter, scene, COUNT.speed_square_bits, speed_square)
    if ti.static(bool(arrays.variant & VARIANT.water)):
        if is_water and settles(scene, arrays):
            mass = _mass_around(x, first_node, arrays, arrays.setting[SETTING.inverse_cell_size])
            arrays.volume[p] = settle(x, arrays.volume[p], mass, scene, arrays)
    arrays.position[p] = moved
    arrays.velocity[p] = speed
    arrays.affine[p] = C


@ti.kernel
def substep(
    position: Vectors, velocity: Vectors, affine: Matrices, deformation: Matrices, volume: Scalars,
    strained: Scalars, covered: Scalars, spread: Integers, response: Matrices, label: Integers, law_row: Integers,
    hidden: Integers, scene_value: ti.types.ndarray(dtype=ti.f32, ndim=2),
    counter: ti.types.ndarray(dtype=ti.i64, ndim=2), setting: Scalars, law: Scalars, shape: Integers, node: Nodes,
    gain: Nodes, fallen: Scalars, block: Integers, contact: Integers, contact_normal: Vectors, pose: Scalars,
    variant: ti.template(),
):  # fmt: skip
    """Advances every scene with remaining time by one substep of its own length.

    Particles that enter later belong to an additional row of scene_value, which never has time.
    Order: time step; marks of blocks (first substep of an interval); particles to grid (deformation, plasticity,
    stress); gravity, colliders, walls; grid to particles and advection (last substep of an interval).

    label    scene and material of each particle
    node     [scenes * blocks * 64] velocity and mass of nodes
    gain     [parts * scenes * blocks * 64] contributions to them, a copy of the grid for each part
    hidden   bits of each particle's nodes that sheets hide from it (see surface_kernel.hidden_nodes); second fields of
             these nodes are at the end of node and gain
    block    flags and list of touched blocks (see mark), the list's length, 1 if an interval begins in any scene and
             the list is built again, and the marks of own_step
    contact  entry of each node or -1: the index of its vectors in `contact_normal` (see surface_kernel.NODE_VECTORS),
             and if below SHAPE.ghosts the index of its second field after SHAPE.ghost_begin. Then for each base node
             the start of its list of triangles in `contact`, or -1; then these lists with their heads (see
             surface_kernel.LIST_HEAD), which contain indices of triangles' vectors in `contact_normal`. Then the
             moving obstacles (see body_arrays)
    pose     numbers of moving obstacles (see layout.BodyState)
    """
    arrays = ti.static(GridArrays(
        position, velocity, affine, deformation, volume, strained, covered, spread, response, label, law_row,
        hidden, scene_value, counter, setting, law, shape, node, gain, fallen, block, contact, contact_normal,
        pose, variant,
    ))  # fmt: skip
    for scene in range(scene_value.shape[0]):
        choose_time_step(scene, scene_value, counter, setting, shape[SHAPE.maximum_substeps])
        if ti.static(bool(variant & VARIANT.moving)):
            move_bodies(scene, arrays)
        if scene_value[scene, VALUE.time_step] > 0.0 and scene_value[scene, VALUE.begins] == 1.0:
            block[3 * shape[SHAPE.all_blocks]] = 0
            block[3 * shape[SHAPE.all_blocks] + 1] = 1

    for p in range(position.shape[0]):
        scene = label[p] >> MATERIAL_BITS
        if block[3 * shape[SHAPE.all_blocks] + 1] == 1 and scene_value[scene, VALUE.time_step] > 0.0:
            blocks = shape[SHAPE.all_blocks]
            mark(position[p], scene, setting[SETTING.inverse_cell_size], arrays, blocks, block, 3 * blocks)

    if ti.static(bool(variant & VARIANT.atomic)):
        for p in range(position.shape[0]):
            scene = label[p] >> MATERIAL_BITS
            step = scene_value[scene, VALUE.time_step]
            if step > 0.0 and (
                spread[p] == 1 or acts(covered[p], scene_value[scene, VALUE.begins], step, scene, scene_value)
            ):
                _particle_to_grid(p, 0, scene, step, arrays)
    else:
        for task in range(scene_value.shape[0] * ti.static(variant // VARIANT.parts)):
            parts = ti.static(variant // VARIANT.parts)
            scene = task // parts
            step = scene_value[scene, VALUE.time_step]
            if step > 0.0:
                copy = (task - scene * parts) * shape[SHAPE.all_blocks]
                for p in range(shape[SHAPE.part_begin + task], shape[SHAPE.part_begin + task + 1]):
                    if label[p] >> MATERIAL_BITS == scene and (
                        spread[p] == 1 or acts(covered[p], scene_value[scene, VALUE.begins], step, scene, scene_value)
                    ):
                        _particle_to_grid(p, copy, scene, step, arrays)

    for n in range(block[3 * shape[SHAPE.all_blocks]] * BLOCK_NODES):
        global_block = block[shape[SHAPE.all_blocks] + (n >> 6)]
        if n & 63 == 0:
            block[global_block] = 0
            block[3 * shape[SHAPE.all_blocks] + 1] = 0
        place = global_block * BLOCK_NODES + (n & 63)
        scene = global_block // shape[SHAPE.scene_blocks]
        begins = scene_value[scene, VALUE.begins] == 1.0
        many = 1.0
        if scene_value[scene, VALUE.synchronised] == 1.0 and scene_value[scene, VALUE.interval_remaining] > 0.0:
            now = ti.cast(counter[scene, COUNT.substeps], ti.i32)
            many = change_of(block[3 * shape[SHAPE.all_blocks] + 2 + global_block], now)
        if scene_value[scene, VALUE.time_step] > 0.0 and many > 0.0:
            lead = ti.min(
                (many - 1.0) * scene_value[scene, VALUE.whole_step], scene_value[scene, VALUE.interval_remaining]
            )
            gravity_time = scene_value[scene, VALUE.gravity_time]
            fallen_before = scene_value[scene, VALUE.fallen]
            entry = -1
            second = -1
            node_fields = 1
            if ti.static(bool(variant & VARIANT.contact)):
                entry = contact[place]
                second = second_field(place, scene, arrays)
                if second >= 0:
                    node_fields = 2
            for field in range(node_fields):
                own = place
                if field == 1:
                    own = shape[SHAPE.ghost_begin] + second
                before = ti.Vector([0.0, 0.0, 0.0, 0.0])
                ahead = 0.0
                if not begins:
                    before = node[own]
                    ahead = fallen[own] - fallen_before
                fallen[own] = fallen_before + gravity_time + lead
                total = gain[own]
                for part in ti.static(range(1, variant // VARIANT.parts)):  # sums the copies in a fixed order
                    total += gain[own + part * shape[SHAPE.all_blocks] * BLOCK_NODES]
                for part in ti.static(range(variant // VARIANT.parts)):
                    gain[own + part * shape[SHAPE.all_blocks] * BLOCK_NODES] = ti.Vector([0.0, 0.0, 0.0, 0.0])
                mass = before[3] + total[3]
                v = node_velocity(
                    ti.Vector([before[0], before[1], before[2]]), ti.Vector([total[0], total[1], total[2]]), mass,
                    n & 63, 2 * entry + field, block[2 * shape[SHAPE.all_blocks] + (n >> 6)],
                    falls(gravity_time + lead - ahead, scene, scene_value), scene, arrays,
                )  # fmt: skip
                node[own] = ti.Vector([v[0], v[1], v[2], mass])

    for p in range(position.shape[0]):
        scene = label[p] >> MATERIAL_BITS
        if scene_value[scene, VALUE.time_step] > 0.0 and scene_value[scene, VALUE.interval_remaining] == 0.0:
            _grid_to_particle(p, scene, arrays, label[p] & MATERIAL_MASK == WATER)


@ti.kernel
def start(
    velocity: Vectors, affine: Matrices, deformation: Matrices, volume: Scalars, label: Integers, law_row: Integers,
    counter: ti.types.ndarray(dtype=ti.i64, ndim=2), law: Scalars,
):  # fmt: skip
    """Writes undeformed particles, and the maxima for the first time step."""
    for p in range(velocity.shape[0]):
        scene = label[p] >> MATERIAL_BITS
        material = label[p] & MATERIAL_MASK
        affine[p] = ti.Matrix.zero(ti.f32, 3, 3)
        if p < deformation.shape[0]:
            deformation[p] = ti.Matrix.identity(ti.f32, 3)
        volume[p] = 0.0 if material == SAND else 1.0
        raise_maximum(counter, scene, COUNT.stiffness_bits, initial_stiffness(material, law, law_row[p]))
        speed_square = velocity[p].dot(velocity[p])
        raise_maximum(counter, scene, COUNT.speed_square_bits, speed_square)


@ti.kernel
def enter(
    which: Integers, own_label: Integers, velocity: Vectors, label: Integers, law_row: Integers,
    scene_value: ti.types.ndarray(dtype=ti.f32, ndim=2), counter: ti.types.ndarray(dtype=ti.i64, ndim=2),
    setting: Scalars, law: Scalars,
):  # fmt: skip
    """Adds particles to their scenes between two intervals.

    Their velocities are given for the present time, and converted to the middle of the last interval (leapfrog).
    """
    for i in range(which.shape[0]):
        p = which[i]
        scene = own_label[p] >> MATERIAL_BITS
        label[p] = own_label[p]
        gravity = ti.Vector([scene_value[scene, VALUE.gravity + axis] for axis in range(3)])
        velocity[p] -= 0.5 * setting[SETTING.leapfrog] * scene_value[scene, VALUE.interval] * gravity
        stiffness = initial_stiffness(label[p] & MATERIAL_MASK, law, law_row[p])
        raise_maximum(counter, scene, COUNT.stiffness_bits, stiffness)
        raise_maximum(counter, scene, COUNT.speed_square_bits, velocity[p].dot(velocity[p]))


@ti.kernel
def begin_frame(
    frame_s: ti.f32,
    end_s: ti.f32,
    scene_value: ti.types.ndarray(dtype=ti.f32, ndim=2),
    counter: ti.types.ndarray(dtype=ti.i64, ndim=2),
):
    """Gives every running scene the time of a frame that ends at `end_s`."""
    for scene in range(scene_value.shape[0]):
        counter[scene, COUNT.frame_substeps] = ti.cast(0, ti.i64)
        if counter[scene, COUNT.status] == STATUS.running:
            scene_value[scene, VALUE.remaining] = frame_s
            scene_value[scene, VALUE.frame_end] = end_s
