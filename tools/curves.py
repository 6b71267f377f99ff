"""python -m tools.curves runs=[runs/obstacles]: learning curves of runs as PNG and JSON.

One run: loss, one-step errors with the baselines, and rollout errors, over updates. Several runs: loss and one-step
validation error over the number of scenes seen so far, and this error also over minutes of training.

The JSON contains {"meta": provenance of the figure, "runs": [{"name", "meta": provenance and settings of the run,
"rows"}, ...]}, with a row for each record. Minutes do not include the time between a stop and the next start.
"""

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hgn.command import run_command
from hgn.scene.hdf5 import damage_named
from hgn.schema import from_mapping, printable, require, require_replaceable
from hgn.system.files import write_atomically, write_json
from hgn.system.yaml_files import read_yaml

# prefixes of the figures in the JSON
BEGINNINGS = (
    *("update", "minutes", "loss", "learning_rate", "updates_per_second", "scenes_per_second", "gpu_memory_gb"),
    *("scenes", "one_step", "baseline", "rollout", "monitor"),
)
BASELINE_STYLES = {"constant_velocity": ":", "ballistic_motion": "--", "mean_acceleration": "-."}
LOSS = "MSE of normalised acceleration"
ONE_STEP = "one-step MSE (sum over axes, frame units)"
LOSS_POINTS = 60  # largest number of points of a loss curve, each a mean of neighbouring records
LINES = 200  # largest number of records of the loss in the JSON
BREAKS = 10  # a gap between two records that is longer than this many usual gaps is a stop of the training


@dataclass(frozen=True)
class CurvesConfig:
    """The options of `python -m tools.curves`."""

    runs: tuple[str, ...]  # folders of python -m hgn.train, for example [runs/obstacles,runs/gns]
    # name of the files without ending, OUT.png and OUT.json; null: curves, in the folder of the first run
    out: str | None = None

    def __post_init__(self) -> None:
        require(len(self.runs) > 0, "runs", "at least one folder of python -m hgn.train", self.runs)
        names = {Path(run).name for run in self.runs}
        require(len(names) == len(self.runs), "runs", "folders of different names", self.runs)


@dataclass(frozen=True)
class Run:
    """The records of a run of hgn.train."""

    name: str
    settings: Mapping[str, Any]
    records: list[dict[str, float]]  # the last record of each update in metrics.jsonl, plus `minutes` and `scenes`


def main(mapping: dict[str, Any]) -> int:
    """Writes the PNG and the JSON; returns the exit code."""
    from hgn.system.provenance import provenance

    config = from_mapping(CurvesConfig, mapping)
    out = Path(config.out or f"{config.runs[0]}/curves")
    picture, report = (out.with_suffix(ending) for ending in (".png", ".json"))
    require_replaceable("out", picture, report)
    runs = [read_run(Path(folder)) for folder in config.runs]
    metas = [dict(run.settings.get("provenance", {})) | {"config": run.settings} for run in runs]
    of_runs = zip(runs, metas, strict=True)
    parts = [{"name": run.name, "meta": meta, "rows": measurements(run.records)} for run, meta in of_runs]
    write_json(report, {"meta": provenance(), "runs": parts})
    write_atomically(picture, draw(runs))
    print(picture, report, sep="\n")
    return 0


def read_run(folder: Path) -> Run:
    """Reads metrics.jsonl and the resolved configuration. Raises: ConfigError if the folder is no run of hgn.train."""
    with damage_named(f"{folder}: runs must be folders of python -m hgn.train", "use another folder"):
        for file in (folder / "metrics.jsonl", folder / "config.yaml"):
            if not file.is_file():  # opening a pipe would wait for ever
                raise OSError(f"no plain file {file}")
        lines = (folder / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
        settings = read_yaml(folder / "config.yaml")
        json.dumps(settings), settings["dataset"]["folder"], dict(settings.get("provenance", {}))  # read below
        records = [dict(json.loads(line)) for line in lines]
        for name, value in (item for record in records for item in record.items()):
            drawn = isinstance(value, int | float) and not 1e100 < abs(value) < math.inf
            require(drawn, f"{folder}: {name}", "a number of at most 1e100", value)
        _add_minutes(records)
        _add_scenes(records, settings["training"]["batch_scenes"])
        # a resumed run repeats some updates: the later record counts
        latest = {(record["update"], "loss" in record): record for record in records}
    return Run(folder.name, settings, [latest[key] for key in sorted(latest)])


def _add_minutes(records: list[dict[str, float]]) -> None:
    """Adds the minutes since the first record; a stop counts as one usual gap."""
    gaps = [after["time"] - before["time"] for before, after in itertools.pairwise(records)]
    usual = sorted(gaps)[len(gaps) // 2] if gaps else 0.0
    seconds = 0.0
    for record, gap in zip(records, [0.0, *gaps], strict=False):
        monitored = record.get("monitor/seconds", 0.0)
        seconds += gap if 0 <= gap <= BREAKS * usual + monitored else usual
        record["minutes"] = seconds / 60


def _add_scenes(records: list[dict[str, float]], of_a_device: int) -> None:
    """Adds the number of scenes so far. The ratio of the rates is the number of scenes of an update on all devices."""
    rated = [record for record in records if record.get("updates_per_second")]
    an_update = round(rated[0]["scenes_per_second"] / rated[0]["updates_per_second"]) if rated else of_a_device
    for record in records:
        record["scenes"] = record["update"] * an_update


def measurements(records: list[dict[str, float]]) -> list[dict[str, float]]:
    """Returns all records with errors, and at most LINES records of the loss."""
    losses = [i for i, record in enumerate(records) if "loss" in record]
    kept = set(losses[:: max(1, -(-len(losses) // LINES))])
    return [
        {name: value for name, value in record.items() if name.startswith(BEGINNINGS)}
        for i, record in enumerate(records)
        if i in kept or "loss" not in record
    ]


def draw(runs: Sequence[Run]) -> bytes:
    """Draws the curves of one run or of several; returns PNG bytes."""
    from tools.report import as_png, new_figure, shared_legend

    figure, (panels,) = new_figure(1, 3, (15, 5))
    last = {name: value for record in runs[0].records for name, value in record.items()}
    origins = [run.settings.get("provenance", {}) for run in runs]
    title = "; ".join(
        sorted({f"{o.get('device', '')}, commit {o.get('commit', '')}, {str(o.get('date', ''))[:10]}" for o in origins})
    )
    if len(runs) == 1:
        _draw_one(panels, runs[0], last)
        training, dataset = runs[0].settings["training"], runs[0].settings["dataset"]
        scenes, count = training["batch_scenes"], last.get("episodes")
        episodes = "" if count is None else f"{count:.0f} training episode{'s' * (count != 1)}, "
        title = f"{dataset['folder']}, {episodes}{scenes} scene{'s' * (scenes > 1)} an update, {title}"
    else:
        _draw_several(panels, runs, last)
    panels[0].set_ylabel(LOSS)
    for panel in panels:
        panel.grid(alpha=0.3, which="both")
        if panel.lines:
            panel.set_yscale("log")
    shared_legend(figure, fontsize=8, loc="outside lower center", ncols=5)
    figure.suptitle(_plain(title), fontsize=10)
    return as_png(figure)


def _draw_one(panels: Any, run: Run, last: Mapping[str, float]) -> None:
    left, middle, right = panels
    _plot(left, run.records, "loss", "training loss (noisy input)", "0.4")
    for split, color in (("training", "tab:blue"), ("validation", "tab:orange")):
        _plot(middle, run.records, f"one_step/{split}", f"network, {split}", color, marker="o")
    for frame, color in ((10, "tab:green"), (50, "tab:red"), (150, "tab:purple"), (299, "tab:brown")):
        _plot(right, run.records, f"rollout/mse_frame_{frame}", f"rollout, frame {frame}", color, marker="o")
    _plot_baselines(middle, last)
    middle.set_ylabel(ONE_STEP)
    right.set_ylabel("rollout position MSE (domain units²)")
    for panel in panels:
        panel.set_xlabel("updates")


def _draw_several(panels: Any, runs: Sequence[Run], last: Mapping[str, float]) -> None:
    for i, run in enumerate(runs):
        losses = [record for record in run.records if "loss" in record]
        _plot(panels[0], _means(losses, "loss"), "loss", _plain(run.name), f"C{i}", against="scenes")
        for panel, against in zip(panels[1:], ("scenes", "minutes"), strict=True):
            _plot(panel, run.records, "one_step/validation", "", f"C{i}", marker="o", against=against)
    for panel, label in zip(panels, ("scenes trained on", "scenes trained on", "minutes of training"), strict=True):
        panel.set_xlabel(label)
        first, last_one = panel.dataLim.intervalx
        # an axis of less than two decades has long labels in between
        panel.set_xscale("log" if last_one > 100 * first else "linear")
    for panel in panels[1:]:
        _plot_baselines(panel, last)
        panel.set_ylabel(ONE_STEP + ", validation")


def _plot_baselines(panel: Any, last: Mapping[str, float]) -> None:
    for name, style in BASELINE_STYLES.items():
        if f"baseline/validation_{name}" in last:
            label = f"{name.replace('_', ' ')}, validation"
            panel.axhline(last[f"baseline/validation_{name}"], color="0.3", linestyle=style, label=label)


def _means(records: list[dict[str, float]], key: str) -> list[dict[str, float]]:
    """Averages neighbouring records."""
    step = max(1, len(records) // LOSS_POINTS)
    parts = [records[i : i + step] for i in range(0, len(records), step)]
    return [{"scenes": part[-1]["scenes"], key: sum(r[key] for r in part) / len(part)} for part in parts]


def _plain(text: str) -> str:
    """Returns a text that matplotlib draws as it is. Text between two `$` would be a formula."""
    return printable(text).replace("$", r"\$")


def _plot(
    panel: Any, records: list[dict[str, float]], key: str, label: str, color: str, marker: str = "",
    against: str = "update",
) -> None:  # fmt: skip
    points = [(record[against], record[key]) for record in records if key in record]
    if points:
        panel.plot(*zip(*points, strict=True), label=label, color=color, marker=marker, markersize=3, linewidth=1)


if __name__ == "__main__":
    run_command(main, "curves")
