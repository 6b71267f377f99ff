"""Chooses the backend that computes a network: torch, triton or cpu.

| backend | what it is | networks | gradients |
|---|---|---|---|
| torch | PyTorch, the reference | all | yes |
| triton | Triton kernels, frames and updates in CUDA graphs | hgn | in training updates |
| cpu | compiled C; each core computes blocks of rows | hgn | no |

All have the same interface. `choose` returns the fastest supported backend and reports why.
"""

from collections.abc import Mapping

import torch

from hgn.config import BACKENDS, PRECISIONS, NetworkConfig
from hgn.cpu import compiled
from hgn.cpu import network as cpu_network
from hgn.network.base import ParticleNetwork, Prediction
from hgn.network.features import ParticleState
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.torch_backend import Backend
from hgn.runtime.triton_host import host_unsupported_reason
from hgn.schema import ConfigError, require

TRITON_WIDTHS = (16, 32, 64, 128)
TRITON_LEVELS = 8


class CpuBackend(Backend):
    """Computes frames in blocks of rows on a CPU, with compiled C if there is a compiler; without gradients."""

    name = "cpu"
    network: HierarchicalGraphNetwork

    def prediction(self, state: ParticleState) -> Prediction:
        return cpu_network.prediction(self.network, state)


def choose(device: torch.device, network: ParticleNetwork, precision: str = "auto", backend: str = "auto") -> Backend:
    """Returns the named backend, or with `auto` the fastest supported one. Its `note` reports the choice and why.

    Raises: ConfigError for an unknown backend, or with the reason why it is not supported here.
    """
    for name, value, known in (("backend", backend, BACKENDS), ("precision", precision, ("auto", *PRECISIONS))):
        require(value in known, name, f"one of {', '.join(known)}", value)
    config = network.config
    reasons = {
        "triton": triton_unsupported_reason(device, config, precision),
        "cpu": cpu_unsupported_reason(device, config, precision),
        "torch": torch_unsupported_reason(precision),
    }
    name, report = pick(reasons, backend, precision, "backend")
    chosen = build(name, network, precision)
    chosen.note = f"{report}, precision {chosen.precision}"
    if name == "cpu":
        chosen.note = f"{chosen.note}, {compiled.describe(config.width)}"
    return chosen


def build(name: str, network: ParticleNetwork, precision: str = "auto") -> Backend:
    """Returns the named backend, even if this machine does not support it."""
    if name == "triton":
        # imported here, because the other backends do without Triton
        from hgn.runtime.triton_backend import TritonBackend

        assert isinstance(network, HierarchicalGraphNetwork)
        return TritonBackend(network, precision)
    if name == "cpu":
        assert isinstance(network, HierarchicalGraphNetwork)
        return CpuBackend(network, precision)
    return Backend(network, precision)


def fastest_stepped(network: ParticleNetwork, precision: str = "auto") -> Backend:
    """Returns the fastest backend that computes frames one by one, for any network and device."""
    if cpu_unsupported_reason(next(network.parameters()).device, network.config, precision) is None:
        return build("cpu", network, precision)
    return build("torch", network, precision)


def pick(reasons: Mapping[str, str | None], backend: str, precision: str, field: str) -> tuple[str, str]:
    """Returns a backend's name and a line that reports it.

    `reasons` names for each backend, fastest first, why it cannot run; None: it can.
    Raises: ConfigError if the wanted backend cannot run, or if no backend has this precision.
    """
    running = [name for name, reason in reasons.items() if reason is None]
    if backend not in (*running, "auto", "torch"):
        raise ConfigError(f"{field} must be {' or '.join([*running, 'auto'])} here, got {backend}: {reasons[backend]}")
    chosen = backend if backend in running else running[0] if running and backend == "auto" else None
    first = next(iter(reasons))
    if chosen is None:
        cause = f"{field}=torch was requested" if backend == "torch" else f"{first}: {reasons[first]}"
        raise ConfigError(f"precision must be tf32 or fp32 on backend torch, got {precision}; {cause}")
    because = f" (not {first}: {reasons[first]})" if backend == "auto" and chosen != first else ""
    where = field.rpartition(".")[0] or "runtime"
    return chosen, f"{where} backend: {chosen}{because}"


def torch_unsupported_reason(precision: str) -> str | None:
    """Returns why PyTorch cannot compute a network, or None."""
    return "it does not support fp16" if precision == "fp16" else None


def cpu_unsupported_reason(device: torch.device, config: NetworkConfig, precision: str) -> str | None:
    """Returns why backend cpu cannot compute a network, or None."""
    if device.type != "cpu":
        return f"it needs the CPU, not {device.type}"
    if config.kind != "hgn":
        return f"it computes hgn networks, not {config.kind}"
    return "it computes only in float32" if precision == "fp16" else None


def triton_unsupported_reason(device: torch.device, config: NetworkConfig, precision: str = "auto") -> str | None:
    """Returns why backend triton cannot simulate a network, or None."""
    if device.type != "cuda":
        return f"it needs a CUDA device, not {device.type}"
    if reason := host_unsupported_reason() or _too_little_shared_memory(device, config.width):
        return reason
    if config.kind != "hgn":
        return f"it computes hgn networks, not {config.kind}"
    if config.width not in TRITON_WIDTHS:
        return f"network.width must be one of {', '.join(map(str, TRITON_WIDTHS))} for it, not {config.width}"
    if precision == "fp32":
        return "it computes in tf32 or fp16, not fp32"
    if config.levels > TRITON_LEVELS:
        return f"network.levels must be at most {TRITON_LEVELS} for it, not {config.levels}"
    return None


def _too_little_shared_memory(device: torch.device, width: int) -> str | None:
    """Returns why weights do not fit into shared memory, or None. Kernels keep five float16 matrices in it."""
    needed = shared = 10 * width**2
    if torch.cuda.is_available():
        # torch's own annotations do not contain this name
        shared = getattr(torch.cuda.get_device_properties(device), "shared_memory_per_block_optin", needed)
    if shared < needed:
        return f"its kernels need {needed >> 10} KB of shared memory at width {width}, and this GPU has {shared >> 10}"
    return None


def set_matmul_precision(precision: str) -> None:
    """Sets the precision of PyTorch's float32 products: full with fp32, else TF32 on a GPU."""
    torch.set_float32_matmul_precision("highest" if precision == "fp32" else "high")
