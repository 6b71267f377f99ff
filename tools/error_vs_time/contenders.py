"""Contenders: networks, the solver on several grids and with several steps, and baselines.

Each contender computes one-step errors, if it has any, and rollouts, all of the same test scenes.
Shape legend: T frames, N particles of a scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from hgn.config import NetworkConfig
from hgn.data.batch import Batch, make_batch
from hgn.runtime.backend import choose
from hgn.runtime.rollouts import RolloutResult, simulate_scenes
from hgn.runtime.simulator import InitialState, Simulator
from hgn.runtime.weights import load_weights, require_frame_rate
from hgn.scene.episode import Episode
from hgn.training.errors import PARTICLES_PER_BATCH, Predictor, SquaredError, groups_of_frames, network_predictor
from tools.solver_rollouts import OnFrame, Setting, SolverLaunches
from tools.timing import matmul_precision

if TYPE_CHECKING:
    from hgn.runtime.triton_backend import TritonBackend

Row = dict[str, Any]
PARTICLES_AT_ONCE = 150_000  # particles per batch of one-step errors with backend triton
REST_SPEED = 1e-4  # domain units per frame; slower particles are at rest


@dataclass
class OneStep:
    """Holds one-step errors of a scene, and accelerations predicted for its particles at rest."""

    error: SquaredError = field(default_factory=SquaredError)
    rest_sum: float = 0.0  # sum of the lengths of accelerations at rest, domain units per frame squared
    rest_count: int = 0


class Contender:
    """Describes a row of the report, and computes its errors."""

    row: Row  # system and settings
    all_at_once = False  # simulates all scenes side by side, instead of score.BATCH_SCENES
    stepped = True  # computes frames one by one, without captured or compiled programs

    def one_step(self, episode: Episode, stride: int) -> OneStep | None:
        """Returns errors of the accelerations of every stride-th frame; None if the contender predicts none."""
        return None

    def trials(self, episodes: Sequence[Episode], frames: int, on_frame: OnFrame) -> list[RolloutResult]:
        """Simulates from the episodes' first frames, side by side."""
        raise NotImplementedError

    def release(self) -> None:
        """Frees the device memory that was kept for further rollouts."""


class NetworkContender(Contender):
    """Runs a weights file at one precision of its matrix products, on the fastest backend."""

    def __init__(self, file: Path, precision: str, device: torch.device, frame_rate_hz: float) -> None:
        """Raises: ConfigError if no backend supports the precision."""
        self.file, self.device, self.precision = file, device, precision
        self.network, info = load_weights(file, device)
        require_frame_rate(info, frame_rate_hz)
        config = info.network
        with matmul_precision(self.precision):
            chosen = choose(device, self.network, precision, "auto")
            self.simulator = Simulator(self.network, info.frame_rate_hz, chosen)
        self.stepped = chosen.stepped
        self.row = {
            "system": config.kind,
            "weights": file.name,
            "levels": config.levels,
            "message_passing_steps": config.message_passing_steps,
            "width": config.width,
            "backend": chosen.name,
            "precision": precision,
            "updates": info.updates,
        }

    def one_step(self, episode: Episode, stride: int) -> OneStep:
        predict, at_once = network_predictor(self.simulator.backend), PARTICLES_PER_BATCH
        if not self.stepped:
            from hgn.runtime.triton_backend import TritonBackend  # loads Triton

            assert isinstance(self.simulator.backend, TritonBackend)
            predict, at_once = partial(triton_acceleration, self.simulator.backend), PARTICLES_AT_ONCE
        with matmul_precision(self.precision):
            return one_step(predict, self.network.config, episode, stride, self.device, at_once)

    def trials(self, episodes: Sequence[Episode], frames: int, on_frame: OnFrame) -> list[RolloutResult]:
        with matmul_precision(self.precision):
            return simulate_scenes(self.simulator, [InitialState.of_episode(e) for e in episodes], frames, on_frame)

    def release(self) -> None:
        self.simulator.backend.release()


class SolverContender(Contender):
    """Runs the solver that generated the data, on a grid and with a step.

    It has no one-step error, because a step would need stresses and volumes, which are not in the data.
    """

    all_at_once = True  # a single scene uses only a few of a GPU's processors

    def __init__(self, launches: SolverLaunches, setting: Setting, named: Row | None = None) -> None:
        """`named` replaces the row that the settings give."""
        self.launches, self.setting = launches, setting
        grid = round(1 / launches.cell_size)
        self.row = named or {"system": "mpm", "grid": grid, "step": setting.step, "precision": "fp32"}

    def trials(self, episodes: Sequence[Episode], frames: int, on_frame: OnFrame) -> list[RolloutResult]:
        if on_frame is not None:
            return self.launches.simulate([(self.setting, episode) for episode in episodes], frames, on_frame)
        return self.launches.trials(self.setting, episodes)


class BaselineContender(Contender):
    """Gives every particle of a scene the same acceleration."""

    def __init__(self, name: str, acceleration: Callable[[Episode], np.ndarray], device: torch.device) -> None:
        self.row = {"system": "baseline", "predictor": name}
        self.acceleration, self.device = acceleration, device

    def one_step(self, episode: Episode, stride: int) -> OneStep:
        acceleration_3 = torch.from_numpy(self.acceleration(episode)).float().to(self.device)
        network = NetworkConfig(obstacle_features=False)
        return one_step(lambda b: acceleration_3.expand_as(b.window_WN3[0]), network, episode, stride, self.device)

    def trials(self, episodes: Sequence[Episode], frames: int, on_frame: OnFrame) -> list[RolloutResult]:
        time_T11 = np.arange(frames)[:, None, None]

        def trial(episode: Episode) -> RolloutResult:
            velocity_N3 = episode.initial_velocity_N3 / episode.frame_rate_hz
            # as for networks: velocities are integrated first, and the history before frame 0 is free fall
            velocity_N3 = velocity_N3 - 0.5 * np.asarray(episode.gravity) / episode.frame_rate_hz**2
            path_TN3 = velocity_N3 * time_T11 + self.acceleration(episode) * (0.5 * time_T11 * (time_T11 + 1))
            return RolloutResult((episode.position_TN3[0] + path_TN3).astype(np.float32))

        with ThreadPoolExecutor(torch.get_num_threads()) as threads:
            return list(threads.map(trial, episodes))


class FallingContender(Contender):
    """Lets each particle fly freely from the first frame until it meets a wall of the domain, where it stays."""

    def __init__(self, wall: float) -> None:
        """Takes the thickness of the domain's walls, in domain units."""
        self.row, self.wall = {"system": "baseline", "predictor": "fall and stop at the floor"}, wall

    def trials(self, episodes: Sequence[Episode], frames: int, on_frame: OnFrame) -> list[RolloutResult]:
        return [RolloutResult(self._path(episode, frames)) for episode in episodes]

    def _path(self, episode: Episode, frames: int) -> np.ndarray:
        time_T11 = np.arange(frames)[:, None, None] / episode.frame_rate_hz
        fall_TN3 = time_T11 * episode.initial_velocity_N3 + 0.5 * time_T11**2 * np.asarray(episode.gravity)
        path_TN3 = episode.position_TN3[0] + fall_TN3
        low, high = self.wall, np.asarray(episode.domain_size) - self.wall
        outside_TN = ((path_TN3 < low) | (path_TN3 > high)).any(axis=2)
        stop_N = np.where(outside_TN.any(axis=0), outside_TN.argmax(axis=0), frames)
        frame_TN1 = np.minimum(np.arange(frames)[:, None], stop_N)[:, :, None]
        return np.take_along_axis(path_TN3, frame_TN1, axis=0).clip(low, high).astype(np.float32)


def triton_acceleration(backend: TritonBackend, batch: Batch) -> torch.Tensor:
    """Predicts accelerations with backend triton: simulates one frame from each state."""
    state = batch.state()
    with backend.stepper(state) as stepper:
        for _ in stepper.blocks(1):
            pass
        output_N3 = stepper.fused.output[: len(state.position_N3), :3]  # before the constraints of the frame
        return backend.network.restored_acceleration(output_N3, state)


def one_step(
    predict: Predictor,
    network: NetworkConfig,
    episode: Episode,
    stride: int,
    device: torch.device,
    particles_per_batch: int = PARTICLES_PER_BATCH,
) -> OneStep:
    """Measures a predictor on every stride-th frame of an episode, without noise."""
    result = OneStep()
    pairs = [(episode, n) for n in range(0, len(episode.position_TN3) - 1, stride)]
    with torch.inference_mode():
        for group in groups_of_frames(pairs, particles_per_batch):
            batch = make_batch(group, network).to(device)
            predicted_N3, true_N3 = predict(batch), batch.acceleration()
            result.error.add((predicted_N3 - true_N3).square().sum(-1), batch.material_N, network.materials)
            speed_NM = batch.state().velocity_NM3.norm(dim=-1)
            resting_N = (speed_NM.amax(1) < REST_SPEED) & (true_N3.norm(dim=-1) < REST_SPEED)
            result.rest_sum += float(predicted_N3.norm(dim=-1)[resting_N].double().sum())
            result.rest_count += int(resting_N.sum())
    return result
