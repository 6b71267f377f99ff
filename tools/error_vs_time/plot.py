"""Figures of a report's JSON: error against run time, and error over the frames with the chaos floor."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from itertools import cycle, repeat
from typing import Any

import numpy as np

from tools.error_vs_time.paired import NETWORK_SYSTEMS
from tools.error_vs_time.score import label
from tools.error_vs_time.settings import UNTIMED
from tools.report import as_png, new_figure

CONVENTION = "squared errors: sum over axes, mean over particles and scenes, frame units"
SHOWN_FRAME = 50  # in a panel of its own, next to the last frame
HGN_COLORS = ("#0b3c8c", "#2f7fd6", "#12a3a8", "#7b5cd6", "#5aa9e6", "#2b2f77")
GNS_COLORS = ("#d9480f", "#a61e4d", "#f08c00", "#862e9c")
GRID_COLORS = ("#111111", "#5c5c5c", "#9a9a9a", "#c0c0c0")  # the finest first
PRECISION_MARKERS = {"fp32": "o", "tf32": "s", "fp16": "D"}
STEP_MARKERS = ("^", "v", "<", ">")  # the largest step first
FLOOR_COLOR, BASELINE_COLOR = "#2b8a3e", "#868e96"
FLOOR_LINES, BASELINE_LINES = ("-", "--"), (":", "--", "-.")
TICKS = (1, 2, 5)  # of each decade of the run times
TEXT, SMALL, TINY = 10.5, 9.5, 7.5  # points
FIGURE_WIDTH, PANEL_HEIGHT = 16.2, 4.9  # inches
NEAR_FLOOR, FAR_ABOVE = 30, 8  # limits of the axis: factor below the least error, and above the best baseline
LEGEND_LINE = 1.5 * SMALL  # points
TIMED = (*NETWORK_SYSTEMS, "mpm")
UPPER_EDGE = 0.965  # of a panel's height, where contenders are marked that diverged in all scenes

Row = Mapping[str, Any]


def draw_pareto(rows: Sequence[Row], meta: Mapping[str, Any], batched: bool = False) -> bytes:
    """Draws errors against milliseconds a frame, of one scene or of several side by side; returns PNG bytes.

    A line joins the precisions of a network, and the steps of the solver on a grid. Bars are the middle half of the
    scenes. Crosses mark means over fewer scenes, because others failed.
    """
    frames = sorted({int(frame) for row in rows for frame in row["position_mse"]})
    shown: list[int | None] = [None, *sorted({f for f in frames if f == SHOWN_FRAME} | set(frames[-1:]))]
    styles = _styles(rows)
    columns = _legend(rows, styles)
    most = max(len(column) for column in columns)
    below = most * LEGEND_LINE / 72  # inches
    size = (FIGURE_WIDTH, PANEL_HEIGHT + below + 0.9)
    figure, grid = new_figure(1, len(shown), size)
    scenes = max((row.get("batch_scenes") or 1 for row in rows), default=1)
    how = f"up to {scenes} scenes side by side, the best number for each" if batched else "one scene"
    for panel, frame in zip(grid[0], shown, strict=True):
        _pareto(panel, rows, frame, "ms_batched" if batched else "ms", styles)
        panel.set_xlabel(f"milliseconds a frame{' and scene' if batched else ''}", fontsize=TEXT)
    footer = _footer(figure, meta)
    filled = [handle for column in columns for handle in column + [_mark("", "", "none")] * (most - len(column))]
    place = {"loc": "lower center", "bbox_to_anchor": (0.5, footer / size[1]), "borderaxespad": 0}
    figure.legend(handles=filled, ncols=len(columns), fontsize=SMALL, frameon=False, columnspacing=2.5, **place)
    return _png(figure, meta, f"Error against run time, {how}", footer + below + 0.12)


def draw_frames(rows: Sequence[Row], meta: Mapping[str, Any]) -> bytes:
    """Draws position MSE over the frames, of each network at the precision that reached most; returns PNG bytes."""
    figure, ((panel,),) = new_figure(1, 1, (11.0, 6.4))
    styles = _styles(rows)
    networks = [row for row in rows if row["system"] in NETWORK_SYSTEMS]
    best: dict[str, Row] = {}
    for row in sorted(networks, key=lambda row: sum(value is None for value in row["curve"])):
        best.setdefault(row["weights"], row)
    for row in rows:
        network = row["system"] in NETWORK_SYSTEMS
        if network and row is not best[row["weights"]]:
            continue
        own, curve_T = styles[label(row, setting=False)], np.array([np.nan if v is None else v for v in row["curve"]])
        time_T = np.flatnonzero(curve_T > 0)
        style = {"color": own["color"], "linestyle": own.get("line", "-"), "linewidth": 2.0 if network else 1.2}
        if row["system"] == "mpm":
            style |= {"marker": own["markers"][row["step"]], "markevery": 0.15, "markersize": 5}
        panel.plot(time_T, curve_T[time_T], label=label(row), **style)
    panel.set_xlabel("frame", fontsize=TEXT)
    panel.set_ylabel("position MSE (domain lengths²)", fontsize=TEXT)
    panel.set_yscale("log")
    scored = sorted({int(frame) for row in rows for frame in row["position_mse"]})
    if scored:  # without the solver's small first errors and the large ones of ballistic motion
        panel.set_ylim(_limits(rows, scored[0])[0], _limits(rows, scored[-1])[1])
    panel.grid(alpha=0.25)
    panel.tick_params(labelsize=SMALL)
    if rows:
        panel.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0, fontsize=SMALL, frameon=False)
    return _png(figure, meta, "Error over the frames", _footer(figure, meta))


def _pareto(panel: Any, rows: Sequence[Row], frame: int | None, key: str, styles: Mapping[str, Any]) -> None:
    from matplotlib.ticker import LogLocator

    times = [row[key] for row in rows if row.get(key) is not None] or [1.0]
    low, high = _limits(rows, frame)
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(label(row, setting=False), []).append(row)
    for name, some in groups.items():
        own, error = styles[name], _error(some[0], frame)
        if some[0]["system"] not in UNTIMED:
            points = sorted((row for row in some if row.get(key) is not None), key=lambda row: row[key])
            there = [(row[key], y) for row in points if (y := _error(row, frame)) is not None]
            panel.plot([x for x, _ in there], [y for _, y in there], "-", color=own["color"], linewidth=1.2, alpha=0.6)
            for row in points:
                _point(panel, row, frame, key, own, high)
        elif error is not None:
            panel.axhline(error, color=own["color"], linestyle=own["line"], linewidth=1.3, zorder=1)
    panel.set(xscale="log", yscale="log", xlim=(min(times) / 1.8, max(times) * 1.8), ylim=(low, high))
    panel.xaxis.set_major_locator(LogLocator(subs=TICKS))
    panel.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    panel.xaxis.set_minor_formatter("")
    title = "one step: MSE of accelerations" if frame is None else f"rollout: MSE of positions at frame {frame}"
    panel.set_title(title, fontsize=TEXT)
    panel.set_ylabel("MSE (domain lengths² / frame⁴)" if frame is None else "MSE (domain lengths²)", fontsize=SMALL)
    panel.tick_params(labelsize=SMALL)
    panel.grid(alpha=0.25)
    panel.grid(alpha=0.1, which="minor", axis="x")
    floors = _errors(rows, frame, "chaos")
    if floors:
        panel.axhspan(low, max(floors), color=FLOOR_COLOR, alpha=0.09, linewidth=0, zorder=0)


def _limits(rows: Sequence[Row], frame: int | None) -> tuple[float, float]:
    """Returns limits of the axis of errors, without points far above the baselines and floors far below."""
    points, baselines, floors = (_errors(rows, frame, *of) for of in (TIMED, ("baseline",), ("chaos",)))
    everything = points + baselines + floors or [1.0]
    low, high = min(points or everything), max([*points, *baselines[:1]] or everything)
    low = min([low, *(floor for floor in floors if floor > low / NEAR_FLOOR)])
    if baselines:
        high = min(max(high, min(baselines)), FAR_ABOVE * min(baselines))
    return low / 2.5, high * (2.5 * high / low) ** 0.12


def _point(panel: Any, row: Row, frame: int | None, key: str, own: Mapping[str, Any], highest: float) -> None:
    marker = own["markers"][row["step"]] if row["system"] == "mpm" else PRECISION_MARKERS[row["precision"]]
    style = {"color": own["color"], "markeredgecolor": "white", "markeredgewidth": 0.7, "markersize": 8.5, "zorder": 4}
    x, error, scenes = row[key], _error(row, frame), len(row["seeds"])
    reached = scenes if frame is None else int(row["scenes_reached"].get(str(frame), 0))
    if error is None and (reached or not row["failed_scenes"]):
        return
    edge = {"transform": panel.get_xaxis_transform()}
    inside = error is not None and error <= highest
    y, at = (error, {}) if inside else (UPPER_EDGE, edge)
    panel.plot(x, y, marker, **at, **style)
    if error is not None and not inside:
        style = {"textcoords": "offset points", "xytext": (8, -4), "fontsize": SMALL, "color": own["color"]}
        panel.annotate(f"↑ {error:.0e}", (x, y), xycoords=edge["transform"], **style)
        return
    bars = row["one_step_quartiles"] if frame is None else row["position_quartiles"].get(str(frame))
    if inside and bars and min(bars) > 0:
        panel.plot([x] * 2, bars, "-", color=own["color"], linewidth=4, alpha=0.28, zorder=2)
    if reached < scenes:
        panel.plot(x, y, "x", color="black", markersize=10, zorder=5, **at)


def _mark(marker: str, name: str, color: str = "0.35") -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], marker=marker, linestyle="", color=color, markersize=7.5, label=name)


def _legend(rows: Sequence[Row], styles: Mapping[str, Any]) -> list[list[Any]]:
    """Returns the columns of the legend."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    networks: list[Any] = []
    grids: list[Any] = []
    lines: list[Any] = []
    steps: dict[float, str] = {}
    for name, own in styles.items():
        kind = networks if own["system"] in NETWORK_SYSTEMS else grids if own["system"] == "mpm" else lines
        style = {"linestyle": own["line"], "linewidth": 1.5} if kind is lines else {"linewidth": 3.5}
        text = f"baseline: {name}" if own["system"] == "baseline" else name
        kind.append(Line2D([], [], color=own["color"], label=text, **style))
        steps |= own.get("markers", {})
    present = {row["precision"] for row in rows if row["system"] in NETWORK_SYSTEMS}
    precisions = [_mark(marker, name) for name, marker in PRECISION_MARKERS.items() if name in present]
    marks = [_mark(m, f"solver, {step:g} of the stable step") for step, m in sorted(steps.items(), reverse=True)]
    notes: list[Any] = []
    if networks or grids:
        notes.append(Patch(color="0.35", alpha=0.28, label="bar: the middle half of the scenes"))
    if any(row["failed_scenes"] for row in rows):
        notes.append(_mark("x", "some scenes failed (at the upper edge: all)", "black"))
    if any(row["system"] == "chaos" for row in rows):
        notes.append(Patch(color=FLOOR_COLOR, alpha=0.15, label="below the chaos floor"))
    columns = [networks, [*grids, *marks], [*precisions, *notes], lines]
    return [column for column in columns if column] or [[_mark("", "nothing was measured")]]


def _styles(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Returns colours, markers and lines by name."""
    grids = sorted({row["grid"] for row in rows if row["system"] == "mpm"}, reverse=True)
    steps = sorted({row["step"] for row in rows if row["system"] == "mpm"}, reverse=True)
    gns = cycle(GNS_COLORS)
    colors = {"hgn": cycle(HGN_COLORS), "chaos": repeat(FLOOR_COLOR), "baseline": repeat(BASELINE_COLOR)}
    lines = {"chaos": cycle(FLOOR_LINES), "baseline": cycle(BASELINE_LINES)}
    styles: dict[str, dict[str, Any]] = {}
    for row in rows:
        name, system = label(row, setting=False), row["system"]
        if name in styles:
            continue
        styles[name] = {"system": system}
        if system == "mpm":
            color = GRID_COLORS[min(grids.index(row["grid"]), len(GRID_COLORS) - 1)]
            styles[name] |= {"color": color, "markers": dict(zip(steps, cycle(STEP_MARKERS), strict=False))}
        else:
            styles[name] |= {"color": next(colors.get(system, gns))}
            styles[name] |= {"line": next(lines[system])} if system in lines else {}
    return styles


def _error(row: Row, frame: int | None) -> float | None:
    error = row["one_step_mse"] if frame is None else row["position_mse"].get(str(frame))
    return error if error is not None and error > 0 else None


def _errors(rows: Sequence[Row], frame: int | None, *systems: str) -> list[float]:
    return [error for row in rows if row["system"] in systems and (error := _error(row, frame)) is not None]


def _footer(figure: Any, meta: Mapping[str, Any]) -> float:
    """Writes the provenance at the lower edge; returns its height in inches."""
    versions = "torch {torch}, taichi {taichi}".format(**meta["versions"])
    when = f"commit {meta['commit']}, {meta['date'][:10]}: {meta['command']}"
    text = f"{CONVENTION}; scored by {meta['reference']}. {versions}, {when}"
    width = int(figure.get_figwidth() * 72 / (0.62 * TINY))  # characters
    lines = textwrap.wrap(text, width, max_lines=4, placeholder=" …")
    figure.text(0.006, 0.008, "\n".join(lines), fontsize=TINY, color="0.35", va="bottom")
    return (len(lines) * 1.4 * TINY + 8) / 72


def _png(figure: Any, meta: Mapping[str, Any], title: str, below: float) -> bytes:
    """Adds a title; `below` inches stay free at the lower edge."""
    free = below / figure.get_figheight()
    figure.get_layout_engine().set(rect=(0, free, 1, 1 - free))
    scenes = f"{meta['scenes']} {meta['split']} scenes of {meta['data']}, {meta['device']}"
    figure.suptitle(f"{title}: {scenes}", fontsize=TEXT + 2)
    return as_png(figure, dpi=130)
