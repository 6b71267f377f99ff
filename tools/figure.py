"""Matplotlib's figures as PNG, drawn without a screen."""

from __future__ import annotations

import io
from typing import Any

import numpy as np


def new_figure(lines: int, columns: int, size: tuple[float, float], share_y: bool = False) -> tuple[Any, np.ndarray]:
    """A figure of that size in inches, and its panels [lines, columns]."""
    from matplotlib.figure import Figure  # takes a second to load, which a command may not need

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(lines, columns, sharey=share_y, squeeze=False)


def as_png(figure: Any, dpi: int = 110) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()
