"""One frame of a network as a graph that runs without this package: ONNX, or a compiled package (AOTInductor).

The graph is traced from the reference, hgn.network. It contains features, grid, network, constraints and integration.
The numbers of particles, obstacle cells and triangles may change from frame to frame, up to LARGEST_EXPORTED. The graph
raises no errors, so its caller checks that positions are finite. INPUTS and OUTPUTS name its tensors. `initial_arrays`
returns the inputs of a scene.
Shape legend: N particles, H velocities, K obstacle cells, F triangles of obstacles.
"""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import nn

from hgn.network.barriers import Barriers, barrier_rows
from hgn.network.base import ParticleNetwork
from hgn.network.cell_keys import COORDINATE_LIMIT, LARGEST_EXPORTED, pack, unpack
from hgn.network.features import ParticleState
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.network.obstacles import ObstacleCells
from hgn.runtime.weights import WeightsInfo
from hgn.schema import require, to_mapping
from hgn.step.reference import accelerations, advanced
from hgn.system.files import make_folder, sync_folder, sync_written, write_atomically

INPUTS = (
    "position", "velocity", "material", "domain_size", "gravity", "obstacle_cell", "obstacle_normal",
    "obstacle_triangle",
)  # fmt: skip
OUTPUTS = ("next_position", "next_velocity")
EXAMPLE_PARTICLES, EXAMPLE_CELLS, EXAMPLE_TRIANGLES = 64, 32, 16  # sizes for tracing; the graph does not depend on them


class Step(nn.Module):
    """One frame of one scene."""

    def __init__(self, network: HierarchicalGraphNetwork, obstacle_cell_size: float) -> None:
        super().__init__()
        self.network, self.obstacle_cell_size = network, obstacle_cell_size

    def forward(
        self,
        position: torch.Tensor,
        velocity: torch.Tensor,
        material: torch.Tensor,
        domain_size: torch.Tensor,
        gravity: torch.Tensor,
        obstacle_cell: torch.Tensor,
        obstacle_normal: torch.Tensor,
        obstacle_triangle: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns positions [N, 3] and velocities [N, H, 3], newest first, one frame later, in domain units and frames.

        `material`, int64 [N], indexes the network's materials. `domain_size` and `gravity` are [3]. `obstacle_cell` is
        int64 [K, 3] without repetition, `obstacle_normal` [K, 3]. `obstacle_triangle` [F, 3, 3] are corners. Networks
        with absolute inputs ignore gravity; networks without `obstacle_clearance` ignore triangles.
        """
        # Another cell, out of reach of every particle, so that the lists are never empty.
        far_13 = torch.full_like(domain_size[None], COORDINATE_LIMIT - 1).to(torch.int64)
        cell_K3 = torch.cat([obstacle_cell, far_13])
        normal_K3 = torch.cat([obstacle_normal, torch.zeros_like(domain_size[None])])
        key_K = pack(torch.zeros_like(cell_K3[:, 0]), cell_K3)
        state = ParticleState(
            position_N3=position,
            velocity_NM3=velocity,
            material_N=material,
            scene_N=torch.zeros_like(material),
            domain_S3=domain_size[None],
            gravity_S3=gravity[None],
            obstacles=ObstacleCells(key_K, normal_K3, self.obstacle_cell_size),
            barriers=self._barriers(obstacle_triangle),
        )
        acceleration_N3 = accelerations(self.network, state, self.network.prediction(state))
        after = advanced(state, acceleration_N3, self.network.step, self.network.config.dimensions)
        return after.position_N3, after.velocity_NM3

    def _barriers(self, corner_F33: torch.Tensor) -> Barriers | None:
        """Returns barriers without lists of cells, because the graph finds pairs by bounding boxes."""
        clearance = self.network.step.obstacle_clearance
        if clearance is None:
            return None
        # Another triangle, without area, so that the list is never empty.
        corner_F33 = torch.cat([corner_F33, corner_F33.new_zeros(1, 3, 3)])
        row_F24 = barrier_rows(corner_F33, clearance).to(corner_F33.dtype)
        none = torch.zeros(0, dtype=torch.int64, device=corner_F33.device)
        cell_size = self.obstacle_cell_size
        return Barriers(none, none, none, row_F24, scene_F=none, cell_size=cell_size, clearance=clearance)


def initial_arrays(state: ParticleState, corner_F33: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Returns the first inputs of the graph by name for a simulator's state of one scene.

    `corner_F33` contains the corners of the obstacles' triangles in domain units, from
    `hgn.scene.barrier.barrier_pieces`; None: no triangles.
    """
    require(state.scene_count == 1, "scenes", "one", state.scene_count)
    cells, normals = np.zeros((0, 3), np.int64), np.zeros((0, 3), np.float32)
    if state.obstacles is not None:
        cells = unpack(state.obstacles.key_K)[1].cpu().numpy()
        normals = state.obstacles.normal_K3.cpu().numpy()
    triangles = np.zeros((0, 3, 3), np.float32) if corner_F33 is None else corner_F33.astype(np.float32)
    tensors = (state.position_N3, state.velocity_NM3, state.material_N, state.domain_S3[0], state.gravity_S3[0])
    arrays = [*(tensor.cpu().numpy() for tensor in tensors), cells, normals, triangles]
    return dict(zip(INPUTS, arrays, strict=True))


def traced_step(network: ParticleNetwork, info: WeightsInfo) -> torch.export.ExportedProgram:
    """Returns the graph. Raises: ConfigError for a GNS (neighbour lists cannot be exported) and for own physics."""
    require(isinstance(network, HierarchicalGraphNetwork), "weights", "an hgn network", network.config.kind)
    assert isinstance(network, HierarchicalGraphNetwork)
    own = list(network.config.own_physics)
    require(not own, "weights", "a network without own_physics, which a graph has no inputs for yet", own)
    device, config = next(network.parameters()).device, network.config
    generator = torch.Generator().manual_seed(0)
    example = (
        torch.rand(EXAMPLE_PARTICLES, 3, generator=generator) * 0.1 + 0.3,
        torch.randn(EXAMPLE_PARTICLES, config.velocity_history, 3, generator=generator) * 1e-3,
        torch.zeros(EXAMPLE_PARTICLES, dtype=torch.int64),
        torch.ones(3),
        torch.zeros(3),
        torch.arange(EXAMPLE_CELLS)[:, None] * torch.tensor([0, 0, 1]),
        torch.ones(EXAMPLE_CELLS, 3),
        torch.rand(EXAMPLE_TRIANGLES, 3, 3, generator=generator),
    )
    particles = {0: torch.export.Dim("particles", min=1, max=LARGEST_EXPORTED)}
    cells = {0: torch.export.Dim("obstacle_cells", min=0, max=LARGEST_EXPORTED)}
    triangles = {0: torch.export.Dim("obstacle_triangles", min=0, max=LARGEST_EXPORTED)}
    step = Step(network, info.obstacle_cell_size).eval()
    # One graph serves 0, 1 and more particles, cells and triangles.
    with (
        torch.no_grad(),
        torch.fx.experimental._config.patch(  # type: ignore[attr-defined]
            backed_size_oblivious=True
        ),
    ):
        return torch.export.export(
            step,
            tuple(tensor.to(device) for tensor in example),
            dynamic_shapes=(particles, particles, particles, None, None, cells, cells, triangles),
            strict=False,
        )


def write_onnx(path: Path, program: torch.export.ExportedProgram, info: WeightsInfo) -> None:
    """Writes the graph as ONNX with its parameters. The metadata entry `hgn` contains the weights' info."""
    import onnxscript  # noqa: F401 - imported first, because torch's own error does not name it

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns about its dependencies
        exported = torch.onnx.export(
            program,
            (),
            dynamo=True,
            input_names=INPUTS,
            output_names=OUTPUTS,
            verbose=False,
            custom_translation_table={torch.ops.aten.index_add.default: _added_in_order},
        )
    assert exported is not None
    exported.model.metadata_props["hgn"] = _description(info)
    make_folder(path.parent)
    write_atomically(path, exported.model_proto.SerializeToString())


def _added_in_order(sums: Any, dim: int, index: Any, source: Any) -> Any:
    """Writes `index_add` as ScatterElements. By default it becomes ScatterND, in which threads of ONNX Runtime 1.32
    overwrite each other's sums. Repeated frames of 4,096 particles then differed by 1e-4 domain units."""
    from onnxscript import opset18

    others = [axis for axis in range(len(source.shape)) if axis != dim]
    axes: Any = opset18.Constant(value_ints=others) if others else None
    index = opset18.Unsqueeze(index, axes) if others else index
    index = opset18.Expand(index, opset18.Shape(source))
    return opset18.ScatterElements(sums, index, source, axis=dim, reduction="add")


def write_package(path: Path, program: torch.export.ExportedProgram, info: WeightsInfo) -> None:
    """Writes the graph compiled for its device, for PyTorch's C++ library. Needs a C++ compiler and takes minutes."""
    make_folder(path.parent)
    with TemporaryDirectory(prefix=f".{path.stem}.", dir=path.parent) as folder, warnings.catch_warnings():
        temporary = Path(folder) / path.name
        warnings.simplefilter("ignore")
        torch._inductor.aoti_compile_and_package(
            program,
            package_path=str(temporary.resolve()),
            # The program that runs the package sets the number of threads.
            inductor_configs={"aot_inductor.metadata": {"hgn": _description(info)}, "cpp.dynamic_threads": True},
        )
        sync_written(temporary)
        temporary.replace(path)
    sync_folder(path.parent)


def _description(info: WeightsInfo) -> str:
    return json.dumps(to_mapping(info), sort_keys=True)
