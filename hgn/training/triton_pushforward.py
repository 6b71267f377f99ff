"""Pushforward on backend triton: scenes are simulated, cut into windows and read on the device.

A window is an episode of W frames with its scene's material and obstacles, so the kernels of an update read it like any
other episode. Buffers and the captured graph are reused by the next simulation.
Shape legend: as in hgn.training.pushforward.
"""

import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import torch

from hgn.config import TrainingConfig
from hgn.kernels.scene_tables import BARRIER_COLUMNS, OBSTACLE_COLUMNS, SceneTable
from hgn.kernels.update.op import DeviceEpisode, DeviceSample
from hgn.network.cell_keys import COORDINATE_BITS
from hgn.network.elastic import RestShape
from hgn.network.features import ParticleState
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.network.moving import MovingObstacles
from hgn.network.obstacles import ObstacleCells
from hgn.network.own_physics import joined_parameters
from hgn.runtime.simulation import Simulation
from hgn.runtime.triton_stepper import CHECKED_PARTICLES, TritonStepper
from hgn.scene.rest_shape import connected_bodies

SPARE = 1.1  # (capacity of a new stepper for particles) / (particles in its first simulation)


class TritonScenes:
    """Implements hgn.training.pushforward.SimulatedScenes."""

    def __init__(
        self, network: HierarchicalGraphNetwork, training: TrainingConfig, obstacle_cell_size: float, precision: str
    ) -> None:
        """Simulations use the parameters in `values`.

        Before the first simulation the kernels are compared with PyTorch, both with the parameters of `network`.
        """
        self._network, self._training, self._precision = network, training, precision
        self._obstacle_cell_size = obstacle_cell_size
        self._history = network.config.velocity_history
        self._stepper: TritonStepper | None = None
        self.values = torch.empty(0)  # parameters in the packed layout, set before each simulation

    @property
    def cell_size(self) -> float:
        return self._network.config.cell_size

    def frame_count(self, episode: DeviceEpisode) -> int:
        return episode.frames - self._history

    def domain_size(self, episode: DeviceEpisode) -> torch.Tensor:
        return torch.tensor(episode.domain_size, device=self.values.device)

    def groups(self, starts: Sequence[tuple[DeviceEpisode, int]]) -> list[Sequence[tuple[DeviceEpisode, int]]]:
        return [starts]

    def true_frames(self, episode: DeviceEpisode, frame: int, simulated: int) -> torch.Tensor:
        return episode.position_TN3[frame : frame + self._history + simulated + 2].to(self.values.device)

    def materials_and_bodies(self, episode: DeviceEpisode) -> tuple[torch.Tensor, list[torch.Tensor]]:
        device = self.values.device
        bodies = [] if episode.rest is None else connected_bodies(episode.rest.neighbour_NK.cpu().numpy())
        return episode.material_N.to(device), [torch.from_numpy(body_B).to(device) for body_B in bodies]

    def sample(self, episode: DeviceEpisode, frame: int, window_WN3: torch.Tensor) -> DeviceSample:
        first = episode.first_frame + frame
        return DeviceSample(replace(episode, position_TN3=window_WN3, first_frame=first), 0, 0)

    def drawn(self, sample: DeviceSample, seed: int, weight: float) -> DeviceSample:
        return sample._replace(seed=seed, weight=weight)

    def simulate(self, starts: Sequence[tuple[DeviceEpisode, int]], frames: int) -> list[torch.Tensor]:
        """Raises: ConfigError in the first call, if the kernels' results differ from PyTorch's on this machine."""
        episodes, state = [episode for episode, _ in starts], self._state(starts)
        with Simulation(lambda _: nullcontext(self._begun(episodes, state)), state, isolate=True) as simulation:
            path_FN3 = torch.cat([block_TN3.clone() for block_TN3 in simulation.blocks(frames)])
        return list(path_FN3.split([episode.particles for episode in episodes], dim=1))

    def _state(self, starts: Sequence[tuple[DeviceEpisode, int]]) -> ParticleState:
        """Returns the true state at the start of the simulation, without obstacles, which have their own tables.

        Empty scenes pad the state to `pushforward_scenes`, so that the same buffers fit simulations of fewer scenes.
        """
        device, episodes = self.values.device, [episode for episode, _ in starts]
        last = self._history + 1
        pasts = [episode.position_TN3[frame : frame + last].to(device) for episode, frame in starts]
        past_TN3 = torch.cat(pasts, dim=1)
        counts = torch.tensor([episode.particles for episode in episodes], device=device)
        empty = max(0, self._training.pushforward_scenes - len(episodes))
        placed = [*episodes, *[episodes[0]] * empty]  # the domain of an empty scene is arbitrary
        frames = [episode.first_frame + frame for episode, frame in starts] + [0] * empty
        own: dict[str, Any] = {"frame_S": torch.tensor(frames, device=device)}
        if "friction" in self._network.config.own_physics:
            own["wall_friction_S3"] = torch.tensor([episode.wall_friction for episode in placed], device=device)
        if "parameters" in self._network.config.own_physics:
            parameters = [episode.parameter_NP for episode in episodes]
            own["parameter_NP"] = joined_parameters(parameters, [past_TN3[-1] for past_TN3 in pasts])
        if "elastic" in self._network.config.own_physics:
            shapes = [e.rest or RestShape.none(e.position_TN3[0].to(device)) for e in episodes]
            own["rest"] = RestShape.joined(shapes, [e.particles for e in episodes])
        if "moving" in self._network.config.own_physics:
            bodies = [episode.moving.obstacles for episode in episodes] + [()] * empty
            config, clearance = self._network.config, self._network.step.in_training.obstacle_clearance
            moving = MovingObstacles.of(bodies, frames, episodes[0].moving.frame_s, config, clearance=clearance)
            own["moving"] = moving and moving.to(device)
        return ParticleState(
            position_N3=past_TN3[-1],
            velocity_NM3=past_TN3.diff(dim=0).flip(0).transpose(0, 1),
            material_N=torch.cat([episode.material_N for episode in episodes]),
            scene_N=torch.arange(len(episodes), device=device).repeat_interleave(counts),
            domain_S3=torch.tensor([episode.domain_size for episode in placed], device=device),
            gravity_S3=torch.tensor([episode.gravity for episode in placed], device=device),
            obstacles=None,
            **own,
        )

    def _begun(self, episodes: Sequence[DeviceEpisode], state: ParticleState) -> TritonStepper:
        """Returns a stepper at `state`: the previous one if its buffers are large enough, else a new one."""
        config, values = self._network.config, self.values
        device = values.device
        table, barriers, empty = None, None, [None] * (state.scene_count - len(episodes))
        if config.obstacle_features:
            hashes = [*(episode.obstacles for episode in episodes), *empty]
            table = SceneTable(hashes, OBSTACLE_COLUMNS, device, self._obstacle_cell_size)
        step = self._network.step.in_training
        if step.obstacle_clearance is not None:
            barriers = SceneTable([*(e.barrier for e in episodes), *empty], BARRIER_COLUMNS, device)
        stepper = self._stepper
        if stepper is not None and len(state.position_N3) <= stepper.particles and stepper.fits_moving(state.moving):
            if table is not None:
                assert stepper.obstacles is not None
                stepper.obstacles.take(table)
            if barriers is not None:
                assert stepper.barriers is not None
                stepper.barriers.take(barriers)
            stepper.use_values(values)
            stepper.begin(state)
            return stepper
        capacities, half_sums = None, True
        if stepper is not None:
            capacities, half_sums = stepper.grid.capacities, stepper.half_sums
            self._stepper = stepper = None  # freed before the new one is allocated
        particles = 16 * math.ceil(SPARE * len(state.position_N3) / 16)
        stepper = TritonStepper(
            self._network,
            state,
            self._precision,
            capacities,
            capacity=particles,
            obstacles=table,
            barriers=barriers,
            step=step,
        )
        if capacities is None:
            first = self._first_scenes(episodes, state)
            if first is not None:
                stepper.require_parity(self._network, first, "training.")
                if device.type == "cuda":
                    torch.cuda.empty_cache()  # free memory determines where episodes are stored
        elif stepper.half_sums and not half_sums:
            stepper.sum_in_float32()
        stepper.use_values(values)
        self._stepper = stepper
        return stepper

    def _first_scenes(self, episodes: Sequence[DeviceEpisode], state: ParticleState) -> ParticleState | None:
        """Returns as many of the first scenes, with obstacles, as PyTorch can check; None if the first is too large."""
        scenes, count = 0, 0
        while scenes < len(episodes) and count + episodes[scenes].particles <= CHECKED_PARTICLES:
            count += episodes[scenes].particles
            scenes += 1
        if count == 0:
            return None
        seen = [(scene, e.obstacles) for scene, e in enumerate(episodes[:scenes]) if e.obstacles is not None]
        obstacles = None
        if seen:
            # an episode's keys have the scene number 0
            key_K = torch.cat([cells.key_K + (scene << 3 * COORDINATE_BITS) for scene, cells in seen])
            order_K = torch.argsort(key_K)
            value_KV = torch.cat([cells.value_K for _, cells in seen])[order_K]
            distance = self._network.config.obstacle_distance
            obstacles = ObstacleCells.of_rows(key_K[order_K], value_KV, self._obstacle_cell_size, distance)
        first = state.selected(slice(count))
        return replace(first, material_N=first.material_N.long(), obstacles=obstacles)
