"""Figures of a report's JSON: error against run time, and error over the frames with the chaos floor."""

import textwrap
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np

from tools.error_vs_time.paired import NETWORK_SYSTEMS
from tools.error_vs_time.score import label
from tools.error_vs_time.settings import UNTIMED
from tools.report import as_png, new_figure, shared_legend

CONVENTION = "squared errors: sum over axes, mean over particles and scenes, frame units"
SHOWN_FRAME = 50  # frame with a panel of its own, beside that of the last frame
COLORS = {
    "gns": ("#d9480f", "#a61e4d", "#f08c00", "#862e9c"),  # also for other systems; older reports have several GNS
    "hgn": ("#0b3c8c", "#2f7fd6", "#12a3a8", "#7b5cd6", "#5aa9e6", "#2b2f77"),
    "mpm": ("#b5b5b5", "#7d7d7d", "#111111", "#4d4d4d"),  # coarse grids come first
    "baseline": ("#868e96",),
    "chaos": ("#2b8a3e",),
}
LINES = {"chaos": ("-", "--"), "baseline": (":", "--", "-.")}
PRECISION_MARKERS = {"fp32": "o", "tf32": "s", "fp16": "D"}
STEP_MARKERS = {1.0: "^", 0.5: "v"}  # by the fraction of the stable step
NEAR_FLOOR, FAR_ABOVE = 30, 8  # limits of the axis: factor below the smallest error, and above the best baseline
TICKS = (1, 2, 5)  # ticks in each decade of the run times
UPPER_EDGE = 0.965  # fraction of a panel's height where marks of contenders that diverged in all scenes stand
SMALL = 9.5  # points

Row = Mapping[str, Any]


def draw_pareto(rows: Sequence[Row], meta: Mapping[str, Any], batched: bool = False) -> bytes:
    """Draws errors against milliseconds per frame of one scene, or of several side by side; returns PNG bytes.

    A line joins the precisions of a network, and the steps of the solver on a grid. Bars show the middle half of the
    scenes. A cross marks a mean over fewer scenes, because the others failed.
    """
    frames = sorted({int(frame) for row in rows for frame in row["position_mse"]})
    shown: list[int | None] = [None, *sorted({f for f in frames if f == SHOWN_FRAME} | set(frames[-1:]))]
    figure, (panels,) = new_figure(1, len(shown), (16.2, 6.8))
    for panel, frame in zip(panels, shown, strict=True):
        _pareto(panel, rows, frame, "ms_batched" if batched else "ms")
        panel.set_xlabel(f"milliseconds a frame{' and scene' if batched else ''}")
    shared_legend(figure, loc="outside lower center", ncols=4, fontsize=SMALL, frameon=False)
    scenes = max((row.get("batch_scenes") or 1 for row in rows), default=1)
    how = f"up to {scenes} scenes side by side, the best number for each" if batched else "one scene"
    return _png(figure, meta, f"Error against run time, {how}; bars: the middle half of the scenes")


def draw_frames(rows: Sequence[Row], meta: Mapping[str, Any]) -> bytes:
    """Draws position MSE over frames, for each network at the precision that reached most frames; returns PNG bytes."""
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
        curve_T = np.array([np.nan if value is None else value for value in row["curve"]])
        time_T = np.flatnonzero(curve_T > 0)
        style = styles[label(row, setting=False)] | {"linewidth": 2.0 if network else 1.2}
        if row["system"] == "mpm":
            style |= {"marker": _marker(row), "markevery": 0.15, "markersize": 5}
        panel.plot(time_T, curve_T[time_T], label=label(row), **style)
    panel.set(xlabel="frame", ylabel="position MSE (domain lengths²)", yscale="log")
    scored = sorted({int(frame) for row in rows for frame in row["position_mse"]})
    if scored:  # without the solver's small first errors and the large ones of ballistic motion
        panel.set_ylim(_limits(rows, scored[0])[0], _limits(rows, scored[-1])[1])
    panel.grid(alpha=0.25)
    if rows:
        panel.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0, fontsize=SMALL, frameon=False)
    return _png(figure, meta, "Error over the frames")


def _pareto(panel: Any, rows: Sequence[Row], frame: int | None, key: str) -> None:
    from matplotlib.ticker import LogLocator

    low, high = _limits(rows, frame)
    for name, style in _styles(rows).items():
        some = [row for row in rows if label(row, setting=False) == name]
        if some[0]["system"] in UNTIMED:
            if (error := _error(some[0], frame)) is not None:
                named = f"baseline: {name}" if some[0]["system"] == "baseline" else name
                panel.axhline(error, label=named, linewidth=1.3, zorder=1, **style)
            continue
        timed = sorted((row for row in some if row.get(key) is not None), key=lambda row: row[key])
        there = [(row[key], error) for row in timed if (error := _error(row, frame)) is not None]
        panel.plot([x for x, _ in there], [y for _, y in there], label=name, linewidth=1.5, **style)
        for row in timed:
            _point(panel, row, frame, row[key], style["color"], high)
    times = [row[key] for row in rows if row.get(key) is not None] or [1.0]
    panel.set(xscale="log", yscale="log", xlim=(min(times) / 1.8, max(times) * 1.8), ylim=(low, high))
    panel.xaxis.set_major_locator(LogLocator(subs=TICKS))
    panel.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    panel.xaxis.set_minor_formatter("")
    title = "one step: MSE of accelerations" if frame is None else f"rollout: MSE of positions at frame {frame}"
    panel.set(title=title, ylabel=f"MSE (domain lengths²{' / frame⁴' if frame is None else ''})")
    panel.grid(alpha=0.25)
    if floors := _errors(rows, frame, "chaos"):
        color = COLORS["chaos"][0]
        panel.axhspan(low, max(floors), color=color, alpha=0.09, zorder=0, label="below the chaos floor")


def _limits(rows: Sequence[Row], frame: int | None) -> tuple[float, float]:
    """Returns limits of the axis of errors. They omit errors far above the baselines, and a floor far below all."""
    points, baselines, floors = (
        _errors(rows, frame, *systems) for systems in ((*NETWORK_SYSTEMS, "mpm"), ("baseline",), ("chaos",))
    )
    low = min(points or baselines or floors or [1.0])
    low = min([low, *(floor for floor in floors if floor > low / NEAR_FLOOR)])
    best = [min(baselines)] if baselines else []
    high = min([max([*points, *best] or [low]), *(FAR_ABOVE * error for error in best)])
    return low / 2.5, high * (2.5 * high / low) ** 0.12


def _point(panel: Any, row: Row, frame: int | None, x: float, color: str, high: float) -> None:
    """Draws a row's error with its bar, or a mark at the upper edge if the error is above or all scenes failed."""
    error, scenes = _error(row, frame), len(row["seeds"])
    reached = scenes if frame is None else int(row["scenes_reached"].get(str(frame), 0))
    if error is None and (reached or not row["failed_scenes"]):
        return
    inside = error is not None and error <= high
    y, place = (error, panel.transData) if inside else (UPPER_EDGE, panel.get_xaxis_transform())
    how = f"solver, {row['step']:g} of the stable step" if row["system"] == "mpm" else row["precision"]
    panel.plot(x, y, _marker(row), color=color, markersize=8.5, markeredgecolor="white", zorder=4, transform=place)
    panel.plot([], [], _marker(row), color="0.35", label=how)
    if error is not None and not inside:
        panel.annotate(f"↑ {error:.0e}", (x, y), (8, -4), place, "offset points", fontsize=SMALL, color=color)
    bars = row["one_step_quartiles"] if frame is None else row["position_quartiles"].get(str(frame))
    if inside and bars and min(bars) > 0:
        panel.plot([x] * 2, bars, color=color, linewidth=4, alpha=0.28, zorder=2)
    if reached < scenes:
        note = "some scenes failed (at the upper edge: all)"
        panel.plot(x, y, "x", color="black", markersize=10, zorder=5, linestyle="", label=note, transform=place)


def _marker(row: Row) -> str:
    return STEP_MARKERS.get(row["step"], "<") if row["system"] == "mpm" else PRECISION_MARKERS[row["precision"]]


def _styles(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Returns colours and lines by name."""
    systems = {label(row, setting=False): row["system"] if row["system"] in COLORS else "gns" for row in rows}
    colors = {system: cycle(own) for system, own in COLORS.items()}
    lines = {system: cycle(LINES.get(system, "-")) for system in COLORS}
    return {name: {"color": next(colors[of]), "linestyle": next(lines[of])} for name, of in systems.items()}


def _error(row: Row, frame: int | None) -> float | None:
    error = row["one_step_mse"] if frame is None else row["position_mse"].get(str(frame))
    return error if error is not None and error > 0 else None


def _errors(rows: Sequence[Row], frame: int | None, *systems: str) -> list[float]:
    return [error for row in rows if row["system"] in systems and (error := _error(row, frame)) is not None]


def _png(figure: Any, meta: Mapping[str, Any], title: str) -> bytes:
    """Returns the figure as PNG bytes, with a title and the provenance."""
    versions = "torch {torch}, taichi {taichi}".format(**meta["versions"])
    when = f"commit {meta['commit']}, {meta['date'][:10]}: {meta['command']}"
    text = f"{CONVENTION}; scored by {meta['reference']}. {versions}, {when}"
    lines = textwrap.wrap(text, int(12 * figure.get_figwidth()), max_lines=4, placeholder=" …")
    scenes = f"{meta['scenes']} {meta['split']} scenes of {meta['data']}, {meta['device']}"
    figure.suptitle("\n".join([f"{title}: {scenes}", *lines]), fontsize=SMALL)
    return as_png(figure, dpi=130)
