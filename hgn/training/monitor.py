"""Measurements while a training runs: one-step errors and rollouts of fixed scenes."""

import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hgn.data.pooled import AnyStore
from hgn.render.pictures import rollout_of_episode
from hgn.runtime.backend import fastest_stepped
from hgn.runtime.rollouts import simulate_scenes
from hgn.runtime.simulator import InitialState, Simulator
from hgn.scene.episode import Episode
from hgn.system.patience import outlived, standard_patience_s
from hgn.training.callbacks import Checkpoints, log
from hgn.training.data_module import agreed_count
from hgn.training.errors import (
    MONITORED_SCENES,
    REPORTED_FRAMES,
    SquaredError,
    baselines,
    frame_batches,
    network_predictor,
    one_step_errors,
    rollout_errors,
)
from hgn.training.lightning_compat import Callback, LightningModule, Trainer
from hgn.training.module import TrainingModule
from hgn.training.schedule import measurement_due
from hgn.training.stop import StopRequest
from hgn.training.tensorboard import show_pictures, write_pictures

FRAME_STRIDE = 4  # neighbouring frames have almost the same errors


class Monitor(Callback):
    """Measures one-step errors of fixed scenes of both splits, and rollouts of the validation scenes."""

    def __init__(self, run: Path, training: AnyStore, stop: StopRequest, checkpoints: Checkpoints):
        self.run, self.stop, self.checkpoints = run, stop, checkpoints
        self.stores = {"training": training, "validation": training.of_split("validation")}
        self.last: dict[str, float] = {}

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Makes the measurement that a stop request ended before this start."""
        self.on_train_batch_end(trainer, pl_module)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        assert isinstance(pl_module, TrainingModule)
        if measurement_due(pl_module.training_config, pl_module.update):
            self.measure(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, TrainingModule)
        if not self._interrupted(trainer):
            self.measure(trainer, pl_module, standard_patience_s())

    def measure(self, trainer: Trainer, module: TrainingModule, patience_s: float = 0.0) -> None:
        """Measures and logs. One-step frames are divided among the ranks; rank 0 simulates the rollouts.

        A stop request ends it without a result; the resumed run measures again. If scenes are on a server that does not
        answer, it only prints a message.
        """
        if self.checkpoints.measured_update == module.update:
            return
        network = module.trained.result
        network.eval()
        started = time.monotonic()
        self.stores["validation"].refresh()
        chosen = {
            split: store.first_indices(MONITORED_SCENES, agreed_count(store, trainer))
            for split, store in self.stores.items()
        }
        here = all(store.within_reach(chosen[split], patience_s) for split, store in self.stores.items())
        if not trainer.strategy.reduce_boolean_decision(here, all=True):
            network.train()
            if trainer.is_global_zero:
                text = "a server did not send all scenes that are measured"
                print(f"no measurement at update {module.update}: {text}", file=sys.stderr)
            return
        scenes = {split: [store[i] for i in chosen[split]] for split, store in self.stores.items()}
        values: dict[str, float] = {}
        for split, episodes in scenes.items():
            if not episodes or self._interrupted(trainer):
                continue
            values |= self._one_step(trainer, module, split, episodes)
        if self._interrupted(trainer):
            network.train()
            return
        frames = module.training_config.monitor_rollout_frames
        if "one_step/validation" in values and frames >= 2 and trainer.is_global_zero:
            values |= self._rollout(trainer, module, scenes["validation"], frames)
        self.checkpoints.offer(trainer, module.update, values.get("one_step/validation", math.inf))
        values["monitor/seconds"] = time.monotonic() - started
        network.train()
        self.last |= values
        log(trainer, self.run, module.update, values)

    def _one_step(
        self, trainer: Trainer, module: TrainingModule, split: str, episodes: list[Episode]
    ) -> dict[str, float]:
        network = module.trained.result
        ranks = {"rank": trainer.global_rank, "world_size": trainer.world_size}
        batches = frame_batches(episodes, network, FRAME_STRIDE, **ranks)
        backend = fastest_stepped(network, module.updates.precision)
        predictors = {"network": network_predictor(backend)} | baselines(network)
        materials = network.config.materials
        interrupted: Callable[[], bool] = lambda: trainer.world_size == 1 and self.stop.signal is not None  # noqa: E731
        errors = one_step_errors(predictors, batches, module.device, materials, stop=interrupted)
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
        """Returns rollout errors, averaged over the scenes that reached each frame, and the fraction that finished."""
        simulator = Simulator(module.trained.result, episodes[0].frame_rate_hz, module.simulating_backend())
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
        folder = self.run / "pictures"
        paths = outlived(lambda: write_pictures(folder, module.update, shown, error_T), folder)
        show_pictures(trainer.loggers, module.update, paths)
        return values

    def _interrupted(self, trainer: Trainer) -> bool:
        return bool(trainer.strategy.reduce_boolean_decision(self.stop.signal is not None, all=False))


def _reduce(trainer: Trainer, device: torch.device, error: SquaredError, materials: tuple[str, ...]) -> SquaredError:
    rows = [[error.total.get(name, 0.0), float(error.count.get(name, 0))] for name in materials]
    summed = trainer.strategy.reduce(torch.tensor(rows, dtype=torch.float64, device=device), reduce_op="sum")
    assert isinstance(summed, torch.Tensor)
    return SquaredError(
        {name: row[0] for name, row in zip(materials, summed.tolist(), strict=True)},
        {name: int(row[1]) for name, row in zip(materials, summed.tolist(), strict=True)},
    )
