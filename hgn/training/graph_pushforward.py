"""The pushforward pool of backend triton: simulated, cut into windows and read on the device.

The rule, and the pool of backend torch, are in hgn.training.pushforward.

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
from hgn.kernels.barrier_table import BarrierTable
from hgn.kernels.grid.op import ObstacleTable
from hgn.kernels.rollout.kernel import DIVERGED
from hgn.kernels.update.op import DeviceEpisode, DeviceSample
from hgn.network.cell_keys import COORDINATE_BITS
from hgn.network.features import ParticleState
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.network.obstacles import ObstacleCells
from hgn.runtime.triton_rollout import CHECKED_PARTICLES, TritonRollout
from hgn.training.noise import noise_scale, target_acceleration
from hgn.training.pushforward import (
    PoolDraws,
    by_frames,
    diverged_scenes,
    known_frames,
    pool_figures,
    pushforward_windows,
    usable_frames,
)

SPARE = 1.1  # more particles than the scenes of the first simulation have


class GraphPushforwardPool:
    """The pool on backend triton; what it holds is what hgn.training.pushforward.PushforwardPool would."""

    def __init__(
        self, network: HierarchicalGraphNetwork, training: TrainingConfig, obstacle_cell_size: float, rank: int
    ) -> None:
        """`network` simulates; it also checks the kernels, the first time."""
        self.network, self.training, self.rank = network, training, rank
        self.obstacle_cell_size = obstacle_cell_size
        self._rollout: TritonRollout | None = None
        self._samples: list[tuple[DeviceEpisode, float]] = []  # with the rms of the target acceleration
        self._draws = PoolDraws(training, rank, [])
        self.figures: dict[str, float] = {}

    def replaced(self, samples: list[DeviceSample], update: int) -> list[DeviceSample]:
        """The samples of an update with a fraction from the pool; seeds stay."""
        samples = list(samples)
        for slot, (number, rarity) in enumerate(self._draws.drawn(update)):
            episode, acceleration = self._samples[number]
            seed = samples[slot].seed
            scale, weight = noise_scale(self.training, acceleration, seed)
            samples[slot] = DeviceSample(episode, 0, seed, rarity * weight, scale)
        return samples

    def refresh(self, starts: Sequence[tuple[DeviceEpisode, int]], values: torch.Tensor) -> None:
        """Simulates from these frames with `values`, the parameters in the packed layout, and makes the pool of that.

        Raises: ConfigError the first time, when the kernels are wrong here.
        """
        begin_s = time.monotonic()
        self._samples = []  # frees the memory
        squares, known = [], 0
        before = self.network.config.velocity_history  # frames of a DeviceEpisode that come before frame 0
        for frames, alike in by_frames(self.training, starts, [episode.frames - before for episode, _ in starts]):
            answered = [known_frames(frames, episode.frames - before, frame) for episode, frame in alike]
            squares += self._taken(alike, answered, frames, len(starts), values)
            known += sum(answered)
        self._draws = PoolDraws(self.training, self.rank, [acceleration for _, acceleration in self._samples])
        self.figures = pool_figures(len(self._samples), known, squares, time.monotonic() - begin_s)

    def _taken(
        self,
        starts: Sequence[tuple[DeviceEpisode, int]],
        answered: Sequence[int],
        frames: int,
        scenes: int,
        values: torch.Tensor,
    ) -> list[float]:
        """Simulates so many frames and adds the windows of those that the truth answers; the mean squared distance at
        the end of each scene that is there until then. The buffers are for `scenes`, of which the last may be empty.
        """
        config, device = self.network.config, values.device
        truths = [
            episode.position_TN3[frame : frame + config.velocity_history + known + 2].to(device)
            for (episode, frame), known in zip(starts, answered, strict=True)
        ]
        episodes = [episode for episode, _ in starts]
        path_FN3 = self._simulate(episodes, self._state(episodes, truths, scenes), frames, values)
        paths = path_FN3.split([episode.particles for episode in episodes], dim=1)
        parts = [path_FN3[:known] for path_FN3, known in zip(paths, answered, strict=True)]
        domain_S3 = torch.tensor([episode.domain_size for episode in episodes], device=device)
        counts_and_squares = [
            torch.stack([x.double() for x in usable_frames(truth, part, domain_3, config.cell_size)])
            for truth, part, domain_3 in zip(truths, parts, domain_S3, strict=True)
        ]
        squares = []
        for episode, truth, part, (count, square) in zip(
            episodes, truths, parts, torch.stack(counts_and_squares).tolist(), strict=True
        ):
            windows = pushforward_windows(truth, part, self.training.pushforward_pull, config.cell_size)
            windows = windows[: int(count)].contiguous()
            accelerations = target_acceleration(windows).tolist()
            self._samples += [
                (replace(episode, position_TN3=w), a) for w, a in zip(windows, accelerations, strict=True)
            ]
            squares += [square] if count == len(part) else []
        return squares

    def _state(self, episodes: Sequence[DeviceEpisode], truths: Sequence[torch.Tensor], scenes: int) -> ParticleState:
        """The true state that the simulation starts from; obstacles have tables of their own."""
        history, device = self.network.config.velocity_history, truths[0].device
        past_TN3 = torch.cat([truth[: history + 1] for truth in truths], dim=1)
        counts = torch.tensor([episode.particles for episode in episodes], device=device)
        placed = [*episodes, *[episodes[0]] * (scenes - len(episodes))]  # empty scenes have the domain of any
        return ParticleState(
            position_N3=past_TN3[-1],
            velocity_NM3=past_TN3.diff(dim=0).flip(0).transpose(0, 1),
            material_N=torch.cat([episode.material_N for episode in episodes]),
            scene_N=torch.arange(len(episodes), device=device).repeat_interleave(counts),
            domain_S3=torch.tensor([episode.domain_size for episode in placed], device=device),
            gravity_S3=torch.tensor([episode.gravity for episode in placed], device=device),
            obstacles=None,
        )

    def _simulate(
        self, episodes: Sequence[DeviceEpisode], state: ParticleState, frames: int, values: torch.Tensor
    ) -> torch.Tensor:
        """Positions [F, N, 3]; of a scene that diverged, whatever came after."""
        rollout = self._begun(episodes, state, values)
        pieces, done = [], 0
        while done < frames:
            path_TN3, status = rollout.look(frames - done)
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
        table, empty = None, state.scene_count - len(episodes)
        if config.obstacle_features:
            table = ObstacleTable(
                [*(episode.obstacles for episode in episodes), *[None] * empty], self.obstacle_cell_size, device
            )
        barriers = None
        if config.obstacle_clearance is not None:
            barriers = BarrierTable([*(episode.barrier for episode in episodes), *[None] * empty], device)
        rollout = self._rollout
        if rollout is not None and len(state.position_N3) <= rollout.particles:
            if table is not None:
                assert rollout.obstacles is not None
                rollout.obstacles.take(table)
            if barriers is not None:
                assert rollout.barriers is not None
                rollout.barriers.take(barriers)
            rollout.use_values(values)
            rollout.begin(state)
            return rollout
        capacities = None
        if rollout is not None:
            capacities = rollout.grid.capacities
            self._rollout = rollout = None  # before the new one is allocated
        particles = 16 * math.ceil(SPARE * len(state.position_N3) / 16)
        rollout = TritonRollout(self.network, state, self.training.precision, capacities, particles, table, barriers)
        if capacities is None:
            first = self._first_scenes(episodes, state)
            if first is not None:
                rollout.require_parity(self.network, first, "training.backend")
                if device.type == "cuda":
                    torch.cuda.empty_cache()  # what is free decides where episodes are kept
        rollout.use_values(values)
        self._rollout = rollout
        return rollout

    def _first_scenes(self, episodes: Sequence[DeviceEpisode], state: ParticleState) -> ParticleState | None:
        """As many of the first scenes as PyTorch can check, with their obstacles; none if one is too many."""
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
            key_K = torch.cat([cells.key_K + (scene << 3 * COORDINATE_BITS) for scene, cells in seen])
            order_K = torch.argsort(key_K)
            normal_K3 = torch.cat([cells.normal_K3 for _, cells in seen])[order_K]
            obstacles = ObstacleCells(key_K[order_K], normal_K3, self.obstacle_cell_size)
        return replace(
            state,
            position_N3=state.position_N3[:count],
            velocity_NM3=state.velocity_NM3[:count],
            material_N=state.material_N[:count].long(),
            scene_N=state.scene_N[:count],
            domain_S3=state.domain_S3[:scenes],
            gravity_S3=state.gravity_S3[:scenes],
            obstacles=obstacles,
        )

    def _set_back(self, rollout: TritonRollout, state: ParticleState) -> None:
        """Scenes that have lost a particle begin again, at rest, where nobody looks: the others go on."""
        count = rollout.live
        again_N1 = diverged_scenes(rollout.position_N3[:count], rollout.scene_N[:count], rollout.domain_S3)[:, None]
        rollout.position_N3[:count] = torch.where(again_N1, state.position_N3, rollout.position_N3[:count])
        rollout.velocity_NV[:count] = torch.where(again_N1, 0.0, rollout.velocity_NV[:count])
        rollout.lost.zero_()
        rollout.grid.status.zero_()
