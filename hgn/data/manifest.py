"""Reads and writes the manifest of a data set: published shards, their content, and the settings of their generation.

`manifest.json` is written last and atomically, so all listed shards are complete. The append-only files of
`hgn.data.index` list the shards, so the manifest's size does not depend on their number.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hgn.data.entries import (
    SPLITS,
    EpisodeEntry,
    QuarantinedScene,
    ShardEntry,
    SplitTotals,
    Totals,
    no_totals,
    require_sound,
)
from hgn.data.identity import identity_hash
from hgn.data.index import Index, IndexState, begin, extend, parse_json
from hgn.data.statistics import Statistics
from hgn.data.storage import Storage, ask, open_storage
from hgn.scene.episode import SCHEMA_VERSION, require_schema_version
from hgn.schema import ConfigError, from_mapping, require, to_mapping
from hgn.system.files import write_atomically

__all__ = ["MANIFEST_NAME", "SPLITS", "EpisodeEntry", "Manifest", "QuarantinedScene", "ShardEntry"]
MANIFEST_NAME = "manifest.json"
MOST_BYTES = 32 << 20  # a manifest has a few KB, and more if it names thousands of mesh files


@dataclass(frozen=True)
class _Identity:
    """Holds the fields of a manifest without those of its index."""

    config_hash: str  # hash of `config`
    config: dict[str, Any]  # `hgn.data.identity.dataset_identity`
    requested: dict[str, int]  # number of episodes per split
    revision: int = 0  # grows by one with each publication
    schema_version: int = field(default=SCHEMA_VERSION, kw_only=True)


@dataclass(frozen=True)
class _Head(_Identity):
    """Holds the content of `manifest.json`."""

    index: IndexState = field(kw_only=True)
    totals: dict[str, SplitTotals] = field(kw_only=True)


@dataclass(frozen=True)
class Manifest(_Identity):
    """Describes the published part of a data set."""

    # in publication order; generation 0 has no files
    shards: Index = field(default_factory=lambda: Index("", IndexState(generation=0), no_totals()))

    @staticmethod
    def load(folder: Path | str, patience_s: float | None = None) -> Manifest:
        """Reads `<folder>/manifest.json`. Waits for a server that does not answer for up to `patience_s`.

        Raises: ConfigError if it is missing, not JSON, of another schema version, or has a wrong field;
        UnreachableError if the server does not answer.
        """

        def read(files: Storage) -> Manifest:
            return Manifest.parse(files.manifest(MANIFEST_NAME, patience_s), folder)

        path = f"{folder}/{MANIFEST_NAME}"
        try:
            return read(open_storage(folder)) if patience_s == 0 else ask(folder, read)
        except (FileNotFoundError, NotADirectoryError):
            raise ConfigError(
                f"{path} must be the manifest of a data set, got no such file; generate one with "
                f"python -m datagen +experiment=... out={folder}"
            ) from None

    @staticmethod
    def parse(content: bytes, folder: Path | str) -> Manifest:
        """Parses the bytes of a manifest whose index is in `folder`.

        Raises: ConfigError if they are not JSON, of another schema version, or have a wrong field.
        """
        path = f"{folder}/{MANIFEST_NAME}"
        require(len(content) <= MOST_BYTES, path, f"at most {MOST_BYTES} bytes", len(content))
        mapping = parse_json(content, path)
        require_schema_version(mapping, path)
        remedy = "release 0.1.0 listed the shards here: generate the data again, or read them with release 0.2.0"
        require("index" in mapping, f"{path}.index", "given", None, remedy)
        head = from_mapping(_Head, mapping, path)
        shards = Index(folder, head.index, no_totals() | head.totals)
        for name, splits in (("requested", head.requested), ("totals", shards.totals)):
            require(set(splits) <= set(SPLITS), f"{path}.{name}", f"for {', '.join(SPLITS)}", sorted(splits))
        for totals in shards.totals.values():
            require_sound(totals.statistics or Statistics())
        count = sum(totals.shards for totals in shards.totals.values())
        require(count == len(shards), f"{path}.index.shards", f"{count}, as in totals", len(shards))
        for key in ("frames", "long_frames"):
            frames = head.config.get(key, 1)
            require(type(frames) is int and frames > 0, f"{path}.config.{key}", "a whole number > 0", frames)
        with errors_in_config(path):
            expected = identity_hash(head.config)
        require(head.config_hash == expected, f"{path}.config_hash", f"{expected}, config's hash", head.config_hash)
        return Manifest(head.config_hash, head.config, head.requested, head.revision, shards)

    def save(
        self, folder: Path | str, shards: Iterable[ShardEntry], quarantined: Sequence[QuarantinedScene] = ()
    ) -> Manifest:
        """Replaces the folder's manifest and, by a new generation, its index. Returns the manifest in the folder."""
        try:
            current = json.loads((Path(folder) / MANIFEST_NAME).read_bytes())["index"]["generation"]
        except (FileNotFoundError, ValueError, LookupError, TypeError):  # no manifest, or a damaged one
            current = 0
        return replace(self, shards=begin(Path(folder), current)).extended(Path(folder), shards, quarantined)

    def extended(
        self,
        folder: Path,
        shards: Iterable[ShardEntry] = (),
        quarantined: Sequence[QuarantinedScene] = (),
        **changes: Any,
    ) -> Manifest:
        """Publishes more entries in this folder at a constant cost. `changes` are new values of other fields.

        Raises: OSError; ConfigError if another program changed the index.
        """
        if self.shards.state.generation == 0:
            return replace(self, **changes).save(folder, shards, quarantined)
        manifest = replace(self, shards=extend(folder, self.shards, shards, quarantined), **changes)
        mapping = {name: value for name, value in vars(manifest).items() if name != "shards"}
        head = _Head(**mapping, index=manifest.shards.state, totals=manifest.shards.totals)
        text = json.dumps(to_mapping(head), sort_keys=True, allow_nan=False, separators=(",", ":"))
        write_atomically(folder / MANIFEST_NAME, text.encode() + b"\n")
        return manifest

    @property
    def totals(self) -> Totals:
        """Returns the totals of each split."""
        return self.shards.totals

    @property
    def quarantined(self) -> list[QuarantinedScene]:
        """Returns the scenes that could not be simulated, in order. Each access reads the index."""
        return self.shards.quarantined()

    def statistics(self, split: str = "train") -> Statistics:
        """Returns mean and spread of velocity and acceleration of a split, in frame units."""
        return self.totals[split].statistics or Statistics()

    def shards_of(self, split: str) -> Iterator[ShardEntry]:
        """Yields the published shards of a split in publication order."""
        return (shard for shard in self.shards if shard.split == split)

    def published(self, split: str) -> int:
        """Returns the number of published episodes of a split."""
        return self.totals[split].episodes

    @property
    def complete(self) -> bool:
        """Returns whether every requested episode is published."""
        return all(self.published(split) >= count for split, count in self.requested.items())


@contextlib.contextmanager
def errors_in_config(folder: Path | str) -> Iterator[None]:
    """Turns errors of code that reads a manifest's config into a ConfigError, because a file may have any config."""
    try:
        yield
    except ConfigError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise ConfigError(f"{folder} must have a config that this version can read, got {error!r}") from error
