"""Computes the parts of a substep of explicit MLS-MPM, for the Taichi kernels grid_kernel and team_kernel.

Transfers are APIC with quadratic B-splines (Jiang et al. 2015; Hu et al. 2018). Only blocks of nodes near particles are
updated. Particles' contributions have their own array; the old node velocity is added later (`node_velocity`). Masses
are in units of the mass of a particle with the config's density.

Each transfer smooths velocities, so transfers have a rate of their own. The interval between two transfers contains as
many substeps as the stiffest particle needs. With adaptive steps an interval is synchronised if it needs three or more
substeps, or if a fast particle shortens it. Then it has one more substep, and its first and last substep are half as
long as the others. Stress acts from half a step before to half a step after its time (velocity Verlet). If velocities
were half a step ahead of stresses, oscillations with two periods in an interval could double their energy in it.

At the end of an interval that is not synchronised, strain is one step behind, and velocity half a step. If the next
interval is synchronised, its first substep compensates both (VALUE.catch_up). If an interval that is not synchronised
follows a synchronised one, its first substep skips strain, and the stress of this substep acts for half of it.

In the first substep of an interval particles transfer mass, momentum and force to the nodes. In the other substeps they
stay in place on the grid, compute strain and stress from the gradient of the nodes' velocities, and transfer only
force, as in the Lagrangian phase of the classical method (Sulsky et al. 1994). After the last substep particles take
velocity and gradient from the grid, and move by the interval times the velocity. Momentum and angular momentum are
conserved, because stresses are symmetric and each particle moves along its velocity. multiple_time_stepping chooses the
particles that compute a new stress in a substep.

Positions belong to the ends of intervals, velocities to their middles (leapfrog). Gravity acts for half of the last and
half of the present interval, so free fall is exactly v t + g t² / 2 at the end of each interval. Stresses and contacts
act as in the symplectic Euler scheme, which Taichi Elements uses for gravity too.

Time step, interval, remaining time, state and counters are per scene. Finished and failed scenes idle.
"""

import taichi as ti

from datagen.mpm.body_kernel import first_body, nearest_surface
from datagen.mpm.constitutive import count_event, hardening, settled, solid, water
from datagen.mpm.layout import BLOCK, BLOCK_NODES, CONSTANT, COUNT, SETTING, SHAPE, STATUS, VALUE, VARIANT, has_solid
from datagen.mpm.nodes import base_node, node_place, weights
from datagen.mpm.surface_kernel import NODE_VECTORS, hidden_by_moving, hidden_nodes, meet, stop_at_surface
from hgn.scene.material import FLUIDS, SNOW

SMALLEST_MASS = 1e-10  # smallest mass of a node with a velocity, in particles; smaller ones are rounding of the weights

Scalars = ti.types.ndarray(dtype=ti.f32, ndim=1)
Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)
Vectors = ti.types.ndarray(dtype=ti.types.vector(3, ti.f32), ndim=1)
Matrices = ti.types.ndarray(dtype=ti.types.matrix(3, 3, ti.f32), ndim=1)
Nodes = ti.types.ndarray(dtype=ti.types.vector(4, ti.f32), ndim=1)


@ti.func
def _not_finite(value) -> ti.i32:
    return (ti.bit_cast(value, ti.i32) & 0x7F800000) == 0x7F800000


@ti.func
def respond(
    C, stretch, F, volume: ti.f32, material: ti.i32, row: ti.i32, step: ti.f32, scene: ti.i32, arrays: ti.template()
):
    """Computes a material's response to a step of `step` seconds with the velocity gradient C, 1/s.

    Particles keep the positions that they had when the interval began, so C is the gradient at these. `stretch` is
    the sum of dt (C + Cᵀ) / 2 in the interval so far. The gradient at the present positions is, to first order,
    C - ((C + Cᵀ) / 2) @ stretch. With this gradient the steps of an interval together stretch F as one step would.

    Returns the response, -(V0 4 / dx²) stress / mass: the rate at which stress changes APIC's C; the new stretch and F
    (unchanged for water); the new volume (see constitutive); and the present (3 lambda + 2 mu) / density, m²/s².
    """
    has_water = ti.static(bool(arrays.variant & VARIANT.water))
    solids = ti.static(has_solid(arrays.variant))
    inverse_dx = arrays.setting[SETTING.inverse_cell_size]
    density = arrays.law[row + CONSTANT.density]
    scale = -4.0 * inverse_dx * inverse_dx / density  # V0 / mass = 1 / density
    response = ti.Matrix.zero(ti.f32, 3, 3)
    new_stretch = stretch
    new_F = F
    new_volume = volume
    stiffness = 0.0
    if ti.static(has_water):
        if ti.static(not solids) or is_fluid(material):
            expansion = step * C.trace()
            if ti.static(bool(arrays.variant & VARIANT.taichi_elements)):
                expansion = (ti.Matrix.identity(ti.f32, 3) + step * C).determinant() - 1.0
            J, pressure, water_stiffness = water(volume, expansion, arrays.law, row, arrays.counter, scene)
            new_volume = J
            stiffness = water_stiffness
            viscosity = arrays.law[row + CONSTANT.viscosity]
            if viscosity > 0.0:
                rate = 0.5 * (C + C.transpose())
                response += scale * 2.0 * viscosity * J * (rate - C.trace() / 3.0 * ti.Matrix.identity(ti.f32, 3))
                # the stability limit of viscosity: a step of rho dx² / (4 viscosity) reverses a lone particle's shear
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
                trial_F, volume, material, arrays.law, row, arrays.counter, scene, arrays.variant, step
            )
            new_F = solid_F
            new_volume = solid_volume
            stiffness = solid_stiffness
            response += scale * stress
    return response, new_stretch, new_F, new_volume, stiffness / density


@ti.func
def node_velocity(
    before, momentum, mass: ti.f32, local: ti.i32, facing: ti.i32, corner: ti.i32, fall, scene: ti.i32,
    arrays: ti.template(),
):  # fmt: skip
    """Returns the new velocity of a node's field: `before` + `momentum` / `mass` + `fall` after colliders and walls.

    `momentum` is the sum of contributions, and `fall` the change by gravity. The result is 0 for a mass that is only
    rounding of the weights. The node has number `local` in a block whose coordinates along x, y, z are `corner`, in ten
    bits each. `facing` is twice the node's entry in `contact_normal`, plus 1 for its second field; the entry is -1
    without an obstacle at rest.
    """
    v = ti.Vector([0.0, 0.0, 0.0])
    if mass > SMALLEST_MASS:
        v = before + momentum / mass + fall
        index = ti.Vector(
            [
                (corner >> 20) * BLOCK + (local >> 4),
                ((corner >> 10) & 1023) * BLOCK + ((local >> 2) & 3),
                (corner & 1023) * BLOCK + (local & 3),
            ]
        )
        if ti.static(bool(arrays.variant & VARIANT.contact)):
            field = facing & 1
            normal = ti.Vector([0.0, 0.0, 0.0])
            friction, least, distance = 0.0, 0.0, ti.math.inf
            if facing >= 0:
                at = NODE_VECTORS * (facing >> 1)
                normal = arrays.contact_normal[at + field]
                frictions = arrays.contact_normal[at + 2]
                leasts = arrays.contact_normal[at + 3]
                friction, least, distance = frictions[0], leasts[0], frictions[2]
                if field == 1:
                    friction, least, distance = frictions[1], leasts[1], leasts[2]
            if ti.static(bool(arrays.variant & VARIANT.moving)):
                normal, friction, least, surface = nearest_surface(
                    index, field, normal, friction, least, distance, scene, arrays
                )
                if mass >= least:
                    v = meet(v - surface, normal, friction) + surface
            elif facing >= 0 and mass >= least:
                v = meet(v, normal, friction)
        # walls act last, so that a collider cannot push material out of the domain
        wall_cells = arrays.shape[SHAPE.wall_cells]
        for axis in ti.static(range(3)):
            outward = 0.0
            if index[axis] < wall_cells:
                outward = -1.0
            if index[axis] >= ti.cast(arrays.scene_value[scene, VALUE.nodes + axis], ti.i32) - wall_cells:
                outward = 1.0
            if outward != 0.0:
                normal = ti.Vector([0.0, 0.0, 0.0])
                normal[axis] = -outward
                v = meet(v, normal, arrays.scene_value[scene, VALUE.wall_friction + axis])
    return v


@ti.func
def _room(fx, base: ti.i32, axis: ti.template(), scene: ti.i32, arrays: ti.template()) -> ti.f32:
    """Returns the fraction of the splines of a particle's nodes that lies between an axis's walls, a weighted mean."""
    w0, w1, w2 = weights(fx)
    wall = arrays.shape[SHAPE.wall_cells]
    nodes = ti.cast(arrays.scene_value[scene, VALUE.nodes + axis], ti.i32)
    room = 0.0
    for offset, w in ti.static(((0, w0), (1, w1), (2, w2))):
        # depth in cells within the wall; a node's own spline reaches 1.5 cells
        depth = ti.min(base + offset - (wall - 1), nodes - wall - base - offset)
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
def settles(scene: ti.i32, arrays: ti.template()) -> ti.i32:
    """Returns whether the scene's water is moved towards its density after each interval (see settle)."""
    return arrays.scene_value[scene, VALUE.water_density] > 0.0 and arrays.setting[SETTING.density_relaxation] > 0.0


@ti.func
def settle(x, volume: ti.f32, mass: ti.f32, scene: ti.i32, arrays: ti.template()) -> ti.f32:
    """Returns J of a water particle after an interval, moved towards the volume that its density implies.

    The density follows from `mass`, which is interpolated from the masses of the surrounding nodes.
    """
    scaled = x * arrays.setting[SETTING.inverse_cell_size]
    base = ti.floor(scaled - 0.5, ti.i32)
    fx = scaled - ti.cast(base, ti.f32)
    room = (
        _room(fx[0], base[0], 0, scene, arrays)
        * _room(fx[1], base[1], 1, scene, arrays)
        * _room(fx[2], base[2], 2, scene, arrays)
    )
    share = arrays.scene_value[scene, VALUE.interval_elapsed] * arrays.setting[SETTING.density_relaxation]
    density = mass / (arrays.scene_value[scene, VALUE.water_density] * ti.max(room, 0.1))
    return settled(volume, density, ti.min(share, 1.0))


@ti.func
def _triangle_list(x, scene: ti.i32, arrays: ti.template()) -> ti.i32:
    """Returns the index in `contact` of the list of triangles near a particle, or -1."""
    base = base_node(x, arrays.setting[SETTING.inverse_cell_size])
    return arrays.contact[arrays.shape[SHAPE.all_blocks] * BLOCK_NODES + node_place(base, scene, arrays.shape)]


@ti.func
def find_hidden(x, scene: ti.i32, arrays: ti.template()) -> ti.i32:
    """Returns in bits which of a particle's nodes are hidden from it by sheets (see surface_kernel.hidden_nodes).

    A node near a sheet has two velocity fields, one per side; particles on the hidden side use the second.
    """
    bits = 0
    list_at = _triangle_list(x, scene, arrays)
    scaled = x * arrays.setting[SETTING.inverse_cell_size]
    if list_at >= 0:
        bits = hidden_nodes(scaled, ti.floor(scaled - 0.5) - scaled, list_at, 0, arrays, False)
    if ti.static(bool(arrays.variant & VARIANT.moving_sheets)):
        bits |= hidden_by_moving(scaled, scene, arrays)
    return bits


@ti.func
def move(x, v, C, scene: ti.i32, arrays: ti.template()):
    """Returns position (changed by triangles and bounds) and velocity (by triangles only) after an interval, and v².

    A particle that is not finite or leaves the domain stops its scene; v² is then 0.
    """
    out = x + arrays.scene_value[scene, VALUE.interval_elapsed] * v
    speed = v
    if ti.static(bool(arrays.variant & VARIANT.sweep)):
        list_at = _triangle_list(x, scene, arrays)
        moving = ti.static(bool(arrays.variant & VARIANT.moving))
        near = list_at >= 0
        if ti.static(moving):
            near = near or first_body(scene, arrays) < first_body(scene + 1, arrays)
        if near:
            out, speed = stop_at_surface(x, out, v, list_at, scene, arrays, moving)
    speed_square = speed.dot(speed)
    bad = _not_finite(speed_square) | _not_finite(out.sum()) | _not_finite(C.sum())
    outside = 0
    clamps = 0
    for axis in ti.static(range(3)):
        low = arrays.setting[SETTING.low]
        high = arrays.scene_value[scene, VALUE.high + axis]
        if not (out[axis] >= 0.0 and out[axis] <= arrays.scene_value[scene, VALUE.size + axis]):
            outside = 1
        if not out[axis] >= low:
            out[axis] = low
            clamps = 1
        if not out[axis] <= high:
            out[axis] = high
            clamps = 1
    if bad:
        arrays.counter[scene, COUNT.status] = ti.cast(STATUS.not_finite, ti.i64)
        arrays.scene_value[scene, VALUE.remaining] = 0.0
        speed_square = 0.0
    elif outside:
        # a value that is not finite is the better cause to report, so it is not replaced
        if arrays.counter[scene, COUNT.status] != STATUS.not_finite:
            arrays.counter[scene, COUNT.status] = ti.cast(STATUS.left_domain, ti.i64)
        arrays.scene_value[scene, VALUE.remaining] = 0.0
        speed_square = 0.0
    else:
        count_event(arrays.counter, scene, COUNT.position_clamps, clamps)
    return out, speed, speed_square


@ti.func
def is_fluid(material: ti.i32) -> ti.i32:
    """Returns whether a material has no deformation gradient."""
    result = 0
    for fluid in ti.static(FLUIDS):
        if material == fluid:
            result = 1
    return result


@ti.func
def initial_stiffness(material: ti.i32, law: ti.template(), row: ti.i32) -> ti.f32:
    """Returns (3 lambda + 2 mu) / density of an undeformed particle."""
    stiffness = 3.0 * law[row + CONSTANT.bulk]
    if not is_fluid(material):
        stiffness += 2.0 * law[row + CONSTANT.shear]
        if material == SNOW:
            stiffness *= hardening(1.0, law, row)
    return stiffness / law[row + CONSTANT.density]
