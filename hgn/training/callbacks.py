"""What happens beside the updates: the same weights on all ranks, checkpoints, log lines, stopping.

Files of a run: checkpoints/last.ckpt, metrics.jsonl, tensorboard/; and where there are validation scenes
checkpoints/best.ckpt (lowest one-step validation error) and pictures/.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from tqdm import tqdm

from hgn.schema import ConfigError, to_mapping
from hgn.system.files import TEMPORARY_SUFFIX
from hgn.system.progress import bar
from hgn.training import lightning_compat
from hgn.training.checkpoint import BEST_NAME, LAST_NAMES
from hgn.training.checkpoint_writer import CheckpointWriter
from hgn.training.data_module import EpisodeDataModule
from hgn.training.distributed import checksum, same_on_all_ranks
from hgn.training.errors import format_ratio
from hgn.training.gradients import GradientGuard
from hgn.training.module import TrainingModule
from hgn.training.stop import BY_WEIGHT, StopRequest

METRICS = "metrics.jsonl"


class SameWeights(Callback):
    """All ranks begin at one place: the same update, the same samples next, the same weights and normaliser; and at
    each log line their weights are still the same, bit for bit.

    Nothing but gradients travels at an update, but for those where ranks log, save, measure or agree.
    """

    def __init__(self, feed: EpisodeDataModule) -> None:
        self.feed = feed

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Raises: ConfigError on every rank when one of them resumes from another checkpoint."""
        if trainer.world_size == 1:
            return
        lightning_compat.skip_sigterm_broadcast(trainer)
        mine: dict[str, Any] = {"update": trainer.global_step} | to_mapping(self.feed.sampler_state)
        first = trainer.strategy.broadcast(mine)
        if not trainer.strategy.reduce_boolean_decision(mine == first, all=True):
            raise ConfigError(
                f"run must be a folder that all machines share, got another checkpoint on some of them (rank "
                f"{trainer.global_rank}: {mine}, rank 0: {first}); give them one run=FOLDER"
            )
        # A data set that grows may have shown other statistics to a rank that looked later.
        for tensor in (*pl_module.parameters(), *pl_module.buffers()):
            torch.distributed.broadcast(tensor.detach(), 0)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Raises: ConfigError on every rank when one of them has other weights."""
        if trainer.world_size == 1 or trainer.global_step % self.feed.training.log_every:
            return
        if not same_on_all_ranks(checksum(pl_module.parameters())):
            raise ConfigError(
                f"weights must be the same on all ranks, got others at update {trainer.global_step}: a device or a "
                "link computes wrongly; find it, and run the same command again to resume from rank 0's last checkpoint"
            )


class Checkpoints(Callback):
    """Says when a checkpoint is due, and where it goes; the trainer's `writer` writes it beside the next updates."""

    def __init__(self, folder: Path, every: int, writer: CheckpointWriter) -> None:
        self.folder, self.every, self.writer = folder, every, writer
        self.best_error = math.inf
        self._saved_update = -1

    def state_dict(self) -> dict[str, Any]:
        return {"best_error": self.best_error}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.best_error = state_dict["best_error"]

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        if trainer.is_global_zero:
            for left_by_a_crash in self.folder.glob(f".*{TEMPORARY_SUFFIX}"):
                left_by_a_crash.unlink()

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        if trainer.global_step % self.every == 0:
            self.save_last(trainer)

    def save_last(self, trainer: Trainer) -> None:
        """All ranks call this; rank 0 writes, see CheckpointWriter."""
        if self._saved_update != trainer.global_step:
            trainer.save_checkpoint(self.folder / LAST_NAMES[0])
            self._saved_update = trainer.global_step

    def offer(self, trainer: Trainer, error: float) -> None:
        """Keeps the network as the best so far if its one-step validation error is the lowest."""
        if error < self.best_error:
            self.best_error = error
            self._saved_update = -1  # the last checkpoint is to know it, too
            trainer.save_checkpoint(self.folder / BEST_NAME)

    def finish(self, trainer: Trainer) -> None:
        """All ranks call this at the end: the last checkpoint is on disk then."""
        self.save_last(trainer)
        self.writer.wait()
        trainer.strategy.barrier()  # a rank that ends before this may take the others with it


class LogLines(Callback):
    """Loss, learning rate and speed, to TensorBoard, metrics.jsonl and a progress bar.

    The loss is the mean over all ranks; speed, waiting for data and GPU memory are those of rank 0.
    """

    def __init__(
        self,
        run: Path,
        measured: dict[str, float],
        guard: GradientGuard,
        feed: EpisodeDataModule,
        published: Callable[[], str],
    ) -> None:
        """measured: filled by the monitor as it measures."""
        self.run, self.measured, self.guard, self.feed, self.published = run, measured, guard, feed, published
        self._bar: tqdm[Any] | None = None
        self._time, self._update, self._waited_s = time.monotonic(), 0, 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._time, self._update, self._waited_s = time.monotonic(), trainer.global_step, self.feed.waited_s
        if trainer.is_global_zero:
            _drop_cut_line(self.run / METRICS)
            total = self.feed.training.maximum_updates
            self._bar = bar("training", total=total, initial=trainer.global_step, unit="update")

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        assert isinstance(pl_module, TrainingModule)
        if trainer.global_step % pl_module.training_config.log_every:
            return
        loss_sum, count = trainer.strategy.reduce(pl_module.loss_sum.clone(), reduce_op="sum").tolist()
        pl_module.loss_sum.zero_()
        gradients = self.guard.take(trainer.global_step)
        now, waited_s = time.monotonic(), self.feed.waited_s
        seconds = now - self._time
        speed = (trainer.global_step - self._update) / seconds
        values = {"loss": loss_sum / count} if count else {}
        values |= gradients | {
            "learning_rate": float(trainer.optimizers[0].param_groups[0]["lr"]),
            "updates_per_second": speed,
            "scenes_per_second": speed * pl_module.training_config.batch_scenes * trainer.world_size,
            "data_wait_fraction": (waited_s - self._waited_s) / seconds,
            "shards": float(self.feed.store.manifest.totals["train"].shards),
            "episodes": float(pl_module.sampler_state.episodes),
            "epoch": float(pl_module.sampler_state.epoch),
        }
        self._time, self._update, self._waited_s = now, trainer.global_step, waited_s
        values |= pl_module.pushforward_figures
        if pl_module.device.type == "cuda":
            values["gpu_memory_gb"] = torch.cuda.max_memory_allocated() / 1e9
        log(trainer, self.run, values)
        if self._bar is not None:
            notes = f"loss {values.get('loss', math.nan):.3f}"
            if "baseline_ratio/validation" in self.measured:
                notes += f", {format_ratio(self.measured['baseline_ratio/validation'])} the best baseline"
            self._bar.set_postfix_str(f"{notes}, {self.published()}", refresh=False)
            self._bar.update(trainer.global_step - self._bar.n)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._bar is not None:
            self._bar.close()


class Stopper(Callback):
    """Ends the loop at an update boundary on every rank, once a checkpoint is written."""

    AGREE_EVERY = 10  # updates between agreements of several ranks

    def __init__(self, stop: StopRequest, checkpoints: Checkpoints) -> None:
        self.stop, self.checkpoints = stop, checkpoints
        self._agreed_update = 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._agreed_update = trainer.global_step
        # Lightning has just put a handler of its own before ours: on SIGTERM it talks to the other ranks from within
        # the handler, and leaves the loop by an exception, past the checkpoint.
        self.stop.listen()
        lightning_compat.forget_sigterm(trainer)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        if trainer.world_size > 1 and trainer.global_step < self._agreed_update + self.AGREE_EVERY:
            return
        self._agreed_update = trainer.global_step
        if trainer.strategy.reduce_boolean_decision(self.stop.requested, all=False):
            trainer.should_stop = True
            # A signal may have reached one rank alone; all end with its exit code.
            mine = 0 if self.stop.signal is None else 1 + BY_WEIGHT.index(self.stop.signal)
            heaviest = int(trainer.strategy.reduce(torch.tensor(mine, device=pl_module.device), reduce_op="max"))
            self.stop.signal = int(BY_WEIGHT[heaviest - 1]) if heaviest else None

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.checkpoints.finish(trainer)


def log(trainer: Trainer, run: Path, values: dict[str, float]) -> None:
    """To TensorBoard and to metrics.jsonl, on rank 0 alone."""
    if not trainer.is_global_zero:
        return
    for logger in trainer.loggers:
        logger.log_metrics(values, trainer.global_step)
    record = {"update": trainer.global_step, "time": time.time()} | values
    with (run / METRICS).open("a", encoding="utf-8") as file:
        file.write(json.dumps(record) + "\n")


def _drop_cut_line(path: Path) -> None:
    """Where a full disk or a loss of power cut the last record, the next one begins a line of its own."""
    if path.exists():
        os.truncate(path, path.read_bytes().rfind(b"\n") + 1)
