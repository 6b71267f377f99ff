"""Waiting for servers that are away: asked again and again, with pauses that grow, until patience ends."""

from __future__ import annotations

import contextlib
import errno
import random
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 10.0

T = TypeVar("T")
without = threading.Event()  # set: nobody waits any more


class UnreachableError(OSError):
    """A server did not answer for as long as it was waited for."""

    def __init__(self, url: str, patience_s: float, cause: str) -> None:
        self.cause = cause
        super().__init__(errno.ETIMEDOUT, f"no answer for {patience_s:.0f} s (at last: {cause})", url)


@contextlib.contextmanager
def without_patience() -> Iterator[None]:
    """While it is entered no thread of this process waits for a server that does not answer: nobody needs it now."""
    without.set()
    try:
        yield
    finally:
        without.clear()


def patiently(
    ask: Callable[[], T], passing: Callable[[Exception], str | None], url: str, server: str, patience_s: float
) -> T:
    """What `ask` returns, asked again while what it raises may pass: `passing` says why, and nothing of what stays.

    Raises: UnreachableError in the name of `url`; what stays.
    """
    begin, pause, told = time.monotonic(), FIRST_PAUSE_S, False
    while True:
        try:
            return ask()
        except Exception as error:
            cause = passing(error)
            if cause is None:
                raise
            if time.monotonic() - begin + pause > patience_s or without.is_set():
                raise UnreachableError(url, patience_s, cause) from error
            if not told and pause > 1:
                told = True
                print(f"{server} does not answer ({cause}); trying for {patience_s:.0f} s", file=sys.stderr)
            without.wait(pause * random.uniform(0.5, 1.0))  # no two readers come back at the same moment
            pause = min(2 * pause, LONGEST_PAUSE_S)
