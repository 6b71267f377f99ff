"""Training updates in PyTorch, the reference: one batch, its loss, one step of the optimiser."""

import sys
from collections.abc import Callable

import torch

from hgn.config import TrainingConfig
from hgn.cpu.allocator import keep_freed_memory
from hgn.data.batch import Batch, BatchSample, WindowChunk, join
from hgn.network.base import ParticleNetwork
from hgn.scene.episode import Episode
from hgn.training.cell_means import with_means
from hgn.training.gradients import GradientGuard
from hgn.training.noise import jittered_origin, perturbed_window
from hgn.training.pushforward import PushforwardPool
from hgn.training.schedule import average_weight, learning_rate
from hgn.training.symmetry import drawn_symmetries, under_symmetries
from hgn.training.torch_pushforward import TorchScenes
from hgn.training.updates import TrainedNetwork


class TorchUpdates:
    """Trains on chunks of samples with PyTorch. hgn.training.updates.Updates describes the methods."""

    def __init__(
        self,
        trained: TrainedNetwork,
        training: TrainingConfig,
        rank: int = 0,
        backward: Callable[[torch.Tensor], None] = torch.Tensor.backward,
        *,
        precision: str = "fp32",
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Takes PyTorch's `precision`, and `backward`, which computes a loss's gradients averaged over the ranks.

        Simulations for pushforward end with SimulationStoppedError if `stopped` returns True.
        """
        self.trained, self.training, self._backward = trained, training, backward
        self.precision, self._rank = precision, rank
        self._device = next(trained.network.parameters()).device
        if self._device.type == "cpu":
            keep_freed_memory()
        self._guard = GradientGuard(trained.counters)
        self.pool: PushforwardPool[Episode, BatchSample] | None = None
        if training.pushforward_fraction > 0:
            self.pool = PushforwardPool(TorchScenes(trained.result, stopped), training, rank)

    def run(self, chunk: WindowChunk, first_update: int) -> None:
        if self.pool is not None and chunk.starts:
            if self._device.type == "cpu" and self._rank == 0:
                text = f"simulating {len(chunk.starts)} scenes before update {first_update + 1}"
                print(f"{text} (training.pushforward_scenes)", file=sys.stderr, flush=True)
            self.pool.refresh(chunk.starts)
        for update, samples in enumerate(chunk.samples, first_update):
            batch = chunk.batch
            if self.pool is not None or batch is None:
                own = samples if self.pool is None else self.pool.replaced(samples, update)
                batch = join(own, self.trained.network.config)
            self._update(batch.to(self._device), update)

    def _update(self, batch: Batch, update: int) -> None:
        loss = batch_loss(self.trained.network, batch, self.training)
        value = loss.detach()
        self.trained.loss_sum.add_(torch.where(value.isfinite(), torch.stack([value, torch.ones_like(value)]), 0))
        self.trained.optimizer.zero_grad()
        self._backward(loss)
        self.step(update)

    def step(self, update: int) -> None:
        """Moves the parameters along their gradients, then their average. Skips gradients that are not finite."""
        network, averaged, optimizer = self.trained.network, self.trained.averaged, self.trained.optimizer
        optimizer.param_groups[0]["lr"] = learning_rate(self.training, update)
        self._guard.check(network.parameters(), optimizer)
        optimizer.step()
        if averaged is not None:
            means = [parameter.detach() for parameter in averaged.parameters()]
            values = [parameter.detach() for parameter in network.parameters()]
            torch._foreach_lerp_(means, values, average_weight(self.training, update))


def batch_loss(network: ParticleNetwork, batch: Batch, training: TrainingConfig, jitter: bool = True) -> torch.Tensor:
    """Returns the squared error of the normalised acceleration, averaged over axes, then particles, then scenes.

    This function draws noise, jitter and symmetry for backend torch. hgn.kernels.update draws them for triton.
    """
    if training.symmetry != "none":
        batch = under_symmetries(batch, drawn_symmetries(batch))
    cell_size, axes = network.config.cell_size, network.config.dimensions
    correlated = training.noise_correlated_fraction
    window_WN3 = perturbed_window(batch, training.noise_std, correlated, cell_size=cell_size, dimensions=axes)
    origin_S3 = jittered_origin(batch, cell_size, axes) if jitter else None
    target_N3 = network.target(batch.acceleration(window_WN3), batch.gravity_S3[batch.scene_N])
    prediction = network.prediction(batch.state(window_WN3), origin_S3)
    error_N3 = prediction.acceleration_N3 - target_N3
    weighted_N3 = error_N3
    if training.cell_mean_weight > 0:
        assert prediction.grid is not None
        weighted_N3 = with_means(error_N3, prediction.grid, training.cell_mean_weight)
    return batch.mean_over_scenes((error_N3 * weighted_N3).mean(-1))
