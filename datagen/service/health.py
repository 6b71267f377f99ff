"""/healthz at a port of its own, from a thread of the service: probes do not wait in the readers' queue.

The service reports its state every second. After SILENCE_S without a report the answer is 503, so that a service that
hangs is noticed.
"""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any

SILENCE_S = 30.0
_PATIENCE_S = 2.0  # for a request


class HealthPage:
    """Answers every request at `listener` with the last report; a context manager."""

    def __init__(self, listener: socket.socket) -> None:
        self._report = (time.monotonic(), 503, {"status": "the service has not begun"})
        self._server = ThreadingHTTPServer(listener.getsockname()[:2], _handler(self.answer), bind_and_activate=False)
        self._server.socket.close()
        self._server.socket = listener
        self._thread = threading.Thread(target=self._server.serve_forever, name="health", daemon=True)

    def tell(self, status: int, content: dict[str, Any]) -> None:
        """Sets the answer from now on."""
        self._report = (time.monotonic(), status, content)

    def answer(self) -> tuple[int, bytes]:
        """Returns the present status code and JSON body."""
        since, status, content = self._report
        silent_s = time.monotonic() - since
        if silent_s > SILENCE_S:
            status, content = 503, {"status": f"the service has not reported for {silent_s:.0f} s"}
        return status, json.dumps(content).encode()

    def __enter__(self) -> HealthPage:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.shutdown()
        self._server.server_close()


def _handler(answer: Callable[[], tuple[int, bytes]]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = _PATIENCE_S

        def do_GET(self) -> None:
            status, body = answer()
            self.send_response(status)
            self.send_header("content-type", "application/json")
            self.send_header("content-length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *arguments: Any) -> None:
            """Writes no log."""

    return Handler
