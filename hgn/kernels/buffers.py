"""Allocates the buffers of the network's launches. In inference, results that are never needed together share buffers.

Shape legend: N particles, C cells, W width.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import torch

from hgn.config import NetworkConfig
from hgn.kernels.grid.op import SUMS, DeviceGrid
from hgn.kernels.packing import PackedMessagePassing, PackedNetwork
from hgn.kernels.tuning import Tuning

OUT = SUMS  # three outputs of the decoder, or nine with relative inputs, padded


class Stored(NamedTuple):
    """Holds buffers for the backward pass under the kernel's argument names. One that is not written has any shape."""

    hidden: torch.Tensor  # [R, W]; the rows R are pairs [8 N], edges [C, 6] or cells [C]
    normalised: torch.Tensor  # [R, W]
    rstd: torch.Tensor  # one over the standard deviation, float32 [R]


@dataclass
class Block:
    """Holds a message-passing block: its level, its weights, and its buffers as lists over its steps."""

    level: int
    packed: PackedMessagePassing
    cell: list[torch.Tensor] = field(default_factory=list)  # M + 1 tensors [C, W]
    edge: list[torch.Tensor] = field(default_factory=list)  # M - 1 tensors [C, 6, W]
    edge_stored: list[Stored] = field(default_factory=list)
    sum: list[torch.Tensor] = field(default_factory=list)
    cell_stored: list[Stored] = field(default_factory=list)
    send: list[torch.Tensor] = field(default_factory=list)  # two that alternate; in inference twice the same one
    receive: list[torch.Tensor] = field(default_factory=list)
    product: torch.Tensor | None = None  # product of the block's output, for the next step
    next_at: int = 0  # place of the weights of that product


class Buffers:
    """Holds the buffers of a network. `down` and `up` are the message-passing blocks, finest level first.
    Messages to parents and hidden layers of the steps between levels are lists over the finer level. Inference may
    share buffers, because no kernel accesses them before all earlier kernels have ended."""

    config: NetworkConfig
    packed: PackedNetwork
    grid: DeviceGrid
    tuning: Tuning
    training: bool
    width: int
    operand: torch.dtype
    device: torch.device

    latent: torch.Tensor  # [N, W], as all tensors without another shape
    by_particle_down: torch.Tensor
    by_particle_up: torch.Tensor
    decoder_input: torch.Tensor
    output: torch.Tensor  # float32 [N, OUT]
    message: list[torch.Tensor]  # messages to the parents [C, W]
    encode_hidden: torch.Tensor
    decode_hidden: torch.Tensor
    transfer_hidden_down: list[torch.Tensor]
    transfer_hidden_up: list[torch.Tensor]
    pairs_down: Stored
    pairs_up: Stored
    down: list[Block]
    up: list[Block]

    def _operand(self, *shape: int) -> torch.Tensor:
        return torch.zeros(shape, dtype=self.operand, device=self.device)

    def _float(self, *shape: int) -> torch.Tensor:
        return torch.zeros(shape, device=self.device)

    def _stored(self, *rows: int) -> Stored:
        return Stored(self._operand(*rows, self.width), self._operand(*rows, self.width), self._float(*rows))

    def _cell(self, *shape: int) -> torch.Tensor:
        return self._operand(*shape) if self.tuning.half_cells else self._float(*shape)

    def _first_cell(self, *shape: int) -> torch.Tensor:
        """Returns the input of the first block, to which atomics add. In training rounded sums would cost precision."""
        return self._cell(*shape) if self.tuning.half_sums and not self.training else self._float(*shape)

    def _allocate(self, stores_pair_hidden: bool) -> None:
        packed, levels = self.packed, self.config.levels
        self.down = [Block(i, packed.passing_down[i]) for i in range(levels)]
        self.up = [Block(i, packed.passing_up[i]) for i in range(levels - 1)]
        for i in range(levels):
            into = packed.cell_to_particle if i == 0 else packed.coarse_to_fine[i - 1]
            self._last(i).next_at = into.parts[0]
        self.latent = self._operand(self.grid.particles, self.width)
        self.by_particle_up = self._operand(self.grid.particles, self.width)
        pairs = 8 * self.grid.particles if self.training else 1
        hidden = pairs if stores_pair_hidden else 1
        self.pairs_down, self.pairs_up = (
            Stored(self._operand(hidden, self.width), self._operand(pairs, self.width), self._float(pairs))
            for _ in range(2)
        )
        if self.training:
            self._allocate_training()
        else:
            self._allocate_inference()

    def _last(self, level: int) -> Block:
        """Returns the last block on a level."""
        return self.down[level] if level == self.config.levels - 1 else self.up[level]

    def _allocate_training(self) -> None:
        width, steps = self.width, self.config.message_passing_steps
        particles, capacities = self.grid.particles, self.grid.capacities
        self.by_particle_down, self.decoder_input = (self._operand(particles, width) for _ in range(2))
        self.encode_hidden, self.decode_hidden = (self._operand(particles, width) for _ in range(2))
        self.output = self._float(particles, OUT)
        self.message, self.transfer_hidden_down, self.transfer_hidden_up = (
            [self._operand(capacity, width) for capacity in capacities[:-1]] for _ in range(3)
        )
        for block in (*self.down, *self.up):
            capacity = capacities[block.level]
            start = self._first_cell if block is self.down[0] else self._cell
            block.send, block.receive = ([self._operand(capacity, width) for _ in range(2)] for _ in range(2))
            block.cell = [start(capacity, width)] + [self._cell(capacity, width) for _ in range(steps)]
            block.edge = [self._operand(capacity, 6, width) for _ in range(steps - 1)]
            block.edge_stored = [self._stored(capacity, 6) for _ in range(steps)]
            block.sum = [self._operand(capacity, width) for _ in range(steps)]
            block.cell_stored = [self._stored(capacity) for _ in range(steps)]
        for level, capacity in enumerate(capacities):
            self._last(level).product = self._operand(capacity, width)

    def _allocate_inference(self) -> None:
        """Allocates the buffers of inference. All edges share one buffer, and hidden rows are not stored.

        While there are no edges, this buffer contains other data: the particles' products until the first pairs read
        them; a block's message to the parents, or its product for the next block, until the next block's edges; and the
        decoder's input, behind the last product. `output` takes the memory of the features, which the encoder has read.
        """
        width, steps = self.width, self.config.message_passing_steps
        particles, capacities = self.grid.particles, self.grid.capacities
        finest = capacities[0]
        shared = self._operand(max(6 * finest, finest + particles), width)
        self.by_particle_down = shared[:particles]
        self.decoder_input = shared[finest : finest + particles]
        self.output = self.grid.feature_NF.view(-1)[: particles * OUT].view(particles, OUT)
        self.message = [shared[:capacity] for capacity in capacities[:-1]]
        self.encode_hidden = self.decode_hidden = self.latent
        self.transfer_hidden_down = self.transfer_hidden_up = self.message
        for level, capacity in enumerate(capacities):
            send, receive, total = (self._operand(capacity, width) for _ in range(3))
            # The steps of a block write these two in turn. `coarse_to_fine` reads again the last one that the block on
            # the way down wrote. So the block on the way up begins with the other one.
            cells = [self._cell(capacity, width) for _ in range(2)]
            blocks = [(self.down[level], cells)]
            if level < self.config.levels - 1:
                blocks.append((self.up[level], [cells[(steps + 1) % 2], cells[steps % 2]]))
            for block, turns in blocks:
                block.send, block.receive = [send] * 2, [receive] * 2
                block.sum = [total] * steps
                block.cell = [turns[m % 2] for m in range(steps + 1)]
                block.edge = [shared[: 6 * capacity].view(capacity, 6, width)] * (steps - 1)
                block.edge_stored = block.cell_stored = [Stored(send, send, total)] * steps
            self._last(level).product = shared[:capacity]
        if self.tuning.half_cells and not self.tuning.half_sums:
            self.down[0].cell[0] = self._first_cell(finest, width)
