"""The reference network in float64 with operands rounded as matrix units round them: what rounding alone does to it.

How far a network's outputs and gradients move is one draw of many roundings: of one particle from 2e-4 to 4e-3.
"""

from contextlib import contextmanager
from unittest import mock

import torch

from hgn.network import hgn, mlp
from hgn.network.mlp import MLP

MANTISSA_BITS = 10  # of TF32 and float16, the leading one not counted


def rounded(x):
    """To the nearest number of so many bits, whatever its size."""
    mantissa, exponent = torch.frexp(x)
    scale = 2.0 ** (MANTISSA_BITS + 1)
    return torch.ldexp(torch.round(mantissa * scale) / scale, exponent)


class _Product(torch.autograd.Function):
    """x [..., K] times w [N, K], and both gradients, of rounded operands."""

    @staticmethod
    def forward(ctx, x, w):
        x, w = rounded(x), rounded(w)
        ctx.save_for_backward(x, w)
        return x @ w.mT

    @staticmethod
    def backward(ctx, gradient):
        x, w = ctx.saved_tensors
        gradient = rounded(gradient)
        return gradient @ w, gradient.flatten(0, -2).mT @ x.flatten(0, -2)


class _Stored(torch.autograd.Function):
    """What is kept rounded between kernels, and its gradient too."""

    @staticmethod
    def forward(ctx, x):
        return rounded(x)

    @staticmethod
    def backward(ctx, gradient):
        return rounded(gradient)


@contextmanager
def rounding(stored):
    """Plain networks compute with rounded operands, and with `stored` keep what goes from one layer to the next so."""

    def linear(value, weight, bias=None):
        out = _Product.apply(value, weight)
        return out if bias is None else out + bias

    def add_projection(self, hidden, part, value):
        return hidden.add_(self.project(part, value))

    def kept(function):
        return lambda *values: _Stored.apply(function(*values)) if stored else function(*values)

    with (
        mock.patch.object(mlp, "linear", linear),
        mock.patch.object(MLP, "add_projection", add_projection),
        mock.patch.object(MLP, "project", kept(MLP.project)),
        mock.patch.object(MLP, "finish", kept(MLP.finish)),
        mock.patch.object(hgn, "_scatter", kept(hgn._scatter)),
    ):
        yield
