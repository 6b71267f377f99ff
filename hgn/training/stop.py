"""Stopping a training: Ctrl-C, SIGTERM, SIGUSR1 (what schedulers send before the end), or the time a start was given.

A signal only raises a flag; the loop ends at the next update, after a checkpoint was written, and nothing is
lost. A second Ctrl-C does not wait.
"""

from __future__ import annotations

import signal
import time
from types import FrameType

# what a process that got several of them ends with: a scheduler that sent SIGUSR1 queues the job again, and sends
# SIGTERM too when it is in a hurry
BY_WEIGHT = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)


class StopRequest:
    """Whether, and why, this process should stop training."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self._deadline: float | None = None

    def listen(self) -> None:
        """Takes over SIGINT, SIGTERM and SIGUSR1; only the main thread may call this."""
        for number in BY_WEIGHT:
            signal.signal(number, self._on_signal)

    def restart_clock(self, maximum_minutes: float | None) -> None:
        """Counts the time from now: waiting for data is not training."""
        self._deadline = None if maximum_minutes is None else time.monotonic() + 60 * maximum_minutes

    @property
    def requested(self) -> bool:
        return self.signal is not None or self.out_of_time

    @property
    def out_of_time(self) -> bool:
        return self._deadline is not None and time.monotonic() > self._deadline

    @property
    def exit_code(self) -> int:
        """128 + the signal's number, or 0."""
        return 0 if self.signal is None else 128 + self.signal

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.signal = max(self.signal or number, number, key=BY_WEIGHT.index)
