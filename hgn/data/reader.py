"""Reads published episodes. Positions are memory-mapped, so a window of frames costs only its own pages.

Each shard is checked against the manifest (size, then sha256) before anything in it is used: a tar cut at a
member boundary would otherwise read as fewer samples without any error.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np

from hgn.data.manifest import MANIFEST_NAME, SPLITS, EpisodeEntry, Manifest, ShardEntry
from hgn.data.statistics import Statistics
from hgn.scene.episode import POSITION_MEMBER, Episode, decode_episode
from hgn.schema import ConfigError, require

# (path, size, modification time, sha256) of the shards that this process has verified
_verified: set[tuple[str, int, int, str]] = set()


class EpisodeStore:
    """The published episodes of one split of a data set; it only grows.

    Picklable for spawned workers: the folder, split and manifest travel, open files and maps do not.
    """

    def __init__(self, folder: Path | str, split: str) -> None:
        """Raises: ConfigError when the folder holds no readable manifest or the split is unknown."""
        require(split in SPLITS, "split", f"one of {', '.join(SPLITS)}", split)
        self.folder = Path(folder)
        self.split = split
        self.manifest = Manifest.load(self.folder)
        self._reset()

    @staticmethod
    def available(folder: Path | str) -> bool:
        """Whether there is a data set (perhaps not yet complete, perhaps not yet with any shard) to open."""
        return (Path(folder) / MANIFEST_NAME).is_file()

    def refresh(self) -> bool:
        """Reads the manifest again; True when this split has more episodes than before.

        Raises: ConfigError when the folder now holds another data set, or published shards were taken away.
        """
        manifest = Manifest.load(self.folder)
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
        for shard in self.manifest.shards_of(self.split):
            self._append(shard)

    def _append(self, shard: ShardEntry) -> None:
        self._located.extend((shard, entry) for entry in shard.episodes)

    def _open(self, index: int) -> Episode:
        if index not in self._opened:
            shard, entry = self._located[index]
            if shard.name not in self._maps:
                verify_shard(self.folder, shard)
                # one map a shard, not one an episode: each map holds a file descriptor
                self._maps[shard.name] = np.memmap(self.folder / shard.name, dtype=np.uint8, mode="r")
            episode = read_episode(self._maps[shard.name], shard.name, entry.key, entry.members)
            found = (episode.seed, episode.particle_count, episode.frame_count)
            if found != (entry.seed, entry.particles, entry.frames):
                raise ConfigError(
                    f"{self.folder / shard.name}: {entry.key} must have seed, particles, frames "
                    f"{(entry.seed, entry.particles, entry.frames)}, got {found}; delete manifest.json and run the "
                    "generator again"
                )
            self._opened[index] = episode
        return self._opened[index]


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


def verify_shard(folder: Path, shard: ShardEntry) -> None:
    """Checks size and sha256 of a published shard, once a process as long as the file does not change.

    Raises: ConfigError naming the shard, what was expected and found, and the remedy.
    """
    path = folder / shard.name
    remedy = "delete it and run the generator again"
    try:
        status = path.stat()
    except FileNotFoundError:
        raise ConfigError(f"{path} is listed in the manifest but missing; run the generator again") from None
    if status.st_size != shard.bytes:
        raise ConfigError(f"{path} must have {shard.bytes} bytes, got {status.st_size}; {remedy}")
    identity = (str(path.resolve()), status.st_size, status.st_mtime_ns, shard.sha256)
    if identity in _verified:
        return
    found = file_sha256(path)
    if found != shard.sha256:
        raise ConfigError(f"{path} must have sha256 {shard.sha256}, got {found}: it was altered; {remedy}")
    _verified.add(identity)


def file_sha256(path: Path) -> str:
    """The sha256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


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
