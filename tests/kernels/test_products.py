"""The matrix products' rounding of operands."""

import pytest
import torch
import triton
import triton.language as tl
from kernels.engines import device

from hgn.kernels.blocks import finer_product, nearest_tf32, product
from hgn.kernels.packing import rounded_to_tf32

LAST_BIT = 2.0**-10  # of TF32, of a number's power of two


@triton.jit
def _nearest(x, y, SIZE: tl.constexpr):
    at = tl.arange(0, SIZE)
    tl.store(y + at, nearest_tf32(tl.load(x + at)))


@triton.jit
def _product(x, w, y, SIZE: tl.constexpr, PRECISION: tl.constexpr):
    at = tl.arange(0, SIZE)[:, None] * SIZE + tl.arange(0, SIZE)[None, :]
    tl.store(y + at, product(tl.load(x + at), tl.load(w + at), PRECISION))


@triton.jit
def _finer_product(x, w, y, SIZE: tl.constexpr, PRECISION: tl.constexpr):
    at = tl.arange(0, SIZE)[:, None] * SIZE + tl.arange(0, SIZE)[None, :]
    tl.store(y + at, finer_product(tl.load(x + at), tl.load(w + at), PRECISION))


def rounded(x):
    """To TF32's nearest, in float64."""
    mantissa, exponent = torch.frexp(x.double())
    steps = 2 * mantissa / LAST_BIT
    return torch.ldexp(torch.sign(steps) * (steps.abs() + 0.5).floor() * LAST_BIT / 2, exponent)


def test_numbers_are_rounded_to_the_nearest():
    """Every number becomes the nearest with 10 bits of mantissa, ties away from zero; NaN, infinity and zero stay."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(1024, generator=generator) * 2.0 ** torch.randint(-30, 30, (1024,), generator=generator)
    special = torch.tensor([0x7FFFFFFF, 0x7F800000, -0x800000, 0, 0x3F801000, 0x3F800FFF, -0x407FF000])
    x[: len(special)] = special.int().view(torch.float32)
    y = torch.empty_like(x, device=device())
    _nearest[(1,)](x.to(device()), y, SIZE=1024)
    found = y.cpu()
    assert found[0].isnan() and found[1] == float("inf") and found[2] == -float("inf") and found[3] == 0
    assert found[4:7].tolist() == [1 + LAST_BIT, 1.0, -1 - LAST_BIT]
    assert torch.equal(found[7:].double(), rounded(x[7:]))


def test_a_product_rounds_what_it_is_given():
    """A TF32 product of activations and of weights, which come rounded, is the product of the rounded ones."""
    generator = torch.Generator().manual_seed(0)
    x, w = torch.randn(2, 16, 16, generator=generator)
    exact, w = w, rounded_to_tf32(w)
    y = torch.empty(16, 16, device=device())
    _product[(1,)](x.to(device()), w.to(device()), y, SIZE=16, PRECISION="tf32")
    torch.testing.assert_close(y.cpu().double(), rounded(x) @ rounded(exact), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("precision", ["fp16", "tf32", "fp32"])
def test_a_finer_product_keeps_twenty_bits(precision):
    """Features and weights of usual size, which rounded to 10 bits would be 3e-4 off."""
    generator = torch.Generator().manual_seed(0)
    x, w = 3 * torch.randn(64, 64, generator=generator), torch.randn(64, 64, generator=generator) / 8
    y = torch.empty(64, 64, device=device())
    _finer_product[(1,)](x.to(device()), w.to(device()), y, SIZE=64, PRECISION=precision)
    expected = x.double() @ w.double()
    assert float((y.cpu() - expected).norm() / expected.norm()) < 1e-6
