"""Backend triton on the bench: frames and training updates in CUDA graphs, checked like PyTorch's.

Shape legend: N particles of all scenes, S scenes.
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import torch

from hgn.config import NetworkConfig, TrainingConfig
from hgn.data.batch import Batch
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.parity import relative_error
from hgn.runtime.triton_host import kernel_precision
from tools.bench.contenders import (
    BOUNDS,
    GRADIENT_BOUNDS,
    PASS,
    bench_network,
    reference_acceleration,
    reference_gradients,
    verdict,
)
from tools.bench.states import Workload, batch_of, state_of
from tools.bench.timing import Timed, once

if TYPE_CHECKING:
    from hgn.kernels.update.op import DeviceEpisode

FRAMES_AT_ONCE = 16  # at most, so that a frame's launch hides behind the one before, as in a simulation
UPDATES_AT_ONCE = 20
OBSTACLE_CELL_SIZE = 1 / 64
FIRST_MOMENT_FRACTION = 0.1  # of Adam, of the gradient, after the first update


class TritonFrame:
    """One frame of a simulation; what is timed puts the same state back before each."""

    def __init__(self, precision: str, config: NetworkConfig, work: Workload, device: torch.device) -> None:
        from hgn.runtime.triton_rollout import TritonRollout  # loads Triton

        self.device = device
        network = bench_network(config, device)
        assert isinstance(network, HierarchicalGraphNetwork)
        self.network, self.state = network, state_of(work, config, device)
        self.velocity_NV = self.state.velocity_NM3.flatten(1)  # a view
        self.rollout = TritonRollout(network, self.state, precision)
        self.failure: str | None = None

    @property
    def frames_at_once(self) -> int:
        """As many as the rollout has room to keep the positions of."""
        return min(FRAMES_AT_ONCE, len(self.rollout.path_TN3))

    def restore(self) -> None:
        self.rollout.position_N3.copy_(self.state.position_N3)
        self.rollout.velocity_NV.copy_(self.velocity_NV)

    def run(self) -> None:
        """`frames_at_once` frames of the same state, each in a graph where there is a GPU."""
        self.rollout.frame.zero_()
        for _ in range(self.frames_at_once):
            self.restore()
            if self.rollout.graph is None:
                self.rollout.frame_launches()
            else:
                self.rollout.graph.replay()

    def timed(self) -> Timed:
        return Timed(self._sample)

    def _sample(self) -> list[float]:
        milliseconds = once(self.run, self.device) / self.frames_at_once
        if int(self.rollout.frame) != self.frames_at_once:
            self.failure = "frames were left out for lack of room"
        return [milliseconds]

    def check(self, precision: str) -> str:
        """`pass`, or by how much the accelerations differ from float64."""
        self.restore()
        self.rollout.run(1)  # makes room where it needs more
        found_N3 = self.rollout.velocity_NV[:, :3].double() - self.state.velocity_NM3[:, 0].double()
        with torch.no_grad():
            expected_N3 = reference_acceleration(self.network, self.state)
        return verdict("acceleration", relative_error(found_N3, expected_N3), BOUNDS[precision])


def device_samples(batch: Batch) -> list[tuple[DeviceEpisode, int, int]]:
    """The scenes of a batch as Triton's updates take them: episodes of one window, frame 0 and the seed."""
    from hgn.kernels.update.op import DeviceEpisode  # loads Triton

    windows = batch.window_WN3.split(batch.particles_S, dim=1)
    materials = batch.material_N.int().split(batch.particles_S)
    rows = zip(windows, materials, batch.domain_S3.tolist(), batch.gravity_S3.tolist(), batch.seeds_S, strict=True)
    return [(DeviceEpisode(w.contiguous(), m.clone(), None, tuple(d), tuple(g)), 0, s) for w, m, d, g, s in rows]


class TritonTrain:
    """One training update: batch, noise, jitter, grid or neighbours, forward, backward, Adam."""

    def __init__(self, precision: str, config: NetworkConfig, work: Workload, device: torch.device) -> None:
        self.device, self.precision = device, precision
        self.batch = batch_of(work, config, device)
        self.network = bench_network(config, device)
        self.samples = device_samples(self.batch)
        training = TrainingConfig()
        self.updates = self._updates(training.noise_std, training.grid_jitter)
        self.rates = [training.learning_rate] * UPDATES_AT_ONCE

    def _updates(self, noise_std: float, grid_jitter: bool):  # type: ignore[no-untyped-def]
        from hgn.kernels.update.op import UpdateSettings
        from hgn.runtime.triton_backend import updates_of

        return updates_of(self.network)(
            copy.deepcopy(self.network),
            UpdateSettings(len(self.samples), noise_std, grid_jitter, OBSTACLE_CELL_SIZE),
            kernel_precision(self.precision, self.device),
            torch.zeros(2, device=self.device),
            torch.zeros(5, device=self.device),
        )

    def run(self) -> None:
        self.updates.run([self.samples] * UPDATES_AT_ONCE, self.rates)

    def timed(self) -> Timed:
        return Timed(lambda: [once(self.run, self.device) / UPDATES_AT_ONCE])

    def check(self, precision: str) -> str:
        """`pass`, or by how much loss or gradients differ from float64, without noise and jitter."""
        plain = self._updates(0.0, False)
        plain.run([self.samples], [0.0])
        expected_loss, expected = reference_gradients(self.network, self.batch)
        first = verdict("loss", relative_error(plain.loss_sum[0].double(), expected_loss), BOUNDS[precision])
        if first != PASS:
            return first
        gradients = [torch.zeros_like(parameter) for parameter in self.network.parameters()]
        plain.packed.scatter(plain.first_moment / FIRST_MOMENT_FRACTION, gradients)
        gradient = torch.cat([tensor.flatten() for tensor in gradients]).double()
        return verdict("gradient", relative_error(gradient, expected), GRADIENT_BOUNDS[precision])
