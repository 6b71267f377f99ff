"""`python -m datagen.upload data=data/obstacles to=s3://bucket/obstacles`: copies a data set to an object store.

Training then reads it with `dataset.folder=s3://bucket/obstacles`. Shards are copied first and the manifest last, so
that all listed shards are complete. A second run copies only new shards.
"""

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.generate import stop_signals
from hgn.command import run_command
from hgn.data.manifest import MANIFEST_NAME, SPLITS, Manifest
from hgn.data.storage import is_remote, open_storage, remote_storage
from hgn.schema import ConfigError, from_mapping, printable, require
from hgn.system.progress import bar
from hgn.system.signals import Signals


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
    with stop_signals() as stop:
        copy = upload(Path(config.data), config.to.rstrip("/"), stop)
    print(printable(f"{config.to} has {len(copy.shards)} shards") + (", the whole data set" if copy.complete else ""))
    return stop.exit_code


def upload(folder: Path, url: str, stop: Signals) -> Manifest:
    """Copies the missing shards, then the index and the manifest. After a stop request it copies no more.

    Returns the manifest at the URL, or an empty one. An object store writes files atomically.
    Raises: ConfigError if the URL has another data set or one that cannot be read, a local shard is altered or missing,
    or writing fails; UnreachableError.
    """
    there, remote = None, remote_storage(url)
    with contextlib.suppress(FileNotFoundError):
        there = Manifest.parse(remote.manifest(MANIFEST_NAME), url)
    try:
        content = (folder / MANIFEST_NAME).read_bytes()
    except FileNotFoundError:
        raise ConfigError(f"data must be the folder of a data set, got {folder} without {MANIFEST_NAME}") from None
    manifest = Manifest.parse(content, folder)
    there = there or Manifest(manifest.config_hash, manifest.config, manifest.requested, revision=-1)
    if there.config_hash != manifest.config_hash:
        raise ConfigError(f"to must be empty or contain the same data set, got another one in {url}")
    if not all(manifest.shards.continues(there.shards, split) for split in SPLITS):
        raise ConfigError(
            f"to must contain the first shards of the local data set, got others in {url}; if it was generated again, "
            "choose another URL"
        )
    size, before = (sum(total.bytes for total in each.totals.values()) for each in (manifest, there))
    with bar("copying", total=size - before, unit="byte") as progress:
        for shard in manifest.shards.since(len(there.shards)):
            if stop.requested:
                return there
            path = open_storage(folder).shard(shard.name, shard.sha256, shard.bytes)
            if not remote.has(shard.name, path):  # an earlier copy, without its manifest, was interrupted
                remote.write(shard.name, path)
            progress.update(shard.bytes)
    if (there.revision, there.requested) == (manifest.revision, manifest.requested):
        return there
    same = there.shards.state.generation == manifest.shards.state.generation
    have = set(there.shards.files()) if same else set()
    for name, size in manifest.shards.files():
        if (name, size) not in have:
            remote.write(name, (folder / name).read_bytes()[:size])
    remote.write(MANIFEST_NAME, content)  # the bytes that were read, because the file may have grown
    return manifest


if __name__ == "__main__":
    run_command(main, "upload")
