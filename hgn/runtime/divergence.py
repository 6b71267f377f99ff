"""When a simulation has come apart: one rule for both paths, and for training on the network's own states."""

from __future__ import annotations

import torch


def lost(position_N3: torch.Tensor, domain_N3: torch.Tensor) -> torch.Tensor:
    """Which particles are not finite or farther from the domain than its own size, bool [..., N]."""
    inside = (position_N3 > -domain_N3) & (position_N3 < 2 * domain_N3)  # NaN is outside
    return ~inside.all(-1)
