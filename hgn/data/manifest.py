"""The manifest of a data set: which shards are published, what is in them, and how they were made.

`manifest.json` is written last and atomically, so whatever it lists is there whole. Shards stay in the order they
were published in, so a reader that knows revision r only ever sees shards appended.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hgn.data.statistics import Statistics, merge_statistics
from hgn.data.storage import PATIENCE_S, open_storage
from hgn.scene.episode import SCHEMA_VERSION, require_schema_version
from hgn.schema import ConfigError, from_mapping, require, require_non_negative, require_one_of, to_mapping
from hgn.system.files import write_atomically

MANIFEST_NAME = "manifest.json"
SPLITS = ("train", "validation", "test")
_FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,200}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class EpisodeEntry:
    """One episode inside a shard."""

    key: str
    index: int  # within its split
    seed: int
    attempt: int  # 0 unless earlier seeds of this index were quarantined
    particles: int
    frames: int
    members: dict[str, tuple[int, int]]  # name after `<key>.` -> offset of its data in the tar, bytes


@dataclass(frozen=True)
class ShardEntry:
    """One published tar file: episodes [first, stop) of a split."""

    name: str
    split: str
    first: int
    stop: int
    sha256: str
    bytes: int
    episodes: tuple[EpisodeEntry, ...]
    statistics: Statistics

    def __post_init__(self) -> None:
        # both become file names, and a manifest may come from anywhere
        require(_FILE_NAME.fullmatch(self.name) is not None, "name", "a plain file name", self.name)
        require(_SHA256.fullmatch(self.sha256) is not None, "sha256", "64 hexadecimal digits", self.sha256)
        require_one_of(self, "split", SPLITS)
        require_non_negative(self, "bytes")


@dataclass(frozen=True)
class QuarantinedScene:
    """A scene that could not be simulated; the next attempt's seed took its place."""

    key: str
    attempt: int
    seed: int
    cause: str


@dataclass(frozen=True)
class Manifest:
    """`requested` counts episodes per split; `config` is the mapping whose hash is `config_hash`."""

    config_hash: str
    config: dict[str, Any]
    requested: dict[str, int]
    revision: int = 0  # grows by one with each publication
    shards: tuple[ShardEntry, ...] = ()  # in publication order
    quarantined: tuple[QuarantinedScene, ...] = ()
    schema_version: int = field(default=SCHEMA_VERSION)

    @staticmethod
    def load(folder: Path | str, patience_s: float = PATIENCE_S) -> Manifest:
        """Reads `<folder>/manifest.json`, where `folder` may be a URL whose server may be away for `patience_s`.

        Raises: ConfigError when it is missing, no JSON, of another schema version, or wrong in any field;
        UnreachableError when the server stays away.
        """
        path = f"{folder}/{MANIFEST_NAME}"
        try:
            content = open_storage(folder).manifest(MANIFEST_NAME, patience_s)
        except (FileNotFoundError, NotADirectoryError):
            raise ConfigError(
                f"{path} must be the manifest of a data set, got no such file; generate one with "
                f"python -m datagen +experiment=... out={folder}"
            ) from None
        return Manifest.parse(content, path)

    @staticmethod
    def parse(content: bytes, path: str) -> Manifest:
        """The manifest in a file's bytes; messages name `path`.

        Raises: ConfigError when they are no JSON, of another schema version, or wrong in any field.
        """
        try:
            mapping = json.loads(content.decode("utf-8"))
        except ValueError as error:
            raise ConfigError(
                f"{path} must be JSON written by python -m datagen, got {error}; delete it and run the same command "
                "again: published shards are found and kept"
            ) from None
        require_schema_version(mapping, path)
        return from_mapping(Manifest, mapping, path)

    def save(self, folder: Path | str) -> None:
        """Replaces `<folder>/manifest.json` atomically."""
        text = json.dumps(to_mapping(self), sort_keys=True, allow_nan=False, separators=(",", ":"))
        write_atomically(Path(folder) / MANIFEST_NAME, text.encode() + b"\n")

    def statistics(self, split: str = "train") -> Statistics:
        """Velocity and acceleration over all published episodes of a split, in frame units."""
        return merge_statistics(shard.statistics for shard in self.shards_of(split))

    def shards_of(self, split: str) -> tuple[ShardEntry, ...]:
        """The published shards of a split, in publication order."""
        return tuple(shard for shard in self.shards if shard.split == split)

    def published(self, split: str) -> int:
        """How many episodes of a split can be read."""
        return sum(len(shard.episodes) for shard in self.shards_of(split))

    @property
    def complete(self) -> bool:
        """Whether every requested episode is published."""
        return all(self.published(split) >= count for split, count in self.requested.items())
