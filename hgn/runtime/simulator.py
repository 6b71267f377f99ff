"""The simulation loop (paper algorithm 1): features, grid, network, integration, all on one device.

Imports torch and the network, nothing of the training stack.
Shape legend: T frames, N particles of all scenes, S scenes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from hgn.network.base import ParticleNetwork
from hgn.network.edges import PlainEdges
from hgn.network.features import ParticleState, material_rows
from hgn.network.gns import GraphNetworkSimulator
from hgn.network.grid import GridRangeError
from hgn.network.network import HierarchicalGraphNetwork
from hgn.network.obstacles import ObstacleCells, SurfaceParticles
from hgn.runtime.divergence import lost
from hgn.runtime.gns_edges import require_agreement, use_edges
from hgn.runtime.gns_graph import GnsGraphs
from hgn.scene.episode import Episode
from hgn.scene.history import ballistic_positions
from hgn.scene.obstacle_grid import ObstacleGrid, build_obstacle_grid, surface_points
from hgn.scene.rollout_file import cell_obstacles, obstacles_of_episode
from hgn.scene.scene import Obstacle, Scene

if TYPE_CHECKING:
    from hgn.runtime.fast import FastRollout

KEPT = 2  # simulations of the fast path, of different numbers of scenes
FILLED = 0.5  # of the room of one that is kept, at least: launches are as large as the room


class DivergenceError(RuntimeError):
    """Particles are no longer finite, or have left the domain by more than its own size."""

    def __init__(self, frame: int, cause: str) -> None:
        super().__init__(f"the simulation diverged at frame {frame}: {cause}; train further, or take other weights")
        self.frame = frame


@dataclass(frozen=True, eq=False)
class InitialState:
    """Where a simulation starts. Units: domain units, seconds."""

    position_N3: np.ndarray
    velocity_N3: np.ndarray
    material_N: np.ndarray  # index into MATERIALS
    obstacle_grid: ObstacleGrid
    domain_size: tuple[float, float, float]
    gravity: tuple[float, float, float]
    # The obstacles' meshes, for networks that see them as particles; none: only the cells are known, a square each.
    obstacles: Callable[[], Sequence[Obstacle]] | None = None

    @staticmethod
    def of_episode(episode: Episode) -> InitialState:
        """Frame 0 of an episode."""
        return InitialState(
            np.array(episode.position_TN3[0]),
            episode.initial_velocity_N3,
            episode.material_N,
            episode.obstacle_grid,
            episode.domain_size,
            episode.gravity,
            lambda: obstacles_of_episode(episode),
        )

    @staticmethod
    def of_scene(scene: Scene) -> InitialState:
        """A scene's initial particles, its obstacles sampled into cells."""
        return InitialState(
            scene.position_N3,
            scene.velocity_N3,
            scene.material_N,
            build_obstacle_grid(scene.obstacles, scene.cell_size, scene.seed, scene.domain_size),
            scene.domain_size,
            scene.gravity,
            lambda: scene.obstacles,
        )

    def surface(self) -> np.ndarray:
        """Points on the obstacles, no closer than a quarter of a cell, float32 [P, 3]."""
        grid = self.obstacle_grid
        obstacles = cell_obstacles(grid) if self.obstacles is None else self.obstacles()
        return surface_points(obstacles, grid.cell_size, 0)


class Simulator:
    """Runs a trained network on one or several scenes at once."""

    def __init__(
        self, network: ParticleNetwork, frame_rate_hz: float, path: str = "plain", precision: str = "high"
    ) -> None:
        """`path` is plain or fast, as hgn.runtime.path chooses it; `precision` is that of the fast path, and
        of a GNS, which works on its edges accordingly from now on."""
        self.network = network
        self.frame_rate_hz = frame_rate_hz
        self.path, self.precision = path, precision
        self.device = next(network.parameters()).device
        self.growths = 0  # of the fast path's buffers, in all rollouts
        self._kept: dict[int, FastRollout] = {}
        self.predict: Callable[[ParticleState], torch.Tensor] = network
        use_edges(network, precision)
        if isinstance(network, GraphNetworkSimulator) and self.device.type == "cuda":
            roomy = not isinstance(network.edges, PlainEdges)  # which take no room to spare
            self.predict = GnsGraphs(network) if roomy else network

    def start(self, scenes: Sequence[InitialState]) -> ParticleState:
        """The state at frame 0, with a ballistic history.

        Raises: ConfigError when a scene holds a material that the network does not know.
        """
        config = self.network.config
        velocities = []
        for scene in scenes:
            past = ballistic_positions(
                scene.position_N3,
                scene.velocity_N3,
                scene.gravity,
                self.frame_rate_hz,
                range(-config.velocity_history, 0),
            )
            positions_HN3 = np.concatenate([past, scene.position_N3[None].astype(np.float32)])
            velocities.append(np.diff(positions_HN3, axis=0)[::-1].transpose(1, 0, 2))
        material_N = material_rows(np.concatenate([scene.material_N for scene in scenes]), config.materials)
        counts = [len(scene.position_N3) for scene in scenes]
        position_N3 = np.concatenate([scene.position_N3 for scene in scenes]).astype(np.float32)
        obstacles = ObstacleCells.of([scene.obstacle_grid for scene in scenes]) if config.obstacle_features else None
        surface = SurfaceParticles.of([scene.surface() for scene in scenes]) if config.obstacle_particles else None
        return ParticleState(
            position_N3=torch.from_numpy(position_N3).to(self.device),
            velocity_NM3=torch.from_numpy(np.concatenate(velocities)).to(self.device),
            material_N=material_N.to(self.device),
            scene_N=torch.from_numpy(np.repeat(np.arange(len(scenes)), counts)).to(self.device),
            domain_S3=torch.tensor([scene.domain_size for scene in scenes], dtype=torch.float32).to(self.device),
            obstacles=obstacles and obstacles.to(self.device),
            surface=surface and surface.to(self.device),
        )

    @torch.inference_mode()
    def step(self, state: ParticleState) -> ParticleState:
        """One frame: v += a, x += v. Velocity is kept as state, not as a difference of positions."""
        velocity_N3 = state.velocity_NM3[:, 0] + self.predict(state)
        history_NM3 = torch.cat([velocity_N3[:, None], state.velocity_NM3[:, :-1]], dim=1)
        return replace(state, position_N3=state.position_N3 + velocity_N3, velocity_NM3=history_NM3)

    def rollout(
        self,
        scenes: Sequence[InitialState],
        frames: int,
        on_frame: Callable[[int], None] | None = None,
    ) -> list[np.ndarray]:
        """Simulates `frames` frames, frame 0 included; float32 [frames, N, 3] for each scene.

        Raises: DivergenceError, which says at which frame; the network must be trained further then.
        """
        state = self.start(scenes)
        counts = [len(scene.position_N3) for scene in scenes]
        if self.path == "fast":
            return np.split(self._fast_rollout(state, frames, on_frame), np.cumsum(counts)[:-1], axis=1)
        require_agreement(self.network, state, gradients=False)
        positions = [state.position_N3.cpu().numpy()]
        for frame in range(1, frames):
            try:
                state = self.step(state)
            except GridRangeError as error:
                raise DivergenceError(frame, str(error)) from None
            self._check(state, frame)
            positions.append(state.position_N3.cpu().numpy())
            if on_frame is not None:
                on_frame(frame)
        return np.split(np.stack(positions), np.cumsum(counts)[:-1], axis=1)

    def _fast_rollout(self, state: ParticleState, frames: int, on_frame: Callable[[int], None] | None) -> np.ndarray:
        # Triton, which the plain path does without, is loaded here.
        from hgn.runtime.fast import CHECKED_PARTICLES, FastRollout, LeftDomainError

        assert isinstance(self.network, HierarchicalGraphNetwork)
        first_1N3 = state.position_N3[None].cpu().numpy()
        rollout = self._begun(state)
        if rollout is None:
            self._kept.pop(state.scene_count, None)  # before the new one is allocated
            rollout = FastRollout(self.network, state, self.precision)
            if len(state.position_N3) <= CHECKED_PARTICLES:
                rollout.require_agreement(self.network, state)
            if len(self._kept) == KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[state.scene_count] = rollout
        before = rollout.growths
        try:
            later_TN3 = rollout.run(frames - 1, on_frame)
        except LeftDomainError as error:
            raise DivergenceError(error.frame, _left(error.lost, len(state.position_N3))) from None
        finally:
            self.growths += rollout.growths - before
        return np.concatenate([first_1N3, later_TN3])

    def _begun(self, state: ParticleState) -> FastRollout | None:
        """An earlier simulation of the same network begun anew, its launches captured already; none that fits."""
        known, count = self._kept.get(state.scene_count), len(state.position_N3)
        if known is None or not known.fits(state) or count < FILLED * known.particles:
            return None
        assert isinstance(self.network, HierarchicalGraphNetwork)
        known.use_values(known.packed.gather(list(self.network.parameters())))
        known.begin(state, new_obstacles=True)
        return known

    def release(self) -> None:
        """Gives back the buffers that simulations keep for those that follow."""
        self._kept.clear()
        if isinstance(self.predict, GnsGraphs):
            self.predict = GnsGraphs(self.predict.network)

    @staticmethod
    def _check(state: ParticleState, frame: int) -> None:
        left = int(lost(state.position_N3, state.domain_S3[state.scene_N]).sum())
        if left:
            raise DivergenceError(frame, _left(left, len(state.position_N3)))


def _left(left: int, count: int) -> str:
    return f"{left} of {count} particles are not finite or farther from the domain than its own size"
