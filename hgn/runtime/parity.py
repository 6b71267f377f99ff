"""Compares kernels, as compiled for this machine, with PyTorch.

Both round, and rounding moves activations across their kinks, so the bounds are wide. Wrong kernels exceed them by far.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from hgn.schema import ConfigError


@dataclass(frozen=True)
class Quantity:
    """A result to compare: the largest relative error of its norm, and the smallest rms that it is related to."""

    name: str
    bound: float
    least: float = 0.0


class ParityError(ConfigError):
    """The results of kernels on this machine differ from PyTorch's."""


# Normalised accelerations. Latent vectors have size 1 for any output, so rounding to 11 bits (fp16, tf32) changes small
# and large outputs by the same amount: 6e-4 on an H100, in a scene at rest. The smallest bound, 0.05 * 0.03, is 2.5
# times that.
OUTPUTS = Quantity("outputs", 0.05, least=0.03)
# The gradient of one parameter tensor. Rounding to 11 bits changes the worst of 395 tensors by 0.02 to 0.2. A gradient
# that is missing has the error 1. `least` is 1e-7 of the largest gradients.
GRADIENTS = Quantity("gradients", 0.5, least=1e-7)


def relative_error(computed: torch.Tensor, expected: torch.Tensor, least: float = 0.0) -> float:
    """Returns the norm of the error over that of `expected`, or over that of values of size `least` if that is larger.

    If the divisor is zero, the result is 0 without an error and infinity with one.
    """
    difference, size = float((computed - expected).norm()), max(float(expected.norm()), least * expected.numel() ** 0.5)
    if size > 0:
        return difference / size
    return 0.0 if difference == 0 else math.inf


def require_parity(
    computed: torch.Tensor, expected: torch.Tensor, quantity: Quantity, precision: str, section: str = ""
) -> float:
    """Returns the relative error of kernels of this precision against PyTorch. Raises: ParityError above the bound."""
    return require_error(relative_error(computed, expected, quantity.least), quantity, precision, section)


def require_error(error: float, quantity: Quantity, precision: str, section: str = "") -> float:
    """Returns the error of kernels of this precision.

    Raises: ParityError if the error exceeds its bound. It names the setting to change, in `section`.
    """
    if not error <= quantity.bound:  # NaN fails too
        field, wanted, used = ("precision", "tf32", "fp16") if precision == "fp16" else ("backend", "torch", "triton")
        raise ParityError(
            f"{section}{field} must be {wanted} on this machine, got {used}: its {quantity.name} differ by {error:.1e} "
            f"from PyTorch's (at most {quantity.bound:.2g}); set {section}{field}={wanted}, and report device and "
            "versions"
        )
    return error
