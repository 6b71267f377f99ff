"""How far apart two computations of the same thing are, and how far backend triton may be from PyTorch."""

from __future__ import annotations

import math

import torch

from hgn.schema import ConfigError

GRADIENT_BOUND = 0.3  # relative error of all gradients, of the norm
OUTPUT_BOUND = 0.05  # relative error of the network's outputs; both round, and wrong kernels miss it by far
# of normalised accelerations, root mean square: what relative inputs put out in free flight is rounding and far less,
# and differs as a whole
LEAST_OUTPUT = 0.01


def relative_error(computed: torch.Tensor, expected: torch.Tensor, least: float = 0.0) -> float:
    """Of the norm, or of that of values of size `least` where it is larger. Where nothing is expected: 0 if nothing is
    computed, else infinite."""
    difference, size = float((computed - expected).norm()), max(float(expected.norm()), least * expected.numel() ** 0.5)
    if size > 0:
        return difference / size
    return 0.0 if difference == 0 else math.inf


def require_bound(error: float, bound: float, what: str, field: str, right: str, wrong: str) -> None:
    """Raises ConfigError where kernels, as compiled for this machine, are farther from PyTorch than rounding brings
    them: `field` must be `right` then and not `wrong`."""
    if not error <= bound:  # NaN fails
        raise ConfigError(
            f"{field} must be {right} on this machine, got {wrong}: its {what} differ by {error:.1e} from PyTorch's "
            f"(at most {bound}); set {field}={right}, and report device and versions"
        )
