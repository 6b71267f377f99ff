"""Shards of URLs on this machine, under their sha256, so that no two data sets collide there.

One process of the machine brings a shard, the others wait for it. `HGN_CACHE` names the cache's folder (default
`~/.cache/hgn`), `HGN_CACHE_GB` how much may be in it (default: all that fits on its disk; the shard that was brought
first makes room).
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import math
import os
import sys
import time
import weakref
from collections.abc import Callable, Collection, Iterator
from io import BufferedRandom
from pathlib import Path
from typing import Protocol

from hgn.data.verification import note_verified, verify_file
from hgn.schema import ConfigError, require
from hgn.system import patience
from hgn.system.files import NO_LOCKS, TEMPORARY_SUFFIX, sync_folder
from hgn.system.patience import UnreachableError

CACHE_VARIABLE = "HGN_CACHE"
LIMIT_VARIABLE = "HGN_CACHE_GB"
_LOCK_PAUSE_S = 0.05


class Holder(Protocol):
    """Who has files of the cache open, which take their room until they are closed."""

    def release(self, path: Path) -> None:
        """Closes a file that is about to go."""
        ...


holders: weakref.WeakSet[Holder] = weakref.WeakSet()


def cache_folder() -> Path:
    """Where shards of URLs are kept.

    Raises: ConfigError where nothing is named and there is no home folder.
    """
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        return Path(named) / "shards"
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hgn" / "shards"
    except RuntimeError:
        raise ConfigError(
            f"{CACHE_VARIABLE} must name a folder for a server's shards where there is no home folder, got none"
        ) from None


def cached_shard(
    url: str,
    sha256: str,
    size: int,
    patience_s: float,
    spared: Collection[str] | None,
    fill: Callable[[BufferedRandom], None],
) -> Path:
    """A shard's verified file. Where it is not here, `fill` completes a file that may hold its beginning; others leave
    a full cache for it, but those whose sha256 is `spared` (none: all are).

    Raises: ConfigError; UnreachableError, while another process has the file and brings nothing; OSError (a full disk,
    or cache); what `fill` raises.
    """
    path = cache_folder() / f"{sha256}.tar"
    for again in (True, False):
        if not path.exists():
            _bring(path, url, sha256, size, patience_s, spared, fill)
        try:
            verify_file(path, sha256, size, "it is fetched again")
            break
        except (ConfigError, FileNotFoundError) as error:  # this machine's disk, or somebody cleaning up
            if not again:
                raise
            print(error, file=sys.stderr)
            path.unlink(missing_ok=True)
    return path


def _bring(
    path: Path,
    url: str,
    sha256: str,
    size: int,
    patience_s: float,
    spared: Collection[str] | None,
    fill: Callable[[BufferedRandom], None],
) -> None:
    _make_folder(path.parent)
    with _owned(path, url, patience_s) as file:
        if file is None:
            return
        while True:  # room is made by the file's owner alone: two that need one shard would make it twice
            over = _bytes_over(path.parent, size)
            try:
                if over > 0:
                    raise OSError(errno.ENOSPC, f"the cache is full ({LIMIT_VARIABLE})", str(path))
                fill(file)
                break
            except OSError as error:
                if error.errno not in (errno.ENOSPC, errno.EDQUOT) or spared is None:
                    raise
                if not _make_room(path.parent, max(over, size), spared):
                    raise
        os.fsync(file.fileno())
        # it is the last one that was brought, wherever this machine's clock stood before
        latest = max((time_ns for time_ns, _, _ in _cached(path.parent)), default=0)
        if os.fstat(file.fileno()).st_mtime_ns <= latest:
            os.utime(file.fileno(), ns=(latest + 1, latest + 1))
        Path(file.name).replace(path)
    sync_folder(path.parent)
    note_verified(path, sha256)


def _make_folder(folder: Path) -> None:
    """Raises: ConfigError, which says what to name, where it may not be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR):
            raise
        raise ConfigError(
            f"{CACHE_VARIABLE} must name a folder for a server's shards that can be written to, got {folder} "
            f"({error.strerror})"
        ) from None


def _cached(folder: Path) -> list[tuple[int, int, Path]]:
    """Of each shard in the cache when it was brought, its bytes and path; others may take them away meanwhile."""
    shards = []
    for path in folder.glob("*.tar"):
        with contextlib.suppress(FileNotFoundError):
            status = path.stat()
            shards.append((status.st_mtime_ns, status.st_size, path))
    return sorted(shards)


def _bytes_over(folder: Path, size: int) -> float:
    """By how much the cache would be over its limit with one more file. Raises: ConfigError."""
    limit = os.environ.get(LIMIT_VARIABLE)
    if not limit:
        return 0
    try:
        allowed = float(limit) * 1e9
    except ValueError:
        allowed = 0.0
    require(0 < allowed < math.inf, LIMIT_VARIABLE, "a number of gigabytes > 0", limit)
    return sum(cached for _, cached, _ in _cached(folder)) + size - allowed


def _make_room(folder: Path, size: float, spared: Collection[str]) -> bool:
    """Removes the shards that were brought first, but those that are spared; whether there was any."""
    freed = 0
    for _, cached, path in _cached(folder):
        if freed >= size:
            break
        if path.stem in spared:
            continue
        for holder in list(holders):
            holder.release(path)
        path.unlink(missing_ok=True)
        freed += cached
    return freed > 0


@contextlib.contextmanager
def _owned(path: Path, url: str, patience_s: float) -> Iterator[BufferedRandom | None]:
    """The partial file of `path`, for this process alone and with what others had written; none when `path` is there.

    The kernel frees a process's hold when it ends, so the next one goes on.
    Raises: UnreachableError when another one has it, and brings nothing for as long as there is patience.
    """
    partial = path.with_name(f".{path.name}{TEMPORARY_SUFFIX}")
    while True:
        try:
            opened = open(partial, "a+b", opener=_open_file)  # noqa: SIM115 - a path's takes no opener
        except OSError as error:
            if error.errno != errno.ELOOP:
                raise
            raise ConfigError(f"{partial} must be a file, got a symbolic link to another; delete it") from None
        with opened as file:
            try:
                _take(file, url, patience_s)
            except OSError as error:
                if error.errno not in NO_LOCKS:
                    raise
                raise ConfigError(
                    f"{CACHE_VARIABLE} must name a folder on a file system with file locks, got {path.parent} "
                    f"({error.strerror}); take one of this machine's own disks"
                ) from None
            if not _is_same(file, partial):
                continue  # whoever had it before has given it its name
            if path.exists():
                partial.unlink()
                yield None
                return
            try:
                yield file
            except ConfigError:
                partial.unlink(missing_ok=True)
                raise
            except OSError as error:
                if error.errno in (errno.ENOSPC, errno.EDQUOT):
                    error.filename = error.filename or str(path)
                    partial.unlink(missing_ok=True)
                raise
            return


def _take(file: BufferedRandom, url: str, patience_s: float) -> None:
    """The file's lock. A process that was stopped may have it: it is waited for while what it brings grows."""
    size, begin = -1, time.monotonic()
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            before, size = size, os.fstat(file.fileno()).st_size
            if before != size:
                begin = time.monotonic()
            if time.monotonic() - begin >= patience_s or patience.without.is_set():
                raise UnreachableError(url, patience_s, "another process is fetching it") from None
            patience.without.wait(_LOCK_PAUSE_S)


def _open_file(name: str, flags: int) -> int:
    return os.open(name, flags | os.O_NOFOLLOW, 0o644)


def _is_same(file: BufferedRandom, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
