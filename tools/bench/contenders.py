"""Contenders with their checks: a frame, a training step, a frame of the solver.

A check compares a contender with PyTorch in float64 on the same input. Workloads that are too large for float64 are
replaced in the check by one scene of at most one tile of particles.
"""

import copy
from dataclasses import replace

import numpy as np
import torch

from hgn.config import MpmConfig, NetworkConfig, TrainingConfig
from hgn.data.batch import Batch
from hgn.network.base import ParticleNetwork
from hgn.network.build import build_network
from hgn.network.features import ParticleState
from hgn.network.gns import GraphNetworkSimulator
from hgn.runtime.backend import build, fastest_stepped
from hgn.runtime.parity import relative_error
from hgn.runtime.simulator import Simulator
from hgn.training.torch_updates import batch_loss
from hgn.training.updates import build_optimizer
from tools.bench.states import SPEED, Workload, batch_of, scene_of, state_of
from tools.report import PASS
from tools.timing import FrameClock, Timed, once

BOUNDS = {"fp32": 1e-5, "tf32": 2e-3, "fp16": 2e-3}  # relative error in the norm, of accelerations and of the loss
# Relative error of all gradients together. It is larger, because rounding flips activations next to their kink. The
# flipped fraction is about the rounding error, and the error of the gradient about the root of this fraction.
GRADIENT_BOUNDS = {"fp32": 1e-3, "tf32": 5e-2, "fp16": 5e-2}
FRAME_RATE_HZ = 60.0
MPM_ROUNDS, MPM_FRAMES = 5, 20  # samples of the solver, and frames of each
OBSTACLE_CELL_SIZE = 1 / 64


def bench_network(config: NetworkConfig, device: torch.device) -> ParticleNetwork:
    """Returns a network with random parameters, and a normaliser with the spread of the bench's states."""
    torch.manual_seed(0)
    network = build_network(config)
    for quantity in ("velocity", "acceleration"):
        network.normaliser.set(quantity, torch.zeros(3), torch.full((3,), SPEED), 0.0)
    return network.to(device).eval()


class Contender(Timed):
    """A network that is checked, and then timed run by run."""

    device: torch.device
    at_once = 1  # number of times that a run repeats the work

    def run(self) -> object:
        raise NotImplementedError

    def check(self, precision: str) -> str:
        """Returns `pass`, or the error and its bound."""
        raise NotImplementedError

    def sample(self) -> float:
        return once(self.run, self.device) / self.at_once


class Frame(Contender):
    """One frame of a simulation: features, grid or neighbours, network, integration."""

    def __init__(
        self, config: NetworkConfig, work: Workload, device: torch.device, precision: str, backend: str | None = None
    ) -> None:
        """Takes the name of a `backend`; None: the fastest one that computes frames one by one."""
        self.device = device
        self.network = bench_network(config, device)
        chosen = build(backend, self.network, precision) if backend else fastest_stepped(self.network, precision)
        self.simulator = Simulator(self.network, FRAME_RATE_HZ, chosen)
        self.state = state_of(work, config, device)

    def run(self) -> ParticleState:
        return self.simulator.step(self.state)

    def check(self, precision: str) -> str:
        return check_acceleration(self.run().velocity_NM3[:, 0], self.network, self.state, precision)


class Train(Contender):
    """One training step on data that is on the device: noise, jitter, forward, backward, Adam."""

    def __init__(self, config: NetworkConfig, work: Workload, device: torch.device, precision: str) -> None:
        self.device = device
        self.network = bench_network(config, device).train()
        self.training = TrainingConfig(batch_scenes=work.scenes)
        self.batch = batch_of(work, config, device)
        self.optimizer = build_optimizer(self.network, self.training)

    def run(self) -> None:
        self.optimizer.zero_grad()
        batch_loss(self.network, self.batch, self.training).backward()
        self.optimizer.step()

    def check(self, precision: str) -> str:
        network = self.network
        network.zero_grad()
        loss = batch_loss(network, self.batch, replace(self.training, noise_std=0.0), jitter=False)
        loss.backward()
        return check_update(loss.detach(), _gradients(network), network, self.batch, precision)


class MpmFrame(Timed):
    """One frame of the solver that generates the data, with its default step; the particles start at rest."""

    def __init__(self, work: Workload, cell_size: float, device: torch.device) -> None:
        self.scenes = [scene_of(work, seed, cell_size) for seed in range(work.scenes)]
        self.config = MpmConfig(device=device.type, scenes_per_launch=work.scenes)
        self.particles = sum(scene.particle_count for scene in self.scenes) // work.scenes
        self.rounds, self.warm_up = MPM_ROUNDS, 1
        self.substeps = 0.0  # number of substeps of a frame, mean over particles

    def sample(self) -> float:
        """Returns the mean milliseconds per frame of a short simulation, because several frames may end together."""
        from datagen.mpm.solver import SceneFailure, simulate

        clock = FrameClock()
        results = simulate(self.scenes, self.config, MPM_FRAMES, FRAME_RATE_HZ, clock)
        steps = 0
        for scene, result in zip(self.scenes, results, strict=True):
            if isinstance(result, SceneFailure):
                self.failure = result.cause
            elif not np.isfinite(result.position_TN3[-1]).all():
                self.failure = "positions are not finite"
            else:
                steps += result.counters["substeps"] * scene.particle_count
        particles = sum(scene.particle_count for scene in self.scenes)
        self.substeps = steps / particles / (MPM_FRAMES - 1)
        return (clock.ends[-1] - clock.ends[0]) * 1e3 / (MPM_FRAMES - 1)


def check_acceleration(
    velocity_N3: torch.Tensor, network: ParticleNetwork, state: ParticleState, precision: str
) -> str:
    """Compares the velocities after a frame with float64; returns `pass` or the error."""
    reference = copy.deepcopy(network).double()
    with torch.no_grad():
        expected_N3 = reference.restored_acceleration(reference_output(reference, state), state)
    error = relative_error(velocity_N3.double() - state.velocity_NM3[:, 0].double(), expected_N3)
    return verdict("acceleration", error, BOUNDS[precision])


def check_update(
    loss: torch.Tensor, gradient: torch.Tensor, network: ParticleNetwork, batch: Batch, precision: str
) -> str:
    """Compares loss and gradients, without noise and jitter, with float64; returns `pass` or the error."""
    expected_loss, expected = reference_gradients(network, batch)
    check = verdict("loss", relative_error(loss.double(), expected_loss), BOUNDS[precision])
    if check == PASS:
        check = verdict("gradient", relative_error(gradient.double(), expected), GRADIENT_BOUNDS[precision])
    return check


def reference_gradients(network: ParticleNetwork, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the float64 network's loss without noise and jitter, and all gradients, concatenated."""
    reference = copy.deepcopy(network).double()
    reference.zero_grad()
    double = replace(batch, window_WN3=batch.window_WN3.double(), domain_S3=batch.domain_S3.double())
    target_N3 = reference.target(double.acceleration(), batch.gravity_S3[batch.scene_N])
    predicted_N3 = reference_output(reference, batch.state())
    loss = batch.mean_over_scenes((predicted_N3 - target_N3).square().mean(-1))
    loss.backward()
    return loss.detach(), _gradients(reference)


def reference_output(reference: ParticleNetwork, state: ParticleState) -> torch.Tensor:
    """Returns the float64 network's output. GNS gets the checked network's neighbours: rounding could change them."""
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
    """Returns `pass`, or the error and its bound."""
    return PASS if error <= bound else f"relative error of {what} {error:.1e} exceeds {bound:.0e}"  # NaN fails


def _gradients(network: torch.nn.Module) -> torch.Tensor:
    """Concatenates the gradients of all parameters."""
    gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in network.parameters()]
    return torch.cat([gradient.flatten() for gradient in gradients])
