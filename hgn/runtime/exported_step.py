"""One frame of a network as a graph that runs without this package: ONNX, or a compiled package (AOTInductor).

The graph is traced from the reference, hgn.network. It contains features, grid, network, constraints and integration.
The numbers of particles, obstacle cells and triangles may change from frame to frame, up to LARGEST_EXPORTED. The graph
raises no errors, so its caller checks that positions are finite. `input_names` and OUTPUTS name its tensors.
`initial_arrays` returns the inputs of a scene.
Shape legend: N particles, H velocities, K obstacle cells, F triangles of obstacles, P parameters, R particles with a
rest shape (0, or N), B rest neighbours, V moving obstacles, T frames.
"""

from __future__ import annotations

import json
import logging
import math
import warnings
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn.functional import pad

from hgn.config import NetworkConfig
from hgn.network.barriers import Barriers, barrier_rows
from hgn.network.base import ParticleNetwork
from hgn.network.cell_keys import COORDINATE_LIMIT, LARGEST_EXPORTED, pack, unpack
from hgn.network.elastic import RestShape
from hgn.network.features import ParticleState
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.network.moving import MovingObstacles, Poses
from hgn.network.obstacles import ObstacleCells
from hgn.network.own_physics import scaled_parameters
from hgn.runtime.weights import WeightsInfo
from hgn.scene.barrier import barrier_pieces
from hgn.scene.own_physics import NOMINAL_P
from hgn.scene.rest_shape import NEIGHBOURS
from hgn.schema import require, to_mapping
from hgn.step.reference import accelerations, constrained, moved, next_state
from hgn.system.files import make_folder, sync_folder, sync_written, write_atomically

INPUTS = (
    "position", "velocity", "frame", "material", "domain_size", "gravity", "obstacle_cell", "obstacle_normal",
    "obstacle_triangle",
)  # fmt: skip
NAMED = len(INPUTS) - 1  # inputs that are arguments of `Step.forward` by name
OWN_INPUTS = {
    "friction": ("wall_friction", "obstacle_friction"),
    "parameters": ("parameters",),
    "elastic": ("rest_position", "rest_neighbour"),
    "moving": ("moving_pose", "moving_cell", "moving_surface", "moving_triangle"),
}  # the inputs that follow for each of `network.own_physics`; those of `moving` only in graphs with moving obstacles
MOST_POSES = 100_000  # largest number of frames times obstacles in `moving_pose` of `initial_arrays`
OUTPUTS = ("next_position", "next_velocity")
# torch registers the ONNX forms of torchvision's operators in each export, which no graph of this package contains
logging.getLogger("torch.onnx._internal.exporter._registration").addFilter(
    lambda record: record.msg != "torchvision is not installed. Skipping %s"
)
# sizes for tracing; the graph does not depend on them
EXAMPLE_PARTICLES, EXAMPLE_CELLS, EXAMPLE_TRIANGLES, EXAMPLE_RESTS = 64, 32, 16, 8


def input_names(config: NetworkConfig) -> tuple[str, ...]:
    """Returns the names of the graph's inputs in their order. Those of moving obstacles are the last."""
    own = (names for kind, names in OWN_INPUTS.items() if kind in config.own_physics)
    return sum(own, INPUTS)


class Step(nn.Module):
    """One frame of one scene."""

    def __init__(self, network: HierarchicalGraphNetwork, obstacle_cell_size: float) -> None:
        super().__init__()
        self.network, self.obstacle_cell_size = network, obstacle_cell_size

    def forward(
        self,
        position: torch.Tensor,
        velocity: torch.Tensor,
        frame: torch.Tensor,
        material: torch.Tensor,
        domain_size: torch.Tensor,
        gravity: torch.Tensor,
        obstacle_cell: torch.Tensor,
        obstacle_normal: torch.Tensor,
        *others: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns positions [N, 3] and velocities [N, H, 3], newest first, one frame later, in domain units and frames.

        `frame`, int64 [1], is the number of frames before, 0 for the first one; it gives the origin of the grid.
        `material`, int64 [N], indexes the network's materials. `domain_size` and `gravity` are [3]. `obstacle_cell` is
        int64 [K, 3] without repetition, `obstacle_normal` [K, 3], with `obstacle_distance` [K, 4] with the distance of
        the cell's centre last. Networks with absolute inputs ignore gravity.

        The first of `others` is `obstacle_triangle` [F, 3, 3], corners that networks without `obstacle_clearance`
        ignore. Then follow the inputs of OWN_INPUTS that the network has: friction of the walls normal to x, y, z [3],
        and of obstacle cells [K]; values of INPUT_PARAMETERS [N, P]; rest positions [R, 3], and rest neighbours, int64
        [R, B], -1 for none; poses x -> R x + t of moving obstacles, R and then t, in this frame and the next [2, V, 3,
        4], their cells, int64 [K, 4], the obstacle's number first, normals and friction of these [K, 4], with
        `obstacle_distance` [K, 5], and triangles [V, F, 3, 3].
        """
        given = dict(zip(input_names(self.network.config)[NAMED:], others, strict=False))
        # Another cell, out of reach of every particle, so that the lists are never empty.
        far_13 = torch.full_like(domain_size[None], COORDINATE_LIMIT - 1).to(torch.int64)
        cell_K3 = torch.cat([obstacle_cell, far_13])
        key_K, distance = pack(torch.zeros_like(cell_K3[:, 0]), cell_K3), self.network.config.obstacle_distance
        obstacles = ObstacleCells.of_rows(key_K, pad(obstacle_normal, (0, 0, 0, 1)), self.obstacle_cell_size, distance)
        friction_K = pad(given["obstacle_friction"], (0, 1)) if "obstacle_friction" in given else None
        state = ParticleState(
            position_N3=position,
            velocity_NM3=velocity,
            material_N=material,
            scene_N=torch.zeros_like(material),
            domain_S3=domain_size[None],
            gravity_S3=gravity[None],
            frame_S=frame,
            obstacles=replace(obstacles, friction_K=friction_K),
            barriers=self._barriers(given["obstacle_triangle"]),
            **self._own_fields(given, material),
        )
        acceleration_N3 = accelerations(self.network, state, self.network.prediction(state))
        step, dimensions = self.network.step, self.network.config.dimensions
        motion = constrained(state, moved(state, acceleration_N3), step, dimensions)
        after = next_state(replace(state, moving=None), motion)  # the caller moves the obstacles
        return after.position_N3, after.velocity_NM3

    def _own_fields(self, given: dict[str, torch.Tensor], material_N: torch.Tensor) -> dict[str, Any]:
        """Returns the fields of the state for own physics, except the friction of obstacles."""
        fields: dict[str, Any] = {}
        if "wall_friction" in given:
            fields["wall_friction_S3"] = given["wall_friction"][None]
        if "parameters" in given:
            fields["parameter_NP"] = scaled_parameters(given["parameters"], material_N, self.network.config.materials)
        if "rest_position" in given:
            # Another particle, without neighbours, stands for all particles without a rest shape.
            position_R3, neighbour_RB = pad(given["rest_position"], (0, 0, 0, 1)), given["rest_neighbour"]
            rest = RestShape.of(position_R3, pad(neighbour_RB, (0, 0, 0, 1), value=-1))
            row_N = torch.arange(material_N.shape[0], device=material_N.device).clamp(max=neighbour_RB.shape[0])
            fields["rest"] = RestShape(rest.neighbour_NK[row_N], rest.position_N3[row_N], rest.coefficient_NK4[row_N])
        if "moving_pose" in given:
            fields["moving"] = self._moving(*(given[name] for name in OWN_INPUTS["moving"]))
        return fields

    def _moving(
        self, pose_2V34: torch.Tensor, cell_K4: torch.Tensor, surface_KV: torch.Tensor, corner_VF33: torch.Tensor
    ) -> MovingObstacles:
        """Returns the moving obstacles of the frame. All pivots are 0, so that their positions are t."""
        rotation_2V33, place_2V3 = pose_2V34[..., :3], pose_2V34[..., 3]
        change_V33 = rotation_2V33[1] @ rotation_2V33[0].mT - torch.eye(3, device=pose_2V34.device)
        zero_V3, shift_V3 = torch.zeros_like(place_2V3[0]), place_2V3[1] - place_2V3[0]
        poses = Poses(rotation_2V33[0], zero_V3, place_2V3[0], change_V33, shift_V3=shift_V3)
        # Another cell, as for obstacles at rest.
        far_K3, number_K = pad(cell_K4[:, 1:], (0, 0, 0, 1), value=COORDINATE_LIMIT - 1), pad(cell_K4[:, 0], (0, 1))
        key_K, row_KV = pack(number_K, far_K3), pad(surface_KV, (0, 0, 0, 1))
        cells = ObstacleCells.of_rows(key_K, row_KV, self.obstacle_cell_size, self.network.config.obstacle_distance)
        barriers = self._barriers(corner_VF33.flatten(0, 1))
        if barriers is not None:
            number_VF = torch.ones_like(corner_VF33[:, :, 0, 0], dtype=torch.int64).cumsum(0) - 1
            barriers = replace(barriers, scene_F=pad(number_VF.flatten(), (0, 1)))
        return MovingObstacles(((),), (0,), 1.0, cells, barriers=barriers, poses=poses)

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


def initial_arrays(
    config: NetworkConfig,
    state: ParticleState,
    corner_F33: np.ndarray | None = None,
    parameter_NP: np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """Returns the first inputs of the graph by name for a simulator's state of one scene.

    `corner_F33` contains the corners of the obstacles' triangles in domain units, from
    `hgn.scene.barrier.barrier_pieces`; None: no triangles. `parameter_NP` are the values of INPUT_PARAMETERS; None: the
    solver's defaults.
    """
    require(state.scene_count == 1, "scenes", "one", state.scene_count)
    own = config.obstacle_distance
    cells, normals, friction = np.zeros((0, 3), np.int64), np.zeros((0, 3 + own), np.float32), None
    if state.obstacles is not None:
        cells = unpack(state.obstacles.key_K)[1].cpu().numpy()
        normals, friction = state.obstacles.rows(friction=False).cpu().numpy(), state.obstacles.friction_K
    triangles = np.zeros((0, 3, 3), np.float32) if corner_F33 is None else corner_F33.astype(np.float32)
    if parameter_NP is None:
        parameter_NP = np.tile(np.array(NOMINAL_P, np.float32), (len(state.position_N3), 1))
    walls, rest = state.wall_friction_S3, state.rest
    first = (state.position_N3, state.velocity_NM3, state.frame_S, state.material_N)
    tensors = [x.cpu().numpy() for x in (*first, state.domain_S3[0], state.gravity_S3[0])]
    arrays = dict(zip(INPUTS, [*tensors, cells, normals, triangles], strict=True))
    arrays |= {
        "wall_friction": np.zeros(3, np.float32) if walls is None else walls[0].cpu().numpy(),
        "obstacle_friction": np.zeros(len(cells), np.float32) if friction is None else friction.cpu().numpy(),
        "parameters": parameter_NP,
        "rest_position": np.zeros((0, 3), np.float32) if rest is None else rest.position_N3.cpu().numpy(),
        "rest_neighbour": np.zeros((0, NEIGHBOURS), np.int64) if rest is None else rest.neighbour_NK.cpu().numpy(),
    }
    if state.moving is not None:
        arrays |= _moving_arrays(state.moving)
    return {name: arrays[name] for name in input_names(config) if name in arrays}


def _moving_arrays(moving: MovingObstacles) -> dict[str, np.ndarray]:
    """Returns the inputs for moving obstacles. Poses [T, V, 3, 4] are those of all frames until the motion ends.

    Raises: ConfigError for more than MOST_POSES poses.
    """
    own = moving.scenes[0]
    frames = math.ceil(max(m.motion.time_T[-1] for m in own) / moving.frame_s) + 2
    rule = f"at most {MOST_POSES} poses (frames times obstacles) with arrays"
    require(frames * len(own) <= MOST_POSES, "keyframes", rule, frames * len(own))
    triangles = [barrier_pieces(m.corner_F33, moving.cell_size) for m in own]
    poses = [[np.column_stack(m.motion.transform(t * moving.frame_s)) for m in own] for t in range(frames)]
    corner_VF33 = np.zeros((len(own), max(map(len, triangles)), 3, 3), np.float32)  # further triangles have no area
    for corners, corner_F33 in zip(corner_VF33, triangles, strict=True):
        corners[: len(corner_F33)] = corner_F33
    cell_K4, surface_KV = np.zeros((0, 4), np.int64), np.zeros((0, 4), np.float32)
    if moving.cells is not None:
        number_K, cell_K3 = unpack(moving.cells.key_K)
        cell_K4 = torch.cat([number_K[:, None], cell_K3], 1).cpu().numpy()
        surface_KV = moving.cells.rows(friction=True).cpu().numpy()
    return dict(zip(OWN_INPUTS["moving"], [np.array(poses, np.float32), cell_K4, surface_KV, corner_VF33], strict=True))


def traced_step(network: ParticleNetwork, info: WeightsInfo, moving: int = 0) -> torch.export.ExportedProgram:
    """Returns the graph of scenes with `moving` moving obstacles.

    Raises: ConfigError for a GNS, because neighbour lists cannot be exported.
    """
    require(isinstance(network, HierarchicalGraphNetwork), "weights", "an hgn network", network.config.kind)
    assert isinstance(network, HierarchicalGraphNetwork)
    device, config = next(network.parameters()).device, network.config
    generator = torch.Generator().manual_seed(0)
    particles = {0: torch.export.Dim("particles", min=1, max=LARGEST_EXPORTED)}
    cells = {0: torch.export.Dim("obstacle_cells", min=0, max=LARGEST_EXPORTED)}
    triangles = {0: torch.export.Dim("obstacle_triangles", min=0, max=LARGEST_EXPORTED)}
    shapes = {0: torch.export.Dim("rest_shapes", min=0, max=LARGEST_EXPORTED)}
    moving_cells = {0: torch.export.Dim("moving_cells", min=0, max=LARGEST_EXPORTED)}
    moving_triangles = {1: torch.export.Dim("moving_triangles", min=0, max=LARGEST_EXPORTED)}
    position_N3 = torch.rand(EXAMPLE_PARTICLES, 3, generator=generator) * 0.1 + 0.3
    velocity_NH3 = torch.randn(EXAMPLE_PARTICLES, config.velocity_history, 3, generator=generator) * 1e-3
    examples = {
        "position": (position_N3, particles),
        "velocity": (velocity_NH3, particles),
        "frame": (torch.ones(1, dtype=torch.int64), None),
        "material": (torch.zeros(EXAMPLE_PARTICLES, dtype=torch.int64), particles),
        "domain_size": (torch.ones(3), None),
        "gravity": (torch.zeros(3), None),
        "obstacle_cell": (torch.arange(EXAMPLE_CELLS)[:, None] * torch.tensor([0, 0, 1]), cells),
        "obstacle_normal": (torch.ones(EXAMPLE_CELLS, 3 + config.obstacle_distance), cells),
        "obstacle_triangle": (torch.rand(EXAMPLE_TRIANGLES, 3, 3, generator=generator), triangles),
        "wall_friction": (torch.zeros(3), None),
        "obstacle_friction": (torch.zeros(EXAMPLE_CELLS), cells),
        "parameters": (torch.tensor(NOMINAL_P).repeat(EXAMPLE_PARTICLES, 1), particles),
        "rest_position": (position_N3[:EXAMPLE_RESTS], shapes),
        "rest_neighbour": (torch.zeros(EXAMPLE_RESTS, NEIGHBOURS, dtype=torch.int64), shapes),
    }
    if moving:
        examples |= {
            "moving_pose": (torch.eye(3, 4).expand(2, moving, 3, 4).clone(), None),
            "moving_cell": (torch.arange(EXAMPLE_CELLS)[:, None] * torch.tensor([0, 0, 0, 1]), moving_cells),
            "moving_surface": (torch.ones(EXAMPLE_CELLS, 4 + config.obstacle_distance), moving_cells),
            "moving_triangle": (torch.rand(moving, EXAMPLE_TRIANGLES, 3, 3, generator=generator), moving_triangles),
        }
    example, dynamic = zip(*(examples[name] for name in input_names(config) if name in examples), strict=True)
    dynamic = (*dynamic[:NAMED], dynamic[NAMED:])
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
            dynamic_shapes=dynamic,
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
            input_names=input_names(info.network)[: len(program.graph_signature.user_inputs)],
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
