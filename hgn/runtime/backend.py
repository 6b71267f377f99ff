"""Which implementation computes the network: the plain one, or the fast one (Triton kernels in CUDA graphs).

`auto` takes the fast one wherever it runs, and the choice is always said.
"""

from __future__ import annotations

import torch

from hgn.config import NetworkConfig
from hgn.runtime.triton_host import why_no_triton
from hgn.schema import ConfigError

FAST_WIDTHS = (16, 32, 64, 128)
FAST_LEVELS = 8


def why_not_fast(device: torch.device, config: NetworkConfig, precision: str = "tf32") -> str | None:
    """What keeps backend triton from running, in words; none if nothing does."""
    if config.kind != "hgn":
        return f"it computes hgn networks, not {config.kind}"
    if reason := _why_no_kernels(device) or _why_not_wide_so(config):
        return reason
    if precision == "fp32":
        return "it computes in tf32 or fp16, not fp32"
    if config.levels > FAST_LEVELS:
        return f"network.levels must be at most {FAST_LEVELS} for it, not {config.levels}"
    return None


def why_not_trained_fast(
    device: torch.device, config: NetworkConfig, precision: str, pushforward: bool = False
) -> str | None:
    """What keeps training from backend triton, which updates GNS too, in words; none if nothing does.

    `pushforward`: it is to train on the network's own simulations.
    """
    if config.kind == "hgn":
        return why_not_fast(device, config, precision)
    if config.obstacle_particles:
        return f"it trains hgn and gns networks, not {config.kind}"
    if reason := _why_no_kernels(device):
        return reason
    if precision != "fp16":
        return f"it trains gns with precision fp16, not {precision}"
    if reason := _why_not_wide_so(config):
        return reason
    if config.maximum_neighbours is not None:
        return f"network.maximum_neighbours must be null for it, not {config.maximum_neighbours}"
    if pushforward:
        return "it trains gns on true states alone (training.pushforward_fraction=0)"
    return None


def _why_no_kernels(device: torch.device) -> str | None:
    if device.type != "cuda":
        return f"it needs a CUDA device, not {device.type}"
    return why_no_triton()


def _why_not_wide_so(config: NetworkConfig) -> str | None:
    if config.width not in FAST_WIDTHS:
        return f"network.width must be one of {', '.join(map(str, FAST_WIDTHS))} for it, not {config.width}"
    return None


def choose_path(
    field: str, backend: str, precision: str, reason: str | None, torch_has_fp16: bool = False
) -> tuple[str, str]:
    """`torch` or `triton`, and a line that says so; `reason` is what keeps the latter from running.

    `torch_has_fp16`: of this network.
    Raises: ConfigError when triton is asked for and cannot run, or fp16 without it.
    """
    if backend == "triton" and reason is not None:
        raise ConfigError(f"{field} must be torch or auto here, got triton: {reason}")
    chosen = "triton" if backend != "torch" and reason is None else "torch"
    if chosen == "torch" and precision == "fp16" and not torch_has_fp16:
        raise ConfigError(
            f"precision must be tf32 or fp32 on backend torch, got fp16; {reason or f'{field}=torch was asked for'}"
        )
    because = f" ({reason})" if chosen == "torch" and backend == "auto" else ""
    return chosen, f"{field.rpartition('.')[0] or 'runtime'} backend: {chosen}{because}, precision {precision}"


def path_on(
    device: torch.device, network: NetworkConfig, backend: str, precision: str, field: str = "backend"
) -> tuple[str, str]:
    """What choose_path answers for a network on a device; GNS has fp16 of its own, see gns_edges."""
    return choose_path(field, backend, precision, why_not_fast(device, network, precision), network.kind != "hgn")


def set_matmul_precision(precision: str) -> None:
    """PyTorch's own float32 products: full with fp32, one TF32 product on a GPU with tf32 and fp16."""
    torch.set_float32_matmul_precision("highest" if precision == "fp32" else "high")


def kernel_precision(precision: str, device: torch.device) -> str:
    """What the kernels are given: without a GPU there is no TF32."""
    return "fp32" if device.type == "cpu" and precision == "tf32" else precision
