"""One training from its start or its last checkpoint to its end: network, data, callbacks and trainer."""

from __future__ import annotations

import errno
import math
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import yaml

from hgn.config import SceneConfig, TrainConfig
from hgn.data.manifest import Manifest
from hgn.data.pooled import AnyStore, PooledStore
from hgn.data.storage import faults_outlived
from hgn.network.base import ParticleNetwork
from hgn.network.build import build_network
from hgn.runtime.backend import pick, set_matmul_precision, torch_unsupported_reason, triton_unsupported_reason
from hgn.runtime.torch_backend import precisions_to_try
from hgn.runtime.weights import WeightsInfo
from hgn.scene.kinds import fastest
from hgn.scene.own_physics import own_ranges
from hgn.schema import from_stored, printable, to_mapping
from hgn.system.device import keep_to_quota
from hgn.system.files import make_folder, write_atomically
from hgn.system.loading import loading
from hgn.system.patience import outlived
from hgn.system.provenance import provenance, with_texts
from hgn.system.ranks import first_on_machine, first_rank
from hgn.training.checkpoint import BEST_NAME, LAST_NAMES, DataInfo, Resume
from hgn.training.distributed import layout
from hgn.training.errors import format_ratio
from hgn.training.stop import StopRequest

if TYPE_CHECKING:
    from hgn.training.module import TrainingModule
    from hgn.training.precompile import Precompilation


@dataclass(frozen=True)
class Start:
    """Data and network at the start of a training."""

    store: AnyStore
    resume: Resume | None  # the checkpoint to resume from
    # network whose parameters and normaliser the training starts from; None: random parameters, normaliser of the data
    initial: tuple[ParticleNetwork, WeightsInfo] | None
    precompilation: Precompilation | None


def train_network(config: TrainConfig, start: Start, stop: StopRequest, published: Callable[[], str]) -> int:
    """Trains until `training.maximum_updates` or a stop request. Returns the exit code.

    `published` reports how many episodes are published. Every rank calls this function.
    """
    # Importing Lightning takes seconds. It is imported after the wait for data, and by no other command.
    with loading():
        from hgn.training import lightning_compat
        from hgn.training.callbacks import Checkpoints, LogLines, SameWeights, Stopper
        from hgn.training.checkpoint_writer import CheckpointWriter
        from hgn.training.data_module import EpisodeDataModule
        from hgn.training.loggers import build_loggers
        from hgn.training.monitor import Monitor
        from hgn.training.readers import ChunkReader, EpisodeReader, WindowReader
        from hgn.training.tensorboard import FinalMetrics
        from hgn.training.watch import RankWatch, record_collectives

    training, run, store, resume = config.training, Path(config.run), start.store, start.resume
    lightning_compat.quieten()
    devices, nodes = layout(training)
    backend, precisions, text = _backend(config, resume)
    if first_rank():
        print(text if devices * nodes == 1 else f"{text}, {devices * nodes} processes", file=sys.stderr)
        if not config.dataset.validation_scenes and not len(store.of_split("validation")):
            print(
                f"no validation scenes, so no {BEST_NAME}, validation errors or pictures are written", file=sys.stderr
            )
    keep_to_quota()
    set_matmul_precision(precisions[0])
    lightning_compat.seed_everything(training.seed, verbose=False)
    module = _module(config, start, backend, precisions)
    if devices * nodes == 1:
        module.stopped = lambda: stop.requested
    if backend == "triton":
        reader: ChunkReader = EpisodeReader(store, config.network, training, config.step)
    else:
        reader = WindowReader(store, config.network, training)
    feed = EpisodeDataModule(store, training, reader, interrupted=lambda: stop.requested)
    if resume is not None:
        feed.first_update, feed.sampler_state = resume.progress.updates, resume.progress.sampler_state
    outlived(lambda: _write_run_files(config, store.manifest), run / "config.yaml", start=True)

    writer = CheckpointWriter()
    checkpoints = Checkpoints(run / "checkpoints", training.checkpoint_every, writer)
    monitor = Monitor(run, store, stop, checkpoints)
    lines = LogLines(run, monitor.last, feed, published)
    final = FinalMetrics(settings_of_run(config), monitor.last, stop)
    watch = RankWatch(run)
    trainer = lightning_compat.Trainer(
        accelerator=training.device,
        devices=devices,
        num_nodes=nodes,
        strategy=lightning_compat.gradient_averaging(backend) if devices * nodes > 1 else "auto",
        max_epochs=1,  # the feed ends after the last update
        callbacks=[watch, SameWeights(feed), lines, monitor, checkpoints, Stopper(stop, checkpoints), final],
        plugins=[writer, *lightning_compat.own_launcher()],
        logger=build_loggers(training.loggers, run, settings_of_run(config)),
        default_root_dir=run,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
    )
    if resume is not None:
        lightning_compat.name_odd_parts(trainer, resume.path)
    if devices * nodes > 1:
        record_collectives(run)
    if start.precompilation is not None:
        print(start.precompilation.wait(lambda: stop.requested), file=sys.stderr)
    if devices * nodes > 1:
        if stop.requested:
            return stop.exit_code
        stop.end_at_once()
    try:
        with lightning_compat.interrupts_passed_on(), faults_outlived():
            trainer.fit(module, feed, ckpt_path=resume.path if resume else None, weights_only=True)
    except RuntimeError as error:
        if watch.lost is None:
            raise
        raise ConnectionAbortedError(errno.ECONNABORTED, watch.lost) from error
    finally:
        module.release()
    # a signal after the last measurement has no effect
    finished = module.update >= training.maximum_updates and checkpoints.measured_update == module.update
    if trainer.is_global_zero:
        trained = resume is None or resume.progress.updates < training.maximum_updates
        _report(config, module.update, monitor.last, trained, stopped=stop.requested and not finished)
    return 0 if finished else stop.exit_code


def _module(config: TrainConfig, start: Start, backend: str, precisions: tuple[str, ...]) -> TrainingModule:
    from hgn.training.module import TrainingModule

    data = DataInfo(
        start.store.manifest.config_hash,
        config.dataset.frame_rate_hz,
        config.scene.cell_size,
        config.scene.gravity,
        maximum_initial_speed=fastest(config.scene),
        own_ranges=own_ranges(config.scene.own_physics),
        materials=_materials(config, start),
    )
    network = build_network(config.network, config.step)
    module = TrainingModule(network, config.training, data, backend, precisions=precisions)
    if start.initial is None:
        module.set_statistics(start.store.statistics())
    else:
        module.load_weights(start.initial[0])
    return module


def _materials(config: TrainConfig, start: Start) -> tuple[str, ...]:
    """Returns the materials of the data, after those of the data of training.init_weights; empty: all."""
    first = () if start.initial is None else start.initial[1].data_materials
    earlier = first if start.resume is None else start.resume.materials
    if config.imported or (start.resume is not None and not earlier):
        return ()
    others = start.store.others if isinstance(start.store, PooledStore) else ()
    scenes = (from_stored(SceneConfig, other.manifest.config["scene"], "scene") for other in others)
    own = (name for scene in (config.scene, *scenes) for name in scene.drawn_materials)
    return (*dict.fromkeys((*earlier, *own)),)


def _backend(config: TrainConfig, resume: Resume | None) -> tuple[str, tuple[str, ...], str]:
    """Returns `torch` or `triton`, the precisions to try in order, and a line for the user with backend and precision.

    A training with precision `auto` resumes in the precision of its checkpoint.
    """
    training = config.training
    on_gpu = training.device != "cpu" and torch.cuda.is_available()
    device = torch.device("cuda" if on_gpu else "cpu")
    reasons = {
        "triton": triton_unsupported_reason(device, config.network, training.precision),
        "torch": torch_unsupported_reason(training.precision),
    }
    backend, report = pick(reasons, training.backend, training.precision, "training.backend")
    precisions = precisions_to_try(training.precision, device, backend)
    if resume is not None and resume.progress.precision in precisions:
        precisions = (resume.progress.precision,)
    return backend, precisions, f"{report}, precision {precisions[0]}"


def precompile_kernels(config: TrainConfig, resume: Resume | None, stack: ExitStack) -> Precompilation | None:
    """Starts to compile kernels during the wait for data, in the first process of a machine with GPUs."""
    training = config.training
    backend, precisions, _ = _backend(config, resume)
    on_gpu = training.device != "cpu" and torch.cuda.is_available() and torch.version.hip is None
    if backend != "triton" or not on_gpu or not first_on_machine():
        return None
    # imported here, because backend torch does without Triton
    from hgn.training.precompile import Precompilation

    devices, nodes = layout(training)
    config = replace(config, training=replace(training, precision=precisions[0]))
    return stack.enter_context(Precompilation(config, torch.cuda.get_device_capability(), devices * nodes > 1))


def settings_of_run(config: TrainConfig) -> dict[str, Any]:
    """Returns the settings, without passwords and other secrets."""
    mapping: dict[str, Any] = with_texts(to_mapping(config), printable)
    return mapping


def _write_run_files(config: TrainConfig, manifest: Manifest) -> None:
    """Writes the resolved configuration with the commit and the machine."""
    run = Path(config.run)
    make_folder(run)
    if not first_rank():
        return
    record = settings_of_run(config)
    record["provenance"] = provenance("cuda" if torch.cuda.is_available() else "cpu") | {
        "data_schema_version": manifest.schema_version,
        "data_config_hash": manifest.config_hash,
    }
    write_atomically(run / "config.yaml", yaml.safe_dump(record, sort_keys=False).encode())


def _report(config: TrainConfig, updates: int, last: dict[str, float], trained: bool, stopped: bool) -> None:
    if trained:
        print(f"trained {updates} of {config.training.maximum_updates} updates in {config.run}")
    else:
        print(f"{config.run} is finished: {updates} updates; training.maximum_updates above {updates} continues it")
    if "one_step/validation" in last:
        print(
            f"one-step validation MSE {last['one_step/validation']:.3e} on every fourth frame, "
            f"{format_ratio(last.get('baseline_ratio/validation', math.nan))} the best baseline's; few frames contain "
            "most of the error, so hgn.evaluate, which measures all frames, may print another ratio"
        )
    best = Path(config.run) / "checkpoints" / BEST_NAME
    if not outlived(best.exists, best):
        print(f"no {BEST_NAME}, because no validation scene was measured; export {best.with_name(LAST_NAMES[0])}")
    if stopped:
        print("stopped; the same command resumes it")
