"""Stops a training on Ctrl-C, SIGTERM, SIGUSR1 (which schedulers send before the end), or at a time limit.

A signal sets a flag. The loop ends at the next update, after a checkpoint. A second Ctrl-C ends it immediately.
"""

import contextlib
import os
import signal
import time
from types import FrameType

from hgn.system.ranks import first_rank
from hgn.system.signals import Signals

# After several signals the last one in this order determines the exit code. A scheduler that sent SIGUSR1 queues the
# job again, and may send SIGTERM too.
BY_WEIGHT = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
STOPPING = b"\nstopping: an update that runs is completed and saved; Ctrl-C (SIGINT) then ends the command at once\n"


class StopRequest(Signals):
    """Records whether, and why, this process should stop training."""

    def __init__(self) -> None:
        super().__init__(self._tell, numbers=BY_WEIGHT)
        self.signal: int | None = None
        self._deadline: float | None = None

    def listen(self) -> None:
        """Installs handlers for SIGINT, SIGTERM and SIGUSR1. Only the main thread may call this.

        SIGHUP, unless it is ignored, ends the process, because Python's handlers do not run in a wait for other ranks.
        """
        super().listen()
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            signal.signal(signal.SIGHUP, signal.SIG_DFL)

    def end_at_once(self) -> None:
        """Lets a signal end the process until the next `listen`. While ranks wait for each other in C++, Python's
        handlers do not run."""
        for number in BY_WEIGHT:
            signal.signal(number, signal.SIG_DFL)

    def restart_clock(self, maximum_minutes: float | None) -> None:
        """Starts the time limit now, after the wait for data."""
        self._deadline = None if maximum_minutes is None else time.monotonic() + 60 * maximum_minutes

    @property
    def requested(self) -> bool:
        """Returns whether a signal was received, here or by another rank, or the time limit has passed."""
        return self.signal is not None or (self._deadline is not None and time.monotonic() > self._deadline)

    @property
    def exit_code(self) -> int:
        """Returns 128 + the signal's number, or 0 without a signal."""
        return 0 if self.signal is None else 128 + self.signal

    def _tell(self, number: int) -> None:
        if self.signal is None and first_rank():
            with contextlib.suppress(OSError):  # the disk is full, or the terminal is closed
                os.write(2, STOPPING)  # a handler may interrupt a write to sys.stderr, which must not be entered again

    def _receive(self, number: int, frame: FrameType | None) -> None:
        super()._receive(number, frame)
        self.signal = max(self.signal or number, number, key=BY_WEIGHT.index)
