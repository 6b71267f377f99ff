"""Builds batches: position windows around frames of episodes, concatenated over their particles.

Shape legend: H velocity history, W = H + 2 frames, N particles of all scenes, S scenes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from hgn.config import NetworkConfig
from hgn.data.episode_tensors import frame_gravity, seen_surfaces, shown_symmetries
from hgn.data.sampler import SamplerState
from hgn.network.elastic import RestShape
from hgn.network.features import ParticleState, material_rows
from hgn.network.moving import MovingObstacles
from hgn.network.obstacles import ObstacleCells
from hgn.network.own_physics import physics_fields
from hgn.scene.episode import Episode
from hgn.scene.history import window
from hgn.scene.moving import moving_of_episode
from hgn.scene.symmetry import Symmetry

# fields that a batch has in common with a ParticleState
OF_STATE = (
    *("material_N", "scene_N", "domain_S3", "gravity_S3", "obstacles"),
    *("wall_friction_S3", "parameter_NP", "rest", "moving"),
)


@dataclass(frozen=True, eq=False)
class Batch:
    """Holds windows x^{n-H} … x^{n+1}. The last frame is the target, the others are the input."""

    window_WN3: torch.Tensor  # float32, domain units
    material_N: torch.Tensor  # int64, index into the network's materials
    scene_N: torch.Tensor  # int64
    particles_S: tuple[int, ...]  # number of particles of each scene, on the host
    domain_S3: torch.Tensor
    gravity_S3: torch.Tensor  # domain units per frame squared
    obstacles: ObstacleCells | None
    seeds_S: tuple[int, ...]  # seeds of noise, jitter and symmetry
    symmetries_S: tuple[tuple[Symmetry, ...], ...] = ()  # symmetries of each scene that training may apply
    weight_S: tuple[float, ...] = ()  # loss weight of each scene; empty: 1
    wall_friction_S3: torch.Tensor | None = None  # as in ParticleState
    parameter_NP: torch.Tensor | None = None  # as in ParticleState
    rest: RestShape | None = None  # as in ParticleState
    moving: MovingObstacles | None = None  # as in ParticleState

    def to(self, device: torch.device, non_blocking: bool = False) -> "Batch":
        own = {name: value for name in ("window_WN3", *OF_STATE) if (value := getattr(self, name)) is not None}
        moved: dict[str, Any] = {name: value.to(device, non_blocking=non_blocking) for name, value in own.items()}
        return replace(self, **moved)

    def state(self, window_WN3: torch.Tensor | None = None) -> ParticleState:
        """Returns the network's input at frame n from this window, or from a perturbed copy of it."""
        if window_WN3 is None:
            window_WN3 = self.window_WN3
        velocity_MN3 = (window_WN3[1:-1] - window_WN3[:-2]).flip(0)
        own: dict[str, Any] = {name: getattr(self, name) for name in OF_STATE}
        return ParticleState(position_N3=window_WN3[-2], velocity_NM3=velocity_MN3.transpose(0, 1), **own)

    def acceleration(self, window_WN3: torch.Tensor | None = None) -> torch.Tensor:
        """Returns v^{n+1} - v^n in frame units, [N, 3]."""
        if window_WN3 is None:
            window_WN3 = self.window_WN3
        return (window_WN3[-1] - window_WN3[-2]) - (window_WN3[-2] - window_WN3[-3])

    def mean_over_scenes(self, value_N: torch.Tensor) -> torch.Tensor:
        """Returns a scalar: the mean over scenes of (loss weight of a scene) * (mean over its particles)."""
        weight_S = self.weight_S or (1.0,) * len(self.particles_S)
        pairs = zip(weight_S, self.particles_S, strict=True)
        factor_S = torch.tensor([weight / (len(weight_S) * max(count, 1)) for weight, count in pairs])
        return (value_N * factor_S.to(value_N)[self.scene_N]).sum()


@dataclass(frozen=True, eq=False)
class BatchSample:
    """Holds a frame of an episode to train on. With backend triton it is a hgn.kernels.update.op.DeviceSample."""

    episode: Episode
    frame: int
    window_WN3: np.ndarray  # positions around the frame, from the episode or from a simulation
    seed: int = 0  # seed of noise, jitter and symmetry
    weight: float = 1.0  # loss weight


@dataclass(frozen=True, eq=False)
class WindowChunk:
    """Holds the samples of one update on backend torch. For triton see hgn.data.episode_tensors.EpisodeChunk."""

    samples: tuple[tuple[BatchSample, ...], ...]  # samples of each update; here of one update
    sampler_state: SamplerState  # position in the order of samples after this update
    starts: tuple[tuple[Episode, int], ...] = ()  # starts of the simulations before this update
    batch: Batch | None = None  # the samples as tensors; None if the pushforward pool may replace some of them


def make_batch(
    frames: Sequence[tuple[Episode, int]], network: NetworkConfig, seeds: Sequence[int] | None = None
) -> Batch:
    """Returns the windows of (episode, frame) pairs, with the obstacle inputs of the network."""
    pairs = zip(frames, seeds or [0] * len(frames), strict=True)
    history = network.velocity_history
    return join([BatchSample(e, frame, window(e, frame, history), seed) for (e, frame), seed in pairs], network)


def moving_in(samples: Sequence[BatchSample], network: NetworkConfig) -> MovingObstacles | None:
    """Returns the moving obstacles of samples in their frames, for a network that has them as inputs."""
    if "moving" not in network.own_physics:
        return None
    scenes, frames = [moving_of_episode(s.episode) for s in samples], [s.frame for s in samples]
    return MovingObstacles.of(scenes, frames, 1 / samples[0].episode.frame_rate_hz, network)


def join(samples: Sequence[BatchSample], network: NetworkConfig) -> Batch:
    """Returns the samples as the tensors of one batch."""
    episodes = [sample.episode for sample in samples]
    particles = tuple(len(episode.material_N) for episode in episodes)
    material_N = torch.cat([material_rows(e.material_N, network.materials, e.materials) for e in episodes])
    grids = [seen_surfaces(e, network) for e in episodes] if network.obstacle_features else []
    return Batch(
        window_WN3=torch.from_numpy(np.concatenate([sample.window_WN3 for sample in samples], axis=1)),
        material_N=material_N,
        scene_N=torch.from_numpy(np.repeat(np.arange(len(episodes)), particles)),
        particles_S=particles,
        domain_S3=torch.tensor([episode.domain_size for episode in episodes], dtype=torch.float32),
        gravity_S3=torch.tensor([frame_gravity(episode) for episode in episodes], dtype=torch.float32),
        obstacles=ObstacleCells.of(grids),
        seeds_S=tuple(sample.seed for sample in samples),
        weight_S=tuple(sample.weight for sample in samples),
        symmetries_S=tuple(shown_symmetries(e, network) for e in episodes),
        moving=moving_in(samples, network),
        **physics_fields(network, episodes, material_N),
    )
