"""Defines references of the network's kernels in plain PyTorch.

A reference has its kernel's name, takes the kernel's arguments by name, and returns the expected content of each buffer
that the kernel writes. It computes in the type of its inputs, which is float64 in the tests, and there with parameters
that are not rounded. Gradients use the signs of the activations that the kernel uses: those of the stored hidden layer,
or of the layer that the kernel computes again, rounded as in the kernel.
Shape legend: R rows, N particles, C cells, E edges, W width.
"""

import math
from dataclasses import dataclass

import torch
from torch.nn import functional

from hgn.network.grid import CORNER_83, DIRECTION_63
from hgn.network.mlp import LEAKY_SLOPE


@dataclass(frozen=True)
class Added:
    """What is added to the buffer `totals` from element `at` on, times the loss scale (1 / unscale).

    `summands` is the root of the sum of the squares of what was summed: where summands cancel, rounding counts by it.
    """

    at: int
    value: torch.Tensor
    summands: float = 0.0


# By the buffer's name, or one that says what is added. A tensor: the buffer's first elements (NaN: not promised).
Outputs = dict[str, torch.Tensor | Added]


def rows(x: torch.Tensor, *shape: int) -> torch.Tensor:
    """The first elements of a buffer that may have more of them."""
    return x.flatten()[: math.prod(shape)].view(shape)


def part(parameters: torch.Tensor, at: int, *shape: int) -> torch.Tensor:
    """The parameter at a place of the packed ones."""
    return rows(parameters.flatten()[at:], *shape)


def nowhere(x: torch.Tensor, there: torch.Tensor) -> torch.Tensor:
    """x [..., W], of which nothing is promised but where `there` says so."""
    return torch.where(there[..., None], x, math.nan)


def leaky(h: torch.Tensor) -> torch.Tensor:
    return functional.leaky_relu(h, LEAKY_SLOPE)


def leaky_backward(gradient: torch.Tensor, positive: torch.Tensor) -> torch.Tensor:
    return torch.where(positive, gradient, LEAKY_SLOPE * gradient)


def normalised_rows(z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows of zero mean and unit variance, and one over the standard deviation."""
    centred = z - z.mean(-1, keepdim=True)
    rstd = (centred.square().mean(-1) + 1e-5).rsqrt()
    return centred * rstd[..., None], rstd


def norm_backward(
    gradient: torch.Tensor, z: torch.Tensor, weight_W: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Gradients of z, of the norm's weight and of its bias, by autograd."""
    with torch.enable_grad():
        z, weight_W = z.detach().requires_grad_(), weight_W.detach().requires_grad_()
        bias_W = torch.zeros_like(weight_W, requires_grad=True)
        y = functional.layer_norm(z, z.shape[-1:], weight_W, bias_W)
        first, second, third = torch.autograd.grad(y, (z, weight_W, bias_W), gradient)
    return first, second, third


def stored_norm_backward(
    gradient: torch.Tensor, normalised: torch.Tensor, rstd: torch.Tensor, weight_W: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The same from the stored output and one over its deviation; zero where there is no row (0)."""
    there = rstd != 0
    result = torch.zeros_like(gradient)
    values = norm_backward(gradient[there], normalised[there] / rstd[there][:, None], weight_W)
    result[there] = values[0]
    return result, values[1], values[2]


def listed_sums(x: torch.Tensor, table: torch.Tensor, edges: bool) -> torch.Tensor:
    """For each column of the table [SUM, R] the sum of x's rows that it lists (below zero: none).

    With `edges` x is [C, SUM, W]: of the row listed for a direction the opposite direction's part.
    """
    total = x.new_zeros(table.shape[1], x.shape[-1])
    for i, row in enumerate(table):
        values = x[:, i ^ 1] if edges else x
        total[row >= 0] += values[row[row >= 0]]
    return total


def corners(like: torch.Tensor) -> torch.Tensor:
    """The bits of a cell's eight corners [8, 3]."""
    return CORNER_83.to(like)


def directions(like: torch.Tensor) -> torch.Tensor:
    """The six neighbours of a cell [6, 3]."""
    return DIRECTION_63.to(like)


# hgn.kernels.cell_mlp


def cell_mlp_forward(
    cell, total, count_ptr, values, first_at, sum_first_at, bias_at, second_at, second_bias_at, norm_weight_at,
    norm_bias_at, next_at_0, next_at_1, next_bias_at, NEXT, SAVE, WIDTH, **_,
) -> Outputs:  # fmt: skip
    count = int(count_ptr)
    feature = rows(cell, count, WIDTH)
    h = feature @ part(values, first_at, WIDTH, WIDTH).T
    h = h + rows(total, count, WIDTH) @ part(values, sum_first_at, WIDTH, WIDTH).T
    a = leaky(h + part(values, bias_at, WIDTH))
    z = a @ part(values, second_at, WIDTH, WIDTH).T + part(values, second_bias_at, WIDTH)
    z, rstd = normalised_rows(z)
    out = feature + z * part(values, norm_weight_at, WIDTH) + part(values, norm_bias_at, WIDTH)
    outputs: Outputs = {"cell_out": out}
    if SAVE:
        outputs |= {"hidden": a, "normalised": z, "rstd": rstd}
    if NEXT > 0:
        outputs["next_0"] = out @ part(values, next_at_0, WIDTH, WIDTH).T
    if NEXT > 1:
        outputs["next_1"] = out @ part(values, next_at_1, WIDTH, WIDTH).T + part(values, next_bias_at, WIDTH)
    return outputs


def cell_mlp_backward(
    gradient, later_hidden_gradient, later_receive_gradient, neighbour, count_ptr, values, later_send_at,
    later_receive_at, first_at, sum_first_at, second_at, norm_weight_at, norm_bias_at, hidden, normalised, rstd,
    send_gradient, capacity, LAST, GATHER, WIDTH, **_,
) -> Outputs:  # fmt: skip
    count = int(count_ptr)
    outputs: Outputs = {}
    df = rows(gradient, count, WIDTH)
    if not LAST:
        sent = rows(send_gradient, count, WIDTH)
        if GATHER:
            table = neighbour.long().view(6, capacity)[:, :count]
            sent = listed_sums(later_hidden_gradient.reshape(-1, 6, WIDTH), table, True)
            outputs["send_gradient"] = sent
        df = df + sent @ part(values, later_send_at, WIDTH, WIDTH)
        df = df + rows(later_receive_gradient, count, WIDTH) @ part(values, later_receive_at, WIDTH, WIDTH)
    stored = rows(normalised, count, WIDTH), rows(rstd, count)
    dz, norm_weight, norm_bias = stored_norm_backward(df, *stored, part(values, norm_weight_at, WIDTH))
    dh = leaky_backward(dz @ part(values, second_at, WIDTH, WIDTH), rows(hidden, count, WIDTH) > 0)
    return outputs | {
        "norm_weight": Added(norm_weight_at, norm_weight),
        "norm_bias": Added(norm_bias_at, norm_bias),
        "second_gradient": dz,
        "hidden_gradient": dh,
        "sum_gradient": dh @ part(values, sum_first_at, WIDTH, WIDTH),
        "gradient": df + dh @ part(values, first_at, WIDTH, WIDTH),
    }


# hgn.kernels.edges


def edge_forward(
    send, receive, edge_in, neighbour, count_ptr, values, own_at, second_at, second_bias_at, norm_weight_at,
    norm_bias_at, capacity, FIRST, STORE_EDGE, SAVE, WIDTH, **_,
) -> Outputs:  # fmt: skip
    count = int(count_ptr)
    sender_C6 = neighbour.long().view(6, capacity)[:, :count].T
    there = sender_C6 >= 0
    h = rows(receive, count, WIDTH)[:, None] + rows(send, count, WIDTH)[sender_C6.clamp(min=0)]
    if FIRST:
        edge = torch.zeros_like(h)
        h = h - directions(h) @ part(values, own_at, 3, WIDTH)  # receiver minus sender
    else:
        edge = rows(edge_in, count, 6, WIDTH)
        h = h + edge @ part(values, own_at, WIDTH, WIDTH).T
    a = leaky(h)
    z = a @ part(values, second_at, WIDTH, WIDTH).T + part(values, second_bias_at, WIDTH)
    z, rstd = normalised_rows(z)
    out = z * part(values, norm_weight_at, WIDTH) + part(values, norm_bias_at, WIDTH) + edge
    outputs: Outputs = {"sum_out": torch.where(there[..., None], out, 0.0).sum(1)}
    if STORE_EDGE:
        outputs["edge_out"] = nowhere(out, there)
    if SAVE:
        outputs |= {"hidden": nowhere(a, there), "normalised": nowhere(z, there)}
        outputs["rstd"] = torch.where(there, rstd, 0.0)
    return outputs


def edge_backward(
    sum_gradient, edge_gradient, count_ptr, values, own_at, second_at, norm_weight_at, norm_bias_at, hidden,
    normalised, rstd, FIRST, LAST, WIDTH, **_,
) -> Outputs:  # fmt: skip
    count = int(count_ptr)
    rstd = rows(rstd, count, 6)
    de = rows(sum_gradient, count, WIDTH)[:, None].expand(count, 6, WIDTH)
    if not LAST:
        de = de + rows(edge_gradient, count, 6, WIDTH)
    stored = rows(normalised, count, 6, WIDTH), rstd
    dz, norm_weight, norm_bias = stored_norm_backward(de, *stored, part(values, norm_weight_at, WIDTH))
    dh = leaky_backward(dz @ part(values, second_at, WIDTH, WIDTH), rows(hidden, count, 6, WIDTH) > 0)
    outputs: Outputs = {
        "norm_weight": Added(norm_weight_at, norm_weight),
        "norm_bias": Added(norm_bias_at, norm_bias),
        "second_gradient": dz,
        "hidden_gradient": dh,
        "receive_gradient": dh.sum(1),
    }
    if FIRST:
        outputs["offsets"] = Added(own_at, torch.einsum("di,cdw->iw", -directions(dh), dh))
    else:
        outputs["edge_gradient"] = nowhere(de + dh @ part(values, own_at, WIDTH, WIDTH), rstd != 0)
    return outputs


# hgn.kernels.mlp


def mlp_forward(
    x, count_ptr, values, first_weights, first_at, offset_at, bias_at, second_at, second_bias_at, norm_weight_at,
    norm_bias_at, gathered, index, octant, next_at_0, next_at_1, next_bias_at_0, next_bias_at_1, fraction,
    fraction_at_0, fraction_at_1, INPUT, WIDTH, OUT, GATHER, OFFSET, BIAS, NORM, RESIDUAL, NEXT, FRACTION, SAVE, **_,
) -> Outputs:  # fmt: skip
    count = int(count_ptr)
    x = rows(x, count, INPUT)
    h = x @ part(first_weights, first_at, WIDTH, INPUT).T
    if GATHER:
        h = h + gathered[index[:count].long()]
    if OFFSET:
        h = h + OFFSET * (0.5 - corners(x)[octant[:count].long()]) @ part(values, offset_at, 3, WIDTH)
    if BIAS:
        h = h + part(values, bias_at, WIDTH)
    a = leaky(h)
    y = a @ part(values, second_at, OUT, WIDTH).T + part(values, second_bias_at, OUT)
    if NORM:
        y = normalised_rows(y)[0] * part(values, norm_weight_at, OUT) + part(values, norm_bias_at, OUT)
    if RESIDUAL:
        y = y + x
    outputs: Outputs = {"y": y}
    if SAVE:
        outputs["hidden"] = a
    following = ((next_at_0, next_bias_at_0, fraction_at_0), (next_at_1, next_bias_at_1, fraction_at_1))
    for i, (at, next_bias_at, fraction_at) in enumerate(following[:NEXT]):
        z = y @ part(values, at, WIDTH, WIDTH).T
        if next_bias_at >= 0:
            z = z + part(values, next_bias_at, WIDTH)
        if FRACTION:
            z = z + (2 * i - 1) * rows(fraction, count, 3) @ part(values, fraction_at, 3, WIDTH)
        outputs[f"next_{i}"] = z
    return outputs


def mlp_backward(
    gradient, gradient_index, from_0, from_1, x_gradient, count_ptr, values, first_at, offset_at, second_at,
    second_bias_at, norm_weight_at, norm_bias_at, octant, next_at_0, next_at_1, hidden, WIDTH, OUT, GATHER, OFFSET,
    NORM, RESIDUAL, NEXT, INTO, **_,
) -> Outputs:  # fmt: skip
    count = int(count_ptr)
    dy = gradient[gradient_index[:count].long()] if GATHER else rows(gradient, count, OUT)
    for product_gradient, at in ((from_0, next_at_0), (from_1, next_at_1))[:NEXT]:
        dy = dy + rows(product_gradient, count, WIDTH) @ part(values, at, WIDTH, WIDTH)
    a, second = rows(hidden, count, WIDTH), part(values, second_at, OUT, WIDTH)
    outputs: Outputs = {}
    dz = dy
    if NORM:
        z = a @ second.T + part(values, second_bias_at, OUT)
        dz, norm_weight, norm_bias = norm_backward(dy, z, part(values, norm_weight_at, OUT))
        outputs |= {"norm_weight": Added(norm_weight_at, norm_weight), "norm_bias": Added(norm_bias_at, norm_bias)}
    dh = leaky_backward(dz @ second, a > 0)
    outputs |= {"second_gradient": dz, "hidden_gradient": dh}
    if OFFSET:
        side = OFFSET * (0.5 - corners(a)[octant[:count].long()])
        outputs["offsets"] = Added(offset_at, side.T @ dh)
    if INTO:
        dx = dh @ part(values, first_at, WIDTH, WIDTH)
        if RESIDUAL:
            dx = dx + dy
        if INTO == 2:
            dx = dx + rows(x_gradient, count, WIDTH)
        outputs["x_gradient"] = dx
    return outputs


def clear_rows(x, count_ptr, WIDTH, **_) -> Outputs:
    return {"x": x.new_zeros(int(count_ptr), WIDTH)}


def _listed(x, table, count, capacity, SUM, EDGES, WIDTH) -> torch.Tensor:
    x = x.reshape((-1, SUM, WIDTH) if EDGES else (-1, WIDTH))
    return listed_sums(x, table.long().view(SUM, capacity)[:, :count], EDGES)


def gather_sums(x, table, count_ptr, capacity, SUM, EDGES, WIDTH, **_) -> Outputs:
    return {"y": _listed(x, table, int(count_ptr), capacity, SUM, EDGES, WIDTH)}


def gather_project(x, table, count_ptr, values, at_0, at_1, bias_at, capacity, SUM, WIDTH, **_) -> Outputs:
    count = int(count_ptr)
    y = _listed(x, table, count, capacity, SUM, False, WIDTH) if SUM else rows(x, count, WIDTH)
    outputs: Outputs = {"y": y} if SUM else {}
    outputs["next_0"] = y @ part(values, at_0, WIDTH, WIDTH).T
    outputs["next_1"] = y @ part(values, at_1, WIDTH, WIDTH).T + part(values, bias_at, WIDTH)
    return outputs


def gather_project_backward(
    x, table, count_ptr, weights, at_0, other, other_at, gradient, capacity, SUM, EDGES, ADD, WIDTH, **_
) -> Outputs:
    count = int(count_ptr)
    summed = _listed(x, table, count, capacity, SUM, EDGES, WIDTH) if SUM else rows(x, count, WIDTH)
    result = summed @ part(weights, at_0, WIDTH, WIDTH)
    if EDGES:
        result = result + rows(other, count, WIDTH) @ part(weights, other_at, WIDTH, WIDTH)
    if ADD:
        result = result + rows(gradient, count, WIDTH)
    return {"summed": summed, "gradient": result}


# hgn.kernels.particle_cell


def _pair_hidden(by_particle, by_cell, cell_of, count, values, offset_at, TO_CELL, WIDTH) -> torch.Tensor:
    """[N, 8, W] before the activation."""
    side_8W = corners(values) @ part(values, offset_at, 3, WIDTH)
    h = rows(by_particle, count, WIDTH)[:, None] + (side_8W if TO_CELL else -side_8W)
    return h if TO_CELL else h + by_cell[rows(cell_of, count, 8).long()]


def particle_cell_forward(
    by_particle, by_cell, particle, cell_of, weight_of, count_ptr, values, offset_at, second_at, second_bias_at,
    norm_weight_at, norm_bias_at, out, TO_CELL, SAVE, WIDTH, PRECISION, **_,
) -> Outputs:  # fmt: skip
    count = int(count_ptr)
    a = leaky(_pair_hidden(by_particle, by_cell, cell_of, count, values, offset_at, TO_CELL, WIDTH))
    z = a @ part(values, second_at, WIDTH, WIDTH).T + part(values, second_bias_at, WIDTH)
    z, rstd = normalised_rows(z)
    message = z * part(values, norm_weight_at, WIDTH) + part(values, norm_bias_at, WIDTH)
    message = message * rows(weight_of, count, 8)[..., None]
    if TO_CELL:
        outputs: Outputs = {"out": out.index_add(0, rows(cell_of, 8 * count).long(), message.flatten(0, 1))}
    else:
        outputs = {"out": rows(particle, count, WIDTH) + message.sum(1)}
    if SAVE:
        outputs |= {"normalised": z, "rstd": rstd}
        if PRECISION == "tf32":
            outputs["hidden"] = a
    return outputs


def particle_cell_backward(
    gradient, by_particle, by_cell, cell_of, weight_of, fraction, count_ptr, values, offset_at, second_at,
    norm_weight_at, norm_bias_at, hidden, normalised, rstd, by_cell_gradient, TO_CELL, WIDTH, PRECISION, **_,
) -> Outputs:  # fmt: skip
    """Over a particle's corners weight times offset adds up to nothing, and on the way up all have one gradient: what
    is left of the offsets' gradient may be a tenth of its summands."""
    count = int(count_ptr)
    cell = rows(cell_of, count, 8).long()
    dy = gradient[cell] if TO_CELL else rows(gradient, count, WIDTH)[:, None]
    dy = dy * rows(weight_of, count, 8)[..., None]
    stored = rows(normalised, count, 8, WIDTH), rows(rstd, count, 8)
    dz, norm_weight, norm_bias = stored_norm_backward(dy, *stored, part(values, norm_weight_at, WIDTH))
    if PRECISION == "tf32":
        positive = rows(hidden, count, 8, WIDTH) > 0
    else:  # computed again, in float16 as its products take it
        a = leaky(_pair_hidden(by_particle, by_cell, cell_of, count, values, offset_at, TO_CELL, WIDTH).float())
        positive = (a.half() if PRECISION == "fp16" else a) > 0
    dh = leaky_backward(dz @ part(values, second_at, WIDTH, WIDTH), positive)
    side_N83 = corners(dh) - rows(fraction, count, 3)[:, None]
    offsets = torch.einsum("nki,nkw->iw", side_N83 if TO_CELL else -side_N83, dh)
    summands = float(torch.einsum("nki,nkw->iw", side_N83.square(), dh.square()).sum().sqrt())
    outputs: Outputs = {
        "norm_weight": Added(norm_weight_at, norm_weight),
        "norm_bias": Added(norm_bias_at, norm_bias),
        "offsets": Added(offset_at, offsets, summands),
        "second_gradient": dz,
        "by_particle_gradient": dh.sum(1),
    }
    if not TO_CELL:
        outputs["by_cell_gradient"] = by_cell_gradient.index_add(0, cell.flatten(), dh.flatten(0, 1))
    return outputs


def particle_cell_weight_gradient(
    second_gradient, by_particle, by_cell, cell_of, count_ptr, values, offset_at, second_at, second_bias_at, TO_CELL,
    WIDTH, **_,
) -> Outputs:  # fmt: skip
    count = int(count_ptr)
    dz = rows(second_gradient, 8 * count, WIDTH)
    a = leaky(_pair_hidden(by_particle, by_cell, cell_of, count, values, offset_at, TO_CELL, WIDTH)).flatten(0, 1)
    return {"second": Added(second_at, dz.T @ a), "second_bias": Added(second_bias_at, dz.sum(0))}


# hgn.kernels.weight_gradient


def weight_gradient(left, right, jobs, counts, **_) -> Outputs:
    """Each entry of the list by itself. `right` gives, by their offsets, the buffers about the kernel's own."""
    outputs: Outputs = {}
    for number, job in enumerate(jobs.tolist()):
        left_at, right_at, at, counted, left_width, right_width, multiple, bias_at = job
        count = int(counts[counted]) * multiple
        a = left[left_at : left_at + count * left_width].view(count, left_width)
        b = right[right_at].flatten()[: count * right_width].view(count, right_width)
        outputs[f"weight {number}"] = Added(at, a.T @ b)
        if bias_at >= 0:
            outputs[f"bias {number}"] = Added(bias_at, a.sum(0))
    return outputs
