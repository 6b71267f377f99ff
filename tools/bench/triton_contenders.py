"""Contenders of backend triton: frames and training updates in CUDA graphs.

Shape legend: N particles of all scenes, S scenes.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch

from hgn.config import NetworkConfig, TrainingConfig
from hgn.data.batch import Batch
from hgn.network.base import ParticleNetwork
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.triton_host import kernel_precision
from tools.bench.contenders import OBSTACLE_CELL_SIZE, Contender, bench_network, check_acceleration, check_update
from tools.bench.states import Workload, batch_of, state_of

if TYPE_CHECKING:
    from hgn.kernels.update.op import DeviceEpisode, Updates

FRAMES_AT_ONCE = 16  # at most; a frame is launched while the frame before runs, as in a simulation
UPDATES_AT_ONCE = 20
FIRST_MOMENT_FRACTION = 0.1  # Adam's first moment after the first update, as a fraction of the gradient


class TritonFrame(Contender):
    """One frame of a simulation; the state is restored before each frame."""

    def __init__(self, config: NetworkConfig, work: Workload, device: torch.device, precision: str) -> None:
        from hgn.runtime.triton_stepper import TritonStepper  # loads Triton

        self.device = device
        network = bench_network(config, device)
        assert isinstance(network, HierarchicalGraphNetwork)
        self.network, self.state = network, state_of(work, config, device)
        self.velocity_NV = self.state.velocity_NM3.flatten(1)  # a view
        self.stepper = TritonStepper(network, self.state, precision)
        # the rollout stores positions of a limited number of frames
        self.at_once = min(FRAMES_AT_ONCE, len(self.stepper.path_TN3))

    def restore(self) -> None:
        self.stepper.buffers.position_N3.copy_(self.state.position_N3)
        self.stepper.buffers.velocity_NV.copy_(self.velocity_NV)

    def run(self) -> None:
        """Computes frames of the same state, on a GPU with CUDA graphs."""
        self.stepper.frame.zero_()
        for _ in range(self.at_once):
            self.restore()
            if self.stepper.graph is None:
                self.stepper.frame_launches()
            else:
                self.stepper.graph.replay()

    def sample(self) -> float:
        milliseconds = super().sample()
        if int(self.stepper.frame) != self.at_once:
            self.failure = "frames were skipped for lack of memory"
        return milliseconds

    def check(self, precision: str) -> str:
        self.stepper.begin(self.state)  # at its frame, whose grid origin PyTorch has too
        for _ in self.stepper.blocks(1):  # allocates memory if necessary
            pass
        return check_acceleration(self.stepper.buffers.velocity_NV[:, :3], self.network, self.state, precision)


def device_samples(batch: Batch) -> list[tuple[DeviceEpisode, int, int]]:
    """Converts the scenes of a batch for Triton's updates: episodes of one window, frame 0 and the seed."""
    from hgn.kernels.update.op import DeviceEpisode  # loads Triton

    windows = batch.window_WN3.split(batch.particles_S, dim=1)
    materials = batch.material_N.int().split(batch.particles_S)
    rows = zip(windows, materials, batch.domain_S3.tolist(), batch.gravity_S3.tolist(), batch.seeds_S, strict=True)
    return [(DeviceEpisode(w.contiguous(), m.clone(), None, tuple(d), tuple(g)), 0, s) for w, m, d, g, s in rows]


def triton_updates(
    network: ParticleNetwork, training: TrainingConfig, precision: str, device: torch.device, **more: Any
) -> Updates:
    """Returns updates with their own network. `more` are further arguments of Updates."""
    from hgn.kernels.update.op import Updates  # loads Triton

    assert isinstance(network, HierarchicalGraphNetwork)
    sums = torch.zeros(2, device=device), torch.zeros(5, device=device)
    precision = kernel_precision(precision, device)
    return Updates(copy.deepcopy(network), training, OBSTACLE_CELL_SIZE, precision, *sums, **more)


class TritonTrain(Contender):
    """One training update: batch, noise, jitter, grid or neighbours, forward, backward, Adam."""

    at_once = UPDATES_AT_ONCE

    def __init__(self, config: NetworkConfig, work: Workload, device: torch.device, precision: str) -> None:
        self.device = device
        self.batch = batch_of(work, config, device)
        self.network = bench_network(config, device)
        self.samples = device_samples(self.batch)
        self.training = TrainingConfig(batch_scenes=work.scenes, noise_correlated_fraction=0.0)
        self.updates = triton_updates(self.network, self.training, precision, device)

    def run(self) -> None:
        self.updates.run([self.samples] * UPDATES_AT_ONCE, [TrainingConfig.learning_rate] * UPDATES_AT_ONCE)

    def check(self, precision: str) -> str:
        plain = triton_updates(self.network, replace(self.training, noise_std=0.0), precision, self.device)
        plain.jitter = False
        plain.run([self.samples], [0.0])
        gradients = [torch.zeros_like(parameter) for parameter in self.network.parameters()]
        plain.packed.scatter(plain.first_moment / FIRST_MOMENT_FRACTION, gradients)
        gradient = torch.cat([tensor.flatten() for tensor in gradients])
        return check_update(plain.loss_sum[0], gradient, self.network, self.batch, precision)
