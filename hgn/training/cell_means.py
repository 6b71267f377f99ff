"""Errors of cells' means in the loss, so that training weights errors that many particles have in common.

A simulation corrects errors of single particles: their neighbours resist. Errors that a whole body has in common add up
instead, for example the acceleration of sand at rest on a slope. They are a small part of a mean over particles. So the
loss of error e is e K e with K = 1 + weight times the sum over levels of P m^-1 P^T, where P contains the particles'
trilinear weights in cells of that level, and m those cells' sums of them. P m^-1 P^T replaces an error by its mean.
Shape legend: N particles, C cells of a level.
"""

import torch

from hgn.network.grid import GridHierarchy


def with_means(error_N3: torch.Tensor, grid: GridHierarchy, weight: float) -> torch.Tensor:
    """Returns K times the errors, [N, 3]."""
    weight_N8, cell_N8 = grid.groups.weight_N8, grid.cells
    rows = (weight_N8[:, :, None] * torch.cat([error_N3, torch.ones_like(error_N3[:, :1])], 1)[:, None]).flatten(0, 1)
    total_N3 = error_N3
    for level in grid.levels:
        sum_C4 = error_N3.new_zeros(level.cell_count, 4).index_add(0, cell_N8.flatten(), rows)
        mean_C3 = sum_C4[:, :3] / sum_C4[:, 3:].where(sum_C4[:, 3:] > 0, 1.0)
        total_N3 = total_N3 + weight * (weight_N8[:, :, None] * mean_C3[cell_N8]).sum(1)
        if level.parent_C is not None:
            cell_N8 = level.parent_C[cell_N8]
    return total_N3
