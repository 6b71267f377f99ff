"""Rows of the stability reports, their table and their JSON."""

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from tools import report


@dataclass(frozen=True)
class Row:
    """A case: the prediction or bound, the measurement, whether it passes, and what happens otherwise."""

    case: str
    predicted: float | str
    measured: float | str
    held: bool  # whether the case passes
    beyond: str  # details, or the reason of the failure
    more: dict[str, Any] = field(default_factory=dict)  # further columns of the JSON


def within(case: str, bound: float, measured: float, beyond: str) -> Row:
    """Returns a row that passes if the size of the measurement is at most the bound."""
    return Row(case, bound, measured, abs(measured) <= bound, beyond)


class Report:
    """Collects rows: prints a line to stderr as each case ends, and writes the JSON after each."""

    def __init__(self, part: str, meta: dict[str, Any], file: str | None, **more: Any) -> None:
        self.part, self.meta, self.file, self.more = part, meta, file, more
        self.rows: list[Row] = []

    def add(self, rows: Iterable[Row]) -> None:
        """Adds rows one by one."""
        for row in rows:
            self.rows.append(row)
            measured, predicted = _figures(row)
            verdict = "passes" if row.held else "FAILS "
            print(f"{verdict} {row.case}: {measured} ({predicted}); {row.beyond}", file=sys.stderr, flush=True)
            self.write()

    def write(self) -> None:
        """Writes the JSON, if a file was given."""
        if self.file is not None:
            own = ("case", "predicted", "measured", "held", "beyond")
            rows = [{"part": self.part} | row.more | {name: getattr(row, name) for name in own} for row in self.rows]
            report.write_report(self.file, {"meta": self.meta, "rows": rows} | self.more)


def table(rows: Sequence[Row]) -> str:
    """Returns the rows as a table of at most 100 columns."""
    lines = []
    for row in rows:
        measured, predicted = _figures(row)
        lines.append((row.case, predicted, measured, "yes" if row.held else "NO", row.beyond))
    return report.table(("case", "predicted", "measured", "passes", "details"), lines)


def _figures(row: Row) -> tuple[str, str]:
    measured, predicted = (v if isinstance(v, str) else f"{v:.4g}" for v in (row.measured, row.predicted))
    return measured, predicted
