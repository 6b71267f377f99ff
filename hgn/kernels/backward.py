"""Launches the backward pass of the fused network in the reverse order of the forward pass.

At the end one launch for each type of operand and size of chunk computes weight gradients.

Shape legend: N particles, C cells, W width.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from hgn.config import MATERIAL_EMBEDDING
from hgn.kernels.buffers import OUT, Block, Stored
from hgn.kernels.cell_mlp.kernel import cell_mlp_backward
from hgn.kernels.edges.kernel import edge_backward
from hgn.kernels.forward import FusedNetwork
from hgn.kernels.grid.op import DeviceGrid, own_physics_column
from hgn.kernels.mlp.kernel import gather_project_backward, mlp_backward
from hgn.kernels.packing import PackedMLP, PackedNetwork
from hgn.kernels.particle_cell.kernel import particle_cell_backward, particle_cell_weight_gradient
from hgn.kernels.triton_compat import interpreting
from hgn.kernels.tuning import Tuning, many
from hgn.kernels.weight_gradient.kernel import JOB_COLUMNS, weight_gradient

CHUNK_ROWS = (512, 2048)  # rows of a program of the weight gradients: for few rows, and for at least MANY_ROWS
MANY_ROWS = 16384


@dataclass(frozen=True)
class MLPGradients:
    """Holds the gradients of an MLP's hidden layer before its activation, and of the output of its second layer."""

    hidden: torch.Tensor
    output: torch.Tensor


@dataclass(frozen=True)
class PairGradients:
    """Holds the gradients of the pairs' second layer [8 N, W], and of the particles' part of the first layer [N, W]."""

    output: torch.Tensor
    by_particle: torch.Tensor


@dataclass(frozen=True)
class StepGradients:
    """Holds gradients of a message passing step: edge MLP [C, 6, W], cell MLP, and cells' products for edges [C, W]."""

    edge: MLPGradients
    cell: MLPGradients
    send: torch.Tensor
    receive: torch.Tensor


@dataclass(frozen=True)
class Gradients:
    """Holds the gradients of activations that the weight gradients read. Lists are over levels, finest first."""

    encode: MLPGradients
    decode: MLPGradients
    particle_to_cell: PairGradients
    cell_to_particle: PairGradients
    down: list[list[StepGradients]]
    up: list[list[StepGradients]]
    product: list[torch.Tensor]  # gradient of the product that each level's last block gives to the next launch [C, W]
    fine_to_coarse: list[MLPGradients]
    coarse_to_fine: list[MLPGradients]


class FusedTrainingNetwork(FusedNetwork):
    """Adds the backward pass, which writes gradients to `totals`, float32, laid out as `values`."""

    def __init__(
        self,
        packed: PackedNetwork,
        values: torch.Tensor,
        grid: DeviceGrid,
        particle_count: torch.Tensor,
        precision: str,
        loss_scale: float = 1.0,
        tuning: Tuning | None = None,
        tail: int = 0,
    ) -> None:
        """Expects `output_gradient` times `loss_scale`, which float16 gradients need. `totals` are divided by it.

        At its end `totals` has the gradient of the encoder's combined first layer, and `tail` elements for callers.
        """
        super().__init__(packed, values, grid, particle_count, precision, True, tuning)
        self.unscale, self.copy_precision = 1.0 / loss_scale, precision
        self._allocate_gradients(tail)

    def _allocate_gradients(self, tail: int) -> None:
        width, grid = self.width, self.grid
        particles, capacities = grid.particles, grid.capacities
        self.totals = self._float(self.packed.size + width * grid.features + tail)
        self.output_gradient = self._float(particles, OUT)
        self.latent_gradient = self._float(particles, width)
        # The pairs add to these gradients of the cells' products.
        self.product_gradient = (self._operand if self.tuning.half_sums else self._float)(capacities[0], width)
        self.cell_gradient_up = [self._float(c, width) for c in capacities]
        self.cell_gradient_down = [self._float(c, width) for c in capacities]
        self.edge_gradient = self._operand(capacities[0], 6, width)
        self.sum_gradient = self._operand(capacities[0], width)
        # One arena holds all operands of weight gradients, so that one launch can address all of them.
        sizes: list[int] = []

        def noted(*shape: int) -> torch.Tensor:
            sizes.append(math.prod(shape))
            return torch.empty(0)

        self._gradients(noted)
        self.left = self._operand(sum(sizes))
        views = iter(self.left.split(sizes))
        self.g = self._gradients(lambda *shape: next(views).view(shape))
        self._plan_weight_gradients()

    def _gradients(self, take: Callable[..., torch.Tensor]) -> Gradients:
        """Returns all gradients from which weight gradients are computed. `take` makes a tensor of a shape."""
        width, grid, steps = self.width, self.grid, self.config.message_passing_steps
        particles, capacities = grid.particles, grid.capacities

        def mlp(count: int, out: int = width) -> MLPGradients:
            return MLPGradients(take(count, width), take(count, out))

        def pairs() -> PairGradients:
            return PairGradients(take(8 * particles, width), take(particles, width))

        def step(count: int) -> StepGradients:
            edge = MLPGradients(take(count, 6, width), take(count, 6, width))
            return StepGradients(edge, mlp(count), take(count, width), take(count, width))

        return Gradients(
            encode=mlp(particles),
            decode=mlp(particles, OUT),
            particle_to_cell=pairs(),
            cell_to_particle=pairs(),
            down=[[step(count) for _ in range(steps)] for count in capacities],
            up=[[step(count) for _ in range(steps)] for count in capacities[:-1]],
            product=[take(count, width) for count in capacities],
            fine_to_coarse=[mlp(count) for count in capacities[:-1]],
            coarse_to_fine=[mlp(count) for count in capacities[:-1]],
        )

    def _plan_weight_gradients(self) -> None:
        packed, grid = self.packed, self.grid
        particles = grid.levels  # index of the number of particles in `counts`
        self.counts = torch.zeros(grid.levels + 1, dtype=torch.int32, device=self.device)
        jobs: list[tuple[torch.Tensor, torch.Tensor, int, int, int, int]] = []

        def job(
            left: torch.Tensor, right: torch.Tensor, at: int, count: int, bias: int = -1, multiple: int = 1
        ) -> None:
            jobs.append((left, right, at, count, bias, multiple))

        g = self.g
        pair, back = packed.particle_to_cell, packed.cell_to_particle
        job(g.encode.hidden, grid.feature_NF, packed.size, particles)
        job(g.encode.output, self.encode_hidden, packed.encode.second, particles, packed.encode.second_bias)
        job(g.decode.hidden, self.decoder_input, packed.decode.parts[0], particles, packed.decode.first_bias)
        job(g.decode.output, self.decode_hidden, packed.decode.second, particles, packed.decode.second_bias)
        job(g.particle_to_cell.by_particle, self.latent, pair.parts[0], particles, pair.first_bias)
        job(g.cell_to_particle.by_particle, self.latent, back.parts[1], particles, back.first_bias)
        if self.stores_pair_hidden():
            job(g.particle_to_cell.output, self.pairs_down.hidden, pair.second, particles, pair.second_bias, 8)
            job(g.cell_to_particle.output, self.pairs_up.hidden, back.second, particles, back.second_bias, 8)
        blocks = [*zip(self.down, self.g.down, strict=True), *zip(self.up, self.g.up, strict=True)]
        for block, gradients in blocks:
            for m, step in enumerate(gradients):
                edge, cell = block.packed.edge[m], block.packed.cell[m]
                job(step.edge.output, block.edge_stored[m].hidden, edge.second, block.level, edge.second_bias)
                if m > 0:
                    job(step.edge.hidden, block.edge[m - 1], edge.parts[2], block.level)
                job(step.send, block.cell[m], edge.parts[0], block.level)
                job(step.receive, block.cell[m], edge.parts[1], block.level, edge.first_bias)
                job(step.cell.hidden, block.cell[m], cell.parts[0], block.level, cell.first_bias)
                job(step.cell.hidden, block.sum[m], cell.parts[1], block.level)
                job(step.cell.output, block.cell_stored[m].hidden, cell.second, block.level, cell.second_bias)
        for i in range(grid.levels):
            block = self.down[i] if i == grid.levels - 1 else self.up[i]
            job(g.product[i], block.cell[-1], block.next_at, i)
        for i in range(grid.levels - 1):
            down, up = packed.fine_to_coarse[i], packed.coarse_to_fine[i]
            job(g.fine_to_coarse[i].hidden, self.down[i].cell[-1], down.parts[0], i, down.first_bias)
            job(g.fine_to_coarse[i].output, self.transfer_hidden_down[i], down.second, i, down.second_bias)
            job(g.coarse_to_fine[i].hidden, self.down[i].cell[-1], up.parts[1], i, up.first_bias)
            job(g.coarse_to_fine[i].output, self.transfer_hidden_up[i], up.second, i, up.second_bias)
        self._weight_jobs = []
        for dtype, chunk in itertools.product(dict.fromkeys((torch.float32, self.operand)), CHUNK_ROWS):
            alike = [entry for entry in jobs if chunk == CHUNK_ROWS[_rows(entry[0]) >= MANY_ROWS]]
            mine = [entry for entry in alike if entry[1].dtype == dtype]
            if not mine:
                continue
            # Offsets count from the lowest address. Allocations are aligned to far more than one element.
            base = min((right for _, right, *_ in mine), key=lambda tensor: tensor.data_ptr())
            rows: list[list[int]] = []
            chunk_job: list[int] = []
            chunk_first: list[int] = []
            for left, right, at, count, bias, multiple in mine:
                rows_held = _rows(left)
                multiple = 6 if left.dim() == 3 else multiple
                left_at = (left.data_ptr() - self.left.data_ptr()) // left.element_size()
                right_at = (right.data_ptr() - base.data_ptr()) // right.element_size()
                row = [left_at, right_at, at, count, left.shape[-1], right.shape[-1], multiple, bias]
                assert len(row) == JOB_COLUMNS and left_at % 16 == right_at % 16 == at % 16 == 0
                starts = range(0, rows_held, chunk)
                chunk_job += [len(rows)] * len(starts)
                chunk_first += list(starts)
                rows.append(row)
            tables = [(rows, torch.int64), (chunk_job, torch.int32), (chunk_first, torch.int32)]
            on_device = [torch.tensor(table, dtype=kind, device=self.device) for table, kind in tables]
            self._weight_jobs.append((chunk, base, *on_device))

    def backward(self) -> None:
        """Computes `totals` from `output_gradient` [N, OUT], which includes the loss scale."""
        packed, grid, g, levels = self.packed, self.grid, self.g, self.config.levels
        self.totals.zero_()
        self._clear(self.product_gradient)
        self.counts[: grid.levels].copy_(grid.counts_L)
        self.counts[grid.levels :].copy_(self.particle_count)
        if self.config.relative:
            grid.balance_backward(self.output_gradient, self.particle_count)
        self._mlp_backward(
            packed.decode, self.output_gradient, self.particle_count, self.decode_hidden, g.decode.hidden,
            g.decode.output, into=(self.latent_gradient, 1), norm=False,
        )  # fmt: skip
        top = self.up[0] if levels > 1 else self.down[0]
        assert top.product is not None
        self._particle_cell_backward(
            packed.cell_to_particle, self.latent_gradient, self.by_particle_up, top.product, self.pairs_up,
            g.cell_to_particle.output, g.cell_to_particle.by_particle, self.product_gradient, False,
        )  # fmt: skip
        self._gather_backward(
            0, self.product_gradient, grid.children(0), 0, top.next_at, g.product[0], self._gradient_of(top)
        )
        for i in range(levels - 1):
            block, mlp = self.up[i], packed.coarse_to_fine[i]
            self._passing_backward(block, g.up[i])
            self._mlp_backward(
                mlp, self.cell_gradient_up[i], grid.count(i), self.transfer_hidden_up[i],
                g.coarse_to_fine[i].hidden, g.coarse_to_fine[i].output, first_at=mlp.parts[1],
                offset=(mlp.parts[2], -1), octant=grid.octant(i), into=(self.cell_gradient_down[i], 1),
                residual=True,
            )  # fmt: skip
            coarse = self.up[i + 1] if i + 1 < levels - 1 else self.down[-1]
            self._gather_backward(
                i + 1, g.coarse_to_fine[i].hidden, grid.children(i + 1), 8, coarse.next_at, g.product[i + 1],
                self._gradient_of(coarse),
            )  # fmt: skip
        for i in reversed(range(levels)):
            if i < levels - 1:
                mlp = packed.fine_to_coarse[i]
                self._mlp_backward(
                    mlp, self.cell_gradient_down[i + 1], grid.count(i), self.transfer_hidden_down[i],
                    g.fine_to_coarse[i].hidden, g.fine_to_coarse[i].output, gradient_index=grid.parent(i),
                    offset=(mlp.parts[1], 1), octant=grid.octant(i), into=(self.cell_gradient_down[i], 2),
                )  # fmt: skip
            self._passing_backward(self.down[i], g.down[i])
        self._particle_cell_backward(
            packed.particle_to_cell, self.cell_gradient_down[0], self.by_particle_down, self.by_particle_down,
            self.pairs_down, g.particle_to_cell.output, g.particle_to_cell.by_particle, self.product_gradient,
            True,
        )  # fmt: skip
        self._mlp_backward(
            packed.encode, self.latent_gradient, self.particle_count, self.encode_hidden, g.encode.hidden,
            g.encode.output, following=(packed.particle_to_cell.parts[0], packed.cell_to_particle.parts[1]),
            products=(g.particle_to_cell.by_particle, g.cell_to_particle.by_particle),
        )  # fmt: skip
        rows = 128 if interpreting() else 64 if self.precision == "fp16" else 32  # the interpreter needs large steps
        for chunk, base, jobs, chunk_job, chunk_first in self._weight_jobs:
            weight_gradient[(len(chunk_job),)](
                left=self.left, right=base, totals=self.totals, jobs=jobs, chunk_job=chunk_job,
                chunk_first=chunk_first, counts=self.counts, unscale=self.unscale,
                TILE=max(self.width, grid.features, OUT), CHUNK=chunk, STEP=rows,
                PRECISION=self.precision, PIPELINED=not interpreting(), num_warps=8,
                maxnreg=self.tuning.weight_registers,
            )  # fmt: skip
        self._encode_gradients()

    def _gradient_operands(self) -> dict[str, Any]:
        return self._operands() | {"totals": self.totals, "unscale": self.unscale}

    def _gradient_of(self, block: Block) -> torch.Tensor:
        """Returns the buffer of a block. It first contains the gradient of the block's output, then of its input."""
        down = any(block is other for other in self.down)
        return (self.cell_gradient_down if down else self.cell_gradient_up)[block.level]

    def _encode_gradients(self) -> None:
        """Splits the gradient of the encoder's combined first layer into features, embedding and bias."""
        config, width, own = self.config, self.config.feature_width, own_physics_column(self.config)
        used = width - MATERIAL_EMBEDDING
        size = self.width * self.grid.features
        combined = self.totals[self.packed.size : self.packed.size + size].view(self.width, self.grid.features)
        table = combined[:, used:own]
        first, embedding, bias = self._encode_views(self.totals)
        value, rows, _ = self._encode_views(self.values)
        first[:, :used].copy_(combined[:, :used])
        first[:, used:width].copy_(table @ rows)
        if config.own_physics:
            first[:, width:].copy_(combined[:, own : own + first.shape[1] - width])
        embedding.copy_(table.T @ value[:, used:width])
        bias.copy_(table.sum(1))

    def _mlp_backward(
        self,
        mlp: PackedMLP,
        gradient: torch.Tensor,
        count: torch.Tensor,
        hidden: torch.Tensor,
        hidden_gradient: torch.Tensor,
        second_gradient: torch.Tensor,
        first_at: int | None = None,
        gradient_index: torch.Tensor | None = None,
        offset: tuple[int, int] = (0, 0),
        octant: torch.Tensor | None = None,
        into: tuple[torch.Tensor | None, int] = (None, 0),
        norm: bool = True,
        residual: bool = False,
        following: tuple[int, ...] = (),
        products: tuple[torch.Tensor, ...] = (),
    ) -> None:
        block, warps = self.tuning.row_tile(len(hidden), True)
        at, given = (*following, 0, 0), (*products, hidden, hidden)
        mlp_backward[self._blocks(len(hidden), block)](
            gradient=gradient, gradient_index=gradient_index if gradient_index is not None else count,
            from_0=given[0], from_1=given[1], x_gradient=into[0] if into[0] is not None else gradient,
            count_ptr=count, **self._gradient_operands(),
            first_at=mlp.parts[0] if first_at is None else first_at, offset_at=offset[0], **mlp.layers(),
            octant=octant if octant is not None else count, next_at_0=at[0], next_at_1=at[1], hidden=hidden,
            hidden_gradient=hidden_gradient, second_gradient=second_gradient, OUT=mlp.out,
            GATHER=gradient_index is not None, OFFSET=offset[1], NORM=norm, RESIDUAL=residual,
            NEXT=len(following), INTO=into[1], BLOCK=block, num_warps=warps,
        )  # fmt: skip

    def _particle_cell_backward(
        self,
        mlp: PackedMLP,
        gradient: torch.Tensor,
        by_particle: torch.Tensor,
        by_cell: torch.Tensor,
        stored: Stored,
        second_gradient: torch.Tensor,
        by_particle_gradient: torch.Tensor,
        by_cell_gradient: torch.Tensor,
        to_cell: bool,
    ) -> None:
        grid = self.grid
        programs = self.tuning.programs(grid.particles, self.tuning.pair_particles)
        particle_cell_backward[programs](
            gradient=gradient, by_particle=by_particle, by_cell=by_cell, cell_of=grid.cell_N8,
            weight_of=grid.weight_N8, fraction=grid.fraction_N3, count_ptr=self.particle_count,
            **self._gradient_operands(), offset_at=mlp.parts[-1], **mlp.layers(second_bias=False),
            **stored._asdict(), second_gradient=second_gradient, by_particle_gradient=by_particle_gradient,
            by_cell_gradient=by_cell_gradient, TO_CELL=to_cell, PARTICLES=self.tuning.pair_particles,
            num_warps=self.tuning.pair_warps,
        )  # fmt: skip
        if not self.stores_pair_hidden():
            particle_cell_weight_gradient[programs](
                second_gradient=second_gradient, by_particle=by_particle, by_cell=by_cell, cell_of=grid.cell_N8,
                count_ptr=self.particle_count, values=self.values, totals=self.totals, offset_at=mlp.parts[-1],
                second_at=mlp.second, second_bias_at=mlp.second_bias, unscale=self.unscale, TO_CELL=to_cell,
                WIDTH=self.width, PARTICLES=self.tuning.pair_particles, PRECISION=self.precision,
                PIPELINED=not interpreting(), num_warps=self.tuning.pair_warps,
            )  # fmt: skip

    def _gather_backward(
        self,
        level: int,
        x: torch.Tensor,
        table: torch.Tensor,
        summands: int,
        at: int,
        summed: torch.Tensor,
        gradient: torch.Tensor,
        add: bool = False,
        received: tuple[torch.Tensor, int] | None = None,
    ) -> None:
        """Launches gather_project_backward. With `received` x contains gradients of edges, see EDGES there."""
        rows = self.grid.capacities[level]
        size, warps = self.tuning.row_tile(rows)
        other, other_at = received or (summed, at)
        if summands > 0 and self.tuning.gathers(rows):
            self._gather(level, x, table, summed, received is not None)
            x, summands = summed, 0
        gather_project_backward[self._blocks(rows, size)](
            x=x, table=table, count_ptr=self.grid.count(level), weights=self.weights, at_0=at, summed=summed,
            other=other, other_at=other_at, gradient=gradient, capacity=rows, SUM=summands,
            EDGES=received is not None, ADD=add, WIDTH=self.width, BLOCK=size, PRECISION=self.precision,
            num_warps=warps,
        )  # fmt: skip

    def _passing_backward(self, block: Block, gradients: list[StepGradients]) -> None:
        grid, level, steps = self.grid, block.level, self.config.message_passing_steps
        rows = grid.capacities[level]
        gradient = self._gradient_of(block)
        edge_gradient, sum_gradient = self.edge_gradient[:rows], self.sum_gradient[:rows]
        table = grid.neighbour(level)
        tuning = self.tuning
        size, warps = self.tuning.row_tile(rows)
        if tuning.cell_backward_block > 0 and many(rows):
            size, warps = tuning.cell_backward_block, tuning.cell_backward_warps
        edge_size, edge_warps = self.tuning.edge_tile(rows)
        overlap = self.overlaps()
        for m in reversed(range(steps)):
            edge, cell, last = block.packed.edge[m], block.packed.cell[m], m == steps - 1
            step, later = gradients[m], gradients[m if last else m + 1]
            later_edge = block.packed.edge[m if last else m + 1]
            gathers = self.tuning.gathers(rows) and not last
            if gathers:
                self._gather(level, later.edge.hidden, table, later.send, True)
            cell_mlp_backward[self._blocks(rows, size)](
                gradient=gradient, later_hidden_gradient=later.edge.hidden,
                later_receive_gradient=later.receive, neighbour=table, count_ptr=grid.count(level),
                **self._gradient_operands(), later_send_at=later_edge.parts[0],
                later_receive_at=later_edge.parts[1], first_at=cell.parts[0], sum_first_at=cell.parts[1],
                **cell.layers(second_bias=False), **block.cell_stored[m]._asdict(), send_gradient=later.send,
                hidden_gradient=step.cell.hidden, second_gradient=step.cell.output, sum_gradient=sum_gradient,
                capacity=rows, LAST=last, GATHER=not gathers, BLOCK=size, RESIDENT=overlap and not many(rows),
                OVERLAP=overlap and not many(rows), num_warps=warps, launch_pdl=overlap and not many(rows),
            )  # fmt: skip
            edge_backward[self.tuning.programs(rows, self.tuning.edge_cells(edge_size))](
                sum_gradient=sum_gradient, edge_gradient=edge_gradient, count_ptr=grid.count(level),
                **self._gradient_operands(), own_at=edge.parts[2], **edge.layers(second_bias=False),
                **block.edge_stored[m]._asdict(), hidden_gradient=step.edge.hidden,
                second_gradient=step.edge.output, receive_gradient=step.receive, FIRST=m == 0, LAST=last,
                ROWS=8 * edge_size, DENSE=self.tuning.dense, OVERLAP=overlap, num_warps=edge_warps,
                launch_pdl=overlap,
            )  # fmt: skip
        first = block.packed.edge[0]
        into, received = gradients[0].send, (gradients[0].receive, first.parts[1])
        self._gather_backward(level, gradients[0].edge.hidden, table, 6, first.parts[0], into, gradient, True, received)


def _rows(table: torch.Tensor) -> int:
    return table.numel() // table.shape[-1]
