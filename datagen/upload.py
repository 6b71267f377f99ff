"""`python -m datagen.upload data=data/obstacles to=s3://bucket/obstacles`: copies a data set to an object store.

Training then reads it with `dataset.folder=s3://bucket/obstacles`. Shards are copied first and the manifest last, so
that all listed shards are complete. A second run copies only new shards.
"""

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.generate import StopSignal
from hgn.command import run_command
from hgn.data.manifest import MANIFEST_NAME, SPLITS, Manifest
from hgn.data.storage import is_remote, open_storage, write_remote
from hgn.schema import ConfigError, from_mapping, printable, require
from hgn.system.progress import bar


@dataclass(frozen=True)
class UploadConfig:
    """`python -m datagen.upload`: source and destination."""

    data: str  # folder of a data set
    to: str  # URL; training reads it with dataset.folder=URL


def main(mapping: dict[str, Any]) -> int:
    """Copies the data set. The exit code is 0, or 128 + the signal that stopped it."""
    config = from_mapping(UploadConfig, mapping)
    require(is_remote(config.to), "to", "a URL", config.to, "as in to=s3://bucket/obstacles")
    require(not is_remote(config.data), "data", "a local folder", config.data)
    with StopSignal() as stop:
        target = Target(config.to)
        target.copy(Path(config.data), stop)
    print(printable(f"{config.to} has {target.shards} shards") + (", the whole data set" if target.complete else ""))
    return 0 if stop.signal is None else 128 + stop.signal


class Target:
    """A data set at a writable URL: an object store, which writes files atomically."""

    def __init__(self, url: str) -> None:
        """Raises: ConfigError if the existing data set cannot be read; UnreachableError."""
        self._url = url.rstrip("/")
        self._manifest: Manifest | None = None
        with contextlib.suppress(FileNotFoundError):
            content = open_storage(self._url).manifest(MANIFEST_NAME)
            self._manifest = Manifest.parse(content, self._url)

    @property
    def shards(self) -> int:
        """Returns the number of shards at the URL."""
        return 0 if self._manifest is None else len(self._manifest.shards)

    @property
    def complete(self) -> bool:
        """Returns whether the URL has the whole data set."""
        return self._manifest is not None and self._manifest.complete

    def copy(self, folder: Path, stop: StopSignal) -> None:
        """Copies the missing shards, then the index and the manifest. After a stop request it copies no more.

        Raises: ConfigError if the URL has another data set, a local shard is altered or missing, or writing fails;
        UnreachableError.
        """
        try:
            content = (folder / MANIFEST_NAME).read_bytes()
        except FileNotFoundError:
            raise ConfigError(f"data must be the folder of a data set, got {folder} without {MANIFEST_NAME}") from None
        manifest, there = Manifest.parse(content, folder), self._manifest
        if there is not None:
            self._require_beginning(there, manifest)
        copied = 0 if there is None else len(there.shards)
        size = sum(total.bytes for total in manifest.totals.values()) - (
            0 if there is None else sum(total.bytes for total in there.totals.values())
        )
        with bar("copying", total=size, unit="byte") as progress:
            for shard in manifest.shards.since(copied):
                if stop.requested():
                    return
                path = open_storage(folder).shard(shard.name, shard.sha256, shard.bytes)
                write_remote(self._url, shard.name, path)
                progress.update(shard.bytes)
        if there is None or (there.revision, there.requested) != (manifest.revision, manifest.requested):
            same = there is not None and there.shards.state.generation == manifest.shards.state.generation
            have = set(there.shards.files()) if there is not None and same else set()
            for name, size in manifest.shards.files():
                if (name, size) not in have:
                    write_remote(self._url, name, (folder / name).read_bytes()[:size])
            write_remote(self._url, MANIFEST_NAME, content)  # the bytes that were read, because the file may have grown
            self._manifest = Manifest.parse(content, folder)

    def _require_beginning(self, there: Manifest, manifest: Manifest) -> None:
        if there.config_hash != manifest.config_hash:
            raise ConfigError(f"to must be empty or contain the same data set, got another one in {self._url}")
        if not all(manifest.shards.continues(there.shards, split) for split in SPLITS):
            raise ConfigError(
                f"to must contain the first shards of the local data set, got others in {self._url}; if it was "
                "generated again, choose another URL"
            )


if __name__ == "__main__":
    run_command(main, "upload")
