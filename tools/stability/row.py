"""A row of the stability report."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any


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


def table(rows: list[Row]) -> str:
    """The rows for people."""
    width = max((len(row.case) for row in rows), default=4)
    lines = [f"{'case':<{width}} {'predicted':>12} {'measured':>12}  held  beyond"]
    for row in rows:
        held = "yes" if row.held else "NO"
        lines.append(
            f"{row.case:<{width}} {_text(row.predicted):>12} {_text(row.measured):>12}  {held:<4}  {row.beyond}"
        )
    return "\n".join(lines)


def _text(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"
