"""The data set of a training: its completeness, the wait for its episodes, and its progress."""

import contextlib
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from shutil import disk_usage

from hgn.config import SceneConfig, TrainConfig
from hgn.data.identity import identity_differences, physics_settings
from hgn.data.manifest import SPLITS, Manifest, errors_in_config
from hgn.data.pooled import AnyStore, PooledStore
from hgn.data.reader import EpisodeStore
from hgn.data.storage import is_remote
from hgn.schema import ConfigError, from_stored, printable, require
from hgn.system.machine import available_cpus
from hgn.system.patience import UnreachableError, standard_patience_s
from hgn.system.progress import advance_to, bar, duration
from hgn.system.ranks import first_rank
from hgn.training.generator import Generator
from hgn.training.stop import StopRequest

LONG_ON_A_CPU_S = 3600.0
WAY_OUT = (
    "on a CPU: +experiment=demo (minutes), a trial (run=runs/trial dataset.folder=data/trial "
    "dataset.training_scenes=2 dataset.validation_scenes=1 dataset.test_scenes=0 dataset.frames=24 "
    "training.batch_scenes=1 training.maximum_updates=60), or a GPU (a hundred times faster)"
)
# per particle and frame: CPU seconds of the solver on 64^3 cells (frame_cpu_images.json), and bytes in a shard
SOLVER_CPU_S, SHARD_BYTES = 1.8e-4, 14
MEAN_FILLING = 0.7  # mean number of particles of a group, divided by that of a full cube of the group's size
BETWEEN_LOOKS_S = 10.0  # interval between reads of the manifest for the progress line


def missing_scenes(config: TrainConfig, manifest: Manifest | None, splits: Sequence[str] = SPLITS) -> str:
    """Returns the numbers of published and configured scenes of incomplete splits, as `1 of 2 validation, 0 of 3 test`.

    The text is empty if every configured episode is published.
    """
    wanted = {split: config.dataset.scenes(split) for split in splits}
    published = {split: manifest.published(split) if manifest else 0 for split in splits}
    return ", ".join(
        f"{published[split]} of {wanted[split]} {split}" for split in splits if published[split] < wanted[split]
    )


def more_data(config: TrainConfig) -> list[EpisodeStore]:
    """Returns the training episodes of `training.more_data` that are published now.

    Raises: ConfigError for a data set that is missing, given twice, or incompatible with the others.
    """
    stores: list[EpisodeStore] = []
    for i, folder in enumerate(config.training.more_data):
        field = f"training.more_data[{i}]"
        others = (config.dataset.folder, *config.training.more_data[:i])
        require(folder not in others, field, "a data set that is not among the others", folder)
        store = EpisodeStore(folder, "train")
        require(len(store) > 0, field, "a data set with training episodes", folder)
        with errors_in_config(folder):
            _require_goes_with(config, store, field)
        stores.append(store)
    return stores


def _require_goes_with(config: TrainConfig, store: EpisodeStore, field: str) -> None:
    stored, folder, network = store.manifest.config, store.folder, config.network
    require("imported" not in stored and not config.imported, field, "left out for imported data", folder)
    scene = from_stored(SceneConfig, stored["scene"], "scene")
    rate = config.dataset.frame_rate_hz
    require(stored["frame_rate_hz"] == rate, field, f"data with {rate:g} frames per second", stored["frame_rate_hz"])
    cell_size = config.scene.cell_size
    require(scene.cell_size == cell_size, field, f"data with cells of {cell_size:g}", scene.cell_size)
    known_materials = set(scene.drawn_materials) <= set(network.materials)
    require(known_materials, field, f"data with only {', '.join(network.materials)}", list(scene.drawn_materials))
    seen = network.obstacle_features or scene.obstacle_count == 0
    require(seen, field, "data without obstacles, which the network does not see", folder)
    upright = scene.gravity == config.scene.gravity and scene.upright
    require(network.relative or upright, field, "data with the settings' gravity if network.inputs=absolute", folder)
    differences = identity_differences(stored["mpm"], physics_settings(config.datagen), "mpm")
    require(not differences, field, "data with the same mpm settings", f"{folder}, where {'; '.join(differences[:3])}")
    reference, own = stored.get("reference"), config.datagen.reference
    require(reference == own, field, f"data with the same reference grid ({own or 'none'})", reference)


def wait_for_episodes(
    config: TrainConfig, generator: Generator | None, stop: StopRequest, others: Sequence[EpisodeStore] = ()
) -> AnyStore | None:
    """Waits until enough training episodes are published, those of `others` included. Shows the progress.

    While the generator runs, it also waits for the first validation episode: otherwise a short training might end
    before one is published, without a best checkpoint.
    Returns None after a stop request; it then ends the generator, and prints what is missing and kept. Once the
    manifest has been read, later reads may fail for the standard patience.
    Raises: ConfigError if the generator failed, or if no process generates the missing episodes.
    """
    folder = config.dataset.folder
    present = sum(map(len, others))
    needed = max(0, min(config.training.minimum_episodes, config.dataset.training_scenes + present) - present)
    others_validate = any(store.manifest.published("validation") for store in others)
    # number of validation episodes made before the start, because the generator alternates between the splits
    validation = min(max(needed - 1, 0 if others_validate else 1), config.dataset.validation_scenes)
    if generator is None and first_rank() and not EpisodeStore.available(folder):
        raise ConfigError(
            f"dataset.folder must contain a data set, got {folder} without one; generate it with python -m datagen "
            f"out={folder}, or set training.generate=true"
        )
    progress, seen_s, missing = None, -math.inf, ""
    with contextlib.ExitStack() as shown:  # closes the bar
        while not (missing and stop.requested):
            # read before the manifest, which then has all episodes of a generator that has ended
            running = generator is not None and generator.running
            try:
                store = EpisodeStore(folder, "train") if EpisodeStore.available(folder) else None
                seen_s = time.monotonic()
            except (ConfigError, OSError):
                if time.monotonic() - seen_s > standard_patience_s():
                    raise
                time.sleep(0.5)
                continue
            awaited = min(1, validation) if running else 0
            train, validated = (len(store), store.manifest.published("validation")) if store is not None else (0, 0)
            missing = f"{max(0, needed - train)} training and {max(0, awaited - validated)} validation scenes"
            if stop.requested:
                break
            if store is not None and train >= needed and validated >= awaited:
                if progress is not None:
                    progress.close()
                    if generator is not None and (frames := generator.frames_done()):
                        present, seconds = generator.present + generator.found, progress.format_dict["elapsed"]
                        print(estimate(config, frames, present, seconds), file=sys.stderr)
                return PooledStore(store, others) if others else store
            if generator is not None:
                if not running:
                    generator.check()
                    raise ConfigError(
                        f"training.minimum_episodes must be reachable, got {needed} for a data set of "
                        f"{train}; generate more scenes"
                    )
            elif first_rank() and (not is_remote(folder) or (store is not None and store.manifest.complete)):
                raise ConfigError(
                    f"dataset.folder must contain {needed} training episodes, got {train} in "
                    f"{folder}; generate them, or set training.generate=true"
                )
            if progress is None and first_rank():
                print(printable(f"waiting for {missing} in {folder}"), file=sys.stderr)
                total = (needed + validation) * config.dataset.frames
                initial = (min(train, needed) + min(validated, validation)) * config.dataset.frames
                progress = shown.enter_context(bar("generating", total, initial, "frame"))
            if progress is not None and generator is not None:
                frames = progress.initial + generator.frames_done() + generator.found * config.dataset.frames
                advance_to(progress, min(max(frames, progress.n), progress.total))
            time.sleep(0.5)
    kept = sum(map(store.manifest.published, SPLITS)) if store is not None else 0
    lost = ""
    if generator is not None:
        generator.stop()
        kept, lost = max(kept, generator.kept), ", interrupted simulations start again"
    if first_rank():
        scenes = sum(map(config.dataset.scenes, SPLITS))
        text = f"stopped while waiting for {missing}; {kept} of {scenes} scenes {'is' if kept == 1 else 'are'} kept"
        print(f"{text}{lost}; the same command resumes", file=sys.stderr)
    return None


def warning_on_a_cpu(config: TrainConfig, manifest: Manifest | None) -> str | None:
    """Returns a warning with the time and space that missing episodes need on a CPU; None if less than an hour."""
    scene = config.scene
    published = sum(map(manifest.published, SPLITS)) if manifest is not None else 0
    scenes = sum(map(config.dataset.scenes, SPLITS)) - published
    of_group = MEAN_FILLING * scene.particles_per_cell * (scene.group_size / scene.cell_size) ** 3
    particle_frames = scenes * config.dataset.frames * scene.group_count * of_group
    seconds = particle_frames * SOLVER_CPU_S / available_cpus()
    if seconds < LONG_ON_A_CPU_S:
        return None
    space = f"{particle_frames * SHARD_BYTES / 1e9:.2g} GB"
    updates = f"before most of {config.training.maximum_updates:,} updates"
    return f"no GPU: {scenes} scenes take roughly {duration(seconds)} and {space} here, {updates}; {WAY_OUT}"


def estimate(config: TrainConfig, frames: int, present: int, seconds: float) -> str:
    """Returns the remaining time and the size of the data set, of which `frames` were simulated in `seconds`.

    `present` episodes were not: earlier runs or other generators made them.
    """
    folder = Path(config.dataset.folder)
    scenes = sum(config.dataset.scenes(split) for split in SPLITS)
    published = sum(Manifest.load(folder).published(split) for split in SPLITS)
    size = scenes * sum(path.stat().st_size for path in folder.glob("*-*.tar")) / published
    left_s = max(0.0, (scenes - present) * config.dataset.frames / frames - 1) * seconds
    space = f"{size / 1e9:.2g} GB in all, {disk_usage(folder).free / 1e9:.2g} GB are free"
    return f"about {duration(left_s)} for the rest of {scenes} scenes, while training continues; {space}"


class PublishedEpisodes:
    """Returns the progress of the data set when called: `5/800 episodes`.

    The manifest is read at most every BETWEEN_LOOKS_S, because a read takes 0.1 s, and not after all training episodes
    are published.
    """

    def __init__(self, config: TrainConfig, generator: Generator | None) -> None:
        self.folder, self.total = config.dataset.folder, config.dataset.training_scenes
        self.generator = generator
        self._looked_at_s, self._text = -math.inf, ""

    def __call__(self) -> str:
        if time.monotonic() - self._looked_at_s < BETWEEN_LOOKS_S:
            return self._text
        try:
            count = Manifest.load(self.folder, patience_s=0.0).published("train")
        except (ConfigError, OSError) as error:  # the data module ends a training whose data stay unreachable
            away = isinstance(error, UnreachableError)
            count, self._text = 0, "the service does not answer" if away else "the manifest cannot be read"
        else:
            ended = self.generator is not None and not self.generator.running and count < self.total
            self._text = f"{count}/{self.total} episodes{', generator stopped' if ended else ''}"
        self._looked_at_s = math.inf if count >= self.total else time.monotonic()
        return self._text
