"""Where a data set lies: a folder of this machine, or a URL (a dataset service, a file server, an object store).

Shards of a URL are kept on this machine (`hgn.data.shard_cache`). `HGN_DATASET_TOKEN` is the token that a dataset
service asks for, `HGN_DATASET_HOST` the only host (or host:port) that it is for.
"""

from __future__ import annotations

import errno
import functools
import hashlib
import os
import threading
import time
from collections.abc import Callable, Collection
from io import BufferedRandom
from pathlib import Path
from typing import Any, Protocol, TypeVar
from urllib.parse import urlsplit

from hgn.data.shard_cache import cached_shard
from hgn.data.verification import verify_file
from hgn.schema import ConfigError, require
from hgn.system.extras import missing_extra
from hgn.system.files import read_replaced
from hgn.system.hub import PREFIX, HubPlace, hub_token
from hgn.system.patience import UnreachableError, patiently

TOKEN_VARIABLE = "HGN_DATASET_TOKEN"
TOKEN_HOST_VARIABLE = "HGN_DATASET_HOST"
PATIENCE_S = 300.0  # with a server that does not answer: time enough to start a service again
_CHUNK_BYTES = 16 * 2**20  # of a shard at a time: what is lost when a connection is
_CONNECT_S, _SILENCE_S = 10.0, 60.0
_AWAY_S = 10.0
_NETWORK_PACKAGES = {"aiohttp", "botocore", "aiobotocore", "gcsfs", "google", "azure"}

T = TypeVar("T")


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


def local_folder(folder: Path | str) -> Path:
    """The path of a data set that is no remote one."""
    return Path(str(folder).removeprefix("file://"))


def open_storage(folder: Path | str) -> Storage:
    """The storage of a data set; of a URL the same one each time.

    Raises: ConfigError for a URL whose protocol is not known or not installed.
    """
    if is_remote(folder):
        return _remote(str(folder).rstrip("/"))
    return _Folder(local_folder(folder))


def write_remote(url: str, name: str, source: Path | bytes) -> None:
    """Writes a file, or bytes, to a data set's URL. Raises: ConfigError when that cannot be; UnreachableError."""
    _remote(url.rstrip("/")).write(name, source)


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
            raise ConfigError(f"{path} is listed in the index but missing; run the generator again") from None
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
        self._manifest: tuple[bytes, str] | None = None  # the manifest last read, and its ETag at a dataset service
        self._lock = threading.Lock()
        self._away = (0.0, "")  # until when, and why, who has no patience need not ask

    def manifest(self, name: str, patience_s: float = PATIENCE_S) -> bytes:
        with self._lock:
            self._require_not_away(name, patience_s)
            options: dict[str, Any] = {}
            if self._http and self._manifest is not None:
                options["headers"] = {"If-None-Match": self._manifest[1]}
            content = self._patiently(name, patience_s, lambda path: self._files.cat_file(path, **options))
            if not content and self._manifest is not None:  # not modified
                return self._manifest[0]
            self._manifest = content, f'"{hashlib.sha256(content).hexdigest()}"'
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
        def fill(file: BufferedRandom) -> None:
            try:
                self._fill_whole(file, name, sha256, size, patience_s)
            except FileNotFoundError:
                raise ConfigError(
                    f"{self._url}/{name} is listed in the index but missing; run the generator again"
                ) from None

        return cached_shard(f"{self._url}/{name}", sha256, size, patience_s, spared, fill)

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

    def _fill_whole(self, file: BufferedRandom, name: str, sha256: str, size: int, patience_s: float) -> None:
        self._require_not_away(name, patience_s)
        # what a process that ended had fetched is gone on with, unless the disk did not keep it
        for resume in (True, False):
            if not resume:
                file.truncate(0)
            if self._fill(file, name, size, patience_s) == sha256:
                return
        raise ConfigError(
            f"{self._url}/{name} must have sha256 {sha256}, got other bytes: it was altered; generate it again"
        )

    def _fill(self, file: BufferedRandom, name: str, size: int, patience_s: float) -> str:
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
        url, path = f"{self._url}/{name}", f"{self._root}/{name}"
        try:
            result = patiently(lambda: read(path), lambda error: _transient(error, url), url, self._url, patience_s)
        except UnreachableError as error:
            # a machine that is switched off costs _CONNECT_S at each asking
            self._away = time.monotonic() + _AWAY_S, error.cause
            raise
        self._away = 0.0, ""
        return result


def _whole(data: bytes, path: str, start: int, stop: int) -> bytes:
    if len(data) != stop - start:
        raise ConfigError(f"{path} must have {stop} bytes, got {start + len(data)}; it was cut: generate it again")
    return data


def _read_range(files: Any, start: int, stop: int) -> Callable[[str], bytes]:
    return lambda path: files.cat_file(path, start=start, end=stop)


def _transient(error: Exception, url: str) -> str | None:
    """What to say of an error that may pass; none of one that is not the network's. Raises: ConfigError (refused)."""
    if isinstance(error, FileNotFoundError):
        return None
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
