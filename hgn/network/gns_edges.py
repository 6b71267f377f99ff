"""GNS's message passing along edges with gradients of its own, which keep no more than each step's incoming edges.

Plain autograd keeps every intermediate result of every edge and passes over it several times. Here the hidden layer and
the norm are computed again backward. What stays of an edge, its latent state and that state's gradient, may be held in
float16; sums over edges, the norm's statistics and everything of particles stay in the particles' type.
`Edges` says what is to be computed; `PlainEdges` computes it in blocks of edges in PyTorch and is the reference of
hgn.kernels.gns.
Shape legend: N particles, E directed edges, W width (the hidden layer's too).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import torch
from torch.nn import functional

from hgn.network.mlp import MLP
from hgn.network.neighbours import NeighbourList

EPSILON = 1e-5  # torch.nn.LayerNorm's
# Rows of edges at once. On a CPU intermediate results stay in its caches, on a GPU blocks keep it busy.
CPU_ROWS, GPU_ROWS = 1 << 12, 1 << 18
# What the largest gradient of a particle's last state is scaled to, for float16: 2^10 below its largest number, for
# sums along the way back, and 2^20 above its smallest normal one.
SCALED_MAXIMUM = 64.0


class Weights(NamedTuple):
    """Of a step's edge network: the first layer's part for the edge, the second layer, the norm."""

    own: torch.Tensor  # [W, W]; of the encoder [W, 4], of offset and distance
    second: torch.Tensor  # [W, W]
    bias: torch.Tensor  # [W]
    gain: torch.Tensor
    shift: torch.Tensor

    @staticmethod
    def of(network: MLP, own: torch.Tensor) -> Weights:
        assert network.norm is not None
        return Weights(own, network.second.weight, network.second.bias, network.norm.weight, network.norm.bias)


class Ends(NamedTuple):
    """The first layer's products with both ends of an edge, its bias in one of them: what particles give a step."""

    send_NW: torch.Tensor
    receive_NW: torch.Tensor


@dataclass(eq=False)
class Graph:
    """A neighbour list, where the positions are for the encoder, and what gradients are multiplied by."""

    neighbours: NeighbourList
    position_N3: torch.Tensor  # in radii, in the list's order
    # on the device, a power of two; known as soon as gradients reach the particles' last state
    scale: torch.Tensor = field(init=False)

    @cached_property
    def by_sender(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The edges in the order of their senders [E], and where each sender's begin [N + 1]."""
        sender_E, order_E = torch.sort(self.neighbours.sender_E, stable=True)
        count = torch.arange(len(self.position_N3) + 1, device=sender_E.device)
        return order_E, torch.searchsorted(sender_E, count)


class Edges(ABC):
    """The work on edges. Gradients of edges, which may be float16, are multiplied by the graph's scale, others not."""

    @abstractmethod
    def encode(self, graph: Graph, first_bias_W: torch.Tensor, weights: Weights) -> torch.Tensor:
        """Latent edges [E, W] from sender minus receiver and their distance, in radii."""

    @abstractmethod
    def encode_backward(
        self, graph: Graph, first_bias_W: torch.Tensor, weights: Weights, gradient_EW: torch.Tensor
    ) -> tuple[torch.Tensor, Weights]:
        """Gradients of first_bias_W and of the weights."""

    @abstractmethod
    def step(
        self, graph: Graph, ends: Ends, weights: Weights, edge_EW: torch.Tensor, last: bool, in_place: bool
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Each receiver's sum of messages [N, W], and the edges with their messages added unless `last`."""

    @abstractmethod
    def step_backward(
        self,
        graph: Graph,
        ends: Ends,
        weights: Weights,
        edge_EW: torch.Tensor,
        sum_gradient_NW: torch.Tensor,
        gradient_EW: torch.Tensor | None,
    ) -> tuple[Ends, Weights, torch.Tensor]:
        """Gradients of the ends, the weights and edge_EW; gradient_EW is that of the edges that left, if they did."""


@dataclass(frozen=True)
class PlainEdges(Edges):
    """In PyTorch, on any device. `dtype` is what edges are stored and multiplied in; none: the particles' type.

    Every row of edges must belong to a receiver: no room to spare.
    """

    dtype: torch.dtype | None = None

    def encode(self, graph: Graph, first_bias_W: torch.Tensor, weights: Weights) -> torch.Tensor:
        sender_E, receivers = graph.neighbours.sender_E, graph.neighbours.receivers
        own, second = weights.own, self._rounded(weights.second)
        dtype = self.dtype or second.dtype
        edge_EW = torch.empty(len(sender_E), len(second), dtype=dtype, device=second.device)
        for first, last in self._blocks(len(sender_E), second.device):
            offset_E4 = _offsets(graph.position_N3, sender_E[first:last], receivers.segment_E[first:last])
            a = self._rounded(torch.addmm(first_bias_W, offset_E4, own.T).relu_())
            z = torch.addmm(weights.bias, a, second.T)
            edge_EW[first:last] = functional.layer_norm(z, z.shape[1:], weights.gain, weights.shift, EPSILON)
        return edge_EW

    def encode_backward(
        self, graph: Graph, first_bias_W: torch.Tensor, weights: Weights, gradient_EW: torch.Tensor
    ) -> tuple[torch.Tensor, Weights]:
        sender_E, receivers = graph.neighbours.sender_E, graph.neighbours.receivers
        second = self._rounded(weights.second)
        sums, bias_W = _zeros(weights), torch.zeros_like(first_bias_W)
        for first, last in self._blocks(len(sender_E), second.device):
            offset_E4 = _offsets(graph.position_N3, sender_E[first:last], receivers.segment_E[first:last])
            a = self._rounded(torch.addmm(first_bias_W, offset_E4, weights.own.T).relu_())
            dm = gradient_EW[first:last].to(second.dtype)
            dh = self._hidden_gradient(weights, second, a, dm, sums)
            sums.own.addmm_(dh.T, offset_E4)
            bias_W += dh.sum(0)
        return bias_W / graph.scale, Weights(*(total / graph.scale for total in sums))

    def step(
        self, graph: Graph, ends: Ends, weights: Weights, edge_EW: torch.Tensor, last: bool, in_place: bool
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        own, second, send_NW = (self._rounded(x) for x in (weights.own, weights.second, ends.send_NW))
        sum_NW = torch.zeros_like(ends.receive_NW)
        out_EW = None if last else edge_EW if in_place else torch.empty_like(edge_EW)
        for first, end in self._blocks(len(edge_EW), edge_EW.device):
            receiver = graph.neighbours.receivers.segment_E[first:end]
            edge = edge_EW[first:end].to(own.dtype)
            a = self._rounded(self._hidden(graph, Ends(send_NW, ends.receive_NW), own, edge, first, end).relu_())
            z = torch.addmm(weights.bias, a, second.T)
            message = functional.layer_norm(z, z.shape[1:], weights.gain, weights.shift, EPSILON)
            sum_NW.index_add_(0, receiver, message)
            if out_EW is not None:
                out_EW[first:end] = edge + message
        return sum_NW, out_EW

    def step_backward(
        self,
        graph: Graph,
        ends: Ends,
        weights: Weights,
        edge_EW: torch.Tensor,
        sum_gradient_NW: torch.Tensor,
        gradient_EW: torch.Tensor | None,
    ) -> tuple[Ends, Weights, torch.Tensor]:
        sender_E, receivers = graph.neighbours.sender_E, graph.neighbours.receivers
        own, second, send_NW = (self._rounded(x) for x in (weights.own, weights.second, ends.send_NW))
        sums, end_sums = _zeros(weights), Ends(torch.zeros_like(send_NW), torch.zeros_like(ends.receive_NW))
        sum_gradient_NW = sum_gradient_NW * graph.scale
        result_EW = torch.empty_like(edge_EW)
        for first, end in self._blocks(len(edge_EW), edge_EW.device):
            sender, receiver = sender_E[first:end], receivers.segment_E[first:end]
            edge = edge_EW[first:end].to(own.dtype)
            a = self._rounded(self._hidden(graph, Ends(send_NW, ends.receive_NW), own, edge, first, end).relu_())
            dm = sum_gradient_NW.index_select(0, receiver)
            if gradient_EW is not None:
                dm += gradient_EW[first:end]
            dh = self._hidden_gradient(weights, second, a, dm, sums)
            end_sums.receive_NW.index_add_(0, receiver, dh)
            end_sums.send_NW.index_add_(0, sender, dh)
            dh = self._rounded(dh)
            sums.own.addmm_(dh.T, edge)
            de = dh @ own
            result_EW[first:end] = de if gradient_EW is None else de.add_(gradient_EW[first:end])
        undone = Weights(*(total / graph.scale for total in sums))
        return Ends(*(total / graph.scale for total in end_sums)), undone, result_EW

    def _hidden(
        self, graph: Graph, ends: Ends, own: torch.Tensor, edge: torch.Tensor, first: int, end: int
    ) -> torch.Tensor:
        """The hidden layer of edges `first` to `end`, before the activation."""
        h = ends.send_NW.index_select(0, graph.neighbours.sender_E[first:end])
        h += ends.receive_NW.index_select(0, graph.neighbours.receivers.segment_E[first:end])
        return h.addmm_(edge, own.T)

    def _hidden_gradient(
        self, weights: Weights, second: torch.Tensor, a: torch.Tensor, dm: torch.Tensor, sums: Weights
    ) -> torch.Tensor:
        """The gradient before the activation from the messages' `dm`; adds those of the layers behind it to `sums`."""
        z = torch.addmm(weights.bias, a, second.T)
        _, mean, scale = torch.native_layer_norm(z, z.shape[1:], weights.gain, weights.shift, EPSILON)
        dz, gain, shift = torch.ops.aten.native_layer_norm_backward(
            dm, z, z.shape[1:], mean, scale, weights.gain, weights.shift, [True, True, True]
        )
        sums.gain.add_(gain)
        sums.shift.add_(shift)
        sums.bias.add_(dz.sum(0))
        dz = self._rounded(dz)
        sums.second.addmm_(dz.T, a)
        return (dz @ second).masked_fill_(a <= 0, 0.0)

    def _rounded(self, value: torch.Tensor) -> torch.Tensor:
        """As the operand of a product: in fp16 its sums are float32 still."""
        return value if self.dtype is None else value.to(self.dtype).to(value.dtype)

    @staticmethod
    def _blocks(count: int, device: torch.device) -> list[tuple[int, int]]:
        rows = CPU_ROWS if device.type == "cpu" else GPU_ROWS
        return [(first, min(count, first + rows)) for first in range(0, count, rows)]


def encoded_edges(edges: Edges, graph: Graph, network: MLP) -> torch.Tensor:
    """Latent edges [E, W], with gradients by the parameters of their encoder."""
    weights = Weights.of(network, network.first.weight)
    result: torch.Tensor = _Encode.apply(edges, graph, network.first.bias, *weights)
    return result


def passed_messages(
    edges: Edges, graph: Graph, ends: Ends, weights: Weights, edge_EW: torch.Tensor, last: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    """Each receiver's sum of messages, and the edges with their messages added (as they were, if `last`)."""
    if torch.is_grad_enabled():
        sum_NW, out_EW = _Step.apply(edges, graph, last, *ends, *weights, edge_EW)
    else:
        sum_NW, out_EW = edges.step(graph, ends, weights, edge_EW, last, in_place=True)
    return sum_NW, edge_EW if out_EW is None else out_EW


def scaling_gradients(graph: Graph, value_NW: torch.Tensor) -> torch.Tensor:
    """`value_NW` itself; its gradient decides the scale of what lies before."""
    result: torch.Tensor = _Scale.apply(graph, value_NW)
    return result


class _Scale(torch.autograd.Function):
    @staticmethod
    def forward(context, graph, value_NW):  # type: ignore[no-untyped-def]
        context.graph = graph
        return value_NW.view_as(value_NW)

    @staticmethod
    def backward(context, gradient_NW):  # type: ignore[no-untyped-def]
        largest = gradient_NW.abs().amax().float()
        scale = torch.exp2(torch.floor(torch.log2(SCALED_MAXIMUM / largest)))
        scale = torch.where((largest > 0) & scale.isfinite(), scale, 1.0)
        context.graph.scale = scale.to(gradient_NW.dtype)
        return None, gradient_NW


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(context, edges, graph, first_bias_W, *weights):  # type: ignore[no-untyped-def]
        context.edges, context.graph = edges, graph
        context.save_for_backward(first_bias_W, *weights)
        return edges.encode(graph, first_bias_W, Weights(*weights))

    @staticmethod
    def backward(context, gradient_EW):  # type: ignore[no-untyped-def]
        first_bias_W, *weights = context.saved_tensors
        bias, gradients = context.edges.encode_backward(context.graph, first_bias_W, Weights(*weights), gradient_EW)
        return None, None, bias, *gradients


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(context, edges, graph, last, *tensors):  # type: ignore[no-untyped-def]
        context.edges, context.graph = edges, graph
        context.save_for_backward(*tensors)
        return edges.step(graph, Ends(*tensors[:2]), Weights(*tensors[2:7]), tensors[7], last, in_place=False)

    @staticmethod
    def backward(context, sum_gradient_NW, gradient_EW):  # type: ignore[no-untyped-def]
        tensors = context.saved_tensors
        ends, weights, edge_EW = context.edges.step_backward(
            context.graph, Ends(*tensors[:2]), Weights(*tensors[2:7]), tensors[7], sum_gradient_NW, gradient_EW
        )
        return None, None, None, *ends, *weights, edge_EW


def _offsets(position_N3: torch.Tensor, sender_E: torch.Tensor, receiver_E: torch.Tensor) -> torch.Tensor:
    """Sender minus receiver and their distance, [E, 4]."""
    offset_E3 = position_N3.index_select(0, sender_E) - position_N3.index_select(0, receiver_E)
    return torch.cat([offset_E3, offset_E3.norm(dim=-1, keepdim=True)], dim=-1)


def _zeros(weights: Weights) -> Weights:
    return Weights(*(torch.zeros_like(weight, memory_format=torch.contiguous_format) for weight in weights))
