"""Which kernels were compiled in this process instead of ahead (hgn.kernels.precompile), and how long that took."""

from __future__ import annotations

from typing import Any

import triton


class JitMisses:
    """Counts from its making on."""

    def __init__(self) -> None:
        self.count, self.seconds = 0, 0.0
        triton.knobs.compilation.listener = self._note

    def _note(self, *, times: Any, cache_hit: bool, **_: Any) -> None:
        if not cache_hit:
            self.count += 1
            self.seconds += times.total / 1e6
