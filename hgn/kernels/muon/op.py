"""Muon's steps on the packed weights. Shape legend: K blocks, W width, E elements of a block."""

from __future__ import annotations

import torch

from hgn.kernels.muon.kernel import momentum_directions, step_blocks
from hgn.kernels.packing import PackedNetwork
from hgn.network.network import HierarchicalGraphNetwork
from hgn.network.orthogonal import EPSILON, MOMENTUM, orthogonalised, square_blocks, step_size

WARPS = 8


class SquareBlocks:
    """The weights that Muon steps, in the packed layout, where each block is one piece."""

    def __init__(self, network: HierarchicalGraphNetwork, packed: PackedNetwork, device: torch.device) -> None:
        block_KWW = square_blocks(network)
        place = torch.empty(int(packed.index.max()) + 1, dtype=torch.int64)
        used = packed.index >= 0
        place[packed.index[used]] = torch.nonzero(used).flatten()
        packed_KE = place[block_KWW].flatten(1)
        assert (packed_KE == packed_KE[:, :1] + torch.arange(packed_KE.shape[1])).all()
        member = torch.zeros(packed.size, dtype=torch.int8)
        member[packed_KE] = 1
        self.starts = packed_KE[:, 0].contiguous().to(device)
        self.member = member.to(device)  # of each element of the packed buffers: whether it is stepped here
        # orthogonal to a hundredth, as the iterations are: products in bfloat16, summed in float32
        dtype = torch.float32 if device.type == "cpu" else torch.bfloat16
        self._direction_KWW = torch.zeros(block_KWW.shape, dtype=dtype, device=device)

    def step(
        self,
        values: torch.Tensor,
        weights: torch.Tensor,
        momentum: torch.Tensor,
        gradient: torch.Tensor,
        share: float,
        rates: torch.Tensor,
        update: torch.Tensor,
        status: torch.Tensor,
        norm: torch.Tensor,
        precision: str,
    ) -> None:
        """Moves the blocks of `values` and of their rounded copy `weights`, where hgn.kernels.update.kernel.adam moves
        the rest; `share` times `gradient` goes into `momentum`.
        """
        count, width, _ = self._direction_KWW.shape
        momentum_directions[(count,)](
            self.starts,
            gradient,
            share,
            momentum,
            self._direction_KWW,
            status,
            norm,
            MOMENTUM,
            EPSILON,
            WIDTH=width,
            num_warps=WARPS,
        )
        step_blocks[(count,)](
            self.starts,
            orthogonalised(self._direction_KWW),
            values,
            weights,
            rates,
            update,
            status,
            norm,
            step_size(width),
            PRECISION=precision,
            WIDTH=width,
            num_warps=WARPS,
        )
