"""What happens beside the updates: the same weights on all ranks, checkpoints, monitoring, log lines, stopping.

Files of a run: checkpoints/last.ckpt, checkpoints/best.ckpt (lowest one-step validation error), metrics.jsonl,
tensorboard/, pictures/.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from tqdm import tqdm

from hgn.data.lookup import first_indices
from hgn.data.pooled import AnyStore
from hgn.data.storage import PATIENCE_S
from hgn.render.pictures import rollout_of_episode
from hgn.runtime.backend import fastest_stepped
from hgn.runtime.rollouts import simulate_scenes
from hgn.runtime.simulator import InitialState, Simulator
from hgn.scene.episode import Episode
from hgn.schema import ConfigError, to_mapping
from hgn.system.files import TEMPORARY_SUFFIX
from hgn.system.progress import bar
from hgn.training import lightning_compat
from hgn.training.checkpoint import LAST_NAMES
from hgn.training.checkpoint_writer import CheckpointWriter
from hgn.training.data_module import EpisodeDataModule, agreed_count
from hgn.training.distributed import checksum, same_on_all_ranks
from hgn.training.errors import (
    REPORTED_FRAMES,
    SquaredError,
    baselines,
    frame_batches,
    network_predictor,
    one_step_errors,
    rollout_errors,
)
from hgn.training.gradients import GradientGuard
from hgn.training.module import TrainingModule
from hgn.training.stop import BY_WEIGHT, StopRequest
from hgn.training.tensorboard import show_rollout

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
            trainer.save_checkpoint(self.folder / "best.ckpt")

    def finish(self, trainer: Trainer) -> None:
        """All ranks call this at the end: the last checkpoint is on disk then."""
        self.save_last(trainer)
        self.writer.wait()
        trainer.strategy.barrier()  # a rank that ends before this may take the others with it


class Monitor(Callback):
    """Measures one-step errors on fixed scenes of both splits, and rollouts of the validation scenes."""

    def __init__(self, run: Path, training: AnyStore, stop: StopRequest, checkpoints: Checkpoints):
        self.run, self.stop, self.checkpoints = run, stop, checkpoints
        self.stores = {"training": training, "validation": training.of_split("validation")}
        self.last: dict[str, float] = {}
        self._measured_update = -1

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        assert isinstance(pl_module, TrainingModule)
        if trainer.global_step % pl_module.training_config.monitor_every == 0:
            self.measure(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, TrainingModule)
        if not self._interrupted(trainer):
            self.measure(trainer, pl_module, PATIENCE_S)

    def measure(self, trainer: Trainer, module: TrainingModule, patience_s: float = 0.0) -> None:
        """The one-step frames are divided among the ranks; rank 0 does the rollouts. Ends early on a stop request.

        Where a server has scenes that are not here yet and does not answer, measures nothing and says so.
        """
        if self._measured_update == trainer.global_step:
            return
        self._measured_update = trainer.global_step
        config, network = module.training_config, module.result
        network.eval()
        started = time.monotonic()
        self.stores["validation"].refresh()
        chosen = {
            split: first_indices(store, config.monitor_scenes, agreed_count(store, trainer))
            for split, store in self.stores.items()
        }
        here = all(store.within_reach(chosen[split], patience_s) for split, store in self.stores.items())
        if not trainer.strategy.reduce_boolean_decision(here, all=True):
            network.train()
            if trainer.is_global_zero:
                text = "the scenes to measure on are not all here, and their server does not send them now"
                print(f"nothing is measured at update {trainer.global_step}: {text}", file=sys.stderr)
            return
        scenes = {split: [store.episodes[i] for i in chosen[split]] for split, store in self.stores.items()}
        values: dict[str, float] = {}
        for split, episodes in scenes.items():
            if not episodes or self._interrupted(trainer):
                continue
            values |= self._one_step(trainer, module, split, episodes)
        if "one_step/validation" in values and not self._interrupted(trainer):
            if config.monitor_rollout_frames >= 2 and trainer.is_global_zero:
                values |= self._rollout(trainer, module, scenes["validation"], config.monitor_rollout_frames)
            self.checkpoints.offer(trainer, values["one_step/validation"])
        values["monitor/seconds"] = time.monotonic() - started
        network.train()
        self.last |= values
        log(trainer, self.run, values)

    def _one_step(
        self, trainer: Trainer, module: TrainingModule, split: str, episodes: list[Episode]
    ) -> dict[str, float]:
        config, network = module.training_config, module.result
        batches = frame_batches(
            episodes,
            network,
            config.monitor_frame_stride,
            config.monitor_particles_per_batch,
            trainer.global_rank,
            trainer.world_size,
        )
        backend = fastest_stepped(network, module.training_config.precision)
        predictors = {"network": network_predictor(backend)} | baselines(network)
        materials = network.config.materials
        interrupted: Callable[[], bool] = lambda: trainer.world_size == 1 and self.stop.signal is not None  # noqa: E731
        errors = one_step_errors(predictors, batches, module.device, materials, interrupted)
        if trainer.world_size > 1:
            errors = {name: _reduce(trainer, module.device, error, materials) for name, error in errors.items()}
        values = {f"one_step/{split}": errors["network"].mse}
        best = min(error.mse for name, error in errors.items() if name != "network")
        if values[f"one_step/{split}"] > 0:
            values[f"baseline_ratio/{split}"] = best / values[f"one_step/{split}"]
        for name, mse in errors["network"].by_material().items():
            values[f"one_step/{split}_{name}"] = mse
        for name, error in errors.items():
            if name != "network":
                values[f"baseline/{split}_{name.replace(' ', '_')}"] = error.mse
        return values

    def _rollout(
        self, trainer: Trainer, module: TrainingModule, episodes: list[Episode], frames: int
    ) -> dict[str, float]:
        """Errors are means over the scenes that came so far; told beside them is how many came to the end."""
        simulator = Simulator(module.result, episodes[0].frame_rate_hz, module.simulating_backend())
        frames = min(frames, *(len(episode.position_TN3) for episode in episodes))
        trials = simulate_scenes(simulator, [InitialState.of_episode(episode) for episode in episodes], frames)
        error_T = rollout_errors([trial.position_TN3 for trial in trials], episodes)
        reached = [n for n in REPORTED_FRAMES if n < len(error_T["all"])]
        values = {f"rollout/mse_frame_{n}": float(error_T["all"][n]) for n in reached}
        values["rollout/finished"] = sum(trial.cause is None for trial in trials) / len(trials)
        values["rollout/frames"] = float(min(trial.frame_count for trial in trials))
        for name, mse_T in error_T.items():
            values["rollout/mse" if name == "all" else f"rollout/mse_{name}"] = float(np.nanmean(mse_T))
        shown = rollout_of_episode(episodes[0], trials[0].position_TN3)
        show_rollout(trainer, self.run / "pictures", shown, error_T)
        return values

    def _interrupted(self, trainer: Trainer) -> bool:
        return bool(trainer.strategy.reduce_boolean_decision(self.stop.signal is not None, all=False))


class LogLines(Callback):
    """Loss, learning rate and speed, to TensorBoard, metrics.jsonl and a progress bar.

    The loss is the mean over all ranks; speed, waiting for data and GPU memory are those of rank 0.
    """

    def __init__(
        self, run: Path, monitor: Monitor, guard: GradientGuard, feed: EpisodeDataModule, published: Callable[[], str]
    ):
        self.run, self.monitor, self.guard, self.feed, self.published = run, monitor, guard, feed, published
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
            if "baseline_ratio/validation" in self.monitor.last:
                notes += f", {self.monitor.last['baseline_ratio/validation']:.2f}x below the best baseline"
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


def _reduce(trainer: Trainer, device: torch.device, error: SquaredError, materials: tuple[str, ...]) -> SquaredError:
    rows = [[error.total.get(name, 0.0), float(error.count.get(name, 0))] for name in materials]
    summed = trainer.strategy.reduce(torch.tensor(rows, dtype=torch.float64, device=device), reduce_op="sum")
    assert isinstance(summed, torch.Tensor)
    return SquaredError(
        {name: row[0] for name, row in zip(materials, summed.tolist(), strict=True)},
        {name: int(row[1]) for name, row in zip(materials, summed.tolist(), strict=True)},
    )
