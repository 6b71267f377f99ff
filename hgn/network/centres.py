"""Sums of particles over the centres of cells around them: masses, moments, and the fields of rigid motions.

A particle acts on eight centres with given weights. Particles of a group have the same eight centres, so that most
of the work is done once for each group.
Shape legend: N particles, G groups, C centres, K columns.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch.compiler import is_exporting
from torch.nn import functional

SMALLEST_MASS = 1e-30  # lower bound of a cell's mass; a cell without weight gets velocity 0
# Particles on a line define no rotation about it. So a rotation fades out if the product of the three principal moments
# is below (THIN * mean moment)^3, or if the mean moment is below POINT. Moments: in squared edges of a coarsest cell.
THIN = 0.2
POINT = 1e-3  # moment of a cube with 1/13 of the edge of a coarsest cell


@dataclass(frozen=True, eq=False)
class Groups:
    """Particles in groups, each with the weights of its eight centres. On a CPU bags of rows take a tenth of the time
    of products and `index_add`; an exported graph cannot contain them, and they have no second derivatives."""

    weight_N8: torch.Tensor
    group_N: torch.Tensor
    count: int

    def sums(self, value_NK: torch.Tensor) -> torch.Tensor:
        """Returns sums [G, 8, K] of the particles' values times their weights."""
        if not self._in_bags:
            value_NX = (self.weight_N8[..., None] * value_NK[:, None]).flatten(1)
            sum_GX = value_NX.new_zeros(self.count, value_NX.shape[1]).index_add(0, self.group_N, value_NX)
            return sum_GX.unflatten(1, (8, -1))
        row, start, weight = self._members
        sum_XK = functional.embedding_bag(row, value_NK, start, mode="sum", per_sample_weights=weight)
        return sum_XK.unflatten(0, (8, -1)).transpose(0, 1)

    def at_particles(self, value_G8K: torch.Tensor) -> torch.Tensor:
        """Returns sums [N, K] of the centres' values times the particles' weights."""
        if not self._in_bags:
            return (self.weight_N8[..., None] * value_G8K[self.group_N]).sum(1)
        table_XK = value_G8K.flatten(0, 1)
        return functional.embedding_bag(self._rows, table_XK, mode="sum", per_sample_weights=self.weight_N8)

    @property
    def _in_bags(self) -> bool:
        return self.weight_N8.device.type == "cpu" and not (is_exporting() or torch.is_grad_enabled())

    @cached_property
    def _members(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Returns each group's particles, once for each of its centres: their numbers, starts of groups, weights."""
        group_N, order_N = torch.sort(self.group_N, stable=True)
        start_G = torch.searchsorted(group_N, torch.arange(self.count))
        start_8G = len(group_N) * torch.arange(8)[:, None] + start_G
        return order_N.repeat(8), start_8G.flatten(), self.weight_N8[order_N].T.flatten()

    @cached_property
    def _rows(self) -> torch.Tensor:
        return 8 * self.group_N[:, None] + torch.arange(8)


@dataclass(frozen=True, eq=False)
class Centres:
    """The eight centres around each particle. Lengths are in cell edges."""

    groups: Groups
    place_N3: torch.Tensor  # positions relative to the group's origin
    centre_G8: torch.Tensor  # numbers of the centres, int64
    offset_G83: torch.Tensor  # the group's origin relative to the centres; [1, 8, 3] if it is the same for all groups
    count: int

    def sums(self, value_NK: torch.Tensor) -> torch.Tensor:
        """Returns sums [C, K] of the particles' values times their weights."""
        return self._total(self.groups.sums(value_NK))

    def at_particles(self, value_CK: torch.Tensor) -> torch.Tensor:
        """Returns sums [N, K] of the centres' values times the particles' weights."""
        return self.groups.at_particles(value_CK[self.centre_G8])

    @cached_property
    def bodies(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Returns masses [C, 1], centres of mass relative to the centres [C, 3], and inertia over mass [C, 3, 3]."""
        place_N3 = self.place_N3
        square_N9 = (place_N3[:, :, None] * place_N3[:, None, :]).flatten(1)
        sum_G8K = self.groups.sums(torch.cat([torch.ones_like(place_N3[:, :1]), place_N3, square_N9], -1))
        mass_G81, place_G83, square_G89 = sum_G8K.split([1, 3, 9], -1)
        moved_G83 = place_G83 + self.offset_G83 * mass_G81
        mixed_G833 = self.offset_G83[..., :, None] * moved_G83[..., None, :]
        mixed_G833 = mixed_G833 + place_G83[..., :, None] * self.offset_G83[..., None, :]
        sum_CK = self._total(torch.cat([mass_G81, moved_G83, square_G89 + mixed_G833.flatten(2)], -1))
        mass_C1 = sum_CK[:, :1].clamp(min=SMALLEST_MASS)
        centre_C3, square_C9 = (sum_CK[:, 1:] / mass_C1).split([3, 9], 1)
        spread_C33 = square_C9.unflatten(1, (3, 3)) - centre_C3[:, :, None] * centre_C3[:, None, :]
        return mass_C1, centre_C3, inertia(spread_C33)

    def motion(self, value_N3: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Returns the means [C, 3] of vectors, and `rotation` of their moments about the centres of mass."""
        sum_G86 = self.groups.sums(torch.cat([value_N3, torch.linalg.cross(self.place_N3, value_N3)], -1))
        sum_G83, moment_G83 = sum_G86.split(3, -1)
        moment_G83 = moment_G83 + torch.linalg.cross(self.offset_G83.expand_as(sum_G83), sum_G83)
        mass_C1, centre_C3, inertia_C33 = self.bodies
        mean_C3, moment_C3 = (self._total(torch.cat([sum_G83, moment_G83], -1)) / mass_C1).split(3, 1)
        return mean_C3, *rotation(inertia_C33, moment_C3 - torch.linalg.cross(centre_C3, mean_C3))

    def field(
        self, factor_C: torch.Tensor, shift_C3: torch.Tensor, turn_C3: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns weighted sums of factors, [N, 1], and of rigid motions about the centres of mass, [N, 3]."""
        shift_C3 = shift_C3 + torch.linalg.cross(turn_C3, self.bodies[1])
        table_C7 = torch.cat([factor_C[:, None], turn_C3, shift_C3], -1)
        factor_G81, turn_G83, shift_G83 = table_C7[self.centre_G8].split([1, 3, 3], -1)
        shift_G83 = shift_G83 - torch.linalg.cross(turn_G83, self.offset_G83.expand_as(turn_G83))
        sum_N7 = self.groups.at_particles(torch.cat([factor_G81, turn_G83, shift_G83], -1))
        factor_N1, turn_N3, shift_N3 = sum_N7.split([1, 3, 3], -1)
        return factor_N1, shift_N3 - torch.linalg.cross(turn_N3, self.place_N3)

    def _total(self, value_G8K: torch.Tensor) -> torch.Tensor:
        sum_CK = value_G8K.new_zeros(self.count, value_G8K.shape[-1])
        return sum_CK.index_add(0, self.centre_G8.flatten(), value_G8K.flatten(0, 1))


def trace(matrix_K33: torch.Tensor) -> torch.Tensor:
    return matrix_K33.diagonal(dim1=-2, dim2=-1).sum(-1)


def adjugate(matrix_K33: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns determinants [K] and adjugates [K, 3, 3] of symmetric matrices."""
    row = matrix_K33.unbind(1)
    adjugate_K33 = torch.stack([torch.linalg.cross(row[i - 2], row[i - 1]) for i in range(3)], 1)
    return (row[0] * adjugate_K33[:, 0]).sum(-1), adjugate_K33


def inertia(spread_K33: torch.Tensor) -> torch.Tensor:
    """Returns tr(G) - G of the second moments G [K, 3, 3] of masses about their centre."""
    one_33 = torch.eye(3, dtype=spread_K33.dtype, device=spread_K33.device)
    return trace(spread_K33)[:, None, None] * one_33 - spread_K33


def rotation(inertia_K33: torch.Tensor, moment_K3: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns q [K], from 0 (a line or a point) to 1 (a determined rotation), and W [K, 3] with I W = q J.

    q = det I / (det I + m) and W = adj(I) J / (det I + m), with m = (THIN (tr I / 3 + POINT))^3. The denominator is
    positive, so q and W do not jump. If a field u has the angular momentum J, the field q u - W x y has none.
    """
    determinant_K, adjugate_K33 = adjugate(inertia_K33)
    determinant_K = determinant_K.clamp(min=0)
    mean_K = trace(inertia_K33) / 3
    total_K = determinant_K + (THIN * (mean_K + POINT)) ** 3
    return determinant_K / total_K, (adjugate_K33 @ moment_K3[..., None]).squeeze(-1) / total_K[:, None]
