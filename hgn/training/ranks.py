"""What the processes of a distributed training must have in common."""

from __future__ import annotations

import inspect
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.strategies import DDPStrategy
from torch.nn.parallel import DistributedDataParallel

from hgn.schema import ConfigError, to_mapping
from hgn.training.feed import Feed


def gradient_averaging() -> DDPStrategy:
    """Gradients are averaged over all ranks in buckets, while the backward pass still runs; nothing else travels.

    Buffers are not sent at each update: the normaliser is constant, and the sum of losses is each rank's own.
    """
    # torch 2.13 has another name for it
    renamed = "forward_sync_buffers" in inspect.signature(DistributedDataParallel).parameters
    keep_buffers: dict[str, Any] = {"forward_sync_buffers" if renamed else "broadcast_buffers": False}
    return DDPStrategy(gradient_as_bucket_view=True, **keep_buffers)


class SameStart(Callback):
    """All ranks begin at one place: the same update, the same samples next, the same normaliser."""

    def __init__(self, feed: Feed) -> None:
        self.feed = feed

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Raises: ConfigError on every rank when one of them resumes from another checkpoint."""
        if trainer.world_size == 1:
            return
        mine: dict[str, Any] = {"update": trainer.global_step} | to_mapping(self.feed.cursor)
        first = trainer.strategy.broadcast(mine)
        if not trainer.strategy.reduce_boolean_decision(mine == first, all=True):
            raise ConfigError(
                f"run must be a folder that all machines share, got another checkpoint on some of them (rank "
                f"{trainer.global_rank}: {mine}, rank 0: {first}); give them one run=FOLDER"
            )
        # A data set that grows may have shown other statistics to a rank that looked later.
        for buffer in pl_module.buffers():
            torch.distributed.broadcast(buffer, 0)
