"""Reads published episodes. Positions are memory-mapped, so a window of frames costs only its own pages.

Each shard is checked against the manifest (size, then sha256) before anything in it is used: a tar cut at a
member boundary would otherwise read as fewer samples without any error. Shards of a URL are read from the cache that
`hgn.data.storage` keeps on this machine.
"""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np

from hgn.data.manifest import MANIFEST_NAME, SPLITS, EpisodeEntry, Manifest, ShardEntry
from hgn.data.statistics import Statistics
from hgn.data.storage import UnreachableError, is_remote, open_storage
from hgn.scene.episode import POSITION_MEMBER, Episode, decode_episode
from hgn.schema import ConfigError, require


class EpisodeStore:
    """The published episodes of one split of a data set, in a folder or at a URL; it only grows.

    Picklable for spawned workers: the folder, split and manifest travel, open files and maps do not.
    """

    _fetcher: threading.Thread | None = None

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
        known, now = self.manifest.shards_of(self.split), manifest.shards_of(self.split)
        if [shard.sha256 for shard in now[: len(known)]] != [shard.sha256 for shard in known]:
            raise ConfigError(
                f"{self.folder} must keep the {self.split} shards already published, got a manifest (revision "
                f"{manifest.revision}) without some of them; start again"
            )
        self.manifest = manifest
        for shard in now[len(known) :]:
            self._append(shard)
        return len(now) > len(known)

    def within_reach(self, indices: Sequence[int], patience_s: float) -> bool:
        """Whether these episodes can be read without waiting longer for a server; their shards are brought here.

        Raises: ConfigError when a shard is missing or altered.
        """
        for shard in {shard.name: shard for shard, _ in (self._located[index] for index in indices)}.values():
            try:
                open_storage(self.folder).shard(shard.name, shard.sha256, shard.bytes, patience_s)
            except UnreachableError:
                return False
        return True

    def fetch_ahead(self) -> None:
        """Begins to bring the shards known by now to this machine, one after the other, beside their use.

        Does nothing for a folder.
        """
        shards = [shard for shard in self.manifest.shards_of(self.split) if shard.name not in self._maps]
        if is_remote(self.folder) and shards and (self._fetcher is None or not self._fetcher.is_alive()):
            self._fetcher = threading.Thread(target=_fetch, args=(self.folder, shards), name="shards", daemon=True)
            self._fetcher.start()

    @property
    def revision(self) -> int:
        """The manifest revision last read."""
        return self.manifest.revision

    @property
    def entries(self) -> list[EpisodeEntry]:
        """What the manifest says of each episode (key, particles, frames), without opening any shard."""
        return [entry for _, entry in self._located]

    @property
    def episodes(self) -> Sequence[Episode]:
        """The episodes, in publication order; each is opened, and its shard verified, on first use.

        `position_TN3` is a read-only `np.memmap`. Raises on access: ConfigError when a shard is missing or altered.
        """
        return self._episodes

    def statistics(self) -> Statistics:
        """Velocity and acceleration of this split in frame units."""
        return self.manifest.statistics(self.split)

    def __len__(self) -> int:
        return len(self._located)

    def __getstate__(self) -> dict[str, Any]:
        return {"folder": self.folder, "split": self.split, "manifest": self.manifest}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._reset()

    def _reset(self) -> None:
        self._located: list[tuple[ShardEntry, EpisodeEntry]] = []
        self._maps: dict[str, np.ndarray] = {}
        self._opened: dict[int, Episode] = {}
        self._episodes = _Episodes(self)
        self._fetcher = None
        for shard in self.manifest.shards_of(self.split):
            self._append(shard)

    def _append(self, shard: ShardEntry) -> None:
        self._located.extend((shard, entry) for entry in shard.episodes)

    def _open(self, index: int) -> Episode:
        if index not in self._opened:
            shard, entry = self._located[index]
            if shard.name not in self._maps:
                path = open_storage(self.folder).shard(shard.name, shard.sha256, shard.bytes)
                # one map a shard, not one an episode: each map holds a file descriptor
                self._maps[shard.name] = np.memmap(path, dtype=np.uint8, mode="r")
            episode = read_episode(self._maps[shard.name], shard.name, entry.key, entry.members)
            found = (episode.seed, episode.particle_count, episode.frame_count)
            if found != (entry.seed, entry.particles, entry.frames):
                raise ConfigError(
                    f"{self.folder}/{shard.name}: {entry.key} must have seed, particles, frames "
                    f"{(entry.seed, entry.particles, entry.frames)}, got {found}; delete manifest.json and run the "
                    "generator again"
                )
            self._opened[index] = episode
        return self._opened[index]


def _fetch(folder: Path | str, shards: Sequence[ShardEntry]) -> None:
    # whoever needs a shard that cannot be had meets the same error again, and says so
    with contextlib.suppress(ConfigError, OSError):
        for shard in shards:
            open_storage(folder).shard(shard.name, shard.sha256, shard.bytes)


class _Episodes(Sequence[Episode]):
    """The list of episodes of a store, opened on access."""

    def __init__(self, store: EpisodeStore) -> None:
        self._store = store

    @overload
    def __getitem__(self, index: int) -> Episode: ...

    @overload
    def __getitem__(self, index: slice) -> list[Episode]: ...

    def __getitem__(self, index: int | slice) -> Episode | list[Episode]:
        if isinstance(index, slice):
            return [self._store._open(i) for i in range(len(self))[index]]
        return self._store._open(range(len(self))[index])

    def __len__(self) -> int:
        return len(self._store)

    def __iter__(self) -> Iterator[Episode]:
        return (self._store._open(i) for i in range(len(self)))


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
