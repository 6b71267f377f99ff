"""GNS's work on edges through the fused kernels; the reference is hgn.network.edges.PlainEdges.

Shape legend: N particles, E directed edges, W width, P programs.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
import triton

from hgn.kernels.gns.kernel import (
    encode_backward,
    encode_forward,
    layers_backward,
    norm_backward,
    sender_sums,
    step_forward,
    weight_products,
)
from hgn.network.edges import Edges, Ends, Graph, Weights

SENDER_BLOCK = 16


@dataclass(frozen=True)
class Tuning:
    """Edges and warps of a program, and programs for each multiprocessor. They change how fast, never what."""

    block: int = 64
    warps: int = 4
    programs: int = 2
    backward_block: int = 64
    backward_warps: int = 4
    backward_programs: int = 2
    product_rows: int = 64
    product_warps: int = 8
    product_programs: int = 2


def fits(width: int) -> bool:
    """Whether the kernels can take it: widths of matrix units."""
    return 16 <= width <= 128 and width & (width - 1) == 0


@dataclass(frozen=True)
class FusedEdges(Edges):
    """On a CUDA device (or in Triton's interpreter). `precision` is half, or ieee: float32 edges, for tests."""

    precision: str = "half"
    tuning: Tuning = field(default_factory=Tuning)

    def encode(self, graph: Graph, first_bias_W: torch.Tensor, weights: Weights) -> torch.Tensor:
        edges, width = graph.neighbours.edge_count, len(weights.second)
        edge_EW = torch.empty(edges, width, dtype=self._dtype, device=weights.second.device)
        if edges:
            encode_forward[(triton.cdiv(edges, self.tuning.block),)](
                *self._encoder(graph, first_bias_W, weights),
                weights.gain,
                weights.shift,
                edge_EW,
                WIDTH=width,
                BLOCK=self.tuning.block,
                PRECISION=self.precision,
                num_warps=self.tuning.warps,
            )
        return edge_EW

    def encode_backward(
        self, graph: Graph, first_bias_W: torch.Tensor, weights: Weights, gradient_EW: torch.Tensor
    ) -> tuple[torch.Tensor, Weights]:
        width, tuning = len(weights.second), self.tuning
        activation_EW, second_EW = torch.empty_like(gradient_EW), torch.empty_like(gradient_EW)
        programs = self._programs(tuning.backward_programs, triton.cdiv(len(gradient_EW), tuning.backward_block))
        partial_PCW = weights.second.new_empty(programs, 19, width)
        encode_backward[(programs,)](
            gradient_EW,
            *self._encoder(graph, first_bias_W, weights),
            weights.gain,
            activation_EW,
            second_EW,
            partial_PCW,
            WIDTH=width,
            BLOCK=tuning.backward_block,
            PRECISION=self.precision,
            num_warps=tuning.backward_warps,
        )
        total_CW = partial_PCW.sum(0) / graph.scale
        second_WW = self._weight_product(graph, second_EW, activation_EW)
        found = Weights(total_CW[3:7].T.contiguous(), second_WW, total_CW[2], total_CW[0], total_CW[1])
        return total_CW[7], found

    def step(
        self, graph: Graph, ends: Ends, weights: Weights, edge_EW: torch.Tensor, last: bool, in_place: bool
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        out_EW = None if last else edge_EW if in_place else torch.empty_like(edge_EW)
        sum_NW = torch.empty_like(ends.receive_NW)
        count, width = sum_NW.shape
        step_forward[(self._programs(self.tuning.programs, count),)](
            edge_EW,
            edge_EW if out_EW is None else out_EW,
            *self._step(graph, ends, weights),
            weights.gain,
            weights.shift,
            sum_NW,
            LAST=last,
            WIDTH=width,
            BLOCK=self.tuning.block,
            PRECISION=self.precision,
            num_warps=self.tuning.warps,
        )
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
        tuning, scale = self.tuning, graph.scale
        count, width = ends.receive_NW.shape
        activation_EW, second_EW, hidden_EW, result_EW = (torch.empty_like(edge_EW) for _ in range(4))
        receive_NW, send_NW = torch.empty_like(ends.receive_NW), torch.empty_like(ends.receive_NW)
        programs = self._programs(tuning.backward_programs, count)
        partial_P2W, partial_PW = (
            weights.second.new_empty(programs, 2, width),
            weights.second.new_empty(programs, width),
        )
        last = gradient_EW is None
        gradient_EW = edge_EW if gradient_EW is None else gradient_EW.contiguous()
        step = self._step(graph, ends, weights)
        norm_backward[(programs,)](
            sum_gradient_NW.contiguous(),
            gradient_EW,
            scale,
            edge_EW,
            *step,
            weights.gain,
            activation_EW,
            second_EW,
            partial_P2W,
            LAST=last,
            WIDTH=width,
            BLOCK=tuning.backward_block,
            PRECISION=self.precision,
            num_warps=tuning.backward_warps,
        )
        layers_backward[(programs,)](
            second_EW,
            activation_EW,
            gradient_EW,
            graph.neighbours.receivers.offset_N1,
            count,
            *step[5:7],
            hidden_EW,
            result_EW,
            receive_NW,
            partial_PW,
            LAST=last,
            WIDTH=width,
            BLOCK=tuning.backward_block,
            PRECISION=self.precision,
            num_warps=tuning.backward_warps,
        )
        order_E, offset_N1 = graph.by_sender
        sender_sums[(count,)](hidden_EW, order_E, offset_N1, send_NW, WIDTH=width, BLOCK=SENDER_BLOCK, num_warps=4)
        own_WW = self._weight_product(graph, hidden_EW, edge_EW)
        second_WW = self._weight_product(graph, second_EW, activation_EW)
        gain_W, shift_W = (partial_P2W.sum(0) / scale).unbind(0)
        found = Weights(own_WW, second_WW, partial_PW.sum(0) / scale, gain_W, shift_W)
        return Ends(send_NW / scale, receive_NW / scale), found, result_EW

    @property
    def _dtype(self) -> torch.dtype:
        return torch.float16 if self.precision == "half" else torch.float32

    def _encoder(self, graph: Graph, first_bias_W: torch.Tensor, weights: Weights) -> tuple[object, ...]:
        receivers = graph.neighbours.receivers
        return (
            graph.position_N3.contiguous(),
            graph.neighbours.sender_E,
            receivers.segment_E,
            receivers.offset_N1,
            receivers.count,
            weights.own.contiguous(),
            first_bias_W,
            weights.second.to(self._dtype).contiguous(),
            weights.bias,
        )

    def _step(self, graph: Graph, ends: Ends, weights: Weights) -> tuple[object, ...]:
        receivers = graph.neighbours.receivers
        return (
            ends.send_NW.to(self._dtype).contiguous(),
            ends.receive_NW.contiguous(),
            graph.neighbours.sender_E,
            receivers.offset_N1,
            receivers.count,
            weights.own.to(self._dtype).contiguous(),
            weights.second.to(self._dtype).contiguous(),
            weights.bias,
        )

    def _weight_product(self, graph: Graph, left_EW: torch.Tensor, right_EW: torch.Tensor) -> torch.Tensor:
        """left^T right without the scale, float32 [W, W]."""
        tuning, receivers, width = self.tuning, graph.neighbours.receivers, left_EW.shape[1]
        programs = self._programs(tuning.product_programs, triton.cdiv(len(left_EW), tuning.product_rows))
        partial_PWW = torch.empty(programs, width, width, dtype=torch.float32, device=left_EW.device)
        weight_products[(programs,)](
            left_EW,
            right_EW,
            receivers.offset_N1,
            receivers.count,
            partial_PWW,
            WIDTH=width,
            STEP=tuning.product_rows,
            PRECISION=self.precision,
            num_warps=tuning.product_warps,
        )
        return partial_PWW.sum(0) / graph.scale

    @staticmethod
    def _programs(each: int, wanted: int) -> int:
        """`each` for a multiprocessor, no more than there is work for."""
        where = torch.cuda.is_available()
        processors = torch.cuda.get_device_properties("cuda").multi_processor_count if where else 2
        return max(1, min(wanted, each * processors))
