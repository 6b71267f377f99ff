"""References of hgn.kernels.mlp.kernel, see hgn.kernels.reference."""

from __future__ import annotations

import torch

from hgn.kernels.reference import (
    Added,
    Outputs,
    corners,
    leaky,
    leaky_backward,
    listed_sums,
    norm_backward,
    normalised_rows,
    part,
    rows,
)


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


def _sums(x, table, count, capacity, SUM, EDGES, WIDTH) -> torch.Tensor:
    x = x.reshape((-1, SUM, WIDTH) if EDGES else (-1, WIDTH))
    return listed_sums(x, table.long().view(SUM, capacity)[:, :count], EDGES)


def gather_sums(x, table, count_ptr, capacity, SUM, EDGES, WIDTH, **_) -> Outputs:
    return {"y": _sums(x, table, int(count_ptr), capacity, SUM, EDGES, WIDTH)}


def gather_project(x, table, count_ptr, values, at_0, at_1, bias_at, capacity, SUM, WIDTH, **_) -> Outputs:
    count = int(count_ptr)
    y = _sums(x, table, count, capacity, SUM, False, WIDTH) if SUM else rows(x, count, WIDTH)
    outputs: Outputs = {"y": y} if SUM else {}
    outputs["next_0"] = y @ part(values, at_0, WIDTH, WIDTH).T
    outputs["next_1"] = y @ part(values, at_1, WIDTH, WIDTH).T + part(values, bias_at, WIDTH)
    return outputs


def gather_project_backward(
    x, table, count_ptr, weights, at_0, other, other_at, gradient, capacity, SUM, EDGES, ADD, WIDTH, **_
) -> Outputs:
    count = int(count_ptr)
    summed = _sums(x, table, count, capacity, SUM, EDGES, WIDTH) if SUM else rows(x, count, WIDTH)
    result = summed @ part(weights, at_0, WIDTH, WIDTH)
    if EDGES:
        result = result + rows(other, count, WIDTH) @ part(weights, other_at, WIDTH, WIDTH)
    if ADD:
        result = result + rows(gradient, count, WIDTH)
    return {"summed": summed, "gradient": result}
