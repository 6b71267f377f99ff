"""The pool of the network's own states on backend triton: simulated, cut into windows and read on the device.

A window is an episode of W frames with its scene's material and obstacles, so that the kernels of an update read it as
any other. Buffers and the captured graph are kept from one simulation to the next.
Shape legend: as in hgn.training.pushforward.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace

import torch

from hgn.config import TrainingConfig
from hgn.data.rest_noise import asked_acceleration, noise_at_rest
from hgn.kernels.grid.op import ObstacleTable
from hgn.kernels.rollout.kernel import DIVERGED
from hgn.kernels.update.op import DeviceEpisode, DeviceSample
from hgn.network.cell_keys import COORDINATE_BITS
from hgn.network.features import ParticleState
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.network.obstacles import ObstacleCells
from hgn.runtime.triton_rollout import CHECKED_PARTICLES, TritonRollout
from hgn.training.pushforward import drawn_entries, figures_of, frames_kept, lost_scenes, own_windows

ROOM = 1.1  # more particles than the scenes of the first simulation have


class GraphPushforwardPool:
    """The pool on backend triton; what it holds is what hgn.training.pushforward.PushforwardPool would."""

    def __init__(
        self, network: HierarchicalGraphNetwork, training: TrainingConfig, obstacle_cell_size: float, rank: int
    ) -> None:
        """`network` simulates; it also checks the kernels, the first time."""
        self.network, self.training, self.rank = network, training, rank
        self.obstacle_cell_size = obstacle_cell_size
        self._rollout: TritonRollout | None = None
        self._entries: list[tuple[DeviceEpisode, float]] = []  # with the acceleration that is asked for
        self.figures: dict[str, float] = {}

    def mixed(self, samples: list[DeviceSample], update: int) -> list[DeviceSample]:
        """The samples of an update with their share replaced; seeds stay."""
        chosen = drawn_entries(self.training, update, self.rank, len(self._entries))
        own = []
        for entry, sample in zip(chosen, samples, strict=False):
            episode, acceleration = self._entries[entry]
            noise, weight = noise_at_rest(self.training, acceleration, sample.seed)
            own.append(DeviceSample(episode, 0, sample.seed, weight, noise))
        return own + samples[len(own) :]

    def refresh(self, starts: Sequence[tuple[DeviceEpisode, int]], values: torch.Tensor) -> None:
        """Simulates from these frames with `values`, the parameters in the packed layout, and makes the pool of that.

        Raises: ConfigError the first time, when the kernels are wrong here.
        """
        begun = time.monotonic()
        self._entries = []  # frees the memory
        frames, config, device = self.training.rollout_frames, self.network.config, values.device
        length = config.velocity_history + frames + 2
        truths = [episode.position_TN3[frame : frame + length].to(device) for episode, frame in starts]
        episodes = [episode for episode, _ in starts]
        path_FN3 = self._simulate(episodes, self._state(episodes, truths), values)
        parts = path_FN3.split([episode.particles for episode in episodes], dim=1)
        domain_S3 = torch.tensor([episode.domain_size for episode in episodes], device=device)
        found = [
            torch.stack([x.double() for x in frames_kept(truth, part, domain_3, config.cell_size)])
            for truth, part, domain_3 in zip(truths, parts, domain_S3, strict=True)
        ]
        squares = []
        for episode, truth, part, (kept, square) in zip(
            episodes, truths, parts, torch.stack(found).tolist(), strict=True
        ):
            windows = own_windows(truth, part, self.training.rollout_pull, config.cell_size)[: int(kept)].contiguous()
            accelerations = asked_acceleration(windows).tolist()
            self._entries += [
                (replace(episode, position_TN3=w), a) for w, a in zip(windows, accelerations, strict=True)
            ]
            squares += [square] if kept == frames else []
        self.figures = figures_of(self.training, len(self._entries), squares, time.monotonic() - begun)

    def _state(self, episodes: Sequence[DeviceEpisode], truths: Sequence[torch.Tensor]) -> ParticleState:
        """The true state that the simulation starts from; obstacles have a table of their own."""
        history, device = self.network.config.velocity_history, truths[0].device
        past_TN3 = torch.cat([truth[: history + 1] for truth in truths], dim=1)
        counts = torch.tensor([episode.particles for episode in episodes], device=device)
        return ParticleState(
            position_N3=past_TN3[-1],
            velocity_NM3=past_TN3.diff(dim=0).flip(0).transpose(0, 1),
            material_N=torch.cat([episode.material_N for episode in episodes]),
            scene_N=torch.arange(len(episodes), device=device).repeat_interleave(counts),
            domain_S3=torch.tensor([episode.domain_size for episode in episodes], device=device),
            obstacles=None,
        )

    def _simulate(self, episodes: Sequence[DeviceEpisode], state: ParticleState, values: torch.Tensor) -> torch.Tensor:
        """Positions [F, N, 3]; of a scene that was lost, whatever came after."""
        rollout = self._begun(episodes, state, values)
        pieces, done = [], 0
        while done < self.training.rollout_frames:
            path_TN3, status = rollout.look(self.training.rollout_frames - done)
            pieces.append(path_TN3.clone())
            done += len(path_TN3)
            if status & DIVERGED.value:
                self._set_back(rollout, state)
            else:
                rollout.make_room(status)
        return torch.cat(pieces)

    def _begun(self, episodes: Sequence[DeviceEpisode], state: ParticleState, values: torch.Tensor) -> TritonRollout:
        """A simulation at its start; that of before, where there is room in it."""
        config, device = self.network.config, values.device
        table = None
        if config.obstacle_features:
            table = ObstacleTable([episode.obstacles for episode in episodes], self.obstacle_cell_size, device)
        known = self._rollout
        if known is not None and len(state.position_N3) <= known.particles:
            if table is not None:
                assert known.obstacles is not None
                known.obstacles.take(table)
            known.use_values(values)
            known.begin(state)
            return known
        capacities = None
        if known is not None:
            capacities = known.grid.capacities
            self._rollout = known = None  # before the new one is allocated
        room = 16 * math.ceil(ROOM * len(state.position_N3) / 16)
        made = TritonRollout(self.network, state, self.training.precision, capacities, room, table)
        if capacities is None:
            first = self._first_scenes(episodes, state)
            if first is not None:
                made.require_agreement(self.network, first, "training.backend")
                if device.type == "cuda":
                    torch.cuda.empty_cache()  # what is free decides where episodes are kept
        made.use_values(values)
        self._rollout = made
        return made

    def _first_scenes(self, episodes: Sequence[DeviceEpisode], state: ParticleState) -> ParticleState | None:
        """As many of the first scenes as the plain network can check, with their obstacles; none if one is too many."""
        scenes, count = 0, 0
        while scenes < len(episodes) and count + episodes[scenes].particles <= CHECKED_PARTICLES:
            count += episodes[scenes].particles
            scenes += 1
        if count == 0:
            return None
        seen = [(scene, e.obstacles) for scene, e in enumerate(episodes[:scenes]) if e.obstacles is not None]
        obstacles = None
        if seen:
            # a hash has the keys of scene 0
            key_K = torch.cat([found.key_K + (scene << 3 * COORDINATE_BITS) for scene, found in seen])
            order_K = torch.argsort(key_K)
            normal_K3 = torch.cat([found.normal_K3 for _, found in seen])[order_K]
            obstacles = ObstacleCells(key_K[order_K], normal_K3, self.obstacle_cell_size)
        return replace(
            state,
            position_N3=state.position_N3[:count],
            velocity_NM3=state.velocity_NM3[:count],
            material_N=state.material_N[:count].long(),
            scene_N=state.scene_N[:count],
            domain_S3=state.domain_S3[:scenes],
            obstacles=obstacles,
        )

    def _set_back(self, rollout: TritonRollout, state: ParticleState) -> None:
        """Scenes that have lost a particle begin again, at rest, where nobody looks: the others go on."""
        count = rollout.live
        again_N1 = lost_scenes(rollout.position_N3[:count], rollout.scene_N[:count], rollout.domain_S3)[:, None]
        rollout.position_N3[:count] = torch.where(again_N1, state.position_N3, rollout.position_N3[:count])
        rollout.velocity_NV[:count] = torch.where(again_N1, 0.0, rollout.velocity_NV[:count])
        rollout.lost.zero_()
        rollout.grid.status.zero_()
