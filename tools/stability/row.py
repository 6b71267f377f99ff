"""Rows of the stability reports and their JSON."""

from collections.abc import Iterable
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
    """Collects rows: prints a line as each case ends, and writes the JSON after each."""

    def __init__(self, part: str, meta: dict[str, Any], file: str | None, **more: Any) -> None:
        self.part, self.meta, self.file, self.more = part, meta, file, more
        self.rows: list[dict[str, Any]] = []  # as in the JSON; rows of an earlier report may be among them
        self.passes: list[bool] = []  # of the rows of this run

    def add(self, rows: Iterable[Row], brief: bool = False) -> None:
        """Adds rows one by one. If `brief`, only those that fail are printed."""
        for row in rows:
            own = {name: getattr(row, name) for name in ("case", "predicted", "measured", "held", "beyond")}
            self.rows.append({"part": self.part} | row.more | own)
            self.passes.append(row.held)
            if not (brief and row.held):
                measured, predicted = (v if isinstance(v, str) else f"{v:.4g}" for v in (row.measured, row.predicted))
                verdict = "passes" if row.held else "FAILS "
                print(f"{verdict} {row.case}: {measured} ({predicted}); {row.beyond}", flush=True)
            self.write()

    def write(self) -> None:
        """Writes the JSON, if a file was given."""
        if self.file is not None:
            report.write_report(self.file, {"meta": self.meta, "rows": self.rows} | self.more)

    def close(self) -> None:
        """Writes the JSON for the last time, and prints how many rows pass."""
        self.write()
        print(f"{sum(self.passes)} of {len(self.passes)} rows pass")
