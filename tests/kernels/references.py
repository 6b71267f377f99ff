"""What each kernel should leave, in float64: the function that its docstring names, of the very numbers that it was
given, and of the parameters as they are, not rounded.

Gradients are those at the activations' signs that the kernel itself sees: of the hidden layer as it lies in memory, or
where a kernel computes it again, of what it computes, rounded as it rounds.
Shape legend: R rows, N particles, C cells, E edges, W width.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import triton
from kernels.launches import Launch
from torch.nn import functional

from hgn.network.grid import CORNER_83, DIRECTION_63
from hgn.network.mlp import LEAKY_SLOPE

# Found and expected, by what they are. Where summands cancel, third the size that they have: see pairs_backward.
Pairs = dict[str, tuple[torch.Tensor, torch.Tensor] | tuple[torch.Tensor, torch.Tensor, float]]
REFERENCES: dict[str, Callable[[Launch], Pairs]] = {}
# Without products, in integers, float32 or float64 at every precision: of grids and neighbours, batches, optimisers,
# frames. Compared in test_network, test_neighbours, test_update, test_gns_update and test_rollout.
ELSEWHERE = {
    *("mark_cells", "fill_tables", "prepare_particles", "prepare_features"),
    *("cell_keys", "find_runs", "walk_neighbours", "check_room"),
    *("draw_waves", "assemble_batch", "loss_gradient", "tell_overflow", "square_norm", "average_values"),
    *("finish_update", "adam", "momentum_directions", "step_blocks", "integrate", "advance"),
}


def reference(function: Callable[[Launch], Pairs]) -> Callable[[Launch], Pairs]:
    """Of the kernel with the function's name."""
    REFERENCES[function.__name__] = function
    return function


# what they share


def leaky(h: torch.Tensor) -> torch.Tensor:
    return functional.leaky_relu(h, LEAKY_SLOPE)


def before_activation(gradient: torch.Tensor, positive: torch.Tensor) -> torch.Tensor:
    return torch.where(positive, gradient, LEAKY_SLOPE * gradient)


def normalised(z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows of zero mean and unit variance, and one over the standard deviation."""
    centred = z - z.mean(-1, keepdim=True)
    scale = (centred.square().mean(-1) + 1e-5).rsqrt()
    return centred * scale[..., None], scale


def through_norm(
    gradient: torch.Tensor, z: torch.Tensor, gain_W: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Gradients of z, of the gain and of the shift, by autograd."""
    z, gain_W = z.detach().requires_grad_(), gain_W.detach().requires_grad_()
    shift_W = torch.zeros_like(gain_W, requires_grad=True)
    y = functional.layer_norm(z, z.shape[-1:], gain_W, shift_W)
    first, second, third = torch.autograd.grad(y, (z, gain_W, shift_W), gradient)
    return first, second, third


def through_kept_norm(
    gradient: torch.Tensor, kept: torch.Tensor, scale: torch.Tensor, gain_W: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The same of the output and the deviation that were kept; zero where there is no row (scale 0)."""
    there = scale != 0
    result = torch.zeros_like(gradient)
    found, gain, shift = through_norm(gradient[there], kept[there] / scale[there][:, None], gain_W)
    result[there] = found
    return result, gain, shift


def sums_of(x: torch.Tensor, table: torch.Tensor, edges: bool) -> torch.Tensor:
    """For each column of the table [SUM, R] the sum of x's rows that it lists (below zero: none).

    With `edges` x is [C, SUM, W]: of the row listed for a direction the opposite direction's part.
    """
    total = x.new_zeros(table.shape[1], x.shape[-1])
    for i, where in enumerate(table):
        part = x[:, i ^ 1] if edges else x
        total[where >= 0] += part[where[where >= 0]]
    return total


def towards_parent(octant: torch.Tensor) -> torch.Tensor:
    return 0.5 - CORNER_83.to(octant.device).double()[octant]


# rows


@reference
def rows_forward(k: Launch) -> Pairs:
    count, width, out = k.count, k["WIDTH"], k["OUT"]
    x = k.rows("x", count, k["INPUT"])
    h = x @ k.parameter("first_at", width, k["INPUT"], of="first_weights").T
    if k["GATHER"]:
        index = k.indices("index", count)
        h += k.rows("gathered", *k["gathered"].shape)[index]
    if k["OFFSET"]:
        h += k["OFFSET"] * towards_parent(k.indices("octant", count)) @ k.parameter("offset_at", 3, width)
    if k["BIAS"]:
        h += k.parameter("bias_at", width)
    a = leaky(h)
    y = a @ k.parameter("second_at", out, width).T + k.parameter("second_bias_at", out)
    if k["NORM"]:
        y = normalised(y)[0] * k.parameter("gain_at", out) + k.parameter("shift_at", out)
    if k["RESIDUAL"]:
        y += x
    pairs = {"y": (k.found("y", count, out), y)}
    if k["SAVE"]:
        pairs["hidden"] = k.found("hidden", count, width), a
    for i in range(k["NEXT"]):
        following = y @ k.parameter(f"next_at_{i}", width, width).T
        if k[f"next_bias_at_{i}"] >= 0:
            following += k.parameter(f"next_bias_at_{i}", width)
        if k["FRACTION"]:
            sign = 2 * i - 1
            following += sign * k.rows("fraction", count, 3) @ k.parameter(f"fraction_at_{i}", 3, width)
        pairs[f"next_{i}"] = k.found(f"next_{i}", count, width), following
    return pairs


@reference
def rows_backward(k: Launch) -> Pairs:
    count, width, out = k.count, k["WIDTH"], k["OUT"]
    if k["GATHER"]:
        dy = k.rows("gradient", *k["gradient"].shape)[k.indices("gradient_index", count)]
    else:
        dy = k.rows("gradient", count, out)
    for i in range(k["NEXT"]):
        dy = dy + k.rows(f"from_{i}", count, width) @ k.parameter(f"next_at_{i}", width, width)
    a, second = k.rows("hidden", count, width), k.parameter("second_at", out, width)
    pairs, dz = {}, dy
    if k["NORM"]:
        z = a @ second.T + k.parameter("second_bias_at", out)
        dz, gain, shift = through_norm(dy, z, k.parameter("gain_at", out))
        pairs["gain"] = k.added(k["gain_at"], out), gain
        pairs["shift"] = k.added(k["shift_at"], out), shift
    dh = before_activation(dz @ second, a > 0)
    pairs["second_gradient"] = k.found("second_gradient", count, out), dz
    pairs["hidden_gradient"] = k.found("hidden_gradient", count, width), dh
    if k["OFFSET"]:
        side = k["OFFSET"] * towards_parent(k.indices("octant", count))
        pairs["offsets"] = k.added(k["offset_at"], 3, width), side.T @ dh
    if k["INTO"]:
        dx = dh @ k.parameter("first_at", width, width)
        if k["RESIDUAL"]:
            dx += dy
        if k["INTO"] == 2:
            dx += k.rows("x_gradient", count, width)
        pairs["x_gradient"] = k.found("x_gradient", count, width), dx
    return pairs


@reference
def clear_rows(k: Launch) -> Pairs:
    found = k.found("x", k.count, k["WIDTH"])
    return {"x": (found, torch.zeros_like(found))}


@reference
def gather_sums(k: Launch) -> Pairs:
    table = k["table"].long().view(k["SUM"], k["capacity"])[:, : k.count]
    shape = (-1, k["SUM"], k["WIDTH"]) if k["EDGES"] else (-1, k["WIDTH"])
    total = sums_of(k["x"].double().view(shape), table, k["EDGES"])
    return {"y": (k.found("y", k.count, k["WIDTH"]), total)}


@reference
def gather_project(k: Launch) -> Pairs:
    count, width, pairs = k.count, k["WIDTH"], {}
    rows = k.rows("x", count, width) if k["SUM"] == 0 else None
    if rows is None:
        table = k["table"].long().view(k["SUM"], k["capacity"])[:, :count]
        rows = sums_of(k["x"].double(), table, False)
        pairs["y"] = k.found("y", count, width), rows
    pairs["next_0"] = k.found("next_0", count, width), rows @ k.parameter("at_0", width, width).T
    following = rows @ k.parameter("at_1", width, width).T + k.parameter("bias_at", width)
    return pairs | {"next_1": (k.found("next_1", count, width), following)}


@reference
def gather_project_backward(k: Launch) -> Pairs:
    count, width = k.count, k["WIDTH"]
    rows = k.rows("x", count, width) if k["SUM"] == 0 else None
    if rows is None:
        table = k["table"].long().view(k["SUM"], k["capacity"])[:, :count]
        shape = (-1, k["SUM"], width) if k["EDGES"] else (-1, width)
        rows = sums_of(k["x"].double().view(shape), table, k["EDGES"])
    gradient = rows @ k.parameter("at_0", width, width)
    if k["EDGES"]:
        gradient += k.rows("other", count, width) @ k.parameter("other_at", width, width)
    if k["ADD"]:
        gradient += k.rows("gradient", count, width)
    return {
        "summed": (k.found("summed", count, width), rows),
        "gradient": (k.found("gradient", count, width), gradient),
    }


# particle-cell pairs


def pair_hidden(k: Launch) -> torch.Tensor:
    """[N, 8, W] before the activation."""
    count, width = k.count, k["WIDTH"]
    sides_8W = CORNER_83.to(k["by_particle"].device).double() @ k.parameter("offset_at", 3, width)
    h = k.rows("by_particle", count, width)[:, None] + (sides_8W if k["TO_CELL"] else -sides_8W)
    if not k["TO_CELL"]:
        h = h + k["by_cell"].double()[k.indices("cell_of", count, 8)]
    return h


def pair_activation(k: Launch) -> torch.Tensor:
    """Of pairs whose hidden layer a kernel computes again: in float16 as its products take it."""
    a = leaky(pair_hidden(k).float())
    return (a.half() if k["PRECISION"] == "fp16" else a).double()


def keeps_pair_hidden(k: Launch) -> bool:
    """As hgn.kernels.forward.FusedNetwork: float32 is made of TF32 products natively."""
    return k["PRECISION"] == "tf32" or (k["PRECISION"] == "fp32" and not triton.knobs.runtime.interpret)


@reference
def pairs_forward(k: Launch) -> Pairs:
    count, width = k.count, k["WIDTH"]
    a = leaky(pair_hidden(k))
    z, scale = normalised(a @ k.parameter("second_at", width, width).T + k.parameter("second_bias_at", width))
    message = z * k.parameter("gain_at", width) + k.parameter("shift_at", width)
    message = message * k.rows("weight_of", count, 8)[..., None]
    if k["TO_CELL"]:
        out = k["out"].double().index_add(0, k.indices("cell_of", 8 * count), message.flatten(0, 1))
        pairs = {"out": (k.left["out"].double(), out)}
    else:
        out = k.rows("particle", count, width) + message.sum(1)
        pairs = {"out": (k.found("out", count, width), out)}
    if k["SAVE"]:
        pairs["normalised"] = k.found("normalised", count, 8, width), z
        pairs["deviation"] = k.found("deviation", count, 8), scale
        if keeps_pair_hidden(k):
            pairs["hidden"] = k.found("hidden", count, 8, width), a
    return pairs


@reference
def pairs_backward(k: Launch) -> Pairs:
    """Over a particle's corners weight times offset adds up to nothing, and on the way up all have one gradient: what
    is left of the offsets' gradient may be a tenth of its summands (the root of the sum of their squares)."""
    count, width = k.count, k["WIDTH"]
    cell = k.indices("cell_of", count, 8)
    dy = k["gradient"].double()[cell] if k["TO_CELL"] else k.rows("gradient", count, width)[:, None]
    dy = dy * k.rows("weight_of", count, 8)[..., None]
    kept, scale = k.rows("normalised", count, 8, width), k.rows("deviation", count, 8)
    dz, gain, shift = through_kept_norm(dy, kept, scale, k.parameter("gain_at", width))
    if keeps_pair_hidden(k):
        positive = k.rows("hidden", count, 8, width) > 0
    else:
        positive = pair_activation(k) > 0
    dh = before_activation(dz @ k.parameter("second_at", width, width), positive)
    side_N83 = CORNER_83.to(dh.device).double() - k.rows("fraction", count, 3)[:, None]
    offsets = torch.einsum("nki,nkw->iw", side_N83 if k["TO_CELL"] else -side_N83, dh)
    summands = float(torch.einsum("nki,nkw->iw", side_N83.square(), dh.square()).sum().sqrt())
    pairs: Pairs = {
        "gain": (k.added(k["gain_at"], width), gain),
        "shift": (k.added(k["shift_at"], width), shift),
        "offsets": (k.added(k["offset_at"], 3, width), offsets, summands),
        "second_gradient": (k.found("second_gradient", count, 8, width), dz),
        "by_particle_gradient": (k.found("by_particle_gradient", count, width), dh.sum(1)),
    }
    if not k["TO_CELL"]:
        total = k["by_cell_gradient"].double().index_add(0, cell.flatten(), dh.flatten(0, 1))
        pairs["by_cell_gradient"] = k.left["by_cell_gradient"].double(), total
    return pairs


@reference
def pairs_weight_gradient(k: Launch) -> Pairs:
    count, width = k.count, k["WIDTH"]
    dz = k.rows("second_gradient", 8 * count, width)
    second = dz.T @ leaky(pair_hidden(k)).flatten(0, 1)
    return {
        "second": (k.added(k["second_at"], width, width), second),
        "second_bias": (k.added(k["second_bias_at"], width), dz.sum(0)),
    }


# edges and cells


@reference
def edge_forward(k: Launch) -> Pairs:
    count, width = k.count, k["WIDTH"]
    sender_C6 = k["neighbour"].long().view(6, k["capacity"])[:, :count].T
    there = sender_C6 >= 0
    h = k.rows("receive", count, width)[:, None] + k.rows("send", count, width)[sender_C6.clamp(min=0)]
    if k["FIRST"]:
        # receiver minus sender
        h = h - DIRECTION_63.to(h.device).double() @ k.parameter("own_at", 3, width)
        edge = 0.0
    else:
        edge = k.rows("edge_in", count, 6, width)
        h = h + edge @ k.parameter("own_at", width, width).T
    a = leaky(h)
    z, scale = normalised(a @ k.parameter("second_at", width, width).T + k.parameter("second_bias_at", width))
    out = z * k.parameter("gain_at", width) + k.parameter("shift_at", width) + edge
    total = torch.where(there[..., None], out, 0.0).sum(1)
    pairs = {"sum_out": (k.found("sum_out", count, width), total)}
    if k["STORE_EDGE"]:
        pairs["edge_out"] = k.found("edge_out", count, 6, width)[there], out[there]
    if k["SAVE"]:
        pairs["hidden"] = k.found("hidden", count, 6, width)[there], a[there]
        pairs["normalised"] = k.found("normalised", count, 6, width)[there], z[there]
        pairs["deviation"] = k.found("deviation", count, 6), torch.where(there, scale, 0.0)
    return pairs


@reference
def edge_backward(k: Launch) -> Pairs:
    count, width = k.count, k["WIDTH"]
    scale = k.rows("deviation", count, 6)
    there = scale != 0
    de = k.rows("sum_gradient", count, width)[:, None].expand(count, 6, width)
    if not k["LAST"]:
        de = de + k.rows("edge_gradient", count, 6, width)
    kept = k.rows("normalised", count, 6, width)
    dz, gain, shift = through_kept_norm(de, kept, scale, k.parameter("gain_at", width))
    dh = before_activation(dz @ k.parameter("second_at", width, width), k.rows("hidden", count, 6, width) > 0)
    pairs = {
        "gain": (k.added(k["gain_at"], width), gain),
        "shift": (k.added(k["shift_at"], width), shift),
        "second_gradient": (k.found("second_gradient", count, 6, width), dz),
        "hidden_gradient": (k.found("hidden_gradient", count, 6, width), dh),
        "receive_gradient": (k.found("receive_gradient", count, width), dh.sum(1)),
    }
    if k["FIRST"]:
        offsets = torch.einsum("di,cdw->iw", -DIRECTION_63.to(dh.device).double(), dh)
        pairs["offsets"] = k.added(k["own_at"], 3, width), offsets
    else:
        edge = de + dh @ k.parameter("own_at", width, width)
        pairs["edge_gradient"] = k.found("edge_gradient", count, 6, width)[there], edge[there]
    return pairs


@reference
def cell_forward(k: Launch) -> Pairs:
    count, width = k.count, k["WIDTH"]
    cell, total = k.rows("cell", count, width), k.rows("total", count, width)
    h = cell @ k.parameter("first_at", width, width).T + total @ k.parameter("sum_first_at", width, width).T
    a = leaky(h + k.parameter("bias_at", width))
    z, scale = normalised(a @ k.parameter("second_at", width, width).T + k.parameter("second_bias_at", width))
    out = cell + z * k.parameter("gain_at", width) + k.parameter("shift_at", width)
    pairs = {"cell_out": (k.found("cell_out", count, width), out)}
    if k["SAVE"]:
        pairs["hidden"] = k.found("hidden", count, width), a
        pairs["normalised"] = k.found("normalised", count, width), z
        pairs["deviation"] = k.found("deviation", count), scale
    if k["NEXT"] > 0:
        pairs["next_0"] = k.found("next_0", count, width), out @ k.parameter("next_at_0", width, width).T
    if k["NEXT"] > 1:
        following = out @ k.parameter("next_at_1", width, width).T + k.parameter("next_bias_at", width)
        pairs["next_1"] = k.found("next_1", count, width), following
    return pairs


@reference
def cell_backward(k: Launch) -> Pairs:
    count, width, pairs = k.count, k["WIDTH"], {}
    df = k.rows("gradient", count, width)
    if not k["LAST"]:
        if k["GATHER"]:
            table = k["neighbour"].long().view(6, k["capacity"])[:, :count]
            sent = sums_of(k["later_hidden_gradient"].double().view(-1, 6, width), table, True)
            pairs["send_gradient"] = k.found("send_gradient", count, width), sent
        else:
            sent = k.rows("send_gradient", count, width)
        df = df + sent @ k.parameter("later_send_at", width, width)
        df = df + k.rows("later_receive_gradient", count, width) @ k.parameter("later_receive_at", width, width)
    kept, scale = k.rows("normalised", count, width), k.rows("deviation", count)
    dz, gain, shift = through_kept_norm(df, kept, scale, k.parameter("gain_at", width))
    dh = before_activation(dz @ k.parameter("second_at", width, width), k.rows("hidden", count, width) > 0)
    return pairs | {
        "gain": (k.added(k["gain_at"], width), gain),
        "shift": (k.added(k["shift_at"], width), shift),
        "second_gradient": (k.found("second_gradient", count, width), dz),
        "hidden_gradient": (k.found("hidden_gradient", count, width), dh),
        "sum_gradient": (k.found("sum_gradient", count, width), dh @ k.parameter("sum_first_at", width, width)),
        "gradient": (k.found("gradient", count, width), df + dh @ k.parameter("first_at", width, width)),
    }


# weights


@reference
def weight_gradient(k: Launch) -> Pairs:
    """Each entry of the list by itself, its operands where they lie: `right` is but the first of many."""
    pairs, element = {}, k["right"].element_size()
    for number, (left_at, right_at, at, counted, left_width, right_width, multiple, bias_at) in enumerate(
        k["jobs"].tolist()
    ):
        rows = int(k["counts"][counted]) * multiple
        left = k["left"][left_at : left_at + rows * left_width].double().view(rows, left_width)
        operand = k.buffers[k.left["right"].data_ptr() + right_at * element]
        assert operand.dtype == k["right"].dtype and operand.shape[-1] == right_width
        right = operand.flatten()[: rows * right_width].double().view(rows, right_width)
        pairs[f"weight {number}"] = k.added(at, left_width, right_width), left.T @ right
        if bias_at >= 0:
            pairs[f"bias {number}"] = k.added(bias_at, left_width), left.sum(0)
    return pairs


# GNS


def edge_ends(k: Launch) -> tuple[int, torch.Tensor, torch.Tensor]:
    """How many edges there are, and the particles that each comes from and goes to."""
    edges = int(k["offset"][k["particles"]])
    return edges, k.indices("sender", edges), k.indices("receiver", edges)


def offsets_of(k: Launch) -> torch.Tensor:
    """Sender minus receiver and their distance, [E, 4]."""
    _, sender, receiver = edge_ends(k)
    offset = k["position"].double()[sender] - k["position"].double()[receiver]
    return torch.cat([offset, offset.norm(dim=1, keepdim=True)], 1)


def encoder_hidden(k: Launch) -> torch.Tensor:
    return offsets_of(k) @ k["first"].double().T + k["first_bias"].double()


def step_hidden(k: Launch) -> torch.Tensor:
    edges, sender, receiver = edge_ends(k)
    own = k.parameters[k["own"].data_ptr()]
    ends = k["send"].double()[sender] + k["receive"].double()[receiver]
    return k.rows("edge", edges, k["WIDTH"]) @ own.T + ends


def second_layer(k: Launch, a: torch.Tensor) -> torch.Tensor:
    return a @ k.parameters[k["second"].data_ptr()].T + k["second_bias"].double()


def partial_sums(k: Launch, columns: int) -> torch.Tensor:
    """Over programs, [columns, W]."""
    return k.left["partial"].double().view(-1, columns, k["WIDTH"]).sum(0)


@reference
def encode_forward(k: Launch) -> Pairs:
    z, _ = normalised(second_layer(k, encoder_hidden(k).relu()))
    edge = z * k["gain"].double() + k["shift"].double()
    return {"edge": (k.found("edge", *edge.shape), edge)}


@reference
def encode_norm_backward(k: Launch) -> Pairs:
    a = encoder_hidden(k).relu()
    dz, gain, shift = through_norm(k.rows("gradient", *a.shape), second_layer(k, a), k["gain"].double())
    total = partial_sums(k, 8)
    return {
        "activation": (k.found("activation", *a.shape), a),
        "second_gradient": (k.found("second_gradient", *a.shape), dz),
        "gain": (total[0], gain),
        "shift": (total[1], shift),
    }


@reference
def encode_layers_backward(k: Launch) -> Pairs:
    side = offsets_of(k)
    shape = (len(side), k["WIDTH"])
    dz, a = k.rows("second_gradient", *shape), k.rows("activation", *shape)
    dh = torch.where(a > 0, dz @ k.parameters[k["second"].data_ptr()], 0.0)
    total = partial_sums(k, 8)
    return {
        "second_bias": (total[2], dz.sum(0)),
        "first": (total[3:7], side.T @ dh),
        "first_bias": (total[7], dh.sum(0)),
    }


@reference
def step_forward(k: Launch) -> Pairs:
    z, _ = normalised(second_layer(k, step_hidden(k).relu()))
    message = z * k["gain"].double() + k["shift"].double()
    pairs = {"message_out": (k.found("message_out", *message.shape), message)}
    if not k["LAST"]:
        edge = k.rows("edge", *message.shape) + message
        pairs["edge_out"] = k.found("edge_out", *message.shape), edge
    return pairs


@reference
def norm_backward(k: Launch) -> Pairs:
    _, _, receiver = edge_ends(k)
    a = step_hidden(k).relu()
    dm = k["sum_gradient"].double()[receiver]
    if not k["LAST"]:
        dm = dm + k.rows("gradient", *a.shape)
    dz, gain, shift = through_norm(dm, second_layer(k, a), k["gain"].double())
    total = partial_sums(k, 3)
    return {
        "activation": (k.found("activation", *a.shape), a),
        "second_gradient": (k.found("second_gradient", *a.shape), dz),
        "gain": (total[0], gain),
        "shift": (total[1], shift),
    }


@reference
def layers_backward(k: Launch) -> Pairs:
    shape = (int(k["offset"][k["particles"]]), k["WIDTH"])
    dz, a = k.rows("second_gradient", *shape), k.rows("activation", *shape)
    dh = torch.where(a > 0, dz @ k.parameters[k["second"].data_ptr()], 0.0)
    de = dh @ k.parameters[k["own"].data_ptr()]
    if not k["LAST"]:
        de += k.rows("gradient", *shape)
    return {
        "hidden_gradient": (k.found("hidden_gradient", *shape), dh),
        "edge_gradient": (k.found("edge_gradient", *shape), de),
        "second_bias": (partial_sums(k, 3)[2], dz.sum(0)),
    }


@reference
def edge_sums(k: Launch) -> Pairs:
    offset = k["offset"].long()
    place = torch.arange(int(offset[-1]), device=offset.device)
    owner = torch.searchsorted(offset, place, right=True) - 1
    rows = k["value"].double()[k["order"].long()[: len(place)] if k["ORDERED"] else place]
    total = k["total"].new_zeros(k["total"].shape, dtype=torch.float64).index_add(0, owner, rows)
    return {"total": (k.left["total"].double(), total / float(k["scale_ptr"]) if k["SCALED"] else total)}


@reference
def weight_products(k: Launch) -> Pairs:
    shape = (int(k["offset"][k["particles"]]), k["WIDTH"])
    total = k.left["partial"].double().sum(0)
    pairs = {"second": (total[0], k.rows("second_gradient", *shape).T @ k.rows("activation", *shape))}
    if k["BOTH"]:
        pairs["own"] = total[1], k.rows("hidden_gradient", *shape).T @ k.rows("edge", *shape)
    return pairs
