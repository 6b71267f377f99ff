"""One substep of explicit MLS-MPM for a batch of scenes, as a single Taichi kernel.

APIC transfers with quadratic B-splines (Jiang et al. 2015; Hu et al. 2018): a particle at x touches the nodes
base .. base + 2 with base = floor(x / dx - 1/2); node I lies at I dx. Nodes are stored by blocks of 4 x 4 x 4,
[scene, block, node in block], as (momentum or velocity, mass). Only blocks that a particle touches are cleared
and updated. All particles have the same mass, which is the unit of mass.

On a CPU each (scene, part) of the particles scatters into its own copy of the grid, one after another, and the
copies are summed in order: no atomics, and the same result whatever the number of threads at work. On a GPU all
particles scatter at once into one copy with atomics.

Everything is per scene: time step, remaining time, state, counters. A scene that is done, or failed, idles.
"""

import taichi as ti

from datagen.mpm.constitutive import count_event, hardening, solid, water
from datagen.mpm.layout import (
    BLOCK,
    BLOCK_NODES,
    CONSTANT,
    COUNT,
    SETTING,
    SHAPE,
    STATUS,
    VALUE,
    VARIANT,
)
from hgn.scene.material import SNOW, WATER

SMALLEST_MASS = 1e-10  # of a particle; lighter nodes are at the rounding of the weights


Scalars = ti.types.ndarray(dtype=ti.f32, ndim=1)
Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)
Vectors = ti.types.ndarray(dtype=ti.types.vector(3, ti.f32), ndim=1)
Matrices = ti.types.ndarray(dtype=ti.types.matrix(3, 3, ti.f32), ndim=1)
Nodes = ti.types.ndarray(dtype=ti.types.vector(4, ti.f32), ndim=1)


@ti.func
def _weights(fx):
    """Quadratic B-spline weights of nodes 0, 1, 2 for an offset fx in [0.5, 1.5) cells, per axis."""
    return (
        0.5 * (1.5 - fx) ** 2,
        0.75 - (fx - 1.0) ** 2,
        0.5 * (fx - 0.5) ** 2,
    )


@ti.func
def _node_of_axis(index, stride: ti.i32, local_stride: ti.i32):
    """The share of one axis in a node's position; shares of the three axes add up."""
    return (index >> 2) * stride + (index & 3) * local_stride


@ti.func
def _base(x, inverse_dx: ti.f32):
    return ti.floor(x * inverse_dx - 0.5, ti.i32)


@ti.func
def _not_finite(value) -> ti.i32:
    return (ti.bit_cast(value, ti.i32) & 0x7F800000) == 0x7F800000


@ti.func
def _raise_maximum(values: ti.template(), scene: ti.i32, entry: ti.template(), value: ti.f32):
    if values[scene, entry] < value:
        ti.atomic_max(values[scene, entry], value)


@ti.func
def _choose_time_step(
    scene: ti.i32,
    scene_value: ti.template(),
    counter: ti.template(),
    setting: ti.template(),
    maximum_substeps: ti.i32,
):
    step = 0.0
    dx = setting[SETTING.cell_size]
    remaining = scene_value[scene, VALUE.remaining]
    if remaining > 0.0 and counter[scene, COUNT.status] == STATUS.running:
        stiffness = ti.max(
            scene_value[scene, VALUE.stiffness],
            scene_value[scene, VALUE.least_stiffness],
            1.0,
        )
        speed_square = scene_value[scene, VALUE.speed_square]
        gravity = ti.Vector([scene_value[scene, VALUE.gravity + i] for i in range(3)])
        fixed = setting[SETTING.fixed_time_step]
        limit = fixed
        if fixed == 0.0:
            limit = setting[SETTING.stability_fraction] * dx * ti.sqrt(setting[CONSTANT.density] / stiffness)
            # the fall within the step counts too
            speed = ti.sqrt(speed_square) + gravity.norm() * ti.min(limit, remaining)
            limit = ti.min(limit, setting[SETTING.speed_fraction] * dx / ti.max(speed, 1e-20))
        # equal steps to the end of the frame: no sliver at its end
        ahead = ti.max(ti.ceil(ti.min(remaining / limit, 1e9) - 1e-4), 1.0)
        done = ti.cast(counter[scene, COUNT.frame_substeps], ti.i32)
        if fixed > 0.0:
            ahead = setting[SETTING.fixed_substeps] - ti.cast(done, ti.f32)
        if not ahead <= ti.cast(maximum_substeps - done, ti.f32):
            counter[scene, COUNT.status] = ti.cast(STATUS.too_many_substeps, ti.i64)
            scene_value[scene, VALUE.remaining] = 0.0
        else:
            step = remaining / ahead
            if fixed > 0.0:
                step = fixed
            remaining -= step
            if ahead <= 1.0:
                remaining = 0.0
            scene_value[scene, VALUE.remaining] = remaining
            scene_value[scene, VALUE.substeps_ahead] = ahead - 1.0
            scene_value[scene, VALUE.smallest_time_step] = ti.min(scene_value[scene, VALUE.smallest_time_step], step)
            counter[scene, COUNT.frame_substeps] = ti.cast(done + 1, ti.i64)
            counter[scene, COUNT.substeps] += ti.cast(1, ti.i64)
            # maxima are gathered anew while the step runs
            scene_value[scene, VALUE.stiffness] = 0.0
            scene_value[scene, VALUE.speed_square] = 0.0
    scene_value[scene, VALUE.time_step] = step


@ti.func
def _mark(x, scene: ti.i32, inverse_dx: ti.f32, shape: ti.template(), block: ti.template()):
    """Adds the blocks that the particle's nodes lie in, up to eight, to the list.

    `block` holds a flag for each block of all scenes, then the list of touched ones, then its length.
    """
    blocks = shape[SHAPE.all_blocks]
    base = _base(x, inverse_dx)
    first = base >> 2
    last = (base + 2) >> 2
    for i, j, k in ti.static(ti.ndrange(2, 2, 2)):
        corner = ti.Vector([last[0] if i else first[0], last[1] if j else first[1], last[2] if k else first[2]])
        fresh = 1
        for axis, high in ti.static(((0, i), (1, j), (2, k))):
            if ti.static(high):
                if first[axis] == last[axis]:
                    fresh = 0
        if fresh:
            index = scene * shape[SHAPE.scene_blocks]
            index += (corner[0] * shape[SHAPE.blocks + 1] + corner[1]) * shape[SHAPE.blocks + 2] + corner[2]
            if block[index] == 0:
                if ti.atomic_max(block[index], 1) == 0:
                    block[blocks + ti.atomic_add(block[2 * blocks], 1)] = index


@ti.func
def _node_places(base, first_node: ti.i32, shape: ti.template()):
    """Shares of x, y, z in the place of nodes base .. base + 2; the place is the sum of one of each."""
    stride_y = shape[SHAPE.blocks + 2] * BLOCK_NODES
    stride_x = shape[SHAPE.blocks + 1] * stride_y
    offset = ti.Vector([0, 1, 2])
    return (
        first_node + _node_of_axis(base[0] + offset, stride_x, BLOCK * BLOCK),
        _node_of_axis(base[1] + offset, stride_y, BLOCK),
        _node_of_axis(base[2] + offset, BLOCK_NODES, 1),
    )


@ti.func
def _particle_to_grid(
    p: ti.i32,
    copy: ti.i32,
    scene: ti.i32,
    step: ti.f32,
    position: ti.template(),
    velocity: ti.template(),
    affine: ti.template(),
    deformation: ti.template(),
    volume: ti.template(),
    label: ti.template(),
    node: ti.template(),
    scene_value: ti.template(),
    counter: ti.template(),
    setting: ti.template(),
    shape: ti.template(),
    variant: ti.template(),
):
    """Updates the particle's deformation and adds its mass and momentum to its nodes in one copy of the grid."""
    has_water = ti.static(bool(variant & VARIANT.water))
    has_solid = ti.static(bool(variant & (VARIANT.sand | VARIANT.snow)))
    dx = setting[SETTING.cell_size]
    inverse_dx = setting[SETTING.inverse_cell_size]
    material = label[p] & 3
    C = affine[p]
    # -dt V0 (4 / dx^2) stress / mass, with V0 / mass = 1 / density
    scale = -step * 4.0 * inverse_dx * inverse_dx / setting[CONSTANT.density]
    A = C
    if ti.static(has_water):
        if ti.static(not has_solid) or material == WATER:
            J, pressure, stiffness = water(volume[p], step * C.trace(), setting, counter, scene)
            volume[p] = J
            for i in ti.static(range(3)):
                A[i, i] += scale * pressure
            _raise_maximum(scene_value, scene, VALUE.stiffness, stiffness)
    if ti.static(has_solid):
        if ti.static(not has_water) or material != WATER:
            F = deformation[p]
            F += step * (C @ F)
            new_F, new_volume, stress, stiffness = solid(
                F,
                volume[p],
                material,
                setting,
                counter,
                scene,
                ti.static(bool(variant & VARIANT.sand)),
                ti.static(bool(variant & VARIANT.snow)),
                ti.static(bool(variant & VARIANT.taichi_elements_sand)),
            )
            deformation[p] = new_F
            volume[p] = new_volume
            A += scale * stress
            _raise_maximum(scene_value, scene, VALUE.stiffness, stiffness)

    x = position[p] * inverse_dx
    base = ti.floor(x - 0.5, ti.i32)
    fx = x - ti.cast(base, ti.f32)
    w0, w1, w2 = _weights(fx)
    first_node = (copy + scene * shape[SHAPE.scene_blocks]) * BLOCK_NODES
    index_x, index_y, index_z = _node_places(base, first_node, shape)
    w = ti.static((w0, w1, w2))
    A *= dx
    v = velocity[p] - A @ fx
    for i, j in ti.static(ti.ndrange(3, 3)):
        wxy = w[i][0] * w[j][1]
        vxy = ti.Vector([v[a] + A[a, 0] * i + A[a, 1] * j for a in range(3)])
        for k in ti.static(range(3)):
            weight = wxy * w[k][2]
            vxyz = ti.Vector([vxy[a] + A[a, 2] * k for a in range(3)])
            share = ti.Vector([weight * vxyz[0], weight * vxyz[1], weight * vxyz[2], weight])
            target = index_x[i] + index_y[j] + index_z[k]
            if ti.static(bool(variant & VARIANT.atomic)):
                ti.atomic_add(node[target], share)
            else:
                old = node[target]
                node[target] = old + share


@ti.func
def _meet_collider(v, normal, both_sides: ti.i32, friction: ti.f32):
    """Contact of a node: separation is free, approach keeps the tangential part less Coulomb friction."""
    out = v
    along = v.dot(normal)
    if both_sides or along < 0.0:
        tangential = v - along * normal
        speed = tangential.norm()
        keep = 1.0
        if friction > 0.0:
            keep = ti.max(0.0, 1.0 - friction * ti.abs(along) / ti.max(speed, 1e-20))
        out = tangential * keep
    return out


@ti.func
def _update_node(
    place: ti.i32,
    global_block: ti.i32,
    scene_value: ti.template(),
    setting: ti.template(),
    shape: ti.template(),
    node: ti.template(),
    contact: ti.template(),
    contact_normal: ti.template(),
    variant: ti.template(),
):
    """Momentum to velocity; gravity, colliders and walls. What copies hold is summed in order."""
    total = node[place]
    for part in ti.static(range(1, variant // VARIANT.parts)):
        total += node[place + part * shape[SHAPE.all_blocks] * BLOCK_NODES]
    v = ti.Vector([0.0, 0.0, 0.0])
    if total[3] > SMALLEST_MASS:
        blocks_y = shape[SHAPE.blocks + 1]
        blocks_z = shape[SHAPE.blocks + 2]
        scene = global_block // shape[SHAPE.scene_blocks]
        block = global_block - scene * shape[SHAPE.scene_blocks]
        gravity = ti.Vector([scene_value[scene, VALUE.gravity + i] for i in range(3)])
        v = ti.Vector([total[0], total[1], total[2]]) / total[3] + scene_value[scene, VALUE.time_step] * gravity
        if ti.static(bool(variant & VARIANT.contact)):
            entry = contact[place]
            if entry >= 0:
                v = _meet_collider(v, contact_normal[entry >> 1], entry & 1, setting[SETTING.friction])
        # walls last: whatever a collider leaves, nothing leaves the domain
        local = place & (BLOCK_NODES - 1)
        index = ti.Vector(
            [
                block // (blocks_y * blocks_z) * BLOCK + local // 16,
                block // blocks_z % blocks_y * BLOCK + local // 4 % 4,
                block % blocks_z * BLOCK + local % 4,
            ]
        )
        wall_cells = shape[SHAPE.wall_cells]
        stuck = 0
        for axis in ti.static(range(3)):
            if index[axis] < wall_cells:
                v[axis] = ti.max(v[axis], 0.0)
                stuck = 1
            if index[axis] >= shape[SHAPE.nodes + axis] - wall_cells:
                v[axis] = ti.min(v[axis], 0.0)
                stuck = 1
        if stuck and shape[SHAPE.sticky_walls]:
            v = ti.Vector([0.0, 0.0, 0.0])
    node[place] = ti.Vector([v[0], v[1], v[2], total[3]])


@ti.func
def _grid_to_particle(
    p: ti.i32,
    scene: ti.i32,
    step: ti.f32,
    position: ti.template(),
    velocity: ti.template(),
    affine: ti.template(),
    node: ti.template(),
    scene_value: ti.template(),
    counter: ti.template(),
    setting: ti.template(),
    shape: ti.template(),
):
    """New velocity and its gradient, then advection; stops a scene that is not finite or leaves the domain."""
    inverse_dx = setting[SETTING.inverse_cell_size]
    x = position[p]
    scaled = x * inverse_dx
    base = ti.floor(scaled - 0.5, ti.i32)
    fx = scaled - ti.cast(base, ti.f32)
    w0, w1, w2 = _weights(fx)
    w = ti.static((w0, w1, w2))
    index_x, index_y, index_z = _node_places(base, scene * shape[SHAPE.scene_blocks] * BLOCK_NODES, shape)
    v = ti.Vector([0.0, 0.0, 0.0])
    gradient_x = ti.Vector([0.0, 0.0, 0.0])
    gradient_y = ti.Vector([0.0, 0.0, 0.0])
    gradient_z = ti.Vector([0.0, 0.0, 0.0])
    for i in ti.static(range(3)):
        plane = ti.Vector([0.0, 0.0, 0.0])
        plane_y = ti.Vector([0.0, 0.0, 0.0])
        plane_z = ti.Vector([0.0, 0.0, 0.0])
        for j in ti.static(range(3)):
            line = ti.Vector([0.0, 0.0, 0.0])
            line_z = ti.Vector([0.0, 0.0, 0.0])
            for k in ti.static(range(3)):
                value = node[index_x[i] + index_y[j] + index_z[k]]
                share = w[k][2] * ti.Vector([value[0], value[1], value[2]])
                line += share
                line_z += (k - fx[2]) * share
            plane += w[j][1] * line
            plane_y += w[j][1] * (j - fx[1]) * line
            plane_z += w[j][1] * line_z
        v += w[i][0] * plane
        gradient_x += w[i][0] * (i - fx[0]) * plane
        gradient_y += w[i][0] * plane_y
        gradient_z += w[i][0] * plane_z
    C = ti.Matrix.cols([gradient_x, gradient_y, gradient_z]) * (4.0 * inverse_dx)
    x += step * v
    speed_square = v.dot(v)
    bad = _not_finite(speed_square) | _not_finite(x.sum()) | _not_finite(C.sum())
    outside = 0
    clamps = 0
    for axis in ti.static(range(3)):
        low = setting[SETTING.low + axis]
        high = setting[SETTING.high + axis]
        if not (x[axis] >= 0.0 and x[axis] <= setting[SETTING.size + axis]):
            outside = 1
        if not x[axis] >= low:
            x[axis] = low
            clamps = 1
        if not x[axis] <= high:
            x[axis] = high
            clamps = 1
    if bad:
        counter[scene, COUNT.status] = ti.cast(STATUS.not_finite, ti.i64)
        scene_value[scene, VALUE.remaining] = 0.0
    elif outside:
        # a value that is not finite is the better cause to report
        if counter[scene, COUNT.status] != STATUS.not_finite:
            counter[scene, COUNT.status] = ti.cast(STATUS.left_domain, ti.i64)
        scene_value[scene, VALUE.remaining] = 0.0
    else:
        count_event(counter, scene, COUNT.position_clamps, clamps)
        _raise_maximum(scene_value, scene, VALUE.speed_square, speed_square)
        _raise_maximum(scene_value, scene, VALUE.largest_speed_square, speed_square)
    position[p] = x
    velocity[p] = v
    affine[p] = C


@ti.kernel
def substep(
    position: Vectors,
    velocity: Vectors,
    affine: Matrices,
    deformation: Matrices,
    volume: Scalars,
    label: Integers,
    scene_value: ti.types.ndarray(dtype=ti.f32, ndim=2),
    counter: ti.types.ndarray(dtype=ti.i64, ndim=2),
    setting: Scalars,
    shape: Integers,
    node: Nodes,
    block: Integers,
    contact: Integers,
    contact_normal: Vectors,
    variant: ti.template(),
):
    """Advances every scene that has time left by one substep of its own length.

    Order: time step, mark and clear blocks, particles to grid (deformation, plasticity, stress), gravity,
    colliders, walls, grid to particles, advection. `label` holds scene * 4 + material of each particle, `node`
    [parts * scenes * blocks * 64] holds a copy of the grid for each part, `contact` twice the index of each
    node's normal plus 1 where motion is stopped both ways, or -1.
    """
    for scene in range(scene_value.shape[0]):
        _choose_time_step(scene, scene_value, counter, setting, shape[SHAPE.maximum_substeps])
        if scene == 0:
            block[2 * shape[SHAPE.all_blocks]] = 0

    for p in range(position.shape[0]):
        scene = label[p] >> 2
        if scene_value[scene, VALUE.time_step] > 0.0:
            _mark(position[p], scene, setting[SETTING.inverse_cell_size], shape, block)

    for n in range(block[2 * shape[SHAPE.all_blocks]] * BLOCK_NODES):
        blocks = shape[SHAPE.all_blocks]
        place = block[blocks + (n >> 6)] * BLOCK_NODES + (n & 63)
        for part in ti.static(range(variant // VARIANT.parts)):
            node[place + part * blocks * BLOCK_NODES] = ti.Vector([0.0, 0.0, 0.0, 0.0])

    if ti.static(bool(variant & VARIANT.atomic)):
        for p in range(position.shape[0]):
            scene = label[p] >> 2
            step = scene_value[scene, VALUE.time_step]
            if step > 0.0:
                _particle_to_grid(
                    p, 0, scene, step, position, velocity, affine, deformation, volume, label, node, scene_value,
                    counter, setting, shape, variant,
                )  # fmt: skip
    else:
        for task in range(scene_value.shape[0] * ti.static(variant // VARIANT.parts)):
            parts = ti.static(variant // VARIANT.parts)
            scene = task // parts
            step = scene_value[scene, VALUE.time_step]
            if step > 0.0:
                copy = (task - scene * parts) * shape[SHAPE.all_blocks]
                for p in range(shape[SHAPE.part_begin + task], shape[SHAPE.part_begin + task + 1]):
                    _particle_to_grid(
                        p, copy, scene, step, position, velocity, affine, deformation, volume, label, node,
                        scene_value, counter, setting, shape, variant,
                    )  # fmt: skip

    for n in range(block[2 * shape[SHAPE.all_blocks]] * BLOCK_NODES):
        global_block = block[shape[SHAPE.all_blocks] + (n >> 6)]
        if n & 63 == 0:
            block[global_block] = 0
        _update_node(
            global_block * BLOCK_NODES + (n & 63), global_block, scene_value, setting, shape, node, contact,
            contact_normal, variant,
        )  # fmt: skip

    for p in range(position.shape[0]):
        scene = label[p] >> 2
        step = scene_value[scene, VALUE.time_step]
        if step > 0.0:
            _grid_to_particle(p, scene, step, position, velocity, affine, node, scene_value, counter, setting, shape)


@ti.kernel
def start(
    velocity: Vectors,
    affine: Matrices,
    deformation: Matrices,
    volume: Scalars,
    label: Integers,
    scene_value: ti.types.ndarray(dtype=ti.f32, ndim=2),
    setting: Scalars,
):
    """Particles at rest shape, and the maxima that the first time step needs."""
    for p in range(velocity.shape[0]):
        scene = label[p] >> 2
        material = label[p] & 3
        affine[p] = ti.Matrix.zero(ti.f32, 3, 3)
        if p < deformation.shape[0]:
            deformation[p] = ti.Matrix.identity(ti.f32, 3)
        volume[p] = 1.0
        stiffness = 3.0 * setting[CONSTANT.bulk]
        if material != WATER:
            stiffness += 2.0 * setting[CONSTANT.shear]
            if material == SNOW:
                stiffness *= hardening(1.0, setting)
            else:
                volume[p] = 0.0
        _raise_maximum(scene_value, scene, VALUE.stiffness, stiffness)
        speed_square = velocity[p].dot(velocity[p])
        _raise_maximum(scene_value, scene, VALUE.speed_square, speed_square)
        _raise_maximum(scene_value, scene, VALUE.largest_speed_square, speed_square)


@ti.kernel
def begin_frame(
    frame_s: ti.f32,
    scene_value: ti.types.ndarray(dtype=ti.f32, ndim=2),
    counter: ti.types.ndarray(dtype=ti.i64, ndim=2),
):
    """Gives every running scene a frame's time."""
    for scene in range(scene_value.shape[0]):
        counter[scene, COUNT.frame_substeps] = ti.cast(0, ti.i64)
        if counter[scene, COUNT.status] == STATUS.running:
            scene_value[scene, VALUE.remaining] = frame_s
