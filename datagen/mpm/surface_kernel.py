"""Contact with meshes in Taichi kernels: at the nodes of the grid, and by a swept test of particles."""

import taichi as ti

from datagen.mpm.layout import COUNT, SETTING

CLEARANCE = 1e-3  # cells that a particle keeps from a triangle; rounding is 1e-5
EDGE = 1e-4  # of a triangle's edge: how far past it a crossing still counts, so that none slips between two
TRIANGLE_VECTORS = 4  # of a triangle in the array: see datagen.mpm.sweep.Sweep


@ti.func
def meet_collider(v, normal, both_sides: ti.i32, friction: ti.f32):
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
def _first_crossing(start, end, list_at: ti.i32, contact: ti.template(), contact_normal: ti.template()):
    """Where the way from start to end (in cells) first meets a triangle of the list that begins at list_at.

    Returns the fraction of the way (2 where there is none), the place to stop at, and the direction that is free
    there: the triangle's normal on the side of the start.
    """
    first = 2.0
    stop = end
    free = ti.Vector([0.0, 0.0, 0.0])
    for s in range(list_at + 1, list_at + 1 + contact[list_at]):
        triangle = contact[s]
        corner = contact_normal[triangle]
        normal = contact_normal[triangle + 1]
        before = normal.dot(start - corner)
        if before < 0.0:
            normal = -normal
            before = -before
        after = normal.dot(end - corner)
        if after < CLEARANCE and after < before:
            fraction = 1.0
            if after < 0.0:
                fraction = before / (before - after)
            place = start + fraction * (end - start)
            along_1 = contact_normal[triangle + 2].dot(place - corner)
            along_2 = contact_normal[triangle + 3].dot(place - corner)
            if along_1 >= -EDGE and along_2 >= -EDGE and along_1 + along_2 <= 1.0 + EDGE and fraction < first:
                first = fraction
                stop = place + normal * (CLEARANCE - normal.dot(place - corner))
                free = normal
    return first, stop, free


@ti.func
def stop_at_surface(
    x,
    out,
    v,
    list_at: ti.i32,
    scene: ti.i32,
    contact: ti.template(),
    contact_normal: ti.template(),
    counter: ti.template(),
    setting: ti.template(),
):
    """The place that a particle from x reaches on its way to out, and its velocity there.

    A triangle in the way stops it just before, without its velocity into the triangle. Where that place lies behind
    another triangle (in a corner) it stays at x.
    """
    dx = setting[SETTING.cell_size]
    start = x * setting[SETTING.inverse_cell_size]
    end = out * setting[SETTING.inverse_cell_size]
    moved = out
    speed = v
    attempt = 0
    while attempt < 2:
        fraction, stop, free = _first_crossing(start, end, list_at, contact, contact_normal)
        if fraction <= 1.0:
            speed -= ti.min(speed.dot(free), 0.0) * free
            end = stop
            moved = stop * dx
            if attempt == 1:
                moved = x
            else:
                ti.atomic_add(counter[scene, COUNT.surface_projections], ti.cast(1, ti.i64))
            attempt += 1
        else:
            attempt = 2
    return moved, speed


@ti.kernel
def place_contacts(
    contact: ti.types.ndarray(dtype=ti.i32, ndim=1),
    where: ti.types.ndarray(dtype=ti.i32, ndim=1),
    value: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """contact[where] = value."""
    for i in range(where.shape[0]):
        contact[where[i]] = value[i]
