"""Starts the timed processes of tools.scaling, and writes their rows."""

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
import torch.multiprocessing

from hgn.config import SceneConfig, TrainConfig, TrainingConfig
from hgn.schema import from_mapping, require
from hgn.step_config import StepConfig
from hgn.system.files import write_json
from tools import report
from tools.report import EXIT_RED, PASS
from tools.scaling.config import ScalingConfig
from tools.scaling.measure import measure


def main(mapping: dict[str, Any]) -> int:
    """Prints a table, and writes JSON if `json` is given; the exit code is 1 if a check fails."""
    config = from_mapping(ScalingConfig, mapping)
    device_type, count = devices(config)
    _compile_ahead(config, device_type, count)
    with tempfile.TemporaryDirectory() as folder:
        torch.multiprocessing.spawn(measure, (count, config, device_type, Path(folder)), nprocs=count)
        rows = with_efficiency(json.loads((Path(folder) / "rows.json").read_text()))
    print(table(rows))
    if config.json is not None:
        write_json(config.json, {"meta": report.meta_of(config, device_type), "rows": rows})
    return 0 if all(row["check"] == PASS for row in rows) else EXIT_RED


def devices(config: ScalingConfig) -> tuple[str, int]:
    """Returns the kind of device and the number of processes. Raises: ConfigError if there are fewer GPUs."""
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if config.device == "cpu" or (config.device == "auto" and gpus == 0):
        return "cpu", config.devices or 2
    wanted = config.devices or max(gpus, 1)
    require(wanted <= gpus, "devices", f"at most the {gpus} GPUs of this machine", wanted, "use device=cpu")
    return "cuda", wanted


def training_of(config: ScalingConfig) -> TrainConfig:
    """Returns a training with the kernels of the measured updates."""
    training = TrainingConfig(batch_scenes=config.scenes, precision=config.precision, noise_correlated_fraction=0.0)
    scene = SceneConfig(obstacle_count=0)  # for any network
    # Without the rest constraint relative inputs need symmetry, and the measured updates have none.
    step = StepConfig(rest_threshold=0.1 * config.network.relative)
    return TrainConfig(scene, network=config.network, training=training, step=step, imported=True)


def _compile_ahead(config: ScalingConfig, device_type: str, count: int) -> None:
    """Fills Triton's cache, because each process would compile for minutes."""
    if device_type == "cpu" or "triton" not in config.backends or torch.version.hip is not None:
        return
    # Triton, which backend torch does without, is loaded here.
    from hgn.training.precompile import Precompilation

    job = training_of(config)
    with Precompilation(job, torch.cuda.get_device_capability(), count > 1) as precompilation:
        print(precompilation.wait(), file=sys.stderr)


def with_efficiency(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Adds each row's particles per second and device, relative to a single device with the same kind of scenes."""
    rates = [row["particles_per_update"] / row["ms"] if row["ms"] else None for row in rows]
    kinds = [(row["backend"], row["particle_spread"]) for row in rows]
    alone = {kind: rate for row, kind, rate in zip(rows, kinds, rates, strict=True) if row["devices"] == 1}
    for row, kind, rate in zip(rows, kinds, rates, strict=True):
        base = alone.get(kind)
        row["efficiency"] = rate / base if base and rate else None
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """Returns a table of the rows."""
    work = ("backend", "precision", "devices", "scenes", "particle_spread")
    lines = []
    for row in rows:
        averaged = "yes" if row["averaged"] else "no"
        times = report.number(row["ms"], ".2f"), report.spread(row.get("ms_quartiles"), ".2f")
        lines.append(
            (*(row[key] for key in work), averaged, *times, report.number(row["efficiency"], ".3f"), row["check"])
        )
    head = ("backend", "precision", "devices", "scenes", "spread", "averaged", "update, ms", "quartiles", "efficiency")
    return report.table((*head, "check"), lines)
