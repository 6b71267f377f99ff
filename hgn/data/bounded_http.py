"""HTTP answers of bounded size: the requested range, or else the size of a data set's largest file.

Imported only for data sets at HTTP URLs.
"""

from __future__ import annotations

import re
import time

import aiohttp

from hgn.schema import ConfigError

LARGEST_BYTES = 2**29  # of whole files: manifests of the first release, and shards of servers without ranges
LEAST_BYTES_S, SLOW_S = 4096, 20.0  # speed below which a server does not answer, after a start of seconds
_RANGE = re.compile(r"bytes=(\d+)-(\d+)")


class BoundedResponse(aiohttp.ClientResponse):
    """An answer whose body is read in pieces, up to its limit, no slower than LEAST_BYTES_S."""

    async def read(self) -> bytes:
        """Returns the body. Raises: ConfigError for a longer one; ConnectionError for a slow one."""
        if self._body is None:
            requested = _RANGE.fullmatch(self.request_info.headers.get("Range", ""))
            partial = requested is not None and self.status == 206
            limit = int(requested[2]) - int(requested[1]) + 1 if requested is not None and partial else LARGEST_BYTES
            pieces, size, start = [], 0, time.monotonic()
            async for piece in self.content.iter_any():
                size += len(piece)
                if size > limit:
                    self.close()
                    raise ConfigError(
                        f"{self.url} must answer with at most {limit} bytes, got more; check dataset.folder"
                    )
                if size < LEAST_BYTES_S * (time.monotonic() - start - SLOW_S):
                    self.close()
                    raise ConnectionError(f"fewer than {LEAST_BYTES_S} bytes a second")
                pieces.append(piece)
            self._body = b"".join(pieces)
            self.release()
        return self._body
