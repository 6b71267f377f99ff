"""References of hgn.kernels.gns.kernel, see hgn.kernels.reference."""

from __future__ import annotations

import torch

from hgn.kernels.reference import Outputs, ProgramSums, norm_backward, normalised_rows, rows


def _ends(sender, receiver, offset, particles) -> tuple[torch.Tensor, torch.Tensor]:
    """The particles that each edge comes from and goes to."""
    edges = int(offset[particles])
    return sender[:edges].long(), receiver[:edges].long()


def _offsets(position, ends) -> torch.Tensor:
    """Sender minus receiver and their distance, [E, 4]."""
    offset = position[ends[0]] - position[ends[1]]
    return torch.cat([offset, offset.norm(dim=1, keepdim=True)], 1)


def _step_hidden(edge, send, receive, own, ends, WIDTH) -> torch.Tensor:
    return rows(edge, len(ends[0]), WIDTH) @ own.T + send[ends[0]] + receive[ends[1]]


def gns_encode_forward(
    position, sender, receiver, offset, particles, first, first_bias, second, second_bias, norm_weight, norm_bias, **_
) -> Outputs:
    a = (_offsets(position, _ends(sender, receiver, offset, particles)) @ first.T + first_bias).relu()
    return {"edge": normalised_rows(a @ second.T + second_bias)[0] * norm_weight + norm_bias}


def gns_encode_norm_backward(
    gradient, position, sender, receiver, offset, particles, first, first_bias, second, second_bias, norm_weight, **_
) -> Outputs:
    a = (_offsets(position, _ends(sender, receiver, offset, particles)) @ first.T + first_bias).relu()
    dz, weight, bias = norm_backward(rows(gradient, *a.shape), a @ second.T + second_bias, norm_weight)
    sums: Outputs = {"norm_weight": ProgramSums(0, weight[None]), "norm_bias": ProgramSums(1, bias[None])}
    return sums | {"activation": a, "second_gradient": dz}


def gns_encode_layers_backward(
    second_gradient, activation, position, sender, receiver, offset, particles, second, WIDTH, **_
) -> Outputs:
    side = _offsets(position, _ends(sender, receiver, offset, particles))
    dz, a = rows(second_gradient, len(side), WIDTH), rows(activation, len(side), WIDTH)
    dh = torch.where(a > 0, dz @ second, 0.0)
    return {
        "second_bias": ProgramSums(2, dz.sum(0)[None]),
        "first": ProgramSums(3, side.T @ dh),
        "first_bias": ProgramSums(7, dh.sum(0)[None]),
    }


def gns_step_forward(
    edge, send, receive, sender, receiver, offset, particles, own, second, second_bias, norm_weight, norm_bias, LAST,
    WIDTH, **_,
) -> Outputs:  # fmt: skip
    a = _step_hidden(edge, send, receive, own, _ends(sender, receiver, offset, particles), WIDTH).relu()
    message = normalised_rows(a @ second.T + second_bias)[0] * norm_weight + norm_bias
    outputs: Outputs = {"message_out": message}
    if not LAST:
        outputs["edge_out"] = rows(edge, *message.shape) + message
    return outputs


def gns_norm_backward(
    sum_gradient, gradient, edge, send, receive, sender, receiver, offset, particles, own, second, second_bias,
    norm_weight, LAST, WIDTH, **_,
) -> Outputs:  # fmt: skip
    ends = _ends(sender, receiver, offset, particles)
    a = _step_hidden(edge, send, receive, own, ends, WIDTH).relu()
    dm = sum_gradient[ends[1]]
    if not LAST:
        dm = dm + rows(gradient, *a.shape)
    dz, weight, bias = norm_backward(dm, a @ second.T + second_bias, norm_weight)
    sums: Outputs = {"norm_weight": ProgramSums(0, weight[None]), "norm_bias": ProgramSums(1, bias[None])}
    return sums | {"activation": a, "second_gradient": dz}


def gns_layers_backward(
    second_gradient, activation, gradient, offset, particles, own, second, LAST, WIDTH, **_
) -> Outputs:
    shape = int(offset[particles]), WIDTH
    dz, a = rows(second_gradient, *shape), rows(activation, *shape)
    dh = torch.where(a > 0, dz @ second, 0.0)
    de = dh @ own
    if not LAST:
        de = de + rows(gradient, *shape)
    return {"hidden_gradient": dh, "edge_gradient": de, "second_bias": ProgramSums(2, dz.sum(0)[None])}


def gns_edge_sums(value, order, offset, total, scale_ptr, ORDERED, SCALED, **_) -> Outputs:
    place = torch.arange(int(offset[-1]), device=offset.device)
    owner = torch.searchsorted(offset, place, right=True) - 1
    sums = torch.zeros_like(total).index_add(0, owner, value[order[: len(place)].long() if ORDERED else place])
    return {"total": sums / float(scale_ptr) if SCALED else sums}


def gns_weight_products(
    second_gradient, activation, hidden_gradient, edge, offset, particles, BOTH, WIDTH, **_
) -> Outputs:
    shape = int(offset[particles]), WIDTH
    outputs: Outputs = {"second": ProgramSums(0, (rows(second_gradient, *shape).T @ rows(activation, *shape))[None])}
    if BOTH:
        outputs["own"] = ProgramSums(1, (rows(hidden_gradient, *shape).T @ rows(edge, *shape))[None])
    return outputs
