"""HTTP answers that cannot fill the memory: of a range no more than was asked for, else a data set's largest file.

Loaded only where a data set is read from a URL of HTTP.
"""

from __future__ import annotations

import re

import aiohttp

from hgn.schema import ConfigError

LARGEST_BYTES = 2**29  # of what is sent whole: manifests of the first release, shards of servers without ranges
_RANGE = re.compile(r"bytes=(\d+)-(\d+)")


class BoundedResponse(aiohttp.ClientResponse):
    """An answer whose body is read piece by piece, up to its limit."""

    async def read(self) -> bytes:
        """Raises: ConfigError where more comes."""
        if self._body is None:
            asked = _RANGE.fullmatch(self.request_info.headers.get("Range", ""))
            partial = asked is not None and self.status == 206
            limit = int(asked[2]) - int(asked[1]) + 1 if asked is not None and partial else LARGEST_BYTES
            pieces, size = [], 0
            async for piece in self.content.iter_any():
                size += len(piece)
                if size > limit:
                    self.close()
                    raise ConfigError(
                        f"{self.url} must answer with at most {limit} bytes, got more; check dataset.folder"
                    )
                pieces.append(piece)
            self._body = b"".join(pieces)
            self.release()
        return self._body
