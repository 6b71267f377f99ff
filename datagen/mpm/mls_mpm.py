"""The parts of a substep of explicit MLS-MPM, for Taichi kernels: grid_kernel and team_kernel are made of them.

APIC transfers with quadratic B-splines (Jiang et al. 2015; Hu et al. 2018): a particle at x touches the nodes
base .. base + 2 with base = floor(x / dx - 1/2); node I lies at I dx. Nodes are stored by blocks of 4 x 4 x 4,
[scene, block, node in block]. Only blocks that a particle touches are updated; what particles give to nodes is added
up apart from the nodes' velocities. Masses are in units of a particle of the config's density.

Transfers come at a rate of their own, since each smooths velocities: an interval between two holds as many substeps
as the stiffest particle needs. Where that is three or more, or something so fast that the interval is shorter for it,
and the time step adaptive, the interval is synchronised: it has one substep more, and its first and last are half as
long as the others. Stress then acts from half a step before to half a step after the time that it is of, so that
transfers find velocities of the same time as stresses (velocity Verlet). Were velocities half a step ahead, their
smoothing would feed oscillations of half a period an interval, whose energy could double in each.

Where an interval that is not synchronised ends, strain is a step behind and velocity half a step. The first substep of
a synchronised one that follows makes up for both (VALUE.catch_up); where it is the other way round, the first substep
of the one that follows strains nothing, and its stress acts for half of it.

In an interval's first substep particles give mass and momentum to the nodes and force; in the others they stay where
they are on the grid, take the gradient of the nodes' velocities for strain and stress, and give force alone, as in the
Lagrangian phase of the classical method (Sulsky et al. 1994). After the last they take velocity and gradient, and move
by the interval times that velocity: momentum and angular momentum are kept, as stresses are symmetric and each particle
moves along its velocity. Within an interval no velocity is smoothed. Which particles find a new stress in a substep is
the subject of multiple_time_stepping.

Positions belong to the ends of intervals, velocities to their middles (leapfrog): gravity acts for half the last and
half the present interval, at first for half of the first, so that free fall is v t + g t² / 2 at the end of each,
whatever their lengths. Only gravity is known that far ahead; stresses and contacts act as in the symplectic Euler
scheme, which Taichi Elements has for gravity too.

Everything is per scene: time step, interval, remaining time, state, counters. A scene that is done, or failed, idles.
"""

import taichi as ti

from datagen.mpm.constitutive import (
    STIFFENING_MARGIN,
    count_event,
    hardening,
    settled,
    solid,
    water,
)
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
    has_solid,
)
from datagen.mpm.surface_kernel import MOVING_NODE_VECTORS, NODE_VECTORS, hidden_nodes, meet, stop_at_surface
from hgn.scene.material import FLUIDS, SNOW

SMALLEST_MASS = 1e-10  # of a particle; lighter nodes are at the rounding of the weights

Scalars = ti.types.ndarray(dtype=ti.f32, ndim=1)
Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)
Vectors = ti.types.ndarray(dtype=ti.types.vector(3, ti.f32), ndim=1)
Matrices = ti.types.ndarray(dtype=ti.types.matrix(3, 3, ti.f32), ndim=1)
Nodes = ti.types.ndarray(dtype=ti.types.vector(4, ti.f32), ndim=1)


@ti.func
def weights(fx):
    """Quadratic B-spline weights of nodes 0, 1, 2 for an offset fx in [0.5, 1.5) cells, per axis."""
    return (
        0.5 * (1.5 - fx) ** 2,
        0.75 - (fx - 1.0) ** 2,
        0.5 * (fx - 0.5) ** 2,
    )


@ti.func
def spline(distance: ti.f32) -> ti.f32:
    """The weight of a node from the distance to it along one axis, in (-1.5, 1.5) cells."""
    away = ti.abs(distance)
    outer = 1.5 - away
    return 0.75 - away * away if away < 0.5 else 0.5 * outer * outer


@ti.func
def _node_of_axis(index, stride: ti.i32, local_stride: ti.i32):
    """What a node's index along one axis adds to its place in an array; those of the three axes add up."""
    return (index >> 2) * stride + (index & 3) * local_stride


@ti.func
def base_node(x, inverse_dx: ti.f32):
    return ti.floor(x * inverse_dx - 0.5, ti.i32)


@ti.func
def _not_finite(value) -> ti.i32:
    return (ti.bit_cast(value, ti.i32) & 0x7F800000) == 0x7F800000


@ti.func
def mark(
    x,
    scene: ti.i32,
    inverse_dx: ti.f32,
    shape: ti.template(),
    block: ti.template(),
    list_begin: ti.i32,
    length: ti.template(),
    length_at: ti.i32,
):
    """Adds the blocks that the particle's nodes lie in, up to eight, to a list.

    `block` begins with a flag for each of the all_blocks blocks of all scenes. From `list_begin` on it lists the
    indices of touched ones, length[length_at] of them; all_blocks after each entry lies its block's place along x, y,
    z, in ten bits each.
    """
    base = base_node(x, inverse_dx)
    first = base >> 2
    last = (base + 2) >> 2
    corner = ti.Matrix([[last[axis] if n >> (2 - axis) & 1 else first[axis] for axis in range(3)] for n in range(8)])
    index = ti.Vector(
        [
            scene * shape[SHAPE.scene_blocks]
            + (corner[n, 0] * shape[SHAPE.blocks + 1] + corner[n, 1]) * shape[SHAPE.blocks + 2]
            + corner[n, 2]
            for n in range(8)
        ]
    )
    flag = ti.Vector([block[index[n]] for n in range(8)])  # all at once: each is a way to memory
    for n in ti.static(range(8)):
        fresh = flag[n] == 0
        for axis in ti.static(range(3)):
            if ti.static(bool(n >> (2 - axis) & 1)):
                fresh = fresh and first[axis] != last[axis]
        if fresh:
            if ti.atomic_max(block[index[n]], 1) == 0:
                entry = list_begin + ti.atomic_add(length[length_at], 1)
                block[entry] = index[n]
                block[entry + shape[SHAPE.all_blocks]] = (corner[n, 0] << 20) | (corner[n, 1] << 10) | corner[n, 2]


@ti.func
def node_places(base, first_entry: ti.i32, shape: ti.template(), entries: ti.template()):
    """Where nodes base .. base + 2 lie in an array of `entries` numbers a node, by axis: node base + (i, j, k) begins
    at the sum of the first result's i, the second's j and the third's k. The scene's nodes begin at `first_entry`.
    """
    stride_z = BLOCK_NODES * entries
    stride_y = shape[SHAPE.blocks + 2] * stride_z
    stride_x = shape[SHAPE.blocks + 1] * stride_y
    offset = ti.Vector([0, 1, 2])
    return (
        first_entry + _node_of_axis(base[0] + offset, stride_x, BLOCK * BLOCK * entries),
        _node_of_axis(base[1] + offset, stride_y, BLOCK * entries),
        _node_of_axis(base[2] + offset, stride_z, entries),
    )


@ti.func
def respond(
    C,
    stretch,
    F,
    volume: ti.f32,
    material: ti.i32,
    row: ti.i32,
    step: ti.f32,
    scene: ti.i32,
    counter: ti.template(),
    setting: ti.template(),
    law: ti.template(),
    variant: ti.template(),
):
    """The material's answer to a step of `step` seconds with the velocity gradient C, 1/s.

    Particles stay where the interval began, so C is a gradient by positions of then. By those of now it is
    C - (C + Cᵀ) / 2 stretch, in first order of `stretch`, the sum of dt (C + Cᵀ) / 2 over the interval's steps so far.
    With it the steps of an interval together stretch F as one step would.

    Returns the response, - V0 (4 / dx²) stress / mass, by which stress changes APIC's C in a second; the new stretch
    and F, both as they were for water; the new volume (see constitutive); and the present (3 lambda + 2 mu) / density,
    m²/s².
    """
    has_water = ti.static(bool(variant & VARIANT.water))
    solids = ti.static(has_solid(variant))
    inverse_dx = setting[SETTING.inverse_cell_size]
    density = law[row + CONSTANT.density]
    scale = -4.0 * inverse_dx * inverse_dx / density  # V0 / mass = 1 / density
    response = ti.Matrix.zero(ti.f32, 3, 3)
    new_stretch = stretch
    new_F = F
    new_volume = volume
    stiffness = 0.0
    if ti.static(has_water):
        if ti.static(not solids) or is_fluid(material):
            expansion = step * C.trace()
            if ti.static(bool(variant & VARIANT.taichi_elements_water)):
                expansion = (ti.Matrix.identity(ti.f32, 3) + step * C).determinant() - 1.0
            J, pressure, water_stiffness = water(
                volume, expansion, law, row, counter, scene, ti.static(bool(variant & VARIANT.stiffening_water))
            )
            new_volume = J
            if ti.static(bool(variant & VARIANT.stiffening_water)):
                water_stiffness *= STIFFENING_MARGIN if J < 1.0 else 1.0
            stiffness = water_stiffness
            viscosity = law[row + CONSTANT.viscosity]
            if viscosity > 0.0:
                rate = 0.5 * (C + C.transpose())
                response += scale * 2.0 * viscosity * J * (rate - C.trace() / 3.0 * ti.Matrix.identity(ti.f32, 3))
                # the shear of a lone particle is reversed, no smaller, by a step of rho dx² / (4 viscosity)
                rough = ti.sqrt(water_stiffness) + 4.0 * viscosity * inverse_dx / ti.sqrt(density)
                stiffness = rough * rough
            for i in ti.static(range(3)):
                response[i, i] += scale * pressure
    if ti.static(solids):
        if ti.static(not has_water) or not is_fluid(material):
            rate = 0.5 * (C + C.transpose())
            new_stretch = stretch + step * rate
            gradient = C - rate @ stretch
            trial_F = F + step * (gradient @ F)
            solid_F, solid_volume, stress, solid_stiffness = solid(
                trial_F,
                volume,
                material,
                law,
                row,
                counter,
                scene,
                variant,
                step,
            )
            new_F = solid_F
            new_volume = solid_volume
            stiffness = solid_stiffness
            response += scale * stress
    return response, new_stretch, new_F, new_volume, stiffness / density


@ti.func
def node_velocity(
    before,
    momentum,
    mass: ti.f32,
    local: ti.i32,
    facing: ti.i32,
    corner: ti.i32,
    fall,
    scene: ti.i32,
    scene_value: ti.template(),
    shape: ti.template(),
    contact_normal: ti.template(),
    variant: ti.template(),
):
    """The new velocity of a node's field: what colliders, then walls, leave of `before` + `momentum` / `mass` + `fall`;
    the momentum is what came to it, `fall` is gravity's. 0 where the mass is at the rounding of the weights.

    The node is the `local` one of a block whose place along x, y, z is `corner`, in ten bits each. `facing` is twice
    the node's entry in `contact_normal`, plus 1 for its second field, or less than 0 where no collider is.
    """
    v = ti.Vector([0.0, 0.0, 0.0])
    if mass > SMALLEST_MASS:
        v = before + momentum / mass + fall
        if ti.static(bool(variant & VARIANT.contact)):
            if facing >= 0:
                entry = facing // 2
                field = facing - 2 * entry
                moving = ti.static(bool(variant & VARIANT.moving))
                at = ti.static(MOVING_NODE_VECTORS if moving else NODE_VECTORS) * entry
                friction = contact_normal[at + 2][0]
                least = contact_normal[at + 3][0]
                if field == 1:
                    friction = contact_normal[at + 2][1]
                    least = contact_normal[at + 3][1]
                if mass >= least:
                    if ti.static(moving):
                        surface = contact_normal[at + 4 + field]
                        v = meet(v - surface, contact_normal[at + field], friction) + surface
                    else:
                        v = meet(v, contact_normal[at + field], friction)
        # walls last: whatever a collider leaves, nothing leaves the domain
        index = ti.Vector(
            [
                (corner >> 20) * BLOCK + (local >> 4),
                ((corner >> 10) & 1023) * BLOCK + ((local >> 2) & 3),
                (corner & 1023) * BLOCK + (local & 3),
            ]
        )
        wall_cells = shape[SHAPE.wall_cells]
        stuck = 0
        for axis in ti.static(range(3)):
            outward = 0.0
            if index[axis] < wall_cells:
                outward = -1.0
            if index[axis] >= shape[SHAPE.nodes + axis] - wall_cells:
                outward = 1.0
            if outward != 0.0:
                stuck = 1
                normal = ti.Vector([0.0, 0.0, 0.0])
                normal[axis] = -outward
                v = meet(v, normal, scene_value[scene, VALUE.wall_friction + axis])
        if stuck and shape[SHAPE.sticky_walls]:
            v = ti.Vector([0.0, 0.0, 0.0])
    return v


@ti.func
def interpolate(x, first_node: ti.i32, node: ti.template(), inverse_dx: ti.f32, shape: ti.template()):
    """The velocity at x from the nodes around, and its gradient, APIC's C, 1/s. The scene's begin at `first_node`."""
    scaled = x * inverse_dx
    base = ti.floor(scaled - 0.5, ti.i32)
    fx = scaled - ti.cast(base, ti.f32)
    w0, w1, w2 = weights(fx)
    w = ti.static((w0, w1, w2))
    index_x, index_y, index_z = node_places(base, first_node, shape, 1)
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
                whole = node[index_x[i] + index_y[j] + index_z[k]]
                share = w[k][2] * ti.Vector([whole[0], whole[1], whole[2]])
                line += share
                line_z += (k - fx[2]) * share
            plane += w[j][1] * line
            plane_y += w[j][1] * (j - fx[1]) * line
            plane_z += w[j][1] * line_z
        v += w[i][0] * plane
        gradient_x += w[i][0] * (i - fx[0]) * plane
        gradient_y += w[i][0] * plane_y
        gradient_z += w[i][0] * plane_z
    return v, ti.Matrix.cols([gradient_x, gradient_y, gradient_z]) * (4.0 * inverse_dx)


@ti.func
def _room(fx, base: ti.i32, axis: ti.template(), shape: ti.template()) -> ti.f32:
    """The share of a particle's nodes, by weight, that lies between the walls of an axis; of each node the share of its
    own spline that does.
    """
    w0, w1, w2 = weights(fx)
    wall = shape[SHAPE.wall_cells]
    room = 0.0
    for offset, w in ti.static(((0, w0), (1, w1), (2, w2))):
        # in cells within the wall; a node's own spline reaches 1.5 cells
        depth = ti.min(base + offset - (wall - 1), shape[SHAPE.nodes + axis] - wall - base - offset)
        share = 1.0
        if depth == 1:
            share = 47.0 / 48.0
        elif depth == 0:
            share = 0.5
        elif depth == -1:
            share = 1.0 / 48.0
        elif depth < -1:
            share = 0.0
        room += share * w
    return room


@ti.func
def settles(scene: ti.i32, scene_value: ti.template(), setting: ti.template()) -> ti.i32:
    """Whether the water of a scene follows its density."""
    return scene_value[scene, VALUE.water_density] > 0.0 and setting[SETTING.density_relaxation] > 0.0


@ti.func
def settle(
    x,
    volume: ti.f32,
    mass: ti.f32,
    scene: ti.i32,
    scene_value: ti.template(),
    setting: ti.template(),
    shape: ti.template(),
) -> ti.f32:
    """J of a particle of water after an interval, nearer to what its density tells: that of the nodes around, whose
    masses are interpolated to `mass`.
    """
    scaled = x * setting[SETTING.inverse_cell_size]
    base = ti.floor(scaled - 0.5, ti.i32)
    fx = scaled - ti.cast(base, ti.f32)
    room = _room(fx[0], base[0], 0, shape) * _room(fx[1], base[1], 1, shape) * _room(fx[2], base[2], 2, shape)
    share = scene_value[scene, VALUE.interval_elapsed] * setting[SETTING.density_relaxation]
    density = mass / (scene_value[scene, VALUE.water_density] * ti.max(room, 0.1))
    return settled(volume, density, ti.min(share, 1.0))


@ti.func
def node_place(index, scene: ti.i32, shape: ti.template()) -> ti.i32:
    """Where a node's entry lies in arrays that hold one for each node."""
    block = index >> 2
    local = index & 3
    place = (block[0] * shape[SHAPE.blocks + 1] + block[1]) * shape[SHAPE.blocks + 2] + block[2]
    place = (scene * shape[SHAPE.scene_blocks] + place) * BLOCK_NODES
    return place + (local[0] * BLOCK + local[1]) * BLOCK + local[2]


@ti.func
def _triangle_list(x, scene: ti.i32, contact: ti.template(), setting: ti.template(), shape: ti.template()) -> ti.i32:
    """Where the list of triangles near a particle begins in `contact`, or -1."""
    base = base_node(x, setting[SETTING.inverse_cell_size])
    return contact[shape[SHAPE.all_blocks] * BLOCK_NODES + node_place(base, scene, shape)]


@ti.func
def find_hidden(
    x,
    scene: ti.i32,
    elapsed: ti.f32,
    contact: ti.template(),
    contact_normal: ti.template(),
    setting: ti.template(),
    shape: ti.template(),
    variant: ti.template(),
) -> ti.i32:
    """Which of a particle's nodes sheets hide from it, in bits (see surface_kernel.hidden_nodes). A node's second field
    is shared by all particles that it is hidden from. Contacts that move were placed `elapsed` seconds ago.
    """
    bits = 0
    list_at = _triangle_list(x, scene, contact, setting, shape)
    if list_at >= 0:
        moving = ti.static(bool(variant & VARIANT.moving))
        scaled = x * setting[SETTING.inverse_cell_size]
        bits = hidden_nodes(scaled, list_at, elapsed, contact, contact_normal, moving)
    return bits


@ti.func
def ghost_place(index, scene: ti.i32, contact: ti.template(), shape: ti.template()) -> ti.i32:
    """Where a node's second field lies, in numbers of nodes."""
    return shape[SHAPE.ghost_begin] + contact[node_place(index, scene, shape)]


@ti.func
def interpolate_hidden(
    x,
    v,
    C,
    hidden: ti.i32,
    scene: ti.i32,
    node: ti.template(),
    inverse_dx: ti.f32,
    shape: ti.template(),
    contact: ti.template(),
):
    """The v and C that `interpolate` gave, with the second fields of hidden nodes in place of their first."""
    scaled = x * inverse_dx
    base = ti.floor(scaled - 0.5, ti.i32)
    new_v = v
    new_C = C
    bits = hidden
    n = 0
    while bits != 0:
        if bits & 1:
            index = base + ti.Vector([n // 9, n // 3 % 3, n % 3])
            offset = ti.cast(index, ti.f32) - scaled
            place = node_place(index, scene, shape)
            difference = node[shape[SHAPE.ghost_begin] + contact[place]] - node[place]
            change = ti.Vector([difference[0], difference[1], difference[2]])
            change *= spline(offset[0]) * spline(offset[1]) * spline(offset[2])
            new_v += change
            new_C += (4.0 * inverse_dx) * change.outer_product(offset)
        bits >>= 1
        n += 1
    return new_v, new_C


@ti.func
def move(
    x,
    v,
    C,
    scene: ti.i32,
    scene_value: ti.template(),
    counter: ti.template(),
    setting: ti.template(),
    shape: ti.template(),
    contact: ti.template(),
    contact_normal: ti.template(),
    variant: ti.template(),
):
    """The particle's position and velocity at the end of an interval, as triangles and bounds leave them, and v².

    What is not finite, or leaves the domain, stops its scene; v² is 0 then.
    """
    out = x + scene_value[scene, VALUE.interval_elapsed] * v
    speed = v
    if ti.static(bool(variant & VARIANT.sweep)):
        list_at = _triangle_list(x, scene, contact, setting, shape)
        if list_at >= 0:
            moving = ti.static(bool(variant & VARIANT.moving))
            interval = scene_value[scene, VALUE.interval_elapsed]
            elapsed = 0.0
            if ti.static(moving):
                elapsed = scene_value[scene, VALUE.part] - scene_value[scene, VALUE.remaining] - interval
            out, speed = stop_at_surface(
                x, out, v, list_at, elapsed, interval, scene, contact, contact_normal, counter, setting, moving
            )
    speed_square = speed.dot(speed)
    bad = _not_finite(speed_square) | _not_finite(out.sum()) | _not_finite(C.sum())
    outside = 0
    clamps = 0
    for axis in ti.static(range(3)):
        low = setting[SETTING.low + axis]
        high = setting[SETTING.high + axis]
        if not (out[axis] >= 0.0 and out[axis] <= setting[SETTING.size + axis]):
            outside = 1
        if not out[axis] >= low:
            out[axis] = low
            clamps = 1
        if not out[axis] <= high:
            out[axis] = high
            clamps = 1
    if bad:
        counter[scene, COUNT.status] = ti.cast(STATUS.not_finite, ti.i64)
        scene_value[scene, VALUE.remaining] = 0.0
        speed_square = 0.0
    elif outside:
        # a value that is not finite is the better cause to report
        if counter[scene, COUNT.status] != STATUS.not_finite:
            counter[scene, COUNT.status] = ti.cast(STATUS.left_domain, ti.i64)
        scene_value[scene, VALUE.remaining] = 0.0
        speed_square = 0.0
    else:
        count_event(counter, scene, COUNT.position_clamps, clamps)
    return out, speed, speed_square


@ti.func
def is_fluid(material: ti.i32) -> ti.i32:
    """Whether a material has no deformation gradient."""
    result = 0
    for fluid in ti.static(FLUIDS):
        if material == fluid:
            result = 1
    return result


@ti.func
def initial_stiffness(material: ti.i32, law: ti.template(), row: ti.i32) -> ti.f32:
    """(3 lambda + 2 mu) / density of a particle at rest shape."""
    stiffness = 3.0 * law[row + CONSTANT.bulk]
    if not is_fluid(material):
        stiffness += 2.0 * law[row + CONSTANT.shear]
        if material == SNOW:
            stiffness *= hardening(1.0, law, row)
    return stiffness / law[row + CONSTANT.density]
