"""A scene that changes while it is simulated: particles enter, obstacles and gravity change, time goes back.

Shape legend: N particles, A particles that enter, M velocities of a history.
"""

from __future__ import annotations

from dataclasses import replace
from types import TracebackType
from typing import Any

import numpy as np
import torch

from hgn.network.features import ParticleState
from hgn.runtime.simulator import InitialState, Simulator
from hgn.scene.scene import Scene
from hgn.schema import require


class LiveSimulation:
    """One scene, a frame at a time, on the simulator's backend. Use it as a context manager, or close it.

    A change between two frames acts from the next frame. Positions and velocity histories of the particles stay
    bitwise equal. Particles keep their order; new particles follow them.
    """

    def __init__(self, simulator: Simulator, scene: InitialState | Scene, capacity: int = 0) -> None:
        """`capacity` is the number of particles for which backend triton allocates buffers.

        With more particles it captures its frame again, which takes about a second.
        Raises: ConfigError as `Simulator.start`.
        """
        self.simulator, self.scene = simulator, InitialState.of(scene)
        emits = self.scene.emitting is not None
        require(not emits, "emitters", "left out here", "some", remedy="take Simulator.frames, or add_particles")
        self.simulation = simulator.simulation(simulator.start([self.scene]), capacity)

    def __enter__(self) -> LiveSimulation:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Returns the simulation's buffers to the backend, which uses them for the next simulation."""
        self.simulation.close()

    @property
    def frame(self) -> int:
        """Returns the number of the last frame. It can be set."""
        return self.simulation.frame

    @frame.setter
    def frame(self, frame: int) -> None:
        self.simulation.frame = frame

    @property
    def state(self) -> ParticleState:
        """Returns the input of the network for the next frame, on the simulator's device; read-only."""
        return self.simulation.state

    @property
    def particle_count(self) -> int:
        return self.simulation.particle_count

    def step(self) -> np.ndarray:
        """Returns positions one frame later, float32 [N, 3] in domain units.

        Raises: DivergedError. The simulation can then only be restored, or closed.
        """
        return np.asarray(self.simulation.run(1)[0])

    def add_particles(self, position_A3: np.ndarray, velocity_A3: np.ndarray, material_A: np.ndarray) -> np.ndarray:
        """Adds particles that come from free flight: domain units, domain units per second, indices into MATERIALS.

        Returns their velocity histories, float32 [A, M, 3] in domain units per frame, newest first.
        Raises: ConfigError for a material that the network was not trained with, and for arrays of different lengths.
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
        new = self.simulator.start([replace(entering, corners=None)])  # barriers stay; building them takes time
        if count:
            self.simulation.add(new)
        return new.velocity_NM3.cpu().numpy()

    def replace_obstacles(self, scene: InitialState | Scene) -> None:
        """Replaces the obstacles by those of another scene, at rest. Its particles are ignored.

        Raises: ConfigError as `Simulator.start`.
        """
        other = InitialState.of(scene)
        of_obstacles = ("obstacle_grid", "corners")
        obstacles: dict[str, Any] = {name: getattr(other, name) for name in of_obstacles}
        self._change_scene(replace(self.scene, **obstacles), ("obstacles", "barriers"))

    def set_gravity(self, gravity: tuple[float, float, float]) -> None:
        """Replaces gravity, in domain units per second squared.

        Raises: ConfigError for weights with absolute inputs, which support only the gravity of their data.
        """
        self._change_scene(replace(self.scene, gravity=gravity), ("gravity_S3",))

    def restore(self, position_N3: np.ndarray, velocity_NM3: np.ndarray, frame: int) -> None:
        """Restores an earlier frame of the first particles. Particles that entered later are removed.

        Obstacles and gravity stay.

        position_N3: float32, domain units. velocity_NM3: float32, domain units per frame, newest first.
        """
        state = self.simulation.static_state
        count, expected = len(position_N3), (len(position_N3), *state.velocity_NM3.shape[1:])
        require(np.shape(velocity_NM3) == expected, "velocity_NM3", f"of shape {expected}", np.shape(velocity_NM3))
        require(count <= self.particle_count, "position_N3", f"at most {self.particle_count} particles", count)
        device = self.simulator.device
        self.simulation.frame = frame
        self.simulation.continue_from(
            replace(
                state,
                position_N3=torch.tensor(position_N3, dtype=torch.float32).to(device),
                velocity_NM3=torch.tensor(velocity_NM3, dtype=torch.float32).to(device),
                material_N=state.material_N[:count],
                scene_N=state.scene_N[:count],
            )
        )

    def _change_scene(self, scene: InitialState, names: tuple[str, ...]) -> None:
        """Replaces the named parts of the state by those of another scene."""
        of_particles = ("position_N3", "velocity_N3", "material_N")
        started: dict[str, Any] = {name: getattr(scene, name)[:0] for name in of_particles}
        if "barriers" not in names:
            started["corners"] = None  # barriers stay; building them takes time
        new = self.simulator.start([replace(scene, **started)])
        self.scene = scene
        changed: dict[str, Any] = {name: getattr(new, name) for name in names}
        self.simulation.continue_from(replace(self.state, **changed))
