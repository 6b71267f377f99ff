"""Serves /healthz in a separate process at a separate port. A thread of the service would wait for Python's lock.

The service reports its state every second. After SILENCE_S without a report the answer is 503, because the
service hangs.
"""

import contextlib
import fcntl
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

SILENCE_S = 30.0
_PATIENCE_S = 2.0  # longest silence within a request
MOST_OPEN = 64  # connections; further ones close the oldest, because whole requests are answered without delay
_PIPE_BYTES = 4096  # size of the pipe, enough for the reports of a minute


class HealthPage:
    """Answers every request at `listener` with the last report; a context manager."""

    def __init__(self, listener: socket.socket) -> None:
        self._listener = listener

    def tell(self, status: int, content: dict[str, Any]) -> None:
        """Sets the answer without waiting. A process that ended or was stopped is replaced."""
        # JSON has up to 12 bytes for a character, and the kernel would write a part of a line longer than the pipe
        content = {name: str(text)[:300] for name, text in content.items()}
        try:
            os.write(self._reports, json.dumps([status, content]).encode() + b"\n")
        except (BlockingIOError, BrokenPipeError):
            self._end()
            self._begin()

    def __enter__(self) -> "HealthPage":
        self._begin()
        return self

    def __exit__(self, *_: object) -> None:
        self._end()
        self._listener.close()

    def _begin(self) -> None:
        command = [sys.executable, "-m", "datagen.service.health", str(self._listener.fileno())]
        # the package is found from this folder; Ctrl-C is sent only to the service's process group
        folder = Path(__file__).resolve().parents[2]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, pass_fds=[self._listener.fileno()], cwd=folder, process_group=0
        )
        assert self.process.stdin is not None
        self._reports = self.process.stdin.fileno()
        os.set_blocking(self._reports, False)
        fcntl.fcntl(self._reports, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)

    def _end(self) -> None:
        self.process.kill()
        self.process.communicate()


class Page(ThreadingHTTPServer):
    """The server in the separate process. It answers with the last line that `read` received."""

    def __init__(self, listener: socket.socket) -> None:
        super().__init__(listener.getsockname()[:2], _Handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listener
        self.report = time.monotonic(), 503, {"status": "the service has not started"}
        self._open: deque[Any] = deque()

    def read(self, line: str) -> None:
        """Stores a report."""
        status, content = json.loads(line)
        self.report = time.monotonic(), status, content

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answers in a thread. A slow connection would stay open for hours."""
        self._open.append(request)
        if len(self._open) > MOST_OPEN:
            with contextlib.suppress(OSError):  # it is closed already
                self._open.popleft().shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Prints an error, unless a connection has ended."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)

    def answer(self) -> tuple[int, bytes]:
        """Returns the present status code and JSON body."""
        since, status, content = self.report
        silent_s = time.monotonic() - since
        if silent_s > SILENCE_S:
            status, content = 503, {"status": f"the service has not reported for {silent_s:.0f} s"}
        return status, json.dumps(content).encode()


class _Handler(BaseHTTPRequestHandler):
    timeout = _PATIENCE_S

    def do_GET(self) -> None:
        assert isinstance(self.server, Page)
        status, body = self.server.answer()
        self.send_response(status)
        self.send_header("content-type", "application/json")
        self.send_header("content-length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Writes nothing."""


if __name__ == "__main__":
    page = Page(socket.socket(fileno=int(sys.argv[1])))
    threading.Thread(target=page.serve_forever, daemon=True).start()
    for line in sys.stdin:  # until the service ends
        page.read(line)
