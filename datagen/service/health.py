"""/healthz at a port of its own, from a process of its own: who asks there waits for none of the service's readers.

At the service's own port a request has its turn among a thousand others, and on a busy machine the service waits for a
core before each turn; a thread of it would wait for Python's lock with it. This process does nothing else, so it has a
core when it is asked. The service tells it every second how it is; after SILENCE_S without a word the answer is 503,
so a service that hangs is seen.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from hgn.system.processes import die_with_parent

SILENCE_S = 30.0
_PATIENCE_S = 2.0  # for a request's head
_LARGEST_HEAD = _LARGEST_PAGE = 8192
_CONNECTIONS = 64


class HealthPage:
    """Answers every request at `listener` with what was told last; a context manager."""

    def __init__(self, listener: socket.socket) -> None:
        self._listener = listener
        self._taken_at = 0.0  # when the process last took what it was told

    def tell(self, status: int, content: dict[str, Any]) -> None:
        """What to answer from now on. Waits for nobody; a process that has ended, or takes nothing, is replaced."""
        try:
            self._ours.send(json.dumps([status, content]).encode()[:_LARGEST_PAGE])
            self._taken_at = time.monotonic()
        except (BlockingIOError, ConnectionError):
            if self._process.poll() is not None or time.monotonic() - self._taken_at > SILENCE_S:
                self._end()
                self._begin()

    def __enter__(self) -> HealthPage:
        self._begin()
        return self

    def _begin(self) -> None:
        self._ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._ours.setblocking(False)
        # room for some twenty pages: a process that takes none is soon noticed
        self._ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _LARGEST_PAGE)
        self._taken_at = time.monotonic()
        with theirs:
            files = self._listener.fileno(), theirs.fileno()
            command = [sys.executable, "-m", "datagen.service.health", *map(str, files)]
            # the package is found where this one was
            self._process = subprocess.Popen(command, pass_fds=files, cwd=Path(__file__).resolve().parents[2])

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()
        self._listener.close()

    def _end(self) -> None:
        self._ours.close()
        self._process.kill()
        self._process.wait()


class _Page:
    def __init__(self, source: socket.socket) -> None:
        self._source = source
        self._told: tuple[float, int, Any] = (time.monotonic(), 503, {"status": "the service has not begun"})
        self._connections: dict[asyncio.StreamWriter, None] = {}  # the oldest first

    def listen(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                self._told = (time.monotonic(), *json.loads(self._source.recv(_LARGEST_PAGE)))

    async def answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._connections[writer] = None
        if len(self._connections) > _CONNECTIONS:
            oldest = next(iter(self._connections))
            del self._connections[oldest]
            oldest.transport.abort()
        try:
            async with asyncio.timeout(_PATIENCE_S):
                await reader.readuntil(b"\r\n\r\n")
                writer.write(self._page())
                await writer.drain()
        except (OSError, EOFError, asyncio.LimitOverrunError):  # TimeoutError is an OSError
            pass
        finally:
            self._connections.pop(writer, None)
            writer.close()

    def _page(self) -> bytes:
        since, status, content = self._told
        silent_s = time.monotonic() - since
        if silent_s > SILENCE_S:
            status, content = 503, {"status": f"the service has not moved for {silent_s:.0f} s"}
        body = json.dumps(content).encode()
        head = f"HTTP/1.1 {status} {'OK' if status == 200 else 'Service Unavailable'}\r\nconnection: close\r\n"
        return f"{head}content-type: application/json\r\ncontent-length: {len(body)}\r\n\r\n".encode() + body


async def _serve(listener: socket.socket, source: socket.socket) -> None:
    source.setblocking(False)
    page = _Page(source)
    asyncio.get_running_loop().add_reader(source, page.listen)
    server = await asyncio.start_server(page.answer, sock=listener, limit=_LARGEST_HEAD)
    await server.serve_forever()


if __name__ == "__main__":
    die_with_parent(signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the service, which says when it ends
    asyncio.run(_serve(*(socket.socket(fileno=int(number)) for number in sys.argv[1:])))
