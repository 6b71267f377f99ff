"""Lists of the particles of a thread block that act in a substep within an interval.

If particles take their own steps, about a third of them act in a substep. With one thread per particle half of a warp
would wait, so threads process lists. If a thread has at most one particle (`run` is 1), there are no lists, and
`giving` contains IDLE for inactive particles. In an interval that is not synchronised all particles act.

A block lists its own particles, counted from the scene's first. `column_list` has particles that begin a step and,
backwards from its end, particles that continue a step whose stress acts evenly. `giving` has both in order, with -1 - p
for a continuing particle p. Lists have the indices of the block's own particles (see team_particles.dealt). Their
lengths are columns[segment + ACTING], columns[segment + GOING_ON] and columns[segment + GIVING].
"""

import taichi as ti

from datagen.mpm.layout import COUNT, FIELD, SETTING, SHAPE
from datagen.mpm.multiple_time_stepping import acts, mark_changed
from datagen.mpm.team_particles import dealt, get_vector
from datagen.mpm.team_sync import ACTING, GOING_ON, WARP

FULL = 0xFFFFFFFF  # mask of all threads of a warp
IDLE = -(2**31)


@ti.func
def _places(entry, arrays: ti.template(), thread: ti.template()):
    """Returns the positions of this thread's new entries in the three lists. entry[i] is 1 if list i gets an entry.

    All threads of a warp get their positions at the same time, in thread order.
    """
    before = ti.Vector([0, 0, 0])
    if ti.static(arrays.threads > 1):
        # one number contains three counts of at most 32
        own = entry[0] | entry[1] << 8 | entry[2] << 16
        total = own
        for step in ti.static((1, 2, 4, 8, 16)):
            below = ti.simt.warp.shfl_up_i32(ti.u32(FULL), total, step)
            if thread.lane % WARP >= step:
                total += below
        begin = ti.Vector([0, 0, 0])
        if thread.lane % WARP == WARP - 1:
            for i in ti.static(range(3)):
                count = total >> (8 * i) & 255
                if count > 0:
                    begin[i] = ti.atomic_add(arrays.columns[thread.segment + ACTING + i], count)
        for i in ti.static(range(3)):
            begin[i] = ti.simt.warp.shfl_sync_i32(ti.u32(FULL), begin[i], WARP - 1)
            before[i] = begin[i] + ((total - own) >> (8 * i) & 255)
    else:
        for i in ti.static(range(3)):
            if entry[i] == 1:
                before[i] = ti.atomic_add(arrays.columns[thread.segment + ACTING + i], 1)
    return before


@ti.func
def list_acting(share: ti.template(), thread: ti.template(), step: ti.f32, arrays: ti.template()):
    """Makes the block's lists for a substep after the first of an interval. Their lengths must be 0."""
    rounds = (share.owned + arrays.threads - 1) // arrays.threads
    for around in range(rounds):
        own = around * arrays.threads + thread.lane
        entry = ti.Vector([0, 0, 0])
        p = -1
        if own < share.owned:
            p = dealt(own, thread, share.chunk)
            spreads = arrays.spread[share.first + p]
            if acts(arrays.covered[share.first + p], 0.0, step, share.scene, arrays.scene_value):
                entry = ti.Vector([1, 0, 1])
            elif spreads == 1:
                entry = ti.Vector([0, 1, 1])
        place = _places(entry, arrays, thread)
        if entry[0] == 1:
            arrays.column_list[share.first + dealt(place[0], thread, share.chunk)] = p
        if entry[1] == 1:
            arrays.column_list[share.first + dealt(share.owned - 1 - place[1], thread, share.chunk)] = p
        if entry[2] == 1:
            arrays.giving[share.first + dealt(place[2], thread, share.chunk)] = p if entry[0] == 1 else -1 - p


@ti.func
def mark_going_on(share: ti.template(), thread: ti.template(), particles: ti.i32, arrays: ti.template()):
    """Marks the blocks of nodes of particles that continue a step whose stress acts evenly (see mark_changed)."""
    count = arrays.columns[thread.segment + GOING_ON]
    own = thread.lane
    while own < count:
        p = arrays.column_list[share.first + dealt(share.owned - 1 - own, thread, share.chunk)]
        own += arrays.threads
        _mark(p, share.scene, particles, thread.stride, arrays)


@ti.func
def start_lists(thread: ti.template(), columns: ti.template()):
    """Sets the lists' lengths to 0. All threads of the block see this after the next barrier."""
    if thread.lane == 0:
        for i in ti.static(range(3)):
            columns[thread.segment + ACTING + i] = 0


@ti.func
def gives_now(
    p: ti.i32, share: ti.template(), step: ti.f32, particles: ti.i32, stride: ti.i32, some_wait: ti.i32,
    arrays: ti.template(),
) -> ti.i32:  # fmt: skip
    """Returns whether a particle begins its own step, and writes the particle's entry in `giving`.

    With `some_wait` it also marks the blocks of a particle that continues its step. Here entry p is that of particle p.
    """
    begins_own = acts(arrays.covered[share.first + p], 0.0, step, share.scene, arrays.scene_value)
    if begins_own:
        arrays.giving[share.first + p] = p
    elif arrays.spread[share.first + p] == 1:
        arrays.giving[share.first + p] = -1 - p
        if some_wait:
            _mark(p, share.scene, particles, stride, arrays)
    else:
        arrays.giving[share.first + p] = IDLE
    return begins_own


@ti.func
def _mark(p: ti.i32, scene: ti.i32, particles: ti.i32, stride: ti.i32, arrays: ti.template()):
    x = get_vector(arrays.state, particles + p, stride, FIELD.position)
    now = ti.cast(arrays.counter[scene, COUNT.substeps], ti.i32)
    mark_changed(
        x, scene, now, 1.0, arrays.setting[SETTING.inverse_cell_size], arrays, 3 * arrays.shape[SHAPE.all_blocks]
    )
