"""A scene that changes while it is simulated: particles enter, obstacles and gravity change, time goes back.

Shape legend: N particles, A particles that enter, M velocities of a history.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from numbers import Integral
from typing import Any

import numpy as np
import torch

from hgn.network.barriers import Barriers
from hgn.network.features import ParticleState
from hgn.network.moving import MovingObstacles
from hgn.runtime.divergence import DivergedError
from hgn.runtime.simulation import joined
from hgn.runtime.simulator import InitialState, Simulator, initial_states
from hgn.scene.barrier import Barrier
from hgn.scene.motion import Motion
from hgn.scene.moving import MovingObstacle
from hgn.scene.rotation import euler_rotation
from hgn.scene.scene import Scene
from hgn.schema import Vector, require, require_count, require_vector


class LiveSimulation(AbstractContextManager["LiveSimulation"]):
    """One scene or several, a frame at a time, on the simulator's backend. Use it as a context manager, or close it.

    A change between two frames affects scene `index` from the next frame on. Particles that it does not add, remove or
    restore keep positions and velocity histories bitwise. Particles are sorted by scene, new ones last in each.
    """

    def __init__(
        self, simulator: Simulator, scenes: InitialState | Scene | Sequence[InitialState | Scene], capacity: int = 0
    ) -> None:
        """If `scenes` is a list, a scene that diverges loses its particles, and `ended[index]` is the error.

        Backend triton allocates buffers for `capacity` particles of all scenes together. With more particles it
        captures its CUDA graph again, which takes about a second.
        Raises: ConfigError as `Simulator.start`.
        """
        require(isinstance(simulator, Simulator), "simulator", "a Simulator", type(simulator).__name__)
        require_count("capacity", capacity, 0)
        self.simulator = simulator
        given = [scenes] if isinstance(scenes, (InitialState, Scene)) else scenes
        self.scenes = initial_states(given)
        self.ended: dict[int, DivergedError] = {}
        moving = simulator.moving(self.scenes, [0] * len(self.scenes))
        state = replace(self._started(self.scenes), obstacles=simulator.obstacles(self.scenes), moving=moving)
        clearance = simulator.network.step.obstacle_clearance
        self._barriers = [] if clearance is None else [scene.barrier(clearance) for scene in self.scenes]
        state = replace(state, barriers=self._joined(self._barriers))
        self.simulation = simulator.simulation(state, capacity, isolate=given is scenes)
        self._closed = False
        self._changed: ParticleState | None = None  # state from which the next frame starts; None without changes
        # for `restore`: moving obstacles of each scene before each of its moves, with the frame of their keyframes
        self._before_moves: list[list[tuple[int, tuple[MovingObstacle, ...]]]] = [[] for _ in self.scenes]

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Returns the simulation's buffers to the backend, which uses them for the next simulation."""
        self._closed = True
        self.simulation.close()

    @property
    def frame(self) -> int:
        """Returns the number of the last frame. It can be set."""
        return self.simulation.frame

    @frame.setter
    def frame(self, frame: int) -> None:
        require_count("frame", frame, 0)
        state = self.state
        self.simulation.frame, self._changed = frame, replace(state, frame_S=torch.full_like(state.frame_S, frame))

    @property
    def frames(self) -> tuple[int, ...]:
        """Returns the number of each scene's last frame. They differ after `reset` or `restore` of one of several."""
        frame_S = self.simulation.scene_frames if self._changed is None else self._changed.frame_S
        return tuple(frame_S.tolist())

    @property
    def state(self) -> ParticleState:
        """Returns the input of the network for the next frame, on the simulator's device; read-only."""
        return self.simulation.state if self._changed is None else self._changed

    @property
    def particle_count(self) -> int:
        return self.simulation.particle_count if self._changed is None else len(self._changed.material_N)

    def advance(self) -> ParticleState:
        """Simulates one frame of all scenes. Returns `state`, whose tensors stay on the device.

        Raises: DivergedError for a scene that is not in a list. The simulation can then only be restored or closed.
        """
        self._require_scene(0)
        if self._changed is not None:
            self.simulation.continue_from(self._changed)
            self._changed = None
        for _ in self.simulation.blocks(1):
            pass
        self.ended |= self.simulation.ended
        return self.state

    def step(self) -> np.ndarray:
        """Simulates one frame. Returns positions on the host, float32 [N, 3] in domain units. Raises as `advance`."""
        return self.advance().position_N3.numpy(force=True).copy()

    def reset(self, index: int, scene: InitialState | Scene) -> None:
        """Restarts a scene, or starts another one in its place, with any number of particles.

        Obstacles at rest are prepared again unless `obstacle_grid`, `corners` and the domain size are as before.
        Backend triton captures its CUDA graph again for another domain size. Raises: ConfigError as `Simulator.start`.
        """
        self._require_scene(index)
        start, state = InitialState.of(scene), self.state
        self._put(index, start, state.selected(state.scene_N != index), self._started([start]), restart=True)
        self.ended.pop(index, None)
        self.simulation.frame = max(self.frames)

    def add_particles(
        self, position_A3: np.ndarray, velocity_A3: np.ndarray, material_A: np.ndarray, index: int = 0
    ) -> np.ndarray:
        """Adds particles with default parameters and a history of free flight. `material_A` are indices into MATERIALS.

        Positions are in domain units, velocities in domain units per second. Particles inside obstacles, and up to the
        domain's size outside, are accepted. Returns the particles' velocity histories, float32 [A, M, 3] in domain
        units per frame, newest first. Raises: ConfigError for positions farther outside, for a material that the
        network was not trained with, and for arrays of different lengths.
        """
        self._require_scene(index)
        require(index not in self.ended, "index", "the index of a scene in progress", index, remedy="reset it")
        count = len(_array("position_A3", position_A3, (None, 3)))
        _array("velocity_A3", velocity_A3, (count, 3))
        _array("material_A", material_A, (count,))
        require(material_A.dtype.kind in "iu", "material_A", "whole numbers", str(material_A.dtype))
        arrays: dict[str, Any] = {"position_N3": position_A3, "velocity_N3": velocity_A3, "material_N": material_A}
        new = self._started([replace(self.scenes[index], **arrays, past_HN3=None, parameters=None, body_N=None)])
        if count:
            self._put(index, self.scenes[index], self.state, new)
        return new.velocity_NM3.cpu().numpy()

    def replace_obstacles(self, scene: InitialState | Scene, index: int = 0) -> None:
        """Replaces the obstacles by those of another scene. Times of their keyframes count from now.

        Particles of the other scene are ignored. Raises: ConfigError as `Simulator.start`.
        """
        other = InitialState.of(scene)
        own = {"obstacle_grid": other.obstacle_grid, "corners": other.corners, "moving": other.moving}
        self._change_scene(index, **own)

    def move_obstacle(
        self, number: int, translation: Vector, rotation: Vector = (0.0, 0.0, 0.0), index: int = 0
    ) -> None:
        """Moves an obstacle evenly during the next frame, and ends its keyframes. It then rests until moved again.

        `number` counts the scene's obstacles with keyframes. Translation (domain units) and rotation (degrees) are
        relative to its entry, as in a keyframe. It turns the shorter way, so less than half a turn in a frame. Each
        move takes about 1 KB for `restore`, until `reset`.
        Raises: ConfigError if there is no such obstacle, and as keyframes do.
        """
        self._require_scene(index)
        moving, own = self.state.moving, [*self.scenes[index].moving]
        rule = f"0 to {len(own) - 1}, an obstacle" if own else "left out: the scene has no obstacles"
        _require_index("number", number, len(own), f"{rule} with keyframes")
        for name, value in (("translation", translation), ("rotation", rotation)):
            require_vector(name, value)
        assert moving is not None
        before, time_T = own[number].motion, (moving.frames[index] + np.arange(2)) * moving.frame_s
        turn_33, shift_3 = before.pose(time_T[0])
        shift_T3, later_33 = np.stack([shift_3, translation]), euler_rotation(rotation)
        own[number] = replace(own[number], motion=Motion(time_T, shift_T3, np.stack([turn_33, later_33]), before.pivot))
        self._before_moves[index].append((moving.frames[index], self.scenes[index].moving))
        self._changed = replace(self.state, moving=self._moved(moving, moving.frames, index, own))

    def set_gravity(self, gravity: tuple[float, float, float], index: int = 0) -> None:
        """Replaces gravity, in domain units per second squared.

        Raises: ConfigError for weights with absolute inputs, which support only the gravity of their data.
        """
        self._change_scene(index, gravity=gravity)

    def restore(self, position_N3: np.ndarray, velocity_NM3: np.ndarray, frame: int, index: int = 0) -> None:
        """Restores an earlier frame of a scene with its N particles of that time. Those that entered later are removed.

        Gravity and obstacles stay, but moving obstacles jump to their poses in that frame. Keyframes continue,
        without the moves made since. `frame` becomes the number of the last frame.

        position_N3: float32, domain units. velocity_NM3: float32, domain units per frame, newest first. frame: the
        scene's number in `frames` at that time.
        Raises: ConfigError for a later frame.
        """
        self._require_scene(index)
        state, number = self.state, self.frames[index]
        mine_N = state.scene_N == index
        require_count("frame", frame, 0)
        require(frame <= number, "frame", f"at most {number}, the scene's last frame", frame)
        count = len(_array("position_N3", position_N3, (None, 3)))
        _array("velocity_NM3", velocity_NM3, (count, *state.velocity_NM3.shape[1:]))
        most = int(mine_N.sum())
        require(count <= most, "position_N3", f"at most {most} particles", count)
        device = self.simulator.device
        start = replace(
            state.selected(torch.nonzero(mine_N)[:count, 0]),
            position_N3=torch.tensor(position_N3, dtype=torch.float32).to(device),
            velocity_NM3=torch.tensor(velocity_NM3, dtype=torch.float32).to(device),
        )
        if state.moving is not None:
            frames = [*state.moving.frames]
            frames[index] = max(0, frames[index] + frame - number)
            own, moves = self.scenes[index].moving, self._before_moves[index]
            while moves and moves[-1][0] >= frames[index]:
                own = moves.pop()[1]
            state = replace(state, moving=self._moved(state.moving, frames, index, own))
        self.simulation.frame = frame
        self._continue(self._at(state.selected(~mine_N), index, frame), start)

    def _moved(
        self, moving: MovingObstacles, frames: Sequence[int], index: int, own: Sequence[MovingObstacle]
    ) -> MovingObstacles:
        """Gives the moving obstacles of scene `index` other motions, and returns those of all scenes at `frames`."""
        self.scenes = [*self.scenes]
        self.scenes[index] = replace(self.scenes[index], moving=tuple(own))
        return replace(moving, scenes=tuple(scene.moving for scene in self.scenes)).at(frames)

    @staticmethod
    def _at(state: ParticleState, index: int, frame: int) -> ParticleState:
        """Returns the state with scene `index` at another frame."""
        frame_S = state.frame_S.clone()
        frame_S[index] = frame
        return replace(state, frame_S=frame_S)

    def _require_scene(self, index: int) -> None:
        require(not self._closed, "simulation", "open", "closed", remedy="start another one")
        _require_index("index", index, len(self.scenes), f"0 to {len(self.scenes) - 1}, a scene of the batch")

    def _started(self, scenes: Sequence[InitialState]) -> ParticleState:
        """Returns the start of scenes without their obstacles, which often do not change and are slow to prepare."""
        bare = []
        for scene in scenes:
            remedy = "use Simulator.frames, or add_particles"
            require(scene.emitting is None, "emitters", "left out here", "some", remedy=remedy)
            grid = scene.obstacle_grid
            no_cells = replace(grid, cell_K3=grid.cell_K3[:0], normal_K3=grid.normal_K3[:0])
            self.simulator.require_fits(scene)
            bare.append(replace(scene, obstacle_grid=no_cells, corners=None, moving=()))
        return self.simulator.start(bare)

    def _change_scene(self, index: int, **changes: Any) -> None:
        """Changes a scene, but not its particles."""
        self._require_scene(index)
        scene = replace(self.scenes[index], **changes)
        self._put(index, scene, self.state, self._started([scene.selected(slice(0))]))

    def _put(
        self, index: int, scene: InitialState, kept: ParticleState, new: ParticleState, restart: bool = False
    ) -> None:
        """Replaces scene `index` by `scene`. The next frame starts from the particles of `kept` and `new`.

        Keyframes count from this frame if `restart`, or if `scene` has other moving obstacles than before.
        """
        before, scenes, barriers = self.scenes[index], [*self.scenes], [*self._barriers]
        scenes[index] = scene
        changed: dict[str, Any] = {}
        other_solid = _solid(scene) != _solid(before)
        # with obstacle_distance cells depend on both
        if scene.obstacle_grid is not before.obstacle_grid or other_solid:
            changed["obstacles"] = self.simulator.obstacles(scenes)
        if restart or scene.moving is not before.moving:
            frames = [0] * len(scenes) if kept.moving is None else [*kept.moving.frames]
            frames[index] = 0
            changed["moving"] = self.simulator.moving(scenes, frames)
        if barriers and other_solid:
            barriers[index] = scene.barrier(barriers[index].clearance)
            changed["barriers"] = self._joined(barriers)
        for name in ("domain_S3", "gravity_S3", "wall_friction_S3"):
            values_S3, own_S3 = getattr(kept, name), getattr(new, name)  # None without friction of walls
            if values_S3 is not None or own_S3 is not None:
                changed[name] = torch.zeros_like(kept.domain_S3) if values_S3 is None else values_S3.clone()
                changed[name][index] = 0 if own_S3 is None else own_S3[0]
        kept = replace(self._at(kept, index, 0) if restart else kept, **changed)
        self._continue(kept, replace(new, scene_N=new.scene_N + index))
        self.scenes, self._barriers = scenes, barriers
        if "moving" in changed:
            self._before_moves[index] = []

    def _continue(self, kept: ParticleState, new: ParticleState) -> None:
        """Takes kept and new particles, sorted by scene, for the next frame."""
        order_N = torch.argsort(torch.cat([kept.scene_N, new.scene_N]), stable=True)
        both: dict[str, Any] = {name: value[order_N] for name, value in joined(kept, new).items()}
        self._changed = replace(kept, **both)

    def _joined(self, barriers: Sequence[Barrier]) -> Barriers | None:
        joined = Barriers.of(barriers)
        return joined and joined.to(self.simulator.device)


def _array(name: str, value: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    """Returns a caller's argument. Raises: ConfigError unless it is an array of finite real numbers with the shape."""
    require(isinstance(value, np.ndarray), name, "a NumPy array", type(value).__name__)
    require(value.dtype.kind in "iuf", name, "of real numbers", str(value.dtype))
    fits = value.ndim == len(shape) and all(n in (None, own) for n, own in zip(shape, value.shape, strict=True))
    require(fits, name, f"of shape {shape}".replace("None", "any"), value.shape)
    unusable = value[~np.isfinite(value)]
    require(not len(unusable), name, "finite", float(unusable[0]) if len(unusable) else 0.0)
    return np.asarray(value)


def _require_index(name: str, value: int, count: int, rule: str) -> None:
    valid = isinstance(value, Integral) and not isinstance(value, bool) and 0 <= value < count
    require(valid, name, rule, value)


def _solid(scene: InitialState) -> tuple[Any, ...]:
    """Returns the values on which a scene's barrier and field of distances depend."""
    return scene.corners, scene.domain_size, scene.obstacle_grid.cell_size
