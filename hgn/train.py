"""python -m hgn.train +experiment=obstacles: trains a network, and generates its data.

A run is a folder. The same command resumes it. On Ctrl-C, SIGTERM or SIGUSR1 the next update saves, and the run ends.
"""

from __future__ import annotations

import signal
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hgn.command import run_command
from hgn.config import TrainConfig
from hgn.schema import ConfigError, from_mapping, printable, require, require_replaceable
from hgn.system.extras import missing_extra, require_installed
from hgn.system.loading import loading
from hgn.system.locks import locked
from hgn.system.patience import AwayError, outlived
from hgn.system.processes import die_with_parent
from hgn.system.ranks import first_on_machine, first_rank

if TYPE_CHECKING:
    from hgn.network.base import ParticleNetwork
    from hgn.runtime.weights import WeightsInfo
    from hgn.training.checkpoint import DamagedError, Resume


def main(mapping: dict[str, Any]) -> int:
    """Trains with the resolved configuration. Returns the exit code."""
    with loading():
        import torch

        from hgn.data.identity import require_same_dataset
        from hgn.data.manifest import Manifest
        from hgn.data.reader import EpisodeStore
        from hgn.data.storage import is_remote
        from hgn.training.dataset import (
            PublishedEpisodes,
            missing_scenes,
            more_data,
            wait_for_episodes,
            warning_on_a_cpu,
        )
        from hgn.training.distributed import default_run, layout
        from hgn.training.generator import Generator
        from hgn.training.imported import require_network_fits, settings_of_imported
        from hgn.training.session import Start, precompile_kernels, train_network
        from hgn.training.stop import StopRequest

    require_installed("lightning")
    name = mapping.pop("name", "unnamed")
    require(isinstance(name, str) and name != "", "name", "text", name, "put it in quotes")
    if mapping.get("run") is None:
        mapping["run"] = str(default_run(name))
    config = from_mapping(TrainConfig, settings_of_imported(mapping))
    folder, run = config.dataset.folder, Path(config.run)
    outlived(lambda: require_replaceable("run", run / "config.yaml"), run / "config.yaml", start=True)
    if not first_on_machine():
        # If the process that started this rank ends, the rank ends immediately instead of after a time-out.
        die_with_parent(signal.SIGKILL)
    layout(config.training)
    for i, logger in enumerate(config.training.loggers):
        try:
            require_installed(logger)
        except ModuleNotFoundError as error:
            raise ConfigError(
                f"training.loggers[{i}] must be installed, got {logger}; {missing_extra(error)}"
            ) from None
    manifest = Manifest.load(folder) if config.imported or EpisodeStore.available(folder) else None
    if manifest is not None and config.imported:
        require_network_fits(config, manifest)
    elif manifest is not None:
        require_same_dataset(manifest.config, config.datagen, folder, "dataset.folder=...")
    others = more_data(config)
    with ExitStack() as stack:
        if first_rank():
            refusal = "another training is in it; wait for its end, or choose"
            outlived(lambda: stack.enter_context(locked(run / ".lock", "run", refusal)), run / ".lock", start=True)
        checkpoints = run / "checkpoints"
        resume = outlived(lambda: _checkpoint_to_resume(config, checkpoints), checkpoints, start=True)
        initial = _initial_network(config, resume)
        stop = StopRequest()
        stop.listen()  # a signal before ends the process at once, also while it waits for its checkpoints
        generator = None
        # A URL is a service that generates missing episodes itself.
        if first_rank() and config.training.generate and not is_remote(folder) and missing_scenes(config, manifest):
            on_gpu = config.training.device != "cpu" and torch.cuda.is_available()
            if not on_gpu and (warning := warning_on_a_cpu(config, manifest)):
                print(warning, file=sys.stderr)
            generator = Generator(config.datagen, run / "datagen")
            stack.callback(generator.stop)
        precompilation = precompile_kernels(config, resume, stack)
        store = wait_for_episodes(config, generator, stop, others)
        if store is None:
            return stop.exit_code
        missing = missing_scenes(config, store.manifest, ("train", "validation"))
        if first_rank() and generator is None and missing:
            print(printable(f"{folder} has {missing} scenes, and this training generates none"), file=sys.stderr)
        stop.restart_clock(config.training.maximum_minutes)
        start = Start(store, resume, initial, precompilation)
        return train_network(config, start, stop, PublishedEpisodes(config, generator))


def _checkpoint_to_resume(config: TrainConfig, folder: Path) -> Resume | None:
    """Returns the run's last undamaged checkpoint, or None before its first. Call it before other processes start.

    Raises DamagedError if all checkpoints are damaged, AwayError if all are missing.
    """
    from hgn.data.identity import dataset_identity, identity_hash
    from hgn.data.manifest import Manifest
    from hgn.training.checkpoint import (
        LAST_NAMES,
        SAVED,
        DamagedError,
        Progress,
        Resume,
        check_checkpoint,
        data_of_checkpoint,
        read_checkpoint,
    )

    damaged: DamagedError | None = None
    for path in (folder / name for name in LAST_NAMES if (folder / name).exists()):
        try:
            checkpoint = read_checkpoint(path)
            break
        except DamagedError as error:
            print(f"{error}; trying the previous one", file=sys.stderr)
            damaged = damaged or error
    else:
        if damaged is not None:
            raise damaged
        if (mark := folder.parent / SAVED).exists():
            raise AwayError(
                f"run must be a folder with the checkpoints that it has saved, got none in {folder}; restore them, "
                f"choose another run=FOLDER, or delete {mark} to begin at update 0"
            )
        return None
    if config.imported:
        config_hash = Manifest.load(config.dataset.folder).config_hash
    else:
        config_hash = identity_hash(dataset_identity(config.datagen))
    check_checkpoint(checkpoint, config, config_hash, path)
    progress = Progress.of(checkpoint)
    if first_rank():
        print(f"resuming at update {progress.updates}", file=sys.stderr)
    return Resume(path, progress, data_of_checkpoint(checkpoint).materials)


def _initial_network(config: TrainConfig, resume: Resume | None) -> tuple[ParticleNetwork, WeightsInfo] | None:
    """Returns the network of training.init_weights for a new run. A resumed run takes the network of its checkpoint."""
    from hgn.training.checkpoint import network_of_weights

    weights = config.training.init_weights
    if weights is None:
        return None
    if resume is not None:
        if first_rank():
            print(f"training.init_weights={weights} is not read: the run continues from {resume.path}", file=sys.stderr)
        return None
    initial = network_of_weights(config)
    if first_rank():
        print(f"starting with the weights and the normaliser of {weights}", file=sys.stderr)
    return initial


if __name__ == "__main__":
    run_command(main, "train")
