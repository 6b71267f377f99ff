"""The Lightning module: loss, optimiser, learning-rate decay, and what a checkpoint holds.

Shape legend: N particles of all scenes of a batch.
"""

from __future__ import annotations

import copy
import math
import sys
from typing import Any

import torch
from lightning.pytorch import LightningModule

from hgn.config import TrainingConfig
from hgn.cpu.allocator import keep_freed_memory
from hgn.data.batch import Batch, UpdateSamples
from hgn.data.episode_tensors import UpdateChunk
from hgn.data.sampler import SamplerState
from hgn.data.statistics import Statistics
from hgn.network.base import ParticleNetwork
from hgn.runtime.backend import build, fastest_stepped
from hgn.runtime.torch_backend import Backend
from hgn.schema import to_mapping
from hgn.training import lightning_compat
from hgn.training.checkpoint import (
    AVERAGED,
    NETWORK,
    SECTION,
    DataInfo,
    sampler_state_of_checkpoint,
    updates_of_checkpoint,
)
from hgn.training.distributed import sum_over_ranks
from hgn.training.muon import Muon
from hgn.training.noise import jittered_origin, perturbed_window
from hgn.training.pushforward import PushforwardPool
from hgn.training.symmetry import drawn_symmetries, under_symmetries


class TrainingModule(LightningModule):
    """Trains a network on one-step accelerations (paper sec. 3.3)."""

    def __init__(
        self, network: ParticleNetwork, training: TrainingConfig, data: DataInfo, backend: str = "torch"
    ) -> None:
        """`backend` is torch or triton, see hgn.runtime.backend: a training step is one update, or a chunk of them."""
        super().__init__()
        self.automatic_optimization = backend == "torch"
        self.network = network
        self.averaged = copy.deepcopy(network).requires_grad_(False) if training.ema_decay else None
        self.training_config = training
        self.data = data
        self.sampler_state = SamplerState()
        # Sum of finite losses and their number since the last log line, kept on the device: no synchronisation.
        self.loss_sum: torch.Tensor
        self.register_buffer("loss_sum", torch.zeros(2), persistent=False)
        # what GradientGuard counts, see there
        self.gradient_counters: torch.Tensor
        self.register_buffer("gradient_counters", torch.zeros(5), persistent=False)
        self._graph_trainer: Any = None
        self._pool: PushforwardPool | None = None

    def set_statistics(self, statistics: Statistics) -> None:
        """Freezes the normaliser; noise enters in quadrature. Done once, when a run begins."""
        noise, axes = self.training_config.noise_std, self.network.config.dimensions
        normaliser = self.network.normaliser
        if self.network.config.relative:
            normaliser.set_isotropic(torch.tensor(statistics.acceleration.std), noise, axes)
        else:
            for quantity in ("velocity", "acceleration"):
                moments = getattr(statistics, quantity)
                normaliser.set(quantity, torch.tensor(moments.mean), torch.tensor(moments.std), noise, axes)
        self._begin_average()

    def load_weights(self, network: ParticleNetwork) -> None:
        """Takes over weights and normaliser; instead of `set_statistics`, when a run begins."""
        self.network.load_state_dict(network.state_dict())
        self._begin_average()

    @property
    def result(self) -> ParticleNetwork:
        """What is measured and exported: the moving average of the weights where there is one."""
        return self.network if self.averaged is None else self.averaged

    def _begin_average(self) -> None:
        if self.averaged is not None:
            self.averaged.load_state_dict(self.network.state_dict())

    def _average_weight(self, update: int) -> float:
        """Weight of the new values in the moving average, after update number `update`, from 0.

        First weights are forgotten soon: while there are few updates, the average is over the last tenth of them.
        """
        return 1.0 - min(self.training_config.ema_decay, (1 + update) / (10 + update))

    def optimizer_step(self, *arguments: Any, **named: Any) -> None:
        update = self.global_step
        super().optimizer_step(*arguments, **named)
        if self.averaged is not None:
            averaged = [parameter.detach() for parameter in self.averaged.parameters()]
            weights = [parameter.detach() for parameter in self.network.parameters()]
            torch._foreach_lerp_(averaged, weights, self._average_weight(update))

    def loss(self, batch: Batch, jitter: bool = True) -> torch.Tensor:
        """Mean squared error of the normalised acceleration: over axes, over particles, over scenes.

        Noise, jitter and symmetry are drawn here for the torch backend; hgn.kernels.update does so for triton.
        """
        config = self.training_config
        if config.symmetry != "none":
            batch = under_symmetries(batch, drawn_symmetries(batch))
        cell_size, axes = self.network.config.cell_size, self.network.config.dimensions
        window_WN3 = perturbed_window(batch, config.noise_std, config.noise_correlated_fraction, cell_size, axes)
        origin_S3 = jittered_origin(batch, cell_size, axes) if jitter else None
        target_N3 = self.network.target(batch.acceleration(window_WN3), batch.gravity_S3[batch.scene_N])
        predicted_N3 = self.network.normalised_acceleration(batch.state(window_WN3), origin_S3)
        return batch.mean_over_scenes((predicted_N3 - target_N3).square().mean(-1))

    @property
    def pushforward_figures(self) -> dict[str, float]:
        """What is to be logged of the pushforward pool."""
        pool = self._pool if self._graph_trainer is None else self._graph_trainer.pool
        return {} if pool is None else dict(pool.figures)

    def on_fit_start(self) -> None:
        if self.device.type == "cpu":
            keep_freed_memory()

    def simulating_backend(self) -> Backend:
        """What simulates with the weights that count: the kernels that train, or else what makes frames one by one."""
        precision = self.training_config.precision
        if self.automatic_optimization:
            return fastest_stepped(self.result, precision)
        return build("triton", self.result, precision)

    def on_train_start(self) -> None:
        config = self.training_config
        # a checkpoint brings the rates that it was trained with, and the configuration's count
        lightning_compat.advance_scheduler(self._scheduler, config.learning_rate, self.global_step)
        if self.automatic_optimization and config.pushforward_fraction > 0:
            self._pool = PushforwardPool(self.result, config, self.trainer.global_rank)
        if not self.automatic_optimization:
            # Triton, which backend torch does without, is loaded here.
            from hgn.training.graph_trainer import GraphTrainer

            optimizer = self.optimizers(use_pl_optimizer=False)
            assert isinstance(optimizer, torch.optim.Adam)
            self._graph_trainer = GraphTrainer(
                self.network,
                optimizer,
                self.training_config,
                self.data.obstacle_cell_size,
                self.loss_sum,
                self.gradient_counters,
                sum_over_ranks if self.trainer.world_size > 1 else None,
                self.trainer.world_size,
                self.averaged,
                self.trainer.global_rank,
            )

    def training_step(self, batch: Batch | UpdateSamples | UpdateChunk, batch_index: int) -> torch.Tensor | None:
        if isinstance(batch, UpdateChunk):
            self._train_chunk(batch)
            return None
        if isinstance(batch, UpdateSamples):
            assert self._pool is not None
            if batch.starts:
                self._pool.refresh(batch.starts)
            batch = self._batch_of(self._pool.replaced(batch, self.global_step))
        loss = self.loss(batch)
        value = loss.detach()
        self.loss_sum += torch.where(value.isfinite(), torch.stack([value, torch.ones_like(value)]), 0)
        assert batch.sampler_state is not None
        self.sampler_state = batch.sampler_state
        return loss

    def _batch_of(self, samples: UpdateSamples) -> Batch:
        return samples.batch(self.network.config).to(self.device)

    def _train_chunk(self, chunk: UpdateChunk) -> None:
        first, count = self.global_step, len(chunk.samples)
        first_chunk = self._graph_trainer.parity is None
        updates = range(first, first + count)
        average_weights = None
        if self.averaged is not None:
            average_weights = [self._average_weight(update) for update in updates]
        self._graph_trainer.run(chunk, [self._rate(update) for update in updates], average_weights, first)
        if first_chunk and self.trainer.is_global_zero:
            outputs, gradients = self._graph_trainer.parity
            text = f"outputs within {outputs:.0e}, gradients within {gradients:.0e} of PyTorch's"
            print(f"backend triton: {text if math.isfinite(outputs) else 'batch too large to check'}", file=sys.stderr)
        report = self._graph_trainer.report()
        if report and self.trainer.is_global_zero:
            print(report, file=sys.stderr)
        self.sampler_state = chunk.sampler_state
        lightning_compat.count_updates(self.trainer, count)
        lightning_compat.advance_scheduler(self._scheduler, self.training_config.learning_rate, first + count)

    @property
    def _scheduler(self) -> torch.optim.lr_scheduler.LambdaLR:
        scheduler = self.lr_schedulers()
        assert isinstance(scheduler, torch.optim.lr_scheduler.LambdaLR)
        return scheduler

    def _rate(self, update: int) -> float:
        """The learning rate of update number `update`, from 0."""
        return self.training_config.learning_rate * self._rate_factor(update)

    def _rate_factor(self, update: int) -> float:
        config = self.training_config
        decay = (config.final_learning_rate / config.learning_rate) ** (1 / config.maximum_updates)
        warmth = min(1.0, (update + 1) / config.warmup_updates) if config.warmup_updates else 1.0
        return decay**update * warmth

    def configure_optimizers(self) -> Any:
        config = self.training_config
        if config.optimizer == "muon":
            optimizer: torch.optim.Adam = Muon(self.network, config.learning_rate)
        else:
            # One launch instead of several for each group of tensors; only the fused kind can skip a step by itself.
            optimizer = torch.optim.Adam(self.network.parameters(), lr=config.learning_rate, fused=True)
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, self._rate_factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint[SECTION] = {
            "network": to_mapping(self.network.config),
            "noise_std": self.training_config.noise_std,
            "data": to_mapping(self.data),
            "sampler_state": to_mapping(self.sampler_state),
            "updates": self.global_step,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.sampler_state = sampler_state_of_checkpoint(checkpoint)
        state = checkpoint["state_dict"]
        if self.averaged is None:
            for name in [name for name in state if name.startswith(AVERAGED)]:
                del state[name]
        elif not any(name.startswith(AVERAGED) for name in state):  # the average begins here
            begun = {AVERAGED + k.removeprefix(NETWORK): v.clone() for k, v in state.items() if k.startswith(NETWORK)}
            state.update(begun)
        lightning_compat.set_stored_updates(checkpoint, updates_of_checkpoint(checkpoint))
