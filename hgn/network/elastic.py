"""The deformation of elastic bodies as inputs of a network with relative inputs (`network.own_physics: elastic`).

Each elastic particle has NEIGHBOURS rest neighbours, particles of its body. X are their positions relative to it in
the rest shape, x those in the present frame, both as rows. Least squares give the deformation gradient F with x = F X:

    F = sum_k x_k g_k^T,    g_k = A^-1 X_k,    A = sum_k X_k X_k^T
    e = mean_k (x_k - F X_k) = sum_k x_k c_k,    c_k = 1 / K - g_k . mean X

g and c depend on the rest shape only, so they are computed once, and no frame inverts a matrix. F and e are linear in
the positions: they have no memory that could drift, and their gradients are finite for inverted and flat bodies too.
The columns are asinh of (F F^T - 1) / (2 STRETCH) as xx, yy, zz, yz, xz, xy, and of e / s_a. They are 0 for other
materials and for bodies that only move and turn. They do not depend on the axes of the rest shape, but turn with the
body and with the scene. A particle whose neighbours at rest lie nearly in a plane has no neighbours (FLAT).
Shape legend: N particles, K neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch

from hgn.scene.rest_shape import NEIGHBOURS

COLUMNS = 9
PACKED = 5 * NEIGHBOURS  # numbers of a particle in `RestShape.packed`
STRETCH = 0.01  # unit of the stretch; between impacts bodies of the data stretch by 0.002, at impacts by up to 0.03
FLAT = 0.01  # smallest det A / (tr A / 3)^3, which is 1 for neighbours in all directions and 0 for those in a plane
_ROWS, _ROW_COLUMNS = (0, 1, 2, 1, 0, 0), (0, 1, 2, 2, 2, 1)


@dataclass(frozen=True, eq=False)
class RestShape:
    """The neighbours of elastic particles in the rest shape. Other particles have no neighbours and coefficients 0."""

    neighbour_NK: torch.Tensor  # int64, row of the neighbour; -1: none
    position_N3: torch.Tensor  # float32, rest position
    coefficient_NK4: torch.Tensor  # float32, g and c

    @staticmethod
    def of(position_N3: torch.Tensor, neighbour_NK: torch.Tensor) -> RestShape:
        """Returns the rest shape of particles with these rest positions and neighbours."""
        offset_NK3 = (position_N3[neighbour_NK.clamp(min=0)] - position_N3[:, None]).double()
        there_NK = (neighbour_NK >= 0).double()
        offset_NK3 = offset_NK3 * there_NK[..., None]
        moment_N33 = offset_NK3.transpose(1, 2) @ offset_NK3
        row = moment_N33.unbind(1)
        adjugate_N33 = torch.stack([torch.linalg.cross(row[i - 2], row[i - 1]) for i in range(3)], 1)
        determinant_N = (row[0] * adjugate_N33[:, 0]).sum(-1)
        solid_N = determinant_N > FLAT * (moment_N33.diagonal(dim1=1, dim2=2).sum(-1) / 3) ** 3
        gradient_NK3 = offset_NK3 @ (adjugate_N33 / torch.where(solid_N, determinant_N, 1)[:, None, None])
        even_NK = there_NK / there_NK.sum(1, keepdim=True).clamp(min=1)
        residual_NK = even_NK - (gradient_NK3 @ (even_NK[:, None] @ offset_NK3).transpose(1, 2)).squeeze(-1)
        residual_NK = residual_NK * there_NK
        coefficient_NK4 = torch.cat([gradient_NK3, residual_NK[..., None]], -1) * solid_N[:, None, None]
        neighbour_NK = torch.where(solid_N[:, None], neighbour_NK, -1)
        return RestShape(neighbour_NK, position_N3, coefficient_NK4.float())

    @cached_property
    def packed(self) -> torch.Tensor:
        """Returns neighbours and then coefficients of each particle, as the bits of float32, int32 [N, PACKED]."""
        bits_NR = self.coefficient_NK4.flatten(1).contiguous().view(torch.int32)
        return torch.cat([self.neighbour_NK.int(), bits_NR], 1).contiguous()

    @staticmethod
    def unpacked(packed_NR: torch.Tensor, position_N3: torch.Tensor) -> RestShape:
        """Returns the shape of `packed`. The positions are used only if particles lose neighbours."""
        coefficient_NR = packed_NR[:, NEIGHBOURS:].contiguous().view(torch.float32)
        return RestShape(packed_NR[:, :NEIGHBOURS].long(), position_N3, coefficient_NR.unflatten(1, (NEIGHBOURS, 4)))

    @staticmethod
    def none(position_N3: torch.Tensor) -> RestShape:
        """Returns the shape of particles without neighbours."""
        zero_NK4 = position_N3.new_zeros(len(position_N3), NEIGHBOURS, 4, dtype=torch.float32)
        return RestShape(zero_NK4[..., 0].long() - 1, position_N3.float(), zero_NK4)

    @staticmethod
    def joined(shapes: Sequence[RestShape | None], counts: Sequence[int]) -> RestShape | None:
        """Returns one shape for several scenes, or states, of `counts` particles. None means no elastic particles."""
        known = [shape for shape in shapes if shape is not None]
        if not known:
            return None
        parts, first = [], 0
        for shape, count in zip(shapes, counts, strict=True):
            part = shape or RestShape.none(known[0].position_N3.new_zeros(count, 3))
            neighbour_NK = torch.where(part.neighbour_NK < 0, -1, part.neighbour_NK + first)
            parts.append(replace(part, neighbour_NK=neighbour_NK))
            first += count
        return RestShape(*(torch.cat([getattr(part, name) for part in parts]) for name in _TENSORS))

    def __getitem__(self, rows_N: torch.Tensor | slice) -> RestShape:
        """Returns the shape of some particles. A particle that loses neighbours is fitted to its remaining ones."""
        index_N = torch.arange(len(self.neighbour_NK), device=self.neighbour_NK.device)[rows_N]
        place_N = self.neighbour_NK.new_full((len(self.neighbour_NK) + 1,), -1)  # the last is that of no neighbour
        place_N[index_N] = torch.arange(len(index_N), device=index_N.device)
        old_NK, position_N3 = self.neighbour_NK[index_N], self.position_N3[index_N]
        neighbour_NK, coefficient_NK4 = place_N[old_NK], self.coefficient_NK4[index_N]
        lost_N = ((neighbour_NK < 0) & (old_NK >= 0)).any(1)
        if not bool(lost_N.any()):
            return RestShape(neighbour_NK, position_N3, coefficient_NK4)
        refitted = RestShape.of(position_N3, neighbour_NK)
        coefficient_NK4 = torch.where(lost_N[:, None, None], refitted.coefficient_NK4, coefficient_NK4)
        return RestShape(refitted.neighbour_NK, position_N3, coefficient_NK4)

    def to(self, device: torch.device | str, non_blocking: bool = False) -> RestShape:
        return RestShape(*(getattr(self, name).to(device, non_blocking=non_blocking) for name in _TENSORS))


_TENSORS = ("neighbour_NK", "position_N3", "coefficient_NK4")


def elastic_columns(position_N3: torch.Tensor, rest: RestShape, scale: torch.Tensor) -> torch.Tensor:
    """Returns the columns [N, COLUMNS] of particles at these positions. `scale` is s_a."""
    count = position_N3.shape[0]  # len() would fix the size of an exported graph
    own_N1 = torch.arange(count, device=position_N3.device)[:, None]
    offset_NK3 = position_N3[torch.where(rest.neighbour_NK < 0, own_N1, rest.neighbour_NK)] - position_N3[:, None]
    fit_N34 = offset_NK3.transpose(1, 2) @ rest.coefficient_NK4.to(position_N3)
    gradient_N33, residual_N3 = fit_N34[..., :3], fit_N34[..., 3]
    one_33 = torch.eye(3, dtype=position_N3.dtype, device=position_N3.device)
    stretch_N33 = (gradient_N33 @ gradient_N33.transpose(1, 2) - one_33) / (2 * STRETCH)
    stretch_N6 = stretch_N33[:, _ROWS, _ROW_COLUMNS] * (rest.neighbour_NK >= 0).any(1, keepdim=True)
    return torch.asinh(torch.cat([stretch_N6, residual_N3 / scale], -1))


def rest_shape(scenes: Sequence[Any]) -> RestShape | None:
    """Returns the rest shape of several episodes or initial states, or None without elastic particles."""
    shapes = []
    for scene in scenes:
        known = scene.rest_neighbours
        if known is not None:
            known = RestShape.of(torch.from_numpy(known[0]).float(), torch.from_numpy(known[1]).long())
        shapes.append(known)
    return RestShape.joined(shapes, [len(scene.material_N) for scene in scenes])
