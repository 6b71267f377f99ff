"""Pushforward on backend torch: scenes in host memory, simulated by the fastest backend that steps by frames.

Shape legend: as in hgn.training.pushforward.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from hgn.data.batch import BatchSample, make_batch
from hgn.network.barriers import Barriers
from hgn.network.base import ParticleNetwork
from hgn.runtime.backend import fastest_stepped
from hgn.runtime.stepped_rollout import stepped
from hgn.scene.episode import Episode
from hgn.scene.history import window
from hgn.training.errors import PARTICLES_PER_BATCH
from hgn.training.pushforward import diverged_scenes, simulated_barrier


class TorchScenes:
    """Implements hgn.training.pushforward.SimulatedScenes."""

    def __init__(self, network: ParticleNetwork) -> None:
        """`network` simulates."""
        self._network, self._backend = network, fastest_stepped(network)
        self._backend.step = network.step.in_training

    @property
    def cell_size(self) -> float:
        return self._network.config.cell_size

    def frame_count(self, episode: Episode) -> int:
        return episode.frame_count

    def domain_size(self, episode: Episode) -> torch.Tensor:
        return torch.tensor(episode.domain_size)

    def groups(self, starts: Sequence[tuple[Episode, int]]) -> list[Sequence[tuple[Episode, int]]]:
        groups: list[list[tuple[Episode, int]]] = []
        capacity = 0  # particles that fit into the last group
        for start in starts:
            if capacity <= 0:
                groups.append([])
                capacity = PARTICLES_PER_BATCH
            groups[-1].append(start)
            capacity -= len(start[0].material_N)
        return [*groups]

    def simulate(self, starts: Sequence[tuple[Episode, int]], frames: int) -> list[torch.Tensor]:
        config = self._network.config
        batch = make_batch(starts, config).to(self._backend.device)
        begin = state = replace(batch.state(), barriers=self._barriers([episode for episode, _ in starts]))
        path = []
        for _ in range(frames):
            state = stepped(self._backend.predict, state, self._backend.step, config.dimensions)
            path.append(state.position_N3.cpu().clone())
            again_N = diverged_scenes(state.position_N3, state.scene_N, state.domain_S3)
            if bool(again_N.any()):
                position_N3 = torch.where(again_N[:, None], begin.position_N3, state.position_N3)
                velocity_NM3 = torch.where(again_N[:, None, None], 0.0, state.velocity_NM3)
                state = replace(state, position_N3=position_N3, velocity_NM3=velocity_NM3)
        return list(torch.stack(path).split(list(batch.particles_S), dim=1))

    def true_frames(self, episode: Episode, frame: int, known: int) -> torch.Tensor:
        return torch.from_numpy(window(episode, frame, self._network.config.velocity_history, known + 1))

    def sample(self, episode: Episode, frame: int, window_WN3: torch.Tensor) -> BatchSample:
        return BatchSample(episode, frame, window_WN3.numpy())

    def drawn(self, sample: BatchSample, seed: int, weight: float, scale: float) -> BatchSample:
        return replace(sample, seed=seed, weight=weight, noise_scale=scale)

    def _barriers(self, episodes: Sequence[Episode]) -> Barriers | None:
        """Returns the obstacles that constrain simulations; windows are trained on without."""
        clearance = self._backend.step.obstacle_clearance
        if clearance is None:
            return None
        barriers = Barriers.of([simulated_barrier(episode, clearance) for episode in episodes])
        return barriers and barriers.to(self._backend.device)
