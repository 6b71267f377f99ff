"""Holds inputs of training with backend triton: samples of many updates, and whole episodes instead of windows.

Shape legend: H velocity history, T frames, N particles.
"""

from dataclasses import dataclass

import numpy as np
import torch

from hgn.config import NetworkConfig
from hgn.data.sampler import Sample, SamplerState
from hgn.network.elastic import RestShape
from hgn.network.features import material_rows
from hgn.network.own_physics import physics_fields
from hgn.scene.barrier import Barrier
from hgn.scene.episode import Episode
from hgn.scene.episode_obstacles import field_of_episode
from hgn.scene.history import frames_before
from hgn.scene.moving import MovingObstacle, moving_of_episode
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.scene.symmetry import Symmetry, scene_symmetries
from hgn.schema import Vector, triple


@dataclass(frozen=True, eq=False)
class EpisodeTensors:
    """Holds an episode as tensors. The first H of its H + T frames are those before frame 0 (`frames_before`)."""

    position_TN3: torch.Tensor  # float32, domain units
    material_N: torch.Tensor  # int32, index into the network's materials
    obstacle_grid: ObstacleGrid  # without cells for networks without obstacle features
    domain_size: Vector
    gravity: Vector  # domain units per frame squared
    symmetries: tuple[Symmetry, ...] = ()  # symmetries that training may apply to the scene
    barrier: Barrier | None = None  # barrier of the scene's obstacles, if simulations respect them
    wall_friction: Vector = (0.0, 0.0, 0.0)  # friction of the walls normal to x, y, z
    parameter_NP: torch.Tensor | None = None  # as in ParticleState
    rest: RestShape | None = None  # as in ParticleState
    moving: tuple[MovingObstacle, ...] = ()  # for networks that have them as inputs
    frame_s: float = 0.0


@dataclass(frozen=True, eq=False)
class EpisodeChunk:
    """Holds the samples of successive updates, and the episodes of these samples that are not yet on the device."""

    samples: tuple[tuple[Sample, ...], ...]
    episodes: dict[int, EpisodeTensors]
    sampler_state: SamplerState  # the sampler's state after these updates
    dropped: tuple[int, ...] = ()  # episodes that leave the device before the new ones are placed
    starts: tuple[tuple[int, int], ...] = ()  # episodes and frames to start simulations from


def whole_episode(episode: Episode, network: NetworkConfig, barrier: Barrier | None = None) -> EpisodeTensors:
    """Returns an episode as tensors. Rows n to n + H + 1 are `hgn.scene.history.window` of frame n."""
    past = frames_before(episode, -network.velocity_history)
    grid, seen = seen_surfaces(episode, network), int(network.obstacle_features)
    cell_K3, normal_K3 = (part[: seen * len(part)] for part in (grid.cell_K3, grid.normal_K3))
    friction_K = None if grid.friction_K is None else grid.friction_K[: len(cell_K3)].astype(np.float32)
    own = cell_K3.astype(np.int32), normal_K3.astype(np.float32), friction_K, grid.distance_K
    material_N = material_rows(episode.material_N, network.materials, episode.materials)
    physics = physics_fields(network, [episode], material_N)
    return EpisodeTensors(
        torch.from_numpy(np.concatenate([past, episode.position_TN3], dtype=np.float32)),
        material_N.int(),
        ObstacleGrid(grid.cell_size, *own),
        episode.domain_size,
        frame_gravity(episode),
        shown_symmetries(episode, network),
        barrier,
        episode.wall_friction,
        physics.get("parameter_NP"),
        physics.get("rest"),
        moving_of_episode(episode) if "moving" in network.own_physics else (),
        1 / episode.frame_rate_hz,
    )


def seen_surfaces(episode: Episode, network: NetworkConfig) -> ObstacleGrid:
    """Returns the cells of obstacles at rest that a network with obstacle features sees."""
    return field_of_episode(episode) if network.obstacle_distance else episode.obstacle_grid


def frame_gravity(episode: Episode) -> Vector:
    """Returns gravity in domain units per frame squared."""
    return triple(value / episode.frame_rate_hz**2 for value in episode.gravity)


def shown_symmetries(episode: Episode, network: NetworkConfig) -> tuple[Symmetry, ...]:
    """Returns the symmetries that training may apply to the scene; with relative inputs gravity turns with it."""
    gravity = (0.0, 0.0, 0.0) if network.relative else episode.gravity
    size, cell_size = episode.domain_size, episode.obstacle_grid.cell_size
    return scene_symmetries(gravity, size, cell_size, int(not episode.imported), episode.dimensions)
