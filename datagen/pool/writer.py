"""Writes episodes to shards: a finished episode is staged, and a shard is published when its range is complete.

Files are created atomically in the order `.staging/<key>.tar`, shard, manifest. Staged files are deleted last. So after
a crash the folder shows the remaining work, and no finished episode is simulated again. Published shards are synced. A
staged episode is synced only if its shard is still incomplete after 2 s; most are packed sooner. A power loss may lose
staged episodes that are not synced. Several generators may write to one folder: each claims the shards that it makes,
the first to publish an episode wins, and the manifest changes only under its lock.
"""

import dataclasses
import errno
import math
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

from datagen.pool.locks import ShardLocks
from datagen.pool.plan import (
    SceneTask,
    ShardRange,
    episode_key,
    generation_place,
    missing_ranges,
    parse_episode_key,
    parse_shard_name,
    scene_seed,
    work_order,
)
from datagen.pool.shard import STAGING_NAME, inspect_shard, join_tars, require_sealed, staged_path, sync_staged
from hgn.config import DatagenConfig
from hgn.data.identity import dataset_identity, identity_hash, require_same_dataset
from hgn.data.manifest import MANIFEST_NAME, SPLITS, Manifest, QuarantinedScene, ShardEntry
from hgn.schema import ConfigError
from hgn.system.files import (
    TEMPORARY_SUFFIX,
    make_folder,
    read_replaced,
    sync_file,
    sync_folder,
    temporary_file,
    temporary_target,
)
from hgn.system.machine import available_cpus

MAXIMUM_REPLACEMENTS = 20  # seeds tried for one episode before the scene settings are reported as the cause
STAGED_SECONDS = 2.0  # time after which a staged episode of an incomplete shard is synced by itself
PACKED_AT_ONCE = max(4, min(12, available_cpus() - 1))  # number of shards packed in parallel; 0.1 GB each


_Packed = tuple[ExitStack, Path, ShardEntry]


class DatasetWriter:
    """Writes one generator's shards to a data set folder, inside a `with` block.

    At its start the writer repairs the folder after a crash: it checks and lists complete shards that the index lacks,
    and removes partial files of ended writers. Raises: ConfigError for another data set or an altered file.

    A writer's *share* is the shards that it may make: with `dataset.array_tasks` a part of them, otherwise all.
    """

    def __init__(self, config: DatagenConfig, report: Callable[[str], None] = lambda message: None) -> None:
        self.config = config
        self.folder = Path(config.dataset.folder)
        self.identity = dataset_identity(config)
        self.config_hash = identity_hash(self.identity)
        self.requested = {split: config.dataset.scenes(split) for split in SPLITS}
        self.manifest = Manifest(config_hash=self.config_hash, config=self.identity, requested=self.requested)
        self._report = report
        tasks, task = config.dataset.array_tasks or 1, config.dataset.array_task or 0
        self._share = work_order(self.requested, config.dataset.episodes_per_shard)[task::tasks]
        self.total = sum(len(shard.indices) for shard in self._share)  # number of episodes
        self._in_share = {split: bytearray(count) for split, count in self.requested.items()}  # a byte per episode
        for shard in self._share:
            self._in_share[shard.split][shard.first : shard.stop] = b"\1" * len(shard.indices)
        self._begun = 0  # number of the share's first shards that are all published
        self._claimed: list[ShardRange] = []  # shards that this writer makes
        # for each staged episode of the claimed shards: the time of staging, or inf after the request to sync it
        self._staged: dict[tuple[str, int], float] = {}
        self._syncing: list[Future[None]] = []
        self._packers = ThreadPoolExecutor(PACKED_AT_ONCE, "packer")
        self._packing: dict[ShardRange, Future[_Packed]] = {}  # shards to publish next
        self._content = b""  # bytes of the manifest file that `manifest` was read from
        self._failures: list[QuarantinedScene] = []
        self._forget_published()

    def __enter__(self) -> "DatasetWriter":
        make_folder(self.folder)
        self._locks = ShardLocks(self.folder)
        try:
            make_folder(self.folder / STAGING_NAME)
            with self._locks.manifest():
                self._recover()
                self._sweep()
        except BaseException:
            self._locks.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._packers.shutdown(cancel_futures=True)
            for packing in self._packing.values():
                if not packing.cancelled() and packing.exception() is None:
                    packing.result()[0].close()
            with self._locks.manifest():
                self._sweep()
            staging = self.folder / STAGING_NAME
            with self._locks.alone() as alone:
                if alone and staging.is_dir() and not any(staging.iterdir()):
                    staging.rmdir()
        finally:
            self._locks.close()

    def claim_next(self) -> ShardRange | None:
        """Claims the next shard of the share that is neither published nor claimed by another generator.

        Its staged episodes are checked and kept. Returns None if there is no such shard now. Call it again later,
        because another generator may end without publishing its shards.
        """
        for shard in self._pending():
            if shard in self._claimed or not self._locks.take(shard):
                continue
            # its former owner may have published it, or ended before listing it
            with self._locks.manifest():
                self.refresh()
                self._list_unlisted(self._packed_names(shard))
            if missing_ranges([shard], self._published) != [shard]:
                self._locks.free(shard)
                continue
            self._claimed.append(shard)
            self._find_staged(shard)
            return shard
        return None

    def remaining(self) -> list[tuple[str, int]]:
        """Returns the episodes (split, index) of claimed shards that are not staged, in the order of simulation."""
        wanted = {(shard.split, index) for shard in self._claimed for index in shard.indices} - self._staged.keys()
        return sorted(wanted, key=lambda item: generation_place(*item))

    @property
    def has_claims(self) -> bool:
        """Returns whether this writer has claimed shards that are not yet published."""
        return bool(self._claimed)

    @property
    def done(self) -> int:
        """Returns the number of the share's episodes that are published, or staged in claimed shards."""
        return self._published_of_share + len(self._staged)

    @property
    def complete(self) -> bool:
        """Returns whether the share is published, by any generator."""
        return self._published_of_share == self.total

    def task(self, split: str, index: int) -> SceneTask:
        """Returns the scene to simulate for an episode, with the first seed that is not quarantined.

        Raises: ConfigError if too many seeds in a row could not be simulated.
        """
        key = episode_key(split, index)
        if len(self._failures) < self.manifest.shards.state.quarantined:
            self._failures = self.manifest.quarantined
        failures = [scene for scene in self._failures if scene.key == key]
        attempt = 1 + max((scene.attempt for scene in failures), default=-1)
        if attempt >= MAXIMUM_REPLACEMENTS:
            raise ConfigError(
                f"{key} could not be simulated with {attempt} seeds, the last because: {failures[-1].cause}; change "
                "the scene or mpm settings, with another out=..."
            )
        return SceneTask(split, index, attempt, scene_seed(self.config.dataset.seed, split, index, attempt))

    def quarantine(self, task: SceneTask, cause: str) -> SceneTask:
        """Records that a scene could not be simulated, and returns its replacement."""
        failure = QuarantinedScene(task.key, task.attempt, task.seed, cause)
        with self._locks.manifest():
            self.refresh()
            self._publish_list(quarantined=(failure,))
        return self.task(task.split, task.index)

    def add_staged(self, split: str, index: int) -> None:
        """Records that an episode was staged."""
        self._staged[split, index] = time.monotonic()

    def is_staged(self, split: str, index: int) -> bool:
        """Returns whether a staged file exists. A worker may die after staging and before its report."""
        return staged_path(self.folder, split, index).is_file()

    @property
    def packing(self) -> bool:
        """Returns whether shards are being packed."""
        return bool(self._packing)

    def publish_next(self) -> ShardEntry | None:
        """Packs claimed shards whose episodes are all staged, and publishes one that is packed.

        Returns its entry, or None if none is packed yet. Raises: OSError (a full disk). Then no partial file remains,
        and published shards are unchanged.
        """
        ready = [
            shard for shard in self._claimed if all((shard.split, index) in self._staged for index in shard.indices)
        ]
        self._sync_staged(ready, time.monotonic() - STAGED_SECONDS)
        # two shards per packer, so that none is idle while this thread lists packed shards
        for shard in ready[: 2 * PACKED_AT_ONCE]:
            if shard not in self._packing:
                self._packing[shard] = self._packers.submit(self._pack, shard)
        packed = next((shard for shard in ready if shard in self._packing and self._packing[shard].done()), None)
        if packed is None:
            return None
        entry = self._publish(packed)
        self._forget(packed)
        return entry

    def _sync_staged(self, ready: Sequence[ShardRange], before: float) -> None:
        """Syncs episodes staged before the time `before`, unless their shard is among the `ready` ones."""
        packed = {(shard.split, index) for shard in ready for index in shard.indices}
        for episode, since in self._staged.items():
            if since <= before and episode not in packed:
                self._staged[episode] = math.inf
                self._syncing.append(self._packers.submit(sync_staged, staged_path(self.folder, *episode)))
        for done in [syncing for syncing in self._syncing if syncing.done()]:
            self._syncing.remove(done)
            done.result()

    def _pack(self, shard: ShardRange) -> _Packed:
        """Writes and checks a temporary shard file. Returns a stack that deletes it, its path and its entry."""
        with ExitStack() as stack:
            temporary = stack.enter_context(temporary_file(self.folder / STAGING_NAME / shard.name))
            with temporary.open("wb") as file:
                join_tars(file, (staged_path(self.folder, shard.split, index) for index in shard.indices))
                sync_file(file)
            entry = inspect_shard(temporary, shard, self.config)
            return stack.pop_all(), temporary, entry

    def _publish(self, shard: ShardRange) -> ShardEntry:
        packing = self._packing.pop(shard)
        if winner := self._winner(shard):
            if packing.exception() is None:  # it fails if the winner has deleted the staged files
                packing.result()[0].close()
            return winner
        target = self.folder / shard.name
        stack, temporary, entry = packing.result()
        with stack, self._locks.manifest():
            if winner := self._winner(shard):
                return winner
            if not _link(temporary, target):
                entry = inspect_shard(target, shard, self.config)
            sync_folder(self.folder)
            self._publish_list((entry,))
        return entry

    def _winner(self, shard: ShardRange) -> ShardEntry | None:
        """Returns another generator's shard with these episodes, or None. It exists only if locks fail."""
        self.refresh()
        if missing_ranges([shard], self._published) == [shard]:
            return None
        other = next(other for other in self.manifest.shards if _overlap(shard, other))
        self._report(f"{other.name} was published by another generator; this copy is dropped")
        return other

    def _recover(self) -> None:
        if (self.folder / MANIFEST_NAME).exists():
            self.refresh()
            require_same_dataset(self.manifest.config, self.config, self.folder)
        shards = list(self.manifest.shards)
        present = [shard for shard in shards if self._is_present(shard)]
        if len(present) < len(shards):
            self._rewrite_list(present)
        self._list_unlisted({path.name for path in self.folder.glob("*.tar")} - {shard.name for shard in present})
        # a complete folder stays unchanged if fewer or the same episodes are requested
        asks_anew = self.requested != self.manifest.requested and not (self.complete and self.manifest.complete)
        if asks_anew or not (self.folder / MANIFEST_NAME).exists():
            self._publish_list()
        for path in (self.folder / STAGING_NAME).glob("*.tar"):
            episode = parse_episode_key(path.stem)
            if episode is None or not missing_ranges([episode], self._published):
                path.unlink(missing_ok=True)  # its publisher may delete it at the same time

    def _is_present(self, shard: ShardEntry) -> bool:
        path = self.folder / shard.name
        if not path.exists():
            self._report(f"{path} is listed in the index but missing; its episodes are generated again")
            return False
        size = path.stat().st_size
        if size != shard.bytes:
            raise ConfigError(
                f"{path} must have {shard.bytes} bytes, got {size}; delete it and run the generator again"
            )
        return True

    def _packed_names(self, shard: ShardRange) -> set[str]:
        """Returns the names of shards that overlap this range and have a leftover temporary file."""
        names = {temporary_target(path) for path in (self.folder / STAGING_NAME).glob(f".*{TEMPORARY_SUFFIX}")}
        ranges = {name: parse_shard_name(name) for name in names}
        return {name for name, other in ranges.items() if other is not None and _overlap(shard, other)}

    def _list_unlisted(self, names: set[str]) -> None:
        """Adds complete shards with these names to the index if it lacks them: their generator ended too early."""
        for name in sorted(names):
            shard, path = parse_shard_name(name), self.folder / name
            if shard is None or not path.exists():
                continue
            if missing_ranges([shard], self._published) != [shard]:
                other = next(other for other in self.manifest.shards if _overlap(shard, other))
                if other.name == name:
                    continue
                raise ConfigError(f"{path} overlaps {other.name}; move it out of the folder")
            self._publish_list((inspect_shard(path, shard, self.config),))
            self._report(f"{name} was published but not yet listed; checked and listed")

    def _find_staged(self, shard: ShardRange) -> None:
        """Checks the staged episodes of a newly claimed shard. Removes partial files of earlier runs."""
        for index in shard.indices:
            path = staged_path(self.folder, shard.split, index)
            for partial in path.parent.glob(f".{path.name}.*{TEMPORARY_SUFFIX}"):
                partial.unlink(missing_ok=True)
            if not path.exists():
                continue
            try:
                require_sealed(path)
                inspect_shard(path, ShardRange(shard.split, index, index + 1), self.config)
            except ConfigError as error:
                self._report(f"{error}; the episode is generated again")
                path.unlink()
            else:
                self.add_staged(shard.split, index)

    def _sweep(self) -> None:
        """Removes partial files of ended writers, whose shard or episode is not locked."""
        for folder in (self.folder, self.folder / STAGING_NAME):
            for path in folder.glob(f".*{TEMPORARY_SUFFIX}"):
                name = temporary_target(path)
                shard = parse_shard_name(name) or parse_episode_key(name.removesuffix(".tar"))
                if shard is None:  # the manifest, which is locked
                    path.unlink(missing_ok=True)
                elif self._locks.take(shard):
                    path.unlink(missing_ok=True)
                    if not any(_overlap(shard, claimed) for claimed in self._claimed):
                        self._locks.free(shard)

    def _pending(self) -> Iterator[ShardRange]:
        """Yields the ranges of the share that are not published."""
        for place in range(self._begun, len(self._share)):
            missing = missing_ranges(self._share[place : place + 1], self._published)
            if not missing and place == self._begun:
                self._begun += 1
            yield from missing

    def _forget_published(self) -> None:
        self._published = {split: bytearray(count) for split, count in self.requested.items()}  # a byte per episode
        self._listed = self._begun = self._published_of_share = 0
        self._failures = []

    def _note_published(self) -> None:
        """Adds the new shards of `manifest` to the published episodes."""
        for shard in self.manifest.shards.since(self._listed):
            published, in_share = self._published[shard.split], self._in_share[shard.split]
            published.extend(bytes(max(shard.stop - len(published), 0)))
            self._published_of_share += sum(in_share[shard.first : shard.stop])
            published[shard.first : shard.stop] = b"\1" * (shard.stop - shard.first)
        self._listed = len(self.manifest.shards)

    def refresh(self) -> None:
        """Reads the shards that other generators have published."""
        try:
            content = read_replaced(self.folder / MANIFEST_NAME)
        except FileNotFoundError:  # removed by hand; the next publication writes it again
            return
        if content != self._content:
            manifest = Manifest.parse(content, self.folder)
            if self._content:
                require_same_dataset(manifest.config, self.config, self.folder)
            before = self.manifest.shards
            if self._listed and manifest.shards.state.generation != before.state.generation:
                self._forget_published()
            self.manifest = dataclasses.replace(manifest, shards=before.continued(manifest.shards))
            self._note_published()
            self._content = content

    def _publish_list(self, shards: Sequence[ShardEntry] = (), quarantined: Sequence[QuarantinedScene] = ()) -> None:
        revision = self.manifest.revision + len(shards)
        self._take(
            self.manifest.extended(self.folder, shards, quarantined, revision=revision, requested=self.requested)
        )

    def _rewrite_list(self, shards: Sequence[ShardEntry]) -> None:
        manifest = dataclasses.replace(self.manifest, revision=self.manifest.revision + 1, requested=self.requested)
        self._forget_published()
        self._take(manifest.save(self.folder, shards, manifest.quarantined))

    def _take(self, manifest: Manifest) -> None:
        self.manifest, self._content = manifest, (self.folder / MANIFEST_NAME).read_bytes()
        self._note_published()

    def _forget(self, shard: ShardRange) -> None:
        for index in shard.indices:
            self._staged.pop((shard.split, index), None)
            staged_path(self.folder, shard.split, index).unlink(missing_ok=True)
        self._claimed.remove(shard)
        self._locks.free(shard)


def _overlap(one: ShardRange | ShardEntry, other: ShardRange | ShardEntry) -> bool:
    return one.split == other.split and one.first < other.stop and other.first < one.stop


def _link(temporary: Path, target: Path) -> bool:
    """Gives a finished file its name. Returns False if the name exists. Existing files are never replaced."""
    try:
        target.hardlink_to(temporary)
    except FileExistsError:
        return False
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.ENOTSUP, errno.EMLINK):
            raise
        if target.exists():
            return False
        shutil.move(temporary, target)  # there are no hard links; the manifest's lock excludes other writers
    return True
