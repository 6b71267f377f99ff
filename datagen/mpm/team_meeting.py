"""How the thread blocks of a team wait for each other: at a counter in global memory, where several share a scene.

`threads` of a block are 1 on a CPU, where nothing has to be waited for within it.
"""

import taichi as ti

from datagen.mpm.layout import LIVE, SHAPE, VALUE
from datagen.mpm.time_step import choose_time_step, raise_maximum

WARP = 32
MEETING = 96  # integers of a team, in thirds: how many blocks have come, how often all were let go, its next scene


@ti.func
def wait(threads: ti.template()):
    """Until the whole block is here, and sees what each has written."""
    if ti.static(threads > 1):
        ti.simt.block.sync()


@ti.func
def fence(threads: ti.template()):
    """What the block wrote is seen by whoever sees what this thread writes next, and the other way round."""
    if ti.static(threads > 1):
        ti.simt.grid.memfence()


@ti.func
def await_count(meeting: ti.template(), entry: ti.i32, target: ti.i32, threads: ti.template()):
    while ti.atomic_max(meeting[entry], 0) < target:  # Taichi has no load that passes by the caches
        pass
    fence(threads)


@ti.func
def meet_team(
    team: ti.i32,
    lane: ti.i32,
    meetings: ti.template(),
    meeting: ti.template(),
    threads: ti.template(),
    several: ti.template(),
    blocks: ti.i32,
):
    """Until the whole team is here, and sees what each has written; `meetings` counts a block's own."""
    wait(threads)
    if ti.static(several):
        if lane == 0:
            meetings += 1
            fence(threads)
            ti.atomic_add(meeting[team * MEETING], 1)
            await_count(meeting, team * MEETING, meetings * blocks, threads)
        wait(threads)


@ti.func
def choose(
    scene: ti.i32,
    scene_value: ti.template(),
    counter: ti.template(),
    setting: ti.template(),
    shape: ti.template(),
    live: ti.template(),
):
    choose_time_step(scene, scene_value, counter, setting, shape[SHAPE.maximum_substeps])
    if scene_value[scene, VALUE.begins] == 1.0:
        live[scene * LIVE.length + LIVE.blocks] = 0


@ti.func
def meet_and_choose(
    team: ti.i32,
    lane: ti.i32,
    scene: ti.i32,
    meetings: ti.template(),
    choices: ti.template(),
    meeting: ti.template(),
    scene_value: ti.template(),
    counter: ti.template(),
    setting: ti.template(),
    shape: ti.template(),
    live: ti.template(),
    threads: ti.template(),
    several: ti.template(),
    blocks: ti.i32,
):
    """A meeting where the last block to come chooses the next step; `choices` counts them."""
    wait(threads)
    if lane == 0:
        last = 1
        if ti.static(several):
            meetings += 1
            choices += 1
            fence(threads)
            if ti.atomic_add(meeting[team * MEETING], 1) != meetings * blocks - 1:
                last = 0
        if last == 1:
            if ti.static(several):
                fence(threads)
            choose(scene, scene_value, counter, setting, shape, live)
            if ti.static(several):
                fence(threads)
                ti.atomic_add(meeting[team * MEETING + MEETING // 3], 1)
        if ti.static(several):
            await_count(meeting, team * MEETING + MEETING // 3, choices, threads)
    wait(threads)


@ti.func
def raise_by_warps(
    lane: ti.i32,
    counter: ti.template(),
    scene: ti.i32,
    entry: ti.template(),
    value: ti.f32,
    threads: ti.template(),
):
    """raise_maximum for all threads of a block, one for a warp."""
    if ti.static(threads > 1):
        bits = ti.bit_cast(ti.max(value, 0.0), ti.i32)
        for step in ti.static((16, 8, 4, 2, 1)):
            bits = ti.max(bits, ti.simt.warp.shfl_down_i32(ti.u32(0xFFFFFFFF), bits, step))
        if lane % WARP == 0 and bits > 0:
            ti.atomic_max(counter[scene, entry], ti.cast(bits, ti.i64))  # without a look, which would be waited for
    else:
        raise_maximum(counter, scene, entry, value)
