"""GNS's work on edges through the fused kernels; the reference is hgn.network.gns_edges.PlainEdges.

Shape legend: N particles, E directed edges, W width, P programs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
import triton

from hgn.kernels.gns.kernel import (
    gns_edge_sums,
    gns_encode_forward,
    gns_encode_layers_backward,
    gns_encode_norm_backward,
    gns_layers_backward,
    gns_norm_backward,
    gns_step_forward,
    gns_weight_products,
)
from hgn.kernels.packing import rounded_to_tf32
from hgn.network.gns_edges import Edges, Ends, Graph, Weights

SUM_BLOCK, SUM_WARPS = 16, 4  # edges and warps of a sum


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
    """On a CUDA device (or in Triton's interpreter). `precision` is fp16, tf32 (float32 edges), or fp32 for tests."""

    precision: str = "fp16"
    tuning: Tuning = field(default_factory=Tuning)

    @staticmethod
    def in_tf32() -> FusedEdges:
        """Weights take twice the shared memory: one program a multiprocessor."""
        return FusedEdges("tf32", Tuning(warps=8, programs=1, backward_warps=8, backward_programs=1))

    def encode(self, graph: Graph, first_bias_W: torch.Tensor, weights: Weights) -> torch.Tensor:
        edges, width = graph.neighbours.edge_count, len(weights.second)
        edge_EW = torch.empty(edges, width, dtype=self._dtype, device=weights.second.device)
        if edges:
            gns_encode_forward[(triton.cdiv(edges, self.tuning.block),)](
                **self._encoder(graph, first_bias_W, weights), norm_bias=weights.shift, edge=edge_EW,
                WIDTH=width, BLOCK=self.tuning.block, PRECISION=self.precision, num_warps=self.tuning.warps,
            )  # fmt: skip
        return edge_EW

    def encode_backward(
        self, graph: Graph, first_bias_W: torch.Tensor, weights: Weights, gradient_EW: torch.Tensor
    ) -> tuple[torch.Tensor, Weights]:
        width, tuning = len(weights.second), self.tuning
        activation_EW, second_EW = torch.empty_like(gradient_EW), torch.empty_like(gradient_EW)
        wanted = triton.cdiv(len(gradient_EW), tuning.backward_block)
        programs = self._programs(tuning.backward_programs, wanted, gradient_EW.device)
        partial_P8W = weights.second.new_empty(programs, 8, width)
        encoder = self._encoder(graph, first_bias_W, weights)
        gns_encode_norm_backward[(programs,)](
            gradient=gradient_EW, **encoder, activation=activation_EW, second_gradient=second_EW,
            partial=partial_P8W, WIDTH=width, BLOCK=tuning.backward_block, PRECISION=self.precision,
            num_warps=tuning.backward_warps,
        )  # fmt: skip
        gns_encode_layers_backward[(programs,)](
            second_gradient=second_EW, activation=activation_EW,
            **{name: encoder[name] for name in encoder.keys() - {"first", "first_bias", "second_bias", "norm_weight"}},
            partial=partial_P8W, WIDTH=width, BLOCK=tuning.backward_block, PRECISION=self.precision,
            num_warps=tuning.backward_warps,
        )  # fmt: skip
        total_8W = partial_P8W.sum(0) / graph.scale
        (second_WW,) = self._weight_products(graph, second_EW, activation_EW, None)
        gradients = Weights(total_8W[3:7].T.contiguous(), second_WW, total_8W[2], total_8W[0], total_8W[1])
        return total_8W[7], gradients

    def step(
        self, graph: Graph, ends: Ends, weights: Weights, edge_EW: torch.Tensor, last: bool, in_place: bool
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        out_EW = None if last else edge_EW if in_place else torch.empty_like(edge_EW)
        message_EW = torch.empty_like(edge_EW)
        edges, width = edge_EW.shape
        programs = self._programs(self.tuning.programs, triton.cdiv(edges, self.tuning.block), edge_EW.device)
        gns_step_forward[(programs,)](
            edge=edge_EW, edge_out=edge_EW if out_EW is None else out_EW, message_out=message_EW,
            **self._step(graph, ends, weights), norm_bias=weights.shift, LAST=last, WIDTH=width,
            BLOCK=self.tuning.block, PRECISION=self.precision, num_warps=self.tuning.warps,
        )  # fmt: skip
        return self._sums(graph, message_EW, None, ends.receive_NW, scaled=False), out_EW

    def step_backward(
        self,
        graph: Graph,
        ends: Ends,
        weights: Weights,
        edge_EW: torch.Tensor,
        sum_gradient_NW: torch.Tensor,
        gradient_EW: torch.Tensor | None,
    ) -> tuple[Ends, Weights, torch.Tensor]:
        tuning = self.tuning
        edges, width = edge_EW.shape
        activation_EW, second_EW, hidden_EW, result_EW = (torch.empty_like(edge_EW) for _ in range(4))
        wanted = triton.cdiv(edges, tuning.backward_block)
        programs = self._programs(tuning.backward_programs, wanted, edge_EW.device)
        partial_P3W = weights.second.new_empty(programs, 3, width)
        last = gradient_EW is None
        gradient_EW = edge_EW if gradient_EW is None else gradient_EW.contiguous()
        step = self._step(graph, ends, weights)
        gns_norm_backward[(programs,)](
            sum_gradient=self._stored(sum_gradient_NW * graph.scale), gradient=gradient_EW, edge=edge_EW,
            **step, activation=activation_EW, second_gradient=second_EW, partial=partial_P3W, LAST=last,
            WIDTH=width, BLOCK=tuning.backward_block, PRECISION=self.precision, num_warps=tuning.backward_warps,
        )  # fmt: skip
        gns_layers_backward[(programs,)](
            second_gradient=second_EW, activation=activation_EW, gradient=gradient_EW, offset=step["offset"],
            particles=step["particles"], own=step["own"], second=step["second"], hidden_gradient=hidden_EW,
            edge_gradient=result_EW, partial=partial_P3W, LAST=last, WIDTH=width, BLOCK=tuning.backward_block,
            PRECISION=self.precision, num_warps=tuning.backward_warps,
        )  # fmt: skip
        receive_NW = self._sums(graph, hidden_EW, None, ends.receive_NW, scaled=True)
        send_NW = self._sums(graph, hidden_EW, graph.by_sender, ends.receive_NW, scaled=True)
        second_WW, own_WW = self._weight_products(graph, second_EW, activation_EW, (hidden_EW, edge_EW))
        gain_W, shift_W, bias_W = (partial_P3W.sum(0) / graph.scale).unbind(0)
        return Ends(send_NW, receive_NW), Weights(own_WW, second_WW, bias_W, gain_W, shift_W), result_EW

    @property
    def _dtype(self) -> torch.dtype:
        return torch.float16 if self.precision == "fp16" else torch.float32

    def _stored(self, value: torch.Tensor) -> torch.Tensor:
        return value.to(self._dtype, memory_format=torch.contiguous_format).contiguous()

    def _operand(self, weight: torch.Tensor) -> torch.Tensor:
        return rounded_to_tf32(weight) if self.precision == "tf32" else self._stored(weight)

    def _encoder(self, graph: Graph, first_bias_W: torch.Tensor, weights: Weights) -> dict[str, Any]:
        """What the encoder's kernels read, by their names."""
        return {
            "position": graph.position_N3.contiguous(),
            "first": weights.own.contiguous(),
            "first_bias": first_bias_W,
            **self._edges(graph, weights),
        }

    def _step(self, graph: Graph, ends: Ends, weights: Weights) -> dict[str, Any]:
        """What a message step's kernels read, by their names."""
        return {
            "send": self._stored(ends.send_NW),
            "receive": self._stored(ends.receive_NW),
            "own": self._operand(weights.own),
            **self._edges(graph, weights),
        }

    def _edges(self, graph: Graph, weights: Weights) -> dict[str, Any]:
        receivers = graph.neighbours.receivers
        return {
            "sender": graph.neighbours.sender_E,
            "receiver": receivers.segment_E,
            "offset": receivers.offset_N1,
            "particles": receivers.count,
            "second": self._operand(weights.second),
            "second_bias": weights.bias,
            "norm_weight": weights.gain,
        }

    def _sums(
        self,
        graph: Graph,
        value_EW: torch.Tensor,
        by_sender: tuple[torch.Tensor, torch.Tensor] | None,
        like_NW: torch.Tensor,
        scaled: bool,
    ) -> torch.Tensor:
        """Sums of edges by receiver, or as `by_sender` orders them; without the graph's scale if they have it."""
        receivers = graph.neighbours.receivers
        order_E, offset_N1 = by_sender or (receivers.segment_E, receivers.offset_N1)
        total_NW = torch.empty_like(like_NW, memory_format=torch.contiguous_format)
        gns_edge_sums[(receivers.count,)](
            value=value_EW, order=order_E, offset=offset_N1, total=total_NW,
            scale_ptr=graph.scale if scaled else total_NW, ORDERED=by_sender is not None, SCALED=scaled,
            WIDTH=value_EW.shape[1], BLOCK=SUM_BLOCK, num_warps=SUM_WARPS,
        )  # fmt: skip
        return total_NW

    def _weight_products(
        self,
        graph: Graph,
        second_EW: torch.Tensor,
        activation_EW: torch.Tensor,
        own: tuple[torch.Tensor, torch.Tensor] | None,
    ) -> tuple[torch.Tensor, ...]:
        """second_EW^T activation_EW, and own[0]^T own[1], without the scale, float32 [W, W]."""
        tuning, receivers, (edges, width) = self.tuning, graph.neighbours.receivers, second_EW.shape
        programs = self._programs(tuning.product_programs, triton.cdiv(edges, tuning.product_rows), second_EW.device)
        shape = (programs, 1 if own is None else 2, width, width)
        partial_PCWW = torch.empty(shape, dtype=torch.float32, device=second_EW.device)
        gns_weight_products[(programs,)](
            second_gradient=second_EW, activation=activation_EW,
            hidden_gradient=second_EW if own is None else own[0], edge=activation_EW if own is None else own[1],
            offset=receivers.offset_N1, particles=receivers.count, partial=partial_PCWW, BOTH=own is not None,
            WIDTH=width, STEP=tuning.product_rows, PRECISION=self.precision, num_warps=tuning.product_warps,
        )  # fmt: skip
        return (partial_PCWW.sum(0) / graph.scale).unbind(0)

    @staticmethod
    def _programs(each: int, wanted: int, device: torch.device) -> int:
        """`each` for a multiprocessor, no more than there is work for."""
        gpu = device.type == "cuda"
        processors = torch.cuda.get_device_properties(device).multi_processor_count if gpu else 2
        return max(1, min(wanted, each * processors))
