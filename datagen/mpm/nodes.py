"""Nodes of the grid for Taichi kernels: their indices in arrays, and quadratic B-splines between them and particles.

A particle at x reaches the nodes base .. base + 2 with base = floor(x / dx - 1/2). Node I lies at I dx. Nodes are
stored by blocks of 4 x 4 x 4, [scene, block, node in block].
"""

import taichi as ti

from datagen.mpm.layout import BLOCK, BLOCK_NODES, SHAPE, VARIANT


@ti.func
def weights(fx):
    """Returns, per axis, the quadratic B-spline weights of nodes 0, 1, 2 for an offset fx in [0.5, 1.5) cells."""
    return (0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2)


@ti.func
def spline(distance: ti.f32) -> ti.f32:
    """Returns the weight of a node from its distance along one axis, in (-1.5, 1.5) cells."""
    away = ti.abs(distance)
    outer = 1.5 - away
    return 0.75 - away * away if away < 0.5 else 0.5 * outer * outer


@ti.func
def _node_of_axis(index, stride: ti.i32, local_stride: ti.i32):
    """Returns the part of a node's array index that depends on one axis; the index is the sum over the axes."""
    return (index >> 2) * stride + (index & 3) * local_stride


@ti.func
def base_node(x, inverse_dx: ti.f32):
    return ti.floor(x * inverse_dx - 0.5, ti.i32)


@ti.func
def corner_block(first, last, n: ti.template(), scene: ti.i32, shape: ti.template()) -> ti.i32:
    """Returns the index of corner n (0 to 7) of the blocks `first` to `last` that contain a particle's nodes."""
    corner = ti.Vector([last[axis] if n >> (2 - axis) & 1 else first[axis] for axis in range(3)])
    index = (corner[0] * shape[SHAPE.blocks + 1] + corner[1]) * shape[SHAPE.blocks + 2] + corner[2]
    return index + scene * shape[SHAPE.scene_blocks]


@ti.func
def mark(
    x, scene: ti.i32, inverse_dx: ti.f32, arrays: ti.template(), list_begin: ti.i32, length: ti.template(),
    length_at: ti.i32,
):  # fmt: skip
    """Adds the blocks of a particle's nodes, up to eight, to a list.

    `block` begins with a flag for each of the all_blocks blocks of all scenes. The list of the indices of touched
    blocks begins at `list_begin` and has length[length_at] entries. The coordinates of an entry's block along x, y, z,
    in ten bits each, are stored all_blocks after the entry.
    """
    base = base_node(x, inverse_dx)
    first = base >> 2
    last = (base + 2) >> 2
    index = ti.Vector([corner_block(first, last, n, scene, arrays.shape) for n in range(8)])
    flag = ti.Vector([arrays.block[index[n]] for n in range(8)])  # loads are issued together to hide the latency
    for n in ti.static(range(8)):
        fresh = flag[n] == 0
        for axis in ti.static(range(3)):
            if ti.static(bool(n >> (2 - axis) & 1)):
                fresh = fresh and first[axis] != last[axis]
        if fresh:
            if ti.atomic_max(arrays.block[index[n]], 1) == 0:
                entry = list_begin + ti.atomic_add(length[length_at], 1)
                arrays.block[entry] = index[n]
                corner = ti.Vector([last[axis] if n >> (2 - axis) & 1 else first[axis] for axis in range(3)])
                arrays.block[entry + arrays.shape[SHAPE.all_blocks]] = (corner[0] << 20) | (corner[1] << 10) | corner[2]


@ti.func
def node_places(base, first_entry: ti.i32, shape: ti.template(), entries: ti.template()):
    """Returns the array indices of nodes base .. base + 2 by axis, for `entries` numbers per node.

    Node base + (i, j, k) begins at the sum of entries i, j and k of the three results. The scene is at `first_entry`.
    """
    stride_z = BLOCK_NODES * entries
    stride_y = shape[SHAPE.blocks + 2] * stride_z
    stride_x = shape[SHAPE.blocks + 1] * stride_y
    offset = ti.Vector([0, 1, 2])
    return (
        first_entry + _node_of_axis(base[0] + offset, stride_x, BLOCK * BLOCK * entries),
        _node_of_axis(base[1] + offset, stride_y, BLOCK * entries),
        _node_of_axis(base[2] + offset, stride_z, entries),
    )


@ti.func
def node_place(index, scene: ti.i32, shape: ti.template()) -> ti.i32:
    """Returns a node's index in arrays of one entry per node."""
    block = index >> 2
    local = index & 3
    place = (block[0] * shape[SHAPE.blocks + 1] + block[1]) * shape[SHAPE.blocks + 2] + block[2]
    place = (scene * shape[SHAPE.scene_blocks] + place) * BLOCK_NODES
    return place + (local[0] * BLOCK + local[1]) * BLOCK + local[2]


@ti.func
def second_field(place: ti.i32, scene: ti.i32, arrays: ti.template()) -> ti.i32:
    """Returns the index of a node's second field among second fields, or -1. In a scene with moving sheets all nodes
    have one (see body_arrays)."""
    field = arrays.contact[place]
    if field >= arrays.shape[SHAPE.ghosts]:
        field = -1
    if ti.static(bool(arrays.variant & VARIANT.moving_sheets)):
        begin = arrays.contact[arrays.shape[SHAPE.second_fields] + scene]
        if begin >= 0:
            field = begin + place - scene * arrays.shape[SHAPE.scene_blocks] * BLOCK_NODES
    return field


@ti.func
def ghost_place(index, scene: ti.i32, arrays: ti.template()) -> ti.i32:
    """Returns the index of a node's second field in `node`, in nodes."""
    return arrays.shape[SHAPE.ghost_begin] + second_field(node_place(index, scene, arrays.shape), scene, arrays)


@ti.func
def interpolate(x, first_node: ti.i32, arrays: ti.template(), inverse_dx: ti.f32):
    """Returns the velocity at x and its gradient, APIC's C in 1/s. `first_node` is the scene's first node."""
    scaled = x * inverse_dx
    base = ti.floor(scaled - 0.5, ti.i32)
    fx = scaled - ti.cast(base, ti.f32)
    w0, w1, w2 = weights(fx)
    w = ti.static((w0, w1, w2))
    index_x, index_y, index_z = node_places(base, first_node, arrays.shape, 1)
    v = ti.Vector([0.0, 0.0, 0.0])
    gradient_x = ti.Vector([0.0, 0.0, 0.0])
    gradient_y = ti.Vector([0.0, 0.0, 0.0])
    gradient_z = ti.Vector([0.0, 0.0, 0.0])
    for i in ti.static(range(3)):
        plane = ti.Vector([0.0, 0.0, 0.0])
        plane_y = ti.Vector([0.0, 0.0, 0.0])
        plane_z = ti.Vector([0.0, 0.0, 0.0])
        for j in ti.static(range(3)):
            line = ti.Vector([0.0, 0.0, 0.0])
            line_z = ti.Vector([0.0, 0.0, 0.0])
            for k in ti.static(range(3)):
                whole = arrays.node[index_x[i] + index_y[j] + index_z[k]]
                share = w[k][2] * ti.Vector([whole[0], whole[1], whole[2]])
                line += share
                line_z += (k - fx[2]) * share
            plane += w[j][1] * line
            plane_y += w[j][1] * (j - fx[1]) * line
            plane_z += w[j][1] * line_z
        v += w[i][0] * plane
        gradient_x += w[i][0] * (i - fx[0]) * plane
        gradient_y += w[i][0] * plane_y
        gradient_z += w[i][0] * plane_z
    return v, ti.Matrix.cols([gradient_x, gradient_y, gradient_z]) * (4.0 * inverse_dx)


@ti.func
def interpolate_hidden(x, v, C, hidden: ti.i32, scene: ti.i32, arrays: ti.template(), inverse_dx: ti.f32):
    """Returns v and C of `interpolate`, corrected to use the second fields of hidden nodes instead of the first."""
    scaled = x * inverse_dx
    base = ti.floor(scaled - 0.5, ti.i32)
    new_v = v
    new_C = C
    bits = hidden
    n = 0
    while bits != 0:
        if bits & 1:
            index = base + ti.Vector([n // 9, n // 3 % 3, n % 3])
            offset = ti.cast(index, ti.f32) - scaled
            place = node_place(index, scene, arrays.shape)
            ghost = arrays.shape[SHAPE.ghost_begin] + second_field(place, scene, arrays)
            difference = arrays.node[ghost] - arrays.node[place]
            change = ti.Vector([difference[0], difference[1], difference[2]])
            change *= spline(offset[0]) * spline(offset[1]) * spline(offset[2])
            new_v += change
            new_C += (4.0 * inverse_dx) * change.outer_product(offset)
        bits >>= 1
        n += 1
    return new_v, new_C
