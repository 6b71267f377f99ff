"""Scores and times one contender after another, the most telling first, and writes the report after each.

A run that is cut off anywhere leaves a whole file with all that was measured, errors and run times together.
"""

from __future__ import annotations

import json
import math
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from hgn.renamed import current_names
from hgn.scene.episode import Episode
from hgn.schema import ConfigError, require
from hgn.system.files import write_atomically, write_json
from hgn.system.progress import bar
from tools.error_vs_time.contenders import COARSE_GRIDS, GNS_FIRST, BaselineContender, Contender, SolverContender
from tools.error_vs_time.paired import paired_rows
from tools.error_vs_time.plot import draw_frames, draw_pareto
from tools.error_vs_time.score import label, score
from tools.error_vs_time.settings import UNTIMED, ErrorVsTimeConfig
from tools.error_vs_time.timing import Stopwatch

# of the seconds given: until when a contender, and a further round of run times, may be begun
BEGIN_FRACTION, ROUND_FRACTION = 0.85, 0.95
BESIDE = (GNS_FIRST, COARSE_GRIDS)  # what is scored while kernels are compiled, with baselines
DRAWN_EVERY_S = 60.0  # which takes some seconds each time
# of a contender: rows of earlier reports that have the same need not be measured again
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


class Run:
    """The contenders of a report, in its order, and what was measured of them so far."""

    def __init__(
        self,
        config: ErrorVsTimeConfig,
        contenders: Sequence[Contender],
        references: Sequence[Episode],
        device: torch.device,
        meta: dict[str, Any],
        begun: float,
        earlier: Sequence[dict[str, Any]] = (),
        untimed: Sequence[dict[str, Any]] = (),
    ) -> None:
        """`begun` is by time.monotonic(); `earlier` are rows of reports before this one, which come first; `untimed`
        those that lack their run times alone: they get `timed`, where and when that was.
        """
        self.config, self.contenders, self.references, self.device = config, contenders, references, device
        self.begun, self.earlier = begun, list(earlier)
        self.meta = meta | {"not_run": [], "not_timed": []}
        self.failed = 0  # contenders, by a fault of the program or the machine
        self.watches: dict[int, Stopwatch] = {}
        of_contenders = {i: same_row(contender.row, untimed) for i, contender in enumerate(contenders)}
        self._rows: dict[int, dict[str, Any]] = {i: dict(row) for i, row in of_contenders.items() if row is not None}
        self._scored_before = set(self._rows)
        self._given_up: set[int] = set()
        self._drawn = time.monotonic()
        self.out, self.file = config.out, config.json or f"{config.out}.json"

    @property
    def rows(self) -> list[dict[str, Any]]:
        return [*self.earlier, *(self._rows[i] for i in sorted(self._rows))]

    def is_past(self, fraction: float) -> bool:
        """Whether that fraction of the time given is over."""
        return self.config.seconds is not None and time.monotonic() - self.begun > fraction * self.config.seconds

    def score_beside(self, compiling: Callable[[], bool]) -> None:
        """Scores what is simulated already and, as long as kernels are being compiled, what launches none of them:
        baselines, GNS at the precision that tells most, and the solver on coarse grids.
        """
        for i in self._by_importance():
            contender = self.contenders[i]
            known = isinstance(contender, SolverContender) and contender.launches.knows(contender.setting)
            idle = contender.importance in BESIDE or isinstance(contender, BaselineContender)
            if known or (idle and compiling() and not self.is_past(BEGIN_FRACTION)):
                self._attempt(i, self._errors)

    def measure(self) -> None:
        """Scores and times every contender, in order of importance, or times them where all are scored; then times all
        of them further in turns.
        """
        turns = [[self._errors], [self._times]] if self.config.times_last else [[self._errors, self._times]]
        with bar("contenders", total=len(turns) * len(self.contenders), unit="contender") as progress:
            for steps in turns:
                for i in self._by_importance():
                    # past the time too: by baselines all others are told
                    if not self.is_past(BEGIN_FRACTION) or isinstance(self.contenders[i], BaselineContender):
                        for step in steps:
                            self._attempt(i, step)
                    elif i not in self._rows and i not in self._given_up:
                        self._leave_out(i, "the time was over")
                    self.write(drawn=time.monotonic() - self._drawn > DRAWN_EVERY_S)
                    progress.update()
        for _ in range(1, self.config.rounds):
            for i in sorted(self.watches):
                if not self.is_past(ROUND_FRACTION):
                    self._attempt(i, self._time)
        self.write()

    def write(self, drawn: bool = False) -> None:
        """Writes the JSON, and the figures if wanted. Numbers that are none are null, for JSON knows no NaN."""
        untold = [row for row in self.rows if row["system"] not in UNTIMED and row.get("ms") is None]
        self.meta |= {"not_timed": [label(row) for row in untold], "seconds": time.monotonic() - self.begun}
        rows = _without_nan(self.rows)
        paired = paired_rows(self.rows) if drawn else []
        write_json(self.file, {"meta": self.meta, "rows": rows, "paired": paired}, allow_nan=False)
        if drawn:
            draw(self.out, rows, self.meta)
            self._drawn = time.monotonic()

    def _by_importance(self) -> list[int]:
        return sorted(range(len(self.contenders)), key=lambda i: self.contenders[i].importance)

    def _errors(self, i: int) -> None:
        if i in self._rows:
            return
        begun = time.monotonic()
        try:
            row = score(self.contenders[i], self.references, self.config, self.device)
        finally:
            self.contenders[i].release()
        self._rows[i] = row | {"scoring_s": time.monotonic() - begun}
        self.write()

    def _times(self, i: int) -> None:
        if self.contenders[i].row["system"] not in UNTIMED:
            begun = time.monotonic()
            self.watches[i] = Stopwatch(self.contenders[i], self.references, self.config, self.device)
            self._time(i)
            self._rows[i]["timing_s"] = time.monotonic() - begun
            if i in self._scored_before:
                self._rows[i]["timed"] = {name: self.meta[name] for name in ("device", "commit", "date")}

    def _time(self, i: int) -> None:
        self._rows[i] |= self.watches[i].round()

    def _attempt(self, i: int, work: Callable[[int], None]) -> None:
        """The others need not wait for what fails; that is named, and counted where nobody foresaw it."""
        if i in self._given_up:
            return
        try:
            work(i)
        except (ConfigError, torch.OutOfMemoryError) as error:
            self._leave_out(i, str(error))
        except Exception as error:  # noqa: BLE001 - printed whole and counted: the others go on
            traceback.print_exc()
            self.failed += 1
            self._leave_out(i, f"{type(error).__name__}: {error}")

    def _leave_out(self, i: int, cause: str) -> None:
        self._given_up.add(i)
        self.watches.pop(i, None)
        self.contenders[i].release()
        self.meta["not_run"].append(self.contenders[i].row | {"cause": cause, "scored": i in self._rows})
        print(f"left out: {label(self.contenders[i].row)}: {cause}", file=sys.stderr)


def draw(out: str, rows: Sequence[dict[str, Any]], meta: dict[str, Any]) -> list[str]:
    """Writes the figures of a report's JSON; their names."""
    files = {
        f"{out}.png": draw_pareto(rows, meta),
        f"{out}_batched.png": draw_pareto(rows, meta, batched=True),
        f"{out}_frames.png": draw_frames(rows, meta),
    }
    for file, picture in files.items():
        write_atomically(Path(file), picture)
    return list(files)


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
