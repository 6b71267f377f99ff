"""The sparse grid hierarchy (paper sec. 3.2, fig. 2 and 3), built with plain tensor operations.

Cell k of the finest level spans [k, k + 1) * cell_size + origin. A cell is active if its centre has a non-zero
trilinear weight for some particle. The parent of cell k is floor(k / 2). It is active if one of its children is.
Edges join active cells of one level that share a face, in both directions.

With `bodies`, cells of different bodies are different cells, on all levels. A body is a set of finest cells that
particles connect: a particle connects its eight cells. So a coarser cell belongs to one body, and a cube of space may
have several cells. Edges join cells of the same body, on coarser levels only where an edge of the finest level crosses
their common face. So bodies that are apart exchange nothing.
Shape legend: N particles, G groups of particles, C cells of a level, E directed edges of a level, S scenes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch.compiler import is_exporting

from hgn.network.cell_keys import AXIS_STRIDE, COORDINATE_LIMIT, find, pack, unique, unpack
from hgn.network.centres import Centres, Groups
from hgn.schema import ConfigError

# The 8 corners of a unit cube, z fastest: the offsets of a particle's cells, and of children in a parent.
CORNER_83 = torch.tensor([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
# The 6 directions from an edge's receiver to its sender.
DIRECTION_63 = torch.tensor([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])

EXPORTED_ROUNDS = 16  # rounds of `_bodies` in an exported graph, which has no loops; they reach across 2^15 cells


class GridRangeError(ConfigError):
    """A particle is not finite, or too far from the origin for the grid's integer coordinates."""


@dataclass(frozen=True, eq=False)
class Level:
    """One level. Cells are sorted by key, cells of one key by body, edges by receiver."""

    key_C: torch.Tensor
    sender_E: torch.Tensor
    receiver_E: torch.Tensor
    direction_E: torch.Tensor  # row of DIRECTION_63
    parent_C: torch.Tensor | None = None  # index into the next level; None on the coarsest
    octant_C: torch.Tensor | None = None  # row of CORNER_83: the cell's position in its parent

    @property
    def cell_count(self) -> int:
        return self.key_C.shape[0]  # len() would fix the size of an exported graph


@dataclass(frozen=True, eq=False)
class GridHierarchy:
    """All levels, finest first, and the 8 cells of each particle. Particles with the same cells form a group."""

    levels: tuple[Level, ...]
    fraction_N3: torch.Tensor  # particle minus the centre of its first corner's cell, in cells, [0, 1)
    cell_G8: torch.Tensor  # the cells of each group: int64, index into the finest level; corner order of CORNER_83
    groups: (
        Groups  # with trilinear weights, which sum to 1; some are zero if the particle lies on a plane of cell centres
    )

    @cached_property
    def cells(self) -> torch.Tensor:
        """Returns the eight finest cells of each particle, `cell_G8` of its group, [N, 8]."""
        return self.cell_G8[self.groups.group_N]

    @cached_property
    def finest(self) -> Centres:
        """Returns the centres of the finest cells."""
        offset_183 = -CORNER_83.to(self.fraction_N3)[None]
        count = self.levels[0].cell_count
        return Centres(self.groups, self.fraction_N3, self.cell_G8, offset_183, count)

    @cached_property
    def coarsest(self) -> Centres:
        """Returns the centres of the coarsest ancestors of each particle's eight cells, some of which may be equal."""
        corner_83, cell_G8 = CORNER_83.to(self.fraction_N3), self.cell_G8
        place_N3, offset_G83 = self.fraction_N3, -corner_83[None]
        for level in self.levels[:-1]:
            assert level.parent_C is not None and level.octant_C is not None
            place_N3, offset_G83 = 0.5 * place_N3, 0.5 * (offset_G83 + corner_83[level.octant_C[cell_G8]] - 0.5)
            cell_G8 = level.parent_C[cell_G8]
        return Centres(self.groups, place_N3, cell_G8, offset_G83, self.levels[-1].cell_count)


def build_hierarchy(
    position_N3: torch.Tensor,
    scene_N: torch.Tensor,
    origin_S3: torch.Tensor,
    cell_size: float,
    levels: int,
    bodies: bool = False,
) -> GridHierarchy:
    """Builds the grids of all scenes. Cells of different scenes are never neighbours.

    position_N3 is in domain units. scene_N contains int64 indices into origin_S3, the finest grid's origins. With
    `bodies` cells of different bodies are different cells.
    Raises: GridRangeError if a particle is not finite, or 65,534 cells or more from the origin on an axis.
    """
    grid_N3 = (position_N3 - origin_S3[scene_N]) / cell_size - 0.5
    # an exported graph cannot raise
    if not is_exporting() and len(grid_N3) and not bool((grid_N3.abs() < COORDINATE_LIMIT - 2).all()):
        raise GridRangeError(
            f"positions must be finite and within {(COORDINATE_LIMIT - 2) * cell_size:.0f} domain units, "
            f"got {position_N3[(grid_N3.abs() < COORDINATE_LIMIT - 2).logical_not().any(1)][0].tolist()}"
        )
    base_N3 = torch.floor(grid_N3)
    fraction_N3 = grid_N3 - base_N3
    corner_83 = CORNER_83.to(position_N3.device)
    # A particle exactly on a plane of centres gives the far corners no weight, so these must not become active.
    # Their entries point at the near corner instead, with weight zero.
    reached_N = octant(fraction_N3 > 0)
    key_B, base_N = unique(pack(scene_N, base_N3.long()))
    key_G, group_N = unique(8 * base_N + reached_N)
    scene_G, coordinate_G3 = unpack(key_B[key_G >> 3])
    coordinate_G83 = coordinate_G3[:, None] + corner_83 * corner_83[key_G & 7][:, None]
    key_C, cell_G8 = unique(pack(scene_G[:, None], coordinate_G83))

    finest_count = key_C.shape[0]
    body_C = _bodies(cell_G8, finest_count) if bodies else None
    built: list[Level] = []
    for level in range(levels):
        edges = _edges_of_parents(built[-1], key_C.shape[0]) if bodies and level > 0 else _edges(key_C, body_C)
        sender_E, receiver_E, direction_E = edges
        if level == levels - 1:
            built.append(Level(key_C, sender_E, receiver_E, direction_E))
            break
        scene_C, coordinate_C3 = unpack(key_C)
        parent_key, parent_C = unique(pack(scene_C, coordinate_C3 >> 1))
        if body_C is not None:
            owned, parent_C = unique(parent_C * finest_count + body_C)
            parent = torch.div(owned, finest_count, rounding_mode="floor")
            parent_key, body_C = parent_key[parent], owned - finest_count * parent  # ONNX has no % by a size
        built.append(Level(key_C, sender_E, receiver_E, direction_E, parent_C, octant(coordinate_C3 & 1)))
        key_C = parent_key
    return GridHierarchy(tuple(built), fraction_N3, cell_G8, Groups(trilinear(fraction_N3), group_N, key_G.shape[0]))


def trilinear(fraction_N3: torch.Tensor) -> torch.Tensor:
    """Returns the weights of the corners of a cube at positions in it, [N, 8]."""
    x_N2, y_N2, z_N2 = torch.stack([1 - fraction_N3, fraction_N3], -1).unbind(1)
    return (x_N2[:, :, None, None] * y_N2[:, None, :, None] * z_N2[:, None, None]).flatten(1)


def octant(upper_K3: torch.Tensor) -> torch.Tensor:
    """Returns the row of CORNER_83 of each triple of zeros and ones, int64 [K]."""
    return (upper_K3 * torch.tensor([4, 2, 1], device=upper_K3.device)).sum(-1)


def _bodies(cell_G8: torch.Tensor, count: int) -> torch.Tensor:
    """Returns the body of each finest cell, int64 [C]: its lowest cell.

    In each round a cell, and the cell that it links to, get the lowest link among the cells that share a particle with
    them. Then links are followed once (as in Zhang, Azad and Hu 2020). An exported graph has a fixed number of rounds.
    """
    body_C, rounds = torch.arange(count, device=cell_G8.device), 0
    while True:
        least_G8 = body_C[cell_G8].amin(1, keepdim=True).expand(-1, 8).flatten()
        linked_C = body_C.scatter_reduce(0, body_C[cell_G8].flatten(), least_G8, "amin")
        linked_C = linked_C.scatter_reduce(0, cell_G8.flatten(), least_G8, "amin")
        linked_C, rounds = linked_C[linked_C], rounds + 1
        if rounds == EXPORTED_ROUNDS if is_exporting() else torch.equal(linked_C, body_C):
            return linked_C
        body_C = linked_C


def _edges(key_C: torch.Tensor, body_C: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    stride_6 = (DIRECTION_63 * torch.tensor(AXIS_STRIDE)).sum(-1).to(key_C.device)
    neighbour_C6, found_C6 = find(key_C, key_C[:, None] + stride_6)
    if body_C is not None:
        found_C6 = found_C6 & (body_C[neighbour_C6] == body_C[:, None])
    receiver_E, direction_E = torch.nonzero(found_C6, as_tuple=True)
    return neighbour_C6[receiver_E, direction_E], receiver_E, direction_E


def _edges_of_parents(level: Level, count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Returns the edges between different parents of cells that an edge of this level joins. `count`: parents."""
    assert level.parent_C is not None
    sender_E, receiver_E = level.parent_C[level.sender_E], level.parent_C[level.receiver_E]
    (crossing_E,) = torch.nonzero(sender_E != receiver_E, as_tuple=True)
    edge_E = (receiver_E * 6 + level.direction_E) * count + sender_E
    edge_E, _ = unique(edge_E[crossing_E])
    receiver_E = torch.div(edge_E, count, rounding_mode="floor")
    return edge_E - receiver_E * count, torch.div(receiver_E, 6, rounding_mode="floor"), receiver_E % 6
