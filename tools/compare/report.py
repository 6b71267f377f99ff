"""What was found, as JSON after each step and as tables: checks, times and profiles of trees beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hgn.system.files import write_json
from tools.bench.contenders import PASS

PROFILE_LINES = 16


class Report:
    """{"meta", "rows", "checks", "profiles"} in the making."""

    def __init__(self, path: Path, meta: dict[str, Any], cases: Sequence[str], trees: Sequence[str]) -> None:
        self.path, self.meta, self.cases, self.trees = path, meta, cases, trees
        self.checks: list[dict[str, Any]] = []
        self.profiles: list[dict[str, Any]] = []
        self._milliseconds: dict[tuple[str, str], list[float]] = {}

    def add_check(self, case: str, tree: str, when: str, found: dict[str, Any]) -> bool:
        """`found`: the check's answer, or one with an `error`; whether it passed."""
        verdict = found.get("error") or found["check"]
        check = {"case": case, "tree": tree, "when": when, "check": verdict}
        self.checks.append(check | {key: found[key] for key in ("errors", "seconds") if key in found})
        return verdict == PASS

    def add_times(self, case: str, tree: str, milliseconds: list[float]) -> None:
        self._milliseconds.setdefault((case, tree), []).extend(milliseconds)

    def add_profile(self, case: str, tree: str, found: dict[str, Any]) -> None:
        self.profiles.append({"case": case, "tree": tree, **found})

    def write(self) -> None:
        """Raises: OSError as write_json does."""
        parts = {"meta": self.meta, "rows": self.rows(), "checks": self.checks, "profiles": self.profiles}
        write_json(self.path, parts)

    def rows(self) -> list[dict[str, Any]]:
        """A row for each case and tree that has been checked; no time where a check is red."""
        rows = []
        for case in self.cases:
            for tree in self.trees:
                checks = [check for check in self.checks if (check["case"], check["tree"]) == (case, tree)]
                if not checks:
                    continue
                verdict = next((check["check"] for check in checks if check["check"] != PASS), PASS)
                row: dict[str, Any] = {"case": case, "tree": tree, "ms": None, "ms_quartiles": None, "samples": 0}
                milliseconds = self._milliseconds.get((case, tree))
                if milliseconds and verdict == PASS:
                    low, middle, high = np.percentile(milliseconds, (25, 50, 75)).tolist()
                    row |= {"ms": middle, "ms_quartiles": [low, high], "samples": len(milliseconds)}
                rows.append(row | {"check": verdict, "checked": [check["when"] for check in checks]})
        return rows

    def green(self) -> bool:
        """Whether every tree has passed every check of every case."""
        rows = self.rows()
        return len(rows) == len(self.cases) * len(self.trees) and all(row["check"] == PASS for row in rows)

    def table(self) -> str:
        """Medians of the times and their ratios to the first tree's, as Markdown; then what is red."""
        rows = {(row["case"], row["tree"]): row for row in self.rows()}
        lines = [f"| ms | {' | '.join(self.trees)} |", f"| :-- |{' --: |' * len(self.trees)}"]
        for case in self.cases:
            cells = []
            first = rows.get((case, self.trees[0]), {}).get("ms")
            for tree in self.trees:
                ms = rows.get((case, tree), {}).get("ms")
                ratio = f" ({ms / first:.3f})" if ms and first and tree != self.trees[0] else ""
                cells.append(f"{ms:.4g}{ratio}" if ms else "-")
            lines.append(f"| {case} | {' | '.join(cells)} |")
        red = [row for row in rows.values() if row["check"] != PASS]
        return "\n".join([*lines, *(f"{row['case']} of {row['tree']}: {row['check']}" for row in red)])

    def profile_tables(self) -> str:
        """Microseconds and launches of the longest kernels of each profiled case, trees beside each other."""
        lines = []
        for case in dict.fromkeys(profile["case"] for profile in self.profiles):
            found = {profile["tree"]: profile for profile in self.profiles if profile["case"] == case}
            kernels = {tree: {kernel["kernel"]: kernel for kernel in found[tree]["kernels"]} for tree in found}
            longest: dict[str, float] = {}
            for of_tree in kernels.values():
                for name, kernel in of_tree.items():
                    longest[name] = max(longest.get(name, 0.0), kernel["us"])
            lines += [f"| {case}, µs × launches | {' | '.join(found)} |", f"| :-- |{' --: |' * len(found)}"]
            lines.append(f"| all | {' | '.join(_cell(found[tree]) for tree in found)} |")
            for name in sorted(longest, key=lambda name: -longest[name])[:PROFILE_LINES]:
                lines.append(f"| {name} | {' | '.join(_cell(kernels[tree].get(name)) for tree in found)} |")
            lines.append("")
        return "\n".join(lines)


def _cell(found: dict[str, Any] | None) -> str:
    return "-" if found is None else f"{found['us']:.1f} × {found['launches']:g}"
