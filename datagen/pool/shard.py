"""Stages tar files of episodes one by one, joins them to shards, and verifies shards completely."""

import contextlib
import hashlib
import os
import tarfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

from datagen.pool.plan import ShardRange, episode_key, scene_seed
from hgn.config import DatagenConfig
from hgn.data.identity import dataset_identity, identity_hash
from hgn.data.manifest import EpisodeEntry, ShardEntry
from hgn.data.reader import FileBytes, read_episode
from hgn.data.shard import episode_tar, locate_members, tar_end
from hgn.data.statistics import episode_statistics, merge_statistics
from hgn.data.verification import file_sha256
from hgn.scene.episode import Episode
from hgn.schema import ConfigError
from hgn.system.files import errors_name, open_at_once, sync_file, temporary_file

STAGING_NAME = ".staging"
_COPY_BYTES = 1 << 22


def staged_path(folder: Path, split: str, index: int) -> Path:
    """Returns the path of a finished episode's tar file until its shard is complete."""
    return folder / STAGING_NAME / f"{episode_key(split, index)}.tar"


def stage_episode(folder: Path, episode: Episode) -> None:
    """Writes `<folder>/.staging/<key>.tar`. Worker processes may call it concurrently.

    `episode.solver["dataset"]` contains `config_hash` and `attempt`, which identify the episode in later runs.
    Raises: OSError (a full disk), ConfigError (positions that are not finite).
    """
    stage_parts(folder, episode.key, episode_tar(episode))


def stage_parts(folder: Path, key: str, parts: Iterable[bytes | memoryview]) -> None:
    """Writes the parts of an episode's tar file atomically, and appends their sha256.

    The file is not synced. `DatasetWriter` syncs it, unless its shard is packed before.
    Raises: OSError (a full disk).
    """
    target, digest = folder / STAGING_NAME / f"{key}.tar", hashlib.sha256()
    with temporary_file(target) as temporary:
        with temporary.open("wb", buffering=0) as file:
            for part in (*parts, None):
                data = _seal(digest) if part is None else part
                digest.update(data)
                rest = memoryview(data)
                while rest:  # a write takes at most 2 GB
                    rest = rest[file.write(rest) :]
        temporary.replace(target)


def sync_staged(path: Path) -> None:
    """Syncs a staged file. Does nothing if the file was removed with its shard. Raises: OSError (a full disk)."""
    with errors_name(path), contextlib.suppress(FileNotFoundError), path.open("rb") as file:
        sync_file(file)


def require_sealed(path: Path) -> None:
    """Raises ConfigError if a staged file has changed: a disk failed, or the machine lost its power."""
    digest, seal = hashlib.sha256(), len(_seal(hashlib.sha256()))
    with errors_name(path), open_at_once(path) as file:
        size = max(os.fstat(file.fileno()).st_size - seal, 0)
        for start in range(0, size, _COPY_BYTES):
            digest.update(file.read(min(_COPY_BYTES, size - start)))
        if file.read() != _seal(digest):
            raise ConfigError(f"{path} must end with the sha256 of its content, got another; delete it and run again")


def _seal(digest: Any) -> bytes:
    return f"sha256 {digest.hexdigest()}\n".encode()


def join_tars(file: BinaryIO, sources: Iterable[Path]) -> None:
    """Writes the members of several staged tars as one tar. Raises: ConfigError if a staged file has changed."""
    written = 0
    for source in sources:
        require_sealed(source)
        members = (place for named in locate_members(source).values() for place in named.values())
        length = max((offset + size for offset, size in members), default=0)
        length += -length % tarfile.BLOCKSIZE
        with source.open("rb") as staged:  # buffered, because an unbuffered read may return fewer bytes
            for start in range(0, length, _COPY_BYTES):
                file.write(staged.read(min(_COPY_BYTES, length - start)))
        written += length
    file.write(tar_end(written))


def inspect_shard(path: Path, shard: ShardRange, config: DatagenConfig) -> ShardEntry:
    """Checks a whole tar: every member, value and seed, and that it contains exactly this range of this data set.

    Raises: ConfigError naming the difference and the remedy.
    """
    located = locate_members(path)
    expected = [episode_key(shard.split, index) for index in shard.indices]
    if list(located) != expected:
        raise ConfigError(
            f"{path} must contain {', '.join(expected)}, got {', '.join(located) or 'nothing'}; delete it and run the "
            "generator again"
        )
    content = FileBytes(path)
    entries, statistics = [], []
    for index, (key, members) in zip(shard.indices, located.items(), strict=True):
        episode, attempt = _read_own_episode(path, content, key, members, config)
        seed, frames = scene_seed(config.dataset.seed, shard.split, index, attempt), config.dataset.frames_of(index)
        if episode.seed != seed or episode.frame_count != frames:
            raise ConfigError(
                f"{path}: {key} must have seed {seed} and {frames} frames, got {episode.seed} "
                f"and {episode.frame_count}; delete it and run the generator again"
            )
        entries.append(EpisodeEntry(key, index, seed, attempt, episode.particle_count, episode.frame_count, members))
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
    path: Path, content: FileBytes, key: str, members: dict[str, tuple[int, int]], config: DatagenConfig
) -> tuple[Episode, int]:
    episode = read_episode(content, path.name, key, members, scan_positions=True)
    origin = episode.solver.get("dataset")
    if not isinstance(origin, dict) or origin.get("config_hash") != identity_hash(dataset_identity(config)):
        raise ConfigError(f"{path}: {key} belongs to another data set; move the file out of the folder")
    attempt = origin.get("attempt")
    if not isinstance(attempt, int):
        raise ConfigError(f"{path}: {key} must name its attempt, got {attempt!r}; delete it and run again")
    return episode, attempt
