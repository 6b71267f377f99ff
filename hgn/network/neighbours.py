"""Neighbour lists: all pairs of particles closer than a radius, found with a sorted list of cells.

Cells are half a radius wide, so a particle's neighbours lie in 5 x 5 x 5 of them. z varies fastest in the keys, so they
are 25 contiguous runs of the sorted particles. The work is proportional to the number of neighbours.
Shape legend: N particles, K candidate pairs, E directed edges.
"""

from dataclasses import dataclass

import torch

from hgn.network.cell_keys import AXIS_STRIDE, COORDINATE_LIMIT, pack
from hgn.network.grid import GridRangeError
from hgn.network.segments import Segments
from hgn.schema import require

REACH = 2  # cells on each side
# Two particles within a radius must be at most REACH cells apart. Rounding changes a quotient by up to 0.004 cells at
# the largest coordinates, so cells are SLACK times half a radius wide.
SLACK = 1.01
CANDIDATES = 4  # pairs in these cells for a pair within the radius, in a large body
MOST_NEIGHBOURS = 1000  # mean number, as in imports; this project's data have at most 400


@dataclass(frozen=True, eq=False)
class NeighbourList:
    """Holds directed edges between particles in the order of `order_N`, by receiver, with one from each to itself."""

    order_N: torch.Tensor  # int64: the particle at each index of the sorted order
    sender_E: torch.Tensor  # int64, indices in the sorted order
    receivers: Segments


def neighbour_list(position_N3: torch.Tensor, scene_N: torch.Tensor, radius: float) -> NeighbourList:
    """Returns all ordered pairs of particles of one scene closer than `radius`, including each particle with itself.

    Raises: GridRangeError when a particle is not finite or too far from the origin, and ConfigError for more than
    MOST_NEIGHBOURS on average, for large bodies before memory is allocated for pairs.
    """
    key_N = _keys(position_N3, scene_N, 0.5 * SLACK * radius)
    key_N, order_N = torch.sort(key_N, stable=True)
    position_N3 = position_N3[order_N]
    first_NR, length_NR = _runs(key_N)
    _require_few(int(length_NR.sum()) // CANDIDATES, len(key_N), radius)
    # One row per candidate pair: its receiver, and its index in the receiver's runs.
    runs = length_NR.shape[1]
    length_Q = length_NR.flatten()
    end_Q = length_Q.cumsum(0)
    run_K = torch.repeat_interleave(length_Q)
    sender_K = torch.arange(len(run_K), device=run_K.device) + (first_NR.flatten() - end_Q + length_Q)[run_K]
    receiver_K = run_K // runs
    offset_K3 = position_N3.index_select(0, sender_K) - position_N3.index_select(0, receiver_K)
    near_K = offset_K3.square().sum(-1) < radius * radius
    near_E = torch.nonzero(near_K).flatten()
    _require_few(len(near_E), len(key_N), radius)
    sender_E, receiver_E = sender_K[near_E], receiver_K[near_E]
    offset_N1 = torch.searchsorted(receiver_E, torch.arange(len(key_N) + 1, device=receiver_E.device))
    return NeighbourList(order_N, sender_E, Segments(offset_N1, receiver_E))


def _require_few(pairs: int, particles: int, radius: float) -> None:
    mean, remedy = pairs // max(1, particles), "lower it, or use network.kind=hgn"
    rule = f"below {radius:g}, for at most {MOST_NEIGHBOURS} neighbours on average"
    require(mean <= MOST_NEIGHBOURS, "network.cell_size", rule, mean, remedy=remedy)


def _keys(position_N3: torch.Tensor, scene_N: torch.Tensor, size: float) -> torch.Tensor:
    grid_N3 = position_N3 / size
    inside_N3 = grid_N3.abs() < COORDINATE_LIMIT - REACH - 1
    if not bool(inside_N3.all()):
        raise GridRangeError(
            f"positions must be finite and within {(COORDINATE_LIMIT - REACH - 1) * size:.0f} domain units, "
            f"got {position_N3[inside_N3.logical_not().any(1)][0].tolist()}"
        )
    return pack(scene_N, torch.floor(grid_N3).long())


def _runs(key_N: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns first index and length of the 25 runs of each particle, [N, 25]."""
    side = torch.arange(-REACH, REACH + 1, device=key_N.device)
    column_R = (side[:, None] * AXIS_STRIDE[0] + side[None] * AXIS_STRIDE[1]).flatten()
    low_NR = key_N[:, None] + (column_R - REACH * AXIS_STRIDE[2])
    first_NR = torch.searchsorted(key_N, low_NR)
    last_NR = torch.searchsorted(key_N, low_NR + 2 * REACH * AXIS_STRIDE[2], right=True)
    return first_NR, last_NR - first_NR
