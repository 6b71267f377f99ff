"""The network as one writes it first: each MLP sees its inputs beside each other, for all pairs and edges at once.

The same function of the same weights as hgn.network.hgn, which multiplies inputs where they live instead, and takes
a CPU's rows in blocks. Shape legend: N particles, C cells, E directed edges, W width.
"""

from __future__ import annotations

import torch

from hgn.network.features import ParticleState, wall_distances
from hgn.network.grid import CORNER_83, DIRECTION_63, GridHierarchy, Level
from hgn.network.hgn import HierarchicalGraphNetwork, MessagePassing
from hgn.network.mlp import MLP


class NaiveNetwork(HierarchicalGraphNetwork):
    """Only what is computed, and in which order, differs."""

    def encode_particles(self, state: ParticleState) -> torch.Tensor:
        maximum = self.config.wall_distance_cells * self.config.cell_size
        parts = [self.normaliser.normalise_velocity(state.velocity_NM3).flatten(1)]
        if self.config.obstacle_features:
            obstacles = state.obstacles
            zero_N3 = torch.zeros_like(state.position_N3)
            parts.append(zero_N3 if obstacles is None else obstacles.normals(state.position_N3, state.scene_N))
        parts.append(wall_distances(state.position_N3, state.domain_S3[state.scene_N], maximum))
        parts.append(self.embedding(state.material_N))
        return _output(self.encode, *parts)

    def propagate(self, particle_NW: torch.Tensor, grid: GridHierarchy) -> torch.Tensor:
        corner_83 = CORNER_83.to(particle_NW)
        latent_N8W = particle_NW[:, None].expand(-1, 8, -1)
        offset_N83 = corner_83 - grid.fraction_N3[:, None]  # from particles to cells
        message_N8W = _output(self.particle_to_cell, latent_N8W, offset_N83) * grid.weight_N8[..., None]
        cell_CW = _sums(message_N8W.flatten(0, 1), grid.cell_N8.flatten(), grid.levels[0].cell_count)
        kept = []
        for i, level in enumerate(grid.levels):
            cell_CW = _passed(self.passing_down[i], cell_CW, level)
            if level.parent_C is None or level.octant_C is None:
                break
            kept.append(cell_CW)
            message_CW = _output(self.fine_to_coarse[i], cell_CW, 0.5 - corner_83[level.octant_C])
            cell_CW = _sums(message_CW, level.parent_C, grid.levels[i + 1].cell_count)
        for i in reversed(range(len(kept))):
            level = grid.levels[i]
            assert level.parent_C is not None and level.octant_C is not None
            offset_C3 = corner_83[level.octant_C] - 0.5
            cell_CW = kept[i] + _output(self.coarse_to_fine[i], cell_CW[level.parent_C], kept[i], offset_C3)
            cell_CW = _passed(self.passing_up[i], cell_CW, level)
        change_N8W = _output(self.cell_to_particle, cell_CW[grid.cell_N8], latent_N8W, -offset_N83)
        return _output(self.decode, particle_NW + (change_N8W * grid.weight_N8[..., None]).sum(1))


def _passed(passing: torch.nn.Module, cell_CW: torch.Tensor, level: Level) -> torch.Tensor:
    """Message passing on one level."""
    assert isinstance(passing, MessagePassing)
    edge_E = -DIRECTION_63.to(cell_CW)[level.direction_E]  # receiver minus sender in cells
    for step, (edge, cell) in enumerate(zip(passing.edge, passing.cell, strict=True)):
        message_EW = _output(edge, cell_CW[level.sender_E], cell_CW[level.receiver_E], edge_E)
        edge_E = message_EW if step == 0 else edge_E + message_EW
        cell_CW = cell_CW + _output(cell, cell_CW, _sums(edge_E, level.receiver_E, level.cell_count))
    return cell_CW


def _output(network: torch.nn.Module, *parts: torch.Tensor) -> torch.Tensor:
    assert isinstance(network, MLP)
    hidden = torch.nn.functional.leaky_relu(network.first(torch.cat(parts, -1)), network.slope)
    out: torch.Tensor = network.second(hidden)
    return out if network.norm is None else network.norm(out)


def _sums(rows_RW: torch.Tensor, index_R: torch.Tensor, count: int) -> torch.Tensor:
    return rows_RW.new_zeros(count, rows_RW.shape[1]).index_add_(0, index_R, rows_RW)
