"""Shows progress: a bar on a terminal, a line every 15 seconds elsewhere."""

from __future__ import annotations

import sys
from typing import Any

from tqdm import tqdm

LINE_INTERVAL_S = 15.0
_UNITS = ((86400, "days"), (3600, "hours"), (60, "minutes"), (1, "seconds"))


class _Lines:
    """Turns a bar's updates into separate lines, so that a log file stays readable."""

    def write(self, text: str) -> None:
        text = text.replace("\r", "").strip()
        if text:
            sys.stderr.write(text + "\n")

    def flush(self) -> None:
        sys.stderr.flush()


def duration(seconds: float) -> str:
    """Returns a duration as text: 40 seconds, 3.5 hours, 61 days."""
    size, unit = next(each for each in _UNITS if seconds >= 1.5 * each[0] or each[0] == 1)
    return f"{seconds / size:.2g} {unit}" if seconds < 100 * size else f"{seconds / size:.0f} {unit}"


def bar(what: str, total: int | None, initial: int = 0, unit: str = "it") -> tqdm[Any]:
    """Returns a tqdm bar on stderr. Without a terminal it prints at most a line every 15 seconds.

    Without a total the bar is invisible until its first item.
    """
    style: dict[str, Any] = {"file": sys.stderr, "mininterval": 0.5, "maxinterval": 10.0, "dynamic_ncols": True}
    if not sys.stderr.isatty():
        style = {"file": _Lines(), "mininterval": LINE_INTERVAL_S, "maxinterval": LINE_INTERVAL_S, "ncols": 110}
    style["delay"] = 0.001 if total is None else 0
    return tqdm(total=total, initial=initial, unit=f" {unit}", desc=what, miniters=1, **style)


def advance_to(progress: tqdm[Any], count: int) -> None:
    """Sets the count of a bar. The rate excludes the first items, because they include compilation."""
    if count > progress.initial == progress.n:
        progress.unpause()
    # by assignment, because `update` cannot lower the count
    progress.n = count
    progress.update(0)
