"""The Lightning module: a network in training, its updates, and the content of a checkpoint."""

import copy
from collections.abc import Callable
from typing import Any

import torch

from hgn.config import TrainingConfig
from hgn.data.batch import WindowChunk
from hgn.data.episode_tensors import EpisodeChunk
from hgn.data.sampler import SamplerState
from hgn.data.statistics import Statistics
from hgn.network.base import ParticleNetwork
from hgn.runtime.backend import build, fastest_stepped
from hgn.runtime.torch_backend import Backend
from hgn.schema import to_mapping
from hgn.training.checkpoint import AVERAGED, NETWORK, SECTION, DataInfo, Progress
from hgn.training.lightning_compat import LightningModule
from hgn.training.pushforward import SimulationStoppedError
from hgn.training.schedule import learning_rate
from hgn.training.torch_updates import TorchUpdates
from hgn.training.updates import TrainedNetwork, Updates, build_optimizer


class TrainingModule(LightningModule):
    """Trains a network on one-step accelerations (paper sec. 3.3). A training step is a chunk of updates.

    Optimisation is manual. Lightning's own counters do not change; `update` counts the updates.
    """

    trained: TrainedNetwork  # set by on_train_start, as `updates`
    updates: Updates

    def __init__(
        self,
        network: ParticleNetwork,
        training: TrainingConfig,
        data: DataInfo,
        backend: str = "torch",
        precisions: tuple[str, ...] = ("fp32",),
    ) -> None:
        """`backend` is torch or triton. `precisions` lists those that the updates may use, the preferred one first."""
        super().__init__()
        self.automatic_optimization = False
        self.network = network
        self.averaged = copy.deepcopy(network).requires_grad_(False) if training.ema_decay else None
        self.training_config, self.data, self.backend = training, data, backend
        self._precisions = precisions
        self.update = 0  # number of updates
        # whether to end simulations between updates on backend torch; only without other ranks, which would not end
        self.stopped: Callable[[], bool] = lambda: False
        self.skipped = 0  # number of skipped updates at the last log line
        self.sampler_state = SamplerState()
        # see TrainedNetwork; they stay on the device, which avoids synchronisation
        self.loss_sum: torch.Tensor
        self.register_buffer("loss_sum", torch.zeros(2), persistent=False)
        self.gradient_counters: torch.Tensor
        self.register_buffer("gradient_counters", torch.zeros(5), persistent=False)

    def set_statistics(self, statistics: Statistics) -> None:
        """Sets the normaliser when a run begins; it stays constant. Noise is added in quadrature."""
        noise, axes = self.training_config.noise_std, self.network.config.dimensions
        normaliser = self.network.normaliser
        if self.network.config.relative:
            normaliser.set_isotropic(torch.tensor(statistics.acceleration.std), noise, axes)
        else:
            for quantity in ("velocity", "acceleration"):
                moments = getattr(statistics, quantity)
                mean, std = torch.tensor(moments.mean), torch.tensor(moments.std)
                normaliser.set(quantity, mean, std, noise, dimensions=axes)
        self._begin_average()

    def load_weights(self, network: ParticleNetwork) -> None:
        """Copies the parameters and normaliser of `network` when a run begins, instead of `set_statistics`."""
        self.network.load_state_dict(network.state_dict())
        self._begin_average()

    def _begin_average(self) -> None:
        if self.averaged is not None:
            self.averaged.load_state_dict(self.network.state_dict())

    @property
    def rate(self) -> float:
        """Returns the learning rate of the next update."""
        return learning_rate(self.training_config, self.update)

    def simulating_backend(self) -> Backend:
        """Returns the backend that simulates the trained network: triton if it trains, else the fastest stepped one."""
        result, precision = self.trained.result, self.updates.precision
        return build("triton", result, precision) if self.backend == "triton" else fastest_stepped(result, precision)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return build_optimizer(self.network, self.training_config)

    def on_train_start(self) -> None:
        config, rank = self.training_config, self.trainer.global_rank
        optimizer = self.optimizers(use_pl_optimizer=False)
        assert isinstance(optimizer, torch.optim.Adam)
        trained = self.trained = TrainedNetwork(
            self.network, optimizer, self.loss_sum, counters=self.gradient_counters, averaged=self.averaged
        )
        if self.backend == "torch":
            self.updates = TorchUpdates(
                trained, config, rank, self.manual_backward, precision=self._precisions[0], stopped=self.stopped
            )
        else:
            # imported here, because backend torch does without Triton
            from hgn.training.triton_updates import TritonUpdates

            size, ranks = self.data.obstacle_cell_size, self.trainer.world_size
            self.updates = TritonUpdates(trained, config, size, rank, world_size=ranks, precisions=self._precisions)

    def training_step(self, chunk: WindowChunk | EpisodeChunk) -> None:
        try:
            self.updates.run(chunk, self.update)
        except SimulationStoppedError:  # before the chunk's first update
            return
        self.update += len(chunk.samples)
        self.sampler_state = chunk.sampler_state

    def release(self) -> None:
        """Drops the updates with their CUDA graphs. Lightning destroys its process groups when the process ends, and
        NCCL waits for ever to destroy a group that a graph still uses."""
        self.__dict__.pop("updates", None)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint[SECTION] = {
            "network": to_mapping(self.network.config),
            "step": to_mapping(self.network.step),
            "noise_std": self.training_config.noise_std,
            "precision": self.updates.precision,
            "data": to_mapping(self.data),
            "sampler_state": to_mapping(self.sampler_state),
            "updates": self.update,
            "skipped": self.skipped + int(self.gradient_counters[2]),
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        progress = Progress.of(checkpoint)
        self.update, self.skipped, self.sampler_state = progress.updates, progress.skipped, progress.sampler_state
        checkpoint.pop("loops", None)  # Lightning's own counters
        if not isinstance(checkpoint["callbacks"], dict):  # Lightning would resume without the lowest error
            raise TypeError("callbacks must be a mapping")
        optimizer = checkpoint["optimizer_states"][0]
        (group,), (own,) = optimizer["param_groups"], self.configure_optimizers().state_dict()["param_groups"]
        optimizer["param_groups"] = [own | {"lr": group["lr"]}]  # other settings are this version's
        if self.update > 0 and not optimizer["state"]:
            raise LookupError("no moments of the optimiser")
        state = checkpoint["state_dict"]
        if self.averaged is None:
            for name in [name for name in state if name.startswith(AVERAGED)]:
                del state[name]
        elif not any(name.startswith(AVERAGED) for name in state):  # the average starts from these parameters
            average = {AVERAGED + k.removeprefix(NETWORK): v.clone() for k, v in state.items() if k.startswith(NETWORK)}
            state.update(average)
