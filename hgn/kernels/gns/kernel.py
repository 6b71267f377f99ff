"""The edges of GNS, forward and backward: an encoder, a message-passing step, their gradients by weights and senders.

Edges lie grouped by receiver. A program takes one tile of edges after the other, whatever their receivers, and reads
its weights once; many particles have few neighbours, and tiles of one receiver each would be nearly empty. What belongs
to a particle is summed by a kernel of its own, in a fixed order and without atomic additions. Forward, a step reads and
writes each edge's state once, and its message; backward, it computes the hidden layer and the norm again.
Rows of edges beyond the last offset belong to none: they are neither read nor written.
What of a program's results must be summed over programs stands in `partial`, a row of them each.
Shape legend: N particles, E edges, W width.
"""

from __future__ import annotations

import triton
import triton.language as tl

from hgn.kernels.blocks import (
    FP32_PRODUCT,
    column_sums,
    inside,
    matrix,
    nearest_tf32,
    normalise,
    normalise_backward,
    product,
    transposed,
    weighted_sums,
)
from hgn.kernels.triton_compat import settle_keys


@triton.jit
def _offset(position, near, here, live, axis: tl.constexpr):
    """Of senders from receivers along one axis; both are places in `position`."""
    return tl.load(position + near + axis, mask=live, other=0.0) - tl.load(position + here + axis, mask=live, other=0.0)


@triton.jit
def _encoder_hidden(position, sender, receiver, row, live, first, first_bias, WIDTH: tl.constexpr):
    """The hidden layer [rows, W] of offset and distance; `first` is [W, 4]."""
    column = tl.arange(0, WIDTH)
    near = tl.load(sender + row, mask=live, other=0) * 3
    here = tl.load(receiver + row, mask=live, other=0) * 3
    h = tl.zeros((row.shape[0], WIDTH), tl.float32) + tl.load(first_bias + column)[None, :]
    square = tl.zeros((row.shape[0],), tl.float32)
    for axis in tl.static_range(3):
        difference = _offset(position, near, here, live, axis)
        square += difference * difference
        h += difference[:, None] * tl.load(first + column * 4 + axis)[None, :]
    return h + tl.sqrt(square)[:, None] * tl.load(first + column * 4 + 3)[None, :]


@triton.jit
def gns_encode_forward(
    position, sender, receiver, offset, particles, first, first_bias, second, second_bias, norm_weight,
    norm_bias, edge,
    WIDTH: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """edge [E, W] from sender minus receiver and their distance.

    Reference: hgn.kernels.gns.reference; test: tests/kernels/test_kernels_alone.py.
    """
    count = tl.load(offset + particles)
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = row < count
    column = tl.arange(0, WIDTH)
    h = _encoder_hidden(position, sender, receiver, row, live, first, first_bias, WIDTH)
    z = product(tl.maximum(h, 0.0), transposed(second, WIDTH, WIDTH), PRECISION)
    z, _ = normalise(z + tl.load(second_bias + column)[None, :], WIDTH)
    z = z * tl.load(norm_weight + column)[None, :] + tl.load(norm_bias + column)[None, :]
    tl.store(edge + row[:, None] * WIDTH + column[None, :], z, mask=live[:, None])


@triton.jit
def gns_encode_norm_backward(
    gradient, position, sender, receiver, offset, particles, first, first_bias, second, second_bias,
    norm_weight, activation, second_gradient, partial,
    WIDTH: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """The encoder backward through its norm, from the edges' gradient [E, W]: activation and second_gradient [E, W] are
    the second layer's input and the gradient of its output; rows 0 and 1 of `partial` [programs, 8, W] are the norm's
    weight's and bias's.

    Reference: hgn.kernels.gns.reference; test: tests/kernels/test_kernels_alone.py.
    """
    count = tl.load(offset + particles)
    column = tl.arange(0, WIDTH)
    second_t = transposed(second, WIDTH, WIDTH)
    norm_weight_total, norm_bias_total = tl.zeros((BLOCK // 16, 8, WIDTH), tl.float32), tl.zeros((8, WIDTH), tl.float32)
    tile = tl.program_id(0).to(tl.int64)
    while tile * BLOCK < count:
        row = tile * BLOCK + tl.arange(0, BLOCK)
        live = row < count
        at = row[:, None] * WIDTH + column[None, :]
        h = _encoder_hidden(position, sender, receiver, row, live, first, first_bias, WIDTH)
        a = tl.maximum(h, 0.0)
        tl.store(activation + at, a, mask=live[:, None])
        z = product(a, second_t, PRECISION) + tl.load(second_bias + column)[None, :]
        z, scale = normalise(z, WIDTH)
        dm = tl.load(gradient + at, mask=live[:, None], other=0.0).to(tl.float32)
        if count > 0:  # see gns_norm_backward, and why 0 z
            norm_bias_total += column_sums(dm, BLOCK, WIDTH, 8)
        dm += 0.0 * z
        if count > 0:
            norm_weight_total += tl.sum(tl.reshape(dm * z, (BLOCK // 16, 2, 8, WIDTH)), 1)
        dz = normalise_backward(dm, z, scale, inside(tl.load(norm_weight + column), tile), WIDTH)
        tl.store(second_gradient + at, dz, mask=live[:, None])
        tile += tl.num_programs(0)
    mine = partial + tl.program_id(0) * 8 * WIDTH + column
    tl.store(mine, tl.sum(tl.sum(norm_weight_total, 0), 0))
    tl.store(mine + WIDTH, tl.sum(norm_bias_total, 0))


@triton.jit
def gns_encode_layers_backward(
    second_gradient, activation, position, sender, receiver, offset, particles, second, partial,
    WIDTH: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """The rest of the encoder backward: in `partial` [programs, 8, W] come last the gradients of the second bias, the
    first layer's four columns and its bias.

    Reference: hgn.kernels.gns.reference; test: tests/kernels/test_kernels_alone.py.
    """
    count = tl.load(offset + particles)
    column = tl.arange(0, WIDTH)
    second_w = matrix(second, WIDTH, WIDTH)
    bias_total = tl.zeros((8, WIDTH), tl.float32)
    axis = tl.arange(0, 16)[:, None]
    first_total = tl.zeros((16, WIDTH), tl.float32)
    tile = tl.program_id(0).to(tl.int64)
    while tile * BLOCK < count:
        row = tile * BLOCK + tl.arange(0, BLOCK)
        live = row < count
        at = row[:, None] * WIDTH + column[None, :]
        dz = tl.load(second_gradient + at, mask=live[:, None], other=0.0)
        a = tl.load(activation + at, mask=live[:, None], other=0.0)
        bias_total += tl.sum(tl.reshape(dz.to(tl.float32), (BLOCK // 8, 8, WIDTH)), 0)
        dh = tl.where(a > 0, product(dz, second_w, PRECISION), 0.0)
        near = tl.load(sender + row, mask=live, other=0) * 3
        here = tl.load(receiver + row, mask=live, other=0) * 3
        side = tl.where(axis == 4, 1.0, tl.zeros((16, BLOCK), tl.float32))
        square = tl.zeros((BLOCK,), tl.float32)
        for i in tl.static_range(3):
            difference = _offset(position, near, here, live, i)
            square += difference * difference
            side = tl.where(axis == i, difference[None, :], side)
        side = tl.where(axis == 3, tl.sqrt(square)[None, :], side)
        first_total += weighted_sums(side, dh, PRECISION)
        tile += tl.num_programs(0)
    mine = partial + (tl.program_id(0) * 8 + 2) * WIDTH
    tl.store(mine + column, tl.sum(bias_total, 0))
    tl.store(mine + (1 + axis) * WIDTH + column[None, :], first_total, mask=axis < 5)


@triton.jit
def gns_step_forward(
    edge, edge_out, message_out, send, receive, sender, receiver, offset, particles, own, second, second_bias,
    norm_weight, norm_bias,
    LAST: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """message_out [E, W]: the edges' messages. edge_out [E, W] is edge with the messages added, unless LAST.

    send and receive [N, W], stored like edges, are the particles' products with the first layer, its bias in `receive`.

    Reference: hgn.kernels.gns.reference; test: tests/kernels/test_kernels_alone.py.
    """
    count = tl.load(offset + particles)
    column = tl.arange(0, WIDTH)
    own_t = transposed(own, WIDTH, WIDTH)
    second_t = transposed(second, WIDTH, WIDTH)
    bias = tl.load(second_bias + column)
    norm_weight_row = tl.load(norm_weight + column)
    norm_bias_row = tl.load(norm_bias + column)
    tile = tl.program_id(0).to(tl.int64)
    while tile * BLOCK < count:
        row = tile * BLOCK + tl.arange(0, BLOCK)
        live = row < count
        at = row[:, None] * WIDTH + column[None, :]
        near = tl.load(sender + row, mask=live, other=0)
        here = tl.load(receiver + row, mask=live, other=0)
        state = tl.load(edge + at, mask=live[:, None], other=0.0)
        ends = tl.load(send + near[:, None] * WIDTH + column[None, :], mask=live[:, None], other=0.0)
        ends += tl.load(receive + here[:, None] * WIDTH + column[None, :], mask=live[:, None], other=0.0)
        h = product(state, own_t, PRECISION) + ends.to(tl.float32)
        z = product(tl.maximum(h, 0.0), second_t, PRECISION) + inside(bias, tile)[None, :]
        z, _ = normalise(z, WIDTH)
        message = z * inside(norm_weight_row, tile)[None, :] + inside(norm_bias_row, tile)[None, :]
        tl.store(message_out + at, message, mask=live[:, None])
        if not LAST:
            # read again: registers are dearer than a cache
            state = tl.load(edge + at, mask=live[:, None], other=0.0)
            tl.store(edge_out + at, state.to(tl.float32) + message, mask=live[:, None])
        tile += tl.num_programs(0)


@triton.jit
def gns_norm_backward(
    sum_gradient, gradient, edge, send, receive, sender, receiver, offset, particles, own, second, second_bias,
    norm_weight, activation, second_gradient, partial,
    LAST: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """A step backward through its norm, from the gradients of the sums [N, W] and of edge_out (none if LAST).

    activation and second_gradient [E, W] are the second layer's input and the gradient of its output; rows 0 and 1 of
    `partial` [programs, 3, W] are the norm's weight's and bias's. All gradients are multiplied by the graph's scale;
    those of the sums, send and receive are stored like edges.

    Reference: hgn.kernels.gns.reference; test: tests/kernels/test_kernels_alone.py.
    """
    count = tl.load(offset + particles)
    column = tl.arange(0, WIDTH)
    own_t = transposed(own, WIDTH, WIDTH)
    second_t = transposed(second, WIDTH, WIDTH)
    bias = tl.load(second_bias + column)
    norm_weight_row = tl.load(norm_weight + column)
    norm_weight_total, norm_bias_total = tl.zeros((BLOCK // 16, 8, WIDTH), tl.float32), tl.zeros((8, WIDTH), tl.float32)
    tile = tl.program_id(0).to(tl.int64)
    while tile * BLOCK < count:
        row = tile * BLOCK + tl.arange(0, BLOCK)
        live = row < count
        at = row[:, None] * WIDTH + column[None, :]
        near = tl.load(sender + row, mask=live, other=0)
        here = tl.load(receiver + row, mask=live, other=0)
        state = tl.load(edge + at, mask=live[:, None], other=0.0)
        # Both ends, and both gradients, are added as they were loaded: the sums go to the matrix units' layout once.
        ends = tl.load(send + near[:, None] * WIDTH + column[None, :], mask=live[:, None], other=0.0)
        ends += tl.load(receive + here[:, None] * WIDTH + column[None, :], mask=live[:, None], other=0.0)
        h = product(state, own_t, PRECISION) + ends.to(tl.float32)
        a = tl.maximum(h, 0.0)
        tl.store(activation + at, a, mask=live[:, None])
        summed = tl.load(sum_gradient + here[:, None] * WIDTH + column[None, :], mask=live[:, None], other=0.0)
        dm = summed.to(tl.float32)
        if not LAST:
            dm += tl.load(gradient + at, mask=live[:, None], other=0.0).to(tl.float32)
        if count > 0:  # always; else the compiler keeps the summands to the loop's end, and registers spill
            # rows that one thread has, here as they were loaded, below in the matrix units' layout
            norm_bias_total += column_sums(dm, BLOCK, WIDTH, 8)
        z = product(a, second_t, PRECISION) + inside(bias, tile)[None, :]
        z, scale = normalise(z, WIDTH)
        # 0 z: else the compiler brings z, and with it float32, to where dm was loaded
        dm = dm.to(summed.dtype).to(tl.float32) + 0.0 * z
        if count > 0:
            norm_weight_total += tl.sum(tl.reshape(dm * z, (BLOCK // 16, 2, 8, WIDTH)), 1)
        dz = normalise_backward(dm, z, scale, inside(norm_weight_row, tile), WIDTH)
        tl.store(second_gradient + at, dz, mask=live[:, None])
        tile += tl.num_programs(0)
    mine = partial + tl.program_id(0) * 3 * WIDTH + column
    tl.store(mine, tl.sum(tl.sum(norm_weight_total, 0), 0))
    tl.store(mine + WIDTH, tl.sum(norm_bias_total, 0))


@triton.jit
def gns_layers_backward(
    second_gradient, activation, gradient, offset, particles, own, second, hidden_gradient, edge_gradient,
    partial,
    LAST: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """The rest of the step backward: hidden_gradient [E, W] is that before the activation, edge_gradient [E, W] that of
    the edges that came in; in `partial` [programs, 3, W] comes last the second bias's.

    Reference: hgn.kernels.gns.reference; test: tests/kernels/test_kernels_alone.py.
    """
    count = tl.load(offset + particles)
    column = tl.arange(0, WIDTH)
    own_w = matrix(own, WIDTH, WIDTH)
    second_w = matrix(second, WIDTH, WIDTH)
    bias_total = tl.zeros((8, WIDTH), tl.float32)
    tile = tl.program_id(0).to(tl.int64)
    while tile * BLOCK < count:
        row = tile * BLOCK + tl.arange(0, BLOCK)
        live = row < count
        at = row[:, None] * WIDTH + column[None, :]
        dz = tl.load(second_gradient + at, mask=live[:, None], other=0.0)
        bias_total += tl.sum(tl.reshape(dz.to(tl.float32), (BLOCK // 8, 8, WIDTH)), 0)
        a = tl.load(activation + at, mask=live[:, None], other=0.0)
        if not LAST:
            de = tl.load(gradient + at, mask=live[:, None], other=0.0)
        dh = tl.where(a > 0, product(dz, second_w, PRECISION), 0.0)
        tl.store(hidden_gradient + at, dh, mask=live[:, None])
        result = product(dh, own_w, PRECISION)
        if not LAST:
            result += de.to(tl.float32)
        tl.store(edge_gradient + at, result, mask=live[:, None])
        tile += tl.num_programs(0)
    tl.store(partial + (tl.program_id(0) * 3 + 2) * WIDTH + column, tl.sum(bias_total, 0))


@triton.jit
def gns_edge_sums(
    value, order, offset, total, scale_ptr,
    ORDERED: tl.constexpr, SCALED: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """total [N, W]: the sum of each particle's rows of `value` [E, W], those from its offset to the next one's, or with
    ORDERED those that `order` [E] has there; SCALED: divided by the scale. A program a particle.

    Reference: hgn.kernels.gns.reference; test: tests/kernels/test_kernels_alone.py.
    """
    particle = tl.program_id(0)
    column = tl.arange(0, WIDTH)
    block = tl.load(offset + particle)
    end = tl.load(offset + particle + 1)
    sums = tl.zeros((BLOCK, WIDTH), tl.float32)
    while block < end:
        row = block + tl.arange(0, BLOCK)
        live = row < end
        edge = row
        if ORDERED:
            edge = tl.load(order + row, mask=live, other=0).to(tl.int64)
        part = tl.load(value + edge[:, None] * WIDTH + column[None, :], mask=live[:, None], other=0.0)
        sums += part.to(tl.float32)
        block += BLOCK
    result = tl.sum(sums, 0)
    if SCALED:
        result = result / tl.load(scale_ptr)
    tl.store(total + particle * WIDTH + column, result)


@triton.jit
def _weight_product(left, right, count, partial, WIDTH: tl.constexpr, STEP: tl.constexpr, PRECISION: tl.constexpr):
    column = tl.arange(0, WIDTH)
    total = tl.zeros((WIDTH, WIDTH), tl.float32)
    block = tl.program_id(0).to(tl.int64) * STEP
    while block < count:
        row = block + tl.arange(0, STEP)
        at = row[:, None] * WIDTH + column[None, :]
        live = (row < count)[:, None]
        a = tl.load(left + at, mask=live, other=0.0)
        b = tl.load(right + at, mask=live, other=0.0)
        if PRECISION == "fp16":
            total = tl.dot(tl.trans(a), b, total)
        elif PRECISION == "tf32":
            total = tl.dot(tl.trans(nearest_tf32(a)), nearest_tf32(b), total, input_precision="tf32")
        else:
            total = tl.dot(tl.trans(a), b, total, input_precision=FP32_PRODUCT)
        block += tl.num_programs(0) * STEP
    tl.store(partial + tl.arange(0, WIDTH)[:, None] * WIDTH + column[None, :], total)


@triton.jit
def gns_weight_products(
    second_gradient, activation, hidden_gradient, edge, offset, particles, partial,
    BOTH: tl.constexpr, WIDTH: tl.constexpr, STEP: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """partial [programs, 1 or 2, W, W]: the gradients of the second and, with BOTH, of the first layer's part for the
    edge, of the program's share of the edges.

    Reference: hgn.kernels.gns.reference; test: tests/kernels/test_kernels_alone.py.
    """
    count = tl.load(offset + particles)
    mine = partial + tl.program_id(0).to(tl.int64) * (2 if BOTH else 1) * WIDTH * WIDTH
    _weight_product(second_gradient, activation, count, mine, WIDTH, STEP, PRECISION)
    if BOTH:
        _weight_product(hidden_gradient, edge, count, mine + WIDTH * WIDTH, WIDTH, STEP, PRECISION)


settle_keys(globals())
