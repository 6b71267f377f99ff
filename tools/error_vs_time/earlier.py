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
        try:
            report = json.loads(Path(file).read_text(encoding="utf-8"))
            meta, rows = report["meta"], [current_names(row) for row in report["rows"]]
            whole = [row for row in rows if row["system"] in UNTIMED or row.get("ms") is not None]
            untimed = [row for row in rows if row not in whole]
            wanted = all("curve" in row for row in rows) and {"episodes", "frames", "reference"} <= meta.keys()
        except FileNotFoundError:
            raise ConfigError(f"{field} must be an existing file, got {file}; leave it out to begin anew") from None
        except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, AttributeError):
            wanted = False
        if not wanted:
            raise ConfigError(
                f"{field} must be JSON that python -m tools.error_vs_time wrote, got {file}; leave it out to begin anew"
            )
        return Earlier(field, meta, whole, untimed)

    def require_same(self, episodes: Sequence[str], frames: int, reference: str) -> None:
        """Raises: ConfigError where the report is on other scenes, fewer frames, or was scored by something else."""
        remedy = "take the data and options of that report, or leave it out"
        wanted = {"episodes": list(episodes), "frames": frames, "reference": reference}
        for name, value in wanted.items():
            require(
                self.meta[name] == value, f"{self.field} {name}", f"{value} as in this report", self.meta[name], remedy
            )


def same_row(row: Mapping[str, Any], known: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """The first row of a contender of those settings, if any."""
    return next((other for other in known if all(row.get(name) == other.get(name) for name in IDENTITY)), None)


def is_among(row: Mapping[str, Any], known: Sequence[Mapping[str, Any]]) -> bool:
    return same_row(row, known) is not None
