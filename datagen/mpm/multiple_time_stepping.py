"""Multiple time stepping (Streett et al. 1978) for Taichi kernels: soft particles take longer steps.

The stiffest particle of a scene determines the substep of an interval between two transfers. In a synchronised interval
(see mls_mpm) softer particles take steps of several substeps, limited by their own wave speed, and compute strain and
stress once per step.

The stress of a step acts evenly over its substeps, because particles with shorter steps read the velocities of the same
nodes in each substep. The whole impulse in one substep would give these particles wrong velocities, even at rest.

If all particles in a block of nodes take the same steps, no particle reads the block's nodes within a step. The block
then receives the impulses of stress and gravity of a whole step in the step's first substep, and no later update in it.
"""

import taichi as ti

from datagen.mpm.constitutive import foreseen_stiffness
from datagen.mpm.layout import COUNT, SETTING, SHAPE, VALUE
from datagen.mpm.nodes import base_node, corner_block

MANY = 32  # largest number of substeps in a particle's own step; also the base of the marks
SLACK = 1e-3  # times that differ by less than this fraction of a substep count as equal


@ti.func
def _raise_marks(base, least: ti.i32, scene: ti.i32, arrays: ti.template(), begin: ti.i32):
    """Raises the marks of all blocks that contain a particle's nodes to `least` or more. Marks start at block[begin].

    `base` is the lowest of the particle's 3³ nodes.
    """
    first, last = base >> 2, (base + 2) >> 2
    index = ti.Vector([begin + corner_block(first, last, n, scene, arrays.shape) for n in range(8)])
    found = ti.Vector([arrays.block[index[n]] for n in range(8)])  # loads are issued together to hide the latency
    for n in ti.static(range(8)):
        own = found[n] < least
        for axis in ti.static(range(3)):
            if ti.static(bool(n >> (2 - axis) & 1)):
                own = own and first[axis] != last[axis]
        if own:
            ti.atomic_max(arrays.block[index[n]], least)


@ti.func
def mark_changed(x, scene: ti.i32, now: ti.i32, many: ti.f32, inverse_dx: ti.f32, arrays: ti.template(), begin: ti.i32):
    """Marks the blocks of a particle's nodes: in the substep `now` they receive the impulse of `many` substeps.

    A block's mark is block[begin + index of the block]: the maximum of `now * MANY + (MANY - many)` over all changes.
    It thus stores the latest substep with a change, and the smallest `many` of that substep's changes (see change_of).
    """
    base = base_node(x, inverse_dx)
    change = now * MANY + MANY - ti.cast(many, ti.i32)
    _raise_marks(base, change, scene, arrays, begin)


@ti.func
def _alike_around(
    x, scene: ti.i32, interval: ti.i32, own: ti.f32, inverse_dx: ti.f32, arrays: ti.template(), begin: ti.i32
) -> ti.i32:
    """Returns whether all particles around a particle began the previous interval with steps of `own` substeps.

    "Around" means in the blocks of its nodes. The function also marks the particle's own step for the next interval.
    A block has four marks, each in its own array of all blocks; the first array starts at block[begin]:

        smallest number of substeps in even intervals    the largest in even intervals
        smallest number of substeps in odd intervals     the largest in odd intervals

    A mark contains the number of its interval, so marks of other intervals do not match.
    """
    base = base_node(x, inverse_dx)
    blocks = arrays.shape[SHAPE.all_blocks]
    present = begin + 2 * (interval & 1) * blocks
    former = begin + 2 * ((interval - 1) & 1) * blocks
    many = ti.cast(own, ti.i32)
    fewest, most = interval * MANY + MANY - many, interval * MANY + many - 1
    alike = 1
    for n in ti.static(range(8)):
        index = former + corner_block(base >> 2, (base + 2) >> 2, n, scene, arrays.shape)
        if (arrays.block[index] != fewest - MANY) | (arrays.block[index + blocks] != most - MANY):
            alike = 0
    _raise_marks(base, fewest, scene, arrays, present)
    _raise_marks(base, most, scene, arrays, present + blocks)
    return alike


@ti.func
def change_of(mark: ti.i32, now: ti.i32) -> ti.f32:
    """Returns the number of substeps whose impulses a block receives in the substep `now`; 0 without changes.

    `mark` is the block's mark (see mark_changed).
    """
    many = 0.0
    if mark // MANY == now:
        many = ti.cast(MANY - mark % MANY, ti.f32)
    return many


@ti.func
def acts(covered: ti.f32, begins: ti.f32, step: ti.f32, scene: ti.i32, scene_value: ti.template()) -> ti.i32:
    """Returns whether a particle begins its own step in this substep.

    It does in an interval's first substep, and if its last stress ends before the end of this substep. `covered` is the
    end of that stress in s from the start of the interval.
    """
    return begins == 1.0 or covered < scene_value[scene, VALUE.interval_elapsed] - SLACK * step


@ti.func
def own_step(
    strained: ti.f32, covered: ti.f32, spread: ti.i32, x, C, volume: ti.f32, material: ti.i32, row: ti.i32,
    begins: ti.f32, step: ti.f32, scene: ti.i32, arrays: ti.template(), marks: ti.i32,
):  # fmt: skip
    """Computes the particle's own step that begins in this substep (see acts). Times are in s since the interval began.

    strained   end of the strain of the steps before; negative before the particle's first step
    covered    end of the stress of the steps before
    spread     1 if the stress of the step before acts evenly over its substeps
    marks      index in `block` of the first mark of mark_changed, one mark for each block; _alike_around's follow

    Returns six values:
    1. the time by which the step strains the particle
    2. the new `strained`
    3. the new `covered`
    4. the number of substeps in which the stress acts
    5. the new `spread`
    6. the time of stress in this substep: the substep if the new `spread` is 1, else the acting time after `covered`

    In a synchronised interval a stress computed at time t acts from half a step before t to half a step after t.
    Stresses at the start and end of the interval act for half a step. The remaining time of strain is divided into
    equal steps. They are as long as the particle's stiffness allows, rounded down to substeps. `alike` is the number of
    substeps in each of these steps; particles with the same `alike` have the same steps. In intervals that are not
    synchronised, and in the last substep of every interval, a step is one substep.
    """
    elapsed = arrays.scene_value[scene, VALUE.interval_elapsed]
    left = arrays.scene_value[scene, VALUE.interval_remaining]
    begin = elapsed - step
    before = strained
    ahead = covered - begin
    if begins == 1.0:
        before -= arrays.scene_value[scene, VALUE.last_interval]
        ahead -= arrays.scene_value[scene, VALUE.last_interval]
    if strained < 0.0:
        before, ahead = begin, 0.0
    if spread:
        ahead = 0.0
    spreads = spread
    if begins == 1.0:
        spreads = 0
    many = 1.0
    acting = step
    until = elapsed
    if arrays.scene_value[scene, VALUE.synchronised] == 1.0 and left > 0.0:
        whole = arrays.scene_value[scene, VALUE.whole_step]
        inverse_dx = arrays.setting[SETTING.inverse_cell_size]
        stiffness = foreseen_stiffness(C, volume, material, left + step, inverse_dx, arrays.law, row, arrays.variant)
        longest = arrays.scene_value[scene, VALUE.stability_fraction] * arrays.setting[SETTING.cell_size]
        longest /= ti.sqrt(ti.max(stiffness, 1e-3)) * whole
        longest = ti.min(ti.max(ti.floor(longest + 1e-4), 1.0), ti.cast(MANY, ti.f32))
        total = (elapsed + left) / whole
        alike = ti.ceil(total / ti.ceil(total / longest - 1e-3) - 1e-3)
        steps = ti.ceil((elapsed + left - before) / (whole * alike) - 1e-3)
        if begins == 1.0:
            many = ti.floor(0.5 * total / ti.ceil(total / alike - 1e-3) + 0.501)
            until = begin
            interval = ti.cast(arrays.counter[scene, COUNT.transfers], ti.i32)
            others = marks + arrays.shape[SHAPE.all_blocks]
            if not _alike_around(x, scene, interval, alike, inverse_dx, arrays, others):
                spreads = 1
        elif steps <= 1.0:
            many = 1.0 + ti.round(left / whole + 0.5)
            until = elapsed + left
        else:
            many = ti.floor(2.0 * (before + (elapsed + left - before) / steps - begin) / whole + 1e-3)
            many = ti.min(ti.max(many, 1.0), ti.round(left / whole + 0.5))
            until = begin + 0.5 * many * whole
        now = ti.cast(arrays.counter[scene, COUNT.substeps], ti.i32)
        mark_changed(x, scene, now, 1.0 if spreads else ti.min(many, MANY), inverse_dx, arrays, marks)
        acting = step + ti.min((many - 1.0) * whole, left)
    acts_until = begin + acting
    length = until - before
    if ti.abs(before - begin) <= SLACK * step and until == elapsed:
        length = step
    if spreads:
        acting = step
    elif ahead > SLACK * step:
        acting = ti.max(acting - ahead, 0.0)
    length = ti.max(length, SLACK * step)
    strained_until = before + length
    if begins == 1.0:
        catch_up = arrays.scene_value[scene, VALUE.catch_up]
        length = ti.max(length + catch_up, SLACK * step)
        acting += 0.5 * catch_up
    return length, strained_until, acts_until, many, spreads, acting
