"""Reads the files of a data set from a local folder, or a URL (dataset service, file server, object store).

Shards of a URL are cached on this machine (`hgn.data.shard_cache`). `HGN_DATASET_TOKEN` is the token of a dataset
service. With `HGN_DATASET_HOST` only that host (or host:port) receives it.
"""

import contextlib
import errno
import functools
import hashlib
import ipaddress
import os
import re
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator
from contextvars import ContextVar
from io import BufferedRandom
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit
from urllib.request import getproxies, proxy_bypass_environment  # type: ignore[attr-defined]

from hgn.data.shard_cache import Append, CachedShard, cached_shard
from hgn.data.verification import StorageError, verify_file
from hgn.schema import ConfigError, near_name, require
from hgn.system.extras import missing_extra
from hgn.system.files import errors_name, open_at_once, read_replaced
from hgn.system.hub import PREFIX, HubPlace, hub_token, is_loopback, refused_by_proxy
from hgn.system.patience import UnreachableError, inside, patiently, standard_patience_s

TOKEN_VARIABLE = "HGN_DATASET_TOKEN"
TOKEN_HOST_VARIABLE = "HGN_DATASET_HOST"
_CHUNK_BYTES = 16 * 2**20  # bytes of a shard per request; a lost connection costs at most one request
_COMPARED_BYTES = 1 << 16  # at the beginning and at the end of a file that may have been copied
_CONNECT_S, _SILENCE_S, _ANSWER_S = 10.0, 60.0, 1800.0  # limits: to connect, between two pieces, for a whole answer
_AWAY_S = 10.0  # for this time after a failed request, calls with patience_s=0 fail without a request
_PROXY = re.compile(r"http://([^\s/?#]+@)?([\w.-]+|\[[\w.:]+\])(?::(\d{1,5}))?/?")
_HTTP = ("http", "https")
_NETWORK_PACKAGES = {"aiohttp", "botocore", "aiobotocore", "gcsfs", "google", "azure"}

T = TypeVar("T")
_AGAIN = "run the generator again, or import the set again"
_outliving = threading.Event()
_once = ContextVar("once", default=False)


def faults_outlived() -> contextlib.AbstractContextManager[None]:
    """Lets `ask` repeat failed reads for the standard patience. A running training uses it: faults may be temporary."""
    return inside(_outliving)


def outliving() -> bool:
    """Returns whether failed reads are repeated (see `faults_outlived`)."""
    return _outliving.is_set()


@contextlib.contextmanager
def asked_once() -> Iterator[None]:
    """Ends failed reads of this thread without a retry, because the caller reads the manifest again."""
    token = _once.set(True)
    try:
        yield
    finally:
        _once.reset(token)


def ask(folder: Path | str, read: "Callable[[Storage], T]") -> T:
    """Returns the result of `read` for a data set. Raises: as `read`; inside `faults_outlived` UnreachableError too."""
    storage, place = open_storage(folder), str(folder)
    if _once.get() or not outliving():
        return read(storage)
    return patiently(lambda: read(storage), _may_pass, place, place, standard_patience_s())


def _may_pass(error: Exception) -> str | None:
    lasting = isinstance(error, UnreachableError) or getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)
    return " ".join(str(error).split()) if isinstance(error, (StorageError, OSError)) and not lasting else None


class Storage(ABC):
    """Reads the files of a data set in a folder or at a URL."""

    @abstractmethod
    def manifest(self, name: str, patience_s: float | None = None) -> bytes:
        """Returns the manifest's bytes. Raises: FileNotFoundError; UnreachableError; ConfigError (no access)."""

    @abstractmethod
    def read(self, name: str, start: int, stop: int) -> bytes:
        """Returns a range of a file. Raises: as `manifest`; ConfigError for a file that is too short."""

    @abstractmethod
    def shard(
        self, name: str, sha256: str, size: int, patience_s: float | None = None, spared: Collection[str] | None = ()
    ) -> Path:
        """Returns the path of a verified shard on this machine.

        A full cache removes other shards, except those with a sha256 in `spared`; with None it removes none.
        Raises: ConfigError; UnreachableError; OSError (full disk or cache).
        """


def is_remote(folder: Path | str) -> bool:
    """Returns whether a data set is at a URL."""
    return "://" in str(folder) and not str(folder).startswith("file://")


def local_folder(folder: Path | str) -> Path:
    """Returns the path of a data set that is not remote."""
    return Path(str(folder).removeprefix("file://"))


def open_storage(folder: Path | str) -> Storage:
    """Returns the storage of a data set; the same object for the same URL.

    Raises: ConfigError for a URL with an unknown protocol, or whose package is not installed.
    """
    if is_remote(folder):
        return remote_storage(str(folder))
    path, typo = local_folder(folder), re.match(r"(\w+):/(?!/)|(hf)//", str(folder))
    if typo and not path.exists():
        remedy = f"did you mean {typo[1] or typo[2]}://{str(folder)[typo.end() :]}?"
        require(False, "dataset.folder", "a folder or a URL", str(folder), remedy)
    return _Folder(path)


def _uses_proxies(url: str) -> bool:
    """Returns whether a URL is read through a proxy of the environment, if there is one. Raises: ConfigError.

    Rewrites http_proxy and https_proxy for aiohttp, which requires a scheme in them and ignores all_proxy. Networks in
    no_proxy, which it ignores too, are handled here.
    """
    address, given = urlsplit(url), getproxies()
    others = re.split(r"[\s,;]+", given.get("no", ""))
    names = ",".join(name.removeprefix("*") or name for name in others)
    direct = proxy_bypass_environment(address.netloc.rpartition("@")[2], {"no": names})
    if is_loopback(url) or direct or any(_lies_in(address.hostname or "", name) for name in others):
        return False
    for kind in ("http", "https"):
        proxy = (given.get(kind) or given.get("all", "")).strip()
        if proxy:
            proxy = proxy if "://" in proxy else f"http://{proxy}"
            match, name = _PROXY.fullmatch(proxy), f"{kind if given.get(kind) else 'all'}_proxy"
            fits = match is not None and int(match[3] or 0) < 1 << 16
            require(fits, name, "of the form http://host:port", proxy, "with %23 for # in a password, or set no_proxy")
            os.environ[f"{kind}_proxy"] = proxy
    return True


def _lies_in(host: str, network: str) -> bool:
    """Returns whether an address lies in a network such as 10.0.0.0/8."""
    try:
        return ipaddress.ip_address(host) in ipaddress.ip_network(network, strict=False)
    except ValueError:  # a name
        return False


def _require_address(url: str) -> None:
    """Refuses a URL without a host or path, or whose host or port is malformed. Raises: ConfigError."""
    try:
        address = urlsplit(url)
        _ = address.port  # raises ValueError for a malformed port, as this does for a host that DNS cannot contain
        (address.hostname or "").encode("idna" if address.scheme in _HTTP else "utf-8")
    except ValueError as error:
        raise ConfigError(f"dataset.folder must be a folder or a URL, got {url!r} ({error})") from None
    place = (address.netloc + address.path).strip("/")
    rule = "a folder or a URL with a host or path"  # a data: URL is its own content
    require(bool(place) and address.scheme != "data", "dataset.folder", rule, url)


def dataset_token() -> str | None:
    """Returns the token of $HGN_DATASET_TOKEN. Raises: ConfigError if an HTTP header cannot contain it."""
    token = os.environ.get(TOKEN_VARIABLE)
    if token is None:
        return None
    plain = token.isascii() and token.isprintable() and " " not in token
    require(
        plain and len(token) >= 16, TOKEN_VARIABLE, "16 or more printable ASCII characters", f"{len(token)} of them"
    )
    return token


class _Folder(Storage):
    """Reads a local folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def manifest(self, name: str, patience_s: float | None = None) -> bytes:
        return read_replaced(self._folder / name)

    def read(self, name: str, start: int, stop: int) -> bytes:
        with errors_name(self._folder / name), open_at_once(self._folder / name) as file:
            if (size := os.fstat(file.fileno()).st_size) < stop:
                raise _cut(f"{self._folder}/{name}", stop, size)
            file.seek(start)
            return _whole(file.read(stop - start), f"{self._folder}/{name}", start, stop)

    def shard(
        self, name: str, sha256: str, size: int, patience_s: float | None = None, spared: Collection[str] | None = ()
    ) -> Path:
        path = self._folder / name
        try:
            verify_file(path, sha256, size, f"use an intact copy, or delete it and {_AGAIN}")
        except FileNotFoundError:
            raise _missing(path) from None
        return path


@functools.lru_cache(maxsize=16)
def remote_storage(url: str) -> "RemoteStorage":
    """Returns the storage of a URL. Raises: ConfigError, as `open_storage`."""
    _require_address(url)
    return RemoteStorage(url.rstrip("/"))


class RemoteStorage(Storage):
    """Reads and writes a data set at a URL through fsspec."""

    def __init__(self, url: str) -> None:
        import fsspec  # importing it is slow, and local data sets do not need it

        self._url, hub = url, url.startswith(PREFIX)
        place = HubPlace.parse(url, "dataset.folder") if hub else None
        rule = "of a repository of data sets, hf://datasets/USER/NAME"
        require(place is None or place.is_dataset, "dataset.folder", rule, url)
        address = place.address if place else url
        self._http = urlsplit(address).scheme in _HTTP
        options: dict[str, Any] = {}
        if self._http:
            import aiohttp

            from hgn.data.bounded_http import BoundedResponse

            named, to = os.environ.get(TOKEN_HOST_VARIABLE), urlsplit(url)
            own = not named or named in (to.hostname, f"{to.hostname}:{to.port}")
            token = hub_token() if hub else dataset_token() if own else None
            timeout = aiohttp.ClientTimeout(total=_ANSWER_S, connect=_CONNECT_S, sock_read=_SILENCE_S)
            # a small compressed answer could expand without limit
            headers = {"Accept-Encoding": "identity"}
            if token is not None:
                headers["Authorization"] = f"Bearer {token}"
            client = {
                "headers": headers,
                "timeout": timeout,
                "auto_decompress": False,
                "response_class": BoundedResponse,
                "trust_env": _uses_proxies(address),
            }
            options = {"client_kwargs": client, "use_listings_cache": False}
        try:
            if self._http:  # url_to_fs would take :: in an IPv6 address for the end of a protocol
                self._files, self._root = fsspec.filesystem(urlsplit(address).scheme, **options), address
            else:
                self._files, self._root = fsspec.core.url_to_fs(address, **options)
        except (ValueError, TypeError, ImportError) as error:
            cause = error.__cause__  # the missing package's error caused fsspec's ImportError
            reason = (isinstance(cause, ModuleNotFoundError) and missing_extra(cause)) or error
            near = near_name(url.partition(":")[0], fsspec.available_protocols())
            text = f"dataset.folder must be a folder or a URL that fsspec can read, got {url!r} ({reason}); {near}"
            raise ConfigError(text.removesuffix("; ")) from None
        self._manifest: tuple[bytes, str] | None = None  # the last manifest, and its ETag at a dataset service
        self._lock = threading.Lock()
        self._away = (0.0, "")  # time until which calls with patience_s=0 fail without a request, and the cause

    def manifest(self, name: str, patience_s: float | None = None) -> bytes:
        with self._lock:
            self._require_not_away(name, patience_s)
            options: dict[str, Any] = {}
            if self._http and self._manifest is not None:
                options["headers"] = {"If-None-Match": self._manifest[1]}
            content = self._patiently(name, patience_s, lambda path: self._files.cat_file(path, **options))
            if not content and self._manifest is not None:  # the server answered that it is not modified
                return self._manifest[0]
            self._manifest = content, f'"{hashlib.sha256(content).hexdigest()}"'
            return content

    def read(self, name: str, start: int, stop: int) -> bytes:
        def whole(path: str) -> bytes:
            data: bytes = self._files.cat_file(path, start=start, end=stop)
            if self._http and len(data) < stop - start:
                raise ConnectionError(f"{len(data)} bytes instead of {stop - start}: a proxy may have an older file")
            return data

        data = self._patiently(name, None, whole)
        if len(data) > stop - start:  # the server does not support ranges
            data = data[start:stop]
        return _whole(data, f"{self._url}/{name}", start, stop)

    def shard(
        self, name: str, sha256: str, size: int, patience_s: float | None = None, spared: Collection[str] | None = ()
    ) -> Path:
        def fill(file: BufferedRandom, append: Append) -> None:
            self._require_not_away(name, patience_s)
            try:
                # the second attempt fetches every byte: the disk may have lost bytes that an earlier process wrote
                if self._fill(file, append, name, size, patience_s) == sha256:
                    return
                file.truncate(0)
                if self._fill(file, append, name, size, patience_s) == sha256:
                    return
            except FileNotFoundError:
                raise _missing(f"{self._url}/{name}") from None
            raise StorageError(
                f"{self._url}/{name} must have sha256 {sha256}, got other bytes: it was altered; generate it again"
            )

        wait_s = standard_patience_s() if patience_s is None else patience_s
        return cached_shard(CachedShard(f"{self._url}/{name}", sha256, size), wait_s, spared, fill)

    def write(self, name: str, source: Path | bytes) -> None:
        """Writes a file, or bytes. Raises: ConfigError if writing fails; UnreachableError."""

        def put(path: str) -> None:
            if isinstance(source, bytes):
                self._files.pipe_file(path, source)
            else:
                self._files.put_file(str(source), path)

        expected = len(source) if isinstance(source, bytes) else source.stat().st_size
        try:
            self._patiently(name, None, put)
            self._files.invalidate_cache()
            written = self._files.info(f"{self._root}/{name}")["size"]
        except (NotImplementedError, FileNotFoundError) as error:
            raise ConfigError(
                f"{self._url} must be writable, got {type(error).__name__} for {name}; check that it exists "
                "and that its protocol supports writing"
            ) from None
        if written != expected:
            raise ConfigError(f"{self._url}/{name} must have {expected} bytes, got {written}; copy it again")

    def has(self, name: str, source: Path) -> bool:
        """Returns whether an earlier `write` was completed: size, beginning and end are those of the source."""
        size = source.stat().st_size
        try:
            if self._patiently(name, None, lambda path: self._files.info(path)["size"]) != size:
                return False
            with source.open("rb") as file:
                for start in (0, max(0, size - _COMPARED_BYTES)):
                    file.seek(start)
                    part = file.read(_COMPARED_BYTES)
                    if self.read(name, start, start + len(part)) != part:
                        return False
        except FileNotFoundError:
            return False
        return True

    def _fill(self, file: BufferedRandom, append: Append, name: str, size: int, patience_s: float | None) -> str:
        """Appends the missing bytes. Returns the sha256 of the whole file."""
        if os.fstat(file.fileno()).st_size > size:
            file.truncate(0)
        file.seek(0)
        digest = hashlib.file_digest(file, "sha256")
        have = file.seek(0, os.SEEK_END)
        while have < size:
            stop = min(have + _CHUNK_BYTES, size)
            read = functools.partial(self._files.cat_file, start=have, end=stop)
            data = self._patiently(name, patience_s, read)
            if len(data) == size > stop - have:  # the server does not support ranges
                data = data[have:]
            elif len(data) != stop - have:
                raise _cut(f"{self._url}/{name}", size, have + len(data))
            append(data)
            digest.update(data)
            have += len(data)
        return digest.hexdigest()

    def _require_not_away(self, name: str, patience_s: float | None) -> None:
        if patience_s == 0 and time.monotonic() < self._away[0]:
            raise UnreachableError(f"{self._url}/{name}", 0.0, self._away[1])

    def _patiently(self, name: str, patience_s: float | None, read: Callable[[str], T]) -> T:
        """Reads, and retries while the server does not answer. Raises: as `Storage.manifest`."""
        url, path = f"{self._url}/{name}", f"{self._root}/{name}"
        if patience_s is None:
            patience_s = 0.0 if _once.get() else standard_patience_s()
        try:
            result = patiently(lambda: read(path), lambda error: _transient(error, url), url, self._url, patience_s)
        except UnreachableError as error:
            # otherwise each request to a switched-off machine would take _CONNECT_S
            self._away = time.monotonic() + _AWAY_S, error.cause
            raise
        self._away = 0.0, ""
        return result


def _whole(data: bytes, path: str, start: int, stop: int) -> bytes:
    if len(data) != stop - start:
        raise _cut(path, stop, start + len(data))
    return data


def _cut(path: str, size: int, got: int) -> StorageError:
    return StorageError(f"{path} must have {size} bytes, got {got}; it is truncated: generate it again")


def _missing(path: Path | str) -> StorageError:
    return StorageError(f"{path} is listed in the index but missing; {_AGAIN}")


def _transient(error: Exception, url: str) -> str | None:
    """Returns the cause of a temporary error, or None for another one. Raises: StorageError (access refused)."""
    if isinstance(error, FileNotFoundError):
        return None
    malformed = type(error.__cause__).__module__ == "aiohttp.http_exceptions"  # aiohttp sets status 400 for it
    status = None if malformed else getattr(error, "status", None)
    # 416: a proxy has an older, shorter index file
    lasting = isinstance(status, int) and 400 <= status < 500 and status not in (408, 416, 425, 429)
    if lasting and (status == 407 or type(error).__name__ == "ClientHttpProxyError"):
        raise StorageError(refused_by_proxy(url, status)) from None
    if status in (401, 403) or isinstance(error, PermissionError):
        either = url.startswith("http://") and "http" in getproxies() and _uses_proxies(url)
        raise StorageError(
            f"{url} must be accessible, got access refused{' by its server or the proxy of http_proxy' * either}; "
            f"set {TOKEN_VARIABLE} to the service's token (if {TOKEN_HOST_VARIABLE} is set, only that host receives "
            "it; object stores need their own credentials, the Hugging Face Hub needs HF_TOKEN)"
        ) from None
    if status == 410:
        raise StorageError(f"{url} is damaged on its server; delete it there and {_AGAIN}") from None
    if lasting:
        raise StorageError(f"{url} must be a file of a data set, got status {status}; check dataset.folder") from None
    packages = {kind.__module__.partition(".")[0] for kind in type(error).__mro__}
    if not isinstance(error, OSError) and not packages & _NETWORK_PACKAGES:
        return None
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return None
    return " ".join(str(error).split()) or type(error).__name__
