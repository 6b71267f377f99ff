"""The rule for divergence of a simulation, for all backends and for pushforward."""

import torch

from hgn.step.reference import within_range


class DivergedError(RuntimeError):
    """Particles are not finite, or farther from the domain than its own size."""

    def __init__(self, frame: int, cause: str) -> None:
        super().__init__(f"the simulation diverged at frame {frame}: {cause}; train further, or use other weights")
        self.frame, self.cause = frame, cause


def diverged(position_N3: torch.Tensor, domain_N3: torch.Tensor) -> torch.Tensor:
    """Returns which particles are not finite or farther from the domain than its own size, bool [..., N]."""
    return ~within_range(position_N3, domain_N3).all(-1)


def describe_diverged(diverged_count: int, particle_count: int) -> str:
    """Describes a divergence."""
    return f"{diverged_count} of {particle_count} particles are not finite or farther from the domain than its own size"
