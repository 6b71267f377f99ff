"""What is timed, and how each is checked before: a frame, a training step, the solver's frame.

A check compares with PyTorch in float64 on the same input. Work that is too large for float64 is checked
on one scene of a tile, by the same code.
"""

from __future__ import annotations

import copy
import time
from dataclasses import replace

import numpy as np
import torch

from hgn.config import MpmConfig, NetworkConfig, TrainingConfig
from hgn.data.batch import Batch
from hgn.network.base import ParticleNetwork
from hgn.network.build import build_network
from hgn.network.features import ParticleState
from hgn.network.gns import GraphNetworkSimulator
from hgn.runtime.backend import build, fastest_stepped, with_gradients
from hgn.runtime.parity import relative_error
from hgn.runtime.simulator import Simulator
from hgn.training.checkpoint import DataInfo
from hgn.training.module import TrainingModule
from tools.bench.config import BenchConfig
from tools.bench.states import SPEED, TILE_PARTICLES, Workload, batch_of, scene_of, state_of
from tools.bench.timing import Timed, once

BOUNDS = {"fp32": 1e-5, "tf32": 2e-3, "fp16": 2e-3}  # relative error of accelerations and loss, of the norm
# Of all gradients together. Looser, for rounding turns the activations that lie next to their kink: of millions of
# them a share like the rounding itself, and the gradient's error is like that share's root.
GRADIENT_BOUNDS = {"fp32": 1e-3, "tf32": 5e-2, "fp16": 5e-2}
FRAME_RATE_HZ = 60.0
CHECKED_AT_MOST = {"frame": 50_000, "train": TILE_PARTICLES}  # particles of all scenes
MPM_ROUNDS = 5
PASS = "pass"


def checked_workload(work: Workload, what: str) -> Workload:
    """The workload itself, or one scene of it, where float64 would not fit."""
    if work.particles * work.scenes <= CHECKED_AT_MOST[what]:
        return work
    return Workload(min(work.particles, TILE_PARTICLES), 1)


def bench_network(config: NetworkConfig, device: torch.device) -> ParticleNetwork:
    """Random weights, and a normaliser with the spread of the bench's states."""
    torch.manual_seed(0)
    network = build_network(config)
    for quantity in ("velocity", "acceleration"):
        network.normaliser.set(quantity, torch.zeros(3), torch.full((3,), SPEED), 0.0)
    return network.to(device).eval()


class TimedRun:
    """What is timed run by run."""

    device: torch.device

    def run(self) -> object:
        raise NotImplementedError

    def timed(self) -> Timed:
        return Timed(lambda: [once(self.run, self.device)])


class Frame(TimedRun):
    """One frame of a simulation: features, grid or neighbours, network, integration."""

    def __init__(
        self,
        config: NetworkConfig,
        work: Workload,
        device: torch.device,
        precision: str = "fp32",
        backend: str | None = None,  # none: the fastest that makes frames one by one
    ) -> None:
        self.device = device
        self.network = bench_network(config, device)
        chosen = build(backend, self.network, precision) if backend else fastest_stepped(self.network, precision)
        self.simulator = Simulator(self.network, FRAME_RATE_HZ, chosen)
        self.state = state_of(work, config, device)

    def run(self) -> ParticleState:
        return self.simulator.step(self.state)

    def check(self, precision: str) -> str:
        """`pass`, or by how much the accelerations differ from float64."""
        found_N3 = self.run().velocity_NM3[:, 0].double() - self.state.velocity_NM3[:, 0].double()
        with torch.no_grad():
            expected_N3 = reference_acceleration(self.network, self.state)
        return verdict("acceleration", relative_error(found_N3, expected_N3), BOUNDS[precision])


class Train(TimedRun):
    """One training step on data that is on the device: noise, jitter, forward, backward, Adam."""

    def __init__(self, config: NetworkConfig, work: Workload, device: torch.device, precision: str = "fp32") -> None:
        self.device = device
        training = TrainingConfig(batch_scenes=work.scenes)
        self.module = TrainingModule(bench_network(config, device).train(), training, _data_info()).to(device)
        self.module.backend = with_gradients(self.module.network, precision)
        self.batch = batch_of(work, config, device)
        self.optimizer = self.module.configure_optimizers()["optimizer"]

    def run(self) -> None:
        self.optimizer.zero_grad()
        self.module.loss(self.batch).backward()
        self.optimizer.step()

    def check(self, precision: str) -> str:
        """`pass`, or by how much loss or gradients differ from float64, without noise and jitter."""
        plain = replace(self.module.training_config, noise_std=0.0, grid_jitter=False)
        module = TrainingModule(self.module.network, plain, _data_info())
        module.backend = self.module.backend
        module.network.zero_grad()
        loss = module.loss(self.batch)
        loss.backward()
        gradients = [_gradient(p) for p in module.network.parameters()]
        expected_loss, expected = reference_gradients(module.network, self.batch)
        first = verdict("loss", relative_error(loss.detach().double(), expected_loss), BOUNDS[precision])
        if first != PASS:
            return first
        error = relative_error(torch.cat(gradients).double(), expected)
        return verdict("gradient", error, GRADIENT_BOUNDS[precision])


class MpmFrame:
    """One frame of the solver that makes the data, at its converged step: of the same particles at rest. What it takes
    with landed and random scenes is measured by tools.studies.solver_targets.
    """

    def __init__(self, work: Workload, config: BenchConfig, device: torch.device) -> None:
        self.scenes = [scene_of(work, seed, config.network.cell_size) for seed in range(work.scenes)]
        self.config = MpmConfig(device="gpu" if device.type == "cuda" else "cpu", scenes_per_launch=work.scenes)
        self.frames = config.mpm_frames
        self.particles = sum(scene.particle_count for scene in self.scenes) // work.scenes
        self.failure: str | None = None
        self.warm = False
        self.substeps = 0.0  # of a frame, mean over particles

    def sample(self) -> list[float]:
        """Milliseconds a frame of a short simulation: frames may come several at once."""
        from datagen.mpm.solver import SceneFailure, simulate

        if not self.warm:  # compilation is no part of it
            simulate(self.scenes, self.config, 2, FRAME_RATE_HZ, lambda _: None)
            self.warm = True
        ends: list[float] = []
        results = simulate(
            self.scenes, self.config, self.frames, FRAME_RATE_HZ, lambda _: ends.append(time.perf_counter())
        )
        steps = 0
        for scene, result in zip(self.scenes, results, strict=True):
            if isinstance(result, SceneFailure):
                self.failure = result.cause
            elif not np.isfinite(result.position_TN3[-1]).all():
                self.failure = "positions are not finite"
            else:
                steps += result.counters["substeps"] * scene.particle_count
        particles = sum(scene.particle_count for scene in self.scenes)
        self.substeps = steps / particles / (self.frames - 1)
        return [(ends[-1] - ends[0]) * 1e3 / (self.frames - 1)]

    def timed(self) -> Timed:
        return Timed(self.sample, MPM_ROUNDS)


def _data_info() -> DataInfo:
    return DataInfo("", FRAME_RATE_HZ, 1 / 64)


def _double(batch: Batch) -> Batch:
    return replace(batch, window_WN3=batch.window_WN3.double(), domain_S3=batch.domain_S3.double())


def reference_gradients(network: ParticleNetwork, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
    """The float64 network's loss without noise and jitter, and the gradients of all parameters, end to end."""
    reference = _reference(network)
    reference.zero_grad()
    target_N3 = reference.target(_double(batch).acceleration(), batch.gravity_S3[batch.scene_N])
    predicted_N3 = reference_output(reference, batch.state())
    loss = batch.mean_over_scenes((predicted_N3 - target_N3).square().mean(-1))
    loss.backward()
    return loss.detach(), torch.cat([_gradient(p) for p in reference.parameters()])


def reference_acceleration(network: ParticleNetwork, state: ParticleState) -> torch.Tensor:
    """What the float64 network predicts."""
    reference = _reference(network)
    return reference.restored_acceleration(reference_output(reference, state), state)


def _reference(network: ParticleNetwork) -> ParticleNetwork:
    """A copy in float64."""
    return copy.deepcopy(network).double()


def reference_output(reference: ParticleNetwork, state: ParticleState) -> torch.Tensor:
    """The float64 network's raw output. Of GNS on the same neighbour list: rounding at the radius is no error."""
    double = replace(
        state,
        position_N3=state.position_N3.double(),
        velocity_NM3=state.velocity_NM3.double(),
        domain_S3=state.domain_S3.double(),
    )
    if isinstance(reference, GraphNetworkSimulator):
        return reference.propagate(double, reference.neighbours(state))
    return reference.normalised_acceleration(double)


def verdict(what: str, error: float, bound: float) -> str:
    """`pass`, or the error in words."""
    return PASS if error <= bound else f"relative error of {what} {error:.1e} exceeds {bound:.0e}"  # NaN fails


def _gradient(parameter: torch.Tensor) -> torch.Tensor:
    return torch.zeros_like(parameter).flatten() if parameter.grad is None else parameter.grad.flatten()
