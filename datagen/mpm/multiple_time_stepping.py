"""Multiple time stepping (Streett et al. 1978) for Taichi kernels: soft particles take longer steps.

The substeps of an interval between two transfers are as short as the stiffest particle of the scene needs. In a
synchronised interval (see mls_mpm) softer particles take steps of several substeps, as long as their own wave speed
allows, and compute strain and stress once a step.

The stress acts evenly over the substeps of a step, because particles with shorter steps read the velocities of the same
nodes in each of them. The whole impulse at once would give them wrong velocities, even at rest.

Where all particles in a block of nodes take the same steps, its nodes are not read within a step. There the impulse of
the whole step and of gravity is applied in the first substep, and the block is not updated until the next step.
"""

import taichi as ti

from datagen.mpm.constitutive import foreseen_stiffness
from datagen.mpm.layout import COUNT, SETTING, SHAPE, VALUE
from datagen.mpm.nodes import base_node

MANY = 32  # substeps of a step of a particle's own at most, and as far as marks count
SLACK = 1e-3  # of a substep, within which times are the same


@ti.func
def _corner_block(first, last, n: ti.template(), scene: ti.i32, shape: ti.template()) -> ti.i32:
    """Returns the block at corner n of eight of the blocks `first` to `last` that contain a particle's nodes."""
    corner = ti.Vector([last[axis] if n >> (2 - axis) & 1 else first[axis] for axis in range(3)])
    index = (corner[0] * shape[SHAPE.blocks + 1] + corner[1]) * shape[SHAPE.blocks + 2] + corner[2]
    return index + scene * shape[SHAPE.scene_blocks]


@ti.func
def _raise_marks(base, least: ti.i32, scene: ti.i32, arrays: ti.template(), begin: ti.i32):
    """Marks of all blocks that the nodes from `base` on lie in, from block[begin] on, become `least` at least."""
    first, last = base >> 2, (base + 2) >> 2
    index = ti.Vector([begin + _corner_block(first, last, n, scene, arrays.shape) for n in range(8)])
    found = ti.Vector([arrays.block[index[n]] for n in range(8)])  # all at once: each is a way to memory
    for n in ti.static(range(8)):
        own = found[n] < least
        for axis in ti.static(range(3)):
            if ti.static(bool(n >> (2 - axis) & 1)):
                own = own and first[axis] != last[axis]
        if own:
            ti.atomic_max(arrays.block[index[n]], least)


@ti.func
def mark_changed(x, scene: ti.i32, now: ti.i32, many: ti.f32, inverse_dx: ti.f32, arrays: ti.template(), begin: ti.i32):
    """Marks the blocks of the particle's nodes: in the substep `now` it gives them the impulse of `many` substeps.

    A block's mark is block[begin + its index], the largest now MANY + MANY - many of all that change the block: of the
    latest substep that anything did, by the fewest substeps. change_of reads it.
    """
    base = base_node(x, inverse_dx)
    change = now * MANY + MANY - ti.cast(many, ti.i32)
    _raise_marks(base, change, scene, arrays, begin)


@ti.func
def _alike_around(
    x, scene: ti.i32, interval: ti.i32, own: ti.f32, inverse_dx: ti.f32, arrays: ti.template(), begin: ti.i32
) -> ti.i32:
    """Returns whether all particles in the blocks of a particle's nodes began the previous interval with steps of `own`
    substeps, and marks this particle's step for the next interval.

    A block has four marks, each in an array of all blocks, the first from block[begin] on: the fewest substeps in even
    intervals, the most in them, and both in odd ones. A mark holds the number of its interval too, so that one from
    earlier is no match.
    """
    base = base_node(x, inverse_dx)
    blocks = arrays.shape[SHAPE.all_blocks]
    present = begin + 2 * (interval & 1) * blocks
    former = begin + 2 * ((interval - 1) & 1) * blocks
    many = ti.cast(own, ti.i32)
    fewest, most = interval * MANY + MANY - many, interval * MANY + many - 1
    alike = 1
    for n in ti.static(range(8)):
        index = former + _corner_block(base >> 2, (base + 2) >> 2, n, scene, arrays.shape)
        if (arrays.block[index] != fewest - MANY) | (arrays.block[index + blocks] != most - MANY):
            alike = 0
    _raise_marks(base, fewest, scene, arrays, present)
    _raise_marks(base, most, scene, arrays, present + blocks)
    return alike


@ti.func
def change_of(mark: ti.i32, now: ti.i32) -> ti.f32:
    """Returns the number of substeps whose impulses a block takes in the substep `now`, from its mark (see
    mark_changed); 0 for a block without changes.
    """
    many = 0.0
    if mark // MANY == now:
        many = ti.cast(MANY - mark % MANY, ti.f32)
    return many


@ti.func
def acts(covered: ti.f32, begins: ti.f32, step: ti.f32, scene: ti.i32, scene_value: ti.template()) -> ti.i32:
    """Returns whether a particle begins its own step in this substep: always in an interval's first one, later if its
    last stress acts only until `covered` (s, within the interval), before the substep ends.
    """
    return begins == 1.0 or covered < scene_value[scene, VALUE.interval_elapsed] - SLACK * step


@ti.func
def own_step(
    strained: ti.f32,
    covered: ti.f32,
    spread: ti.i32,
    x,
    C,
    volume: ti.f32,
    material: ti.i32,
    row: ti.i32,
    begins: ti.f32,
    step: ti.f32,
    scene: ti.i32,
    arrays: ti.template(),
    marks: ti.i32,
):
    """The step of its own that a particle begins in this substep (see acts). Times are in s, within the interval.

    `strained` says until when the steps before have strained the particle, less than 0 before the first of all;
    `covered` until when their stress acts; `spread` whether evenly. From block[marks] on lie the marks of mark_changed,
    one a block, then those of _alike_around.

    Returns how long the step strains the particle; the new `strained` and `covered`; how many substeps the stress acts
    for; the new `spread`; and for how long the stress acts in this substep: for the substep where evenly, else for all
    of the step that the one before did not cover.

    In a synchronised interval stress acts from half a step before to half a step after the time that it is of. The
    first, of the interval's begin, and the last, of its end, act for half a step. What is left to strain is cut into as
    few equal steps as the particle's own stiffness allows, rounded down to substeps. `alike` is how many substeps such
    a step has; particles that keep the same `alike` have the same steps. In an interval that is not synchronised, and
    in the last substep of each, a step is a substep.
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
