"""The network's parameters in one flat buffer, each MLP a contiguous block that the kernels can read in whole tiles.

Block of an MLP: the first layer's wide parts, each [hidden, part] row-major; its narrow parts (offsets), each
transposed to [part, hidden]; bias; second layer [out, hidden]; its bias; the norm's gain and shift.
An output of 3 is padded with zero rows to PADDED_OUT. Padding never receives a gradient.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from hgn.network.hgn import HierarchicalGraphNetwork, MessagePassing
from hgn.network.mlp import MLP

NARROW = 8  # parts of fewer columns are offsets
PADDED_OUT = 16


@dataclass(frozen=True)
class PackedFCN:
    """Offsets of an MLP's tensors in the flat buffer, in elements."""

    parts: tuple[int, ...]
    first_bias: int
    second: int
    second_bias: int
    gain: int  # 0 without a norm
    shift: int
    out: int


@dataclass(frozen=True)
class PackedMessagePassing:
    edge: tuple[PackedFCN, ...]
    cell: tuple[PackedFCN, ...]


@dataclass(frozen=True)
class PackedNetwork:
    """Where everything is. `index` (int32, on the host) maps packed elements to the concatenated parameters, -1 for
    padding."""

    encode: PackedFCN
    particle_to_cell: PackedFCN
    passing_down: tuple[PackedMessagePassing, ...]
    fine_to_coarse: tuple[PackedFCN, ...]
    coarse_to_fine: tuple[PackedFCN, ...]
    passing_up: tuple[PackedMessagePassing, ...]
    cell_to_particle: PackedFCN
    decode: PackedFCN
    embedding: int
    size: int
    index: torch.Tensor

    def gather(self, tensors: list[torch.Tensor]) -> torch.Tensor:
        """Packs tensors shaped as the network's parameters, in their order: float32 [size]."""
        # a zero behind them, which goes to the padding
        zero = torch.zeros(1, device=tensors[0].device)
        flat = torch.cat([*(tensor.detach().reshape(-1).float() for tensor in tensors), zero])
        return flat.index_select(0, self.index.remainder(len(flat)).to(flat.device))

    def scatter(self, packed: torch.Tensor, tensors: list[torch.Tensor]) -> None:
        """The inverse of `gather`, into the tensors."""
        index = self.index.to(packed.device)
        flat = packed.new_empty(sum(tensor.numel() for tensor in tensors))
        flat[index[index >= 0]] = packed[index >= 0]
        with torch.no_grad():
            for tensor, part in zip(tensors, flat.split([t.numel() for t in tensors]), strict=True):
                tensor.copy_(part.view(tensor.shape))


class _Packer:
    def __init__(self, network: HierarchicalGraphNetwork) -> None:
        parameters = list(network.parameters())
        every = torch.arange(sum(parameter.numel() for parameter in parameters), dtype=torch.int32)
        pieces = every.split([parameter.numel() for parameter in parameters])
        self.places = dict(zip(map(id, parameters), pieces, strict=True))
        self.pieces: list[torch.Tensor] = []
        self.size = 0

    def positions(self, parameter: torch.Tensor) -> torch.Tensor:
        return self.places[id(parameter)].view(parameter.shape)

    def add(self, positions: torch.Tensor) -> int:
        offset = self.size
        flat = positions.reshape(-1)
        padding = -len(flat) % 16  # vector loads stay aligned
        self.pieces += [flat, flat.new_full((padding,), -1)]
        self.size += len(flat) + padding
        return offset

    def fcn(self, fcn: MLP, whole_first: bool = False) -> PackedFCN:
        out = max(len(fcn.second.weight), PADDED_OUT)
        missing = out - len(fcn.second.weight)
        first = self.positions(fcn.first.weight)
        parts = [first] if whole_first else list(first.split(fcn.parts, dim=1))
        offsets = [self.add(part.T if part.shape[1] < NARROW else part) for part in parts]
        bias = self.add(self.positions(fcn.first.bias))
        second = self.add(torch.nn.functional.pad(self.positions(fcn.second.weight), (0, 0, 0, missing), value=-1))
        second_bias = self.add(torch.nn.functional.pad(self.positions(fcn.second.bias), (0, missing), value=-1))
        gain = shift = 0
        if fcn.norm is not None:
            gain, shift = self.add(self.positions(fcn.norm.weight)), self.add(self.positions(fcn.norm.bias))
        return PackedFCN(tuple(offsets), bias, second, second_bias, gain, shift, out)

    def fcns(self, modules: torch.nn.ModuleList) -> tuple[PackedFCN, ...]:
        return tuple(self.fcn(module) for module in modules if isinstance(module, MLP))

    def passings(self, modules: torch.nn.ModuleList) -> tuple[PackedMessagePassing, ...]:
        return tuple(
            PackedMessagePassing(self.fcns(module.edge), self.fcns(module.cell))
            for module in modules
            if isinstance(module, MessagePassing)
        )


def pack_network(network: HierarchicalGraphNetwork) -> PackedNetwork:
    """The layout of a network; a pure function of its configuration."""
    packer = _Packer(network)
    encode = packer.fcn(network.encode, whole_first=True)
    particle_to_cell = packer.fcn(network.particle_to_cell)
    down = packer.passings(network.passing_down)
    fine_to_coarse = packer.fcns(network.fine_to_coarse)
    coarse_to_fine = packer.fcns(network.coarse_to_fine)
    up = packer.passings(network.passing_up)
    cell_to_particle = packer.fcn(network.cell_to_particle)
    decode = packer.fcn(network.decode)
    embedding = packer.add(packer.positions(network.embedding.weight))
    return PackedNetwork(
        encode,
        particle_to_cell,
        down,
        fine_to_coarse,
        coarse_to_fine,
        up,
        cell_to_particle,
        decode,
        embedding,
        packer.size,
        torch.cat(packer.pieces),
    )


def rounded_to_tf32(weights: torch.Tensor) -> torch.Tensor:
    """To the nearest that TF32 can hold, as hgn.kernels.blocks.nearest_tf32; contiguous float32."""
    return ((weights.contiguous().view(torch.int32) + 0x1000) & -0x2000).view(torch.float32)
