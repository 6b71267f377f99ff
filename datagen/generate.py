"""One run of the generator on a folder, until its part of the data set is published or a stop is requested."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any

from datagen.pool.local_workers import LocalWorkerFactory
from datagen.pool.pool import Pool, Stopped
from datagen.pool.progress import Progress
from datagen.pool.worker import Backend, WorkerFactory
from datagen.pool.worker_plan import plan_workers, visible_gpus
from datagen.pool.writer import DatasetWriter
from hgn.config import DatagenConfig
from hgn.data.fresh import draw_fresh
from hgn.renamed import removed_remedy
from hgn.schema import ConfigError, from_mapping, known_keys, require
from hgn.system.machine import available_cpus, available_memory
from hgn.system.signals import ENDING, Signals

_SECTIONS = ("scene", "mpm", "dataset")
# keys of the command that belong to the section `dataset`, with their names there
_OF_DATASET = {"scenes": "training_scenes", "out": "folder"}
# experiment files serve all commands; these keys are ignored, because only hgn.train needs them
_OTHERS = ("frozen", "name", "network", "step", "training", "progress")


def stop_signals() -> Signals:
    """Returns a record of signals, so that current writes are finished."""
    return Signals(numbers=ENDING)


def datagen_config(mapping: Mapping[str, Any], others: Sequence[str] = ()) -> DatagenConfig:
    """Returns the generator's configuration from a composed one. With `frozen` its seed is drawn.

    Raises: ConfigError, also for a key that is neither a generator's nor one of `others`, which the caller reads.
    """
    names = (*_SECTIONS, *_OF_DATASET, *_OTHERS, *others)
    for key, value in mapping.items():
        if key not in names:
            remedy = removed_remedy("datagen", key, value) or known_keys(key, names)
            raise ConfigError(f"{key} is not a known key; {remedy}")
    sections = {name: mapping[name] for name in _SECTIONS if name in mapping}
    dataset = {name: mapping[key] for key, name in _OF_DATASET.items() if key in mapping}
    config = from_mapping(DatagenConfig, sections | {"dataset": {**mapping.get("dataset", {}), **dataset}})
    weights = mapping.get("frozen")
    if not weights:
        return config
    require(isinstance(weights, list), "frozen", "a list of weights files, as in [a.safetensors]", weights)
    require(config.dataset.seed == 0, "dataset.seed", "left out with frozen, which draws it", config.dataset.seed)
    require_local_folder(config)
    seed = draw_fresh(config.dataset.folder, weights).seed
    return replace(config, dataset=replace(config.dataset, seed=seed))


def require_local_folder(config: DatagenConfig) -> None:
    """Raises ConfigError if the folder to write to is a URL. Remote folders can only be read."""
    folder = config.dataset.folder
    require("://" not in folder, "out", "a folder to write to", folder, "a URL can only be read, by hgn.train")


def generate(
    config: DatagenConfig,
    progress: Progress,
    should_stop: Callable[[], bool],
    backend: Backend | None = None,
    early: bool = False,
) -> bool:
    """Generates the missing episodes. Returns False after a stop request; the same folder can be resumed.

    With `early` a GPU starts with few scenes, because a reader waits for the first episodes; the run takes longer.
    Raises: ConfigError, OSError, RuntimeError. Published and staged episodes are kept in every case.
    """
    require_local_folder(config)
    backend = backend or Backend()
    with DatasetWriter(config, progress.message) as writer:
        if not writer.complete:
            try:
                with _workers(config, backend, early) as factory:
                    Pool(writer, progress, factory, should_stop).run()
            except Stopped:
                progress.message(
                    f"stopped; {writer.done} of {writer.total} episodes are kept in {writer.folder}: run the same "
                    "command to resume; only interrupted simulations start again"
                )
                return False
        progress.message(_summary(config, writer))
    return True


def _workers(config: DatagenConfig, backend: Backend, early: bool) -> AbstractContextManager[WorkerFactory]:
    if config.dataset.pool == "ray":
        from datagen.pool.ray_workers import RayWorkerFactory

        return RayWorkerFactory(config, backend, early)
    plan = plan_workers(config, visible_gpus(), available_cpus(), available_memory(), early=early)
    return nullcontext(LocalWorkerFactory(config, backend, plan))


def _summary(config: DatagenConfig, writer: DatasetWriter) -> str:
    counts = ", ".join(f"{writer.manifest.published(split)} {split}" for split in writer.requested)
    task, tasks = config.dataset.array_task, config.dataset.array_tasks
    if task is not None and not writer.manifest.complete:
        return f"part {task} of {tasks} of {writer.folder} is complete; published so far: {counts} episodes"
    return f"{writer.folder} is complete: {counts} episodes"
