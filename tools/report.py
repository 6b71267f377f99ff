"""What reports share: where they come from, their tables and figures for people, and what a check says."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch

from hgn.schema import to_mapping
from hgn.system.provenance import provenance, without_folders

PASS = "pass"  # of a check; else it says by how much something differs
EXIT_RED = 1


def meta_of(config: Any, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Provenance, and the options of the command."""
    return provenance(device) | {"config": without_folders(to_mapping(config))}


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Markdown whose columns stand below each other on a terminal too."""
    lines = [[str(cell) for cell in line] for line in (head, *rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    lines.insert(1, ["-" * width for width in widths])
    return "\n".join(f"| {' | '.join(map(str.ljust, line, widths))} |" for line in lines)


def number(value: float | None, form: str) -> str:
    """A figure for people; a dash where there is none."""
    return "-" if value is None or not math.isfinite(value) else format(value, form)


def spread(quartiles: Sequence[float] | None, form: str) -> str:
    """The least and the most, or the quartiles, for people."""
    return "-" if quartiles is None else " … ".join(format(value, form) for value in quartiles)


def new_figure(lines: int, columns: int, size: tuple[float, float], share_y: bool = False) -> tuple[Any, np.ndarray]:
    """A figure of that size in inches, and its panels [lines, columns]."""
    from matplotlib.figure import Figure  # takes a second to load, which a command may not need

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(lines, columns, sharey=share_y, squeeze=False)


def as_png(figure: Any, dpi: int = 110) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()
