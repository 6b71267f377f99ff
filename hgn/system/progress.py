"""Shows progress: a bar on a terminal, a line every 15 seconds elsewhere."""

from __future__ import annotations

import sys
from typing import Any

from tqdm import tqdm

LINE_INTERVAL_S = 15.0


class _Lines:
    """Turns a bar's updates into separate lines, so that a log file stays readable."""

    def write(self, text: str) -> None:
        text = text.replace("\r", "").strip()
        if text:
            sys.stderr.write(text + "\n")

    def flush(self) -> None:
        sys.stderr.flush()


def bar(what: str, total: int | None, initial: int = 0, unit: str = "it") -> tqdm[Any]:
    """Returns a tqdm bar on stderr. Without a terminal it prints at most a line every 15 seconds."""
    terminal = sys.stderr.isatty()
    return tqdm(
        total=total,
        initial=initial,
        unit=f" {unit}",
        desc=what,
        file=sys.stderr if terminal else _Lines(),
        mininterval=0.5 if terminal else LINE_INTERVAL_S,
        maxinterval=10.0 if terminal else LINE_INTERVAL_S,
        miniters=1,
        dynamic_ncols=terminal,
        ncols=None if terminal else 110,
    )
