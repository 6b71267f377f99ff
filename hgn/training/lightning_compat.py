"""All of Lightning's private and fragile parts that this project touches; pyproject.toml bounds its version.

`tests/training/test_lightning_compat.py` fails when a new version has changed one of them.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.strategies import DDPStrategy

from hgn.training.distributed import averaging_options


def quieten() -> None:
    """No news and no advice from Lightning: the commands say themselves what they do."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", ".*does not have many workers.*")
    warnings.filterwarnings("ignore", ".*LeafSpec.*")
    warnings.filterwarnings("ignore", ".*GPU available but not used.*")  # training.accelerator=cpu says so


def gradient_averaging(backend: str) -> DDPStrategy:
    """Returns the strategy of a training on several ranks; `backend` is torch or triton."""
    return _Unwrapped() if backend == "triton" else DDPStrategy(**averaging_options())


class _Unwrapped(DDPStrategy):
    """For updates that average their gradients themselves: no DistributedDataParallel, which would wait for them."""

    def configure_ddp(self) -> None:
        pass


@contextmanager
def interrupts_passed_on() -> Iterator[None]:
    """Lightning makes an exit of its own of a KeyboardInterrupt, with the code of a fault."""
    try:
        yield
    except SystemExit as end:
        raise KeyboardInterrupt from end


def skip_sigterm_broadcast(trainer: Trainer) -> None:
    """Before each update Lightning asks rank 0 for a SIGTERM, and has the host wait for the device until it answers
    (its issue 21487). Ours goes another way: the ranks agree now and then, see hgn.training.callbacks.Stopper.
    """
    trainer.fit_loop.epoch_loop._broadcast_sigterm_tensor = _nothing  # type: ignore[method-assign]


def forget_sigterm(trainer: Trainer) -> None:
    """Of a SIGTERM that came while Lightning's own handler was in place, which calls ours, too: after an update it
    would leave the loop by an exception, past the checkpoint and with exit code 0.
    """
    trainer._signal_connector.received_sigterm = False


def count_updates(trainer: Trainer, count: int) -> None:
    """Leaves behind what `count` steps of an optimiser do, where kernels made them: `trainer.global_step` grows."""
    progress = trainer.fit_loop.epoch_loop.manual_optimization.optim_step_progress
    for tracker in (progress.total, progress.current):
        tracker.ready += count
        tracker.completed += count


def advance_scheduler(scheduler: torch.optim.lr_scheduler.LambdaLR, base: float, update: int) -> None:
    """Leaves behind what a scheduler of this base rate does in its steps up to this update."""
    rate = base * scheduler.lr_lambdas[0](update)
    scheduler.last_epoch, scheduler._step_count = update, update + 1
    scheduler.base_lrs, scheduler._last_lr = [base], [rate]
    scheduler.optimizer.param_groups[0]["lr"] = rate


def set_stored_updates(checkpoint: dict[str, Any], updates: int) -> None:
    """Lightning counts updates in one of two places, by the backend that made them; a checkpoint gets both."""
    loops = checkpoint["loops"]["fit_loop"]
    for tracker in (
        loops["epoch_loop.automatic_optimization.optim_progress"]["optimizer"]["step"],
        loops["epoch_loop.manual_optimization.optim_step_progress"],
    ):
        tracker["total"] = {"ready": updates, "completed": updates}


def _nothing() -> None:
    pass
