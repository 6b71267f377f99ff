"""Reads the Hugging Face Hub: `hf://USER/NAME[@REVISION][/PATH]` is weights, `hf://datasets/USER/NAME` a data set.

Data sets are read by HTTP ranges from the Hub's file addresses. huggingface_hub downloads weights to its cache.
$HF_ENDPOINT names another server, and $HF_TOKEN is the token for private repositories.
"""

import functools
import ipaddress
import os
import re
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote, urlsplit
from urllib.request import getproxies

from hgn.schema import ConfigError, require
from hgn.system.patience import UnreachableError, patiently

PREFIX = "hf://"
_NAME = r"[\w.-]+"
_PATTERN = re.compile(rf"hf://(datasets/)?({_NAME}/{_NAME})(?:@([^/]+))?(?:/(.*))?")
_PATIENCE_S = 60.0
_DOWNLOAD_S = 600.0  # longest time of a whole answer; huggingface_hub limits only the time between two pieces
_PACKAGES = ("httpx", "httpx2", "httpcore", "httpcore2")
_PASSING = (408, 425, 429)

T = TypeVar("T")


@dataclass(frozen=True)
class HubPlace:
    """Names a place in a repository of the Hub."""

    repository: str  # USER/NAME
    revision: str
    path: str  # path in the repository; an empty path is the repository's root
    is_dataset: bool

    @staticmethod
    def parse(url: str, field: str) -> "HubPlace":
        """Parses an address. Raises ConfigError with `field`."""
        match = _PATTERN.fullmatch(url)
        if match is None:
            rule = "an address of the form hf://[datasets/]USER/NAME[@REVISION][/PATH]"
            raise ConfigError(f"{field} must be {rule}, got {url!r}")
        return HubPlace(match[2], match[3] or "main", (match[4] or "").strip("/"), match[1] is not None)

    @property
    def address(self) -> str:
        """Returns the URL of the repository's files."""
        kind = "datasets/" if self.is_dataset else ""
        return f"{endpoint()}/{kind}{self.repository}/resolve/{quote(self.revision, safe='')}/{self.path}".rstrip("/")


def endpoint() -> str:
    """Returns the Hub's server."""
    return os.environ.get("HF_ENDPOINT", "https://huggingface.co").rstrip("/")


def hub_token() -> str | None:
    """Returns the token of $HF_TOKEN."""
    return os.environ.get("HF_TOKEN") or None


def is_loopback(url: str) -> bool:
    """Returns whether a URL names this machine."""
    host = urlsplit(url).hostname or ""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def refused_by_proxy(name: str, answer: object) -> str:
    """Returns the message for an answer of a proxy instead of the server."""
    rule = "accessible through the proxy of http_proxy or https_proxy"
    return f"{name} must be {rule}, got its answer {answer}; give it the user and password it needs, or set no_proxy"


@functools.lru_cache(maxsize=64)
def hub_weights(url: str, field: str = "weights", patience_s: float = _PATIENCE_S) -> Path:
    """Downloads a weights file of a repository, the named or the only one, to huggingface_hub's cache.

    Raises ConfigError without such a file, for several, if access is refused, or if the server does not answer.
    """
    place = HubPlace.parse(url, field)
    import huggingface_hub  # slow to import, and optional

    require(not place.is_dataset, field, "the address of a repository of weights, hf://USER/NAME", url)
    direct, host = getproxies().get("no", ""), urlsplit(endpoint()).hostname
    if is_loopback(endpoint()) and host not in direct.split(","):
        os.environ["no_proxy"] = f"{direct},{host}".lstrip(",")
    try:
        huggingface_hub.get_session()
    except Exception as error:  # of httpx, of several kinds
        raise ConfigError(
            f"proxies of the environment must be of the form http://host:port, got {error}; or set no_proxy"
        ) from error
    api = huggingface_hub.HfApi(endpoint=endpoint(), token=hub_token())
    name = place.path
    if not name.endswith(".safetensors"):
        ask = functools.partial(api.list_repo_files, place.repository, revision=place.revision)
        folder = f"{name}/" if name else ""
        files = _patiently(ask, url, field, patience_s)
        inside = [file for file in files if file.endswith(".safetensors") and file.startswith(folder)]
        if len(inside) != 1:
            several = f"one of {', '.join(inside)}" if inside else "a repository with a .safetensors file"
            raise ConfigError(f"{field} must name {several}, got {url!r}")
        name = inside[0]
    bring = functools.partial(api.hf_hub_download, place.repository, name, revision=place.revision)
    return Path(_patiently(bring, url, field, patience_s))


def _patiently(ask: Callable[[], T], url: str, field: str, patience_s: float) -> T:
    """Repeats `ask` while the server does not answer. The errors of huggingface_hub and httpx are not OSErrors."""

    def answered() -> T:
        answer: Future[T] = Future()

        def fill() -> None:
            try:
                answer.set_result(ask())
            except BaseException as error:  # noqa: BLE001 - raised in the waiting thread
                answer.set_exception(error)

        threading.Thread(target=fill, name="hub", daemon=True).start()
        return answer.result(_DOWNLOAD_S)

    try:
        return patiently(answered, lambda error: _passing(error, url, field), url, endpoint(), patience_s)
    except UnreachableError as error:
        raise ConfigError(
            f"{field} must be reachable, got no answer from {endpoint()} for {url} in {patience_s:.0f} s "
            f"(last cause: {error.cause})"
        ) from error


def _passing(error: Exception, url: str, field: str) -> str | None:
    """Returns the cause of a temporary error, or None. Raises ConfigError for an error that repeating cannot fix."""
    from huggingface_hub import errors

    status = getattr(getattr(error, "response", None), "status_code", None)
    if status == 407 or (type(error).__name__ == "ProxyError" and str(error).startswith("4")):
        raise ConfigError(refused_by_proxy(field, f"{status or error} for {url}")) from None
    refused = isinstance(error, errors.RepositoryNotFoundError) or status in (401, 403)
    if refused:
        remedy = "check the name; a private repository needs a token in HF_TOKEN"
        raise ConfigError(f"{field} must be accessible, got {url} refused or not found; {remedy}") from None
    missing = isinstance(error, errors.EntryNotFoundError) and not isinstance(error, errors.LocalEntryNotFoundError)
    if missing or (isinstance(status, int) and 400 <= status < 500 and status not in _PASSING):
        raise ConfigError(f"{field} must be a file of the repository, got {url}, which has no such file") from None
    packages: set[Any] = {kind.__module__.partition(".")[0] for kind in type(error).__mro__}
    passes = isinstance(error, (errors.LocalEntryNotFoundError, OSError)) or packages & set(_PACKAGES)
    return (" ".join(str(error).split())[:200] or type(error).__name__) if passes else None
