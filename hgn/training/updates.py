"""The interface for training on chunks of samples, and the state that training changes. Both backends implement it.

| backend | class | updates of a chunk |
|---|---|---|
| torch | hgn.training.torch_updates.TorchUpdates | 1 |
| triton | hgn.training.triton_updates.TritonUpdates | up to 64, in CUDA graphs |
"""

from dataclasses import dataclass
from typing import Any, Protocol

import torch

from hgn.config import TrainingConfig
from hgn.network.base import ParticleNetwork
from hgn.training.muon import Muon
from hgn.training.pushforward import PushforwardPool


@dataclass(frozen=True, eq=False)
class TrainedNetwork:
    """A network and the other state that its updates change."""

    network: ParticleNetwork
    optimizer: torch.optim.Adam
    loss_sum: torch.Tensor  # [2]: sum and number of the finite losses since the last log line
    counters: torch.Tensor  # [5]: see hgn.training.gradients
    averaged: ParticleNetwork | None = None  # the moving average of the parameters

    @property
    def result(self) -> ParticleNetwork:
        """Returns the measured, simulated and exported network: the moving average if there is one."""
        return self.network if self.averaged is None else self.averaged


class Updates(Protocol):
    """Trains on chunks of samples."""

    precision: str  # precision of matrix products: fp32, tf32 or fp16
    pool: PushforwardPool[Any, Any] | None  # None without pushforward

    def run(self, chunk: Any, first_update: int) -> None:
        """Makes an update for each entry of `chunk.samples`. `first_update` is the number of the first one, from 0.

        Losses and gradient norms are added to the TrainedNetwork's tensors, so the host does not wait for the device.
        Raises: ConfigError if the backend's results are wrong on this machine.
        """


def build_optimizer(network: ParticleNetwork, training: TrainingConfig) -> torch.optim.Adam:
    """Returns the optimiser of a training."""
    if training.optimizer == "muon":
        return Muon(network, training.learning_rate)
    # One launch. Only fused Adam skips a step with gradients that are not finite without the host.
    return torch.optim.Adam(network.parameters(), lr=training.learning_rate, fused=True)
