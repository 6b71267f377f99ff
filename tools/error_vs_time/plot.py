"""The figures: error against run time, and error over the frames with the chaos floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tools.error_vs_time.score import label
from tools.figure import as_png, new_figure

CONVENTION = "squared errors: sum over axes, mean over particles and scenes, frame units"
STYLES = {"hgn": ("o", "tab:blue"), "gns": ("^", "tab:orange"), "gns_particles": ("v", "tab:red"), "mpm": ("s", "0.35")}
NETWORK_COLORS = ("tab:blue", "tab:orange", "tab:red", "tab:purple", "tab:brown", "tab:pink", "tab:cyan", "tab:olive")
FLOOR_STYLE: dict[str, Any] = {"color": "tab:green", "linewidth": 1}
TRIVIAL_LINES = (":", "--", "-.")


def draw_pareto(rows: Sequence[Mapping[str, Any]], meta: Mapping[str, Any]) -> bytes:
    """Milliseconds a frame against one-step MSE and position MSE; PNG bytes.

    Full markers are single scenes, hollow ones scenes side by side; crossed out are means over the scenes that came so
    far, where others failed. Lines across are what needs no time: the chaos floor and the trivial predictors.
    """
    frames = sorted({int(frame) for row in rows for frame in row["position_mse"]})
    figure, axes = _figure(1 + len(frames))
    for panel, frame in zip(axes, [None, *frames], strict=True):
        _pareto(panel, rows, frame)
    return _png(figure, meta, "Error against run time")


def draw_frames(rows: Sequence[Mapping[str, Any]], curves: Sequence[np.ndarray], meta: Mapping[str, Any]) -> bytes:
    """Position MSE over the frames; PNG bytes."""
    figure, (panel,) = _figure(1, width=9.0)
    trivial = iter(TRIVIAL_LINES * len(rows))
    colors = iter(NETWORK_COLORS * len(rows))
    grays = np.linspace(0.75, 0.2, max(1, sum(row["system"] == "mpm" for row in rows))).tolist()
    for row, curve_T in zip(rows, curves, strict=True):
        system = row["system"]
        style: dict[str, Any] = {"linewidth": 1.2}
        if system == "mpm":
            style |= {"color": str(grays.pop(0)), "marker": "s", "markevery": 0.2, "markersize": 3}
        elif system == "chaos":
            style = FLOOR_STYLE | {"linestyle": "--" if "step" in row["floor"] else "-"}
        elif system == "trivial":
            style = {"color": "0.6", "linewidth": 0.9, "linestyle": next(trivial)}
        else:
            style |= {"color": next(colors)}
        time_T = np.flatnonzero(curve_T > 0)
        panel.plot(time_T, curve_T[time_T], label=label(row), **style)
    panel.set_xlabel("frame")
    panel.set_ylabel("position MSE (domain units²)")
    panel.set_yscale("log")
    panel.grid(alpha=0.3)
    if rows:
        panel.legend(fontsize=6)
    return _png(figure, meta, "Error over the frames")


def _pareto(panel: Any, rows: Sequence[Mapping[str, Any]], frame: int | None) -> None:
    times = [row[key] for row in rows for key in ("ms", "ms_batched") if row.get(key) is not None] or [1.0]
    low, high = min(times), max(times)
    middle = (low * high) ** 0.5
    trivial = iter(TRIVIAL_LINES * len(rows))
    for row in rows:
        error = row["one_step_mse"] if frame is None else row["position_mse"].get(str(frame))
        if error is None or not error > 0:
            continue
        if row["system"] == "chaos":
            panel.axhline(error, label=label(row), **FLOOR_STYLE, linestyle="--" if "step" in row["floor"] else "-")
        elif row["system"] == "trivial":
            panel.axhline(error, color="0.6", linewidth=0.9, linestyle=next(trivial), label=label(row))
        else:
            marker, color = STYLES[row["system"]]
            whole = frame is None or row["scenes_reached"][str(frame)] == len(row["seeds"])
            for key, fill in (("ms_batched", "none"), ("ms", color)):
                if row.get(key) is not None:
                    panel.plot(row[key], error, marker, color=color, markerfacecolor=fill, markersize=6)
                    if not whole:
                        panel.plot(row[key], error, "x", color="black", markersize=8)
            if row.get("ms") is not None:
                left = row["ms"] < middle
                place = {"xytext": (4 if left else -4, 3), "ha": "left" if left else "right"}
                panel.annotate(_short(row), (row["ms"], error), fontsize=5, textcoords="offset points", **place)
    panel.set_xscale("log")
    panel.set_xlim(low / 2, high * 2)
    panel.xaxis.set_minor_formatter("")
    panel.set_yscale("log")
    panel.set_xlabel("ms a frame and scene (full: one scene, hollow: side by side)")
    panel.set_ylabel(
        "one-step MSE (frame units)" if frame is None else f"position MSE at frame {frame} (domain units²)"
    )
    panel.grid(alpha=0.3, which="both")
    if panel.get_legend_handles_labels()[1]:
        panel.legend(fontsize=6)


def _short(row: Mapping[str, Any]) -> str:
    if row["system"] == "mpm":
        return f"{row['grid']}³ {row['step']:g}"
    levels = f"L{row['levels']} " if row["system"] == "hgn" else ""
    return f"{levels}M{row['message_passing_steps']} {row['precision']} {row['weights'].rsplit('.', 1)[0]}"


def _figure(panels: int, width: float = 5.5) -> tuple[Any, Sequence[Any]]:
    columns = min(panels, 3)
    lines = -(-panels // columns)
    figure, axes = new_figure(lines, columns, (width * columns, 4.5 * lines + 0.6))
    for extra in axes.flat[panels:]:
        extra.axis("off")
    return figure, list(axes.flat[:panels])


def _png(figure: Any, meta: Mapping[str, Any], title: str) -> bytes:
    versions = meta["versions"]
    figure.suptitle(
        f"{title}: {meta['scenes']} {meta['split']} scenes of {meta['data']}, {meta['device']}, "
        f"torch {versions['torch']}, taichi {versions['taichi']}, commit {meta['commit']}, {meta['date'][:10]}\n"
        f"{CONVENTION}\n{meta['command']}",
        fontsize=7,
        wrap=True,
    )
    return as_png(figure, dpi=130)
