"""Chooses a scene's next substep, for Taichi kernels. See mls_mpm for intervals and gravity."""

import taichi as ti

from datagen.mpm.layout import COUNT, SETTING, STATUS, VALUE
from hgn.solver_method import SPEED_FRACTION

# An interval with at least this number of substeps is synchronised (see mls_mpm). Intervals of fewer substeps are
# stable at rest without synchronisation. But the result of an impact on the ground at 10 m/s changed by 6 % when the
# steps were halved, so an interval that a fast particle shortens is synchronised too.
SYNCHRONISED_FROM = 3.0
SPEED_MARGIN = 1.25  # a particle that gains speed may move this many times the distance planned for an interval


@ti.func
def raise_maximum(counter: ti.template(), scene: ti.i32, entry: ti.template(), value: ti.f32):
    """Replaces a stored maximum by a larger value > 0, both as bits (see layout.Count). NaN is ignored."""
    if value > 0.0:
        bits = ti.cast(ti.bit_cast(value, ti.i32), ti.i64)
        if counter[scene, entry] < bits:
            ti.atomic_max(counter[scene, entry], bits)


@ti.func
def _maximum(counter: ti.template(), scene: ti.i32, entry: ti.template()) -> ti.f32:
    return ti.bit_cast(ti.cast(counter[scene, entry], ti.i32), ti.f32)


@ti.func
def _parts(whole: ti.f32, longest: ti.f32) -> ti.f32:
    """Returns the smallest number of equal parts of a time that are not longer than `longest`."""
    return ti.max(ti.ceil(ti.min(whole / longest, 1e9) - 1e-4), 1.0)


@ti.func
def choose_time_step(
    scene: ti.i32, scene_value: ti.template(), counter: ti.template(), setting: ti.template(), maximum_substeps: ti.i32
):
    # all reads are issued together, before any write, to hide the latency of memory
    remaining = scene_value[scene, VALUE.remaining]
    status = counter[scene, COUNT.status]
    least = scene_value[scene, VALUE.least_stiffness]
    held = _maximum(counter, scene, COUNT.held_stiffness_bits)
    stiffness = ti.max(_maximum(counter, scene, COUNT.stiffness_bits), held, least, 1e-3)
    speed_square = _maximum(counter, scene, COUNT.speed_square_bits)
    largest_speed_square = scene_value[scene, VALUE.largest_speed_square]
    gravity = ti.Vector([scene_value[scene, VALUE.gravity + i] for i in range(3)])
    fraction = scene_value[scene, VALUE.stability_fraction]
    interval = scene_value[scene, VALUE.interval]
    elapsed = scene_value[scene, VALUE.interval_elapsed]
    left = scene_value[scene, VALUE.interval_remaining]
    smallest = scene_value[scene, VALUE.smallest_time_step]
    last_stiffness = scene_value[scene, VALUE.stiffness]
    done = ti.cast(counter[scene, COUNT.frame_substeps], ti.i32)
    substeps = counter[scene, COUNT.substeps]
    transfers = counter[scene, COUNT.transfers]
    dx = setting[SETTING.cell_size]
    fixed = setting[SETTING.fixed_time_step]
    fixed_substeps = setting[SETTING.fixed_substeps]
    transfer_interval = setting[SETTING.transfer_interval]
    speed_fraction = SPEED_FRACTION
    leapfrog = setting[SETTING.leapfrog]
    last_interval = scene_value[scene, VALUE.last_interval]
    last_step = scene_value[scene, VALUE.whole_step]
    synchronised = scene_value[scene, VALUE.synchronised]
    fallen = scene_value[scene, VALUE.fallen] + scene_value[scene, VALUE.gravity_time]
    step = 0.0
    if remaining > 0.0 and status == STATUS.running:
        # material that stiffens by compression is assumed to stiffen further in the step
        growth = ti.max(stiffness / ti.max(last_stiffness, 1e-3), 1.0) if last_stiffness > 0.0 else 1.0
        limit = fraction * dx / ti.sqrt(stiffness * ti.min(growth, 2.0))
        begins = left == 0.0
        catch_up = 0.0
        shift = 0.0  # (time between the middles of the last and the present interval) - (the present interval)
        if begins:
            last_interval = elapsed
            elapsed = 0.0
            fallen = 0.0
            longest = ti.max(limit, transfer_interval)
            # the fall within the interval counts too
            speed = ti.sqrt(speed_square) + gravity.norm() * ti.min(longest, remaining)
            speed = ti.max(speed, scene_value[scene, VALUE.obstacle_speed])
            bound = speed_fraction * dx / ti.max(speed, 1e-20)
            fast = bound < ti.min(longest, remaining)
            longest = ti.min(longest, bound)
            # intervals are equal up to the end of the frame, so that no short one remains
            last = interval
            interval = remaining / _parts(remaining, longest)
            left = interval
            if fixed > 0.0:
                interval = fixed
            shift = 0.5 * leapfrog * (last - interval)
            were = synchronised == 1.0
            many = _parts(left, limit) >= SYNCHRONISED_FROM
            synchronised = ti.cast((many or fast) and transfer_interval > 0.0 and fixed == 0.0, ti.f32)
            if synchronised == 1.0 and not were and transfers > 0:
                catch_up = last_step
            elif were and synchronised == 0.0:
                catch_up = -left / _parts(left, limit)
        # number of steps in this interval
        ahead = _parts(left, limit)
        whole = left / ahead
        step = whole
        if synchronised == 1.0:
            if begins:
                step = 0.5 * whole
                ahead += 1.0
            else:
                full = ti.max(ti.ceil(ti.min(left / limit, 1e9) - 0.5 - 1e-4), 0.0)  # whole steps before the half one
                ahead = full + 1.0
                whole = left / (full + 0.5)
                step = whole if full > 0.0 else left
        total = ahead
        if remaining > left:
            total += _parts(remaining - left, interval) * (_parts(interval, limit) + synchronised)
        if fixed > 0.0:
            ahead = 1.0
            total = fixed_substeps - ti.cast(done, ti.f32)
        if not (begins and synchronised == 1.0):  # the first substep of a synchronised interval does not strain
            scene_value[scene, VALUE.stiffness] = stiffness
        scene_value[scene, VALUE.largest_speed_square] = ti.max(largest_speed_square, speed_square)
        if not total <= ti.cast(maximum_substeps - done, ti.f32):
            counter[scene, COUNT.status] = ti.cast(STATUS.too_many_substeps, ti.i64)
            scene_value[scene, VALUE.remaining] = 0.0
        else:
            if fixed > 0.0:
                step = fixed
            remaining -= step
            left -= step
            elapsed += step
            # an interval also ends if material has become much faster since its start
            reach = SPEED_MARGIN * speed_fraction * dx
            if ahead <= 1.0 or (not begins and elapsed * ti.sqrt(speed_square) > reach):
                left = 0.0
            if total <= 1.0:
                remaining = 0.0
            scene_value[scene, VALUE.remaining] = remaining
            scene_value[scene, VALUE.interval] = interval
            scene_value[scene, VALUE.interval_elapsed] = elapsed
            scene_value[scene, VALUE.interval_remaining] = left
            scene_value[scene, VALUE.begins] = ti.cast(begins, ti.f32)
            scene_value[scene, VALUE.synchronised] = synchronised
            scene_value[scene, VALUE.whole_step] = whole
            scene_value[scene, VALUE.catch_up] = catch_up
            scene_value[scene, VALUE.gravity_time] = step + shift
            scene_value[scene, VALUE.last_interval] = last_interval
            scene_value[scene, VALUE.fallen] = fallen
            scene_value[scene, VALUE.substeps_ahead] = total - 1.0
            scene_value[scene, VALUE.smallest_time_step] = ti.min(smallest, step)
            counter[scene, COUNT.transfers] = transfers + ti.cast(begins, ti.i64)
            counter[scene, COUNT.frame_substeps] = ti.cast(done + 1, ti.i64)
            counter[scene, COUNT.substeps] = substeps + ti.cast(1, ti.i64)
            # maxima are reset in each step, held_stiffness_bits only in each interval
            if begins:
                counter[scene, COUNT.held_stiffness_bits] = ti.cast(0, ti.i64)
            counter[scene, COUNT.stiffness_bits] = ti.cast(0, ti.i64)
            counter[scene, COUNT.speed_square_bits] = ti.cast(0, ti.i64)
    scene_value[scene, VALUE.time_step] = step


@ti.func
def falls(time: ti.f32, scene: ti.i32, scene_value: ti.template()):
    """Returns the change of velocity that gravity causes in `time` s."""
    gravity = ti.Vector([scene_value[scene, VALUE.gravity + i] for i in range(3)])
    return time * gravity
