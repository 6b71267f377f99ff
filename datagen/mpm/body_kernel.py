"""Moving obstacles in Taichi kernels: their poses, and their surfaces near a node or a particle.

A kernel transforms a point into the frame of each moving obstacle of its scene. See datagen.mpm.body. Lengths are in
cells, times in seconds.
"""

import taichi as ti

from datagen.mpm.body import REACH_CELLS, SAMPLES_PER_CELL
from datagen.mpm.collider import GAP_CELLS
from datagen.mpm.layout import HEAD, KEY, SETTING, SHAPE, STATE, VALUE
from datagen.mpm.surface_samples import BEARING_CELLS

AXES = 3  # from the start of a pose to its axes
SAMPLE_VECTORS = 3  # see Body.sample_S33
ON_SURFACE = 1e-3  # distance from the surface below which the direction to it is rounding, cells


@ti.func
def _vector(at: ti.i32, arrays: ti.template()):
    return ti.Vector([arrays.pose[at], arrays.pose[at + 1], arrays.pose[at + 2]])


@ti.func
def _write(at: ti.i32, value, arrays: ti.template()):
    for axis in ti.static(range(3)):
        arrays.pose[at + axis] = value[axis]


@ti.func
def first_body(scene: ti.i32, arrays: ti.template()) -> ti.i32:
    """Returns the index in `contact` of a scene's first body; the others follow, up to the next scene's."""
    return arrays.contact[arrays.shape[SHAPE.bodies] + scene]


@ti.func
def into_frame(place, pose: ti.i32, state: ti.i32, arrays: ti.template()):
    """Returns a point in the frame of a body. `pose` is the start of the pose in `arrays.pose`."""
    offset = place - _vector(pose, arrays)
    return _vector(state + STATE.origin, arrays) + ti.Vector(
        [offset.dot(_vector(pose + AXES + 3 * axis, arrays)) for axis in range(3)]
    )


@ti.func
def out_of_frame(direction, pose: ti.i32, arrays: ti.template()):
    """Returns a direction in the frame of a body as a direction in the scene."""
    return (
        direction[0] * _vector(pose + AXES, arrays)
        + direction[1] * _vector(pose + AXES + 3, arrays)
        + direction[2] * _vector(pose + AXES + 6, arrays)
    )


@ti.func
def body_velocity(place, pose: ti.i32, state: ti.i32, arrays: ti.template()):
    """Returns the velocity of a body at a point in this interval, cells per second."""
    turn = _vector(state + STATE.turn, arrays)
    return _vector(state + STATE.velocity, arrays) + turn.cross(place - _vector(pose, arrays))


@ti.func
def body_list(place, head: ti.i32, arrays: ti.template()) -> ti.i32:
    """Returns the index in `contact` of the list of triangles near a point in a body's frame, or -1."""
    base = ti.floor(place - 0.5, ti.i32)
    list_at = -1
    inside = 1
    at = 0
    for axis in ti.static(range(3)):
        size = arrays.contact[head + HEAD.cells + axis]
        if base[axis] < 0 or base[axis] >= size:
            inside = 0
        at = at * size + base[axis]
    if inside:
        list_at = arrays.contact[arrays.contact[head + HEAD.lists] + at]
    return list_at


@ti.func
def _key(state: ti.i32, keys: ti.i32, time: ti.f32, arrays: ti.template()) -> ti.i32:
    """Returns the last keyframe up to a time, -1 before the first. Times do not decrease from call to call."""
    key = ti.cast(arrays.pose[state + STATE.key], ti.i32)
    while key + 1 < keys and arrays.pose[state + STATE.first_key + (key + 1) * KEY.length + KEY.time] <= time:
        key += 1
    return key


@ti.func
def _place_body(state: ti.i32, keys: ti.i32, time: ti.f32, arrays: ti.template()):
    """Writes the pose at a time as the end pose."""
    key = _key(state, keys, time, arrays)
    arrays.pose[state + STATE.key] = ti.cast(key, ti.f32)
    at = state + STATE.first_key + ti.max(key, 0) * KEY.length
    passed = time - arrays.pose[at + KEY.time] if key >= 0 else 0.0
    _write(state + STATE.end, _vector(at + KEY.place, arrays) + passed * _vector(at + KEY.velocity, arrays), arrays)
    turn = passed * _vector(at + KEY.turn, arrays)
    angle = turn.norm()
    # Rodrigues: sin(a) / a and (1 - cos(a)) / a²
    sine, cosine = 1.0, 0.5
    if angle > 1e-3:
        sine = ti.sin(angle) / angle
        half = ti.sin(0.5 * angle) / angle
        cosine = 2.0 * half * half
    for axis in ti.static(range(3)):
        own = _vector(at + KEY.axes + 3 * axis, arrays)
        across = turn.cross(own)
        _write(state + STATE.end + AXES + 3 * axis, own + sine * across + cosine * turn.cross(across), arrays)


@ti.func
def move_bodies(scene: ti.i32, arrays: ti.template()):
    """Moves a scene's bodies to the end of the substep that was chosen. One thread calls it for each substep.

    An interval starts with the last pose of the previous one, bitwise. Velocities are those in its middle.
    """
    step = arrays.scene_value[scene, VALUE.time_step]
    time = arrays.scene_value[scene, VALUE.frame_end] - arrays.scene_value[scene, VALUE.remaining]
    interval = arrays.scene_value[scene, VALUE.interval]
    begins = arrays.scene_value[scene, VALUE.begins] == 1.0
    if step > 0.0:
        fastest = 0.0
        head = first_body(scene, arrays)
        while head < first_body(scene + 1, arrays):
            state = arrays.contact[head + HEAD.state]
            keys = arrays.contact[head + HEAD.keys]
            if begins:
                for n in range(STATE.end):
                    arrays.pose[state + n] = arrays.pose[state + STATE.end + n]
                key = _key(state, keys, time - step + 0.5 * interval, arrays)
                velocity = ti.Vector([0.0, 0.0, 0.0])
                turn = ti.Vector([0.0, 0.0, 0.0])
                if key >= 0:
                    velocity = _vector(state + STATE.first_key + key * KEY.length + KEY.velocity, arrays)
                    turn = _vector(state + STATE.first_key + key * KEY.length + KEY.turn, arrays)
                _write(state + STATE.velocity, velocity, arrays)
                _write(state + STATE.turn, turn, arrays)
            _place_body(state, keys, time, arrays)
            # keyframes that the next interval may contain
            soon = 2.0 * ti.max(interval, arrays.setting[SETTING.transfer_interval])
            last = _key(state, keys, time + soon, arrays)
            for key in range(ti.max(ti.cast(arrays.pose[state + STATE.key], ti.i32), 0), last + 1):
                fastest = ti.max(fastest, arrays.pose[state + STATE.first_key + key * KEY.length + KEY.speed])
            head += HEAD.length
        arrays.scene_value[scene, VALUE.obstacle_speed] = fastest


@ti.func
def _sampled(place, vector: ti.template(), head: ti.i32, arrays: ti.template()):
    """Returns one of the vectors of a body's samples, interpolated at a point in units of their spacing."""
    base = ti.floor(place, ti.i32)
    fraction = place - ti.cast(base, ti.f32)
    size_y, size_z = arrays.contact[head + HEAD.shape + 1], arrays.contact[head + HEAD.shape + 2]
    total = ti.Vector([0.0, 0.0, 0.0])
    for i, j, k in ti.static(ti.ndrange(2, 2, 2)):
        weight = 1.0
        for axis, upper in ti.static(((0, i), (1, j), (2, k))):
            weight *= fraction[axis] if ti.static(upper == 1) else 1.0 - fraction[axis]
        at = ((base[0] + i) * size_y + base[1] + j) * size_z + base[2] + k
        total += weight * arrays.contact_normal[arrays.contact[head + HEAD.samples] + SAMPLE_VECTORS * at + vector]
    return total


@ti.func
def _reached(height: ti.f32) -> ti.f32:
    """Computes collider.reached."""
    below = ti.static(GAP_CELLS) - height
    away = ti.abs(below)
    outer = ti.max(1.5 - away, 0.0)
    share = outer * outer * outer / 6.0
    if away < 0.5:
        share = 0.5 - away * (0.75 - away * away / 3.0)
    return 1.0 - share if below < 0.0 else share


@ti.func
def nearest_surface(
    index, field: ti.i32, normal_at_rest, friction_at_rest: ti.f32, least_at_rest: ti.f32, distance: ti.f32,
    scene: ti.i32, arrays: ti.template(),
):  # fmt: skip
    """Returns the contact of a node's field with the nearest surface, at rest or moving.

    `index` are the node's numbers along the axes. The arguments are those of the nearest surface at rest, and its
    `distance`. Results: the free direction, friction, smallest mass with which the node stops motion, and the surface's
    velocity in domain units per second.
    """
    place = ti.cast(index, ti.f32)
    normal, friction, least = normal_at_rest, friction_at_rest, least_at_rest
    velocity = ti.Vector([0.0, 0.0, 0.0])
    nearest = distance
    head = first_body(scene, arrays)
    while head < first_body(scene + 1, arrays):
        state = arrays.contact[head + HEAD.state]
        own = into_frame(place, state, state, arrays) * ti.static(float(SAMPLES_PER_CELL))
        inside = 1
        for axis in ti.static(range(3)):
            if not (own[axis] >= 0.0 and own[axis] < ti.cast(arrays.contact[head + HEAD.shape + axis] - 1, ti.f32)):
                inside = 0
        if inside:
            closed = arrays.contact[head + HEAD.closed]
            other = _sampled(own, 2, head, arrays)
            if other[0] <= ti.static(float(REACH_CELLS)) and (not closed or field == 0):
                offset = _sampled(own, 0, head, arrays)
                depth = offset.norm()
                flagged = other[1] > 0.5
                height = depth
                away = depth
                claimed = 0
                if closed:
                    height = other[0]
                    away = ti.abs(height)
                    claimed = height <= ti.static(BEARING_CELLS) or (
                        flagged and height <= arrays.pose[state + STATE.bearing]
                    )
                elif field == 0:
                    claimed = depth <= ti.static(BEARING_CELLS) and not flagged
                else:
                    height = -depth
                    away = ti.sqrt(depth * depth + other[0] * other[0])
                    claimed = away <= ti.static(float(REACH_CELLS))
                if claimed and away < nearest:
                    nearest = away
                    direction = _sampled(own, 1, head, arrays)
                    if (flagged or not closed) and depth > ti.static(ON_SURFACE):
                        direction = offset
                        if closed and height < 0.0:
                            direction = -offset
                    if field == 1:
                        direction = -direction
                    normal = out_of_frame(direction / ti.max(direction.norm(), 1e-20), state, arrays)
                    friction = arrays.pose[state + STATE.friction]
                    least = arrays.pose[state + STATE.cell_mass] * _reached(height)
                    if closed and flagged:
                        least = 0.0
                    velocity = arrays.setting[SETTING.cell_size] * body_velocity(place, state, state, arrays)
        head += HEAD.length
    return normal, friction, least, velocity
