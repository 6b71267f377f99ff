"""Muon (Jordan 2024): hidden matrices step along their orthogonalised momentum; other parameters step as in Adam."""

from collections.abc import Callable
from typing import Any

import torch

from hgn.network.base import ParticleNetwork
from hgn.network.orthogonal import MOMENTUM, normalised, orthogonalised, square_blocks, step_size


class Muon(torch.optim.Adam):
    """torch.optim.Adam whose square blocks (hgn.network.orthogonal) take Muon's step instead, with Nesterov's momentum.

    `exp_avg` of a block contains its momentum. Its `exp_avg_sq` is not used.
    """

    def __init__(self, network: ParticleNetwork, lr: float) -> None:
        super().__init__(network.parameters(), lr=lr, fused=True)
        device = next(network.parameters()).device
        self._block_KWW = square_blocks(network).to(device)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        block_KWW = self._block_KWW
        parameters = self.param_groups[0]["params"]
        value_KWW = _flat(parameters)[block_KWW]
        momentum_KWW = torch.zeros_like(value_KWW)
        if self.state:
            momentum_KWW = _flat([self.state[parameter]["exp_avg"] for parameter in parameters])[block_KWW]
        super().step()
        gradient_KWW = _flat([parameter.grad for parameter in parameters])[block_KWW]
        stepped_KWW = torch.lerp(momentum_KWW, gradient_KWW, 1 - MOMENTUM)
        direction_KWW = orthogonalised(normalised(torch.lerp(stepped_KWW, gradient_KWW, 1 - MOMENTUM)))
        rate, size = self.param_groups[0]["lr"], step_size(block_KWW.shape[-1])
        moved_KWW = value_KWW - rate * (size * direction_KWW)
        skip = getattr(self, "found_inf", None)  # fused Adam reads the same attribute
        if skip is not None:
            stepped_KWW = torch.where(skip > 0, momentum_KWW, stepped_KWW)
            moved_KWW = torch.where(skip > 0, value_KWW, moved_KWW)
        _write(parameters, block_KWW, moved_KWW)
        _write([self.state[parameter]["exp_avg"] for parameter in parameters], block_KWW, stepped_KWW)
        return loss


def _flat(tensors: list[torch.Tensor]) -> torch.Tensor:
    return torch.cat([tensor.reshape(-1) for tensor in tensors])


def _write(tensors: list[torch.Tensor], places: torch.Tensor, values: torch.Tensor) -> None:
    flat = _flat(tensors)
    flat[places] = values
    for tensor, part in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
        tensor.copy_(part.view(tensor.shape))
