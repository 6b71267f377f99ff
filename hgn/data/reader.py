"""Reads published episodes. Positions are memory-mapped, so a window of frames costs only its own pages.

Each shard is checked against the manifest (size, then sha256) before anything in it is used: a tar cut at a
member boundary would otherwise read as fewer samples without any error. Shards of a URL are read from the cache that
`hgn.data.shard_cache` keeps on this machine.
"""

from __future__ import annotations

import contextlib
import sys
import threading
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

import numpy as np

from hgn.data.manifest import MANIFEST_NAME, SPLITS, EpisodeEntry, Manifest, ShardEntry
from hgn.data.shard_cache import holders
from hgn.data.statistics import Statistics
from hgn.data.storage import is_remote, open_storage
from hgn.scene.episode import POSITION_MEMBER, Episode, decode_episode
from hgn.schema import ConfigError, require
from hgn.system.patience import UnreachableError

MAPPED_SHARDS = 256  # at once; a process may have 1,024 files open where nothing else is said


class Episodes(Sequence[Episode], ABC):
    """What reads as the list of its episodes.

    Each is opened, and its shard verified, on first use; its `position_TN3` is a read-only `np.memmap`. Raises on
    access: ConfigError when a shard is missing or altered.
    """

    @abstractmethod
    def open(self, index: int) -> Episode:
        """The episode at a place, from 0 on, below the number of them."""

    @overload
    def __getitem__(self, index: int) -> Episode: ...

    @overload
    def __getitem__(self, index: slice) -> list[Episode]: ...

    def __getitem__(self, index: int | slice) -> Episode | list[Episode]:
        if isinstance(index, slice):
            return [self.open(i) for i in range(len(self))[index]]
        return self.open(range(len(self))[index])


class EpisodeStore(Episodes):
    """The published episodes of one split of a data set, in a folder or at a URL, in their order; it only grows.

    Picklable for spawned workers: the folder, split and manifest travel, open files and maps do not.
    """

    _fetcher: threading.Thread | None = None
    _lock: threading.Lock
    _wanted: list[ShardEntry]  # to be brought here next
    _spared: frozenset[str]  # their sha256, and those of others that are needed soon

    def __init__(self, folder: Path | str, split: str) -> None:
        """Raises: ConfigError when there is no readable manifest or the split is unknown; UnreachableError."""
        require(split in SPLITS, "split", f"one of {', '.join(SPLITS)}", split)
        self.folder = folder
        self.split = split
        self.manifest = Manifest.load(self.folder)
        self._reset()

    @staticmethod
    def available(folder: Path | str) -> bool:
        """Whether there is a data set (perhaps not yet complete, perhaps not yet with any shard) to open.

        Raises: ConfigError where access is refused; UnreachableError.
        """
        try:
            open_storage(folder).manifest(MANIFEST_NAME)
        except (FileNotFoundError, NotADirectoryError):
            return False
        return True

    def of_split(self, split: str) -> EpisodeStore:
        """Another split of the same data set, as it is known here: without asking a server."""
        require(split in SPLITS, "split", f"one of {', '.join(SPLITS)}", split)
        store = EpisodeStore.__new__(EpisodeStore)
        store.__setstate__(self.__getstate__() | {"split": split})
        return store

    def refresh(self) -> bool:
        """Reads the manifest again; True when this split has more episodes than before.

        A server that does not answer is no fault: what was known stays.
        Raises: ConfigError when the folder now holds another data set, or published shards were taken away.
        """
        try:
            manifest = Manifest.load(self.folder, patience_s=0.0)
        except UnreachableError as error:
            print(f"{error.filename}: {error.strerror}; going on with {len(self)} episodes", file=sys.stderr)
            return False
        if manifest.config_hash != self.manifest.config_hash:
            raise ConfigError(
                f"{self.folder} must keep holding the same data set, got config hash {manifest.config_hash[:12]} "
                f"where {self.manifest.config_hash[:12]} was opened; start again"
            )
        manifest = replace(manifest, shards=self.manifest.shards.continued(manifest.shards))
        if not manifest.shards.continues(self.manifest.shards, self.split):
            raise ConfigError(
                f"{self.folder} must keep the {self.split} shards already published, got a manifest (revision "
                f"{manifest.revision}) without some of them; start again"
            )
        before, self.manifest = len(self), manifest
        return len(self) > before

    def within_reach(self, indices: Sequence[int], patience_s: float) -> bool:
        """Whether these episodes can be read without waiting longer for a server; their shards are brought here.

        Raises: ConfigError when a shard is missing or altered.
        """
        for shard in self._shards(indices):
            try:
                self._bring(shard, patience_s=patience_s)
            except UnreachableError:
                return False
        return True

    def fetch_ahead(self, episodes: Sequence[int] | None = None) -> None:
        """Begins to bring shards to this machine, one after the other, beside their use: all that are known by now; or
        those of these `episodes` alone, in their order, for which others leave a full cache.

        Does nothing for a folder.
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

    # whoever needs a shard that cannot be had meets the same error again, and says so

    def _fetch_all(self) -> None:
        with contextlib.suppress(ConfigError, OSError):
            for shard in self.manifest.shards.since(self._fetched):
                if shard.split == self.split:
                    self._bring(shard, spared=None)
                self._fetched += 1

    def _fetch_wanted(self) -> None:
        with contextlib.suppress(ConfigError, OSError):
            while True:
                with self._lock:
                    if not self._wanted:
                        self._fetcher = None
                        return
                    shard, spared = self._wanted.pop(0), self._spared
                self._bring(shard, spared=spared)

    def digest(self, count: int) -> str | None:
        """Tells the first `count` episodes from any others; none where no shard ends with the last of them."""
        return self.manifest.shards.digest(self.split, count)

    @property
    def entries(self) -> Iterator[EpisodeEntry]:
        """What the index says of each episode (key, particles, frames), without opening any shard."""
        return (entry for shard in self.manifest.shards_of(self.split) for entry in shard.episodes)

    def frames(self, count: int | None = None) -> list[int]:
        """Frames of each episode, of the first `count` only. Where all have as many the index is not read for it."""
        count, config = len(self) if count is None else count, self.manifest.config
        if "frames" in config and "long_fraction" not in config:
            return [config["frames"]] * count
        for shard in self.manifest.shards.since(self._measured):
            self._frames += [entry.frames for entry in shard.episodes if shard.split == self.split]
            self._measured += 1
        return self._frames[:count]

    def particles(self, episodes: Sequence[int]) -> list[int]:
        """How many each of these has, by the index."""
        return self.manifest.shards.particles(self.split, episodes)

    def statistics(self) -> Statistics:
        """Velocity and acceleration of this split in frame units."""
        return self.manifest.statistics(self.split)

    def __len__(self) -> int:
        return self.manifest.published(self.split)

    def __getstate__(self) -> dict[str, Any]:
        return {"folder": self.folder, "split": self.split, "manifest": self.manifest}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._reset()

    def _reset(self) -> None:
        self._open_shards: OrderedDict[str, _OpenShard] = OrderedDict()
        self._fetcher = None
        self._frames: list[int] = []  # of the episodes of the data set's first shards, where they may differ
        self._measured = 0  # how many shards these are
        self._fetched = 0  # of the data set's shards, how many were brought here one after the other
        self._wanted, self._spared = [], frozenset()
        self._lock = threading.Lock()
        holders.add(self)

    def _bring(self, shard: ShardEntry, **options: Any) -> Path:
        """A shard's verified file on this machine; options and errors are those of `Storage.shard`."""
        return open_storage(self.folder).shard(shard.name, shard.sha256, shard.bytes, **options)

    def _locate(self, index: int) -> tuple[ShardEntry, EpisodeEntry]:
        return self.manifest.shards.locate(self.split, index)

    def _shards(self, indices: Sequence[int]) -> list[ShardEntry]:
        """Those of some episodes, once each, in their order."""
        return list({shard.name: shard for shard, _ in map(self._locate, indices)}.values())

    def open(self, index: int) -> Episode:
        shard, entry = self._locate(index)
        while True:
            opened = self._open_shards.get(shard.name)
            if opened is None:  # outside of the lock: this may wait for a server
                opened = _OpenShard(self._bring(shard))
            with self._lock:
                opened = self._open_shards.setdefault(shard.name, opened)
                self._open_shards.move_to_end(shard.name)
                # each map holds a file descriptor; episodes that are in use keep theirs
                if len(self._open_shards) > MAPPED_SHARDS:
                    self._open_shards.popitem(last=False)
                size = opened.size()
                if size is None and is_remote(self.folder):  # it left a full cache, and comes again
                    del self._open_shards[shard.name]
                    continue
                if size is not None and size < shard.bytes:  # to read what is mapped there would end the process
                    raise ConfigError(
                        f"{opened.path} must have {shard.bytes} bytes, got {size}: it was cut while it was open"
                    )
                if entry.key not in opened.episodes:
                    opened.episodes[entry.key] = self._read(opened.content, shard, entry)
                return opened.episodes[entry.key]

    def release(self, path: Path) -> None:
        """Closes a shard; episodes of it that are in use stay readable."""
        with self._lock:
            for name in [name for name, opened in self._open_shards.items() if opened.path == path]:
                del self._open_shards[name]

    def _read(self, content: np.ndarray, shard: ShardEntry, entry: EpisodeEntry) -> Episode:
        episode = read_episode(content, shard.name, entry.key, entry.members)
        actual = (episode.seed, episode.particle_count, episode.frame_count)
        expected = (entry.seed, entry.particles, entry.frames)
        config = self.manifest.config
        # imported episodes are of any length
        frames = config.get("frames", entry.frames)
        lengths = {frames, config.get("long_frames", frames)}
        if actual != expected or entry.frames not in lengths:
            raise ConfigError(
                f"{self.folder}/{shard.name}: {entry.key} must have seed, particles, frames {expected}, and as many "
                f"frames as the data set's ({lengths}), got {actual}; delete manifest.json and run the generator again"
            )
        return episode


class _OpenShard:
    """One map a shard, not one an episode."""

    def __init__(self, path: Path) -> None:
        self.path = path
        # of an empty file there is no map
        self.content = np.memmap(path, np.uint8, mode="r") if path.stat().st_size else np.zeros(0, np.uint8)
        self.episodes: dict[str, Episode] = {}

    def size(self) -> int | None:
        """Of the file now; none where it is gone."""
        try:
            return self.path.stat().st_size
        except FileNotFoundError:
            return None


def read_episode(
    shard_bytes: np.ndarray,
    shard_name: str,
    key: str,
    located: Mapping[str, tuple[int, int]],
    scan_positions: bool = False,
) -> Episode:
    """One episode of a shard whose bytes (flat uint8, mapped or in memory) are given; positions stay a view of them.

    `located` gives offset and size of each member. Raises: ConfigError when it does not fit the bytes.
    """
    members: dict[str, bytes | np.ndarray] = {}
    for member, (offset, size) in located.items():
        if offset < 0 or size < 0 or offset + size > len(shard_bytes):
            raise ConfigError(
                f"{shard_name}: {key}.{member} must lie within {len(shard_bytes)} bytes, got offset {offset} and "
                f"{size} bytes; delete manifest.json and run the generator again"
            )
        data = shard_bytes[offset : offset + size]
        members[member] = data if member == POSITION_MEMBER else data.tobytes()
    return decode_episode(key, members, scan_positions)
