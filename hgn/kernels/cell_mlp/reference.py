"""References of hgn.kernels.cell_mlp.kernel, see hgn.kernels.reference."""

from __future__ import annotations

from hgn.kernels.reference import (
    Added,
    Outputs,
    leaky,
    leaky_backward,
    listed_sums,
    normalised_rows,
    part,
    rows,
    stored_norm_backward,
)


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
