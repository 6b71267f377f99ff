"""How far apart two computations of the same thing are, and how far backend triton may be from PyTorch."""

from __future__ import annotations

import math

import torch

from hgn.schema import ConfigError

GRADIENT_BOUND = 0.3  # relative error of all gradients, of the norm
OUTPUT_BOUND = 0.05  # relative error of the network's outputs; both round, and wrong kernels miss it by far
# Of normalised accelerations, root mean square: smaller outputs are compared with this. Latents are of size 1, whatever
# comes of them, so rounding to 11 bits (fp16, tf32) changes outputs by about 5e-4: 6e-4 was measured on an H100, of a
# start in which almost nothing is accelerated. The bound is 2.5 times that here.
LEAST_OUTPUT = 0.03


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
