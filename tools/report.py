"""Shared by all reports: provenance, tables and figures."""

from __future__ import annotations

import io
import itertools
import math
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hgn.schema import FileName, printable, to_mapping
from hgn.system.files import WRITTEN_BY_HGN, write_json
from hgn.system.provenance import provenance, with_texts, without_folders

if TYPE_CHECKING:
    import torch

PASS = "pass"  # result of a check; otherwise a sentence with the error and its bound
EXIT_RED = 1


@dataclass(frozen=True, kw_only=True)
class ReportConfig:
    """The options that reports have in common."""

    device: str = "auto"  # auto (a GPU if there is one), cpu, cuda or cuda:1
    json: FileName | None = None  # file for the rows


def meta_of(config: Any, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Returns the provenance and the options of the command."""
    return provenance(device) | {"config": with_texts(without_folders(to_mapping(config)), printable)}


def write_report(file: str, content: Any) -> None:
    """Writes a report's JSON atomically, and makes a missing folder. NaN and infinity become null."""
    write_json(file, finite(content), allow_nan=False)


def finite(value: Any) -> Any:
    """Returns mappings, lists and numbers with None in place of NaN and infinity."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def table(head: Sequence[str], rows: Iterable[Sequence[Any]], width: int = 100) -> str:
    """Returns an aligned Markdown table. If it is wider than `width` columns, the cells of its widest columns wrap."""
    lines = [[str(cell) for cell in line] for line in (head, *rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    frame = 3 * len(widths) + 1
    while sum(widths) + frame > width:
        widths[widths.index(max(widths))] -= 1
    ruled = [*lines[:1], ["-" * width for width in widths], *lines[1:]]
    return "\n".join(text for line in ruled for text in _wrapped(line, widths))


def _wrapped(line: Sequence[str], widths: Sequence[int]) -> list[str]:
    cells = [textwrap.wrap(text, width, break_on_hyphens=False) for text, width in zip(line, widths, strict=True)]
    parts = itertools.zip_longest(*cells, fillvalue="")
    return [f"| {' | '.join(map(str.ljust, part, widths))} |" for part in parts]


def number(value: float | None, form: str) -> str:
    """Formats a number, or returns a dash."""
    return "-" if value is None or not math.isfinite(value) else format(value, form)


def spread(quartiles: Sequence[float] | None, form: str) -> str:
    """Formats a range, or returns a dash."""
    return "-" if quartiles is None else " … ".join(format(value, form) for value in quartiles)


def new_figure(lines: int, columns: int, size: tuple[float, float], share_y: bool = False) -> tuple[Any, np.ndarray]:
    """Returns a figure of that size in inches, and its panels [lines, columns]."""
    from matplotlib.figure import Figure  # loading takes a second

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(lines, columns, sharey=share_y, squeeze=False)


def shared_legend(figure: Any, **style: Any) -> None:
    """Adds one legend of all panels: within a panel it would cover curves."""
    pairs = [pair for panel in figure.axes for pair in zip(*panel.get_legend_handles_labels(), strict=True)]
    shown = {label: handle for handle, label in pairs}
    if shown:
        figure.legend(shown.values(), shown.keys(), **style)


def as_png(figure: Any, dpi: int = 110) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": WRITTEN_BY_HGN})
    return buffer.getvalue()
