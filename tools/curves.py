"""python -m tools.curves run=runs/obstacles out=results/NAME: a run's learning curves as PNG and JSON.

The JSON holds {"meta": provenance of the run and of the figure, "rows": [...]}, a row for each measurement.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from hgn.command import run_command
from hgn.config import CurvesConfig
from hgn.files import write_atomically, write_json
from hgn.schema import ConfigError, from_mapping
from tools.figure import as_png, new_figure

ROW_KEYS = ("update", "time", "loss", "learning_rate", "updates_per_second", "scenes_per_second", "gpu_memory_gb")
ROW_PREFIXES = ("one_step", "trivial", "rollout", "monitor")
TRIVIAL_STYLES = {"constant_velocity": ":", "ballistic_motion": "--", "mean_acceleration": "-."}


def main(mapping: dict[str, Any]) -> int:
    """Writes <out>.png and <out>.json; returns the exit code."""
    config = from_mapping(CurvesConfig, mapping)
    run, out = Path(config.run), Path(config.out)
    records, settings = read_run(run)
    report = {"meta": settings.get("provenance", {}) | {"config": settings}, "rows": measurements(records)}
    write_json(out.with_suffix(".json"), report)
    write_atomically(out.with_suffix(".png"), draw(records, settings))
    print(out.with_suffix(".png"))
    print(out.with_suffix(".json"))
    return 0


def read_run(run: Path) -> tuple[list[dict[str, float]], dict[str, Any]]:
    """The records of metrics.jsonl and the resolved configuration.

    Raises: ConfigError when the folder is no run of hgn.train.
    """
    try:
        lines = (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
        settings = yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError(f"run must be a folder of python -m hgn.train, got {run} without {error.filename}") from None
    records = [json.loads(line) for line in lines]
    # A run that was stopped and resumed may have repeated some updates: the later record holds.
    latest = {(record["update"], "loss" in record): record for record in records}
    return [latest[key] for key in sorted(latest)], settings


def measurements(records: list[dict[str, float]]) -> list[dict[str, float]]:
    """Records with errors in full, and at most 200 of the plain loss lines."""
    losses = [record for record in records if "loss" in record]
    step = max(1, len(losses) // 200)
    kept = {id(record) for record in losses[::step]} | {id(r) for r in records if "loss" not in r}
    return [
        {k: v for k, v in record.items() if k in ROW_KEYS or k.startswith(ROW_PREFIXES)}
        for record in records
        if id(record) in kept
    ]


def draw(records: list[dict[str, float]], settings: dict[str, Any]) -> bytes:
    """Loss and one-step errors over updates, the trivial predictors as lines, and rollout errors; PNG bytes."""
    figure, ((left, middle, right),) = new_figure(1, 3, (15, 4.5))
    _plot(left, records, "loss", "training loss (noisy input)", "0.4")
    left.set_ylabel("MSE of normalised acceleration")
    for split, color in (("training", "tab:blue"), ("validation", "tab:orange")):
        _plot(middle, records, f"one_step/{split}", f"network, {split}", color, marker="o")
    last: dict[str, float] = {}
    for record in records:
        last |= record
    for name, style in TRIVIAL_STYLES.items():
        if f"trivial/validation_{name}" in last:
            label = f"{name.replace('_', ' ')}, validation"
            middle.axhline(last[f"trivial/validation_{name}"], color="0.3", linestyle=style, label=label)
    middle.set_ylabel("one-step MSE (sum over axes, frame units)")
    for frame in (10, 50, 150, 299):
        _plot(right, records, f"rollout/mse_frame_{frame}", f"frame {frame}", None, marker="o")
    right.set_ylabel("rollout position MSE (domain units²)")
    for axes in (left, middle, right):
        axes.set_xlabel("updates")
        axes.grid(alpha=0.3, which="both")
        if axes.lines:
            axes.set_yscale("log")
            axes.legend(fontsize=8)
    where = settings.get("provenance", {})
    training, dataset = settings["training"], settings["dataset"]
    figure.suptitle(
        f"{dataset['folder']}, {int(last.get('episodes', 0))} training episodes, "
        f"{training['batch_scenes']} scenes an update, {where.get('device', '')}, commit {where.get('commit', '')}, "
        f"{str(where.get('date', ''))[:10]}",
        fontsize=10,
    )
    return as_png(figure)


def _plot(
    axes: Any, records: list[dict[str, float]], key: str, label: str, color: str | None, marker: str = ""
) -> None:
    points = [(record["update"], record[key]) for record in records if key in record]
    if points:
        axes.plot(*zip(*points, strict=True), label=label, color=color, marker=marker, markersize=3, linewidth=1)


if __name__ == "__main__":
    run_command(main, "curves")
