"""The triangles of obstacles on the device, and the cells that list them (see hgn.step.reference).

Shape legend: Q cells of all scenes, E entries of their lists, F triangles.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from hgn.network.cell_keys import pack
from hgn.scene.barrier import CELLS, LEAST_HEIGHT, MARGIN, Barrier
from hgn.schema import require

NOWHERE = 1e30  # coordinates of an empty box, domain units: lowest corner at NOWHERE, highest at -NOWHERE


@dataclass(frozen=True, eq=False)
class Barriers:
    """The barriers of a batch: sorted cell keys, and each cell's list of triangles."""

    key_Q: torch.Tensor  # int64
    start_Q: torch.Tensor  # int64 [Q + 1]
    triangle_E: torch.Tensor  # int64
    row_F24: torch.Tensor  # columns as in hgn.scene.barrier
    scene_F: torch.Tensor  # int64
    cell_size: float
    clearance: float

    @staticmethod
    def of(barriers: Sequence[Barrier]) -> "Barriers | None":
        """Returns the barriers of a batch, with barriers[s] for scene s; None if no scene has an obstacle.

        Raises: ConfigError if scenes with obstacles have different cell sizes.
        """
        if not any(len(barrier.row_F24) for barrier in barriers):
            return None
        clearance = barriers[0].clearance
        assert all(barrier.clearance == clearance for barrier in barriers)
        cell_size, *others = sorted({barrier.cell_size for barrier in barriers if len(barrier.row_F24)})
        values = tuple(size / CELLS for size in (cell_size, *others))
        rule = "one for all scenes of a batch with obstacle_clearance"
        require(not others, "cell_size", rule, values, "simulate scenes of other cell sizes separately")
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

    def to(self, device: torch.device, non_blocking: bool = False) -> "Barriers":
        names = ("key_Q", "start_Q", "triangle_E", "row_F24", "scene_F")
        moved = {name: getattr(self, name).to(device, non_blocking=non_blocking) for name in names}
        return replace(self, **moved)


def barrier_rows(corner_F33: torch.Tensor, clearance: float) -> torch.Tensor:
    """Returns the rows of triangles (see hgn.scene.barrier), float64 [F, 24], differentiable in the corners.

    The row of a triangle without area covers no point.
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
