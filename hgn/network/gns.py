"""The graph network simulator that the paper compares with: message passing between neighbouring particles.

Sanchez-Gonzalez et al. 2020 (GNS), with the paper's choices (sec. 4): connectivity radius R, wall distances clamped
at 8 R, 10 message-passing steps, one hidden layer in every MLP. As in GNS each particle is also its own neighbour.
Obstacles are given by normals in the features, as in the HGN. First layers are split over their concatenated inputs.
So a particle's part is multiplied once instead of once for each edge. The function is the same.
Shape legend: N particles, E directed edges, W width, H hidden.
"""

import torch
from torch import nn

from hgn.config import NetworkConfig
from hgn.network.base import ParticleNetwork
from hgn.network.features import ParticleState
from hgn.network.mlp import MLP, linear
from hgn.network.neighbours import NeighbourList, neighbour_list

RELU = 0.0  # slope below zero


class InteractionStep(nn.Module):
    """One message-passing step, with residuals: edges from both ends, then particles from the sum of their edges."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.edge = MLP((width, width, width), width, width, slope=RELU)  # sender, receiver, edge
        self.node = MLP((width, width), width, width, slope=RELU)  # particle, sum of the edges' updates

    def update(self, node_NW: torch.Tensor, sum_NW: torch.Tensor) -> torch.Tensor:
        """Returns the particles' new state [N, W]."""
        own, total = self.node.first.weight.split(self.node.parts, dim=1)
        hidden_NH = linear(node_NW, own, self.node.first.bias) + linear(sum_NW, total)
        return node_NW + self.node.finish(hidden_NH)


class GraphNetworkSimulator(ParticleNetwork):
    """Predicts the acceleration of every particle, in frame units."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config, RELU)
        width = config.width
        self.encode_edges = MLP((3, 1), width, width, slope=RELU)
        self.steps = nn.ModuleList(InteractionStep(width) for _ in range(config.message_passing_steps))
        self.decode = MLP((width,), width, 3, layer_norm=False, slope=RELU)

    def normalised_acceleration(self, state: ParticleState, origin_S3: torch.Tensor | None = None) -> torch.Tensor:
        """Returns the raw output [N, 3]. `origin_S3` has no effect, because GNS has no grid.

        Raises: GridRangeError when a particle is not finite or too far from the origin.
        """
        return self.propagate(state, self.neighbours(state))

    def neighbours(self, state: ParticleState) -> NeighbourList:
        """Returns all pairs of particles of a scene that are closer than R."""
        return neighbour_list(state.position_N3.detach(), state.scene_N, self.config.cell_size)

    def propagate(self, state: ParticleState, neighbours: NeighbourList) -> torch.Tensor:
        """Returns the raw output [N, 3] for a state and its neighbour list."""
        order_N, sender_E, receivers = neighbours.order_N, neighbours.sender_E, neighbours.receivers
        # Inputs are reordered: a gather of latent states would need a sum over rows in the backward pass.
        state = state.selected(order_N)
        node_NW = self.encode_particles(state)
        edge_EW = self._edges(state.position_N3, sender_E, receivers.segment_E)
        for i, step in enumerate(self.steps):
            assert isinstance(step, InteractionStep)
            sender_EH = step.edge.project(0, node_NW).index_select(0, sender_E)
            receiver_EH = receivers.spread(step.edge.project(1, node_NW) + step.edge.first.bias)
            message_EW = step.edge.finish(step.edge.project(2, edge_EW) + sender_EH + receiver_EH)
            node_NW = step.update(node_NW, receivers.sum(message_EW))
            if i + 1 < len(self.steps):
                edge_EW = edge_EW + message_EW
        decoded_N3 = self.decode(node_NW)
        return torch.empty_like(decoded_N3).index_copy(0, order_N, decoded_N3)

    def _edges(self, position_N3: torch.Tensor, sender_E: torch.Tensor, receiver_E: torch.Tensor) -> torch.Tensor:
        """Returns latent edges [E, W] from the offset (sender minus receiver) and its length, both in radii."""
        offset_E3 = position_N3.index_select(0, sender_E) - position_N3.index_select(0, receiver_E)
        offset_E3 = offset_E3 / self.config.cell_size
        return self.encode_edges(torch.cat([offset_E3, offset_E3.norm(dim=-1, keepdim=True)], dim=-1))
