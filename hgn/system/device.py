"""Choosing the device a command computes on."""

from __future__ import annotations

import os

import torch

from hgn.schema import ConfigError
from hgn.system.machine import available_cpus


def choose_device(name: str) -> torch.device:
    """`auto` takes a CUDA device where there is one; otherwise torch's names (cpu, cuda, cuda:1).

    What stays on the CPU keeps to a container's quota from now on. Raises: ConfigError when the device does not exist.
    """
    keep_to_quota()
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ConfigError(f"device must be auto, cpu or cuda[:index], got {name!r}") from None
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise ConfigError(f"device must exist, got {name!r} with {torch.cuda.device_count()} CUDA devices; take cpu")
    return device


def keep_to_quota() -> None:
    """No more of PyTorch's threads than a container's quota has cores: beyond it all of them are held back together.

    OMP_NUM_THREADS, where it is set, is what somebody wants.
    """
    if "OMP_NUM_THREADS" not in os.environ and available_cpus() < torch.get_num_threads():
        torch.set_num_threads(available_cpus())
