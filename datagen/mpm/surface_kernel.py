"""Contact with meshes in Taichi kernels: at the nodes of the grid, and by a swept test of particles."""

import taichi as ti

from datagen.mpm.body_kernel import body_list, body_velocity, first_body, into_frame, out_of_frame
from datagen.mpm.layout import COUNT, HEAD, SETTING, STATE
from datagen.mpm.sweep import ON_TRIANGLE

CLEARANCE = 1e-3  # smallest distance of a particle from a triangle, in cells; rounding is 1e-5
STOP = 1.5 * CLEARANCE  # distance at which a particle is placed, so that rounding does not move it within CLEARANCE
EDGE = 1e-4  # crossings count up to this barycentric coordinate beyond an edge; closes gaps between triangles
# Vectors of a node's contact: the free direction for particles that see the node, and for those from which a sheet
# hides it (zero if all motion is free); the friction of each, and the distance of the first from its surface in cells;
# the smallest mass with which the node stops each, and the distance of the second
NODE_VECTORS = 4
TRIANGLE_VECTORS = 5  # the vectors of datagen.mpm.sweep.Sweep, and the friction
LIST_HEAD = 2  # head of a list: number of triangles, and number of sheets' triangles, which come first
STENCIL = 27  # number of nodes of a particle
ATTEMPTS = 3  # number of triangles that may stop a path; the third stops the particle


@ti.func
def meet(v, normal, friction: ti.f32):
    """Returns the velocity after contact with a surface: separation is free, and approach ends.

    Coulomb friction reduces the sliding speed by at most the coefficient times the lost approach speed.
    """
    out = v
    along = v.dot(normal)
    if along < 0.0:
        out = v - along * normal
        out *= ti.max(0.0, 1.0 + friction * along / ti.max(out.norm(), 1e-20))
    return out


@ti.func
def hidden_nodes(scaled, to_base, list_at: ti.i32, pose: ti.i32, arrays: ti.template(), moves: ti.template()) -> ti.i32:
    """Returns which of a particle's nodes sheets hide from it.

    Bit 9 i + 3 j + k is 1 if the line to node base + (i, j, k) crosses a triangle of a sheet. The particle is at
    `scaled`, in cells; the vector to its base node is to_base; its list begins at list_at. If the sheet `moves`,
    `scaled` is in the sheet's frame, and `pose` is the start of its pose.
    """
    bits = 0
    for s in range(list_at + LIST_HEAD, list_at + LIST_HEAD + arrays.contact[list_at + 1]):
        triangle = arrays.contact[s]
        normal = arrays.contact_normal[triangle + 1]
        across_1 = arrays.contact_normal[triangle + 2]
        across_2 = arrays.contact_normal[triangle + 3]
        offset = scaled - arrays.contact_normal[triangle]
        if ti.static(moves):
            normal = out_of_frame(normal, pose, arrays)
            across_1 = out_of_frame(across_1, pose, arrays)
            across_2 = out_of_frame(across_2, pose, arrays)
            offset = out_of_frame(offset, pose, arrays)
        height = normal.dot(offset)
        height_base = height + normal.dot(to_base)
        lowest = height_base + 2.0 * ti.min(normal, 0.0).sum()
        highest = height_base + 2.0 * ti.max(normal, 0.0).sum()
        if (height >= 0.0 and lowest < 0.0) or (height < 0.0 and highest >= -ON_TRIANGLE):
            along_1 = across_1.dot(offset)
            along_2 = across_2.dot(offset)
            for n in range(STENCIL):
                way = to_base + ti.cast(ti.Vector([n // 9, n // 3 % 3, n % 3]), ti.f32)
                height_node = normal.dot(offset + way)
                if (height_node < -ON_TRIANGLE) != (height < 0.0):
                    fraction = height / (height - height_node)
                    place_1 = along_1 + fraction * across_1.dot(way)
                    place_2 = along_2 + fraction * across_2.dot(way)
                    if place_1 >= -EDGE and place_2 >= -EDGE and place_1 + place_2 <= 1.0 + EDGE:
                        bits |= 1 << n
    return bits


@ti.func
def hidden_by_moving(scaled, scene: ti.i32, arrays: ti.template()) -> ti.i32:
    """Returns which of a particle's nodes moving sheets hide from it, as `hidden_nodes`."""
    bits = 0
    to_base = ti.floor(scaled - 0.5) - scaled
    head = first_body(scene, arrays)
    while head < first_body(scene + 1, arrays):
        if arrays.contact[head + HEAD.closed] == 0:
            state = arrays.contact[head + HEAD.state]
            own = into_frame(scaled, state, state, arrays)
            list_at = body_list(own, head, arrays)
            if list_at >= 0:
                bits |= hidden_nodes(own, to_base, list_at, state, arrays, True)
        head += HEAD.length
    return bits


@ti.func
def _first_crossing(start, end, list_at: ti.i32, arrays: ti.template()):
    """Returns the first triangle of the list at list_at that the path from start to end (in cells) meets.

    Results: the fraction of the path (2 without a triangle); the end, moved back in front of the triangle; the free
    direction (the triangle's normal on the side of the start); the friction.
    """
    first = 2.0
    stop = end
    free = ti.Vector([0.0, 0.0, 0.0])
    friction = 0.0
    for s in range(list_at + LIST_HEAD, list_at + LIST_HEAD + arrays.contact[list_at]):
        triangle = arrays.contact[s]
        corner = arrays.contact_normal[triangle]
        normal = arrays.contact_normal[triangle + 1]
        begin = start - corner
        finish = end - corner
        before = normal.dot(begin)
        if before < 0.0:
            normal = -normal
            before = -before
        after = normal.dot(finish)
        if after < CLEARANCE and after < before:
            fraction = 1.0
            if after < 0.0:
                fraction = before / (before - after)
            place = begin + fraction * (finish - begin)
            along_1 = arrays.contact_normal[triangle + 2].dot(place)
            along_2 = arrays.contact_normal[triangle + 3].dot(place)
            if along_1 >= -EDGE and along_2 >= -EDGE and along_1 + along_2 <= 1.0 + EDGE and fraction < first:
                first = fraction
                stop = end + normal * (STOP - after)
                free = normal
                friction = arrays.contact_normal[triangle + 4][0]
    return first, stop, free, friction


@ti.func
def _first_moving(start, end, fraction_at_rest: ti.f32, scene: ti.i32, arrays: ti.template()):
    """Returns the first triangle of a moving obstacle that the path meets before the given fraction.

    The path is that in the obstacle's frame, from its pose at the start of the interval to that at the end. Results:
    those of _first_crossing; the velocity of the surface, in cells per second; and the start moved with the obstacle.
    """
    first = fraction_at_rest
    stop = end
    free = ti.Vector([0.0, 0.0, 0.0])
    friction = 0.0
    velocity = ti.Vector([0.0, 0.0, 0.0])
    carried = start
    head = first_body(scene, arrays)
    while head < first_body(scene + 1, arrays):
        state = arrays.contact[head + HEAD.state]
        pose_end = state + STATE.end
        begin = into_frame(start, state, state, arrays)
        finish = into_frame(end, pose_end, state, arrays)
        list_at = body_list(begin, head, arrays)
        if list_at >= 0:
            fraction, own_stop, own_free, own_friction = _first_crossing(begin, finish, list_at, arrays)
            if fraction <= 1.0 and fraction < first:
                first = fraction
                stop = end + out_of_frame(own_stop - finish, pose_end, arrays)
                free = out_of_frame(own_free, pose_end, arrays)
                friction = own_friction
                velocity = body_velocity(start, state, state, arrays)
                carried = end + out_of_frame(begin - finish, pose_end, arrays)
        head += HEAD.length
    return first, stop, free, friction, velocity, carried


@ti.func
def stop_at_surface(
    x, out, v, list_at: ti.i32, scene: ti.i32, arrays: ti.template(), moving: ti.template(),
):  # fmt: skip
    """Returns the end of a particle's path from x to out, and its velocity there.

    A triangle in the path stops motion through it. The particle slides along it with the velocity that friction leaves.
    If a third triangle is in the path (in a corner), the particle stays at x, or moves with a moving third triangle.
    The list of triangles at rest begins at list_at; -1: no list.
    """
    dx = arrays.setting[SETTING.cell_size]
    start = x * arrays.setting[SETTING.inverse_cell_size]
    end = out * arrays.setting[SETTING.inverse_cell_size]
    moved = out
    speed = v
    attempt = 0
    while attempt < ATTEMPTS:
        fraction, stop, free, friction = 2.0, end, ti.Vector([0.0, 0.0, 0.0]), 0.0
        if list_at >= 0:
            fraction, stop, free, friction = _first_crossing(start, end, list_at, arrays)
        velocity = ti.Vector([0.0, 0.0, 0.0])
        carried = start
        if ti.static(moving):
            first, own_stop, own_free, own_friction, own_velocity, own_carried = _first_moving(
                start, end, fraction, scene, arrays
            )
            if first < fraction:
                fraction, stop, free, friction = first, own_stop, own_free, own_friction
                velocity, carried = dx * own_velocity, own_carried
        if fraction <= 1.0:
            if ti.static(moving):
                speed = meet(speed - velocity, free, friction) + velocity
            else:
                speed = meet(speed, free, friction)
            end = stop
            moved = stop * dx
            if attempt == 0:
                ti.atomic_add(arrays.counter[scene, COUNT.surface_projections], ti.cast(1, ti.i64))
            attempt += 1
            if attempt == ATTEMPTS:
                moved = x
                if ti.static(moving):
                    moved = carried * dx
        else:
            attempt = ATTEMPTS
    return moved, speed


@ti.kernel
def place_contacts(
    contact: ti.types.ndarray(dtype=ti.i32, ndim=1),
    where: ti.types.ndarray(dtype=ti.i32, ndim=1),
    value: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """Sets contact[where] = value."""
    for i in range(where.shape[0]):
        contact[where[i]] = value[i]
