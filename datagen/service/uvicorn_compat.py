"""Changes to Uvicorn's HTTP protocol from within. pyproject.toml bounds its version.

`tests/datagen/test_sendfile.py` fails if a new version changes the internals; the extension would then not work.
"""

import asyncio
import logging
from functools import partial
from typing import Any, BinaryIO, cast

import h11
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from datagen.service.sendfile import EXTENSION

_PIECE_BYTES = 2**20  # number of bytes that a reader must accept within `patience_s`


class _Length:
    """Stands for bytes that h11 counts but does not see."""

    def __init__(self, count: int) -> None:
        self._count = count

    def __len__(self) -> int:
        return self._count


class _NamedLogger(logging.LoggerAdapter[logging.Logger]):
    """Begins messages with the address of a client."""

    level = logging.WARNING

    def process(self, msg: Any, kwargs: Any) -> tuple[str, Any]:
        return f"{dict(self.extra or {})['address']}: {msg}", kwargs


class SendfileProtocol(H11Protocol):
    """Adds `http.response.zerocopysend` and time limits to Uvicorn's HTTP on asyncio's own loop.

    A connection is closed if no whole request arrives for `patience_s`, or if its answer is accepted too slowly. With
    more than `most_connections` the oldest one without a request is closed. If all have requests, the new one gets 503.
    Uvicorn's own limits act only after a first answer, and count connections without a request as load.
    """

    patience_s = 30.0
    most_connections = 1024

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.app = cast(Any, partial(self._with_extension, self.app))
        self._seen: tuple[Any, bool, int] | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        address = str((self.client or ("unknown",))[0]).partition("%")[0]
        self.logger = cast(Any, _NamedLogger(self.logger, {"address": address}))
        self.made_at = self.loop.time()
        if len(self.connections) > self.most_connections:
            waiting = [other for other in self.connections if isinstance(other, SendfileProtocol) and not other.busy]
            if oldest := min(waiting, key=lambda other: other.made_at, default=None):
                oldest.transport.abort()
                self.connections.discard(oldest)
        self._look()

    @property
    def busy(self) -> bool:
        """Returns whether a request is in progress."""
        return self.cycle is not None and not self.cycle.response_complete

    def _look(self) -> None:
        if self not in self.connections:
            return
        before, now = self._seen, (self.cycle, self.busy, self.transport.get_write_buffer_size())
        self._seen = now
        if before is not None and before[0] is self.cycle:
            idle = not (before[1] or any(now[1:]))
            slow = min(before[2], now[2]) > 0 and before[2] - now[2] < _PIECE_BYTES
            if idle or slow:
                self.transport.abort()
                return
        self.loop.call_later(self.patience_s, self._look)

    async def _with_extension(self, app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_all(message: Message) -> None:
            if message["type"] != EXTENSION:
                await send(message)
            elif not await self._send_file(message["file"], message["offset"], message["count"]):
                self.transport.abort()
                while (await receive())["type"] != "http.disconnect":
                    pass

        extensions = {**(scope.get("extensions") or {}), EXTENSION: {}}
        await app({**scope, "extensions": extensions}, receive, send_all)

    async def _send_file(self, file: BinaryIO, offset: int, count: int) -> bool:
        """Sends a part of a file. Returns False if the reader has gone or the file is too short."""
        self.conn.send_with_data_passthrough(h11.Data(data=cast(bytes, _Length(count))))
        try:
            for start in range(offset, offset + count, _PIECE_BYTES):
                if self.transport.is_closing():
                    return False
                piece = min(_PIECE_BYTES, offset + count - start)
                sending = self.loop.sendfile(self.transport, file, start, piece)
                if await asyncio.wait_for(sending, self.patience_s) != piece:
                    return False
        except (ConnectionError, TimeoutError):
            return False
        return True
