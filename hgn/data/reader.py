"""Reads published episodes of a data set. No file is mapped: one that was cut would end the process.

Each shard is checked against the index (size, then sha256) before use. Without this check a tar file that ends too
early, between two members, would be read as fewer samples. Remote shards come from a cache (`hgn.data.shard_cache`).
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from heapq import nsmallest
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np

from hgn.data.entries import REMEDY
from hgn.data.manifest import MANIFEST_NAME, SPLITS, EpisodeEntry, Manifest, ShardEntry
from hgn.data.statistics import Statistics
from hgn.data.storage import Storage, StorageError, ask, asked_once, faults_outlived, is_remote, open_storage, outliving
from hgn.scene.episode import POSITION_MEMBER, Episode, decode_episode
from hgn.schema import ConfigError, printable, require
from hgn.system.patience import UnreachableError, standard_patience_s

T = TypeVar("T")
REMOVED_AT_MOST = 10  # number of fetches of a shard that other processes remove before it is read
AGAIN_S, FORGOTTEN_S = 1.0, 60.0  # interval of reads after a fault of the manifest; time until the fault is forgotten


class Episodes(Sequence[Episode], ABC):
    """Defines a sequence of episodes.

    A shard is verified when an episode of it is first read. Positions are read-only.
    Raises on access: ConfigError if a shard is missing or altered.
    """

    @abstractmethod
    def read(self, index: int) -> Episode:
        """Returns the episode at an index from 0."""

    @property
    @abstractmethod
    def entries(self) -> Iterator[EpisodeEntry]:
        """Returns the index entries of all episodes (key, particles, frames), read without opening a shard."""

    def first_indices(self, count: int, published: int | None = None) -> list[int]:
        """Returns the places of the episodes with the lowest indices among the first `published` (None: all)."""
        places = ((entry.index, place) for place, entry in enumerate(islice(self.entries, published)))
        return [place for _, place in nsmallest(count, places)]

    @overload
    def __getitem__(self, index: int) -> Episode: ...

    @overload
    def __getitem__(self, index: slice) -> list[Episode]: ...

    def __getitem__(self, index: int | slice) -> Episode | list[Episode]:
        if isinstance(index, slice):
            return [self.read(i) for i in range(len(self))[index]]
        return self.read(range(len(self))[index])


class EpisodeStore(Episodes):
    """Reads the published episodes of one split of a data set, in publication order. Their number only grows.

    For spawned workers it is pickled with folder, split and manifest.
    """

    _fetcher: threading.Thread | None = None
    _faulty_since: float | None = None  # time of the manifest's first fault
    _looked_s = 0.0
    _lock: threading.Lock
    _wanted: list[ShardEntry]  # shards to fetch next
    _spared: frozenset[str]  # sha256 of shards that stay in a full cache

    def __init__(self, folder: Path | str, split: str) -> None:
        """Raises: ConfigError if there is no readable manifest or the split is unknown; UnreachableError."""
        require(split in SPLITS, "split", f"one of {', '.join(SPLITS)}", split)
        self.folder = folder
        self.split = split
        self.manifest = Manifest.load(self.folder)
        self._reset()

    @staticmethod
    def available(folder: Path | str) -> bool:
        """Returns whether a data set exists there, complete or not, with or without shards.

        Raises: ConfigError if access is refused; UnreachableError.
        """
        try:
            open_storage(folder).manifest(MANIFEST_NAME)
        except (FileNotFoundError, NotADirectoryError):
            return False
        return True

    def of_split(self, split: str) -> EpisodeStore:
        """Returns another split of the same data set without a request to the server."""
        require(split in SPLITS, "split", f"one of {', '.join(SPLITS)}", split)
        store = EpisodeStore.__new__(EpisodeStore)
        store.__setstate__(self.__getstate__() | {"split": split})
        return store

    def refresh(self) -> bool:
        """Reads the manifest again. Returns whether this split has more episodes than before.

        If a server does not answer, the store keeps its present episodes. Any other fault raises an error. Inside
        `faults_outlived`, a fault raises only if it lasts longer than the patience; until then `ask_again` refreshes.
        Raises: ConfigError if the folder contains another data set, or published shards were removed.
        """
        previous_s, self._looked_s = self._looked_s, time.monotonic()
        try:
            before, self.manifest = len(self), self._later_manifest()
        except UnreachableError as error:
            self._tell(f"{error.filename}: {error.strerror}; continuing with {len(self)} episodes")
            return False
        except (ConfigError, OSError) as error:
            patience_s = standard_patience_s()
            if self._looked_s - previous_s > patience_s + FORGOTTEN_S:  # the fault may have ended since
                self._faulty_since = None
            since = self._looked_s if self._faulty_since is None else self._faulty_since
            if not outliving():
                raise
            if self._looked_s - since > patience_s:
                raise StorageError(str(error)) from error
            if self._faulty_since is None:
                self._tell(f"{error}; continuing with {len(self)} episodes for {patience_s:.0f} s")
            self._faulty_since = since
            return False
        self._faulty_since = None
        return len(self) > before

    def _tell(self, text: str) -> None:
        print(printable(text), file=sys.stderr)

    def ask_again(self) -> None:
        """Refreshes after a fault, at most once a second. Raises: as `refresh`."""
        if self._faulty_since is not None and time.monotonic() - self._looked_s > AGAIN_S:
            self.refresh()

    @asked_once()
    def _later_manifest(self) -> Manifest:
        manifest = Manifest.load(self.folder, patience_s=0.0)
        if manifest.config_hash != self.manifest.config_hash:
            raise ConfigError(
                f"{self.folder} must contain the same data set as before, got config hash {manifest.config_hash[:12]} "
                f"instead of {self.manifest.config_hash[:12]}; start again"
            )
        manifest = replace(manifest, shards=self.manifest.shards.continued(manifest.shards))
        if not manifest.shards.continues(self.manifest.shards, self.split):
            raise ConfigError(
                f"{self.folder} must keep the {self.split} shards already published, got a manifest (revision "
                f"{manifest.revision}) without some of them; start again"
            )
        if manifest.shards.state != self.manifest.shards.state:
            _ = manifest.shards[-1:]  # a faulty manifest names an index that cannot be read
        return manifest

    def within_reach(self, indices: Sequence[int], patience_s: float) -> bool:
        """Fetches the shards of these episodes. Returns False if a server does not answer within the patience.

        Raises: ConfigError if a shard is missing or altered.
        """
        for shard in self._shards(indices):
            try:
                self._bring(shard, Path, patience_s=patience_s)
            except UnreachableError:
                return False
        return True

    def fetch_ahead(self, episodes: Sequence[int] | None = None) -> None:
        """Starts to fetch shards in the background, one after the other. A folder needs no fetching.

        It fetches all published shards, or those of `episodes` in order. Only for the latter does a full cache remove
        shards.
        """
        if not is_remote(self.folder):
            return
        with self._lock:
            if episodes is not None:
                self._wanted = self._shards(episodes)
                self._spared = frozenset(shard.sha256 for shard in self._wanted)
            elif self._fetched == len(self.manifest.shards):
                return
            if self._fetcher is None or not self._fetcher.is_alive():
                target = self._fetch_all if episodes is None else self._fetch_wanted
                self._fetcher = threading.Thread(target=target, name="shards", daemon=True)
                self._fetcher.start()

    def _fetch_all(self) -> None:
        with contextlib.suppress(ConfigError, OSError):  # a reader that needs the shard raises the same error
            for shard in self.manifest.shards.since(self._fetched):
                if shard.split == self.split:
                    self._bring(shard, Path, spared=None)
                self._fetched += 1

    def _fetch_wanted(self) -> None:
        with contextlib.suppress(ConfigError, OSError):  # as in _fetch_all
            while True:
                with self._lock:
                    if not self._wanted:
                        self._fetcher = None
                        return
                    shard, spared = self._wanted.pop(0), self._spared
                self._bring(shard, Path, spared=spared)

    def digest(self, count: int) -> str | None:
        """Returns a digest of the first `count` episodes, or None if no shard ends with the last of them."""
        return self.manifest.shards.digest(self.split, count)

    @property
    def entries(self) -> Iterator[EpisodeEntry]:
        return (entry for shard in self.manifest.shards_of(self.split) for entry in shard.episodes)

    def frames(self, count: int | None = None) -> list[int]:
        """Returns the frame counts of the first `count` episodes (None: all). Reads the index unless all are equal."""
        count, config = len(self) if count is None else count, self.manifest.config
        if "frames" in config and "long_fraction" not in config:
            return [config["frames"]] * count
        for shard in self.manifest.shards.since(self._measured):
            self._frames += [entry.frames for entry in shard.episodes if shard.split == self.split]
            self._measured += 1
        return self._frames[:count]

    def particles(self, episodes: Sequence[int]) -> list[int]:
        """Returns the particle counts of these episodes from the index."""
        return self.manifest.shards.particles(self.split, episodes)

    def statistics(self) -> Statistics:
        """Returns mean and standard deviation of velocity and acceleration of this split, in frame units."""
        return self.manifest.statistics(self.split)

    def __len__(self) -> int:
        return self.manifest.published(self.split)

    def __getstate__(self) -> dict[str, Any]:
        return {"folder": self.folder, "split": self.split, "manifest": self.manifest}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._reset()

    def _reset(self) -> None:
        self._scanned: set[str] = set()  # keys of episodes whose positions were checked to be finite
        self._fetcher = None
        self._faulty_since = None
        self._frames: list[int] = []  # frame counts of the episodes in the first shards, if they differ
        self._measured = 0  # number of these shards, with those of other splits
        self._fetched = 0  # number of shards that _fetch_all has finished with
        self._wanted, self._spared = [], frozenset()
        self._lock = threading.Lock()

    def _bring(self, shard: ShardEntry, use: Callable[[Path], T], **options: Any) -> T:
        """Returns the result of `use` for a shard's verified file. Options and errors as for `Storage.shard`."""

        def bring(files: Storage) -> T:
            return use(files.shard(shard.name, shard.sha256, shard.bytes, **options))

        def bring_again(files: Storage) -> T:
            for _ in range(REMOVED_AT_MOST - 1):
                with contextlib.suppress(FileNotFoundError):  # another process has removed it from a full cache
                    return bring(files)
            return bring(files)

        return ask(self.folder, bring_again)

    def _locate(self, index: int) -> tuple[ShardEntry, EpisodeEntry]:
        return self.manifest.shards.locate(self.split, index)

    def _shards(self, indices: Sequence[int]) -> list[ShardEntry]:
        """Returns the shards of these episodes in order, each once."""
        return list({shard.name: shard for shard, _ in map(self._locate, indices)}.values())

    def read(self, index: int) -> Episode:
        shard, entry = self._locate(index)
        stop = min(max((offset + size for offset, size in entry.members.values()), default=0), shard.bytes)
        start = max(0, min([stop, *(offset for offset, _ in entry.members.values())]))
        content = self._bring(shard, lambda path: open_storage(path.parent).read(path.name, start, stop))
        members = {name: (offset - start, size) for name, (offset, size) in entry.members.items()}
        return self._read(np.frombuffer(content, np.uint8), shard, replace(entry, members=members))

    def _read(self, content: np.ndarray, shard: ShardEntry, entry: EpisodeEntry) -> Episode:
        scan = entry.key not in self._scanned  # verified bytes may contain positions that are not finite
        try:
            episode = read_episode(content, shard.name, entry.key, entry.members, scan_positions=scan)
        except ConfigError as error:
            text = f"{self.folder}/{shard.name} must be a valid shard, got {error}; delete it, and {REMEDY}"
            raise StorageError(text) from None
        self._scanned.add(entry.key)
        config = self.manifest.config
        rate = episode.frame_rate_hz
        actual = (episode.seed, episode.particle_count, episode.frame_count, rate)
        expected = (entry.seed, entry.particles, entry.frames, config.get("frame_rate_hz", rate))
        # imported episodes have any length
        frames = config.get("frames", entry.frames)
        lengths = {frames, config.get("long_frames", frames)}
        if actual != expected or entry.frames not in lengths:
            raise StorageError(
                f"{self.folder}/{shard.name}: {entry.key} must have seed, particles, frames, frame_rate_hz "
                f"{expected}, and frames must be one of the data set's ({lengths}), got {actual}; {REMEDY}"
            )
        return episode


class FileBytes:
    """The bytes of a file. A slice is read, not mapped: a map ends the process if the file becomes shorter."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __len__(self) -> int:
        return self._path.stat().st_size

    def __getitem__(self, part: slice) -> np.ndarray:
        return np.fromfile(self._path, np.uint8, part.stop - part.start, offset=part.start)


def read_episode(
    shard_bytes: np.ndarray | FileBytes,
    shard_name: str,
    key: str,
    located: Mapping[str, tuple[int, int]],
    scan_positions: bool = False,
) -> Episode:
    """Decodes an episode from a shard's bytes (flat uint8). Positions are a view of an array.

    `located` gives offset and size of each member. Raises: ConfigError if a member is not within the bytes.
    """
    members: dict[str, bytes | np.ndarray] = {}
    for member, (offset, size) in located.items():
        data = shard_bytes[offset : offset + size]
        if min(offset, size) < 0 or len(data) != size:
            raise ConfigError(
                f"{shard_name}: {key}.{member} must lie within {len(shard_bytes)} bytes, got offset {offset} and "
                f"{size} bytes; {REMEDY}"
            )
        members[member] = data if member == POSITION_MEMBER else data.tobytes()
    return decode_episode(key, members, scan_positions)


def first_episodes(store: EpisodeStore, count: int) -> list[Episode]:
    """Returns the `count` episodes with the lowest indices. Raises: ConfigError if there are none."""
    if not len(store):
        others = ", ".join(f"split={split}" for split in SPLITS if len(store.of_split(split)))
        remedy = f"; it has others: {others}" if others else ""
        raise ConfigError(f"data must contain episodes of the split {store.split}, got none in {store.folder}{remedy}")
    with faults_outlived():
        return [store.read(i) for i in store.first_indices(count)]


def find_episode(folder: Path | str, key: str) -> Episode:
    """Returns the episode with a key, for example validation-000000. Raises: ConfigError if there is none."""
    split = key.rsplit("-", 1)[0]
    if split not in SPLITS:
        raise ConfigError(f"episode must begin with one of {', '.join(SPLITS)}, got {key!r}; e.g. validation-000000")
    store = EpisodeStore(folder, split)
    with faults_outlived():
        for place, entry in enumerate(store.entries):
            if entry.key == key:
                return store.read(place)
    some = "".join(f"; for example {entry.key}" for entry in islice(store.entries, 1))
    raise ConfigError(f"episode must be one of the {len(store)} {split} episodes in {folder}, got {key!r}{some}")
