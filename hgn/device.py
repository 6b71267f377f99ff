"""Choosing the device a command computes on."""

from __future__ import annotations

import torch

from hgn.schema import ConfigError


def choose_device(name: str) -> torch.device:
    """`auto` takes a CUDA device where there is one; otherwise torch's names (cpu, cuda, cuda:1).

    Raises: ConfigError when the device does not exist.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ConfigError(f"device must be auto, cpu or cuda[:index], got {name!r}") from None
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise ConfigError(f"device must exist, got {name!r} with {torch.cuda.device_count()} CUDA devices; take cpu")
    return device
