"""Reports written before: what they hold need not be measured again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hgn.renamed import current_names
from hgn.schema import ConfigError, require
from tools.error_vs_time.settings import UNTIMED

IDENTITY = ("system", "weights", "backend", "precision", "updates", "grid", "step", "predictor", "floor")


@dataclass(frozen=True)
class Earlier:
    """A report's meta, those rows that are whole (with run times, where there are any to take), and those without."""

    field: str
    meta: dict[str, Any]
    rows: list[dict[str, Any]]
    untimed: list[dict[str, Any]]

    @staticmethod
    def read(file: str, field: str) -> Earlier:
        """Raises: ConfigError where there is no such file, or it is none of this report."""
        remedy = "leave it out to begin anew"
        try:
            report = json.loads(Path(file).read_text(encoding="utf-8"))
            meta, rows = report["meta"], [current_names(row) for row in report["rows"]]
            whole = [row for row in rows if row["system"] in UNTIMED or row.get("ms") is not None]
            ours = all("curve" in row for row in rows) and {"episodes", "frames", "reference"} <= meta.keys()
        except FileNotFoundError:
            raise ConfigError(f"{field} must be an existing file, got {file}; {remedy}") from None
        except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, AttributeError):
            ours = False
        require(ours, field, "JSON that python -m tools.error_vs_time wrote", file, remedy)
        return Earlier(field, meta, whole, [row for row in rows if row not in whole])

    def require_same(self, episodes: Sequence[str], frames: int, reference: str) -> None:
        """Raises: ConfigError where the report is on other scenes, fewer frames, or was scored by something else."""
        remedy = "take the data and options of that report, or leave it out"
        for name, value in {"episodes": list(episodes), "frames": frames, "reference": reference}.items():
            rule = f"{value} as in this report"
            require(self.meta[name] == value, f"{self.field} {name}", rule, self.meta[name], remedy)


def same_row(row: Mapping[str, Any], known: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """The first row of a contender of those settings, if any."""
    return next((other for other in known if all(row.get(name) == other.get(name) for name in IDENTITY)), None)
