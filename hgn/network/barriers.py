"""Rigid surfaces of obstacles, on the device: what stops a particle's straight way at the end of a frame.

The rule, for a way from x to y. A particle keeps to the side of each triangle that it begins on; exactly on a plane,
to that of the normal. Where its way comes nearer to the triangle's plane than the clearance, over what the triangle
covers (hgn.scene.barrier), or crosses the plane there, the triangle stops it; of several triangles, the first. What
stops it is SLACK of the clearance nearer than where it is to end, so that for rounding no triangle stops a way twice.
It is to end as far from the plane as the clearance, or as x where that is nearer: y is to be shifted along the
triangle's normal (hgn.runtime.holding), and keeps what is along the triangle, as on a surface without friction.
Shape legend: N particles, Q cells of all scenes, E entries of their lists, F triangles, P pairs of both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.compiler import is_exporting

from hgn.network.cell_keys import COORDINATE_LIMIT, LARGEST_EXPORTED, find, pack
from hgn.scene.barrier import CELLS, LEAST_HEIGHT, MARGIN, Barrier
from hgn.schema import require

SLACK = 0.02  # of the clearance; what begins nearer leaves by that in a frame that would bring it nearer
NOWHERE = 1e30  # domain units: lowest corner of a box that nothing meets, its highest is at minus that


@dataclass(frozen=True, eq=False)
class Barriers:
    """The barriers of a batch: sorted cell keys, and the triangles that each cell lists."""

    key_Q: torch.Tensor  # int64
    start_Q: torch.Tensor  # int64 [Q + 1]
    triangle_E: torch.Tensor  # int64
    row_F24: torch.Tensor  # as in hgn.scene.barrier
    scene_F: torch.Tensor  # int64
    cell_size: float
    clearance: float

    @staticmethod
    def of(barriers: Sequence[Barrier]) -> Barriers | None:
        """Of a batch, scene s from barriers[s]; none where no scene has an obstacle.

        Raises: ConfigError where those that have some have cells of more than one size.
        """
        if not any(len(barrier.row_F24) for barrier in barriers):
            return None
        clearance = barriers[0].clearance
        assert all(barrier.clearance == clearance for barrier in barriers)
        cell_size, *others = sorted({barrier.cell_size for barrier in barriers if len(barrier.row_F24)})
        values = tuple(size / CELLS for size in (cell_size, *others))
        rule = "one for all scenes of a batch with obstacle_clearance"
        require(not others, "cell_size", rule, values, "simulate scenes of other cells by themselves")
        keys = [
            pack(torch.full((len(b.cell_Q3),), scene), torch.from_numpy(b.cell_Q3.astype(np.int64)))
            for scene, b in enumerate(barriers)
        ]
        triangles = np.cumsum([0, *(len(b.row_F24) for b in barriers)])
        entries = np.cumsum([0, *(len(b.triangle_E) for b in barriers)])
        starts = [b.start_Q[:-1] + first for b, first in zip(barriers, entries, strict=False)]
        lists = [b.triangle_E + first for b, first in zip(barriers, triangles, strict=False)]
        return Barriers(
            torch.cat(keys),
            torch.from_numpy(np.concatenate([*starts, entries[-1:]]).astype(np.int64)),
            torch.from_numpy(np.concatenate(lists).astype(np.int64)),
            torch.from_numpy(np.concatenate([b.row_F24 for b in barriers])),
            torch.from_numpy(np.repeat(np.arange(len(barriers)), np.diff(triangles))),
            cell_size,
            clearance,
        )

    def to(self, device: torch.device, non_blocking: bool = False) -> Barriers:
        names = ("key_Q", "start_Q", "triangle_E", "row_F24", "scene_F")
        moved = {name: getattr(self, name).to(device, non_blocking=non_blocking) for name in names}
        return replace(self, **moved)

    def stopped(
        self, before_N3: torch.Tensor, after_N3: torch.Tensor, scene_N: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Which ways a triangle stops, bool [N]; by how much their ends are to be shifted, [N, 1], and along which unit
        normals, [N, 3]; and the share of a way on which nothing is met, [N, 1].

        Shifts and normals are zero where nothing stops a way. Positions are finite. The way to a shifted end may be
        stopped by another triangle.
        """
        particle_P, triangle_P = self._pairs(before_N3, after_N3, scene_N)
        row_P24 = self.row_F24.to(before_N3.dtype)[triangle_P]
        before_P3, way_P3 = before_N3[particle_P], (after_N3 - before_N3)[particle_P]
        normal_P3 = row_P24[:, :3]
        distance_P = (normal_P3 * before_P3).sum(-1) - row_P24[:, 3]
        side_P = torch.where(distance_P >= 0, 1.0, -1.0).to(distance_P.dtype)
        distance_P = side_P * distance_P
        approach_P = -side_P * (normal_P3 * way_P3).sum(-1)
        end_P, closing_P = distance_P - approach_P, approach_P.clamp(min=1e-30)
        within, slack = (1 - SLACK) * self.clearance, SLACK * self.clearance
        contact_P = ((distance_P - within) / closing_P).clamp(0, 1)
        crossing_P = (distance_P / closing_P).clamp(0, 1)
        meets_P = _covers(row_P24, before_P3 + contact_P[:, None] * way_P3)
        crosses_P = _covers(row_P24, before_P3 + crossing_P[:, None] * way_P3) & (end_P < 0)
        stops_P = (approach_P > 0) & (end_P < within) & (meets_P | crosses_P)
        time_P = torch.where(stops_P, torch.where(meets_P, contact_P, crossing_P), 2.0)
        least_N = torch.full_like(before_N3[:, 0], 2.0).scatter_reduce(0, particle_P, time_P.detach(), "amin")
        first_P = stops_P & (time_P == least_N[particle_P])
        # of several at one time that of the least number
        count, pairs = self.row_F24.shape[0], particle_P.shape[0]
        number_P = torch.where(first_P, triangle_P, count)
        number_N = torch.full_like(scene_N, count).scatter_reduce(0, particle_P, number_P, "amin")
        first_P = first_P & (triangle_P == number_N[particle_P])
        # the pair of each particle, a last one that moves nothing for the others
        place_P = torch.where(first_P, torch.arange(pairs, device=scene_N.device), pairs)
        pair_N = torch.full_like(scene_N, pairs).scatter_reduce(0, particle_P, place_P, "amin")
        push_P4 = torch.cat([(distance_P.clamp(max=within) + slack - end_P)[:, None], side_P[:, None] * normal_P3], 1)
        push_N4 = torch.cat([push_P4, before_N3.new_zeros(1, 4)])[pair_N]
        free_P = torch.where(stops_P, contact_P, 1.0)
        free_N = torch.ones_like(before_N3[:, 0]).scatter_reduce(0, particle_P, free_P, "amin")
        return pair_N < pairs, push_N4[:, :1], push_N4[:, 1:], free_N[:, None]

    def _pairs(
        self, before_N3: torch.Tensor, after_N3: torch.Tensor, scene_N: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Particles and triangles int64 [P] among which are all that meet."""
        if is_exporting():
            return self._pairs_of_boxes(before_N3, after_N3)
        before_N3, after_N3 = before_N3.detach(), after_N3.detach()
        way_N3 = after_N3 - before_N3
        pieces_N = torch.ceil(torch.linalg.vector_norm(way_N3, dim=-1) / self.cell_size).clamp(min=1)
        particles, triangles = [scene_N[:0]], [scene_N[:0]]
        for piece in range(int(pieces_N.max()) if len(pieces_N) else 0):
            here_N = torch.nonzero(pieces_N > piece).flatten() if piece else torch.arange(len(way_N3)).to(scene_N)
            share_N1 = ((piece + 0.5) / pieces_N[here_N])[:, None]
            cell_N3 = torch.floor((before_N3[here_N] + share_N1 * way_N3[here_N]) / self.cell_size)
            cell_N3 = cell_N3.clamp(-COORDINATE_LIMIT, COORDINATE_LIMIT - 1).long()
            index_N, found_N = find(self.key_Q, pack(scene_N[here_N], cell_N3))
            index_N, here_N = index_N[found_N], here_N[found_N]
            count_N = self.start_Q[index_N + 1] - self.start_Q[index_N]
            before = torch.repeat_interleave(count_N.cumsum(0) - count_N, count_N)
            entry = torch.arange(len(before), device=before.device) - before
            triangles.append(self.triangle_E[torch.repeat_interleave(self.start_Q[index_N], count_N) + entry])
            particles.append(torch.repeat_interleave(here_N, count_N))
        return torch.cat(particles), torch.cat(triangles)

    def _pairs_of_boxes(self, before_N3: torch.Tensor, after_N3: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Those whose boxes meet: as a graph without loops has it, of one scene."""
        low_N3, high_N3 = torch.minimum(before_N3, after_N3), torch.maximum(before_N3, after_N3)
        low_F3, high_F3 = self.row_F24[:, 16:19], self.row_F24[:, 20:23]
        meets_NF = (low_N3[:, None, 0] <= high_F3[None, :, 0]) & (high_N3[:, None, 0] >= low_F3[None, :, 0])
        for axis in (1, 2):
            meets_NF = meets_NF & (low_N3[:, None, axis] <= high_F3[None, :, axis])
            meets_NF = meets_NF & (high_N3[:, None, axis] >= low_F3[None, :, axis])
        particle_P, triangle_P = torch.nonzero(meets_NF, as_tuple=True)
        if is_exporting():
            torch._check(particle_P.shape[0] <= LARGEST_EXPORTED)
        return particle_P, triangle_P


def barrier_rows(corner_F33: torch.Tensor, clearance: float) -> torch.Tensor:
    """The rows of triangles as hgn.scene.barrier computes them, float64 [F, 24], with gradients by the corners.

    Nothing meets the row of a triangle without area.
    """
    corner_F33 = corner_F33.double()
    a_F3, b_F3, c_F3 = corner_F33.unbind(1)
    normal_F3 = torch.linalg.cross(b_F3 - a_F3, c_F3 - a_F3)
    double_area_F1 = torch.linalg.vector_norm(normal_F3, dim=-1, keepdim=True)
    edges = (b_F3 - a_F3, c_F3 - b_F3, a_F3 - c_F3)
    longest_F1 = torch.stack([torch.linalg.vector_norm(edge_F3, dim=-1) for edge_F3 in edges]).amax(0)[:, None]
    normal_F3 = _unit(normal_F3)
    planes = [normal_F3, (normal_F3 * c_F3).sum(-1, keepdim=True)]
    for edge_F3, corner_F3 in zip(edges, (a_F3, b_F3, c_F3), strict=True):
        outward_F3 = _unit(torch.linalg.cross(edge_F3, normal_F3))
        planes += [outward_F3, (outward_F3 * corner_F3).sum(-1, keepdim=True) + MARGIN * clearance]
    exists_F1, zero_F1 = double_area_F1 > LEAST_HEIGHT * longest_F1, torch.zeros_like(double_area_F1)
    low_F3 = torch.where(exists_F1, corner_F33.amin(1) - 2 * clearance, NOWHERE)
    high_F3 = torch.where(exists_F1, corner_F33.amax(1) + 2 * clearance, -NOWHERE)
    return torch.cat([*planes, low_F3, zero_F1, high_F3, zero_F1], dim=1)


def _unit(direction_F3: torch.Tensor) -> torch.Tensor:
    return direction_F3 / torch.linalg.vector_norm(direction_F3, dim=-1, keepdim=True).clamp(min=1e-300)


def _covers(row_P24: torch.Tensor, place_P3: torch.Tensor) -> torch.Tensor:
    """Whether a triangle covers a place in its plane, bool [P]."""
    inside_P = ((place_P3 >= row_P24[:, 16:19]) & (place_P3 <= row_P24[:, 20:23])).all(-1)
    for plane in (4, 8, 12):
        inside_P = inside_P & ((row_P24[:, plane : plane + 3] * place_P3).sum(-1) <= row_P24[:, plane + 3])
    return inside_P
