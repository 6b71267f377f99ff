"""python -m hgn.train +experiment=obstacles: trains a network, and makes the data it needs.

A run is a folder; the same command again goes on where it stopped. Ctrl-C, SIGTERM and SIGUSR1 end the run at the
next update, after a checkpoint.
"""

from __future__ import annotations

import math
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import yaml

from hgn.command import run_command
from hgn.config import TrainConfig
from hgn.data.identity import dataset_identity, identity_hash, require_same_dataset
from hgn.data.manifest import SPLITS, Manifest
from hgn.data.reader import EpisodeStore
from hgn.data.sampler import SamplerState
from hgn.data.storage import UnreachableError, is_remote
from hgn.network.base import ParticleNetwork
from hgn.network.build import build_network
from hgn.runtime.backend import choose_path, set_matmul_precision, why_not_trained_fast
from hgn.schema import ConfigError, from_mapping, to_mapping
from hgn.system.device import keep_to_quota
from hgn.system.files import write_atomically
from hgn.system.progress import bar
from hgn.system.provenance import provenance
from hgn.training.checkpoint import (
    DataInfo,
    check_checkpoint,
    cursor_of_checkpoint,
    network_of_weights,
    read_checkpoint,
)
from hgn.training.errors import told_gain
from hgn.training.generator import Generator
from hgn.training.launch import default_run, first_on_machine, first_rank, layout
from hgn.training.stop import StopRequest

if TYPE_CHECKING:
    from hgn.runtime.precompile import Precompilation

BETWEEN_LOOKS_S = 10.0  # at the data set's manifest, for the progress line


def main(mapping: dict[str, Any]) -> int:
    """Trains as the resolved configuration says; returns the exit code."""
    name = mapping.pop("name", "unnamed")
    if mapping.get("run") is None:
        mapping["run"] = str(default_run(name))
    config = from_mapping(TrainConfig, mapping)
    layout(config.training)
    run = Path(config.run)
    if EpisodeStore.available(config.dataset.folder):
        require_same_dataset(Manifest.load(config.dataset.folder).config, config.datagen, config.dataset.folder)
    last = run / "checkpoints" / "last.ckpt"
    checkpoint = _checkpoint_to_resume(config, last) if last.exists() else None
    begin_with = _weights_to_begin_with(config, checkpoint)
    stop = StopRequest()
    stop.listen()
    with ExitStack() as stack:
        generator = None
        # what a URL lacks, its own service makes
        if first_rank() and config.training.generate and not is_remote(config.dataset.folder) and not _complete(config):
            generator = Generator(config.datagen, run / "datagen")
            stack.callback(generator.stop)
        ahead = _compile_ahead(config, stack)
        store = _wait_for_episodes(config, generator, stop)
        if store is None:
            print("stopped before the first episode was published; the same command goes on", file=sys.stderr)
            return stop.exit_code
        stop.restart_clock(config.training.maximum_minutes)
        return _fit(config, run, store, checkpoint, begin_with, stop, generator, ahead)


def _fit(
    config: TrainConfig,
    run: Path,
    store: EpisodeStore,
    checkpoint: tuple[Path, SamplerState] | None,
    begin_with: ParticleNetwork | None,
    stop: StopRequest,
    generator: Generator | None,
    ahead: Precompilation | None,
) -> int:
    # Lightning loads for seconds: not before the waiting is over, and never for the other commands.
    from lightning.pytorch import Trainer, seed_everything
    from lightning.pytorch.loggers import TensorBoardLogger

    from hgn.training.callbacks import Checkpoints, LogLines, Monitor, Stopper
    from hgn.training.checkpoint_writer import CheckpointWriter
    from hgn.training.data_module import EpisodeDataModule
    from hgn.training.distributed import SameStart, gradient_averaging
    from hgn.training.gradients import GradientGuard
    from hgn.training.module import TrainingModule
    from hgn.training.tensorboard import FinalMetrics

    training = config.training
    data = DataInfo(
        store.manifest.config_hash, config.dataset.frame_rate_hz, config.scene.cell_size, config.scene.gravity
    )
    _quieten_lightning()
    devices, nodes = layout(training)
    path, text = _path(config)
    if first_rank():
        print(text, file=sys.stderr)
    keep_to_quota()
    set_matmul_precision(training.precision)
    seed_everything(training.seed, verbose=False)
    module = TrainingModule(build_network(config.network), training, data, path)
    if begin_with is None:
        module.set_statistics(store.statistics())
    else:
        module.begin_with(begin_with)
    feed = EpisodeDataModule(store, config.network, training, chunks=path == "fast", interrupted=lambda: stop.requested)
    if checkpoint is not None:
        feed.cursor = checkpoint[1]
    _write_run_files(config, run)

    writer = CheckpointWriter()
    checkpoints = Checkpoints(run / "checkpoints", training.checkpoint_every, writer)
    monitor = Monitor(run, store, stop, checkpoints)
    guard = GradientGuard(training.maximum_skipped_updates)
    lines = LogLines(run, monitor, guard, feed, _published_text(config, generator))
    final = FinalMetrics(to_mapping(config), monitor.last, stop)
    trainer = Trainer(
        accelerator=training.accelerator,
        devices=devices,
        num_nodes=nodes,
        strategy=gradient_averaging(path) if devices * nodes > 1 else "auto",
        max_steps=training.maximum_updates,
        max_epochs=-1,
        callbacks=[SameStart(feed), guard, lines, monitor, checkpoints, Stopper(stop, checkpoints), final],
        plugins=[writer],
        logger=TensorBoardLogger(run, name="", version="tensorboard"),
        default_root_dir=run,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        log_every_n_steps=training.maximum_updates,
    )
    if ahead is not None:
        print(ahead.wait(lambda: stop.requested), file=sys.stderr)
    trainer.fit(module, feed, ckpt_path=checkpoint[0] if checkpoint else None, weights_only=True)
    if trainer.is_global_zero:
        _report(config, run, trainer.global_step, monitor.last, stop)
    # a signal that came after the last update changed nothing
    return 0 if trainer.global_step >= training.maximum_updates else stop.exit_code


def _path(config: TrainConfig) -> tuple[str, str]:
    """`plain` or `fast`, and a line that says so."""
    training = config.training
    on_gpu = training.accelerator != "cpu" and torch.cuda.is_available()
    device = torch.device("cuda" if on_gpu else "cpu")
    own_states = training.rollout_share > 0
    reason = why_not_trained_fast(device, config.network, training.precision, own_states)
    half_plainly = config.network.kind != "hgn"
    return choose_path("training.path", training.path, training.precision, reason, half_plainly)


def _compile_ahead(config: TrainConfig, stack: ExitStack) -> Precompilation | None:
    """Lets the kernels be compiled while others wait for data, where this process leads its machine's on GPUs."""
    training = config.training
    path, _ = _path(config)
    on_gpu = training.accelerator != "cpu" and torch.cuda.is_available() and torch.version.hip is None
    if path != "fast" or not on_gpu or not first_on_machine():
        return None
    # Triton, which the plain path does without, is loaded here.
    from hgn.runtime.precompile import Precompilation
    from hgn.training.precompile import job_of_training

    devices, nodes = layout(training)
    ahead = Precompilation(job_of_training(config, torch.cuda.get_device_capability(), devices * nodes > 1))
    stack.callback(ahead.stop)
    return ahead


def _checkpoint_to_resume(config: TrainConfig, path: Path) -> tuple[Path, SamplerState]:
    """The run's last checkpoint, checked before anything is started, and where in the data it stood."""
    checkpoint = read_checkpoint(path)
    check_checkpoint(checkpoint, config, identity_hash(dataset_identity(config.datagen)), path)
    return path, cursor_of_checkpoint(checkpoint)


def _weights_to_begin_with(config: TrainConfig, checkpoint: tuple[Path, SamplerState] | None) -> ParticleNetwork | None:
    """The network of training.weights, for a new run alone: a checkpoint wins."""
    weights = config.training.weights
    if weights is None:
        return None
    if checkpoint is not None:
        if first_rank():
            print(f"training.weights={weights} is not read: the run goes on from {checkpoint[0]}", file=sys.stderr)
        return None
    network = network_of_weights(config)
    if first_rank():
        print(f"begins with the weights and the normaliser of {weights}", file=sys.stderr)
    return network


def _complete(config: TrainConfig) -> bool:
    folder = config.dataset.folder
    if not EpisodeStore.available(folder):
        return False
    manifest = Manifest.load(folder)
    return all(manifest.published(split) >= config.dataset.scenes(split) for split in SPLITS)


def _wait_for_episodes(config: TrainConfig, generator: Generator | None, stop: StopRequest) -> EpisodeStore | None:
    """Waits until enough training episodes are published, showing what is awaited; none when asked to stop."""
    folder, needed = config.dataset.folder, config.training.minimum_episodes
    needed = min(needed, config.dataset.training_scenes)
    if generator is None and first_rank() and not EpisodeStore.available(folder):
        raise ConfigError(
            f"dataset.folder must hold a data set, got {folder} without one; generate it with python -m datagen "
            f"out={folder}, or set training.generate=true"
        )
    progress = None
    while not stop.requested:
        store = EpisodeStore(folder, "train") if EpisodeStore.available(folder) else None
        if store is not None and len(store) >= needed:
            if progress is not None:
                progress.close()
            return store
        if generator is not None:
            generator.check()
            if not generator.running:
                raise ConfigError(
                    f"training.minimum_episodes must be reachable, got {needed} where the data set has "
                    f"{len(store) if store else 0}; ask for more scenes"
                )
        elif first_rank() and (not is_remote(folder) or (store is not None and store.manifest.complete)):
            raise ConfigError(
                f"dataset.folder must hold {needed} training episodes, got {len(store) if store else 0} in {folder}; "
                "generate them, or set training.generate=true"
            )
        if progress is None and first_rank():
            print(f"waiting for training episode {needed} in {folder}", file=sys.stderr)
            progress = bar("generating", total=needed * config.dataset.frames, unit="frame")
        if progress is not None and generator is not None:
            frames = generator.frames_done()
            progress.update(min(max(frames, progress.n), progress.total) - progress.n)
        time.sleep(0.5)
    return None


def _published_text(config: TrainConfig, generator: Generator | None) -> Callable[[], str]:
    folder, total = config.dataset.folder, config.dataset.training_scenes
    looked_at, found = -math.inf, ""

    def text() -> str:
        # hundreds of scenes take a tenth of a second to read: not with every line, and never again once all are there
        nonlocal looked_at, found
        if time.monotonic() - looked_at < BETWEEN_LOOKS_S:
            return found
        try:
            count = Manifest.load(folder, patience_s=0.0).published("train")
        except UnreachableError:
            count, found = 0, "the service does not answer"
        else:
            state = "" if generator is None or generator.running or count >= total else ", generator stopped"
            found = f"{count}/{total} episodes{state}"
        looked_at = math.inf if count >= total else time.monotonic()
        return found

    return text


def _write_run_files(config: TrainConfig, run: Path) -> None:
    run.mkdir(parents=True, exist_ok=True)
    if not first_rank():
        return
    manifest = Manifest.load(config.dataset.folder)
    record = to_mapping(config)
    record["provenance"] = provenance("cuda" if torch.cuda.is_available() else "cpu") | {
        "data_schema_version": manifest.schema_version,
        "data_config_hash": manifest.config_hash,
    }
    write_atomically(run / "config.yaml", yaml.safe_dump(record, sort_keys=False).encode())


def _report(config: TrainConfig, run: Path, updates: int, last: dict[str, float], stop: StopRequest) -> None:
    print(f"trained {updates} of {config.training.maximum_updates} updates in {run}")
    if "one_step/validation" in last:
        print(
            f"one-step validation MSE {last['one_step/validation']:.3e}, "
            f"{told_gain(last['one_step_gain/validation'])} the best trivial predictor's"
        )
    if stop.requested:
        print("stopped; the same command goes on from here")


def _quieten_lightning() -> None:
    import logging

    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", ".*does not have many workers.*")
    warnings.filterwarnings("ignore", ".*LeafSpec.*")
    warnings.filterwarnings("ignore", ".*GPU available but not used.*")  # training.accelerator=cpu says so


if __name__ == "__main__":
    run_command(main, "train")
