"""The hierarchical graph network (paper sec. 3.2, fig. 2) in plain torch: the reference of every faster backend.

Steps have the numbers of the paper's figure, which has three levels:
0: encode particles. 1: particles to cells.
2, 4, 6: message passing on each level, from the finest to the coarsest. 3, 5: fine to coarse, between these steps.
7, 9: coarse to fine. 8, 10: message passing on each level except the coarsest, up to the finest.
11: cells to particles. 12: decode the acceleration. With L levels there are 2 L - 1 message-passing blocks.
Shape legend: N particles, C cells, E directed edges, W width, H hidden width of an MLP, F input features, S scenes.
"""

from collections.abc import Callable

import torch
from torch import nn

from hgn.config import NetworkConfig
from hgn.network.base import ParticleNetwork, Prediction
from hgn.network.features import ParticleState
from hgn.network.grid import CORNER_83, DIRECTION_63, GridHierarchy, Level, build_hierarchy
from hgn.network.images import Image
from hgn.network.mlp import MLP
from hgn.network.origins import frame_origin
from hgn.network.relative import OUTPUTS, balanced


class MessagePassing(nn.Module):
    """Message passing on one level (fig. 5; paper's steps 2, 4, 6, 8, 10). Each of `steps` has its own parameters."""

    def __init__(self, steps: int, width: int) -> None:
        super().__init__()
        self.edge = nn.ModuleList(MLP((width, width, 3 if m == 0 else width), width, width) for m in range(steps))
        self.cell = nn.ModuleList(MLP((width, width), width, width) for _ in range(steps))

    def forward(self, cell_CW: torch.Tensor, level: Level) -> torch.Tensor:
        """Returns the updated cell features [C, W]."""
        edge_EW: torch.Tensor | None = None
        # Receiver minus sender in cells. DIRECTION_63 points from receiver to sender, hence the sign.
        offset_63 = -DIRECTION_63.to(cell_CW)
        for edge_network, cell_network in zip(self.edge, self.cell, strict=True):
            assert isinstance(edge_network, MLP) and isinstance(cell_network, MLP)
            sender_CH = edge_network.project(0, cell_CW)
            receiver_CH = edge_network.project(1, cell_CW) + edge_network.first.bias
            hidden_EH = sender_CH.index_select(0, level.sender_E).add_(receiver_CH.index_select(0, level.receiver_E))
            if edge_EW is None:
                hidden_EH += edge_network.project(2, offset_63).index_select(0, level.direction_E)
                edge_EW = edge_network.finish(hidden_EH)
            else:
                edge_network.add_projection(hidden_EH, 2, edge_EW)
                edge_EW = edge_network.finish(hidden_EH).add_(edge_EW)
            sum_CW = _scatter(edge_EW, level.receiver_E, level.cell_count)
            hidden_CH = cell_network.project(0, cell_CW) + cell_network.first.bias
            cell_network.add_projection(hidden_CH, 1, sum_CW)
            cell_CW = cell_network.finish(hidden_CH).add_(cell_CW)
        return cell_CW


class HierarchicalGraphNetwork(ParticleNetwork):
    """Predicts the acceleration of every particle, in frame units.

    With `obstacle_features=False` the input has no normals, as in the paper's data set without obstacles. With absolute
    inputs, a batch without any obstacle skips the product with the normals. This is exact, as all normals are zero.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        width = config.width
        self.particle_to_cell = MLP((width, 3), width, width)
        self.passing_down = nn.ModuleList(
            MessagePassing(config.message_passing_steps, width) for _ in range(config.levels)
        )
        self.fine_to_coarse = nn.ModuleList(MLP((width, 3), width, width) for _ in range(config.levels - 1))
        self.coarse_to_fine = nn.ModuleList(MLP((width, width, 3), width, width) for _ in range(config.levels - 1))
        self.passing_up = nn.ModuleList(
            MessagePassing(config.message_passing_steps, width) for _ in range(config.levels - 1)
        )
        self.cell_to_particle = MLP((width, width, 3), width, width)
        self.decode = MLP((width,), width, OUTPUTS if config.relative else 3, layer_norm=False)

    def normalised_acceleration(self, state: ParticleState, origin_S3: torch.Tensor | None = None) -> torch.Tensor:
        """Returns the network's raw output [N, 3], which the loss compares with the normalised target.

        `origin_S3` is the finest grid's origin in each scene, by default that of the scene's frame.
        """
        return self.prediction(state, origin_S3).acceleration_N3

    def prediction(self, state: ParticleState, origin_S3: torch.Tensor | None = None) -> Prediction:
        return self.predicted(state, origin_S3, self.propagate)

    def predicted(
        self,
        state: ParticleState,
        origin_S3: torch.Tensor | None,
        propagate: Callable[[torch.Tensor, GridHierarchy], torch.Tensor],
    ) -> Prediction:
        """Returns the prediction: without `origin_S3` in the image of the frame. `propagate` computes steps 1 to 12."""
        if origin_S3 is None and self.images:
            image = Image.of(state, self.step, self.config.dimensions)
            shown = self.predicted(image.shown(state), self.origin(state), propagate)
            return Prediction(image.sign_S3[state.scene_N] * shown.acceleration_N3, shown.contacts, shown.grid)
        grid = self.grid(state, origin_S3)
        if not self.config.relative:
            return Prediction(propagate(self.encode_particles(state, grid), grid), grid=grid)
        feature_NF, contacts = self.relative_features(state, grid)
        output_N9 = propagate(self.encode_features(feature_NF, state, contacts), grid)
        return Prediction(balanced(output_N9, contacts, grid), contacts, grid)

    @property
    def origin_range(self) -> float:
        """Returns the range of the grid origins of simulations (hgn.network.origins). It is 0 with the rest constraint:
        if its cells move, `mechanics` no longer passes rest over 3,000 frames (sand ends 1.5 times as dense)."""
        return 0.0 if self.step.rests else self.config.cell_size

    @property
    def images(self) -> bool:
        """Returns whether simulations predict their frames in images (hgn.network.images)."""
        return self.config.relative and not self.step.rests

    def origin(self, state: ParticleState) -> torch.Tensor:
        """Returns the origins of the grids of scenes at their frames, [S, 3]."""
        return frame_origin(state.frame_S, self.origin_range, self.config.dimensions).to(state.domain_S3)

    def grid(self, state: ParticleState, origin_S3: torch.Tensor | None = None) -> GridHierarchy:
        """Returns the cells of all levels around a state's particles."""
        cell_size, levels, bodies = self.config.cell_size, self.config.levels, self.config.body_cells
        origin_S3 = self.origin(state) if origin_S3 is None else origin_S3
        return build_hierarchy(state.position_N3, state.scene_N, origin_S3, cell_size, levels, bodies)

    def propagate(self, particle_NW: torch.Tensor, grid: GridHierarchy) -> torch.Tensor:
        """Returns the decoder's output for latent particles (steps 1 to 12).

        Normalised accelerations [N, 3]; with relative inputs the values [N, 9] that `relative.balanced` takes.
        """
        corner_83 = CORNER_83.to(particle_NW)
        # Offset from a fine cell in octant o to its parent's centre, in fine cells: 1/2 - o.
        parent_offset_83 = 0.5 - corner_83

        network = self.particle_to_cell
        corner_8H = network.project(1, corner_83) + network.first.bias
        hidden_NH = network.project(0, particle_NW)
        network.add_projection(hidden_NH, 1, -grid.fraction_N3)
        message_N8W = network.finish(hidden_NH[:, None] + corner_8H).mul_(grid.groups.weight_N8[..., None])
        cell_CW = _scatter(message_N8W, grid.cells, grid.levels[0].cell_count)

        cells_down: list[torch.Tensor] = []
        for i, level in enumerate(grid.levels):
            cell_CW = self.passing_down[i](cell_CW, level)
            if level.parent_C is None or level.octant_C is None:
                break
            cells_down.append(cell_CW)
            network = _mlp(self.fine_to_coarse[i])
            offset_8H = network.project(1, parent_offset_83) + network.first.bias
            message_CW = network.finish(network.project(0, cell_CW).add_(offset_8H.index_select(0, level.octant_C)))
            cell_CW = _scatter(message_CW, level.parent_C, grid.levels[i + 1].cell_count)

        for i in reversed(range(len(cells_down))):
            level = grid.levels[i]
            assert level.parent_C is not None and level.octant_C is not None
            network = _mlp(self.coarse_to_fine[i])
            offset_8H = network.project(2, -parent_offset_83) + network.first.bias
            hidden_CH = network.project(0, cell_CW).index_select(0, level.parent_C)
            network.add_projection(hidden_CH, 1, cells_down[i])
            hidden_CH += offset_8H.index_select(0, level.octant_C)
            cell_CW = self.passing_up[i](network.finish(hidden_CH).add_(cells_down[i]), level)

        network = self.cell_to_particle
        cell_CH = network.project(0, cell_CW)
        corner_8H = network.project(2, corner_83) - network.first.bias
        hidden_NH = network.project(1, particle_NW)
        network.add_projection(hidden_NH, 2, grid.fraction_N3)
        cell_N8H = cell_CH.index_select(0, grid.cells.flatten()).unflatten(0, (-1, 8))
        hidden_N8H = cell_N8H + hidden_NH[:, None]
        hidden_N8H -= corner_8H
        change_NW = network.finish(hidden_N8H).mul_(grid.groups.weight_N8[..., None]).sum(1)
        output: torch.Tensor = self.decode(particle_NW + change_NW)
        return output


def _scatter(value: torch.Tensor, index: torch.Tensor, count: int) -> torch.Tensor:
    """Sums rows [..., W] by index [...] into [count, W]."""
    width = value.shape[-1]
    return value.new_zeros(count, width).index_add_(0, index.flatten(), value.reshape(-1, width))


def _mlp(module: nn.Module) -> MLP:
    assert isinstance(module, MLP)
    return module
