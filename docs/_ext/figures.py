"""Draws the figures of results pages from the JSON beside them, for the site.

A page places one by `<!-- figure: NAME.png: CAPTION -->`, alone in its line. `NAME` is a key of `FIGURES` in the page's
folder; the picture appears under docs/_generated/figures and is not committed.
"""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
DRAWN = ROOT / "docs" / "_generated" / "figures"
MARKER = re.compile(r"^<!-- figure: (?P<name>[\w-]+\.png): (?P<caption>[^>]+?) -->$", re.MULTILINE)

# of drift_h100.json, which has the names of its day
DRIFT_NAMES = {
    "error: from the data": "the network's error",
    "plain, highest, once more": "PyTorch, fp32, once more",
    "plain, high": "PyTorch, tf32",
    "fast, high": "triton, tf32",
    "fast, half": "triton, fp16",
}

Report = dict[str, Any]


def _error_against_time(report: Report) -> bytes:
    from tools.error_vs_time.plot import draw_pareto

    return draw_pareto(report["rows"], report["meta"])


def _batched(report: Report) -> bytes:
    from tools.error_vs_time.plot import draw_pareto

    return draw_pareto(report["rows"], report["meta"], batched=True)


def _frames(report: Report) -> bytes:
    from tools.error_vs_time.plot import draw_frames

    return draw_frames(report["rows"], report["meta"])


def _curves(report: Report) -> bytes:
    from tools.curves import Run, draw

    def settings(meta: Report) -> Report:
        return meta["config"] | {"provenance": {name: meta.get(name, "") for name in ("device", "commit", "date")}}

    parts = report.get("runs", [report])  # a single run has no list
    for part in parts:
        for row in part["rows"]:  # early reports count updates alone
            row.setdefault("scenes", row["update"] * part["meta"]["config"]["training"]["batch_scenes"])
    return draw([Run(part.get("name", ""), settings(part["meta"]), part["rows"]) for part in parts])


def _steps(report: Report) -> bytes:
    from hgn.config import MpmConfig
    from tools.stability.solver_steps import Point, draw

    config = MpmConfig(stability_fraction=report["meta"]["solver"]["stability_fraction"])
    return draw([Point(**point) for point in report["steps"]], config)


def _drift(report: Report) -> bytes:
    from tools.report import as_png, new_figure

    figure, (panels,) = new_figure(1, 2, (14.5, 5.4), share_y=True)
    for row in report["rows"]:
        style = "--" if row["system"] == "solver" else ":" if row["name"].startswith("displaced") else "-"
        for panel, kind in zip(panels, ("mean", "median"), strict=True):
            name = DRIFT_NAMES.get(row["name"], f"{row['system']}, {row['name']}")
            errors = row["curves"][kind][1:]  # of frame 1 and later: frame 0 is the same for all
            panel.plot(range(1, len(errors) + 1), errors, style, label=name)
            panel.set(title=f"{kind} of the scenes", xlabel="frame", yscale="log")
            panel.grid(alpha=0.3)
    panels[0].set_ylabel("position MSE (domain lengths²)")
    panels[1].legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return as_png(figure)


# picture: the report that it shows, and how
FIGURES: dict[str, tuple[str, Callable[[Report], bytes]]] = {
    f"results/error_vs_time/{name}{end}.png": (f"results/error_vs_time/{name}.json", draw)
    for name in ("fine", "obstacles", "chosen", "no_obstacles")
    for end, draw in (("", _error_against_time), ("_batched", _batched), ("_frames", _frames))
    if (name, end) not in (("fine", ""), ("fine", "_batched"), ("obstacles", "_batched"))
} | {
    "results/fast/drift_h100.png": ("results/fast/drift_h100.json", _drift),
    "results/obstacles/curves.png": ("results/obstacles/curves.json", _curves),
    "results/recipe/gns_curves.png": ("results/recipe/gns_curves.json", _curves),
    "results/recipe/networks_curves.png": ("results/recipe/networks_curves.json", _curves),
    "results/solver/steps.png": ("results/solver/stability_solver.json", _steps),
}


def figure_path(name: str) -> Path:
    """Draws a figure of FIGURES unless it is newer than its report; returns the picture."""
    report, draw = FIGURES[name]
    picture, source = DRAWN / name, ROOT / report
    if not picture.is_file() or picture.stat().st_mtime < source.stat().st_mtime:
        sys.path[:0] = [str(ROOT)] * (str(ROOT) not in sys.path)
        picture.parent.mkdir(parents=True, exist_ok=True)
        picture.write_bytes(draw(json.loads(source.read_text(encoding="utf-8"))))
    return picture


def with_figures(text: str, file: Path) -> str:
    """The text of a page with an image for each marker; paths are relative to the page's file."""

    def image(match: re.Match[str]) -> str:
        name = str((file.parent / match["name"]).relative_to(ROOT))
        if name not in FIGURES:
            raise ValueError(f"{file}: no figure {name}; docs/_ext/figures.py lists them")
        up = "../" * len(file.parent.relative_to(ROOT).parts)
        return f"![{match['caption']}]({up}{figure_path(name).relative_to(ROOT)})"

    return MARKER.sub(image, text)
