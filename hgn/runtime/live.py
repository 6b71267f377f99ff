"""A scene that changes while it is simulated: particles enter, obstacles and gravity are replaced, time goes back.

Shape legend: N particles, A particles that enter, M velocities of a history.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from types import TracebackType
from typing import Any

import numpy as np
import torch

from hgn.network.features import ParticleState
from hgn.runtime.divergence import DivergedError
from hgn.runtime.simulator import InitialState, Simulator
from hgn.runtime.stepped_rollout import Rollout
from hgn.scene.emission import at_entry, at_start, entry_frames, require_free_entries
from hgn.scene.scene import Scene
from hgn.schema import require


class LiveSimulation:
    """One scene, a frame at a time, by whatever backend the simulator has. Use it as a context manager, or close it.

    What is changed between two frames counts from the next frame on; positions and velocity histories of the particles
    stay as they are, bit for bit. Particles keep their order, and those that enter come behind them.
    """

    def __init__(self, simulator: Simulator, scene: InitialState | Scene, room: int = 0) -> None:
        """`room`: particles that backend triton makes room for. More than that, and it captures its frame anew, which
        takes about a second.

        Raises: ConfigError as `Simulator.start`.
        """
        self.simulator, self.room, self.frame = simulator, room, 0
        self.scene = InitialState.of(scene)
        self._entered = ExitStack()
        self._rollout: Rollout | None = None
        self._state = simulator.start([self.scene])
        self._go_on_with(self._state)

    def __enter__(self) -> LiveSimulation:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Gives the simulation's buffers back to the backend, which keeps them for the next."""
        self._rollout = None
        self._entered.close()

    @property
    def state(self) -> ParticleState:
        """What the network is told before the next frame, on the simulator's device; not to be written to."""
        if self._rollout is None:
            return self._state
        position_N3, velocity_NM3 = self._rollout.motion()
        return replace(self._state, position_N3=position_N3, velocity_NM3=velocity_NM3)

    @property
    def particle_count(self) -> int:
        return len(self._state.material_N)

    def step(self) -> np.ndarray:
        """Positions one frame later, float32 [N, 3] in domain units.

        Raises: DivergedError. The simulation can then only be restored, or closed.
        """
        self.frame += 1
        if self._rollout is None:
            return self._state.position_N3.cpu().numpy()
        try:
            return np.asarray(self._rollout.run(1)[0])
        except DivergedError as error:
            raise DivergedError(self.frame, error.cause) from None

    def add_particles(self, position_A3: np.ndarray, velocity_A3: np.ndarray, material_A: np.ndarray) -> np.ndarray:
        """Particles enter, in free flight until now: domain units, domain units per second, indices into MATERIALS.

        Returns: their velocity histories, float32 [A, M, 3] in domain units per frame, newest first.
        Raises: ConfigError for a material that the network does not know, or arrays that do not fit each other.
        """
        count = len(position_A3)
        for name, value, shape in (
            ("position_A3", position_A3, (count, 3)),
            ("velocity_A3", velocity_A3, (count, 3)),
            ("material_A", material_A, (count,)),
        ):
            require(isinstance(value, np.ndarray), name, "a NumPy array", type(value).__name__)
            require(value.shape == shape, name, f"of shape {shape}", value.shape)
            unusable = np.asarray(value)[~np.isfinite(value)]
            require(not len(unusable), name, "finite", float(unusable[0]) if len(unusable) else 0.0)
        require(material_A.dtype.kind in "iu", "material_A", "whole numbers", str(material_A.dtype))
        entering = replace(self.scene, position_N3=position_A3, velocity_N3=velocity_A3, material_N=material_A)
        new = self.simulator.start([replace(entering, corners=None)])  # barriers stay, and would take time
        if count:
            old = self.state
            names = ("position_N3", "velocity_NM3", "material_N", "scene_N")
            joined: dict[str, Any] = {name: torch.cat([getattr(old, name), getattr(new, name)]) for name in names}
            self._go_on_with(replace(old, **joined))
        return new.velocity_NM3.cpu().numpy()

    def replace_obstacles(self, scene: InitialState | Scene) -> None:
        """The obstacles are those of another scene from now on, at rest; its particles do not matter.

        Raises: ConfigError as `Simulator.start`.
        """
        other = InitialState.of(scene)
        of_obstacles = ("obstacle_grid", "corners")
        obstacles: dict[str, Any] = {name: getattr(other, name) for name in of_obstacles}
        self._change_scene(replace(self.scene, **obstacles), ("obstacles", "barriers"))

    def set_gravity(self, gravity: tuple[float, float, float]) -> None:
        """Gravity from now on, domain units per second squared.

        Raises: ConfigError for what the weights cannot take: absolute inputs know that of their data alone.
        """
        self._change_scene(replace(self.scene, gravity=gravity), ("gravity_S3",))

    def restore(self, position_N3: np.ndarray, velocity_NM3: np.ndarray, frame: int) -> None:
        """Goes back to what the first particles of the simulation did at an earlier frame: those that entered later
        leave. Obstacles and gravity stay.

        position_N3: float32, domain units. velocity_NM3: float32, domain units per frame, newest first.
        """
        count, expected = len(position_N3), (len(position_N3), *self._state.velocity_NM3.shape[1:])
        require(np.shape(velocity_NM3) == expected, "velocity_NM3", f"of shape {expected}", np.shape(velocity_NM3))
        require(count <= self.particle_count, "position_N3", f"at most {self.particle_count} particles", count)
        device, state = self.simulator.device, self._state
        self.frame = frame
        self._go_on_with(
            replace(
                state,
                position_N3=torch.tensor(position_N3, dtype=torch.float32).to(device),
                velocity_NM3=torch.tensor(velocity_NM3, dtype=torch.float32).to(device),
                material_N=state.material_N[:count],
                scene_N=state.scene_N[:count],
            )
        )

    def _change_scene(self, scene: InitialState, names: tuple[str, ...]) -> None:
        """Another scene's are those parts of the state that have these names; the others stay."""
        of_particles = ("position_N3", "velocity_N3", "material_N")
        started: dict[str, Any] = {name: getattr(scene, name)[:0] for name in of_particles}
        if "barriers" not in names:
            started["corners"] = None  # barriers stay, and would take time
        new = self.simulator.start([replace(scene, **started)])
        self.scene = scene
        changed: dict[str, Any] = {name: getattr(new, name) for name in names}
        self._go_on_with(replace(self.state, **changed))

    def _go_on_with(self, state: ParticleState) -> None:
        self._state = state
        if not len(state.position_N3):  # nothing to simulate yet
            self.close()
        elif self._rollout is None or not self._rollout.take(state):
            self.close()
            self._rollout = self._entered.enter_context(self.simulator.backend.rollout(state, self.room))


def run_scene(
    simulator: Simulator, scene: Scene, frames: int, on_frame: Callable[[int], Any] | None = None
) -> np.ndarray:
    """`frames` frames of a scene, the initial state among them, in which particles enter as its emitters say: float32
    [frames, N, 3] in domain units, NaN before a particle enters. `on_frame(t)` is called when frame t is complete.

    Raises: DivergedError, and ConfigError as `Simulator.start` and where an obstacle is in the way of what enters.
    """
    entered, entry_N = at_entry(scene, simulator.frame_rate_hz), entry_frames(scene, simulator.frame_rate_hz)
    require_free_entries(scene, entered)
    position_TN3 = np.full((frames, scene.particle_count, 3), np.nan, np.float32)
    count = int((entry_N == 0).sum())
    position_TN3[0, :count] = scene.position_N3[:count]
    with LiveSimulation(simulator, at_start(scene), room=scene.particle_count) as live:
        for frame in range(1, frames):
            position_TN3[frame, :count] = live.step()
            new = slice(count, int((entry_N <= frame).sum()))
            if new.stop > count:
                position_TN3[frame, new] = entered.position_N3[new]
                live.add_particles(entered.position_N3[new], entered.velocity_N3[new], entered.material_N[new])
                count = new.stop
            if on_frame is not None:
                on_frame(frame)
    return position_TN3
