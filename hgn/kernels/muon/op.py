"""Launches Muon's steps on the packed weights. Shape legend: K blocks, W width."""

import torch

from hgn.kernels.muon.kernel import momentum_directions, step_blocks
from hgn.network.base import ParticleNetwork
from hgn.network.orthogonal import EPSILON, MOMENTUM, orthogonalised, square_blocks, step_size

WARPS = 8


def direction_dtype(device: torch.device) -> torch.dtype:
    """Returns the type of the directions, bfloat16 on a GPU. Products are summed in float32.
    In any type the iterations make the directions orthogonal only to about 0.01."""
    return torch.float32 if device.type == "cpu" else torch.bfloat16


class SquareBlocks:
    """Holds the places, in the packed layout, of the weights that Muon updates. A block's rows are equally spaced."""

    def __init__(self, network: ParticleNetwork, index: torch.Tensor, device: torch.device) -> None:
        """`index` maps packed elements to the concatenated parameters, -1 for padding."""
        block_KWW = square_blocks(network)
        place = torch.empty(int(index.max()) + 1, dtype=torch.int64)
        used = index >= 0
        place[index[used]] = torch.nonzero(used).flatten()
        packed_KWW, column_W = place[block_KWW], torch.arange(block_KWW.shape[-1])
        self.starts = packed_KWW[:, 0, 0].int().to(device)
        self.pitch = (packed_KWW[:, 1, 0] - packed_KWW[:, 0, 0]).int().to(device)
        row_KW = packed_KWW[:, :1, 0] + column_W * (packed_KWW[:, 1, 0] - packed_KWW[:, 0, 0])[:, None]
        assert (packed_KWW == row_KW[:, :, None] + column_W).all()
        member = torch.zeros(len(index), dtype=torch.int8)
        member[packed_KWW.flatten()] = 1
        self.member = member.to(device)  # 1 for elements of the packed buffers that Muon updates
        self._direction_KWW = torch.zeros(block_KWW.shape, dtype=direction_dtype(device), device=device)

    def step(
        self,
        values: torch.Tensor,
        weights: torch.Tensor,
        momentum: torch.Tensor,
        gradient: torch.Tensor,
        rank_weight: float,
        rates: torch.Tensor,
        update: torch.Tensor,
        status: torch.Tensor,
        norm: torch.Tensor,
        precision: str,
    ) -> None:
        """Moves the blocks of `values` and of the copy `weights`; hgn.kernels.update.kernel.adam moves the rest.
        `rank_weight` times `gradient` is added to `momentum`."""
        count, width, _ = self._direction_KWW.shape
        momentum_directions[(count,)](
            starts=self.starts, pitch=self.pitch, gradient=gradient, rank_weight=rank_weight, first_moment=momentum,
            direction=self._direction_KWW, status=status, norm=norm, momentum=MOMENTUM, epsilon=EPSILON,
            WIDTH=width, num_warps=WARPS,
        )  # fmt: skip
        step_blocks[(count,)](
            starts=self.starts, pitch=self.pitch, direction=orthogonalised(self._direction_KWW), value=values,
            weight=weights, rates=rates, update=update, status=status, norm=norm, step_size=step_size(width),
            PRECISION=precision, WIDTH=width, num_warps=WARPS,
        )  # fmt: skip
