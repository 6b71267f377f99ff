"""Retries requests to storage that does not answer, with growing pauses, for a limited time.

`HGN_PATIENCE_S` is this time in seconds. The default is two minutes.
"""

import contextlib
import errno
import math
import os
import random
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from hgn.schema import ConfigError, printable, require

VARIABLE = "HGN_PATIENCE_S"
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 10.0
# errors of a file server or of the way to it; others at the start of a training may be mistakes in a name
OF_SERVERS = {errno.EIO, errno.ESTALE, errno.ENOTCONN, errno.ETIMEDOUT, errno.EREMOTEIO, errno.EHOSTDOWN}
OF_SERVERS |= {errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ENETDOWN, errno.ECONNRESET, errno.ECONNABORTED}

T = TypeVar("T")
without = threading.Event()  # while this is set, no thread waits to read


class AwayError(ConfigError):
    """Files of a run are missing, perhaps temporarily."""


class UnreachableError(OSError):
    """Reports a server that did not answer within the patience."""

    def __init__(self, url: str, patience_s: float, cause: str) -> None:
        self.cause = cause
        super().__init__(errno.ETIMEDOUT, f"no answer for {patience_s:.0f} s (last cause: {cause})", url)


def standard_patience_s() -> float:
    """Returns how long storage may be unreachable, in seconds. Raises ConfigError unless the variable is a number."""
    given = os.environ.get(VARIABLE, "120")
    number = float(given) if given.replace(".", "", 1).isdecimal() else math.nan
    require(0 <= number <= 1e6, VARIABLE, "a number of seconds from 0 to 1000000", given)
    return number


@contextlib.contextmanager
def inside(event: threading.Event) -> Iterator[None]:
    """Sets an event until the outermost such block ends."""
    outermost = not event.is_set()
    event.set()
    try:
        yield
    finally:
        if outermost:
            event.clear()


def without_patience() -> contextlib.AbstractContextManager[None]:
    """Returns a context in which no thread of this process waits to read from a server that does not answer."""
    return inside(without)


def outlived(write: Callable[[], T], path: Path, start: bool = False) -> T:
    """Returns `write()`, and retries it for the standard patience if a file of a run cannot be written or is away.

    Raises UnreachableError with `path`, or AwayError; at once IsADirectoryError and NotADirectoryError, and at the
    start of a training all errors but OF_SERVERS.
    """

    def cause(error: Exception) -> str | None:
        lasting = isinstance(error, (IsADirectoryError, NotADirectoryError, UnreachableError))
        lasting |= start and getattr(error, "errno", errno.EIO) not in OF_SERVERS
        return str(error) if isinstance(error, (OSError, AwayError)) and not lasting else None

    return patiently(write, cause, str(path), str(path.parent), standard_patience_s(), ended=threading.Event())


def patiently(
    ask: Callable[[], T],
    passing: Callable[[Exception], str | None],
    url: str,
    server: str,
    patience_s: float,
    ended: threading.Event = without,
) -> T:
    """Returns `ask()`, and retries it while `passing` returns the cause of its error. None marks a permanent error.

    While `ended` is set it does not wait.
    Raises UnreachableError with `url`, or a permanent error. A ConfigError that stays is raised itself.
    """
    start, pause, warned = time.monotonic(), FIRST_PAUSE_S, False
    while True:
        try:
            return ask()
        except Exception as error:
            cause = passing(error)
            if cause is None:
                raise
            if time.monotonic() - start + pause > patience_s or ended.is_set():
                if isinstance(error, ConfigError):  # the storage answers, and the file stays damaged
                    raise
                raise UnreachableError(url, patience_s, cause) from error
            if not warned and pause > 1:
                warned = True
                # a ConfigError names a file that was read, and its fault
                fault = cause if isinstance(error, ConfigError) else f"{server} does not answer ({cause})"
                print(printable(f"{fault}; retrying for {patience_s:.0f} s"), file=sys.stderr)
            ended.wait(pause * random.uniform(0.5, 1.0))  # spreads the readers' retries in time
            pause = min(2 * pause, LONGEST_PAUSE_S)
