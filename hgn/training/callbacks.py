"""Callbacks between chunks of updates: the same parameters on all ranks, checkpoints, log lines, stopping.

A run's folder contains checkpoints/last.ckpt, metrics.jsonl and tensorboard/. With validation scenes the folder also
contains pictures/ and checkpoints/best.ckpt, the network with the lowest one-step validation error.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from hgn.data.storage import StorageError
from hgn.schema import ConfigError, to_mapping
from hgn.system.files import TEMPORARY_SUFFIX, errors_name, open_at_once, write_atomically
from hgn.system.locks import make_again
from hgn.system.patience import outlived
from hgn.system.progress import bar, duration
from hgn.training import lightning_compat
from hgn.training.checkpoint import BEST_NAME, LAST_NAMES
from hgn.training.checkpoint_writer import CheckpointWriter
from hgn.training.data_module import EpisodeDataModule
from hgn.training.dataset import LONG_ON_A_CPU_S, WAY_OUT
from hgn.training.distributed import checksum, same_on_all_ranks
from hgn.training.errors import format_ratio
from hgn.training.gradients import take_counters
from hgn.training.lightning_compat import Callback, LightningModule, Trainer
from hgn.training.module import TrainingModule
from hgn.training.schedule import log_line_due, measurement_due
from hgn.training.stop import BY_WEIGHT, StopRequest

METRICS = "metrics.jsonl"
ESTIMATE_AFTER_S = 10.0  # duration of the updates from which the remaining time is estimated, and its least value


class SameWeights(Callback):
    """Ensures that all ranks train the same network.

    At the start it requires the same update and next sample on all ranks, and copies rank 0's parameters and buffers to
    the other ranks. At each log line it requires bitwise equal parameters.
    """

    def __init__(self, feed: EpisodeDataModule) -> None:
        self.feed = feed

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Raises: ConfigError on every rank if one of them resumes from another checkpoint."""
        if trainer.world_size == 1:
            return
        lightning_compat.skip_sigterm_broadcast(trainer)
        mine: dict[str, Any] = {"update": self.feed.first_update} | to_mapping(self.feed.sampler_state)
        first = trainer.strategy.broadcast(mine)
        if not trainer.strategy.reduce_boolean_decision(mine == first, all=True):
            raise ConfigError(
                f"run must be a folder that all machines share, got another checkpoint on some of them (rank "
                f"{trainer.global_rank}: {mine}, rank 0: {first}); set the same run=FOLDER on all"
            )
        # A rank that read the statistics of a growing data set later than rank 0 may have other values.
        for tensor in (*pl_module.parameters(), *pl_module.buffers()):
            torch.distributed.broadcast(tensor.detach(), 0)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Raises: ConfigError on every rank if one of them has other parameters."""
        update = _update(pl_module)
        if trainer.world_size == 1 or not log_line_due(self.feed.training, update):
            return
        if not same_on_all_ranks(checksum(pl_module.parameters())):
            raise ConfigError(
                f"weights must be the same on all ranks, got others at update {update}: a device or a link is faulty; "
                "replace it, and run the same command again to resume from rank 0's last checkpoint"
            )


class Checkpoints(Callback):
    """Saves checkpoints when they are due. `writer` writes them during the next updates."""

    def __init__(self, folder: Path, every: int, writer: CheckpointWriter) -> None:
        self.folder, self.every, self.writer = folder, every, writer
        self.best_error = math.inf
        self.measured_update = 0  # number of updates at the last complete measurement
        self._saved_update = -1

    def state_dict(self) -> dict[str, Any]:
        return {"best_error": self.best_error, "measured_update": self.measured_update}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.best_error = float(state_dict["best_error"])
        self.measured_update = int(state_dict.get("measured_update", 0))  # missing in checkpoints of 0.2.0 and before

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        def clear() -> None:
            for left_by_a_crash in self.folder.glob(f".*{TEMPORARY_SUFFIX}"):
                left_by_a_crash.unlink()

        if trainer.is_global_zero:
            outlived(clear, self.folder, start=True)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._saved_update = _update(pl_module) or -1  # the checkpoint of a resumed run; -1: none

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        if _update(pl_module) % self.every == 0:
            self.save_last(trainer, _update(pl_module))

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Saves a checkpoint if unreachable data end the training.

        The rank that lacks data saves without the other ranks, because they wait inside an update.
        """
        unsaved = hasattr(pl_module, "updates") and self._saved_update != _update(pl_module) > 0
        if unsaved and isinstance(exception, (StorageError, OSError)):
            lightning_compat.save_alone(trainer, self.folder / LAST_NAMES[0])

    def save_last(self, trainer: Trainer, update: int) -> None:
        """Saves a checkpoint. All ranks call this; rank 0 writes (see CheckpointWriter)."""
        if self._saved_update != update:
            trainer.save_checkpoint(self.folder / LAST_NAMES[0])
            self._saved_update = update

    def offer(self, trainer: Trainer, update: int, error: float) -> None:
        """Saves the network as the best one if its one-step validation error is the lowest."""
        self.measured_update = update
        self._saved_update = -1  # last.ckpt must contain the measured update and the best error
        if error < self.best_error:
            self.best_error = error
            trainer.save_checkpoint(self.folder / BEST_NAME)

    def finish(self, trainer: Trainer, update: int) -> None:
        """Waits until the last checkpoint is on disk. All ranks call this at the end."""
        self.save_last(trainer, update)
        self.writer.wait()
        trainer.strategy.barrier()  # a rank that ends earlier may end the others too


class LogLines(Callback):
    """Writes loss, learning rate and speed to the loggers, metrics.jsonl and a progress bar.

    The loss is the mean over all ranks. Speed, waiting time and GPU memory are those of rank 0.
    """

    def __init__(
        self, run: Path, measured: dict[str, float], feed: EpisodeDataModule, published: Callable[[], str]
    ) -> None:
        """`measured` is a dictionary that the monitor fills."""
        self.run, self.measured, self.feed, self.published = run, measured, feed, published
        self._bar: tqdm[Any] | None = None
        self._time, self._update, self._waited_s = time.monotonic(), 0, 0.0
        self._first: tuple[float, int] | None = None  # time and number of the first update
        self._estimated = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._time, self._update, self._waited_s = time.monotonic(), _update(pl_module), self.feed.waited_s
        if trainer.is_global_zero:
            total = self.feed.training.maximum_updates
            self._bar = bar("training", total=total, initial=self._update, unit="update")

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        assert isinstance(pl_module, TrainingModule)
        update = pl_module.update
        if self._bar is not None:
            self._bar.update(update - self._bar.n)
            self._estimate(pl_module, self._bar)
        if not log_line_due(self.feed.training, update):
            return
        loss_sum, count = trainer.strategy.reduce(pl_module.loss_sum.clone(), reduce_op="sum").tolist()
        pl_module.loss_sum.zero_()
        skipped, gradients = take_counters(pl_module.gradient_counters, update)
        pl_module.skipped += skipped
        now, waited_s = time.monotonic(), self.feed.waited_s
        seconds = now - self._time
        speed = (update - self._update) / seconds
        values = {"loss": loss_sum / count} if count else {}
        values |= gradients | {
            "skipped_updates": float(pl_module.skipped),
            "learning_rate": pl_module.rate,
            "updates_per_second": speed,
            "scenes_per_second": speed * self.feed.training.batch_scenes * trainer.world_size,
            "data_wait_fraction": (waited_s - self._waited_s) / seconds,
            "shards": float(self.feed.store.manifest.totals["train"].shards),
            "episodes": float(pl_module.sampler_state.episodes),
            "epoch": float(pl_module.sampler_state.epoch),
        }
        self._time, self._update, self._waited_s = now, update, waited_s
        if pl_module.updates.pool is not None:
            values |= pl_module.updates.pool.figures
        if pl_module.device.type == "cuda":
            values["gpu_memory_gb"] = torch.cuda.max_memory_allocated() / 1e9
        log(trainer, self.run, update, values)
        if self._bar is not None:
            notes = f"loss {values.get('loss', math.nan):.3f}"
            if "baseline_ratio/validation" in self.measured:
                notes += f", {format_ratio(self.measured['baseline_ratio/validation'], 1, 'x')} baseline"
            self._bar.set_postfix_str(f"{notes}, {self.published()}", refresh=False)

    def _estimate(self, module: TrainingModule, progress: tqdm[Any]) -> None:
        """Prints once, after the first seconds of updates, how long the remaining updates will take."""
        now, update = time.monotonic(), module.update
        self._first = self._first or (now, update)  # not timed, because it compiles kernels
        seconds, updates = now - self._first[0], update - self._first[1]
        left_s = (self.feed.training.maximum_updates - update) * seconds / max(1, updates)
        if self._estimated or self.feed.interrupted() or updates < 2 or min(seconds, left_s) < ESTIMATE_AFTER_S:
            return
        self._estimated = True
        text = f"about {duration(left_s)} for the remaining updates, at {updates / seconds:.2g} per second"
        if module.device.type == "cpu" and left_s > LONG_ON_A_CPU_S:
            text += f"; {WAY_OUT}"
        progress.write(text, file=sys.stderr)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._bar is not None:
            self._bar.close()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self.on_train_end(trainer, pl_module)  # an open bar would print its last line after the error


class Stopper(Callback):
    """Ends the loop on every rank between two chunks, after a checkpoint.

    Ranks exchange stop requests, and the time of an update since the last exchange. All ranks derive the update of the
    next exchange from the longest of these times.
    """

    AGREE_S = 1.0  # seconds between two exchanges, or one update if that takes longer
    AGREE_EVERY = 10  # largest number of updates between two exchanges

    def __init__(self, stop: StopRequest, checkpoints: Checkpoints) -> None:
        self.stop, self.checkpoints = stop, checkpoints
        self._agreed, self._due_update = (0, 0.0), self.AGREE_EVERY

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._agreed = _update(pl_module), time.monotonic()
        self._due_update = _update(pl_module) + 1
        # Lightning has just replaced our SIGTERM handler by one that would communicate with the other ranks, and leave
        # the loop by an exception without a checkpoint.
        self.stop.listen()
        lightning_compat.forget_sigterm(trainer)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        assert isinstance(pl_module, TrainingModule)
        if trainer.world_size == 1:
            trainer.should_stop |= self.stop.requested
            return
        update = pl_module.update
        # A stop request that ended a measurement must end the training before the next update.
        if update < self._due_update and not measurement_due(pl_module.training_config, update):
            return
        # 0: no request, 1: one without a signal. All ranks end with the same exit code, whatever signals they received.
        mine = 2 + BY_WEIGHT.index(self.stop.signal) if self.stop.signal is not None else int(self.stop.requested)
        agreed_update, agreed_s = self._agreed
        self._agreed = update, time.monotonic()
        values = torch.tensor([mine, (self._agreed[1] - agreed_s) / (update - agreed_update)], device=pl_module.device)
        request, update_s = trainer.strategy.reduce(values, reduce_op="max").tolist()
        every = int(min(self.AGREE_EVERY, max(1.0, self.AGREE_S / max(update_s, 1e-6))))
        self._due_update = (update // every + 1) * every
        if request:
            trainer.should_stop = True
            self.stop.signal = int(BY_WEIGHT[int(request) - 2]) if request > 1 else None

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.checkpoints.finish(trainer, _update(pl_module))


def _update(module: LightningModule) -> int:
    """Returns the number of updates of a module."""
    assert isinstance(module, TrainingModule)
    return module.update


def log(trainer: Trainer, run: Path, update: int, values: dict[str, float]) -> None:
    """Writes to the loggers and to metrics.jsonl, on rank 0 only."""
    if not trainer.is_global_zero:
        return
    for logger in trainer.loggers:
        logger.log_metrics(values, update)
    record = {"update": update, "time": time.time()} | values

    def append() -> None:
        make_again(run)
        _drop_cut_line(run / METRICS)
        with (run / METRICS).open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")

    outlived(append, run / METRICS)


def _drop_cut_line(path: Path) -> None:
    """Removes an incomplete last record, left by a full disk or a loss of power."""
    with errors_name(path), contextlib.suppress(FileNotFoundError), open_at_once(path) as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - 1))
        if file.read() not in (b"", b"\n"):
            file.seek(0)
            content = file.read()
            write_atomically(path, content[: content.rfind(b"\n") + 1])  # some mounted object stores do not truncate
