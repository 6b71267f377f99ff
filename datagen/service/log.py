"""The service's log. It does not stop the service if its reader stops reading.

A write to a full pipe waits until its reader continues (`| less`, a stopped `tee`, a log daemon that hangs). The
service, its pool and every solver would wait too, each at its next line. Here their lines go through a pipe that is
always read. Lines that the log does not accept are dropped.
"""

import contextlib
import os
import queue
import select
import sys
import threading
import time
from collections.abc import Sequence

_PIECE_BYTES = 4096
_WAITING = 256  # largest number of waiting pieces
_END_S = 2.0  # time for waiting pieces at the end
_LEFT_OUT = b"\n(lines are missing here: nobody read the log)\n"


class UnhurriedLog:
    """While it is entered, output of this process and its children to `files` still reaches them if possible.

    It is a context manager. A terminal is written directly, because its user may stop the output."""

    def __init__(self, files: Sequence[int] = (1, 2)) -> None:
        self._files = files
        self._streams: list[_Stream] = []

    @property
    def error(self) -> str:
        """Returns the reason for which the last lines are not in the log."""
        return next((stream.error for stream in self._streams if stream.error), "")

    def __enter__(self) -> "UnhurriedLog":
        _flush()
        for file in self._files:
            if not os.isatty(file):
                self._streams.append(_Stream(file))
        return self

    def __exit__(self, *_: object) -> None:
        _flush()
        for stream in self._streams:
            stream.close()


class _Stream:
    def __init__(self, file: int) -> None:
        self.error = ""
        self._file, self._log, self._left_out = file, os.dup(file), False
        self._source, sink = os.pipe()
        os.dup2(sink, file)
        os.close(sink)
        self._pieces: queue.Queue[bytes] = queue.Queue(_WAITING)
        for target in (self._take, self._write):
            threading.Thread(target=target, daemon=True).start()

    def close(self) -> None:
        """Restores the file, unless the last lines still wait for its reader."""
        deadline = time.monotonic() + _END_S
        while waits := select.select([self._source], [], [], 0)[0] or self._pieces.unfinished_tasks:
            if time.monotonic() > deadline:
                break
            time.sleep(0.01)
        if not waits:
            os.dup2(self._log, self._file)

    def _take(self) -> None:
        while piece := os.read(self._source, _PIECE_BYTES):
            try:
                self._pieces.put_nowait(piece)
            except queue.Full:
                self._left_out, self.error = True, "its reader does not read it"
        self._pieces.put(b"")
        os.close(self._source)

    def _write(self) -> None:
        while piece := self._pieces.get():
            if self._left_out:
                self._left_out, piece = False, piece + _LEFT_OUT
            try:
                os.write(self._log, piece)
                self.error = ""
            except OSError as error:
                self.error = error.strerror or str(error)
            self._pieces.task_done()
        os.close(self._log)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
