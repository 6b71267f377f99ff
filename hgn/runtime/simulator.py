"""Simulates scenes with a trained network (paper algorithm 1) on one device.

Shape legend: T frames, N particles of all scenes, S scenes, H frames before frame 0, F triangles, P parameters.
"""

from __future__ import annotations

import functools
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hgn.config import DEFAULT_WEIGHTS
from hgn.network.barriers import Barriers
from hgn.network.base import ParticleNetwork
from hgn.network.features import ParticleState, material_rows
from hgn.network.moving import MovingObstacles
from hgn.network.obstacles import ObstacleCells
from hgn.network.own_physics import physics_fields
from hgn.runtime.backend import build, choose, set_matmul_precision
from hgn.runtime.differentiable import Inputs, Pose, simulate, with_velocities
from hgn.runtime.divergence import DivergedError, diverged
from hgn.runtime.simulation import Entry, Simulation, on_host
from hgn.runtime.torch_backend import Backend
from hgn.runtime.torch_stepper import stepped
from hgn.runtime.weights import WeightsInfo, find_weights, load_weights
from hgn.scene.barrier import Barrier, build_barrier
from hgn.scene.emission import at_entry, at_start, entry_frames, require_free_entries
from hgn.scene.episode import Episode
from hgn.scene.episode_obstacles import corners_at_rest, field_around
from hgn.scene.history import ballistic_velocities, require_past
from hgn.scene.material import MATERIALS, elastic_particles
from hgn.scene.moving import MovingObstacle, at_rest, moving_obstacles, moving_of_episode
from hgn.scene.obstacle_grid import ObstacleGrid, build_obstacle_grid
from hgn.scene.own_physics import input_parameters
from hgn.scene.rest_shape import body_numbers, rest_neighbours
from hgn.scene.scene import Obstacle, Scene, all_corners, require_particles, require_vectors, whole_cells
from hgn.schema import Vector, require, require_count, triple
from hgn.system.device import choose_device

LARGEST_GRAVITY = 98.0  # largest supported gravity, domain units per second squared
SAME_GRAVITY = 1e-3  # relative difference below which gravities are equal; estimates of data sets differ by a few 1e-5


@dataclass(frozen=True, eq=False)
class InitialState:
    """The start of a simulation in domain units and seconds."""

    position_N3: np.ndarray
    velocity_N3: np.ndarray
    material_N: np.ndarray  # index into `materials`
    obstacle_grid: ObstacleGrid
    domain_size: tuple[float, float, float]
    gravity: tuple[float, float, float]
    # corners of the obstacles' triangles, float64 [F, 3, 3], for networks with obstacle_clearance; None: only the
    # obstacles' cells are known, and the obstacle constraint does not act
    corners: Callable[[], np.ndarray] | None = None
    materials: tuple[str, ...] = MATERIALS
    past_HN3: np.ndarray | None = None  # frames before frame 0, oldest first; None: free flight before frame 0
    dimensions: int = 3
    emitting: Scene | None = None  # the scene, if particles enter later; these come after the others
    wall_friction: tuple[float, float, float] = (0.0, 0.0, 0.0)
    parameters: np.ndarray | None = None  # float32 [N, P], hgn.scene.own_physics.input_parameters
    body_N: np.ndarray | None = None  # number of each particle's body; None: found from distances of elastic particles
    moving: tuple[MovingObstacle, ...] = ()  # moving obstacles; `obstacle_grid` and `corners` contain those at rest

    def __post_init__(self) -> None:
        require_particles(self.position_N3, self.velocity_N3, self.material_N, self.materials)
        require_vectors(self)
        count = len(self.position_N3)
        for name, axis in (("parameters", 0), ("body_N", 0), ("past_HN3", 1)):
            shape = np.shape(getattr(self, name))
            fits = getattr(self, name) is None or shape[axis : axis + 1] == (count,)
            require(fits, name, f"of {count} particles", shape, remedy="select some of the particles with `selected`")

    def selected(self, chosen_N: np.ndarray | slice) -> InitialState:
        """Returns the start of some of the particles."""
        names = ("position_N3", "velocity_N3", "material_N", "parameters", "body_N")
        some: dict[str, Any] = {name: value[chosen_N] for name in names if (value := getattr(self, name)) is not None}
        return replace(self, **some, past_HN3=None if self.past_HN3 is None else self.past_HN3[:, chosen_N])

    @staticmethod
    def of_episode(episode: Episode) -> InitialState:
        """Returns frame 0 of an episode."""
        return InitialState(
            position_N3=np.array(episode.position_TN3[0]),
            velocity_N3=episode.initial_velocity_N3,
            material_N=episode.material_N,
            obstacle_grid=episode.obstacle_grid,
            domain_size=episode.domain_size,
            gravity=episode.gravity,
            corners=lambda: corners_at_rest(episode.specification),
            materials=episode.materials,
            past_HN3=episode.past_HN3,
            dimensions=episode.dimensions,
            wall_friction=episode.wall_friction,
            parameters=episode.parameters,
            body_N=body_numbers(episode),
            moving=moving_of_episode(episode),
        )

    @staticmethod
    def of_scene(scene: Scene) -> InitialState:
        """Returns a scene's initial particles. Obstacles become cells.

        Raises: ConfigError if the domain is not a whole number of solver cells, which the solver refuses too.
        """
        whole_cells(scene.domain_size, scene.cell_size)
        first, own = at_start(scene), (at_rest(scene.obstacles), scene.cell_size, scene.seed, triple(scene.domain_size))
        grid, corners = _at_rest(*own)
        return InitialState(
            position_N3=first.position_N3,
            velocity_N3=first.velocity_N3,
            material_N=first.material_N,
            obstacle_grid=grid,
            domain_size=scene.domain_size,
            gravity=scene.gravity,
            corners=corners,
            emitting=scene if scene.emits else None,
            wall_friction=scene.wall_friction,
            parameters=input_parameters(first.material_parameters, {}, first.particle_count),
            body_N=body_numbers(first),
            moving=moving_obstacles(scene.obstacles, scene.cell_size),
        )

    @staticmethod
    def of(scene: InitialState | Scene) -> InitialState:
        """Returns the initial state of a scene, or the given one."""
        require(isinstance(scene, (Scene, InitialState)), "scene", "a Scene or an InitialState", type(scene).__name__)
        return InitialState.of_scene(scene) if isinstance(scene, Scene) else scene

    @functools.cached_property
    def field(self) -> ObstacleGrid:
        """Returns hgn.scene.surface_field around the obstacles at rest."""
        corner_F33 = np.zeros((0, 3, 3)) if self.corners is None else self.corners()
        return field_around(self.obstacle_grid, corner_F33, self.domain_size)

    def surfaces(self, distance: bool) -> ObstacleGrid:
        """Returns the field with `distance` (network.obstacle_distance), else the paper's cells."""
        return self.field if distance else self.obstacle_grid

    @functools.cached_property
    def rest_neighbours(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns hgn.scene.rest_shape.rest_neighbours of this state, in which elastic bodies have their rest shape."""
        return rest_neighbours(self.position_N3, elastic_particles(self.material_N, self.materials), self.body_N)

    def velocities(self, history: int, frame_rate_hz: float) -> np.ndarray:
        """Returns displacements in the last frames, newest first, float32 [N, history, 3], domain units per frame.

        Raises: ConfigError if fewer earlier frames are known.
        """
        if self.past_HN3 is None:
            gravity_3 = np.array(self.gravity, np.float64) / frame_rate_hz**2
            return ballistic_velocities(self.velocity_N3 / frame_rate_hz, gravity_3, history)
        require_past(self.past_HN3, history)
        path_TN3 = np.concatenate([self.past_HN3[len(self.past_HN3) - history :], self.position_N3[None]])
        return np.ascontiguousarray(np.diff(path_TN3, axis=0)[::-1].transpose(1, 0, 2))

    def barrier(self, clearance: float) -> Barrier:
        """Returns the barrier of the obstacles. Raises: ConfigError for a clearance of more than a cell."""
        corner_F33 = np.zeros((0, 3, 3)) if self.corners is None else self.corners()
        return build_barrier(corner_F33, self.obstacle_grid.cell_size, clearance, self.domain_size)


class Simulator:
    """Simulates scenes with a trained network, one scene or several at the same time."""

    def __init__(
        self,
        network: ParticleNetwork,
        frame_rate_hz: float,
        backend: str | Backend = "auto",
        precision: str = "auto",
        info: WeightsInfo | None = None,
    ) -> None:
        """`backend` is a backend of hgn.runtime.backend, or a name: torch, triton or cpu.

        A named backend is used even if this machine does not support it. auto is the fastest supported backend. `info`
        is the metadata of the weights file.
        """
        self.network, self.frame_rate_hz, self._info = network, frame_rate_hz, info
        self.device = next(network.parameters()).device
        if isinstance(backend, str):
            auto = backend == "auto"
            backend = choose(self.device, network, precision) if auto else build(backend, network, precision)
        self.backend = backend

    @staticmethod
    def load(
        weights: str | Path = DEFAULT_WEIGHTS, device: str = "auto", backend: str = "auto", precision: str = "auto"
    ) -> Simulator:
        """Loads exported weights: a file, or the name of shipped weights. The options are those of hgn.rollout.

        It also sets the precision of PyTorch's own float32 products.
        Raises: ConfigError if weights, device or backend do not exist or do not fit each other.
        """
        place = choose_device(device)
        network, info = load_weights(find_weights(str(weights)), place)
        chosen = choose(place, network, precision, backend)
        set_matmul_precision(chosen.precision)
        return Simulator(network, info.frame_rate_hz, chosen, info=info)

    @property
    def info(self) -> WeightsInfo:
        """Returns the metadata of the weights file. Only simulators from `load`, or with `info`, have it."""
        assert self._info is not None
        return self._info

    @property
    def materials(self) -> tuple[str, ...]:
        """Returns the materials that scenes can have: those of the weights' data, or without `info` the network's."""
        return self._info.data_materials if self._info else self.network.config.materials

    def start(self, scenes: Sequence[InitialState | Scene]) -> ParticleState:
        """Returns the state at frame 0, with the scenes' past frames or a ballistic history.

        Raises: ConfigError if a scene has a material that the network was not trained with. For loaded weights it is
        also raised for obstacle cells of another size and for an unsupported gravity. Absolute inputs support only the
        gravity of their data; relative inputs support up to LARGEST_GRAVITY. Particles may be at most the domain's size
        away from it.
        """
        config, states = self.network.config, initial_states(scenes)
        for state in states:
            self.require_fits(state)
        gravity_S3 = np.array([state.gravity for state in states], np.float64).reshape(-1, 3) / self.frame_rate_hz**2
        velocities = [state.velocities(config.velocity_history, self.frame_rate_hz) for state in states]
        material_N = torch.cat([material_rows(s.material_N, config.materials, s.materials) for s in states])
        counts = [len(state.position_N3) for state in states]
        position_N3 = np.concatenate([state.position_N3 for state in states]).astype(np.float32)
        barriers = None
        clearance = self.network.step.obstacle_clearance
        if clearance is not None:
            barriers = Barriers.of([state.barrier(clearance) for state in states])
        physics = physics_fields(config, states, material_N)
        start = ParticleState(
            position_N3=torch.from_numpy(position_N3).to(self.device),
            velocity_NM3=torch.from_numpy(np.concatenate(velocities)).to(self.device),
            material_N=material_N.to(self.device),
            scene_N=torch.from_numpy(np.repeat(np.arange(len(states)), counts)).to(self.device),
            domain_S3=torch.tensor([state.domain_size for state in states], dtype=torch.float32).to(self.device),
            gravity_S3=torch.from_numpy(gravity_S3.astype(np.float32)).to(self.device),
            obstacles=self.obstacles(states),
            barriers=barriers and barriers.to(self.device),
            moving=self.moving(states, [0] * len(states)),
            **{name: tensor.to(self.device) for name, tensor in physics.items()},
        )
        far_N = diverged(start.position_N3, start.domain_S3[start.scene_N])
        rule = "finite and no farther from the domain than its own size"
        require(not bool(far_N.any()), "position_N3", rule, start.position_N3[far_N][:1].flatten().tolist())
        return start

    def obstacles(self, scenes: Sequence[InitialState]) -> ObstacleCells | None:
        """Returns the obstacle cells of scenes on the device, or None for a network without obstacle features."""
        if not self.network.config.obstacle_features:
            return None
        distance = self.network.config.obstacle_distance
        obstacles = ObstacleCells.of([scene.surfaces(distance) for scene in scenes])
        return obstacles and obstacles.to(self.device)

    def moving(self, scenes: Sequence[InitialState], frames: Sequence[int]) -> MovingObstacles | None:
        """Returns the moving obstacles of scenes on the device, scene s at frames[s] after its start."""
        config, clearance = self.network.config, self.network.step.obstacle_clearance
        own = [scene.moving for scene in scenes]
        moving = MovingObstacles.of(own, frames, 1 / self.frame_rate_hz, config, clearance=clearance)
        return moving and moving.to(self.device)

    def step(self, state: ParticleState) -> ParticleState:
        """Returns the state one frame later."""
        return stepped(self.backend.predict, state, self.backend.step, self.network.config.dimensions)

    def rollout(
        self, scenes: Sequence[InitialState | Scene], frames: int, on_frame: Callable[[int], None] | None = None
    ) -> list[np.ndarray]:
        """Simulates `frames` frames including frame 0. Returns float32 [frames, N, 3] for each scene.

        A particle that enters later is NaN until it enters. `on_frame(t)` is called after frame t.
        Raises: ConfigError as `start`; DivergedError with the frame of divergence; only more training prevents it.
        """
        return self.paths(scenes, frames, on_frame)[0]

    def paths(
        self,
        scenes: Sequence[InitialState | Scene],
        frames: int,
        on_frame: Callable[[int], None] | None = None,
        isolate: bool = False,
        stop: Callable[[], bool] = lambda: False,
    ) -> tuple[list[np.ndarray], dict[int, DivergedError]]:
        """Does the same as `rollout`, and returns the causes of divergence by scene number.

        With `isolate` a diverged scene is NaN from that frame, and the others continue. The frames end when `stop`
        returns True.
        """
        require_count("frames", frames, 1)
        states = initial_states(scenes)
        entries = [entry for entry in self._entries(states) if entry.frame < frames]
        state = self.start(states)
        scene_N = torch.cat([state.scene_N, *(entry.state.scene_N for entry in entries)]).cpu().numpy()
        first_N3 = np.full((len(scene_N), 3), np.nan, np.float32)
        first_N3[: len(state.position_N3)] = state.position_N3.cpu().numpy()
        with self.simulation(state, len(scene_N), isolate, entries) as simulation:
            position_TN3 = np.concatenate([first_N3[None], simulation.run(frames - 1, on_frame, stop)])
        if entries:
            return [position_TN3[:, scene_N == scene] for scene in range(len(states))], simulation.ended
        ends = np.cumsum(np.bincount(scene_N, minlength=len(states)))[:-1]
        return np.split(position_TN3, ends, axis=1), simulation.ended

    def frames(self, scene: InitialState | Scene, count: int = sys.maxsize) -> Iterator[np.ndarray]:
        """Yields positions float32 [N, 3] of `count` frames, without end by default, starting with the initial ones.

        Backend triton computes some frames ahead. Several scenes may be simulated at the same time by separate calls.
        Raises: ConfigError as `start`, before the first frame is taken; DivergedError after the last good frame.
        """
        require_count("count", count, 1)
        states = initial_states([scene])
        entries = self._entries(states)
        return self._frames(self.start(states), entries, count)

    def _frames(self, state: ParticleState, entries: Sequence[Entry], count: int) -> Iterator[np.ndarray]:
        yield state.position_N3.cpu().numpy()
        capacity = len(state.position_N3) + sum(len(entry.state.position_N3) for entry in entries)
        with self.simulation(state, capacity, entries=entries) as simulation:
            for block_TN3 in simulation.blocks(count - 1):
                yield from on_host(block_TN3)

    def simulation(
        self, state: ParticleState, capacity: int = 0, isolate: bool = False, entries: Sequence[Entry] = ()
    ) -> Simulation:
        """Starts a simulation of a state. Backend triton allocates buffers for `capacity` particles."""
        return Simulation(functools.partial(self.backend.stepper, capacity=capacity), state, isolate, entries)

    def _entries(self, states: Sequence[InitialState]) -> list[Entry]:
        """Returns the particles that enter the scenes, by frame. Raises: ConfigError for an obstacle in their way."""
        entries = []
        for number, state in enumerate(states):
            if state.emitting is None:
                continue
            entered = at_entry(state.emitting, self.frame_rate_hz)
            entry_N = entry_frames(state.emitting, self.frame_rate_hz)
            require_free_entries(state.emitting, entered)
            for frame in sorted({*entry_N[len(state.position_N3) :].tolist()}):
                own = entered.selected(entry_N == frame)
                particles: dict[str, Any] = {
                    name: getattr(own, name) for name in ("position_N3", "velocity_N3", "material_N")
                }
                particles["parameters"] = input_parameters(own.material_parameters, {}, own.particle_count)
                particles |= {"corners": None, "body_N": None, "moving": ()}  # barriers are slow and not needed
                new = self.start([replace(state, **particles)])
                entries.append(Entry(frame, replace(new, scene_N=new.scene_N + number)))
        return sorted(entries, key=lambda entry: entry.frame)

    def differentiable(
        self,
        scene: Scene,
        frames: int,
        *,
        position_N3: torch.Tensor | None = None,
        velocity_N3: torch.Tensor | None = None,
        gravity_3: torch.Tensor | None = None,
        domain_size_3: torch.Tensor | None = None,
        poses: Mapping[int, Pose] | None = None,
        smoothing: float = 0.0,
        **physics: torch.Tensor,
    ) -> torch.Tensor:
        """Computes `rollout` of a scene with gradients: positions [frames, N, 3], a tensor in the network's precision.

        Arguments replace the scene's own values: positions and velocities [N, 3], gravity [3] (relative inputs only),
        the domain's size [3], and by name wall_friction [3] and parameters [N] that are inputs of the network. Units
        are domain units and seconds. `poses` rotates and shifts obstacles by number. `smoothing`, 0 to 1 obstacle
        cells, makes normals continuous (hgn.network.posed_obstacles). PyTorch computes it with one frame's intermediate
        results in memory. docs/how_to/gradients.md lists quantities with gradients.
        Raises: ConfigError and DivergedError as `rollout`.
        """
        require(isinstance(scene, Scene), "scene", "a Scene", type(scene).__name__)
        require(not scene.emits, "emitters", "left out here", "some", remedy="use rollout")
        posed = isinstance(poses, Mapping | None) and all(isinstance(pose, Pose) for pose in (poses or {}).values())
        require(posed, "poses", "a Pose by the number of its obstacle", poses)
        inputs = Inputs(position_N3, velocity_N3, gravity_3, domain_size_3, poses=poses, smoothing=smoothing)
        inputs = replace(inputs, physics=physics)
        scene = with_velocities(scene, poses or {})
        return simulate(self.network, self.start([scene]), scene, self.frame_rate_hz, frames=frames, inputs=inputs)

    def require_fits(self, scene: InitialState) -> None:
        """Raises ConfigError if loaded weights do not fit a scene."""
        info, cell_size = self._info, scene.obstacle_grid.cell_size
        dimensions = self.network.config.dimensions
        rule = f"the network's {dimensions}"
        remedy = f"use weights of {scene.dimensions}D data, or an episode of {dimensions}D data"
        require(scene.dimensions == dimensions, "dimensions", rule, scene.dimensions, remedy=remedy)
        known = "moving" in self.network.config.own_physics
        remedy = "use weights=own_physics, leave keyframes out, or run datagen.solve"
        rule = "at rest for a network without `moving` in network.own_physics"
        require(known or not scene.moving, "obstacles", rule, "keyframes", remedy=remedy)
        material_rows(scene.material_N, self.materials, scene.materials)
        if info is None:
            return
        if info.network.relative:
            rule = f"at most {LARGEST_GRAVITY:g} in size, ten times the earth's"
            require(math.hypot(*scene.gravity) <= LARGEST_GRAVITY, "gravity", rule, scene.gravity)
        else:
            rule = f"the weights' {info.gravity}, because a network with absolute inputs has no gravity as input"
            remedy = "use weights with relative inputs, such as mechanics, or train on scenes with this gravity"
            same = math.dist(scene.gravity, info.gravity) <= SAME_GRAVITY * math.hypot(*info.gravity)
            require(same, "gravity", rule, scene.gravity, remedy=remedy)
        if info.network.obstacle_features:
            rule = f"the weights' {info.obstacle_cell_size}, the size of the obstacle cells in their data"
            require(cell_size == info.obstacle_cell_size, "cell_size", rule, cell_size)


@functools.lru_cache(maxsize=1)
def _at_rest(
    obstacles: tuple[Obstacle, ...], cell_size: float, seed: int, domain_size: Vector
) -> tuple[ObstacleGrid, Callable[[], np.ndarray]]:
    """Returns cells and corners of obstacles at rest. They stay the same objects while others move."""
    grid = build_obstacle_grid(obstacles, cell_size, seed, domain_size)
    return grid, lambda: all_corners(obstacles)


def initial_states(scenes: Sequence[InitialState | Scene]) -> list[InitialState]:
    """Returns the initial states of a list of scenes. Raises: ConfigError for another type or no scene."""
    example = "as in rollout([scene], frames)"
    require(isinstance(scenes, Iterable), "scenes", "a list of scenes", type(scenes).__name__, remedy=example)
    states = [InitialState.of(scene) for scene in scenes]
    require(len(states) > 0, "scenes", "at least one", 0)
    return states
