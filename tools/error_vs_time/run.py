"""Scores and times contenders one after another, and writes the report after each.

An interrupted run leaves a valid file with all that was measured.
"""

import sys
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from hgn.scene.episode import Episode
from hgn.schema import ConfigError
from hgn.system.files import write_atomically
from hgn.system.progress import bar
from tools.error_vs_time.contenders import Contender
from tools.error_vs_time.paired import paired_rows
from tools.error_vs_time.plot import draw_frames, draw_pareto
from tools.error_vs_time.score import label, score
from tools.error_vs_time.settings import UNTIMED, ErrorVsTimeConfig
from tools.report import finite, write_report
from tools.timing import Stopwatch

ROUNDS = 2  # number of times that each scene is timed
Row = dict[str, Any]


class Run:
    """Measures the contenders of a report."""

    def __init__(
        self,
        config: ErrorVsTimeConfig,
        contenders: Sequence[Contender],
        references: Sequence[Episode],
        device: torch.device,
        meta: dict[str, Any],
        started: float,
    ) -> None:
        """`started` is a time of time.monotonic()."""
        self.config, self.contenders, self.references, self.device = config, contenders, references, device
        self.started, self.meta = started, meta | {"not_run": [], "not_timed": []}
        self.failed = 0  # number of contenders that raised an unexpected error
        self.watches: dict[int, Stopwatch] = {}
        self._rows: dict[int, Row] = {}
        self._given_up: set[int] = set()
        self.out, self.file = config.out, config.json or f"{config.out}.json"

    @property
    def rows(self) -> list[Row]:
        return [self._rows[i] for i in sorted(self._rows)]

    def measure(self) -> None:
        """Scores and times every contender, repeats the timing in turns, and draws the figures."""
        with bar("contenders", total=len(self.contenders), unit="contender") as progress:
            for i in range(len(self.contenders)):
                self._attempt(i, self._errors)
                self._attempt(i, self._times)
                self.write()
                progress.update()
        for _ in range(1, ROUNDS):
            for i in sorted(self.watches):
                self._attempt(i, self._time)
        self.write(drawn=True)

    def write(self, drawn: bool = False) -> None:
        """Writes the JSON, and with `drawn` the figures. NaN becomes null."""
        timed = [row for row in self.rows if row["system"] not in UNTIMED]
        self.meta["not_timed"] = [label(row) for row in timed if row.get("ms") is None]
        self.meta["seconds"] = time.monotonic() - self.started
        rows = finite(self.rows)
        paired = paired_rows(self.rows) if drawn else []
        write_report(self.file, {"meta": self.meta, "rows": rows, "paired": paired})
        if drawn:
            draw(self.out, rows, self.meta)

    def _errors(self, i: int) -> None:
        try:
            self._rows[i] = score(self.contenders[i], self.references, self.device)
        finally:
            self.contenders[i].release()
        self.write()

    def _times(self, i: int) -> None:
        if self.contenders[i].row["system"] not in UNTIMED:
            self.watches[i] = Stopwatch(self.contenders[i], self.references, self.device)
            self._time(i)

    def _time(self, i: int) -> None:
        self._rows[i] |= self.watches[i].round()

    def _attempt(self, i: int, work: Callable[[int], None]) -> None:
        """Measures a contender. If it fails, the report names it, and the run continues with the next one."""
        if i in self._given_up:
            return
        try:
            work(i)
        except (ConfigError, torch.OutOfMemoryError) as error:
            self._leave_out(i, str(error))
        except Exception as error:  # noqa: BLE001 - printed in full and counted
            traceback.print_exc()
            self.failed += 1
            self._leave_out(i, f"{type(error).__name__}: {error}")

    def _leave_out(self, i: int, cause: str) -> None:
        self._given_up.add(i)
        self.watches.pop(i, None)
        self.contenders[i].release()
        self.meta["not_run"].append(self.contenders[i].row | {"cause": cause, "scored": i in self._rows})
        print(f"left out: {label(self.contenders[i].row)}: {cause}", file=sys.stderr)


def draw(out: str, rows: Sequence[Row], meta: dict[str, Any]) -> list[str]:
    """Writes the figures of a report's JSON; returns their names."""
    files = {
        f"{out}.png": draw_pareto(rows, meta),
        f"{out}_batched.png": draw_pareto(rows, meta, batched=True),
        f"{out}_frames.png": draw_frames(rows, meta),
    }
    for file, picture in files.items():
        write_atomically(Path(file), picture)
    return list(files)
