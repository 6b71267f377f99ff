"""The particles of a team's scene: which block has which, their state in memory, and their order.

State is stored by field, `state[copy, field, particle]`, in two copies; sorting goes from one to the other.
"""

import taichi as ti

from datagen.mpm.device_memory import load, store
from datagen.mpm.layout import BLOCK, BLOCK_NODES, FIELD, LIVE, SETTING, TAG
from datagen.mpm.mls_mpm import base_node, node_place
from datagen.mpm.team_meeting import meet_team, wait

COPIED = 16  # fields at once


@ti.func
def dealt(own: ti.i32, part: ti.i32, chunk: ti.i32, blocks: ti.i32) -> ti.i32:
    """Which of a scene's particles a block's own one is: they are dealt out in chunks, so that no block has all of
    what takes long.
    """
    return (own // chunk * blocks + part) * chunk + own % chunk


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
    """A matrix from xx, yy, zz, xy, xz, yz."""
    s = ti.Vector([load(state, place + (field + i) * stride) for i in range(6)])
    return ti.Matrix([[s[0], s[3], s[4]], [s[3], s[1], s[5]], [s[4], s[5], s[2]]])


@ti.func
def put_symmetric(state: ti.template(), place: ti.i32, stride: ti.i32, field: ti.template(), value):
    for i, row, column in ti.static(((0, 0, 0), (1, 1, 1), (2, 2, 2), (3, 0, 1), (4, 0, 2), (5, 1, 2))):
        store(state, place + (field + i) * stride, value[row, column])


@ti.func
def _cell(x, scene: ti.i32, setting: ti.template(), shape: ti.template()) -> ti.i32:
    """The number of a particle's cell in the order: BLOCK of them above each other are a column. Material falls, so
    what follows in a column stays beside each other for longest.
    """
    base = base_node(x, setting[SETTING.inverse_cell_size])
    place = node_place(base, scene, shape)
    column = (place // BLOCK_NODES * BLOCK + (base[0] & 3)) * BLOCK + (base[2] & 3)
    return column * BLOCK + (base[1] & 3)


@ti.func
def sort(
    owned: ti.i32,
    part: ti.i32,
    chunk: ti.i32,
    blocks: ti.i32,
    scene: ti.i32,
    first: ti.i32,
    copy: ti.i32,
    segment: ti.i32,
    at: ti.i32,
    lane: ti.i32,
    meetings: ti.template(),
    stride: ti.i32,
    state: ti.template(),
    tag: ti.template(),
    rank: ti.template(),
    cell_count: ti.template(),
    column_count: ti.template(),
    column_list: ti.template(),
    columns: ti.template(),
    live: ti.template(),
    meeting: ti.template(),
    patience: ti.i32,
    setting: ti.template(),
    shape: ti.template(),
    fields: ti.template(),
    threads: ti.template(),
    several: ti.template(),
):
    """Copies all particles to the other copy, in the order of their columns; a meeting at its end."""
    own = lane
    while own < owned:
        p = dealt(own, part, chunk, blocks)
        cell = _cell(
            get_vector(state, copy * fields * stride + first + p, stride, FIELD.position), scene, setting, shape
        )
        rank[first + p] = ti.atomic_add(cell_count[cell], 1)
        if ti.atomic_add(column_count[cell // BLOCK], 1) == 0:
            listed = ti.atomic_add(columns[segment], 1)
            column_list[first + dealt(listed, part, chunk, blocks)] = cell // BLOCK
        own += threads
    meet_team(at, lane, meetings, meeting, columns, segment, patience, threads, several, blocks)
    # the columns that a block came upon first stay together
    c = lane
    while c < columns[segment]:
        ti.atomic_add(columns[segment + 1], column_count[column_list[first + dealt(c, part, chunk, blocks)]])
        c += threads
    wait(threads)
    if lane == 0:
        columns[segment + 1] = ti.atomic_add(live[scene * LIVE.length + LIVE.cursor], columns[segment + 1])
    wait(threads)
    c = lane
    while c < columns[segment]:
        column = column_list[first + dealt(c, part, chunk, blocks)]
        begin = ti.atomic_add(columns[segment + 1], column_count[column])
        for n in range(BLOCK):
            count = cell_count[column * BLOCK + n]
            cell_count[column * BLOCK + n] = begin
            begin += count
        c += threads
    meet_team(at, lane, meetings, meeting, columns, segment, patience, threads, several, blocks)
    own = lane
    while own < owned:
        p = dealt(own, part, chunk, blocks)
        source = copy * fields * stride + first + p
        cell = _cell(get_vector(state, source, stride, FIELD.position), scene, setting, shape)
        # within memory also where blocks leave, and counts are not whole
        place = ti.min(first + cell_count[cell] + rank[first + p], stride - 1)
        target = (1 - copy) * fields * stride + place
        for group in ti.static(range(0, fields, COPIED)):
            values = ti.Vector(
                [load(state, source + field * stride) for field in range(group, min(group + COPIED, fields))]
            )
            for i in ti.static(range(values.n)):
                store(state, target + (group + i) * stride, values[i])
        for i in ti.static(range(TAG.length)):
            tag[((1 - copy) * TAG.length + i) * stride + place] = tag[(copy * TAG.length + i) * stride + first + p]
        own += threads
    meet_team(at, lane, meetings, meeting, columns, segment, patience, threads, several, blocks)
    c = lane
    while c < columns[segment]:
        column = column_list[first + dealt(c, part, chunk, blocks)]
        column_count[column] = 0
        for n in range(BLOCK):
            cell_count[column * BLOCK + n] = 0
        c += threads
    wait(threads)
    if lane == 0:
        columns[segment] = 0
        columns[segment + 1] = 0
        live[scene * LIVE.length + LIVE.cursor] = 0
