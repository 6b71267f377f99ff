"""References of hgn.kernels.particle_cell.kernel, see hgn.kernels.reference."""

from __future__ import annotations

import torch

from hgn.kernels.reference import (
    Added,
    Outputs,
    corners,
    leaky,
    leaky_backward,
    normalised_rows,
    part,
    rows,
    stored_norm_backward,
)


def _hidden(by_particle, by_cell, cell_of, count, values, offset_at, TO_CELL, WIDTH) -> torch.Tensor:
    """[N, 8, W] before the activation."""
    side_8W = corners(values) @ part(values, offset_at, 3, WIDTH)
    h = rows(by_particle, count, WIDTH)[:, None] + (side_8W if TO_CELL else -side_8W)
    return h if TO_CELL else h + by_cell[rows(cell_of, count, 8).long()]


def particle_cell_forward(
    by_particle, by_cell, particle, cell_of, weight_of, count_ptr, values, offset_at, second_at, second_bias_at,
    norm_weight_at, norm_bias_at, out, TO_CELL, SAVE, WIDTH, PRECISION, **_,
) -> Outputs:  # fmt: skip
    count = int(count_ptr)
    a = leaky(_hidden(by_particle, by_cell, cell_of, count, values, offset_at, TO_CELL, WIDTH))
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
        a = leaky(_hidden(by_particle, by_cell, cell_of, count, values, offset_at, TO_CELL, WIDTH).float())
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
    a = leaky(_hidden(by_particle, by_cell, cell_of, count, values, offset_at, TO_CELL, WIDTH)).flatten(0, 1)
    return {"second": Added(second_at, dz.T @ a), "second_bias": Added(second_bias_at, dz.sum(0))}
