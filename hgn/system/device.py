"""Chooses the device on which a command computes."""

import os

import torch

from hgn.schema import ConfigError
from hgn.system.machine import available_cpus


def choose_device(name: str) -> torch.device:
    """Returns a torch device. `auto` is CUDA if it is available; other names are torch's (cpu, cuda, cuda:1).

    Limits CPU threads to a container's quota. Raises ConfigError if the device does not exist.
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
    """Limits PyTorch's threads to a container's CPU quota. Above the quota the system would slow all threads.

    A value of OMP_NUM_THREADS takes precedence.
    """
    if "OMP_NUM_THREADS" not in os.environ and available_cpus() < torch.get_num_threads():
        torch.set_num_threads(available_cpus())
