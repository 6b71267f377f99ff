"""Barriers between the thread blocks of a team: counters in global memory.

On a CPU a block has one thread. A block reads a counter at most `patience` times, because blocks that do not run
concurrently would wait for each other forever. Then the block sets sync[APART] and columns[segment + LEAVES]. All
blocks leave the launch, and the launch's results are discarded.
"""

import taichi as ti

from datagen.mpm.body_kernel import move_bodies
from datagen.mpm.layout import LIVE, SHAPE, VALUE, VARIANT
from datagen.mpm.time_step import choose_time_step, raise_maximum

WARP = 32
SYNC_LENGTH = 96  # number of a team's integers; each third begins with one: arrived blocks, releases, the next turn
TURN = 2 * SYNC_LENGTH // 3
QUEUE, APART = 0, 1  # before the teams' integers: number of turns taken, and 1 if blocks do not run concurrently
SEGMENT, LEAVES = 6, 2  # number of a block's integers in `columns`, and the index of its flag to leave the launch
ACTING, GOING_ON, GIVING = 3, 4, 5  # indices of the lengths of the block's lists (see team_lists)
NO_LIMIT = 2**31 - 1  # number of reads of a counter without a limit
CHECK_READS = 64  # number of reads of a counter between two checks whether all leave


@ti.func
def wait(threads: ti.template()):
    """Waits until all threads of the block have called it. Each thread then sees the writes of all others."""
    if ti.static(threads > 1):
        ti.simt.block.sync()


@ti.func
def fence(threads: ti.template()):
    """Orders memory: other blocks that see this thread's next writes also see its earlier ones, and vice versa."""
    if ti.static(threads > 1):
        ti.simt.grid.memfence()


@ti.func
def await_count(arrays: ti.template(), entry: ti.i32, target: ti.i32, segment: ti.i32, patience: ti.i32):
    reads = 0
    while reads >= 0:
        if ti.atomic_max(arrays.sync[entry], 0) >= target:  # Taichi has no load that bypasses the caches
            reads = -1
        else:
            reads += 1
            if reads % CHECK_READS == 0:
                apart = ti.atomic_max(arrays.sync[APART], 0)
                if apart > 0 or reads >= patience:
                    ti.atomic_max(arrays.sync[APART], 1)
                    arrays.columns[segment + LEAVES] = 1
                    reads = -1
    fence(arrays.threads)


@ti.func
def sync_team(thread: ti.template(), syncs: ti.template(), arrays: ti.template()):
    """Waits until the whole team has called it. Each thread then sees all writes. `syncs` counts the calls."""
    wait(arrays.threads)
    if ti.static(arrays.several):
        if thread.lane == 0:
            syncs += 1
            fence(arrays.threads)
            ti.atomic_add(arrays.sync[thread.at], 1)
            await_count(arrays, thread.at, syncs * thread.blocks, thread.segment, thread.patience)
        wait(arrays.threads)


@ti.func
def take_turn(at: ti.i32, sync: ti.template()):
    """Gives the team whose integers begin at `at` the next turn. Teams get turns in the order in which they ask."""
    sync[at + TURN] = ti.atomic_add(sync[QUEUE], 1)


@ti.func
def leave_scene(entry: ti.i32, lane: ti.i32, arrays: ti.template()):
    """Adds 1 to sync[entry], the number of blocks that have finished a turn with the scene."""
    wait(arrays.threads)
    if lane == 0:
        fence(arrays.threads)
        ti.atomic_add(arrays.sync[entry], 1)


@ti.func
def await_scene(entry: ti.i32, count: ti.i32, thread: ti.template(), arrays: ti.template()):
    """Waits until `count` blocks have left the scene, without a limit: the team that computes the scene is running,
    because it took its turn earlier."""
    if thread.lane == 0:
        await_count(arrays, entry, count, thread.segment, NO_LIMIT)


@ti.func
def choose(scene: ti.i32, arrays: ti.template()):
    choose_time_step(scene, arrays.scene_value, arrays.counter, arrays.setting, arrays.shape[SHAPE.maximum_substeps])
    if arrays.scene_value[scene, VALUE.begins] == 1.0:
        arrays.live[scene * LIVE.length + LIVE.blocks] = 0
    if ti.static(bool(arrays.variant & VARIANT.moving)):
        move_bodies(scene, arrays)


@ti.func
def sync_and_choose(
    thread: ti.template(), scene: ti.i32, syncs: ti.template(), choices: ti.template(), arrays: ti.template()
):
    """Waits for the team. The last block to arrive chooses the next step. `choices` counts these calls."""
    wait(arrays.threads)
    if thread.lane == 0:
        last = 1
        if ti.static(arrays.several):
            syncs += 1
            choices += 1
            fence(arrays.threads)
            if ti.atomic_add(arrays.sync[thread.at], 1) != syncs * thread.blocks - 1:
                last = 0
        if last == 1:
            if ti.static(arrays.several):
                fence(arrays.threads)
            choose(scene, arrays)
            if ti.static(arrays.several):
                fence(arrays.threads)
                ti.atomic_add(arrays.sync[thread.at + SYNC_LENGTH // 3], 1)
        if ti.static(arrays.several):
            await_count(arrays, thread.at + SYNC_LENGTH // 3, choices, thread.segment, thread.patience)
    wait(arrays.threads)


@ti.func
def raise_by_warps(lane: ti.i32, arrays: ti.template(), scene: ti.i32, entry: ti.template(), value: ti.f32):
    """Computes raise_maximum for the values of all threads of a block, with one atomic operation per warp."""
    if ti.static(arrays.threads > 1):
        bits = ti.bit_cast(ti.max(value, 0.0), ti.i32)
        for step in ti.static((16, 8, 4, 2, 1)):
            bits = ti.max(bits, ti.simt.warp.shfl_down_i32(ti.u32(0xFFFFFFFF), bits, step))
        if lane % WARP == 0 and bits > 0:
            ti.atomic_max(
                arrays.counter[scene, entry], ti.cast(bits, ti.i64)
            )  # no read before, because it would wait for memory
    else:
        raise_maximum(arrays.counter, scene, entry, value)
