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
from datagen.mpm.layout import BLOCK, BLOCK_NODES, CONSTANT, COUNT, SETTING, STATE, STATUS, VALUE
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
    scene_state: ti.template(),
    counter: ti.template(),
    constant: ti.template(),
    setting: ti.template(),
    dx: ti.f32,
    maximum_substeps: ti.i32,
):
    step = 0.0
    remaining = scene_value[scene, VALUE.remaining]
    if remaining > 0.0 and scene_state[scene, STATE.status] == STATUS.running:
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
            limit = setting[SETTING.stability_fraction] * dx * ti.sqrt(constant[CONSTANT.density] / stiffness)
            # the fall within the step counts too
            speed = ti.sqrt(speed_square) + gravity.norm() * ti.min(limit, remaining)
            limit = ti.min(limit, setting[SETTING.speed_fraction] * dx / ti.max(speed, 1e-20))
        # equal steps to the end of the frame: no sliver at its end
        ahead = ti.max(ti.ceil(ti.min(remaining / limit, 1e9) - 1e-4), 1.0)
        done = scene_state[scene, STATE.frame_substeps]
        if fixed > 0.0:
            ahead = setting[SETTING.fixed_substeps] - ti.cast(done, ti.f32)
        if not ahead <= ti.cast(maximum_substeps - done, ti.f32):
            scene_state[scene, STATE.status] = STATUS.too_many_substeps
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
            scene_state[scene, STATE.frame_substeps] = done + 1
            counter[scene, COUNT.substeps] += ti.cast(1, ti.i64)
            # maxima are gathered anew while the step runs
            scene_value[scene, VALUE.stiffness] = 0.0
            scene_value[scene, VALUE.speed_square] = 0.0
    scene_value[scene, VALUE.time_step] = step


@ti.func
def _mark(
    x,
    scene: ti.i32,
    inverse_dx: ti.f32,
    blocks_y: ti.i32,
    blocks_z: ti.i32,
    scene_blocks: ti.i32,
    flag: ti.template(),
    touched: ti.template(),
    touched_count: ti.template(),
):
    """Adds the blocks that the particle's nodes lie in, up to eight, to the list."""
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
            block = scene * scene_blocks + (corner[0] * blocks_y + corner[1]) * blocks_z + corner[2]
            if flag[block] == 0:
                if ti.atomic_max(flag[block], 1) == 0:
                    touched[ti.atomic_add(touched_count[0], 1)] = block


@ti.func
def _particle_to_grid(
    p: ti.i32,
    first_node: ti.i32,
    step: ti.f32,
    scene: ti.i32,
    dx: ti.f32,
    inverse_dx: ti.f32,
    stride_x: ti.i32,
    stride_y: ti.i32,
    position: ti.template(),
    velocity: ti.template(),
    affine: ti.template(),
    deformation: ti.template(),
    volume: ti.template(),
    material: ti.template(),
    node: ti.template(),
    scene_value: ti.template(),
    counter: ti.template(),
    constant: ti.template(),
    has_water: ti.template(),
    has_sand: ti.template(),
    has_snow: ti.template(),
    taichi_elements_sand: ti.template(),
    atomic: ti.template(),
):
    C = affine[p]
    # -dt V0 (4 / dx^2) stress / mass, with V0 / mass = 1 / density
    scale = -step * 4.0 * inverse_dx * inverse_dx / constant[CONSTANT.density]
    A = C
    if ti.static(has_water):
        if ti.static(not (has_sand or has_snow)) or material[p] == WATER:
            J, pressure, stiffness = water(volume[p], step * C.trace(), constant, counter, scene)
            volume[p] = J
            for i in ti.static(range(3)):
                A[i, i] += scale * pressure
            _raise_maximum(scene_value, scene, VALUE.stiffness, stiffness)
    if ti.static(has_sand or has_snow):
        if ti.static(not has_water) or material[p] != WATER:
            F = deformation[p]
            F += step * (C @ F)
            new_F, new_volume, stress, stiffness = solid(
                F, volume[p], material[p], constant, counter, scene, has_sand, has_snow, taichi_elements_sand
            )
            deformation[p] = new_F
            volume[p] = new_volume
            A += scale * stress
            _raise_maximum(scene_value, scene, VALUE.stiffness, stiffness)

    x = position[p] * inverse_dx
    base = ti.floor(x - 0.5, ti.i32)
    fx = x - ti.cast(base, ti.f32)
    w0, w1, w2 = _weights(fx)
    index_x = [first_node + _node_of_axis(base[0] + i, stride_x, 16) for i in ti.static(range(3))]
    index_y = [_node_of_axis(base[1] + i, stride_y, 4) for i in ti.static(range(3))]
    index_z = [_node_of_axis(base[2] + i, 64, 1) for i in ti.static(range(3))]
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
            if ti.static(atomic):
                ti.atomic_add(node[target], share)
            else:
                old = node[target]
                node[target] = old + share


@ti.func
def _meet_collider(v, normal, kind: ti.i32, friction: ti.f32):
    """Contact of a node: separation is free, approach keeps the tangential part less Coulomb friction."""
    out = v
    along = v.dot(normal)
    if kind == 2 or along < 0.0:  # kind 2: on a sheet, which stops motion both ways
        tangential = v - along * normal
        speed = tangential.norm()
        keep = 1.0
        if friction > 0.0:
            keep = ti.max(0.0, 1.0 - friction * ti.abs(along) / ti.max(speed, 1e-20))
        out = tangential * keep
    return out


@ti.kernel
def substep(
    scenes: ti.i32,
    particles: ti.i32,
    nodes_x: ti.i32,
    nodes_y: ti.i32,
    nodes_z: ti.i32,
    wall_cells: ti.i32,
    sticky_walls: ti.i32,
    maximum_substeps: ti.i32,
    dx: ti.f32,
    inverse_dx: ti.f32,
    position: Vectors,
    velocity: Vectors,
    affine: Matrices,
    deformation: Matrices,
    volume: Scalars,
    material: ti.types.ndarray(dtype=ti.u8, ndim=1),
    scene_of: Integers,
    part_begin: Integers,
    scene_value: ti.types.ndarray(dtype=ti.f32, ndim=2),
    scene_state: ti.types.ndarray(dtype=ti.i32, ndim=2),
    counter: ti.types.ndarray(dtype=ti.i64, ndim=2),
    constant: Scalars,
    setting: Scalars,
    node: Nodes,
    flag: Integers,
    touched: Integers,
    touched_count: Integers,
    contact: Integers,
    contact_normal: Vectors,
    contact_kind: ti.types.ndarray(dtype=ti.u8, ndim=1),
    has_water: ti.template(),
    has_sand: ti.template(),
    has_snow: ti.template(),
    has_contact: ti.template(),
    taichi_elements_sand: ti.template(),
    parts: ti.template(),
    atomic: ti.template(),
):
    """Advances every scene that has time left by one substep of its own length.

    Order: time step, mark and clear blocks, particles to grid (deformation, plasticity, stress), gravity,
    colliders, walls, grid to particles, advection. `node` [parts * scenes * blocks * 64] holds `parts` copies.
    """
    for scene in range(scenes):
        _choose_time_step(scene, scene_value, scene_state, counter, constant, setting, dx, maximum_substeps)
        if scene == 0:
            touched_count[0] = 0

    for p in range(particles):
        scene = scene_of[p]
        if scene_value[scene, VALUE.time_step] > 0.0:
            blocks_y = (nodes_y + 3) // 4
            blocks_z = (nodes_z + 3) // 4
            scene_blocks = (nodes_x + 3) // 4 * blocks_y * blocks_z
            _mark(position[p], scene, inverse_dx, blocks_y, blocks_z, scene_blocks, flag, touched, touched_count)

    for n in range(touched_count[0] * BLOCK_NODES):
        blocks = scenes * ((nodes_x + 3) // 4) * ((nodes_y + 3) // 4) * ((nodes_z + 3) // 4)
        place = touched[n >> 6] * BLOCK_NODES + (n & 63)
        for part in ti.static(range(parts)):
            node[place + part * blocks * BLOCK_NODES] = ti.Vector([0.0, 0.0, 0.0, 0.0])

    if ti.static(atomic):
        for p in range(particles):
            scene = scene_of[p]
            step = scene_value[scene, VALUE.time_step]
            if step > 0.0:
                blocks_y = (nodes_y + 3) // 4
                blocks_z = (nodes_z + 3) // 4
                scene_nodes = (nodes_x + 3) // 4 * blocks_y * blocks_z * BLOCK_NODES
                _particle_to_grid(
                    p, scene * scene_nodes, step, scene, dx, inverse_dx, blocks_y * blocks_z * 64, blocks_z * 64,
                    position, velocity, affine, deformation, volume, material, node, scene_value, counter,
                    constant, has_water, has_sand, has_snow, taichi_elements_sand, atomic,
                )  # fmt: skip
    else:
        for task in range(scenes * parts):
            scene = task // parts
            step = scene_value[scene, VALUE.time_step]
            if step > 0.0:
                blocks_y = (nodes_y + 3) // 4
                blocks_z = (nodes_z + 3) // 4
                scene_nodes = (nodes_x + 3) // 4 * blocks_y * blocks_z * BLOCK_NODES
                copy = (task - scene * parts) * scenes
                for p in range(part_begin[task], part_begin[task + 1]):
                    _particle_to_grid(
                        p, (copy + scene) * scene_nodes, step, scene, dx, inverse_dx, blocks_y * blocks_z * 64,
                        blocks_z * 64, position, velocity, affine, deformation, volume, material, node,
                        scene_value, counter, constant, has_water, has_sand, has_snow, taichi_elements_sand,
                        atomic,
                    )  # fmt: skip

    for n in range(touched_count[0] * BLOCK_NODES):
        blocks_y = (nodes_y + 3) // 4
        blocks_z = (nodes_z + 3) // 4
        scene_blocks = (nodes_x + 3) // 4 * blocks_y * blocks_z
        global_block = touched[n >> 6]
        local = n & 63
        if local == 0:
            flag[global_block] = 0
        place = global_block * BLOCK_NODES + local
        total = node[place]
        for part in ti.static(range(1, parts)):
            total += node[place + part * scenes * scene_blocks * BLOCK_NODES]
        v = ti.Vector([0.0, 0.0, 0.0])
        if total[3] > SMALLEST_MASS:
            scene = global_block // scene_blocks
            block = global_block - scene * scene_blocks
            step = scene_value[scene, VALUE.time_step]
            gravity = ti.Vector([scene_value[scene, VALUE.gravity + i] for i in range(3)])
            v = ti.Vector([total[0], total[1], total[2]]) / total[3] + step * gravity
            if ti.static(has_contact):
                entry = contact[place]
                if entry >= 0:
                    friction = setting[SETTING.friction]
                    v = _meet_collider(v, contact_normal[entry], ti.cast(contact_kind[entry], ti.i32), friction)
            # walls last: whatever a collider leaves, nothing leaves the domain
            index = ti.Vector(
                [
                    block // (blocks_y * blocks_z) * BLOCK + local // 16,
                    block // blocks_z % blocks_y * BLOCK + local // 4 % 4,
                    block % blocks_z * BLOCK + local % 4,
                ]
            )
            nodes = ti.Vector([nodes_x, nodes_y, nodes_z])
            stuck = 0
            for axis in ti.static(range(3)):
                if index[axis] < wall_cells:
                    v[axis] = ti.max(v[axis], 0.0)
                    stuck = 1
                if index[axis] >= nodes[axis] - wall_cells:
                    v[axis] = ti.min(v[axis], 0.0)
                    stuck = 1
            if stuck and sticky_walls:
                v = ti.Vector([0.0, 0.0, 0.0])
        node[place] = ti.Vector([v[0], v[1], v[2], total[3]])

    for p in range(particles):
        scene = scene_of[p]
        step = scene_value[scene, VALUE.time_step]
        if step > 0.0:
            blocks_y = (nodes_y + 3) // 4
            blocks_z = (nodes_z + 3) // 4
            scene_nodes = (nodes_x + 3) // 4 * blocks_y * blocks_z * BLOCK_NODES
            x = position[p]
            scaled = x * inverse_dx
            base = ti.floor(scaled - 0.5, ti.i32)
            fx = scaled - ti.cast(base, ti.f32)
            w0, w1, w2 = _weights(fx)
            w = ti.static((w0, w1, w2))
            index_x = [
                scene * scene_nodes + _node_of_axis(base[0] + i, blocks_y * blocks_z * 64, 16)
                for i in ti.static(range(3))
            ]
            index_y = [_node_of_axis(base[1] + i, blocks_z * 64, 4) for i in ti.static(range(3))]
            index_z = [_node_of_axis(base[2] + i, 64, 1) for i in ti.static(range(3))]
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
                scene_state[scene, STATE.status] = STATUS.not_finite
                scene_value[scene, VALUE.remaining] = 0.0
            elif outside:
                # a value that is not finite is the better cause to report
                if scene_state[scene, STATE.status] != STATUS.not_finite:
                    scene_state[scene, STATE.status] = STATUS.left_domain
                scene_value[scene, VALUE.remaining] = 0.0
            else:
                count_event(counter, scene, COUNT.position_clamps, clamps)
                _raise_maximum(scene_value, scene, VALUE.speed_square, speed_square)
                _raise_maximum(scene_value, scene, VALUE.largest_speed_square, speed_square)
            position[p] = x
            velocity[p] = v
            affine[p] = C


@ti.kernel
def start(
    particles: ti.i32,
    velocity: Vectors,
    affine: Matrices,
    deformation: Matrices,
    volume: Scalars,
    material: ti.types.ndarray(dtype=ti.u8, ndim=1),
    scene_of: Integers,
    scene_value: ti.types.ndarray(dtype=ti.f32, ndim=2),
    constant: Scalars,
    has_solid: ti.template(),
):
    """Particles at rest shape, and the maxima that the first time step needs."""
    for p in range(particles):
        scene = scene_of[p]
        affine[p] = ti.Matrix.zero(ti.f32, 3, 3)
        if ti.static(has_solid):
            deformation[p] = ti.Matrix.identity(ti.f32, 3)
        volume[p] = 1.0
        stiffness = 3.0 * constant[CONSTANT.bulk]
        if material[p] != WATER:
            stiffness += 2.0 * constant[CONSTANT.shear]
            if material[p] == SNOW:
                stiffness *= hardening(1.0, constant)
            else:
                volume[p] = 0.0
        _raise_maximum(scene_value, scene, VALUE.stiffness, stiffness)
        speed_square = velocity[p].dot(velocity[p])
        _raise_maximum(scene_value, scene, VALUE.speed_square, speed_square)
        _raise_maximum(scene_value, scene, VALUE.largest_speed_square, speed_square)


@ti.kernel
def begin_frame(
    scenes: ti.i32,
    frame_s: ti.f32,
    scene_value: ti.types.ndarray(dtype=ti.f32, ndim=2),
    scene_state: ti.types.ndarray(dtype=ti.i32, ndim=2),
):
    """Gives every running scene a frame's time."""
    for scene in range(scenes):
        scene_state[scene, STATE.frame_substeps] = 0
        if scene_state[scene, STATE.status] == STATUS.running:
            scene_value[scene, VALUE.remaining] = frame_s
