"""What of Uvicorn's HTTP protocol is changed from within; pyproject.toml bounds its version.

`tests/datagen/test_sendfile.py` fails when a new version has changed it: the extension would lack.
"""

from __future__ import annotations

from functools import partial
from typing import Any, BinaryIO, cast

import h11
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from datagen.service.sendfile import EXTENSION


class _Length:
    """Stands for bytes that h11 counts and does not see."""

    def __init__(self, count: int) -> None:
        self._count = count

    def __len__(self) -> int:
        return self._count


class SendfileProtocol(H11Protocol):
    """Uvicorn's HTTP on asyncio's own loop with `http.response.zerocopysend`."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.app = cast(Any, partial(self._with_extension, self.app))

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
        """Whether the bytes are on their way; not so when the reader has gone, or the file is too short."""
        if self.transport.is_closing():
            return False
        self.conn.send_with_data_passthrough(h11.Data(data=cast(bytes, _Length(count))))
        try:
            return await self.loop.sendfile(self.transport, file, offset, count) == count
        except ConnectionError:
            return False
