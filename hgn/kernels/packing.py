"""Packs the network's parameters into one flat buffer. Each MLP is a contiguous block that kernels read in whole tiles.

The block of an MLP holds, in this order: the first layer's wide parts, each [hidden, part] row-major; its narrow parts
(offsets), each transposed to [part, hidden]; its bias; the second layer [out, hidden]; its bias; the LayerNorm's weight
and bias. Zero rows pad an output of 3 or 9 to PADDED_OUT. Padding never receives a gradient.
"""

from dataclasses import dataclass

import torch

from hgn.network.hgn import HierarchicalGraphNetwork, MessagePassing
from hgn.network.mlp import MLP

NARROW = 8  # parts of a first layer with fewer columns than this are narrow; they multiply offsets
PADDED_OUT = 16


@dataclass(frozen=True)
class PackedMLP:
    """Holds the offsets of an MLP's tensors in the flat buffer, in elements."""

    parts: tuple[int, ...]
    first_bias: int
    second: int
    second_bias: int
    norm_weight: int  # 0 without a norm
    norm_bias: int
    out: int

    def layers(self, second_bias: bool = True) -> dict[str, int]:
        """Returns the places of the second layer and of the norm, by the kernels' names."""
        bias = {"second_bias_at": self.second_bias} if second_bias else {}
        norm = {"norm_weight_at": self.norm_weight, "norm_bias_at": self.norm_bias}
        return {"second_at": self.second, **bias, **norm}


@dataclass(frozen=True)
class PackedMessagePassing:
    edge: tuple[PackedMLP, ...]
    cell: tuple[PackedMLP, ...]


@dataclass(frozen=True)
class PackedNetwork:
    """Holds the layout of the buffer. `index` (int32, on the host) maps elements to parameters, -1 for padding."""

    encode: PackedMLP
    particle_to_cell: PackedMLP
    passing_down: tuple[PackedMessagePassing, ...]
    fine_to_coarse: tuple[PackedMLP, ...]
    coarse_to_fine: tuple[PackedMLP, ...]
    passing_up: tuple[PackedMessagePassing, ...]
    cell_to_particle: PackedMLP
    decode: PackedMLP
    embedding: int
    size: int
    index: torch.Tensor

    def gather(self, tensors: list[torch.Tensor]) -> torch.Tensor:
        """Returns float32 [size] packed from tensors with the shapes and order of the network's parameters."""
        # The zero behind the tensors is the value of the padding.
        zero = torch.zeros(1, device=tensors[0].device)
        flat = torch.cat([*(tensor.detach().reshape(-1).float() for tensor in tensors), zero])
        return flat.index_select(0, self.index.remainder(len(flat)).to(flat.device))

    def scatter(self, packed: torch.Tensor, tensors: list[torch.Tensor]) -> None:
        """Copies packed elements into tensors: the inverse of `gather`."""
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
        padding = -len(flat) % 16  # keeps vector loads aligned
        self.pieces += [flat, flat.new_full((padding,), -1)]
        self.size += len(flat) + padding
        return offset

    def mlp(self, mlp: MLP, whole_first: bool = False) -> PackedMLP:
        out = max(len(mlp.second.weight), PADDED_OUT)
        missing = out - len(mlp.second.weight)
        first = self.positions(mlp.first.weight)
        parts = [first] if whole_first else list(first.split(mlp.parts, dim=1))
        offsets = [self.add(part.T if part.shape[1] < NARROW else part) for part in parts]
        bias = self.add(self.positions(mlp.first.bias))
        second = self.add(torch.nn.functional.pad(self.positions(mlp.second.weight), (0, 0, 0, missing), value=-1))
        second_bias = self.add(torch.nn.functional.pad(self.positions(mlp.second.bias), (0, missing), value=-1))
        norm_weight = norm_bias = 0
        if mlp.norm is not None:
            norm_weight, norm_bias = self.add(self.positions(mlp.norm.weight)), self.add(self.positions(mlp.norm.bias))
        return PackedMLP(tuple(offsets), bias, second, second_bias, norm_weight, norm_bias, out)

    def mlps(self, modules: torch.nn.ModuleList) -> tuple[PackedMLP, ...]:
        return tuple(self.mlp(module) for module in modules if isinstance(module, MLP))

    def passings(self, modules: torch.nn.ModuleList) -> tuple[PackedMessagePassing, ...]:
        return tuple(
            PackedMessagePassing(self.mlps(module.edge), self.mlps(module.cell))
            for module in modules
            if isinstance(module, MessagePassing)
        )


def pack_network(network: HierarchicalGraphNetwork) -> PackedNetwork:
    """Returns the layout of a network, which depends only on its configuration."""
    packer = _Packer(network)
    encode = packer.mlp(network.encode, whole_first=True)
    particle_to_cell = packer.mlp(network.particle_to_cell)
    down = packer.passings(network.passing_down)
    fine_to_coarse = packer.mlps(network.fine_to_coarse)
    coarse_to_fine = packer.mlps(network.coarse_to_fine)
    up = packer.passings(network.passing_up)
    cell_to_particle = packer.mlp(network.cell_to_particle)
    decode = packer.mlp(network.decode)
    embedding = packer.add(packer.positions(network.embedding.weight))
    return PackedNetwork(
        encode, particle_to_cell, down, fine_to_coarse, coarse_to_fine, up, cell_to_particle, decode, embedding,
        packer.size, torch.cat(packer.pieces),
    )  # fmt: skip


def rounded_to_tf32(weights: torch.Tensor) -> torch.Tensor:
    """Returns the nearest TF32 numbers (hgn.kernels.blocks.nearest_tf32), contiguous float32."""
    return ((weights.contiguous().view(torch.int32) + 0x1000) & -0x2000).view(torch.float32)
