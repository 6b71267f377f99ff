"""Caches remote shards. They are named by their sha256, so data sets do not collide.

One process fetches a shard, and the others of this machine wait for it. `HGN_CACHE` is the cache's folder (default
`~/.cache/hgn`). `HGN_CACHE_GB` limits its size (default: the disk's size). A full cache removes the oldest shards.
"""

import contextlib
import errno
import functools
import math
import os
import shutil
import sys
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from io import BufferedRandom
from pathlib import Path

from hgn.data.verification import StorageError, note_verified, verify_file
from hgn.schema import ConfigError, require
from hgn.system import patience
from hgn.system.files import TEMPORARY_SUFFIX, errors_name, sync_folder
from hgn.system.locks import NO_LOCKS, lock_file, open_lock
from hgn.system.patience import UnreachableError

CACHE_VARIABLE = "HGN_CACHE"
LIMIT_VARIABLE = "HGN_CACHE_GB"
_LOCK_PAUSE_S = 0.05
_STALLED_S = 2.0  # a process that has a lock and writes nothing for this time may be suspended
_FULL = (errno.ENOSPC, errno.EDQUOT)


def cache_folder() -> Path:
    """Returns the folder of cached shards. Raises: ConfigError without $HGN_CACHE and without a home folder."""
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        return Path(named) / "shards"
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hgn" / "shards"
    except RuntimeError:
        raise ConfigError(
            f"{CACHE_VARIABLE} must name a folder for a server's shards if there is no home folder, got none"
        ) from None


@dataclass(frozen=True)
class CachedShard:
    """Describes a shard at a URL."""

    url: str
    sha256: str
    size: int  # bytes, as an index claims it


Append = Callable[[bytes], None]
Fill = Callable[[BufferedRandom, Append], None]


def cached_shard(shard: CachedShard, patience_s: float, spared: Collection[str] | None, fill: Fill) -> Path:
    """Returns the verified file of a shard. If it is missing, `fill` completes a partial file, perhaps an empty one.

    `fill` appends with its second argument. A full cache removes other shards, except those with a sha256 in `spared`;
    with None it removes none.
    Raises: ConfigError; UnreachableError while another process fetches the file without progress; OSError (full disk or
    cache); exceptions of `fill`.
    """
    path = cache_folder() / f"{shard.sha256}.tar"
    for last_try in (False, True):
        if not path.exists():
            _fetch(path, shard, patience_s, spared, fill)
        try:
            size = path.stat().st_size  # not the claimed one: an index may name another set's shard
            verify_file(path, shard.sha256, size, "it is fetched again")
            break
        except (ConfigError, FileNotFoundError) as error:  # damaged on this disk, or removed by another process
            if last_try:
                raise
            print(error, file=sys.stderr)
            path.unlink(missing_ok=True)
    if size != shard.size:
        cause = f"got {size} of its sha256: its index is wrong; generate it again"
        raise StorageError(f"{shard.url} must have {shard.size} bytes, {cause}")
    return path


def _fetch(path: Path, shard: CachedShard, patience_s: float, spared: Collection[str] | None, fill: Fill) -> None:
    _make_folder(path.parent)
    with _locked_partial(path, shard.url, patience_s) as file:
        if file is None:
            return
        _require_space(path, shard.size, shard.size - os.fstat(file.fileno()).st_size, spared)
        fill(file, functools.partial(_append, file, path, spared))
        os.fsync(file.fileno())
        # the newest shard must have the latest time, even after a change of this machine's clock
        latest = max((time_ns for time_ns, _, _ in _cached(path.parent)), default=0)
        if os.fstat(file.fileno()).st_mtime_ns <= latest:
            os.utime(file.fileno(), ns=(latest + 1, latest + 1))
        Path(file.name).replace(path)
    sync_folder(path.parent)
    note_verified(path, shard.sha256)


def _append(file: BufferedRandom, path: Path, spared: Collection[str] | None, data: bytes) -> None:
    """Appends bytes that have arrived, and frees space for them only. An index, or a server, may claim any size."""
    rest = memoryview(data)
    while rest:
        if (over := _require_space(path, os.fstat(file.fileno()).st_size + len(rest), len(rest), spared)) > 0:
            _free_space(path.parent, over, spared)
        try:
            rest = rest[file.raw.write(rest) :]  # not buffered: a full disk would leave the rest in the buffer
        except OSError as error:  # a quota, or other programs that fill the disk
            if error.errno not in _FULL or not _free_space(path.parent, len(rest), spared):
                raise


def _require_space(path: Path, size: int, missing: int, spared: Collection[str] | None) -> float:
    """Returns the bytes to remove before `path` can have `size` bytes, `missing` of which are not written yet.

    Raises OSError if the removal of all files that are not spared would not be enough.
    """
    over = max(_bytes_over(path.parent, size), missing - shutil.disk_usage(path.parent).free)
    if over > 0 and over > sum(cached for cached, _ in _removable(path.parent, spared)):
        raise OSError(errno.ENOSPC, f"the cache is full ({LIMIT_VARIABLE})", str(path))
    return over


def _make_folder(folder: Path) -> None:
    """Creates the folder. Raises: ConfigError naming the variable, if it cannot be created."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR):
            raise
        raise ConfigError(
            f"{CACHE_VARIABLE} must name a writable folder for a server's shards, got {folder} ({error.strerror})"
        ) from None


def _cached(folder: Path) -> list[tuple[int, int, Path]]:
    """Returns time, bytes and path of each cached shard, oldest first. Other processes may remove shards meanwhile."""
    shards = []
    for path in folder.glob("*.tar"):
        with contextlib.suppress(FileNotFoundError):
            status = path.stat()
            shards.append((status.st_mtime_ns, status.st_size, path))
    return sorted(shards)


def _bytes_over(folder: Path, size: int) -> float:
    """Returns the number of bytes by which one more file would exceed the cache's limit. Raises: ConfigError."""
    limit = os.environ.get(LIMIT_VARIABLE)
    if not limit:
        return 0
    try:
        allowed = float(limit) * 1e9
    except ValueError:
        allowed = 0.0
    require(0 < allowed < math.inf, LIMIT_VARIABLE, "a number of gigabytes > 0", limit)
    return sum(cached for _, cached, _ in _cached(folder)) + size - allowed


def _removable(folder: Path, spared: Collection[str] | None) -> list[tuple[int, Path]]:
    """Returns bytes and path of the cached shards that are not spared, oldest first. With None all are spared."""
    return [(cached, path) for _, cached, path in _cached(folder) if spared is not None and path.stem not in spared]


def _free_space(folder: Path, size: float, spared: Collection[str] | None) -> bool:
    """Removes the oldest shards that are not spared until it has freed `size` bytes. Returns whether it removed any."""
    freed = 0
    for cached, path in _removable(folder, spared):
        if freed >= size:
            break
        path.unlink(missing_ok=True)
        freed += cached
    return freed > 0


@contextlib.contextmanager
def _locked_partial(path: Path, url: str, patience_s: float) -> Iterator[BufferedRandom | None]:
    """Yields the locked partial file of `path` with the bytes that earlier processes wrote; None once `path` exists.

    The kernel frees the lock of a process that ends, so the next process continues the file.
    Raises: UnreachableError if another process has the lock and writes nothing for `patience_s` or _STALLED_S.
    """
    partial = path.with_name(f".{path.name}{TEMPORARY_SUFFIX}")
    while True:
        with open(partial, "a+b", opener=open_lock) as file:
            _lock(file, path.parent, url, patience_s)
            if not _is_same(file, partial):
                continue  # another process removed it, or gave it its final name
            if path.exists():
                partial.unlink()
                yield None
                return
            try:
                with errors_name(path):
                    yield file
            except (ConfigError, OSError) as error:
                if isinstance(error, ConfigError) or error.errno in _FULL:
                    partial.unlink(missing_ok=True)
                raise
            return


def _lock(file: BufferedRandom, folder: Path, url: str, patience_s: float) -> None:
    """Locks a file. Waits for another process as long as the file grows, and then for `patience_s` or _STALLED_S."""
    size, start = -1, time.monotonic()
    try:
        while not lock_file(file):
            before, size = size, os.fstat(file.fileno()).st_size
            if before != size:
                start = time.monotonic()
            if time.monotonic() - start >= max(patience_s, _STALLED_S) or patience.without.is_set():
                raise UnreachableError(url, patience_s, "another process is fetching it")
            patience.without.wait(_LOCK_PAUSE_S)
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        raise ConfigError(
            f"{CACHE_VARIABLE} must name a folder on a file system with file locks, got {folder} "
            f"({error.strerror}); use one on a local disk"
        ) from None


def _is_same(file: BufferedRandom, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
