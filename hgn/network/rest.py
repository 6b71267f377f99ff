"""Rest where touched bodies deform slowly (`network.rest_threshold`), for networks of relative inputs; not the paper's.

`balanced` makes the motion of coarsest cells exact, as wholes; how bodies deform is learned, and what is learned never
is 0: piles creep and swell. Here slow deformation stops, as below a yield stress; what bodies have in common, and what
is beyond the threshold, goes on as it was.

P value = sum_K w_pK min(1, 2 q_K) (value_p - mean_K - Omega_K x y_p) is the deforming part of a field. K are the
middles of coarsest cells, w_pK the trilinear weights between them times the particle's gate sum_C w_pC t_C, t_C
`touched`; mean and rate of rotation Omega_K are those of the field with these weights, y_p is seen from their centre of
mass, and q_K says how well rotation is known (`rotation`). Weights overlap, so that it is the same wherever a body lies
in the grid; bodies far larger than these cells deform as they like. With the next displacement u = v + a and d = P u
accelerations become a - P (phi d), where phi = 2 - |d|^2 / (threshold |g|)^2 within 0 and 1.

The same follows between cells of four times that size, with what the first has left: sand that covers a floor, which is
larger than a coarsest cell, rests too. Particles in contact within two of these larger cells share their slow motion,
in one body or in several. FRICTIONLESS materials are not part of it: water spreads on.

So momentum and angular momentum stay, whatever the weights; as P is symmetric and within 0 and 1, no motion gains
energy, in any frame; no boost is seen; and nothing changes where nothing touches, without gravity, and beyond sqrt(2)
of the threshold.
Shape legend: N particles, C coarsest cells, K middles.
"""

from __future__ import annotations

import torch

from hgn.config import NetworkConfig
from hgn.network.cell_keys import pack, unique, unpack
from hgn.network.features import ParticleState
from hgn.network.grid import CORNER_83, GridHierarchy
from hgn.network.relative import SMALLEST_MASS, coarsest_cells, coarsest_places, inertia, rotation

SURE = 0.5  # q from which on rotation counts as known
LEAST = 1e-30  # of a limit squared
REST_SIZES, LEVEL_SHIFT = 2, 2  # sizes of cells, and the shift from one to the next: 2^LEVEL_SHIFT times as large
FRICTIONLESS = ("water",)  # materials that do not rest between the larger cells


class Deformation:
    """P of a grid whose coarsest cells are `touched_C`, between cells 2^shift times as large as these, of the particles
    that `share_N` is 1 for: called with a field [N, 3], it gives the part that deforms.
    """

    def __init__(
        self, touched_C: torch.Tensor, grid: GridHierarchy, shift: int = 0, share_N: torch.Tensor | None = None
    ) -> None:
        cell_N8, corner_83 = coarsest_cells(grid), CORNER_83.to(grid.cell_N8)
        gate_N = (grid.weight_N8 * touched_C[cell_N8]).sum(1)
        if share_N is not None:
            gate_N = share_N * gate_N
        scene_N, coordinate_N3 = unpack(grid.levels[-1].key_C[cell_N8[:, 0]])
        place_N3 = coarsest_places(grid)[:, 0]
        low_N3 = torch.floor(place_N3)
        low_N3, place_N3 = coordinate_N3 + low_N3.long(), place_N3 - low_N3
        wide_N3 = low_N3 >> shift
        key_N8 = pack(scene_N[:, None], wide_N3[:, None] + corner_83)
        key_K, self.middle_N8 = unique(key_N8)
        self.count = key_K.shape[0]
        self.place_N83 = ((low_N3 - (wide_N3 << shift) + place_N3) / 2**shift)[:, None] - corner_83
        self.weight_N8 = gate_N[:, None] * (1 - self.place_N83.abs()).prod(-1)
        square_N89 = (self.place_N83[..., :, None] * self.place_N83[..., None, :]).flatten(2)
        sum_KX = self._sums(torch.cat([torch.ones_like(square_N89[..., :1]), self.place_N83, square_N89], -1))
        self.mass_K1 = sum_KX[:, :1].clamp(min=SMALLEST_MASS)
        self.centre_K3, square_K9 = (sum_KX[:, 1:] / self.mass_K1).split([3, 9], 1)
        spread_K33 = square_K9.unflatten(1, (3, 3)) - self.centre_K3[:, :, None] * self.centre_K3[:, None, :]
        self.inertia_K33 = inertia(spread_K33)

    def __call__(self, value_N3: torch.Tensor) -> torch.Tensor:
        value_N83 = value_N3[:, None].expand_as(self.place_N83)
        sum_K6 = self._sums(torch.cat([value_N83, torch.linalg.cross(self.place_N83, value_N83)], -1))
        mean_K3, moment_K3 = (sum_K6 / self.mass_K1).split(3, 1)
        known_K, turn_K3 = rotation(self.inertia_K33, moment_K3 - torch.linalg.cross(self.centre_K3, mean_K3))
        share_K = 1 / known_K.clamp(min=SURE)
        factor_N81 = (share_K * known_K)[self.middle_N8][..., None]
        turn_N83 = (share_K[:, None] * turn_K3)[self.middle_N8]
        place_N83 = self.place_N83 - self.centre_K3[self.middle_N8]
        part_N83 = factor_N81 * (value_N83 - mean_K3[self.middle_N8]) - torch.linalg.cross(turn_N83, place_N83)
        return (self.weight_N8[..., None] * part_N83).sum(1)

    def _sums(self, value_N8X: torch.Tensor) -> torch.Tensor:
        """With the weights, [K, X]."""
        value_N8X = self.weight_N8[..., None] * value_N8X
        sum_KX = value_N8X.new_zeros(self.count, value_N8X.shape[-1])
        return sum_KX.index_add(0, self.middle_N8.flatten(), value_N8X.flatten(0, 1))


def rested(
    acceleration_N3: torch.Tensor,
    state: ParticleState,
    touched_C: torch.Tensor,
    grid: GridHierarchy,
    threshold: float,
    scale: torch.Tensor,
    widely_M: torch.Tensor,
) -> torch.Tensor:
    """Returns accelerations less gravity, as `balanced` gives them, without slow deformations, [N, 3], in units of the
    normaliser's `scale`. `widely_M` is 1 for the materials that rest between larger cells, too.
    """
    widely_N = widely_M[state.material_N]
    limit_N = ((threshold / scale) ** 2 * state.gravity_S3.square().sum(-1))[state.scene_N]
    for level in range(REST_SIZES):
        deformation = Deformation(touched_C, grid, level * LEVEL_SHIFT, widely_N if level else None)
        # gravity, which is the same for all of a scene, is no part of a deformation
        rate_N3 = deformation(acceleration_N3 + state.velocity_NM3[:, 0] / scale)
        acceleration_N3 = acceleration_N3 - deformation(slow(rate_N3, limit_N))
    return acceleration_N3


def rests_widely(config: NetworkConfig) -> list[bool]:
    """Returns whether each of the network's materials rests between cells larger than the coarsest, too."""
    return [name not in FRICTIONLESS for name in config.materials]


def slow(rate_N3: torch.Tensor, limit_N: torch.Tensor) -> torch.Tensor:
    """phi d of d and of the threshold's square, which may be 0."""
    ratio_N = rate_N3.square().sum(-1) / limit_N.clamp(min=LEAST)
    return torch.where(limit_N > 0, (2 - ratio_N).clamp(0, 1), 0)[:, None] * rate_N3
