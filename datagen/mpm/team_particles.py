"""The particles of a team's scene: their distribution over blocks, their state in memory, and their order.

State is stored by field, `state[copy, field, particle]`, in two copies. Sorting writes one from the other.
"""

from collections import namedtuple

import taichi as ti

from datagen.mpm.device_memory import load, store
from datagen.mpm.layout import BLOCK, BLOCK_NODES, FIELD, LIVE, SETTING, TAG
from datagen.mpm.nodes import base_node, node_place
from datagen.mpm.team_sync import sync_team, wait

COPIED = 16  # number of fields that are copied together

# Variables that the kernel's functions take as one argument.
# Thread: the thread's number in its block, the block's number in the team, the team's number of blocks; the thread's
# number in the team, and the team's number of threads; the number of all particles; the indices at which velocities
# begin in `node`, the team's integers in `sync`, the block's in `columns`; the most reads of a counter.
Thread = namedtuple(
    "Thread", ["lane", "part", "blocks", "member", "members", "stride", "velocities", "at", "segment", "patience"]
)
# Share: the scene of a block's particles, its first particle, the number of consecutive particles that are dealt out
# together, and the number of the block's particles.
Share = namedtuple("Share", ["scene", "first", "chunk", "owned"])


@ti.func
def dealt(own: ti.i32, thread: ti.template(), chunk: ti.i32) -> ti.i32:
    """Returns the index in the scene of a block's particle `own`. Chunks go to the blocks in turn, to balance work."""
    return (own // chunk * thread.blocks + thread.part) * chunk + own % chunk


@ti.func
def get_vector(state: ti.template(), place: ti.i32, stride: ti.i32, field: ti.template()):
    return ti.Vector([load(state, place + (field + i) * stride) for i in range(3)])


@ti.func
def get_matrix(state: ti.template(), place: ti.i32, stride: ti.i32, field: ti.template()):
    return ti.Matrix([[load(state, place + (field + 3 * i + j) * stride) for j in range(3)] for i in range(3)])


@ti.func
def put_vector(state: ti.template(), place: ti.i32, stride: ti.i32, field: ti.template(), value):
    for i in ti.static(range(3)):
        store(state, place + (field + i) * stride, value[i])


@ti.func
def put_matrix(state: ti.template(), place: ti.i32, stride: ti.i32, field: ti.template(), value):
    for i, j in ti.static(ti.ndrange(3, 3)):
        store(state, place + (field + 3 * i + j) * stride, value[i, j])


@ti.func
def get_symmetric(state: ti.template(), place: ti.i32, stride: ti.i32, field: ti.template()):
    """Returns a symmetric matrix stored as xx, yy, zz, xy, xz, yz."""
    s = ti.Vector([load(state, place + (field + i) * stride) for i in range(6)])
    return ti.Matrix([[s[0], s[3], s[4]], [s[3], s[1], s[5]], [s[4], s[5], s[2]]])


@ti.func
def put_symmetric(state: ti.template(), place: ti.i32, stride: ti.i32, field: ti.template(), value):
    for i, row, column in ti.static(((0, 0, 0), (1, 1, 1), (2, 2, 2), (3, 0, 1), (4, 0, 2), (5, 1, 2))):
        store(state, place + (field + i) * stride, value[row, column])


@ti.func
def _cell(x, scene: ti.i32, arrays: ti.template()) -> ti.i32:
    """Returns the number of a particle's cell in the sorted order. BLOCK cells above each other form a column.

    Most material falls, so particles of a column stay neighbours longest.
    """
    base = base_node(x, arrays.setting[SETTING.inverse_cell_size])
    place = node_place(base, scene, arrays.shape)
    column = (place // BLOCK_NODES * BLOCK + (base[0] & 3)) * BLOCK + (base[2] & 3)
    return column * BLOCK + (base[1] & 3)


@ti.func
def sort(
    share: ti.template(), thread: ti.template(), copy: ti.i32, syncs: ti.template(), arrays: ti.template(),
    fields: ti.template(),
):  # fmt: skip
    """Copies all particles to the other copy in the order of their columns. It ends with a barrier of the team."""
    own = thread.lane
    while own < share.owned:
        p = dealt(own, thread, share.chunk)
        cell = _cell(
            get_vector(arrays.state, copy * fields * thread.stride + share.first + p, thread.stride, FIELD.position),
            share.scene,
            arrays,
        )
        arrays.rank[share.first + p] = ti.atomic_add(arrays.cell_count[cell], 1)
        if ti.atomic_add(arrays.column_count[cell // BLOCK], 1) == 0:
            listed = ti.atomic_add(arrays.columns[thread.segment], 1)
            arrays.column_list[share.first + dealt(listed, thread, share.chunk)] = cell // BLOCK
        own += arrays.threads
    sync_team(thread, syncs, arrays)
    # columns that the same block was the first to find stay together
    c = thread.lane
    while c < arrays.columns[thread.segment]:
        ti.atomic_add(
            arrays.columns[thread.segment + 1],
            arrays.column_count[arrays.column_list[share.first + dealt(c, thread, share.chunk)]],
        )
        c += arrays.threads
    wait(arrays.threads)
    if thread.lane == 0:
        arrays.columns[thread.segment + 1] = ti.atomic_add(
            arrays.live[share.scene * LIVE.length + LIVE.cursor], arrays.columns[thread.segment + 1]
        )
    wait(arrays.threads)
    c = thread.lane
    while c < arrays.columns[thread.segment]:
        column = arrays.column_list[share.first + dealt(c, thread, share.chunk)]
        begin = ti.atomic_add(arrays.columns[thread.segment + 1], arrays.column_count[column])
        for n in range(BLOCK):
            count = arrays.cell_count[column * BLOCK + n]
            arrays.cell_count[column * BLOCK + n] = begin
            begin += count
        c += arrays.threads
    sync_team(thread, syncs, arrays)
    own = thread.lane
    while own < share.owned:
        p = dealt(own, thread, share.chunk)
        source = copy * fields * thread.stride + share.first + p
        cell = _cell(get_vector(arrays.state, source, thread.stride, FIELD.position), share.scene, arrays)
        # bounded, because counts are incomplete if blocks have left the launch
        place = ti.min(share.first + arrays.cell_count[cell] + arrays.rank[share.first + p], thread.stride - 1)
        target = (1 - copy) * fields * thread.stride + place
        for group in ti.static(range(0, fields, COPIED)):
            values = ti.Vector(
                [
                    load(arrays.state, source + field * thread.stride)
                    for field in range(group, min(group + COPIED, fields))
                ]
            )
            for i in ti.static(range(values.n)):
                store(arrays.state, target + (group + i) * thread.stride, values[i])
        for i in ti.static(range(TAG.length)):
            arrays.tag[((1 - copy) * TAG.length + i) * thread.stride + place] = arrays.tag[
                (copy * TAG.length + i) * thread.stride + share.first + p
            ]
        own += arrays.threads
    sync_team(thread, syncs, arrays)
    c = thread.lane
    while c < arrays.columns[thread.segment]:
        column = arrays.column_list[share.first + dealt(c, thread, share.chunk)]
        arrays.column_count[column] = 0
        for n in range(BLOCK):
            arrays.cell_count[column * BLOCK + n] = 0
        c += arrays.threads
    wait(arrays.threads)
    if thread.lane == 0:
        arrays.columns[thread.segment] = 0
        arrays.columns[thread.segment + 1] = 0
        arrays.live[share.scene * LIVE.length + LIVE.cursor] = 0
