"""Bounds HTTP answers: to the requested range, or for whole files to LARGEST_BYTES.

It is imported only for data sets at HTTP URLs.
"""

import asyncio
import re
import time
from contextvars import ContextVar
from typing import Any

import aiohttp
from aiohttp.connector import Connection

from hgn.data.verification import StorageError

LARGEST_BYTES = 2**29  # limit for whole files, as shards of servers without ranges
# smallest mean speed of a body, bytes/s, apart from a grace of SLOW_S seconds; later grace is up to SILENCE_S
LEAST_BYTES_S, SLOW_S = 4096, 20.0
SILENCE_S = 60.0  # limit between two pieces, seconds: aiohttp reports no error of a malformed body
HEAD_S = 150.0  # limit for the heads of an answer and its redirects, seconds: a service may hash a shard first
MOST_INTERIM = 100  # largest number of answers 1xx before an answer
_deadline: ContextVar[float] = ContextVar("deadline")  # of the heads in a task; each call of fsspec is a task
_RANGE = re.compile(r"bytes=(\d+)-(\d+)")


class BoundedResponse(aiohttp.ClientResponse):
    """Reads the body of an answer in pieces, up to its limit, at LEAST_BYTES_S or faster."""

    async def start(self, connection: Connection) -> aiohttp.ClientResponse:
        """Reads the head.

        Raises: TimeoutError if it takes, with those of redirects to it, longer than HEAD_S; ConnectionError for more
        than MOST_INTERIM answers before it, which aiohttp skips.
        """
        now = time.monotonic()
        end = _deadline.get(now + HEAD_S)
        _deadline.set(end)
        protocol, heads = connection.protocol, 0
        assert protocol is not None
        read = protocol.read

        async def next_head() -> Any:
            nonlocal heads
            heads += 1
            if heads > MOST_INTERIM + 1:
                raise ConnectionError(f"it sent more than {MOST_INTERIM} interim answers")
            return await read()

        protocol.read = next_head  # type: ignore[method-assign]
        try:
            return await asyncio.wait_for(super().start(connection), end - now)
        finally:
            del protocol.read

    async def read(self) -> bytes:
        """Returns the body. Raises: StorageError if it is too long; ConnectionError or TimeoutError if too slow."""
        if self._body is None:
            requested = _RANGE.fullmatch(self.request_info.headers.get("Range", ""))
            partial = requested is not None and self.status == 206
            limit = int(requested[2]) - int(requested[1]) + 1 if requested is not None and partial else LARGEST_BYTES
            pieces, size, grace_s, before = [], 0, SLOW_S, time.monotonic()
            while piece := await self._piece():
                size += len(piece)
                if size > limit:
                    self.close()
                    raise StorageError(f"{self.url} must send at most {limit} bytes, got more; check dataset.folder")
                now = time.monotonic()
                grace_s = min(grace_s + len(piece) / LEAST_BYTES_S, SILENCE_S) - (now - before)
                before = now
                if grace_s < 0:
                    self.close()
                    raise ConnectionError(f"fewer than {LEAST_BYTES_S} bytes a second")
                pieces.append(piece)
            self._body = b"".join(pieces)
            self.release()
        return self._body

    async def _piece(self) -> bytes:
        try:
            return await asyncio.wait_for(self.content.readany(), SILENCE_S)
        except RuntimeError as error:  # aiohttp closed the connection after a malformed chunk
            raise ConnectionError(str(error)) from error
