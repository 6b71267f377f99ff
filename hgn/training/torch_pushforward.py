"""Pushforward on backend torch: scenes in host memory, simulated by the fastest backend that steps by frames.

Shape legend: as in hgn.training.pushforward.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from hgn.data.batch import BatchSample, make_batch
from hgn.network.barriers import Barriers
from hgn.network.base import ParticleNetwork
from hgn.runtime.backend import fastest_stepped
from hgn.runtime.simulation import Simulation
from hgn.scene.episode import Episode
from hgn.scene.history import window
from hgn.scene.rest_shape import connected_bodies
from hgn.training.errors import groups_of_frames
from hgn.training.pushforward import SimulationStoppedError, simulated_barrier


class TorchScenes:
    """Implements hgn.training.pushforward.SimulatedScenes."""

    def __init__(self, network: ParticleNetwork, stopped: Callable[[], bool] = lambda: False) -> None:
        """`network` computes the simulations. `stopped` is called after each frame."""
        self._network, self._backend, self._stopped = network, fastest_stepped(network), stopped
        self._backend.step = network.step.in_training

    @property
    def cell_size(self) -> float:
        return self._network.config.cell_size

    def frame_count(self, episode: Episode) -> int:
        return episode.frame_count

    def domain_size(self, episode: Episode) -> torch.Tensor:
        return torch.tensor(episode.domain_size)

    def groups(self, starts: Sequence[tuple[Episode, int]]) -> list[Sequence[tuple[Episode, int]]]:
        return list(groups_of_frames(starts))

    def simulate(self, starts: Sequence[tuple[Episode, int]], frames: int) -> list[torch.Tensor]:
        """As SimulatedScenes.simulate. Raises: SimulationStoppedError after a stop request."""

        def on_frame(_: int) -> None:
            if self._stopped():
                raise SimulationStoppedError

        batch = make_batch(starts, self._network.config).to(self._backend.device)
        frame_S = torch.tensor([frame for _, frame in starts], device=self._backend.device)
        barriers = self._barriers([episode for episode, _ in starts])
        begin = replace(batch.state(), barriers=barriers, frame_S=frame_S)
        clearance = self._backend.step.obstacle_clearance
        if begin.moving is not None and clearance is not None:
            begin = replace(begin, moving=begin.moving.with_barriers(clearance))
        with Simulation(self._backend.stepper, begin, isolate=True) as simulation:
            path_FN3 = torch.from_numpy(simulation.run(frames, on_frame))
        return list(path_FN3.split(list(batch.particles_S), dim=1))

    def true_frames(self, episode: Episode, frame: int, simulated: int) -> torch.Tensor:
        return torch.from_numpy(window(episode, frame, self._network.config.velocity_history, simulated + 1))

    def materials_and_bodies(self, episode: Episode) -> tuple[torch.Tensor, list[torch.Tensor]]:
        rest = episode.rest_neighbours if "elastic" in self._network.config.own_physics else None
        bodies = [] if rest is None else connected_bodies(rest[1])
        return torch.tensor(episode.material_N), [torch.from_numpy(body_B) for body_B in bodies]

    def sample(self, episode: Episode, frame: int, window_WN3: torch.Tensor) -> BatchSample:
        return BatchSample(episode, frame, window_WN3.numpy())

    def drawn(self, sample: BatchSample, seed: int, weight: float) -> BatchSample:
        return replace(sample, seed=seed, weight=weight)

    def _barriers(self, episodes: Sequence[Episode]) -> Barriers | None:
        """Returns the obstacles that constrain simulations. Training windows have no barriers."""
        clearance = self._backend.step.obstacle_clearance
        if clearance is None:
            return None
        barriers = Barriers.of([simulated_barrier(episode, clearance) for episode in episodes])
        return barriers and barriers.to(self._backend.device)
