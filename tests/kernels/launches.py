"""Records every launch of a Triton kernel with its arguments and results, for tests of single kernels.

The launches are intercepted in Triton, so that no caller is missed.
"""

from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from unittest import mock

import torch
from kernels.interpreter import dropped_bits
from kernels.references import Added, rows
from triton.runtime.jit import KernelInterface

from hgn.config import MATERIAL_EMBEDDING


@dataclass(frozen=True)
class Launch:
    """Holds the arguments and results of a kernel."""

    kernel: str
    given: dict[str, Any]  # by the kernel's names; tensors as they were before
    left: dict[str, torch.Tensor]  # the same after
    parameters: dict[int, torch.Tensor]  # float64 and not rounded, by the address of what the kernel reads
    buffers: dict[int, torch.Tensor]  # of the network, by their address

    def arguments(self):
        """Those of the kernel's reference: numbers in float64, parameters not rounded."""
        result = dict(self.given)
        for name, tensor in self.left.items():
            if tensor.data_ptr() in self.parameters:
                result[name] = self.parameters[tensor.data_ptr()]
            elif tensor.is_floating_point():
                result[name] = self.given[name].double()
        if self.kernel == "weight_gradient":
            result["right"] = {row[1]: self._operand(row[1], row[5]) for row in self.given["jobs"].tolist()}
        return result

    def _operand(self, at, width):
        """The buffer that lies at an offset from the weights' products' `right`."""
        right = self.left["right"]
        operand = self.buffers[right.data_ptr() + at * right.element_size()]
        assert operand.dtype == right.dtype and operand.shape[-1] == width
        return operand.double()

    def pairs(self, outputs):
        """Returns for each output its name, the kernel's result, the expected result, and the size of the summands."""
        for name, output in outputs.items():
            if isinstance(output, Added):
                shape = output.value.shape
                after, before = (rows(x["totals"].flatten()[output.at :], *shape) for x in (self.left, self.given))
                yield name, (after.double() - before.double()) / self.given["unscale"], output.value, output.summands
            else:
                promised = ~output.isnan()
                yield name, rows(self.left[name], *output.shape).double()[promised], output[promised], 0.0


@contextmanager
def watched(see, parameters, buffers=None):
    """Every launch is seen as soon as it is over."""
    begin = KernelInterface.__getitem__

    def watching(kernel, grid):
        def launch(**arguments):
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
def watched_engine(see, engine):
    values = engine.values.double()
    parameters = {
        engine.weights.data_ptr(): values,
        engine.values.data_ptr(): values,
        engine.encode_weights.data_ptr(): _encoder(engine, values),
    }
    with watched(see, parameters, {tensor.data_ptr(): tensor for tensor in _tensors(engine)}):
        yield


def _encoder(engine, values):
    """Its first layer on features and one-hot materials."""
    first, embedding, bias = engine._encode_views(values)
    used = engine.config.feature_width - MATERIAL_EMBEDDING
    combined = torch.zeros_like(engine.encode_weights, dtype=torch.float64)
    combined[:, :used] = first[:, :used]
    combined[:, used : used + len(embedding)] = bias[:, None] + first[:, used:] @ embedding.T
    return combined


def _tensors(value):
    if isinstance(value, torch.Tensor):
        yield value
    elif isinstance(value, dict):
        yield from _tensors(list(value.values()))
    elif isinstance(value, (list, tuple)):
        for entry in value:
            yield from _tensors(entry)
    elif type(value).__module__.startswith("hgn.kernels"):
        yield from _tensors(vars(value))
