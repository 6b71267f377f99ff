"""References of hgn.kernels.edges.kernel, see hgn.kernels.reference."""

from __future__ import annotations

import torch

from hgn.kernels.reference import (
    Added,
    Outputs,
    directions,
    leaky,
    leaky_backward,
    normalised_rows,
    nowhere,
    part,
    rows,
    stored_norm_backward,
)


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
