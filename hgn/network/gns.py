"""The graph network simulator that the paper compares with: message passing between neighbouring particles.

Sanchez-Gonzalez et al. 2020 (GNS), with the paper's choices (sec. 4): connectivity radius R, wall distances clamped
at 8 R, 10 message-passing steps, one hidden layer in every MLP. Each particle is its own neighbour too, as in GNS.
Obstacles are either normal features, as in the HGN, or static particles on the obstacles' surfaces.
The first layers are split over their concatenated inputs, so that a particle's part is multiplied once, not once an
edge: exactly the same function.
Shape legend: N particles, P static particles, E directed edges, W width, H hidden.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import nn

from hgn.config import NetworkConfig
from hgn.network.base import ParticleNetwork
from hgn.network.features import ParticleState
from hgn.network.gns_edges import Edges, Ends, Graph, Weights, encoded_edges, passed_messages, scaling_gradients
from hgn.network.mlp import MLP, linear
from hgn.network.neighbours import NeighbourList, neighbour_list

RELU = 0.0  # slope below zero
# Rows of edges worked on at once where no gradient is wanted: 0.5 GB for each intermediate result of width 128.
EDGES_AT_ONCE = 1 << 20


class InteractionStep(nn.Module):
    """One message-passing step: edges from both ends, particles from their edges' sum, residuals on both."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.edge = MLP((width, width, width), width, width, slope=RELU)  # sender, receiver, edge
        self.node = MLP((width, width), width, width, slope=RELU)  # particle, sum of the edges' updates

    def update(self, node_NW: torch.Tensor, sum_NW: torch.Tensor) -> torch.Tensor:
        """The particles' new state [N, W]."""
        own, total = self.node.first.weight.split(self.node.parts, dim=1)
        hidden_NH = linear(node_NW, own, self.node.first.bias) + linear(sum_NW, total)
        return node_NW + self.node.finish(hidden_NH)


class GraphNetworkSimulator(ParticleNetwork):
    """Predicts the acceleration of every particle, in frame units."""

    def __init__(self, config: NetworkConfig) -> None:
        # One kind more, where there are static particles.
        super().__init__(config, len(config.materials) + config.obstacle_particles, RELU)
        width = config.width
        self.encode_edges = MLP((3, 1), width, width, slope=RELU)
        self.steps = nn.ModuleList(InteractionStep(width) for _ in range(config.message_passing_steps))
        self.decode = MLP((width,), width, 3, layer_norm=False, slope=RELU)

    def normalised_acceleration(
        self, state: ParticleState, origin_S3: torch.Tensor | None = None, edges: Edges | None = None
    ) -> torch.Tensor:
        """The network's raw output [N, 3] of the moving particles. There is no grid for `origin_S3` to move.

        `edges` works on the edges, as a backend chooses it; none: PyTorch and its own gradients.
        Raises: GridRangeError when a particle is not finite or too far from the origin.
        """
        moving = len(state.position_N3)
        state = self.with_static_particles(state)
        neighbours = self.neighbours(state)
        return self.propagate(state, neighbours, edges)[:moving]

    def predict(self, state: ParticleState, edges: Edges | None) -> torch.Tensor:
        """Accelerations [N, 3] in frame units, with `edges` at work."""
        return self.normaliser.restore_acceleration(self.normalised_acceleration(state, edges=edges))

    def neighbours(self, state: ParticleState) -> NeighbourList:
        """The graph of a state that holds its static particles."""
        return neighbour_list(
            state.position_N3.detach(), state.scene_N, self.config.cell_size, self.config.maximum_neighbours
        )

    def with_static_particles(self, state: ParticleState) -> ParticleState:
        """The state with its static particles behind the moving ones: at rest, of a kind of their own.

        Only those that messages can reach the moving particles from (paper sec. 4): exactly the same result.
        """
        if not self.config.obstacle_particles or state.surface is None:
            return state
        reach = self.config.message_passing_steps * self.config.cell_size
        surface = state.surface.within(reach, state.position_N3, state.scene_N)
        position_P3 = surface.position_P3.to(state.position_N3.dtype)
        still_PM3 = state.velocity_NM3.new_zeros(len(position_P3), *state.velocity_NM3.shape[1:])
        kind_P = torch.full_like(surface.scene_P, len(self.config.materials))
        return replace(
            state,
            position_N3=torch.cat([state.position_N3, position_P3]),
            velocity_NM3=torch.cat([state.velocity_NM3, still_PM3]),
            material_N=torch.cat([state.material_N, kind_P]),
            scene_N=torch.cat([state.scene_N, surface.scene_P]),
            surface=None,
        )

    def propagate(self, state: ParticleState, neighbours: NeighbourList, edges: Edges | None = None) -> torch.Tensor:
        """The raw output [N, 3] of a state and its graph."""
        order_N = neighbours.order_N
        # a gather of what has gradients would have to be summed backward
        state = replace(
            state,
            position_N3=state.position_N3[order_N],
            velocity_NM3=state.velocity_NM3[order_N],
            material_N=state.material_N[order_N],
            scene_N=state.scene_N[order_N],
        )
        decoded_N3 = self.decoded(self.encode_particles(state), state.position_N3, neighbours, edges)
        return torch.empty_like(decoded_N3).index_copy(0, order_N, decoded_N3)

    def decoded(
        self, node_NW: torch.Tensor, position_N3: torch.Tensor, neighbours: NeighbourList, edges: Edges | None = None
    ) -> torch.Tensor:
        """The raw output [N, 3] of encoded particles, all in the list's order."""
        if edges is not None:
            node_NW = self._steps_of_edges(edges, node_NW, position_N3, neighbours)
        elif torch.is_grad_enabled():
            node_NW = self._steps(node_NW, position_N3, neighbours)
        else:
            node_NW = self._steps_in_blocks(node_NW, position_N3, neighbours)
        result: torch.Tensor = self.decode(node_NW)
        return result

    def _edges(self, position_N3: torch.Tensor, sender_E: torch.Tensor, receiver_E: torch.Tensor) -> torch.Tensor:
        """Latent edges [E, W] from sender minus receiver and their distance, in radii."""
        offset_E3 = position_N3.index_select(0, sender_E) - position_N3.index_select(0, receiver_E)
        offset_E3 = offset_E3 / self.config.cell_size
        return self.encode_edges(torch.cat([offset_E3, offset_E3.norm(dim=-1, keepdim=True)], dim=-1))

    def _steps(self, node_NW: torch.Tensor, position_N3: torch.Tensor, neighbours: NeighbourList) -> torch.Tensor:
        sender_E, receivers = neighbours.sender_E, neighbours.receivers
        edge_EW = self._edges(position_N3, sender_E, receivers.segment_E)
        for i, step in enumerate(self.steps):
            assert isinstance(step, InteractionStep)
            sender_EH = step.edge.project(0, node_NW).index_select(0, sender_E)
            receiver_EH = receivers.spread(step.edge.project(1, node_NW) + step.edge.first.bias)
            message_EW = step.edge.finish(step.edge.project(2, edge_EW) + sender_EH + receiver_EH)
            node_NW = step.update(node_NW, receivers.sum(message_EW))
            if i + 1 < len(self.steps):
                edge_EW = edge_EW + message_EW
        return node_NW

    def _steps_of_edges(
        self, edges: Edges, node_NW: torch.Tensor, position_N3: torch.Tensor, neighbours: NeighbourList
    ) -> torch.Tensor:
        """The same with `edges` at work."""
        graph = Graph(neighbours, position_N3 / self.config.cell_size)
        edge_EW = encoded_edges(edges, graph, self.encode_edges)
        for i, step in enumerate(self.steps):
            assert isinstance(step, InteractionStep)
            send, receive, own = step.edge.first.weight.split(step.edge.parts, dim=1)
            ends = Ends(linear(node_NW, send), linear(node_NW, receive, step.edge.first.bias))
            weights = Weights.of(step.edge, own)
            sum_NW, edge_EW = passed_messages(edges, graph, ends, weights, edge_EW, i + 1 == len(self.steps))
            node_NW = step.update(node_NW, sum_NW)
        return scaling_gradients(graph, node_NW)

    def _steps_in_blocks(
        self, node_NW: torch.Tensor, position_N3: torch.Tensor, neighbours: NeighbourList
    ) -> torch.Tensor:
        """The same without gradients: of everything but the edges' state only a block exists at a time."""
        sender_E, receivers = neighbours.sender_E, neighbours.receivers
        blocks = receivers.blocks(EDGES_AT_ONCE)
        edges = [self._edges(position_N3, sender_E[block.rows], receivers.segment_E[block.rows]) for block in blocks]
        for i, step in enumerate(self.steps):
            assert isinstance(step, InteractionStep)
            sender_NH = step.edge.project(0, node_NW)
            receiver_NH = step.edge.project(1, node_NW) + step.edge.first.bias
            sum_NW = torch.empty_like(node_NW)
            for block, edge_EW in zip(blocks, edges, strict=True):
                hidden_EH = step.edge.project(2, edge_EW)
                hidden_EH.add_(sender_NH.index_select(0, sender_E[block.rows]))
                hidden_EH.add_(block.part.spread(receiver_NH[block.segments]))
                message_EW = step.edge.finish(hidden_EH)
                sum_NW[block.segments] = block.part.sum(message_EW)
                if i + 1 < len(self.steps):
                    edge_EW.add_(message_EW)
            node_NW = step.update(node_NW, sum_NW)
        return node_NW
