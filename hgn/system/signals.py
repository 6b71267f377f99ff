"""Receives the signals that end a command: SIGINT (Ctrl-C), SIGTERM and SIGHUP."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
ONE_REQUEST_S = 1.0  # terminals, launchers and services may repeat a signal of one request within this time


def interrupt(number: int) -> None:
    """Raises KeyboardInterrupt, for signals other than Ctrl-C with the number, which the exit code contains."""
    raise KeyboardInterrupt(*() if number == signal.SIGINT else (number,))


def nothing(number: int) -> None:
    """Ignores a signal."""


class Signals:
    """Receives signals inside a `with` block, in the main thread.

    It calls `first` with the number of the first one, and `again` for a SIGINT more than ONE_REQUEST_S later. It only
    records others, because the command may still write its results.
    """

    def __init__(
        self,
        first: Callable[[int], None] = nothing,
        again: Callable[[int], None] = interrupt,
        numbers: tuple[signal.Signals, ...] | None = None,  # None: those of ENDING that are not ignored
    ) -> None:
        self.received: list[int] = []
        self._first, self._again, self._numbers, self._since = first, again, numbers, 0.0

    def listen(self) -> None:
        """Installs the handlers. They stay until the block ends, or others replace them."""
        main = threading.current_thread() is threading.main_thread()
        self._before = {number: signal.getsignal(number) for number in self._numbers or ENDING if main}
        for number, handler in [*self._before.items()]:
            ignored = handler == signal.SIG_IGN and (self._numbers is None or number == signal.SIGHUP)  # nohup
            if handler is None or ignored:  # None: not of Python
                del self._before[number]
            else:
                signal.signal(number, self._receive)

    def call(self, first: Callable[[int], None]) -> None:
        """Sets the function for the first signal, and calls it if there was one."""
        self._first = first
        for number in self.received[:1]:
            first(number)

    def __enter__(self) -> "Signals":
        self.listen()
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            if signal.getsignal(number) == self._receive:  # a training's own handlers stay until the process ends
                signal.signal(number, handler)

    @property
    def requested(self) -> bool:
        """Returns whether a signal was received."""
        return bool(self.received)

    @property
    def exit_code(self) -> int:
        """Returns 128 + the first signal's number, or 0 without a signal."""
        return 128 + self.received[0] if self.received else 0

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self.received.append(number)
        if len(self.received) == 1:
            self._since = time.monotonic()
            self._first(number)
        elif number == signal.SIGINT and time.monotonic() - self._since > ONE_REQUEST_S:
            self._again(number)


@contextmanager
def signals_delayed() -> Iterator[Signals]:
    """Delays signals to the end of work that they would spoil. An error of the work is raised in their place."""
    with Signals(again=nothing) as signals:
        yield signals
    for number in signals.received[:1]:
        signal.raise_signal(number)
