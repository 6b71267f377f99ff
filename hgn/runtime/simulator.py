"""The simulation loop (paper algorithm 1): features, grid, network, integration, all on one device.

Imports torch and the network, nothing of the training stack.
Shape legend: T frames, N particles of all scenes, S scenes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from hgn.config import BACKENDS, PRECISIONS
from hgn.cpu import compiled
from hgn.cpu.allocator import keep_freed_memory
from hgn.network.base import ParticleNetwork
from hgn.network.features import ParticleState, material_rows
from hgn.network.gns import GraphNetworkSimulator
from hgn.network.gns_edges import PlainEdges
from hgn.network.grid import GridRangeError
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.network.obstacles import ObstacleCells, SurfaceParticles
from hgn.runtime.backend import path_on, set_matmul_precision
from hgn.runtime.divergence import lost
from hgn.runtime.gns_backend import require_agreement, use_edges
from hgn.runtime.gns_graph import GnsGraphs
from hgn.runtime.weights import WeightsInfo, find_weights, load_weights
from hgn.scene.episode import Episode
from hgn.scene.history import ballistic_positions
from hgn.scene.obstacle_grid import ObstacleGrid, build_obstacle_grid, surface_points
from hgn.scene.rollout_file import cell_obstacles, episode_surface
from hgn.scene.scene import Obstacle, Scene
from hgn.schema import require
from hgn.system.device import choose_device

if TYPE_CHECKING:
    from hgn.runtime.triton_rollout import TritonRollout

KEPT = 2  # simulations of backend triton, of different numbers of scenes
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
    # Points on the obstacles so many cells apart, for networks that see them as particles; none: only the cells are
    # known, a square each.
    sampled: Callable[[float], np.ndarray] | None = None

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
            lambda spacing_cells: episode_surface(episode, spacing_cells),
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
            lambda spacing_cells: _surface(scene.obstacles, scene.cell_size, spacing_cells),
        )

    def surface(self, spacing_cells: float) -> np.ndarray:
        """Points on the obstacles, no closer than `spacing_cells` cells, float32 [P, 3]."""
        if self.sampled is not None:
            return self.sampled(spacing_cells)
        return _surface(cell_obstacles(self.obstacle_grid), self.obstacle_grid.cell_size, spacing_cells)


class Simulator:
    """Runs a trained network on one or several scenes at once."""

    def __init__(
        self, network: ParticleNetwork, frame_rate_hz: float, backend: str = "torch", precision: str = "tf32"
    ) -> None:
        """`backend` is torch or triton, as hgn.runtime.backend chooses it; `precision` is that of triton, and
        of a GNS, which works on its edges accordingly from now on."""
        self.network = network
        self.frame_rate_hz = frame_rate_hz
        self.backend_note = ""  # which backend it is and why, where `load` chose it
        self._info: WeightsInfo | None = None
        self.backend, self.precision = backend, precision
        self.device = next(network.parameters()).device
        self.growths = 0  # of backend triton's buffers, in all rollouts
        self._kept: dict[int, TritonRollout] = {}
        self.predict: Callable[[ParticleState], torch.Tensor] = network
        use_edges(network, precision)
        if self.device.type == "cpu":
            keep_freed_memory()
        if isinstance(network, GraphNetworkSimulator) and self.device.type == "cuda":
            roomy = not isinstance(network.edges, PlainEdges)  # which take no room to spare
            self.predict = GnsGraphs(network) if roomy else network

    @staticmethod
    def load(
        weights: str | Path = "obstacles", device: str = "auto", backend: str = "auto", precision: str = "tf32"
    ) -> Simulator:
        """A simulator of exported weights: a file, or the name of shipped ones. The options are those of hgn.rollout.

        Sets the precision of PyTorch's own float32 products, too.
        Raises: ConfigError when the weights, the device or the backend do not exist or do not fit each other.
        """
        for field, value, known in (("backend", backend, BACKENDS), ("precision", precision, PRECISIONS)):
            require(value in known, field, f"one of {', '.join(known)}", value)
        place = choose_device(device)
        network, info = load_weights(find_weights(str(weights)), place)
        chosen, said = path_on(place, network.config, backend, precision)
        if place.type == "cpu" and isinstance(network, HierarchicalGraphNetwork):
            said = f"{said}, {compiled.said(network.config.width)}"
        set_matmul_precision(precision)
        simulator = Simulator(network, info.frame_rate_hz, chosen, precision)
        simulator._info, simulator.backend_note = info, said
        return simulator

    @property
    def info(self) -> WeightsInfo:
        """What the weights file says of itself, for a simulator that `load` made."""
        assert self._info is not None
        return self._info

    def start(self, scenes: Sequence[InitialState | Scene]) -> ParticleState:
        """The state at frame 0, with a ballistic history.

        Raises: ConfigError when a scene holds a material that the network does not know, or, for weights that were
        loaded, another gravity or obstacle cells of another size.
        """
        return self._start(_initial(scenes))

    def _start(self, scenes: Sequence[InitialState]) -> ParticleState:
        config = self.network.config
        velocities = []
        for scene in scenes:
            self._require_known(scene)
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
        surface = None
        if config.obstacle_particles:
            surface = SurfaceParticles.of([scene.surface(config.static_spacing_cells) for scene in scenes])
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
        scenes: Sequence[InitialState | Scene],
        frames: int,
        on_frame: Callable[[int], None] | None = None,
    ) -> list[np.ndarray]:
        """Simulates `frames` frames, frame 0 included; float32 [frames, N, 3] for each scene.

        Raises: ConfigError as `start`; DivergenceError, which says at which frame; the network must be trained further
        then.
        """
        require(frames >= 1, "frames", "at least 1", frames)
        scenes = _initial(scenes)
        state = self._start(scenes)
        positions = [state.position_N3[None].cpu().numpy()]
        if self.backend == "triton":
            with self._fast(state) as rollout:
                positions.append(rollout.run(frames - 1, on_frame))
        else:
            for frame, position_N3 in enumerate(itertools.islice(self._plain_frames(state), frames - 1), start=1):
                positions.append(position_N3[None])
                if on_frame is not None:
                    on_frame(frame)
        counts = [len(scene.position_N3) for scene in scenes]
        return np.split(np.concatenate(positions), np.cumsum(counts)[:-1], axis=1)

    def frames(self, scene: InitialState | Scene) -> Iterator[np.ndarray]:
        """Positions float32 [N, 3] of frame after frame, the initial ones first, for as long as they are asked for.

        Backend triton is some frames ahead. Several scenes may be simulated side by side, each by a call of its own.
        Raises: what `rollout` does, ConfigError with the first frame and DivergenceError behind the last good one.
        """
        state = self.start([scene])
        yield state.position_N3.cpu().numpy()
        if self.backend == "triton":
            with self._fast(state) as rollout:
                yield from rollout.frames()
        else:
            yield from self._plain_frames(state)

    def _plain_frames(self, state: ParticleState) -> Iterator[np.ndarray]:
        """Positions [N, 3] behind the first, without an end."""
        require_agreement(self.network, state, gradients=False)
        for frame in itertools.count(1):
            try:
                state = self.step(state)
            except GridRangeError as error:
                raise DivergenceError(frame, str(error)) from None
            self._check(state, frame)
            yield state.position_N3.cpu().numpy()

    @contextmanager
    def _fast(self, state: ParticleState) -> Iterator[TritonRollout]:
        """A simulation on backend triton, which is kept for others once it is over."""
        # Triton, which backend torch does without, is loaded here.
        from hgn.runtime.triton_rollout import CHECKED_PARTICLES, LeftDomainError, TritonRollout

        assert isinstance(self.network, HierarchicalGraphNetwork)
        rollout = self._begun(state)
        if rollout is None:
            rollout = TritonRollout(self.network, state, self.precision)
            if len(state.position_N3) <= CHECKED_PARTICLES:
                rollout.require_agreement(self.network, state)
        before = rollout.growths
        try:
            yield rollout
        except LeftDomainError as error:
            raise DivergenceError(error.frame, left_text(error.lost, len(state.position_N3))) from None
        finally:
            self.growths += rollout.growths - before
            self._kept.pop(state.scene_count, None)
            if len(self._kept) == KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[state.scene_count] = rollout

    def _begun(self, state: ParticleState) -> TritonRollout | None:
        """An earlier simulation of the same network begun anew, its launches captured already; none that fits.

        Nobody else has it while it runs, and one that does not fit goes before another is allocated.
        """
        known, count = self._kept.pop(state.scene_count, None), len(state.position_N3)
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

    def _require_known(self, scene: InitialState) -> None:
        info, cell_size = self._info, scene.obstacle_grid.cell_size
        if info is None:
            return
        rule = f"the weights' {info.gravity}, which a network cannot take from a scene"
        remedy = "train one on scenes with this gravity"
        require(tuple(scene.gravity) == info.gravity, "gravity", rule, scene.gravity, remedy)
        if info.network.sees_obstacles:
            rule = f"the weights' {info.obstacle_cell_size}, the size of the cells that they know obstacles by"
            require(cell_size == info.obstacle_cell_size, "cell_size", rule, cell_size)

    @staticmethod
    def _check(state: ParticleState, frame: int) -> None:
        left = int(lost(state.position_N3, state.domain_S3[state.scene_N]).sum())
        if left:
            raise DivergenceError(frame, left_text(left, len(state.position_N3)))


def left_text(left: int, count: int) -> str:
    """How a simulation came apart."""
    return f"{left} of {count} particles are not finite or farther from the domain than its own size"


def _initial(scenes: Sequence[InitialState | Scene]) -> list[InitialState]:
    return [InitialState.of_scene(scene) if isinstance(scene, Scene) else scene for scene in scenes]


def _surface(obstacles: Sequence[Obstacle], cell_size: float, spacing_cells: float) -> np.ndarray:
    return surface_points(obstacles, cell_size, 0, spacing_cells=spacing_cells)
