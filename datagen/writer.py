"""Episodes to shards: each finished episode is staged at once, a shard is published when its range is complete.

Every file appears whole or not at all, in this order: `.staging/<key>.tar`, the shard, the manifest; staged files
go last. So after a crash at any point the state of the folder alone says what is left to do, and no finished
episode is simulated again. One generator at a time holds the folder's lock.
"""

from __future__ import annotations

import dataclasses
import errno
import fcntl
import io
import os
import shutil
import tarfile
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np

from datagen.plan import (
    SceneTask,
    ShardRange,
    episode_key,
    generation_order,
    missing_ranges,
    parse_shard_name,
    scene_seed,
    shard_ranges,
)
from hgn.config import DatagenConfig
from hgn.data.identity import dataset_identity, identity_hash, require_same_dataset
from hgn.data.manifest import MANIFEST_NAME, SPLITS, EpisodeEntry, Manifest, QuarantinedScene, ShardEntry
from hgn.data.reader import file_sha256, read_episode
from hgn.data.statistics import episode_statistics, merge_statistics
from hgn.files import TEMPORARY_SUFFIX, sync_folder, temporary_file
from hgn.scene.episode import Episode, encode_episode
from hgn.schema import ConfigError

STAGING_NAME = ".staging"
LOCK_NAME = ".lock"
# seeds tried for one episode before the scene distribution itself is held to be at fault
MAXIMUM_REPLACEMENTS = 20


def stage_episode(folder: Path, episode: Episode) -> None:
    """Writes `<folder>/.staging/<key>.tar` whole or not at all. Safe to call from worker processes.

    `episode.solver["dataset"]` holds `config_hash` and `attempt`, by which a later run knows the episode.
    Raises: OSError (a full disk), ConfigError (positions that are not finite).
    """
    target = folder / STAGING_NAME / f"{episode.key}.tar"
    members = encode_episode(episode)
    with temporary_file(target) as temporary:
        with temporary.open("wb") as file:
            write_tar(file, ((f"{episode.key}.{name}", len(data), io.BytesIO(data)) for name, data in members.items()))
        temporary.replace(target)
    sync_folder(target.parent)


def write_tar(file: BinaryIO, members: Iterable[tuple[str, int, Any]]) -> None:
    """Writes members (name, bytes, stream) as a tar and syncs it. The same members give the same bytes: no times, no
    owners, a fixed mode.
    """
    with tarfile.open(fileobj=file, mode="w", format=tarfile.GNU_FORMAT) as tar:
        for name, size, stream in members:
            info = tarfile.TarInfo(name)
            info.size, info.mtime, info.mode = size, 0, 0o644
            tar.addfile(info, stream)
    file.flush()
    os.fsync(file.fileno())


class DatasetWriter:
    """The one writer of a data set folder; a context manager that holds the folder's lock.

    Entering recovers what an earlier run left: partial files are removed, shards that are not yet in the manifest
    are checked and listed, staged episodes are checked and kept. Raises: ConfigError when the folder is in use, holds
    another data set, or holds a file that was altered.
    """

    def __init__(self, config: DatagenConfig, report: Callable[[str], None] = lambda message: None) -> None:
        self.config = config
        self.folder = Path(config.dataset.folder)
        self.identity = dataset_identity(config)
        self.config_hash = identity_hash(self.identity)
        self.requested = {split: config.dataset.scenes(split) for split in SPLITS}
        self.manifest = Manifest(config_hash=self.config_hash, config=self.identity, requested=self.requested)
        self._report = report
        self._lock: int | None = None
        self._staged: set[tuple[str, int]] = set()
        self._pending: list[ShardRange] = []

    def __enter__(self) -> DatasetWriter:
        self.folder.mkdir(parents=True, exist_ok=True)
        self._acquire_lock()
        try:
            self._recover()
        except BaseException:
            self._release_lock()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._remove_partial_files()
        staging = self.folder / STAGING_NAME
        if staging.is_dir() and not any(staging.iterdir()):
            staging.rmdir()
        self._release_lock()

    def remaining(self) -> list[tuple[str, int]]:
        """The episodes (split, index) that are neither published nor staged, in the order to simulate them."""
        wanted = {(shard.split, index) for shard in self._pending for index in shard.indices} - self._staged
        return [item for item in generation_order(self.requested) if item in wanted]

    @property
    def done(self) -> int:
        """How many of the requested episodes are published or staged."""
        return self.total - len(self.remaining())

    @property
    def total(self) -> int:
        return sum(self.requested.values())

    @property
    def complete(self) -> bool:
        """Whether every requested episode is published."""
        return not self._pending

    def task(self, split: str, index: int) -> SceneTask:
        """The scene to simulate for an episode: the first seed that is not quarantined.

        Raises: ConfigError when too many seeds in a row could not be simulated.
        """
        key = episode_key(split, index)
        failures = [scene for scene in self.manifest.quarantined if scene.key == key]
        attempt = 1 + max((scene.attempt for scene in failures), default=-1)
        if attempt >= MAXIMUM_REPLACEMENTS:
            raise ConfigError(
                f"{key} could not be simulated with {attempt} seeds, the last because: {failures[-1].cause}; change "
                "the scene or mpm settings, with another out=..."
            )
        return SceneTask(split, index, attempt, scene_seed(self.config.dataset.seed, split, index, attempt))

    def quarantine(self, task: SceneTask, cause: str) -> SceneTask:
        """Records that a scene could not be simulated and returns the one that takes its place."""
        failure = QuarantinedScene(task.key, task.attempt, task.seed, cause)
        manifest = dataclasses.replace(self.manifest, quarantined=(*self.manifest.quarantined, failure))
        manifest.save(self.folder)
        self.manifest = manifest
        return self.task(task.split, task.index)

    def add_staged(self, split: str, index: int) -> None:
        """Tells the writer that an episode was staged."""
        self._staged.add((split, index))

    def is_staged(self, split: str, index: int) -> bool:
        """Whether a staged file is there, told or not: a worker may die between the two."""
        return (self.folder / STAGING_NAME / f"{episode_key(split, index)}.tar").is_file()

    def publish_next(self) -> ShardEntry | None:
        """Publishes one shard whose episodes are all staged; None when there is no such shard.

        Raises: OSError (a full disk): nothing half-written is left and what was published stays untouched.
        """
        for shard in self._pending:
            if all((shard.split, index) in self._staged for index in shard.indices):
                entry = self._assemble(shard)
                self._commit((*self.manifest.shards, entry))
                self._forget(shard)
                return entry
        return None

    def _acquire_lock(self) -> None:
        descriptor = os.open(self.folder / LOCK_NAME, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(descriptor, 32).decode(errors="replace").strip() or "unknown"
            os.close(descriptor)
            raise ConfigError(
                f"{self.folder} is being written by another generator (process {holder}); wait until it has ended, "
                "or give another out=..."
            ) from None
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        self._lock = descriptor

    def _release_lock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _recover(self) -> None:
        if (self.folder / MANIFEST_NAME).exists():
            self.manifest = Manifest.load(self.folder)
            require_same_dataset(self.manifest.config, self.config, self.folder)
        self._remove_partial_files()
        shards = [shard for shard in self.manifest.shards if self._is_present(shard)]
        listed = {shard.name for shard in shards}
        for path in sorted(self.folder.glob("*.tar")):
            shard = parse_shard_name(path.name)
            if shard is not None and path.name not in listed:
                shards.append(self._adopt(path, shard, shards))
        planned = [
            shard
            for split in SPLITS
            for shard in shard_ranges(split, self.requested[split], self.config.dataset.episodes_per_shard)
        ]
        present = [ShardRange(shard.split, shard.first, shard.stop) for shard in shards]
        self._pending = missing_ranges(planned, present)
        changed = tuple(shards) != self.manifest.shards
        # a complete folder that is asked for less, or for the same again, stays as it is
        asks_anew = self.requested != self.manifest.requested and (self._pending or not self.manifest.complete)
        if changed:
            self._commit(tuple(shards))
        elif asks_anew or not (self.folder / MANIFEST_NAME).exists():
            self.manifest = dataclasses.replace(self.manifest, requested=self.requested)
            self.manifest.save(self.folder)
        self._find_staged({(shard.split, index) for shard in present for index in shard.indices})

    def _is_present(self, shard: ShardEntry) -> bool:
        path = self.folder / shard.name
        if not path.exists():
            self._report(f"{path} is listed in the manifest but missing; its episodes are made again")
            return False
        size = path.stat().st_size
        if size != shard.bytes:
            raise ConfigError(
                f"{path} must have {shard.bytes} bytes, got {size}; delete it and run the generator again"
            )
        return True

    def _adopt(self, path: Path, shard: ShardRange, shards: Iterable[ShardEntry]) -> ShardEntry:
        for other in shards:
            if other.split == shard.split and other.first < shard.stop and shard.first < other.stop:
                raise ConfigError(f"{path} overlaps {other.name}; move it out of the folder")
        self._report(f"{path.name} was published but not yet listed; checked and listed")
        return self._inspect(path, shard)

    def _find_staged(self, published: set[tuple[str, int]]) -> None:
        staging = self.folder / STAGING_NAME
        staging.mkdir(exist_ok=True)
        for path in sorted(staging.glob("*.tar")):
            split, _, number = path.stem.rpartition("-")
            item = (split, int(number)) if split in SPLITS and number.isdecimal() else None
            if item is None or item in published:
                path.unlink()
                continue
            try:
                self._inspect(path, ShardRange(split, item[1], item[1] + 1))
            except ConfigError as error:
                self._report(f"{error}; the episode is made again")
                path.unlink()
                continue
            self._staged.add(item)

    def _remove_partial_files(self) -> None:
        for folder in (self.folder, self.folder / STAGING_NAME):
            for path in folder.glob(f".*{TEMPORARY_SUFFIX}"):
                path.unlink()

    def _assemble(self, shard: ShardRange) -> ShardEntry:
        target = self.folder / shard.name
        with temporary_file(target) as temporary:
            with temporary.open("wb") as file:
                write_tar(file, self._staged_members(shard))
            entry = self._inspect(temporary, shard)
            _link(temporary, target)
        sync_folder(self.folder)
        return entry

    def _staged_members(self, shard: ShardRange) -> Iterable[tuple[str, int, Any]]:
        for index in shard.indices:
            path = self.folder / STAGING_NAME / f"{episode_key(shard.split, index)}.tar"
            with tarfile.open(path, mode="r:") as tar:
                for info in tar:
                    yield info.name, info.size, tar.extractfile(info)

    def _commit(self, shards: tuple[ShardEntry, ...]) -> None:
        manifest = dataclasses.replace(
            self.manifest, shards=shards, revision=self.manifest.revision + 1, requested=self.requested
        )
        manifest.save(self.folder)
        self.manifest = manifest

    def _forget(self, shard: ShardRange) -> None:
        self._pending.remove(shard)
        for index in shard.indices:
            self._staged.discard((shard.split, index))
            (self.folder / STAGING_NAME / f"{episode_key(shard.split, index)}.tar").unlink()

    def _inspect(self, path: Path, shard: ShardRange) -> ShardEntry:
        """Reads a tar back whole: every member, value and seed, and that it holds just this range of this data set."""
        located = locate_members(path)
        expected = [episode_key(shard.split, index) for index in shard.indices]
        if list(located) != expected:
            raise ConfigError(
                f"{path} must hold {', '.join(expected)}, got {', '.join(located) or 'nothing'}; delete it and run the "
                "generator again"
            )
        content = np.memmap(path, dtype=np.uint8, mode="r")
        entries, statistics = [], []
        for index, (key, members) in zip(shard.indices, located.items(), strict=True):
            episode, attempt = self._read_own_episode(path, content, key, members)
            seed = scene_seed(self.config.dataset.seed, shard.split, index, attempt)
            if episode.seed != seed or episode.frame_count != self.config.dataset.frames:
                raise ConfigError(
                    f"{path}: {key} must have seed {seed} and {self.config.dataset.frames} frames, got {episode.seed} "
                    f"and {episode.frame_count}; delete it and run the generator again"
                )
            entries.append(
                EpisodeEntry(key, index, seed, attempt, episode.particle_count, episode.frame_count, members)
            )
            statistics.append(episode_statistics(episode.position_TN3))
        return ShardEntry(
            name=shard.name,
            split=shard.split,
            first=shard.first,
            stop=shard.stop,
            sha256=file_sha256(path),
            bytes=path.stat().st_size,
            episodes=tuple(entries),
            statistics=merge_statistics(statistics),
        )

    def _read_own_episode(
        self, path: Path, content: np.ndarray, key: str, members: dict[str, tuple[int, int]]
    ) -> tuple[Episode, int]:
        episode = read_episode(content, path.name, key, members, scan_positions=True)
        origin = episode.solver.get("dataset")
        if not isinstance(origin, dict) or origin.get("config_hash") != self.config_hash:
            raise ConfigError(f"{path}: {key} belongs to another data set; move the file out of the folder")
        attempt = origin.get("attempt")
        if not isinstance(attempt, int):
            raise ConfigError(f"{path}: {key} must name its attempt, got {attempt!r}; delete it and run again")
        return episode, attempt


def locate_members(path: Path) -> dict[str, dict[str, tuple[int, int]]]:
    """Where each member's data lies in a tar: key -> name after `<key>.` -> (offset, bytes).

    Raises: ConfigError when the file is not a whole tar.
    """
    located: dict[str, dict[str, tuple[int, int]]] = {}
    try:
        with tarfile.open(path, mode="r:") as tar:
            for info in tar:
                key, _, name = info.name.partition(".")
                located.setdefault(key, {})[name] = (info.offset_data, info.size)
    except tarfile.TarError as error:
        raise ConfigError(f"{path} must be a whole tar, got {error}; delete it and run the generator again") from None
    return located


def _link(temporary: Path, target: Path) -> None:
    """Gives a finished file its name; the first writer wins, and a file that is there is never replaced."""
    try:
        target.hardlink_to(temporary)
    except FileExistsError:
        raise ConfigError(f"{target} appeared while it was being made; run the same command again") from None
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.ENOTSUP, errno.EMLINK):
            raise
        shutil.move(temporary, target)  # a file system without hard links; the lock keeps other writers away
