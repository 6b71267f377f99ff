"""The hierarchical graph network (paper sec. 3.2, fig. 2): plain torch, the reference for every faster path.

Steps: encode particles (0), particles to cells (1), message passing on each level down (2, 4, …) with fine to
coarse (3, 5, …) between, message passing on each level up (8, 10, …) after coarse to fine (7, 9, …), cells to
particles (11), decode to the acceleration (12). With L levels there are 2 L - 1 message-passing blocks.
Shape legend: N particles, C cells, E directed edges, W width, S scenes.
"""

from __future__ import annotations

import torch
from torch import nn

from hgn.config import NetworkConfig
from hgn.network.base import ParticleNetwork
from hgn.network.fcn import FCN
from hgn.network.features import ParticleState
from hgn.network.grid import CORNER_83, DIRECTION_63, GridHierarchy, Level, build_hierarchy

PARTICLES_AT_ONCE = 512  # of eight pairs each; at width 128 a block is 2 MB


class MessagePassing(nn.Module):
    """Steps 2, 4, …: M iterations on the cells of one level (paper fig. 5), weights unshared."""

    def __init__(self, steps: int, width: int) -> None:
        super().__init__()
        self.edge = nn.ModuleList(FCN((width, width, 3 if m == 0 else width), width, width) for m in range(steps))
        self.cell = nn.ModuleList(FCN((width, width), width, width) for _ in range(steps))

    def forward(self, cell_CW: torch.Tensor, level: Level) -> torch.Tensor:
        """Returns the updated cell features [C, W]."""
        edge_EW = None
        for edge_network, cell_network in zip(self.edge, self.cell, strict=True):
            assert isinstance(edge_network, FCN) and isinstance(cell_network, FCN)
            if edge_EW is None:
                # Receiver minus sender in cells: the opposite of where the sender lies.
                offset_63 = -DIRECTION_63.to(cell_CW)
                own_EH = (edge_network.project(2, offset_63) + edge_network.first.bias)[level.direction_E]
            else:
                own_EH = edge_network.project(2, edge_EW) + edge_network.first.bias
            sender_CH, receiver_CH = edge_network.project(0, cell_CW), edge_network.project(1, cell_CW)
            update_EW = edge_network.finish(sender_CH[level.sender_E] + receiver_CH[level.receiver_E] + own_EH)
            edge_EW = update_EW if edge_EW is None else edge_EW + update_EW
            sum_CW = torch.zeros_like(cell_CW).index_add_(0, level.receiver_E, edge_EW)
            hidden_CH = cell_network.project(0, cell_CW) + cell_network.project(1, sum_CW) + cell_network.first.bias
            cell_CW = cell_CW + cell_network.finish(hidden_CH)
        return cell_CW


class HierarchicalGraphNetwork(ParticleNetwork):
    """Predicts the acceleration of every particle, in frame units.

    Without obstacle features the input lacks the normals (the paper's second data set); with them, a scene
    without obstacles leaves their columns out, which is exact since the normals are zero.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        width = config.width
        self.particle_to_cell = FCN((width, 3), width, width)
        self.passing_down = nn.ModuleList(
            MessagePassing(config.message_passing_steps, width) for _ in range(config.levels)
        )
        self.fine_to_coarse = nn.ModuleList(FCN((width, 3), width, width) for _ in range(config.levels - 1))
        self.coarse_to_fine = nn.ModuleList(FCN((width, width, 3), width, width) for _ in range(config.levels - 1))
        self.passing_up = nn.ModuleList(
            MessagePassing(config.message_passing_steps, width) for _ in range(config.levels - 1)
        )
        self.cell_to_particle = FCN((width, width, 3), width, width)
        self.decode = FCN((width,), width, 3, layer_norm=False)

    def normalised_acceleration(self, state: ParticleState, origin_S3: torch.Tensor | None = None) -> torch.Tensor:
        """The network's raw output [N, 3], which the loss compares with the normalised target.

        The finest grid's origin in each scene is 0 unless given.
        """
        if origin_S3 is None:
            origin_S3 = torch.zeros_like(state.domain_S3)
        config = self.config
        grid = build_hierarchy(state.position_N3, state.scene_N, origin_S3, config.cell_size, config.levels)
        return self.propagate(self.encode_particles(state), grid)

    def propagate(self, particle_NW: torch.Tensor, grid: GridHierarchy) -> torch.Tensor:
        """Steps 1 to 12: latent particles and their grids to normalised accelerations [N, 3]."""
        corner_83 = CORNER_83.to(particle_NW)
        # Towards the parent's centre, in fine cells: from octant o the parent's centre lies at 1/2 - o.
        parent_offset_83 = 0.5 - corner_83

        network = self.particle_to_cell
        hidden_NH = network.project(0, particle_NW) - network.project(1, grid.fraction_N3) + network.first.bias
        corner_8H = network.project(1, corner_83)
        cell_CW = particle_NW.new_zeros(grid.levels[0].cell_count, particle_NW.shape[1])
        for block in _pair_blocks(particle_NW):
            message_N8W = network.finish(hidden_NH[block, None] + corner_8H) * grid.weight_N8[block, :, None]
            cell_CW.index_add_(0, grid.cell_N8[block].flatten(), message_N8W.flatten(0, 1))

        kept: list[torch.Tensor] = []
        for i, level in enumerate(grid.levels):
            cell_CW = self.passing_down[i](cell_CW, level)
            if level.parent_C is None:
                break
            kept.append(cell_CW)
            network = _fcn(self.fine_to_coarse[i])
            offset_8H = network.project(1, parent_offset_83) + network.first.bias
            message_CW = network.finish(network.project(0, cell_CW) + offset_8H[level.octant_C])
            cell_CW = _scatter(message_CW, level.parent_C, grid.levels[i + 1].cell_count)

        for i in reversed(range(len(kept))):
            level = grid.levels[i]
            network = _fcn(self.coarse_to_fine[i])
            offset_8H = network.project(2, -parent_offset_83) + network.first.bias
            coarse_CH = network.project(0, cell_CW)[level.parent_C]
            hidden_CH = coarse_CH + network.project(1, kept[i]) + offset_8H[level.octant_C]
            cell_CW = self.passing_up[i](kept[i] + network.finish(hidden_CH), level)

        network = self.cell_to_particle
        hidden_NH = network.project(1, particle_NW) + network.project(2, grid.fraction_N3) + network.first.bias
        cell_CH, corner_8H = network.project(0, cell_CW), network.project(2, corner_83)
        changes = []
        for block in _pair_blocks(particle_NW):
            message_N8W = network.finish(cell_CH[grid.cell_N8[block]] + hidden_NH[block, None] - corner_8H)
            changes.append((message_N8W * grid.weight_N8[block, :, None]).sum(1))
        return self.decode(particle_NW + torch.cat(changes))


def _pair_blocks(particle_NW: torch.Tensor) -> list[slice]:
    """Runs of particles whose pairs stay in a CPU's cache; all at once on a GPU, and where gradients keep the pairs."""
    count = len(particle_NW)
    if particle_NW.device.type != "cpu" or torch.is_grad_enabled() or count == 0:
        return [slice(0, count)]
    return [slice(first, first + PARTICLES_AT_ONCE) for first in range(0, count, PARTICLES_AT_ONCE)]


def _scatter(value: torch.Tensor, index: torch.Tensor, count: int) -> torch.Tensor:
    """Sums rows [..., W] by index [...] into [count, W]."""
    width = value.shape[-1]
    return value.new_zeros(count, width).index_add_(0, index.flatten(), value.reshape(-1, width))


def _fcn(module: nn.Module) -> FCN:
    assert isinstance(module, FCN)
    return module
