"""Runs the network on buffers of fixed capacity, as a fixed list of launches that one CUDA graph can capture.

Nothing here reads a value back to the host. The docstring of each kernel describes its launch. The order of launches is
the paper's (sec. 3.2). Shape legend: N particles, C cells, W width.
"""

from typing import Any

import torch
import triton

from hgn.config import MATERIAL_EMBEDDING
from hgn.kernels.buffers import Block, Buffers, Stored
from hgn.kernels.cell_mlp.kernel import cell_mlp_forward
from hgn.kernels.edges.kernel import edge_forward
from hgn.kernels.grid.op import DeviceGrid, own_physics_column
from hgn.kernels.mlp.kernel import clear_rows, gather_project, gather_sums, mlp_forward
from hgn.kernels.packing import PackedMLP, PackedNetwork, rounded_to_tf32
from hgn.kernels.particle_cell.kernel import particle_cell_forward
from hgn.kernels.triton_compat import overlaps
from hgn.kernels.tuning import LIGHT_BLOCK, Tuning, many
from hgn.network.own_physics import physics_widths
from hgn.schema import require

PRECISIONS = ("fp32", "tf32", "fp16")
CLEAR_ROWS = 64
ADDRESSED = 2**31  # limit of int32 indices; larger edge tensors use 64-bit indices
REMEDY = "use fewer together, or backend torch"
NONE = -1  # bias offset of a product without a bias


def _require_room(grid: DeviceGrid, width: int, training: bool) -> None:
    """Raises ConfigError if a tensor, other than the edges of a simulation, exceeds the limit of int32 indices."""
    pairs, edges = (8, 6) if training else (1, 1)
    for what, count, each in (("particles", grid.particles, pairs), ("cells", grid.capacities[0], edges)):
        most = (ADDRESSED - 1) // (each * width)
        purpose = "an update" if training else "a simulation"
        require(count <= most, f"{what} of {purpose} with backend triton", f"at most {most:,}", count, REMEDY)


class FusedNetwork(Buffers):
    """Runs a packed network on a DeviceGrid.

    `values` float32 [packed.size] are the parameters. In fp16 and TF32 the matrix products read `weights`, a rounded
    copy of `values`. Call `refresh` after every change of `values`. `training` adds buffers for a backward pass.
    """

    def __init__(
        self,
        packed: PackedNetwork,
        values: torch.Tensor,
        grid: DeviceGrid,
        particle_count: torch.Tensor,
        precision: str,
        training: bool = False,
        tuning: Tuning | None = None,
    ) -> None:
        assert precision in PRECISIONS
        config = grid.config
        _require_room(grid, config.width, training)
        self.config, self.packed, self.grid, self.precision = config, packed, grid, precision
        self.values, self.training, self.width = values, training, config.width
        self.particle_count = particle_count
        self.operand = torch.float16 if precision == "fp16" else torch.float32
        self.device = values.device
        rounded = precision in ("fp16", "tf32")
        self.weights = torch.empty_like(values, dtype=self.operand) if rounded else values
        # Falling particles have equal features, so rounding in the encoder would move a whole body. See FINE.
        self.fine = rounded and not training
        self.encode_weights = torch.zeros(self.width, grid.features, device=self.device)
        self.tuning = tuning or Tuning.of(precision)
        self._allocate(self.stores_pair_hidden())
        self.refresh()

    # parameters

    def refresh(self) -> None:
        """Updates the kernels' copies of the weights: the rounded copy, and the encoder's first layer."""
        if self.weights is not self.values:
            self.weights.copy_(self._rounded(self.values))
        self.refresh_encoder()

    def refresh_encoder(self) -> None:
        """Folds embedding and bias into the encoder's first layer, which then takes one-hot materials.

        The columns of own physics, which are the network's last ones, follow those of the materials.
        """
        first, embedding, bias = self._encode_views(self.values)
        width, own = self.config.feature_width, own_physics_column(self.config)
        used = width - MATERIAL_EMBEDDING
        self.encode_weights[:, :used].copy_(first[:, :used])
        torch.addmm(bias[:, None], first[:, used:width], embedding.T, out=self.encode_weights[:, used:own])
        if self.config.own_physics:
            self.encode_weights[:, own : own + first.shape[1] - width].copy_(first[:, width:])
        if self.precision == "tf32" and not self.fine:
            self.encode_weights.copy_(self._rounded(self.encode_weights))

    def _rounded(self, weights: torch.Tensor) -> torch.Tensor:
        """Returns the nearest TF32 numbers (hgn.kernels.blocks.nearest_tf32), or with other precisions the weights."""
        if self.precision != "tf32":
            return weights
        return rounded_to_tf32(weights)

    def _encode_views(self, flat: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        config, packed, width = self.config, self.packed, self.width
        at, columns = packed.encode.parts[0], config.feature_width + sum(physics_widths(config))
        first = flat[at : at + width * columns].view(width, columns)
        rows, embedding = len(config.materials), MATERIAL_EMBEDDING
        table = flat[packed.embedding : packed.embedding + rows * embedding].view(rows, embedding)
        return first, table, flat[packed.encode.first_bias : packed.encode.first_bias + width]

    # forward

    def forward(self) -> None:
        """Computes `output` [N, OUT] from the grid's features and tables. Columns 0 to 2: normalised accelerations."""
        packed, grid, levels = self.packed, self.grid, self.config.levels
        self._mlp(
            packed.encode, grid.feature_NF, self.particle_count, self.latent, self.encode_hidden,
            first=(self.encode_weights, 0), bias=False,
            following=(packed.particle_to_cell.parts[0], packed.cell_to_particle.parts[1]),
            following_bias=(packed.particle_to_cell.first_bias, packed.cell_to_particle.first_bias),
            products=(self.by_particle_down, self.by_particle_up),
            fractions=(packed.particle_to_cell.parts[-1], packed.cell_to_particle.parts[-1]), fine=self.fine,
        )  # fmt: skip
        self._clear(self.down[0].cell[0], self.overlaps())
        self._particle_cell(
            packed.particle_to_cell, self.by_particle_down, self.by_particle_down, self.pairs_down,
            self.down[0].cell[0], True,
        )  # fmt: skip
        for i, block in enumerate(self.down):
            self._begin(block, i > 0)
            self._passing(block)
            if i < levels - 1:
                self._mlp(
                    packed.fine_to_coarse[i], block.cell[-1], grid.count(i), self.message[i],
                    self.transfer_hidden_down[i], offset=(packed.fine_to_coarse[i].parts[1], 1),
                    octant=grid.octant(i),
                )  # fmt: skip
        coarse = self.down[-1]
        for i in reversed(range(levels - 1)):
            block = self.up[i]
            edge = block.packed.edge[0]
            assert coarse.product is not None
            self._mlp(
                packed.coarse_to_fine[i], self.down[i].cell[-1], grid.count(i), block.cell[0],
                self.transfer_hidden_up[i], first=(self.weights, packed.coarse_to_fine[i].parts[1]),
                gathered=coarse.product, index=grid.parent(i), offset=(packed.coarse_to_fine[i].parts[2], -1),
                octant=grid.octant(i), residual=True, following=(edge.parts[0], edge.parts[1]),
                following_bias=(NONE, edge.first_bias), products=(block.send[0], block.receive[0]),
            )  # fmt: skip
            self._passing(block)
            coarse = block
        assert coarse.product is not None
        self._particle_cell(
            packed.cell_to_particle, self.by_particle_up, coarse.product, self.pairs_up, self.decoder_input, False
        )
        self._mlp(packed.decode, self.decoder_input, self.particle_count, self.output, self.decode_hidden, norm=False)
        if self.config.relative:
            grid.balance(self.output, self.particle_count)

    def _operands(self) -> dict[str, Any]:
        """Returns the arguments that every kernel with products takes."""
        return {"weights": self.weights, "values": self.values, "WIDTH": self.width, "PRECISION": self.precision}

    def _clear(self, x: torch.Tensor, overlap: bool = False) -> None:
        """Sets the rows of x of the finest cells to zero."""
        clear_rows[self._blocks(len(x), CLEAR_ROWS)](
            x=x, count_ptr=self.grid.count(0), WIDTH=self.width, OVERLAP=overlap, BLOCK=CLEAR_ROWS,
            num_warps=4, launch_pdl=overlap,
        )  # fmt: skip

    def _blocks(self, rows: int, block: int) -> tuple[int]:
        return (triton.cdiv(rows, block),)

    def overlaps(self) -> bool:
        """Returns whether a kernel of a message step starts before the end of the previous one."""
        return self.tuning.overlap and overlaps()

    def stores_pair_hidden(self) -> bool:
        """Returns whether the hidden layer of particle-cell pairs is stored for the backward pass."""
        return self.precision == "tf32"

    def _mlp(
        self,
        mlp: PackedMLP,
        x: torch.Tensor,
        count: torch.Tensor,
        y: torch.Tensor,
        hidden: torch.Tensor,
        first: tuple[torch.Tensor, int] | None = None,
        gathered: torch.Tensor | None = None,
        index: torch.Tensor | None = None,
        offset: tuple[int, int] = (0, 0),
        octant: torch.Tensor | None = None,
        bias: bool = True,
        norm: bool = True,
        residual: bool = False,
        following: tuple[int, ...] = (),
        following_bias: tuple[int, ...] = (),
        products: tuple[torch.Tensor, ...] = (),
        fractions: tuple[int, int] = (0, 0),
        fine: bool = False,
    ) -> None:
        first = first or (self.weights, mlp.parts[0])
        block, warps = self.tuning.row_tile(len(x))
        at, bias_at = (*following, 0, 0), (*following_bias, NONE, NONE)
        into = (*products, hidden, hidden)
        loops, overlap = self.tuning.loops_over(len(x), block, 4), self.overlaps()
        mlp_forward[self.tuning.row_programs(len(x), block, loops, 1 if norm else 2)](
            x=x, count_ptr=count, **self._operands(), first_weights=first[0], first_at=first[1],
            offset_at=offset[0], bias_at=mlp.first_bias, **mlp.layers(),
            gathered=gathered if gathered is not None else x, index=index if index is not None else count,
            octant=octant if octant is not None else count, next_at_0=at[0], next_at_1=at[1],
            next_bias_at_0=bias_at[0], next_bias_at_1=bias_at[1], fraction=self.grid.fraction_N3,
            fraction_at_0=fractions[0], fraction_at_1=fractions[1], y=y, hidden=hidden, next_0=into[0],
            next_1=into[1], INPUT=x.shape[-1], OUT=mlp.out, GATHER=gathered is not None, OFFSET=offset[1],
            BIAS=bias, NORM=norm, RESIDUAL=residual, NEXT=len(following), FRACTION=fractions != (0, 0),
            SAVE=self.training, FINE=fine, BLOCK=block, LOOP=loops, OVERLAP=overlap, num_warps=warps,
            launch_pdl=overlap,
        )  # fmt: skip

    def _particle_cell(
        self,
        mlp: PackedMLP,
        by_particle: torch.Tensor,
        by_cell: torch.Tensor,
        stored: Stored,
        out: torch.Tensor,
        to_cell: bool,
    ) -> None:
        grid, tuning = self.grid, self.tuning
        at_once, registers, overlap = tuning.light_programs, tuning.light_registers, self.overlaps()
        particle_cell_forward[self.tuning.programs(grid.particles, tuning.pair_particles, at_once)](
            by_particle=by_particle, by_cell=by_cell, particle=self.latent, cell_of=grid.cell_N8,
            weight_of=grid.weight_N8, count_ptr=self.particle_count, **self._operands(),
            offset_at=mlp.parts[-1], **mlp.layers(), **stored._asdict(), out=out, TO_CELL=to_cell,
            SAVE=self.training, PARTICLES=self.tuning.pair_particles, OVERLAP=overlap,
            num_warps=self.tuning.pair_warps, maxnreg=registers, launch_pdl=overlap,
        )  # fmt: skip

    def _gather(self, level: int, x: torch.Tensor, table: torch.Tensor, y: torch.Tensor, edges: bool = False) -> None:
        """Writes to y the sums of the rows of x that the table lists."""
        rows, size = self.grid.capacities[level], self.tuning.gather_block
        gather_sums[self._blocks(rows, size)](
            x=x, table=table, count_ptr=self.grid.count(level), y=y, capacity=rows, SUM=len(table), EDGES=edges,
            WIDTH=self.width, BLOCK=size, num_warps=4,
        )  # fmt: skip

    def _begin(self, block: Block, from_children: bool) -> None:
        """Computes the input of a block, and the input's two products that the first message passing step reads."""
        grid, level, edge = self.grid, block.level, block.packed.edge[0]
        rows = grid.capacities[level]
        size, warps = self.tuning.row_tile(rows)
        if from_children and self.tuning.gathers(rows):
            self._gather(level, self.message[level - 1], grid.children(level), block.cell[0])
            from_children = False
        loops, overlap = not from_children and self.tuning.loops_over(rows, size), self.overlaps()
        if loops:
            size, warps = LIGHT_BLOCK
        gather_project[self.tuning.row_programs(rows, size, loops, 2)](
            x=self.message[level - 1] if from_children else block.cell[0], table=grid.children(level),
            count_ptr=grid.count(level), **self._operands(), at_0=edge.parts[0], at_1=edge.parts[1],
            bias_at=edge.first_bias, y=block.cell[0], next_0=block.send[0], next_1=block.receive[0],
            capacity=rows, SUM=8 if from_children else 0, BLOCK=size, LOOP=loops, OVERLAP=overlap, num_warps=warps,
            launch_pdl=overlap,
        )  # fmt: skip

    def _passing(self, block: Block) -> None:
        grid, level, steps = self.grid, block.level, self.config.message_passing_steps
        rows = grid.capacities[level]
        size, warps = self.tuning.row_tile(rows)
        edge_size, edge_warps = self.tuning.edge_tile(rows)
        overlap, loops = self.overlaps(), self.tuning.loops_over(rows, size)
        for m in range(steps):
            edge, cell, last = block.packed.edge[m], block.packed.cell[m], m == steps - 1
            if not last:
                following = block.packed.edge[m + 1].parts
                next_at, into = (following[0], following[1]), (block.send[(m + 1) % 2], block.receive[(m + 1) % 2])
                next_bias, products = block.packed.edge[m + 1].first_bias, 2
            else:
                product = block.product if block.product is not None else block.send[(m + 1) % 2]
                next_at, into, products = (block.next_at, 0), (product, product), int(block.product is not None)
                next_bias = 0
            light = m == 0 and many(rows)
            at_once = self.tuning.light_programs if light else 2
            edge_forward[self.tuning.programs(rows, self.tuning.edge_cells(edge_size), at_once)](
                send=block.send[m % 2], receive=block.receive[m % 2],
                edge_in=block.edge[m - 1] if m > 0 else block.cell[m], neighbour=grid.neighbour(level),
                count_ptr=grid.count(level), **self._operands(), own_at=edge.parts[2], **edge.layers(),
                edge_out=block.edge[m] if not last else block.cell[m], sum_out=block.sum[m],
                **block.edge_stored[m]._asdict(), capacity=rows, FIRST=m == 0, STORE_EDGE=not last,
                SAVE=self.training, ROWS=8 * edge_size, DENSE=self.tuning.dense, OVERLAP=overlap,
                AHEAD=self.tuning.dense and many(rows), WIDE=6 * rows * self.width >= ADDRESSED, num_warps=edge_warps,
                maxnreg=self.tuning.light_registers if light else None, launch_pdl=overlap,
            )  # fmt: skip
            cell_mlp_forward[self.tuning.row_programs(rows, size, loops)](
                cell=block.cell[m], total=block.sum[m], count_ptr=grid.count(level), **self._operands(),
                first_at=cell.parts[0], sum_first_at=cell.parts[1], bias_at=cell.first_bias, **cell.layers(),
                next_at_0=next_at[0], next_at_1=next_at[1], next_bias_at=next_bias, cell_out=block.cell[m + 1],
                **block.cell_stored[m]._asdict(), next_0=into[0], next_1=into[1], NEXT=products,
                SAVE=self.training, BLOCK=size, RESIDENT=overlap or loops, LOOP=loops, OVERLAP=overlap,
                num_warps=warps, launch_pdl=overlap,
            )  # fmt: skip
