"""Which implementation computes the network: the plain one, or the fast one (Triton kernels in CUDA graphs).

`auto` takes the fast one wherever it runs, and the choice is always said.
"""

from __future__ import annotations

import torch

from hgn.config import NetworkConfig
from hgn.runtime.triton_host import why_no_triton
from hgn.schema import ConfigError

# what the configuration calls them, and what the kernels do; float32 in three TF32 products
KERNEL_PRECISION = {"highest": "tf32x3", "high": "tf32", "half": "half"}
FAST_WIDTHS = (16, 32, 64, 128)
FAST_LEVELS = 8
HIGHEST_WIDTH = 64  # wider matrices in three parts each do not fit into an H100's shared memory


def why_not_fast(device: torch.device, config: NetworkConfig, precision: str = "high") -> str | None:
    """What keeps the fast path from running, in words; none if nothing does."""
    if config.kind != "hgn":
        return f"it computes hgn networks, not {config.kind}"
    if reason := _why_no_kernels(device) or _why_not_wide_so(config):
        return reason
    if precision == "highest" and config.width > HIGHEST_WIDTH:
        return f"with precision highest it computes widths up to {HIGHEST_WIDTH}, not {config.width}"
    if config.levels > FAST_LEVELS:
        return f"network.levels must be at most {FAST_LEVELS} for it, not {config.levels}"
    return None


def why_not_trained_fast(
    device: torch.device, config: NetworkConfig, precision: str, own_states: bool = False
) -> str | None:
    """What keeps training from the fast path, which updates GNS too, in words; none if nothing does.

    `own_states`: it is to train on the network's own states.
    """
    if config.kind == "hgn":
        return why_not_fast(device, config, precision)
    if config.obstacle_particles:
        return f"it trains hgn and gns networks, not {config.kind}"
    if reason := _why_no_kernels(device):
        return reason
    if precision != "half":
        return f"it trains gns with precision half, not {precision}"
    if reason := _why_not_wide_so(config):
        return reason
    if config.maximum_neighbours is not None:
        return f"network.maximum_neighbours must be null for it, not {config.maximum_neighbours}"
    if own_states:
        return "it trains gns on true states alone (training.rollout_share=0)"
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
    field: str, path: str, precision: str, reason: str | None, half_plainly: bool = False
) -> tuple[str, str]:
    """`plain` or `fast`, and a line that says so; `reason` is what keeps the fast one from running.

    `half_plainly`: the plain path knows half precision too.
    Raises: ConfigError when the fast path is asked for and cannot run, or half precision without it.
    """
    if path == "fast" and reason is not None:
        raise ConfigError(f"{field} must be plain or auto here, got fast: {reason}")
    chosen = "fast" if path != "plain" and reason is None else "plain"
    if chosen == "plain" and precision == "half" and not half_plainly:
        raise ConfigError(
            f"precision must be high or highest on the plain path, got half; {reason or f'{field}=plain was asked for'}"
        )
    because = f" ({reason})" if chosen == "plain" and path == "auto" else ""
    return chosen, f"{field.rpartition('.')[0] or 'runtime'} path: {chosen}{because}, precision {precision}"


def path_on(
    device: torch.device, network: NetworkConfig, path: str, precision: str, field: str = "path"
) -> tuple[str, str]:
    """What choose_path answers for a network on a device; GNS has half precision of its own, see gns_edges."""
    return choose_path(field, path, precision, why_not_fast(device, network, precision), network.kind != "hgn")


def set_matmul_precision(precision: str) -> None:
    """PyTorch's own float32 products: full with `highest`, one TF32 product on a GPU with `high` and `half`."""
    torch.set_float32_matmul_precision("highest" if precision == "highest" else "high")


def kernel_precision(precision: str, device: torch.device) -> str:
    """What the kernels call `highest`, `high` or `half`; without a GPU float32 needs no detour."""
    name = KERNEL_PRECISION[precision]
    return "ieee" if device.type == "cpu" and name != "half" else name
