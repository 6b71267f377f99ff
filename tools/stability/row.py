"""A row of the stability report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from tools import report


@dataclass(frozen=True)
class Row:
    """A case with what was predicted and measured, whether it held, and what happens past the limit."""

    case: str
    predicted: float | str
    measured: float | str
    held: bool
    beyond: str
    more: dict[str, Any] = field(default_factory=dict)  # further numbers

    def mapping(self, part: str) -> dict[str, Any]:
        row = asdict(self)
        return {"part": part} | row.pop("more") | row


def within(case: str, bound: float, measured: float, beyond: str, more: dict[str, Any] | None = None) -> Row:
    """A row that holds where the size of what is measured is at most the bound."""
    return Row(case, bound, measured, abs(measured) <= bound, beyond, more or {})


def table(rows: Sequence[Row]) -> str:
    """The rows for people."""
    figures = [[v if isinstance(v, str) else f"{v:.4g}" for v in (row.predicted, row.measured)] for row in rows]
    lines = [(r.case, *figure, "yes" if r.held else "NO", r.beyond) for r, figure in zip(rows, figures, strict=True)]
    return report.table(("case", "predicted", "measured", "held", "beyond"), lines)
