"""What is compared: networks, the solver at several grids and steps, and predictors that have learned nothing.

Each gives its one-step errors where it has any, its rollouts, and itself for timing, on the same test scenes.
Shape legend: T frames, N particles of a scene.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from hgn.config import MpmConfig, NetworkConfig
from hgn.data.batch import Batch, make_batch
from hgn.network.network import HierarchicalGraphNetwork
from hgn.runtime.path import path_on, set_matmul_precision
from hgn.runtime.simulator import InitialState, Simulator
from hgn.runtime.weights import load_weights, require_frame_rate
from hgn.scene.episode import Episode
from hgn.training.errors import Predictor, SquaredError
from tools.trial import FrameClock, Trial, network_trials, solver_scene, solver_trials

PARTICLES_PER_BATCH = 32_768
PRECISIONS = {"fp32": "highest", "tf32": "high", "fp16": "half"}  # names of the report, and of the paths


@dataclass
class OneStep:
    """One-step errors of a scene, and what is predicted for its particles at rest."""

    error: SquaredError = field(default_factory=SquaredError)
    rest_sum: float = 0.0  # of the predicted accelerations' lengths, domain units a frame squared
    rest_count: int = 0


class Contender(Protocol):
    """One row of the report."""

    row: dict[str, Any]  # system and settings
    all_at_once: bool  # whether all scenes are simulated side by side, or so many as the command says

    def one_step(self, episode: Episode, stride: int, rest_speed: float) -> OneStep | None:
        """Errors of the accelerations of every stride-th frame; none where the contender has no such thing."""

    def trials(self, episodes: Sequence[Episode], frames: int, on_frame: Callable[[int], None] | None) -> list[Trial]:
        """Rollouts from the episodes' first frames, side by side."""


class NetworkContender:
    """A weights file at one precision of its matrix products, on the path that a simulation would take."""

    all_at_once = False

    def __init__(self, file: Path, precision: str, path: str, device: torch.device, frame_rate_hz: float) -> None:
        """Raises: ConfigError where the path does not take the network or the precision."""
        self.network, info = load_weights(file, device)
        require_frame_rate(info, frame_rate_hz)
        config = info.network
        self.device, self.precision = device, PRECISIONS[precision]
        self.path, _ = path_on(device, config, path, self.precision)
        with self.matmul():
            self.simulator = Simulator(self.network, info.frame_rate_hz, self.path, self.precision)
        self.row: dict[str, Any] = {
            "system": config.kind,
            "weights": file.name,
            "levels": config.levels,
            "message_passing_steps": config.message_passing_steps,
            "width": config.width,
            "path": self.path,
            "precision": precision,
            "updates": info.updates,
        }

    @contextmanager
    def matmul(self) -> Iterator[None]:
        before = torch.get_float32_matmul_precision()
        set_matmul_precision(self.precision)
        try:
            yield
        finally:
            torch.set_float32_matmul_precision(before)

    def one_step(self, episode: Episode, stride: int, rest_speed: float) -> OneStep:
        config = self.network.config
        with self.matmul():
            if self.path == "fast":
                assert isinstance(self.network, HierarchicalGraphNetwork)
                fast = FastPredictor(self.network, self.precision)
                return one_step(fast, config, episode, stride, rest_speed, self.device, particles_per_batch=1)
            return one_step(lambda b: self.network(b.state()), config, episode, stride, rest_speed, self.device)

    def trials(self, episodes: Sequence[Episode], frames: int, on_frame: Callable[[int], None] | None) -> list[Trial]:
        with self.matmul():
            return network_trials(self.simulator, [InitialState.of_episode(e) for e in episodes], frames, on_frame)


class SolverContender:
    """The solver that made the data, on a grid and with a step of its own."""

    all_at_once = True  # a scene takes one of a GPU's many processors

    def __init__(
        self,
        config: MpmConfig,
        cell_size: float,
        frame_rate_hz: float,
        frames: int,
        timed_frames: int,
        perturbation: float = 0.0,
    ) -> None:
        """Rollouts end at `frames`, timed ones at `timed_frames`."""
        self.config, self.cell_size, self.frame_rate_hz = config, cell_size, frame_rate_hz
        self.frames, self.timed_frames, self.perturbation = frames, timed_frames, perturbation
        self._known: dict[tuple[str, ...], list[Trial]] = {}
        self.row: dict[str, Any] = {
            "system": "mpm",
            "grid": round(1 / cell_size),
            "step": config.stability_fraction,
            "precision": "fp32",
        }

    def named(self, **row: Any) -> SolverContender:
        """The same in another row; what one has simulated the other need not."""
        same = copy.copy(self)
        same.row = row
        return same

    def one_step(self, episode: Episode, stride: int, rest_speed: float) -> None:
        """None: a step begins from stresses and volumes, which positions do not tell."""

    def trials(self, episodes: Sequence[Episode], frames: int, on_frame: Callable[[int], None] | None) -> list[Trial]:
        if on_frame is not None:
            return self._simulate(episodes, min(frames, self.timed_frames), on_frame)
        keys = tuple(episode.key for episode in episodes)
        if keys not in self._known:
            self._known[keys] = self._simulate(episodes, min(frames, self.frames), None)
        return self._known[keys]

    def _simulate(
        self, episodes: Sequence[Episode], frames: int, on_frame: Callable[[int], None] | None
    ) -> list[Trial]:
        scenes = [solver_scene(episode, self.cell_size) for episode in episodes]
        for scene in scenes if self.perturbation else ():
            generator = np.random.default_rng(scene.seed)
            scene.position_N3[:] += generator.uniform(-self.perturbation, self.perturbation, scene.position_N3.shape)
        return solver_trials(scenes, self.config, frames, self.frame_rate_hz, on_frame)


class TrivialContender:
    """The same acceleration for every particle, whatever happens: nothing is learned."""

    all_at_once = False

    def __init__(self, name: str, acceleration: Callable[[Episode], np.ndarray], device: torch.device) -> None:
        self.row: dict[str, Any] = {"system": "trivial", "predictor": name}
        self.acceleration, self.device = acceleration, device

    def one_step(self, episode: Episode, stride: int, rest_speed: float) -> OneStep:
        acceleration_3 = torch.from_numpy(self.acceleration(episode)).float().to(self.device)
        network = NetworkConfig(obstacle_features=False)
        return one_step(
            lambda b: acceleration_3.expand_as(b.window_WN3[0]), network, episode, stride, rest_speed, self.device
        )

    def trials(self, episodes: Sequence[Episode], frames: int, on_frame: Callable[[int], None] | None) -> list[Trial]:
        trials = []
        for episode in episodes:
            time_T11 = np.arange(frames)[:, None, None]
            velocity_N3 = episode.initial_velocity_N3 / episode.frame_rate_hz
            acceleration_3 = self.acceleration(episode)
            # As the networks integrate: the velocity first, and the history before frame 0 falls freely.
            velocity_N3 = velocity_N3 - 0.5 * np.asarray(episode.gravity) / episode.frame_rate_hz**2
            path_TN3 = velocity_N3 * time_T11 + acceleration_3 * (0.5 * time_T11 * (time_T11 + 1))
            trials.append(Trial((episode.position_TN3[0] + path_TN3).astype(np.float32)))
        return trials


class FastPredictor:
    """Accelerations by the fast path's own launches: a frame simulated from each given state of one scene."""

    def __init__(self, network: HierarchicalGraphNetwork, precision: str) -> None:
        from hgn.runtime.fast import FastRollout  # loads Triton

        self._make = lambda state: FastRollout(network, state, precision)
        self._rollout: FastRollout | None = None

    def __call__(self, batch: Batch) -> torch.Tensor:
        state = batch.state()
        rollout = self._rollout = self._rollout or self._make(state)
        rollout.position_N3.copy_(state.position_N3)
        rollout.velocity_NV.copy_(state.velocity_NM3.flatten(1))
        rollout.run(1)
        return rollout.velocity_NV[:, :3] - state.velocity_NM3[:, 0]


def one_step(
    predict: Predictor,
    network: NetworkConfig,
    episode: Episode,
    stride: int,
    rest_speed: float,
    device: torch.device,
    particles_per_batch: int = PARTICLES_PER_BATCH,
) -> OneStep:
    """Errors of a predictor on every stride-th frame of an episode, without noise."""
    result = OneStep()
    frames = list(range(0, len(episode.position_TN3) - 1, stride))
    together = max(1, particles_per_batch // max(1, len(episode.material_N)))
    with torch.inference_mode():
        for first in range(0, len(frames), together):
            batch = make_batch([(episode, n) for n in frames[first : first + together]], network).to(device)
            predicted_N3, true_N3 = predict(batch), batch.acceleration()
            result.error.add((predicted_N3 - true_N3).square().sum(-1), batch.material_N, network.materials)
            speed_NM = batch.state().velocity_NM3.norm(dim=-1)
            resting_N = (speed_NM.amax(1) < rest_speed) & (true_N3.norm(dim=-1) < rest_speed)
            result.rest_sum += float(predicted_N3.norm(dim=-1)[resting_N].double().sum())
            result.rest_count += int(resting_N.sum())
    return result


def frame_milliseconds(contender: Contender, episodes: Sequence[Episode], frames: int) -> float | None:
    """Mean time of a frame of a rollout, everything included; none where it ends too early to tell."""
    clock = FrameClock()
    contender.trials(episodes, frames, clock)
    return clock.milliseconds()
