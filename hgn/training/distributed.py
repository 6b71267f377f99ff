"""What the processes of a distributed training must have in common."""

from __future__ import annotations

import inspect
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.strategies import DDPStrategy
from torch.nn.parallel import DistributedDataParallel

from hgn.schema import ConfigError, to_mapping
from hgn.training.data_module import EpisodeDataModule

MESSAGE_MB = 4  # gradients of the network's last layers are on their way while those of its first are computed


def averaging_options() -> dict[str, Any]:
    """How gradients are averaged: arguments of DistributedDataParallel.

    In buckets, while the backward pass still runs; nothing else travels. Buffers are not sent at each update: the
    normaliser is constant, and the sum of losses is each rank's own.
    """
    # torch 2.13 has another name for it
    renamed = "forward_sync_buffers" in inspect.signature(DistributedDataParallel).parameters
    keep_buffers = "forward_sync_buffers" if renamed else "broadcast_buffers"
    return {"gradient_as_bucket_view": True, "bucket_cap_mb": MESSAGE_MB, keep_buffers: False}


def gradient_averaging(path: str) -> DDPStrategy:
    """The strategy of a training on several ranks; `path` is plain or fast."""
    return DDPStrategy(**averaging_options()) if path == "plain" else _Unwrapped()


def sum_over_ranks(tensor: torch.Tensor) -> None:
    """Sums a tensor over all ranks, in place. The fast path does so with the gradients of an update, in one message."""
    torch.distributed.all_reduce(tensor)


class _Unwrapped(DDPStrategy):
    """For updates that average their gradients themselves: no DistributedDataParallel, which would wait for them."""

    def configure_ddp(self) -> None:
        pass


class SameStart(Callback):
    """All ranks begin at one place: the same update, the same samples next, the same weights and normaliser.

    From then on nothing but gradients travels at an update, but for those where ranks log, save, measure or agree.
    """

    def __init__(self, feed: EpisodeDataModule) -> None:
        self.feed = feed

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Raises: ConfigError on every rank when one of them resumes from another checkpoint."""
        if trainer.world_size == 1:
            return
        # Before each update Lightning asks rank 0 for a SIGTERM, and has the host wait for the device until it answers
        # (its issue 21487). Ours goes another way: the ranks agree now and then, see Stopper.
        trainer.fit_loop.epoch_loop._broadcast_sigterm_tensor = _nothing  # type: ignore[method-assign]
        mine: dict[str, Any] = {"update": trainer.global_step} | to_mapping(self.feed.cursor)
        first = trainer.strategy.broadcast(mine)
        if not trainer.strategy.reduce_boolean_decision(mine == first, all=True):
            raise ConfigError(
                f"run must be a folder that all machines share, got another checkpoint on some of them (rank "
                f"{trainer.global_rank}: {mine}, rank 0: {first}); give them one run=FOLDER"
            )
        # A data set that grows may have shown other statistics to a rank that looked later.
        for tensor in (*pl_module.parameters(), *pl_module.buffers()):
            torch.distributed.broadcast(tensor.detach(), 0)


def _nothing() -> None:
    pass
