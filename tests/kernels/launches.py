"""Every launch of a Triton kernel with what it was given and what it left, for the tests that judge each kernel alone.

Launches are seen where Triton makes them: whatever launches a kernel, none is missed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from unittest import mock

import torch
from kernels.interpreter import dropped_bits
from triton.runtime.jit import KernelInterface

from hgn.kernels.forward import FusedNetwork
from hgn.kernels.gns.op import FusedEdges


@dataclass(frozen=True)
class Launch:
    """Numbers come in float64, those of buffers with room to spare as their first rows."""

    kernel: str
    given: dict[str, Any]  # by the kernel's names; tensors as they were before
    left: dict[str, torch.Tensor]  # the same after
    parameters: dict[int, torch.Tensor]  # float64 and not rounded, by the address of what the kernel reads
    buffers: dict[int, torch.Tensor]  # of the engine, by their address

    def __getitem__(self, name: str) -> Any:
        return self.given[name]

    @property
    def count(self) -> int:
        return int(self.given["count_ptr"])

    def rows(self, name: str, *shape: int) -> torch.Tensor:
        return _first(self.given[name], shape).double()

    def found(self, name: str, *shape: int) -> torch.Tensor:
        return _first(self.left[name], shape).double()

    def indices(self, name: str, *shape: int) -> torch.Tensor:
        """Below zero: none."""
        return _first(self.given[name], shape).long()

    def parameter(self, at: str, *shape: int, of: str = "") -> torch.Tensor:
        """The parameters at the place that the argument `at` names, which may be of several."""
        every = self.parameters[self.given[of or ("values" if "values" in self.given else "weights")].data_ptr()]
        return _first(every.flatten()[self.given[at] :], shape)

    def added(self, at: int, *shape: int) -> torch.Tensor:
        """What was added to `totals` at a place, without the loss scale's share."""
        found = [_first(totals["totals"].flatten()[at:], shape).double() for totals in (self.left, self.given)]
        return (found[0] - found[1]) / self.given["unscale"]


def _first(x: torch.Tensor, shape: tuple[int, ...]) -> torch.Tensor:
    return x.flatten()[: math.prod(shape)].view(shape)


@contextmanager
def watched(
    see: Callable[[Launch], None], parameters: dict[int, torch.Tensor], buffers: dict[int, torch.Tensor] | None = None
) -> Iterator[None]:
    """Every launch is seen as soon as it is over."""
    begin = KernelInterface.__getitem__

    def watching(kernel: Any, grid: Any) -> Callable[..., None]:
        def launch(**arguments: Any) -> None:
            left = {name: value for name, value in arguments.items() if isinstance(value, torch.Tensor)}
            given = arguments | {
                name: value.clone() for name, value in left.items() if value.data_ptr() not in parameters
            }
            begin(kernel, grid)(**arguments)
            see(Launch(kernel.__name__, given, left, parameters, buffers or {}))

        return launch

    with mock.patch.object(KernelInterface, "__getitem__", watching), dropped_bits():
        yield


@contextmanager
def watched_engine(see: Callable[[Launch], None], engine: FusedNetwork) -> Iterator[None]:
    values = engine.values.double()
    parameters = {
        engine.weights.data_ptr(): values,
        engine.values.data_ptr(): values,
        engine.encode_weights.data_ptr(): _encoder(engine, values),
    }
    with watched(see, parameters, {tensor.data_ptr(): tensor for tensor in _tensors(engine)}):
        yield


@contextmanager
def watched_edges(see: Callable[[Launch], None]) -> Iterator[None]:
    """Of GNS, whose products read copies that are made for each launch."""
    parameters: dict[int, torch.Tensor] = {}
    copy = FusedEdges._operand

    def noting(edges: FusedEdges, weight: torch.Tensor) -> torch.Tensor:
        operand = copy(edges, weight)
        parameters[operand.data_ptr()] = weight.detach().double()
        return operand

    with mock.patch.object(FusedEdges, "_operand", noting), watched(see, parameters):
        yield


def _encoder(engine: FusedNetwork, values: torch.Tensor) -> torch.Tensor:
    """Its first layer on features and one-hot materials."""
    first, embedding, bias = engine._encode_views(values)
    used = engine.config.feature_width - engine.config.material_embedding
    combined = torch.zeros_like(engine.encode_weights, dtype=torch.float64)
    combined[:, :used] = first[:, :used]
    combined[:, used : used + len(embedding)] = bias[:, None] + first[:, used:] @ embedding.T
    return combined


def _tensors(value: Any) -> Iterator[torch.Tensor]:
    if isinstance(value, torch.Tensor):
        yield value
    elif isinstance(value, dict):
        yield from _tensors(list(value.values()))
    elif isinstance(value, (list, tuple)):
        for entry in value:
            yield from _tensors(entry)
    elif type(value).__module__.startswith("hgn.kernels"):
        yield from _tensors(vars(value))
