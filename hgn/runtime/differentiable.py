"""Simulation with gradients with respect to the initial state and the poses of obstacles.

docs/how_to/gradients.md lists which gradients are exact, which are valid only within a cell, and for how many frames.
Shape legend: T frames, S scenes, N particles, M or H velocities, F triangles.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np
import torch
from torch.func import functional_call

from hgn.network.barriers import Barriers, barrier_rows
from hgn.network.base import ParticleNetwork
from hgn.network.features import ParticleState
from hgn.network.grid import GridRangeError
from hgn.network.moving import Poses
from hgn.network.obstacles import ObstacleCells
from hgn.network.own_physics import scaled_parameters
from hgn.network.posed_obstacles import Placement, PosedObstacleCells
from hgn.runtime.divergence import DivergedError, describe_diverged, diverged
from hgn.scene.barrier import barrier_of_pieces, barrier_pieces
from hgn.scene.material import INPUT_PARAMETERS
from hgn.scene.motion import AT_REST
from hgn.scene.obstacle_grid import ObstacleGrid, build_obstacle_grid
from hgn.scene.own_physics import NOMINAL_P, input_parameters
from hgn.scene.scene import Obstacle, Scene, all_corners
from hgn.scene.surface_field import surface_field
from hgn.schema import require, require_count
from hgn.step.reference import Accelerations, advanced


@dataclass(frozen=True, eq=False)
class Pose:
    """A change of an obstacle's pose: a rotation about a pivot, then a translation. None means no change."""

    rotation_3: torch.Tensor | None = None  # axis times angle, radians
    translation_3: torch.Tensor | None = None  # domain units
    pivot_3: tuple[float, float, float] | None = None  # domain units; None: the centre of the bounding box
    velocity_3: torch.Tensor | None = None  # domain units per second, added to the motion of keyframes


@dataclass(frozen=True, eq=False)
class Inputs:
    """Tensors that replace a scene's own. They may require gradients. Units: domain units, seconds."""

    position_N3: torch.Tensor | None = None
    velocity_N3: torch.Tensor | None = None
    gravity_3: torch.Tensor | None = None
    domain_size_3: torch.Tensor | None = None
    poses: Mapping[int, Pose] | None = None  # by the obstacle's number in the scene
    physics: Mapping[str, torch.Tensor] | None = None  # by name: wall_friction [3], each of INPUT_PARAMETERS [N]
    smoothing: float = 0.0  # 0 to 1 obstacle cells; see hgn.network.posed_obstacles


def simulate(
    network: ParticleNetwork, start: ParticleState, scene: Scene, frame_rate_hz: float, frames: int, inputs: Inputs
) -> torch.Tensor:
    """Returns positions [T, N, 3]. `start` is the scene's state at frame 0 from `Simulator.start`.

    The backward pass computes each frame again. Memory contains all states, and the intermediate results of one frame.
    The network's parameters get no gradients. Raises: ConfigError, DivergedError.
    """
    require_count("frames", frames, 1)
    smooth = isinstance(inputs.smoothing, Real) and 0 <= inputs.smoothing <= 1
    require(smooth, "smoothing", "0 to 1 cells", inputs.smoothing)
    state = _started(network, start, scene, frame_rate_hz, inputs=inputs)
    moved = functools.partial(_in_motion, state, scene, inputs.poses or {}, frame_rate_hz=frame_rate_hz)
    state = moved(frame=0)
    predicted = Accelerations(network)
    weights = {name: tensor.detach() for name, tensor in predicted.state_dict(keep_vars=True).items()}

    def step(before: ParticleState, *variables: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        before = _with_variables(before, variables)
        acceleration_N3 = functional_call(predicted, weights, (before,))
        after = advanced(before, acceleration_N3, network.step, network.config.dimensions)
        return after.position_N3, after.velocity_NM3

    variables = _variables(state)
    positions = [state.position_N3]
    for frame in range(1, frames):
        try:
            before = replace(state, frame_S=state.frame_S + frame - 1)
            variables[:2] = _Frame.apply(functools.partial(step, before), *variables)
        except GridRangeError as error:
            raise DivergedError(frame, str(error)) from None
        lost = int(diverged(variables[0].detach(), state.domain_S3.detach()[state.scene_N]).sum())
        if lost:
            raise DivergedError(frame, describe_diverged(lost, len(variables[0])))
        positions.append(variables[0])
        variables[2:] = _variables(moved(frame=frame))[2:]
    return torch.stack(positions)


class _Frame(torch.autograd.Function):
    """A frame without its intermediate results. The backward pass computes them again.

    torch.utils.checkpoint does the same, but calls Python for each intermediate tensor. On a GPU such a call takes as
    long as computing the tensor.
    """

    @staticmethod
    def forward(context, step, *variables):  # type: ignore[no-untyped-def]
        context.step = step
        context.save_for_backward(*variables)
        return step(*variables)

    @staticmethod
    def backward(context, *gradients):  # type: ignore[no-untyped-def]
        asked = context.needs_input_grad[1:]
        variables = [
            tensor.detach().requires_grad_(wanted) for tensor, wanted in zip(context.saved_tensors, asked, strict=True)
        ]
        with torch.enable_grad():
            outputs = context.step(*variables)
        wanted = [tensor for tensor in variables if tensor.requires_grad]
        # grad refuses outputs that depend on no wanted tensor: for example, only a pose is wanted, and its obstacle
        # stops no particle
        reached = [pair for pair in zip(outputs, gradients, strict=True) if pair[0].requires_grad]
        ends, slopes = [output for output, _ in reached], [gradient for _, gradient in reached]
        computed = iter(torch.autograd.grad(ends, wanted, slopes, allow_unused=True))
        return None, *(next(computed) if tensor.requires_grad else None for tensor in variables)


def _variables(state: ParticleState) -> list[torch.Tensor]:
    """Returns the tensors of a state that may have gradients, positions and velocities first."""
    tensors = [state.position_N3, state.velocity_NM3, state.domain_S3, state.gravity_S3]
    if isinstance(state.obstacles, PosedObstacleCells):
        for _, placement in state.obstacles.placed:
            tensors += [placement.rotation_33, placement.translation_3]
    tensors += [x for x in (state.wall_friction_S3, state.parameter_NP) if x is not None]
    tensors += [] if state.moving is None else state.moving.poses.tensors
    return tensors if state.barriers is None else [*tensors, state.barriers.row_F24]


def _with_variables(state: ParticleState, variables: Sequence[torch.Tensor]) -> ParticleState:
    """Returns the state with these tensors. Inverts `_variables`."""
    position_N3, velocity_NM3, domain_S3, gravity_S3, *others = variables
    rest, obstacles = iter(others), state.obstacles
    if isinstance(obstacles, PosedObstacleCells):
        placed = tuple(
            (cells, replace(placement, rotation_33=next(rest), translation_3=next(rest)))
            for cells, placement in obstacles.placed
        )
        obstacles = replace(obstacles, placed=placed)
    return replace(
        state,
        position_N3=position_N3,
        velocity_NM3=velocity_NM3,
        domain_S3=domain_S3,
        gravity_S3=gravity_S3,
        obstacles=obstacles,
        wall_friction_S3=None if state.wall_friction_S3 is None else next(rest),
        parameter_NP=None if state.parameter_NP is None else next(rest),
        moving=state.moving and replace(state.moving, poses=state.moving.poses.map(lambda _: next(rest))),
        barriers=state.barriers and replace(state.barriers, row_F24=next(rest)),
    )


def _started(
    network: ParticleNetwork, start: ParticleState, scene: Scene, frame_rate_hz: float, inputs: Inputs
) -> ParticleState:
    """Returns the state at frame 0 with `inputs`, in the network's precision."""
    config, device = network.config, start.position_N3.device
    dtype = next(network.parameters()).dtype

    def given(name: str, value: torch.Tensor | None, default: np.ndarray, shape: tuple[int, ...]) -> torch.Tensor:
        tensor = torch.as_tensor(default) if value is None else _tensor(name, value, shape)
        return tensor.to(device, torch.float64)  # the simulator computes its history in float64 too

    require(
        inputs.gravity_3 is None or config.relative,
        "gravity_3",
        "left out for a network with absolute inputs, which supports only the gravity of its data",
        "a tensor",
        remedy="use weights with relative inputs, such as mechanics",
    )
    count = len(scene.position_N3)
    position_N3 = given("position_N3", inputs.position_N3, scene.position_N3, (count, 3))
    velocity_N3 = given("velocity_N3", inputs.velocity_N3, scene.velocity_N3, (count, 3)) / frame_rate_hz
    gravity_3 = given("gravity_3", inputs.gravity_3, np.array(scene.gravity), (3,)) / frame_rate_hz**2
    domain_3 = given("domain_size_3", inputs.domain_size_3, np.array(scene.domain_size), (3,))
    age_H1 = torch.arange(config.velocity_history, device=device, dtype=torch.float64)[:, None] + 0.5
    obstacles, barriers = _obstacles(network, start, scene, inputs)
    return replace(
        start,
        position_N3=position_N3.to(dtype),
        velocity_NM3=(velocity_N3[:, None] - age_H1 * gravity_3).to(dtype),  # as in hgn.scene.history
        domain_S3=domain_3[None].to(dtype),
        gravity_S3=gravity_3[None].to(dtype),
        obstacles=obstacles,
        barriers=barriers,
        **_physics(network, start, scene, inputs.physics or {}),
    )


def _physics(
    network: ParticleNetwork, start: ParticleState, scene: Scene, given: Mapping[str, torch.Tensor]
) -> dict[str, Any]:
    """Returns the fields of a state for friction of walls and for parameters. `given` replaces those of the scene."""
    fields: dict[str, Any] = {"wall_friction_S3": start.wall_friction_S3, "parameter_NP": start.parameter_NP}
    count, dtype, inputs = scene.particle_count, next(network.parameters()).dtype, network.config.own_physics
    known: dict[str, tuple[int, ...]] = {"wall_friction": (3,)} if "friction" in inputs else {}
    known |= dict.fromkeys(INPUT_PARAMETERS, (count,)) if "parameters" in inputs else {}
    for name, tensor in given.items():
        require(name in known, "physics", f"one of the network's inputs ({', '.join(known) or 'none'})", name)
        _tensor(f"physics {name}", tensor, known[name])
    if "wall_friction" in given:
        fields["wall_friction_S3"] = given["wall_friction"][None].to(start.domain_S3.device)
    if given.keys() - {"wall_friction"}:
        own_NP = input_parameters(scene.material_parameters, {}, count)
        value_NP = torch.tensor(np.tile(NOMINAL_P, (count, 1)) if own_NP is None else own_NP, dtype=torch.float64)
        columns = zip(INPUT_PARAMETERS, value_NP.to(start.domain_S3.device).unbind(-1), strict=True)
        value_NP = torch.stack([given.get(name, value_N).to(value_N) for name, value_N in columns], -1)
        fields["parameter_NP"] = scaled_parameters(value_NP, start.material_N, network.config.materials)
    return {name: None if tensor is None else tensor.to(dtype) for name, tensor in fields.items()}


def _obstacles(
    network: ParticleNetwork, start: ParticleState, scene: Scene, inputs: Inputs
) -> tuple[ObstacleCells | None, Barriers | None]:
    poses, config, device = inputs.poses or {}, network.config, start.position_N3.device
    dtype = next(network.parameters()).dtype
    for number in poses:
        rule = f"0 to {len(scene.obstacles) - 1}" if scene.obstacles else "left out: the scene has no obstacles"
        require(isinstance(number, int) and 0 <= number < len(scene.obstacles), "poses", rule, number)
    if not poses and inputs.smoothing == 0:
        return start.obstacles, start.barriers
    staying = [obstacle for i, obstacle in enumerate(scene.obstacles) if i not in poses and obstacle.motion is None]
    own_poses = ((i, pose) for i, pose in poses.items() if scene.obstacles[i].motion is None)
    placements = {i: _placement(scene.obstacles[i], pose, device, dtype) for i, pose in own_poses}
    obstacles, barriers = None, start.barriers
    if config.obstacle_features:
        far = config.obstacle_distance
        require(not far or inputs.smoothing == 0, "smoothing", "0 with obstacle_distance", inputs.smoothing)
        rest = _cells(scene, staying, device, far)
        placed = tuple((_cells(scene, [scene.obstacles[i]], device, far), pose) for i, pose in placements.items())
        friction_K = rest.surface_rows[:, 3] if any(o.friction for o in scene.obstacles) else None
        own = rest.key_K, rest.normal_K3, rest.cell_size, placed, inputs.smoothing
        obstacles = PosedObstacleCells(*own, friction_K=friction_K, distance_K=rest.distance_K)
    clearance = network.step.obstacle_clearance
    if clearance is not None and placements:
        barriers = _barriers(scene, placements, clearance, device, dtype=dtype)
    return obstacles, barriers


def with_velocities(scene: Scene, poses: Mapping[int, Pose]) -> Scene:
    """Returns the scene in which each obstacle with a velocity in `poses` has a motion: AT_REST if it had none."""
    moving = {number for number, pose in poses.items() if pose.velocity_3 is not None}
    own = (replace(o, motion=o.motion or AT_REST) if i in moving else o for i, o in enumerate(scene.obstacles))
    return replace(scene, obstacles=tuple(own))


def _in_motion(
    state: ParticleState, scene: Scene, poses: Mapping[int, Pose], *, frame_rate_hz: float, frame: int
) -> ParticleState:
    """Returns the state with its moving obstacles as in frame `frame`. `poses` act before the motion of keyframes."""
    if state.moving is None:
        return state
    moving, device = state.moving.at([frame]), state.position_N3.device
    rows = [Poses(*tensors) for tensors in zip(*moving.poses.tensors, strict=True)]
    numbers = [number for number, obstacle in enumerate(scene.obstacles) if obstacle.motion is not None]
    for row, number in enumerate(numbers):
        if number not in poses:
            continue
        own, velocity_3 = rows[row], poses[number].velocity_3
        placement = _placement(scene.obstacles[number], poses[number], device, torch.float64)
        shift_3 = torch.zeros_like(own.shift_V3) if velocity_3 is None else velocity_3.to(own.shift_V3) / frame_rate_hz
        place_3 = own.put(placement.pivot_3 + placement.translation_3)
        rows[row] = replace(
            own,
            rotation_V33=own.rotation_V33 @ placement.rotation_33,
            pivot_V3=placement.pivot_3,
            place_V3=place_3 + frame * shift_3,
            shift_V3=own.velocity(place_3) + shift_3,
        )
    tensors = map(torch.stack, zip(*(row.tensors for row in rows), strict=True))
    return replace(state, moving=replace(moving, poses=Poses(*tensors)))


def _barriers(
    scene: Scene, placements: Mapping[int, Placement], clearance: float, device: torch.device, dtype: torch.dtype
) -> Barriers | None:
    """Returns barriers of the placed obstacles. Rows are differentiable in the poses, lists of cells are not."""
    cell_size, parts = scene.cell_size, []
    for i, obstacle in enumerate(scene.obstacles):
        if obstacle.motion is not None:
            continue
        staying = i not in placements
        # not clipped at the domain: an obstacle may be moved into it
        piece_F33 = barrier_pieces(obstacle.corners, cell_size, scene.domain_size if staying else None)
        corner_F33 = torch.from_numpy(piece_F33).to(device)
        parts.append(corner_F33 if staying else placements[i].to(torch.float64).place(corner_F33))
    corner_F33 = torch.cat(parts)
    barriers = Barriers.of([barrier_of_pieces(corner_F33.detach().cpu().numpy(), cell_size, clearance)])
    return barriers and replace(barriers.to(device), row_F24=barrier_rows(corner_F33, clearance).to(dtype))


def _cells(scene: Scene, obstacles: list[Obstacle], device: torch.device, distance: bool) -> ObstacleCells:
    # not cut at the domain: an obstacle may be moved into it
    grid: ObstacleGrid = build_obstacle_grid(obstacles, scene.cell_size, scene.seed)
    cells = ObstacleCells.of([surface_field(grid, all_corners(obstacles)) if distance else grid])
    if cells is None:
        cells = ObstacleCells(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 3), scene.cell_size)
    return cells.to(device)


def _placement(obstacle: Obstacle, pose: Pose, device: torch.device, dtype: torch.dtype) -> Placement:
    middle_3 = 0.5 * (obstacle.vertex_V3.min(axis=0) + obstacle.vertex_V3.max(axis=0))
    pivot_3 = _tensor("poses pivot_3", torch.as_tensor(middle_3 if pose.pivot_3 is None else pose.pivot_3), (3,))
    parts = {}
    for name in ("rotation_3", "translation_3", "velocity_3"):
        value = getattr(pose, name)
        parts[name] = torch.zeros(3, dtype=torch.float64) if value is None else _tensor(f"poses {name}", value, (3,))
    x, y, z = parts["rotation_3"].to(device, torch.float64).unbind()
    zero = torch.zeros_like(x)
    cross_33 = torch.stack([torch.stack(row) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))])
    rotation_33 = torch.linalg.matrix_exp(cross_33)  # differentiable at angle 0 too
    return Placement(rotation_33.to(dtype), pivot_3.to(device, dtype), parts["translation_3"].to(device, dtype))


def _tensor(name: str, value: Any, shape: tuple[int, ...]) -> torch.Tensor:
    """Returns a tensor of a caller. Raises: ConfigError unless it has this shape and finite real numbers in memory."""
    usable = isinstance(value, torch.Tensor) and value.layout == torch.strided
    usable = usable and not (value.is_meta or value.is_complex())
    require(usable, name, "a dense tensor of real numbers", type(value).__name__)
    require(tuple(value.shape) == shape, name, f"of shape {shape}", tuple(value.shape))
    require(bool(torch.isfinite(value).all()), name, "finite", "nan or inf")
    return torch.as_tensor(value)
