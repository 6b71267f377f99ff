"""Where a data set lies: a folder of this machine, or a URL (a dataset service, a file server, an object store).

Shards of a URL are kept in a cache on this machine, under their sha256, so that no two data sets collide there; one
process of the machine brings a shard, the others wait for it. `HGN_CACHE` names the cache's folder (default
`~/.cache/hgn`), `HGN_CACHE_GB` how much may be in it (default: all that fits on its disk; the shard that was brought
first makes room), `HGN_DATASET_TOKEN` the token that a dataset service asks for,
`HGN_DATASET_HOST` the only host (or host:port) that it is for.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import functools
import hashlib
import io
import math
import os
import random
import sys
import threading
import time
import weakref
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, Protocol, TypeVar
from urllib.parse import urlsplit

from hgn.schema import ConfigError, require
from hgn.system.extras import missing_extra
from hgn.system.files import NO_LOCKS, TEMPORARY_SUFFIX, read_replaced, sync_folder
from hgn.system.hub import PREFIX, HubPlace, hub_token

TOKEN_VARIABLE = "HGN_DATASET_TOKEN"
TOKEN_HOST_VARIABLE = "HGN_DATASET_HOST"
CACHE_VARIABLE = "HGN_CACHE"
LIMIT_VARIABLE = "HGN_CACHE_GB"
PATIENCE_S = 300.0  # with a server that does not answer: time enough to start a service again
_CHUNK_BYTES = 16 * 2**20  # of a shard at a time: what is lost when a connection is
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.25, 10.0
_CONNECT_S, _SILENCE_S = 10.0, 60.0
_AWAY_S = 10.0
_LOCK_PAUSE_S = 0.05
_NETWORK_PACKAGES = {"aiohttp", "botocore", "aiobotocore", "gcsfs", "google", "azure"}

T = TypeVar("T")
_without_patience = threading.Event()
_verified: set[tuple[str | int, ...]] = set()  # the files that this process has verified


class UnreachableError(OSError):
    """A server did not answer for as long as it was waited for."""

    def __init__(self, url: str, patience_s: float, cause: str) -> None:
        self.cause = cause
        super().__init__(errno.ETIMEDOUT, f"no answer for {patience_s:.0f} s (at last: {cause})", url)


class Holder(Protocol):
    """Who has files of the cache open, which take their room until they are closed."""

    def release(self, path: Path) -> None:
        """Closes a file that is about to go."""
        ...


holders: weakref.WeakSet[Holder] = weakref.WeakSet()


class Storage(Protocol):
    """A data set's files, wherever they are."""

    def manifest(self, name: str, patience_s: float = PATIENCE_S) -> bytes:
        """The manifest's bytes. Raises: FileNotFoundError; UnreachableError; ConfigError (no access)."""
        ...

    def read(self, name: str, start: int, stop: int) -> bytes:
        """Some bytes of a file. Raises: FileNotFoundError; UnreachableError; ConfigError (no access, too short)."""
        ...

    def shard(
        self, name: str, sha256: str, size: int, patience_s: float = PATIENCE_S, spared: Collection[str] | None = ()
    ) -> Path:
        """The path of a shard on this machine, verified; others leave a full cache for it, but those whose sha256 is
        `spared` (none: all are).

        Raises: ConfigError; UnreachableError; OSError (a full disk, or cache).
        """
        ...


def is_remote(folder: Path | str) -> bool:
    """Whether a data set is given by a URL."""
    return "://" in str(folder) and not str(folder).startswith("file://")


def open_storage(folder: Path | str) -> Storage:
    """The storage of a data set; of a URL the same one each time.

    Raises: ConfigError for a URL whose protocol is not known or not installed.
    """
    if is_remote(folder):
        return _remote(str(folder).rstrip("/"))
    return _Folder(Path(str(folder).removeprefix("file://")))


def write_remote(url: str, name: str, source: Path | bytes) -> None:
    """Writes a file, or bytes, to a data set's URL. Raises: ConfigError when that cannot be; UnreachableError."""
    _remote(url.rstrip("/")).write(name, source)


@contextlib.contextmanager
def without_patience() -> Iterator[None]:
    """While it is entered no thread of this process waits for a server that does not answer: nobody needs it now."""
    _without_patience.set()
    try:
        yield
    finally:
        _without_patience.clear()


def dataset_token() -> str | None:
    """The token of $HGN_DATASET_TOKEN. Raises: ConfigError when it could not stand in a header."""
    token = os.environ.get(TOKEN_VARIABLE)
    if token is None:
        return None
    plain = token.isascii() and token.isprintable() and " " not in token
    require(
        plain and len(token) >= 16, TOKEN_VARIABLE, "16 or more printable ASCII characters", f"{len(token)} of them"
    )
    return token


def _token_is_for(url: str) -> bool:
    named, address = os.environ.get(TOKEN_HOST_VARIABLE), urlsplit(url)
    return not named or named in (address.hostname, f"{address.hostname}:{address.port}")


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


def file_sha256(path: Path) -> str:
    """The sha256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def verify_file(path: Path, sha256: str, size: int, remedy: str) -> None:
    """Checks size and sha256 of a file, once a process as long as the file does not change.

    Raises: ConfigError naming the file, what was expected and found, and the remedy; FileNotFoundError.
    """
    status = path.stat()
    if status.st_size != size:
        raise ConfigError(f"{path} must have {size} bytes, got {status.st_size}; {remedy}")
    identity = _identity(path, sha256)
    if identity in _verified:
        return
    actual = file_sha256(path)
    if actual != sha256:
        raise ConfigError(f"{path} must have sha256 {sha256}, got {actual}: it was altered; {remedy}")
    _verified.add(identity)


def _identity(path: Path, sha256: str) -> tuple[str | int, ...]:
    """Another one as soon as the file may have changed: a modification time can be set back, a change's cannot."""
    status = path.stat()
    times = status.st_mtime_ns, status.st_ctime_ns
    return str(path.resolve()), status.st_dev, status.st_ino, status.st_size, *times, sha256


class _Folder:
    """A folder of this machine."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def manifest(self, name: str, patience_s: float = PATIENCE_S) -> bytes:
        return read_replaced(self._folder / name)

    def read(self, name: str, start: int, stop: int) -> bytes:
        with (self._folder / name).open("rb") as file:
            file.seek(start)
            return _whole(file.read(stop - start), f"{self._folder}/{name}", start, stop)

    def shard(
        self, name: str, sha256: str, size: int, patience_s: float = PATIENCE_S, spared: Collection[str] | None = ()
    ) -> Path:
        path = self._folder / name
        try:
            verify_file(path, sha256, size, "delete it and run the generator again")
        except FileNotFoundError:
            raise ConfigError(f"{path} is listed in the manifest but missing; run the generator again") from None
        return path


@functools.lru_cache(maxsize=16)
def _remote(url: str) -> _Remote:
    return _Remote(url)


class _Remote:
    """A URL that fsspec reads."""

    def __init__(self, url: str) -> None:
        import fsspec  # loads for a while, and local data sets need none of it

        self._url, hub = url, url.startswith(PREFIX)
        address = HubPlace.parse(url, "dataset.folder").address if hub else url
        self._http = address.startswith(("http://", "https://"))
        options: dict[str, Any] = {}
        if self._http:
            import aiohttp

            from hgn.data.bounded_http import BoundedResponse

            token = hub_token() if hub else dataset_token() if _token_is_for(url) else None
            timeout = aiohttp.ClientTimeout(total=None, connect=_CONNECT_S, sock_read=_SILENCE_S)
            # packed, a small answer could become a large one
            headers = {"Accept-Encoding": "identity"}
            if token is not None:
                headers["Authorization"] = f"Bearer {token}"
            client = {
                "headers": headers,
                "timeout": timeout,
                "auto_decompress": False,
                "response_class": BoundedResponse,
            }
            options = {"client_kwargs": client, "use_listings_cache": False}
        try:
            self._files, self._root = fsspec.core.url_to_fs(address, **options)
        except (ValueError, ImportError) as error:
            cause = error.__cause__  # of fsspec's ImportError: which package is missing
            reason = (isinstance(cause, ModuleNotFoundError) and missing_extra(cause)) or error
            raise ConfigError(
                f"dataset.folder must be a folder or a URL that fsspec can read, got {url!r} ({reason})"
            ) from None
        self._known: tuple[bytes, str] | None = None  # the manifest last read, and its ETag at a dataset service
        self._lock = threading.Lock()
        self._away = (0.0, "")  # until when, and why, who has no patience need not ask

    def manifest(self, name: str, patience_s: float = PATIENCE_S) -> bytes:
        with self._lock:
            self._require_not_away(name, patience_s)
            options: dict[str, Any] = {}
            if self._http and self._known is not None:
                options["headers"] = {"If-None-Match": self._known[1]}
            content = self._patiently(name, patience_s, lambda path: self._files.cat_file(path, **options))
            if not content and self._known is not None:  # not modified
                return self._known[0]
            self._known = content, f'"{hashlib.sha256(content).hexdigest()}"'
            return content

    def read(self, name: str, start: int, stop: int) -> bytes:
        read = _read_range(self._files, start, stop)

        def whole(path: str) -> bytes:
            data = read(path)
            if self._http and len(data) < stop - start:
                raise ConnectionError(f"{len(data)} bytes instead of {stop - start}: a proxy may have an older file")
            return data

        data = self._patiently(name, PATIENCE_S, whole)
        if len(data) > stop - start:  # from a server without ranges
            data = data[start:stop]
        return _whole(data, f"{self._url}/{name}", start, stop)

    def shard(
        self, name: str, sha256: str, size: int, patience_s: float = PATIENCE_S, spared: Collection[str] | None = ()
    ) -> Path:
        path = cache_folder() / f"{sha256}.tar"
        remedy = "it is fetched again"
        for again in (True, False):
            if not path.exists():
                try:
                    self._fetch(name, sha256, size, path, patience_s, spared)
                except FileNotFoundError:
                    raise ConfigError(
                        f"{self._url}/{name} is listed in the manifest but missing; run the generator again"
                    ) from None
            try:
                verify_file(path, sha256, size, remedy)
            except (ConfigError, FileNotFoundError) as error:  # this machine's disk, or somebody cleaning up
                if not again:
                    raise
                print(error, file=sys.stderr)
                path.unlink(missing_ok=True)
            else:
                break
        return path

    def write(self, name: str, source: Path | bytes) -> None:
        def put(path: str) -> None:
            if isinstance(source, bytes):
                self._files.pipe_file(path, source)
            else:
                self._files.put_file(str(source), path)

        expected = len(source) if isinstance(source, bytes) else source.stat().st_size
        try:
            self._patiently(name, PATIENCE_S, put)
            self._files.invalidate_cache()
            written = self._files.info(f"{self._root}/{name}")["size"]
        except (NotImplementedError, FileNotFoundError) as error:
            raise ConfigError(
                f"{self._url} must be a place to write to, got {type(error).__name__} for {name}; see that it exists, "
                "and that its protocol knows writing"
            ) from None
        if written != expected:
            raise ConfigError(f"{self._url}/{name} must have {expected} bytes, got {written}; copy it again")

    def _fetch(
        self, name: str, sha256: str, size: int, path: Path, patience_s: float, spared: Collection[str] | None
    ) -> None:
        self._require_not_away(name, patience_s)
        _make_folder(path.parent)
        with _owned(path, f"{self._url}/{name}", patience_s) as file:
            if file is None:
                return
            while True:  # room is made by the file's owner alone: two that need one shard would make it twice
                over = _bytes_over(path.parent, size)
                try:
                    if over > 0:
                        raise OSError(errno.ENOSPC, f"the cache is full ({LIMIT_VARIABLE})", str(path))
                    self._fill_whole(file, name, sha256, size, patience_s)
                    break
                except OSError as error:
                    if error.errno not in (errno.ENOSPC, errno.EDQUOT) or spared is None:
                        raise
                    if not _make_room(path.parent, max(over, size), spared):
                        raise
            # it is the last one that was brought, wherever this machine's clock stood before
            latest = max((time_ns for time_ns, _, _ in _cached(path.parent)), default=0)
            if os.fstat(file.fileno()).st_mtime_ns <= latest:
                os.utime(file.fileno(), ns=(latest + 1, latest + 1))
            Path(file.name).replace(path)
        sync_folder(path.parent)
        _verified.add(_identity(path, sha256))

    def _fill_whole(self, file: io.BufferedRandom, name: str, sha256: str, size: int, patience_s: float) -> None:
        # what a process that ended had fetched is gone on with, unless the disk did not keep it
        for resume in (True, False):
            if not resume:
                file.truncate(0)
            if self._fill(file, name, size, patience_s) == sha256:
                break
        else:
            raise ConfigError(
                f"{self._url}/{name} must have sha256 {sha256}, got other bytes: it was altered; generate it again"
            )
        os.fsync(file.fileno())

    def _fill(self, file: io.BufferedRandom, name: str, size: int, patience_s: float) -> str:
        """Appends what is missing and returns the sha256 of the whole."""
        if os.fstat(file.fileno()).st_size > size:
            file.truncate(0)
        file.seek(0)
        digest = hashlib.file_digest(file, "sha256")
        have = file.seek(0, os.SEEK_END)
        while have < size:
            stop = min(have + _CHUNK_BYTES, size)
            data = self._patiently(name, patience_s, _read_range(self._files, have, stop))
            if len(data) == size > stop - have:  # from a server without ranges
                data = data[have:]
            elif len(data) != stop - have:
                raise ConfigError(
                    f"{self._url}/{name} must have {size} bytes, got {have + len(data)}; it was cut: generate it again"
                )
            file.write(data)
            digest.update(data)
            have += len(data)
        file.flush()
        return digest.hexdigest()

    def _require_not_away(self, name: str, patience_s: float) -> None:
        if not patience_s and time.monotonic() < self._away[0]:
            raise UnreachableError(f"{self._url}/{name}", patience_s, self._away[1])

    def _patiently(self, name: str, patience_s: float, read: Callable[[str], T]) -> T:
        """Reads, again and again while the server is away. Raises: as `Storage.manifest`."""
        begin, pause, said = time.monotonic(), _FIRST_PAUSE_S, False
        while True:
            try:
                result = read(f"{self._root}/{name}")
                self._away = 0.0, ""
                return result
            except FileNotFoundError:
                raise
            except Exception as error:
                cause = _transient(error, f"{self._url}/{name}")
                if cause is None:
                    raise
                if time.monotonic() - begin + pause > patience_s or _without_patience.is_set():
                    # a machine that is switched off costs _CONNECT_S at each asking
                    self._away = time.monotonic() + _AWAY_S, cause
                    raise UnreachableError(f"{self._url}/{name}", patience_s, cause) from error
                if not said and pause > 1:
                    said = True
                    print(f"{self._url} does not answer ({cause}); trying for {patience_s:.0f} s", file=sys.stderr)
                # no two readers come back at the same moment
                _without_patience.wait(pause * random.uniform(0.5, 1.0))
                pause = min(2 * pause, _LONGEST_PAUSE_S)


def _whole(data: bytes, path: str, start: int, stop: int) -> bytes:
    if len(data) != stop - start:
        raise ConfigError(f"{path} must have {stop} bytes, got {start + len(data)}; it was cut: generate it again")
    return data


def _cached(folder: Path) -> list[tuple[int, int, Path]]:
    """Of each shard in the cache when it was brought, its bytes and path; others may take them away meanwhile."""
    found = []
    for path in folder.glob("*.tar"):
        with contextlib.suppress(FileNotFoundError):
            status = path.stat()
            found.append((status.st_mtime_ns, status.st_size, path))
    return sorted(found)


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


def _read_range(files: Any, start: int, stop: int) -> Callable[[str], bytes]:
    return lambda path: files.cat_file(path, start=start, end=stop)


def _transient(error: Exception, url: str) -> str | None:
    """What to say of an error that may pass; none of one that is not the network's. Raises: ConfigError (refused)."""
    status = getattr(error, "status", None)
    if status in (401, 403) or isinstance(error, PermissionError):
        raise ConfigError(
            f"{url} must be open to this program, got refused; set {TOKEN_VARIABLE} to the service's token, which "
            f"goes to {TOKEN_HOST_VARIABLE} alone where that is set (an object store asks for its own credentials, the "
            "Hugging Face Hub for HF_TOKEN)"
        ) from None
    if status == 410:
        raise ConfigError(f"{url} is damaged at its service; delete it there and run the generator again") from None
    # 416: beyond the end of an index file that a proxy remembers
    if isinstance(status, int) and 400 <= status < 500 and status not in (408, 416, 425, 429):
        raise ConfigError(
            f"{url} must be a file of a data set, got the answer {status}; check dataset.folder"
        ) from None
    packages = {kind.__module__.partition(".")[0] for kind in type(error).__mro__}
    if not isinstance(error, OSError) and not packages & _NETWORK_PACKAGES:
        return None
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return None
    return " ".join(str(error).split()) or type(error).__name__


@contextlib.contextmanager
def _owned(path: Path, url: str, patience_s: float) -> Iterator[io.BufferedRandom | None]:
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
            except (ConfigError, FileNotFoundError):
                partial.unlink(missing_ok=True)
                raise
            except OSError as error:
                if error.errno in (errno.ENOSPC, errno.EDQUOT):
                    error.filename = error.filename or str(path)
                    partial.unlink(missing_ok=True)
                raise
            return


def _take(file: io.BufferedRandom, url: str, patience_s: float) -> None:
    """The file's lock. A process that was stopped may have it: it is waited for while what it brings grows."""
    size, begin = -1, time.monotonic()
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            now, size = size, os.fstat(file.fileno()).st_size
            if now != size:
                begin = time.monotonic()
            if time.monotonic() - begin >= patience_s or _without_patience.is_set():
                raise UnreachableError(url, patience_s, "another process is fetching it") from None
            _without_patience.wait(_LOCK_PAUSE_S)


def _open_file(name: str, flags: int) -> int:
    return os.open(name, flags | os.O_NOFOLLOW, 0o644)


def _is_same(file: io.BufferedRandom, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
