"""GNS's training updates on the device: neighbours, forward, backward and optimiser in one CUDA graph for an update.

Batch, loss, optimiser and bookkeeping are those of hgn.kernels.update. Between them PyTorch's autograd runs the network
with the fused edges on lists of fixed capacity, so that all of it can be captured.
Shape legend: N particles, W width, F columns of features.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from functools import cached_property

import torch
import triton
from torch.nn import functional
from torch.nn.utils import vector_to_parameters

from hgn.kernels.forward import feature_columns
from hgn.kernels.gns.op import FusedEdges
from hgn.kernels.grid.kernel import prepare_features
from hgn.kernels.grid.op import OUT_OF_WINDOW, PARTICLE_BLOCK, feature_arguments
from hgn.kernels.neighbours.op import DeviceNeighbours
from hgn.kernels.update.op import TAIL, Layout, Tables, TrainedNetwork, Updates
from hgn.network.cell_keys import COORDINATE_LIMIT
from hgn.network.features import WALL_DISTANCE_CELLS, ParticleState
from hgn.network.gns import GraphNetworkSimulator
from hgn.network.gns_edges import PlainEdges
from hgn.schema import ConfigError

OUT = 4  # the decoder's three outputs, padded


@dataclass(frozen=True)
class FlatLayout:
    """The parameters one after the other, as they are."""

    size: int

    @cached_property
    def index(self) -> torch.Tensor:
        return torch.arange(self.size)

    def gather(self, tensors: list[torch.Tensor]) -> torch.Tensor:
        return torch.cat([tensor.detach().reshape(-1).float() for tensor in tensors])

    def scatter(self, packed: torch.Tensor, tensors: list[torch.Tensor]) -> None:
        with torch.no_grad():
            for tensor, part in zip(tensors, packed.split([t.numel() for t in tensors]), strict=True):
                tensor.copy_(part.view(tensor.shape))


def views_of(network: GraphNetworkSimulator, values: torch.Tensor) -> GraphNetworkSimulator:
    """A network whose parameters are pieces of `values`, laid out one after the other."""
    result = copy.deepcopy(network)
    vector_to_parameters(values, result.parameters())
    return result


class FusedGns:
    """Forward and backward passes of a network on a neighbour list of fixed capacity."""

    copy_precision = "fp32"  # products read the values themselves
    unscale = 1.0  # gradients are scaled on the way, see hgn.network.gns_edges

    def __init__(
        self,
        network: GraphNetworkSimulator,
        values: torch.Tensor,
        tables: DeviceNeighbours,
        feature_NF: torch.Tensor,
        particle_count: torch.Tensor,
        precision: str,
        tail: int = 0,
    ) -> None:
        """`values` are the network's parameters, and `feature_NF` rows of particles in the batch's order."""
        self.network = views_of(network, values)
        self.edges = FusedEdges.in_tf32() if precision == "tf32" else FusedEdges(precision)
        self.parameters = list(self.network.parameters())
        self.weights, self.tables, self.feature_NF, self.particle_count = values, tables, feature_NF, particle_count
        self.output = torch.zeros(tables.particles, OUT, device=values.device)
        self.output_gradient = torch.zeros_like(self.output)
        self.totals = torch.zeros(len(values) + tail, device=values.device)
        self._place_N = torch.arange(tables.particles, device=values.device)
        self._decoded_N3: torch.Tensor | None = None
        if (
            values.is_cuda
        ):  # autograd's thread has no CUDA context before it launches something, and cuBLAS would say so
            with torch.enable_grad():
                (values[:1].clone().requires_grad_() * 2).sum().backward()

    def forward(self) -> None:
        """The output of every particle, [N, 3] of `output`."""
        self._decoded_N3 = None
        tables, order_N = self.tables, self.tables.neighbours.order_N
        # rows without a particle come last in the order; what is in them is left by other updates
        feature_NF = torch.where(self._live(), self.feature_NF[order_N], 0.0)
        position_N3 = torch.where(self._live(), tables.position_N3, 0.0)
        with torch.enable_grad():
            node_NW = self._encoded(feature_NF)
            self._decoded_N3 = self.network.decoded(node_NW, position_N3, tables.neighbours, self.edges)
        self.output[:, :3].index_copy_(0, order_N, self._decoded_N3.detach())

    def backward(self) -> None:
        """From `output_gradient` to `totals`."""
        assert self._decoded_N3 is not None
        gradient_N3 = self.output_gradient[self.tables.neighbours.order_N, :3]
        gradient_N3 = torch.where(self._live(), gradient_N3, 0.0)
        gradients = torch.autograd.grad(self._decoded_N3, self.parameters, gradient_N3, allow_unused=True)
        self._decoded_N3 = None
        flat = [
            (torch.zeros_like(parameter) if gradient is None else gradient).reshape(-1)
            for parameter, gradient in zip(self.parameters, gradients, strict=True)
        ]
        torch.cat(flat, out=self.totals[: len(self.weights)])

    def refresh(self) -> None:
        """The network's parameters are the values."""

    def refresh_encoder(self) -> None:
        """There is no copy of it."""

    def _live(self) -> torch.Tensor:
        """Whether there is a particle in each row of the order."""
        return (self._place_N < self.particle_count)[:, None]

    def _encoded(self, feature_NF: torch.Tensor) -> torch.Tensor:
        """The particles' first state [N, W], from one product: what a material adds is a column of it."""
        network, encode = self.network, self.network.encode
        first, material = encode.first.weight.split([sum(encode.parts[:3]), encode.parts[3]], dim=1)
        combined = torch.cat([first, material @ network.embedding.weight.T], dim=1)
        return encode.finish(functional.linear(feature_NF[:, : combined.shape[1]], combined, encode.first.bias))


class GnsUpdates(Updates):
    """The updates of a GNS whose obstacles are features; `capacities` is that of edges."""

    growth = 1.5  # neighbours differ more from frame to frame than cells do, and room for them costs memory alone
    checked_particles = 40_000
    network: GraphNetworkSimulator

    def reference_output(self, state: ParticleState, origin_S3: torch.Tensor) -> torch.Tensor:
        # In blocks of edges: autograd keeps ten times as much.
        return self.network.normalised_acceleration(state, origin_S3, PlainEdges())

    def _layout(self) -> Layout:
        assert not self.config.obstacle_particles and self.config.maximum_neighbours is None
        return FlatLayout(sum(parameter.numel() for parameter in self.network.parameters()))

    def _device_grid(self, capacities: tuple[int, ...]) -> Tables:
        (edges,) = capacities
        return DeviceNeighbours(self.particles, edges, self.config.cell_size, self.device)

    def _fused_network(self) -> TrainedNetwork:
        assert isinstance(self.grid, DeviceNeighbours)
        self.feature_NF = torch.zeros(self.particles, feature_columns(self.config), device=self.device)
        return FusedGns(
            self.network, self.values, self.grid, self.feature_NF, self.particle_count, self.precision, tail=TAIL
        )

    def _grid(self) -> None:
        config = self.config
        self.grid.build(self.position_N3, self.scene_N, self.origin_S3, self.particle_count)
        prepare_features[(triton.cdiv(self.particles, PARTICLE_BLOCK),)](
            **feature_arguments(
                config,
                self.position_N3,
                self.velocity_NV,
                self.scene_N,
                self.material_N,
                self.domain_S3,
                self.particle_count,
                self.obstacles,
                self.settings.symmetry,
                self.feature_NF,
            ),
            mean=self.velocity_mean,
            std=self.velocity_std,
            wall_maximum=WALL_DISTANCE_CELLS * config.cell_size,
        )

    def _make_room(self, status: int, needed: list[int]) -> None:
        if status & OUT_OF_WINDOW and bool(self.position_N3[: int(self.particle_count)].isfinite().all()):
            limit = 0.5 * self.config.cell_size * (COORDINATE_LIMIT - 4)
            raise ConfigError(f"positions of the training episodes must be within {limit:.0f} domain units")
        super()._make_room(status, needed)
