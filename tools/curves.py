"""python -m tools.curves runs=[runs/obstacles] out=results/NAME: learning curves of runs as PNG and JSON.

One run: loss, one-step errors beside the baselines, and rollout errors, over updates. Several: loss and
one-step validation error over updates, and the latter over minutes of training, in one panel each.

The JSON holds {"meta": provenance of the figure, "runs": [{"name", "meta": provenance and settings of the run,
"rows"}, ...]}, a row for each measurement; `minutes` are those of training, without the time between a stop and the
next start.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from hgn.command import run_command
from hgn.renamed import current_metrics
from hgn.schema import ConfigError, from_mapping, require
from hgn.system.files import write_atomically, write_json
from hgn.system.provenance import provenance
from tools.figure import as_png, new_figure

ROW_KEYS = (
    "update",
    "minutes",
    "loss",
    "learning_rate",
    "updates_per_second",
    "scenes_per_second",
    "gpu_memory_gb",
)
ROW_PREFIXES = ("one_step", "baseline", "rollout", "monitor")
BASELINE_STYLES = {"constant_velocity": ":", "ballistic_motion": "--", "mean_acceleration": "-."}
LOSS = "MSE of normalised acceleration"
ONE_STEP = "one-step MSE (sum over axes, frame units)"
LINES = 200  # of the loss that are kept
BREAKS = 10  # times the usual time between two records: there the training was stopped


@dataclass(frozen=True)
class CurvesConfig:
    """The options of `python -m tools.curves`."""

    runs: tuple[str, ...]  # folders of python -m hgn.train, for example [runs/obstacles,runs/gns]
    out: str  # without ending: OUT.png and OUT.json
    names: tuple[str, ...] | None = None  # of the runs in the figure; null: those of the folders

    def __post_init__(self) -> None:
        require(len(self.runs) > 0, "runs", "at least one folder of python -m hgn.train", self.runs)
        if self.names is not None:
            rule = f"one for each of the {len(self.runs)} runs"
            require(len(self.names) == len(self.runs), "names", rule, self.names)


@dataclass(frozen=True)
class Run:
    """What a run of hgn.train has written."""

    name: str
    settings: Mapping[str, Any]
    records: list[dict[str, float]]  # of metrics.jsonl, each update's last, with `minutes`


def main(mapping: dict[str, Any]) -> int:
    """Writes <out>.png and <out>.json; returns the exit code."""
    config = from_mapping(CurvesConfig, mapping)
    names = config.names or tuple(Path(run).name for run in config.runs)
    runs = [read_run(Path(folder), name) for folder, name in zip(config.runs, names, strict=True)]
    out = Path(config.out)
    report = {
        "meta": provenance(),
        "runs": [
            {
                "name": run.name,
                "meta": dict(run.settings.get("provenance", {})) | {"config": run.settings},
                "rows": measurements(run.records),
            }
            for run in runs
        ],
    }
    write_json(out.with_suffix(".json"), report)
    write_atomically(out.with_suffix(".png"), draw(runs[0]) if len(runs) == 1 else draw_several(runs))
    print(out.with_suffix(".png"))
    print(out.with_suffix(".json"))
    return 0


def read_run(folder: Path, name: str) -> Run:
    """Reads metrics.jsonl and the resolved configuration.

    Raises: ConfigError when the folder is no run of hgn.train.
    """
    try:
        lines = (folder / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
        settings = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError(
            f"runs must be folders of python -m hgn.train, got {folder} without {error.filename}"
        ) from None
    records = [current_metrics(json.loads(line)) for line in lines]
    _add_minutes(records)
    # A run that was stopped and resumed may have repeated some updates: the later record holds.
    latest = {(record["update"], "loss" in record): record for record in records}
    return Run(name, settings, [latest[key] for key in sorted(latest)])


def _add_minutes(records: list[dict[str, float]]) -> None:
    """Adds the minutes since the first record; a stop counts as much as two records are usually apart."""
    gaps = [after["time"] - before["time"] for before, after in itertools.pairwise(records)]
    usual = sorted(gaps)[len(gaps) // 2] if gaps else 0.0
    seconds = 0.0
    for record, gap in zip(records, [0.0, *gaps], strict=False):
        monitored = record.get("monitor/seconds", 0.0)
        seconds += gap if 0 <= gap <= BREAKS * usual + monitored else usual
        record["minutes"] = seconds / 60


def measurements(records: list[dict[str, float]]) -> list[dict[str, float]]:
    """Records with errors in full, and at most LINES of the loss lines."""
    losses = [record for record in records if "loss" in record]
    step = -(-len(losses) // LINES)
    kept = {id(record) for record in losses[:: max(1, step)]} | {id(r) for r in records if "loss" not in r}
    return [
        {k: v for k, v in record.items() if k in ROW_KEYS or k.startswith(ROW_PREFIXES)}
        for record in records
        if id(record) in kept
    ]


def draw(run: Run) -> bytes:
    """Loss and one-step errors over updates, the baselines as lines, and rollout errors; PNG bytes."""
    figure, ((left, middle, right),) = new_figure(1, 3, (15, 4.5))
    records = run.records
    _plot(left, records, "loss", "training loss (noisy input)", "0.4")
    left.set_ylabel(LOSS)
    for split, color in (("training", "tab:blue"), ("validation", "tab:orange")):
        _plot(middle, records, f"one_step/{split}", f"network, {split}", color, marker="o")
    last = _last(records)
    _baseline_lines(middle, last)
    middle.set_ylabel(ONE_STEP)
    for frame in (10, 50, 150, 299):
        _plot(right, records, f"rollout/mse_frame_{frame}", f"frame {frame}", None, marker="o")
    right.set_ylabel("rollout position MSE (domain units²)")
    for axes in (left, middle, right):
        _finish(axes, "updates")
    training, dataset = run.settings["training"], run.settings["dataset"]
    episodes = f"{int(last['episodes'])} training episodes, " if "episodes" in last else ""
    figure.suptitle(
        f"{dataset['folder']}, {episodes}{training['batch_scenes']} scenes an update, {_origin(run)}",
        fontsize=10,
    )
    return as_png(figure)


def draw_several(runs: list[Run]) -> bytes:
    """Loss and validation error over updates, and the latter over minutes; PNG bytes."""
    figure, ((left, middle, right),) = new_figure(1, 3, (15, 4.5))
    for i, run in enumerate(runs):
        label, color = f"{run.name}, {run.settings['training']['batch_scenes']} scenes", f"C{i}"
        losses = [record for record in run.records if "loss" in record]
        _plot(left, _means(losses, "loss"), "loss", label, color)
        for axes, against in ((middle, "update"), (right, "minutes")):
            _plot(axes, run.records, "one_step/validation", "", color, marker="o", against=against)
    for axes in (middle, right):
        _baseline_lines(axes, _last(runs[0].records))
        axes.set_ylabel(ONE_STEP + ", validation")
    left.set_ylabel(LOSS)
    for axes, label in ((left, "updates"), (middle, "updates"), (right, "minutes of training")):
        _finish(axes, label)
    figure.suptitle("; ".join(sorted({_origin(run) for run in runs})), fontsize=10)
    return as_png(figure)


def _means(records: list[dict[str, float]], key: str, lines: int = 60) -> list[dict[str, float]]:
    """Means over neighbouring records, as many as are drawn."""
    step = max(1, len(records) // lines)
    parts = [records[i : i + step] for i in range(0, len(records), step)]
    return [{"update": part[-1]["update"], key: sum(r[key] for r in part) / len(part)} for part in parts]


def _last(records: list[dict[str, float]]) -> dict[str, float]:
    """The last value of each measurement."""
    last: dict[str, float] = {}
    for record in records:
        last |= record
    return last


def _origin(run: Run) -> str:
    where = run.settings.get("provenance", {})
    return f"{where.get('device', '')}, commit {where.get('commit', '')}, {str(where.get('date', ''))[:10]}"


def _baseline_lines(axes: Any, last: dict[str, float]) -> None:
    for name, style in BASELINE_STYLES.items():
        if f"baseline/validation_{name}" in last:
            label = f"{name.replace('_', ' ')}, validation"
            axes.axhline(last[f"baseline/validation_{name}"], color="0.3", linestyle=style, label=label)


def _finish(axes: Any, label: str) -> None:
    axes.set_xlabel(label)
    axes.grid(alpha=0.3, which="both")
    if axes.lines:
        axes.set_yscale("log")
        axes.legend(fontsize=8)


def _plot(
    axes: Any,
    records: list[dict[str, float]],
    key: str,
    label: str,
    color: str | None,
    marker: str = "",
    against: str = "update",
) -> None:
    points = [(record[against], record[key]) for record in records if key in record]
    if points:
        axes.plot(*zip(*points, strict=True), label=label, color=color, marker=marker, markersize=3, linewidth=1)


if __name__ == "__main__":
    run_command(main, "curves")
