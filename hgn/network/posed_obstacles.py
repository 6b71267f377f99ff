"""Obstacles whose pose may have gradients: normals are looked up in each obstacle's own frame and turned back.

An obstacle's cells are computed once, in the pose of the scene file. A particle is expressed in that frame by
x' = R^T (x - t - c) + c with pivot c. The normal n found there becomes R n, so its direction follows the rotation
exactly. The cell of a particle is piecewise constant, so n has no gradient with respect to shifts or the distance from
the surface. With `smoothing` s the normal is the mean over a cube of s cells around the particle. The mean is
continuous, and piecewise polynomial in position and pose. Networks were trained with s = 0.
Shape legend: N particles, K obstacle cells.
"""

from dataclasses import dataclass

import torch

from hgn.network.cell_keys import find, pack
from hgn.network.grid import CORNER_83
from hgn.network.obstacles import ObstacleCells


@dataclass(frozen=True, eq=False)
class Placement:
    """The pose of an obstacle relative to that in the scene file: x -> R (x - c) + c + t."""

    rotation_33: torch.Tensor
    pivot_3: torch.Tensor  # c, domain units
    translation_3: torch.Tensor  # t, domain units

    def place(self, position_3: torch.Tensor) -> torch.Tensor:
        """Moves points […, 3] of the obstacle to its pose."""
        return (position_3 - self.pivot_3) @ self.rotation_33.T + self.pivot_3 + self.translation_3

    def to(self, dtype: torch.dtype) -> "Placement":
        return Placement(*(tensor.to(dtype) for tensor in (self.rotation_33, self.pivot_3, self.translation_3)))

    def undo(self, position_N3: torch.Tensor) -> torch.Tensor:
        """Moves points from the obstacle's pose to the frame of its cells. Inverts `place`."""
        return (position_N3 - self.translation_3 - self.pivot_3) @ self.rotation_33 + self.pivot_3


@dataclass(frozen=True, eq=False)
class PosedObstacleCells(ObstacleCells):
    """Cells of one scene: those of fixed obstacles, as in ObstacleCells, and those of each placed obstacle."""

    placed: tuple[tuple[ObstacleCells, Placement], ...] = ()
    smoothing: float = 0.0  # side of the cube for mean normals, in cells, 0 to 1

    def surfaces(self, position_N3: torch.Tensor, scene_N: torch.Tensor) -> torch.Tensor:
        """Returns n_o of each particle, the sum over obstacles shortened to length 1, and friction likewise, [N, 4].

        With distances normals may be short, and friction is the mean over obstacles within reach.
        """
        rows = [smoothed_surfaces(self, position_N3, scene_N, self.smoothing)]
        for cells, placement in self.placed:
            own_N4 = smoothed_surfaces(cells, placement.undo(position_N3), scene_N, self.smoothing)
            rows.append(torch.cat([own_N4[:, :3] @ placement.rotation_33.T, own_N4[:, 3:]], dim=-1))
        surface_N4 = torch.stack(rows).sum(0)
        square_N1 = surface_N4[:, :3].square().sum(-1, keepdim=True)
        shortened_N4 = torch.where(square_N1 > 1, surface_N4 * square_N1.clamp(min=1).rsqrt(), surface_N4)
        if all(cells.distance_K is None for cells in (self, *(cells for cells, _ in self.placed))):
            return shortened_N4
        count_N1 = torch.stack(rows)[..., :3].any(-1, keepdim=True).sum(0).clamp(min=1)
        return torch.cat([shortened_N4[:, :3], surface_N4[:, 3:] / count_N1], dim=-1)


def smoothed_surfaces(
    cells: ObstacleCells, position_N3: torch.Tensor, scene_N: torch.Tensor, smoothing: float
) -> torch.Tensor:
    """Returns the means of normals and friction over a cube of `smoothing` cells around each particle, [N, 4]."""
    if len(cells.key_K) == 0:
        return position_N3.new_zeros(len(position_N3), 4)
    if smoothing == 0:
        return cells.rows_at(cells.surface_rows, position_N3, scene_N)
    grid_N3 = position_N3 / cells.cell_size
    low_N3 = torch.floor(grid_N3 - 0.5 * smoothing).detach()
    upper_N3 = ((grid_N3 + 0.5 * smoothing - low_N3 - 1) / smoothing).clamp(0, 1)  # fraction in the next cell
    corner_83 = CORNER_83.to(position_N3.device)
    weight_N8 = torch.where(corner_83.bool(), upper_N3[:, None], 1 - upper_N3[:, None]).prod(-1)
    index_N8, found_N8 = find(cells.key_K, pack(scene_N[:, None], low_N3.long()[:, None] + corner_83))
    surface_N84 = cells.surface_rows.to(position_N3.dtype)[index_N8]
    return ((weight_N8 * found_N8)[..., None] * surface_N84).sum(1)
