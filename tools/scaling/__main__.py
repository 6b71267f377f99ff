"""python -m tools.scaling [--json FILE]: weak scaling of training on this machine's devices.

Prints no time of what fails its check. The JSON holds {"meta": provenance, "rows"}.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import torch
import torch.multiprocessing

from hgn.command import run_command
from hgn.schema import ConfigError, from_mapping, to_mapping
from hgn.system.files import write_json
from hgn.system.provenance import provenance, without_folders
from tools.bench.contenders import PASS
from tools.scaling.config import ScalingConfig
from tools.scaling.measure import measure

EXIT_RED = 1


def main(mapping: dict[str, Any]) -> int:
    """Prints tables, and writes JSON where asked to; the exit code is 1 where a check is red."""
    config = from_mapping(ScalingConfig, mapping)
    device_type, count = devices(config)
    with tempfile.TemporaryDirectory() as folder:
        torch.multiprocessing.spawn(measure, (count, config, device_type, Path(folder)), nprocs=count)
        rows = with_efficiency(json.loads((Path(folder) / "rows.json").read_text()))
    print(table(rows))
    if config.json is not None:
        write_json(
            config.json,
            {"meta": provenance(device_type) | {"config": without_folders(to_mapping(config))}, "rows": rows},
        )
    return 0 if all(row["check"] == PASS for row in rows) else EXIT_RED


def devices(config: ScalingConfig) -> tuple[str, int]:
    """(kind of device, how many processes). Raises: ConfigError when there are not as many GPUs."""
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if config.device == "cpu" or (config.device == "auto" and gpus == 0):
        return "cpu", config.devices or 2
    wanted = config.devices or max(gpus, 1)
    if wanted > gpus:
        raise ConfigError(f"devices must be at most the {gpus} GPUs of this machine, got {wanted}; take device=cpu")
    return "cuda", wanted


def with_efficiency(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Adds each row's scenes per second and device, against one device alone with the same kind of scenes."""
    alone = {(row["backend"], row["particle_spread"]): row["ms"] for row in rows if row["devices"] == 1}
    for row in rows:
        base = alone.get((row["backend"], row["particle_spread"]))
        row["efficiency"] = base / row["ms"] if base and row["ms"] else None
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """The figures for people, as Markdown."""
    lines = [
        "| backend | precision | devices | scenes | spread | messages | update, ms | quartiles | efficiency | check |",
        "| :-- | :-- | --: | --: | --: | :-- | --: | --: | --: | :-- |",
    ]
    for row in rows:
        sent = f"{len(row['messages'])}, up to {max(row['messages']) / 1e6:.1f} MB" if row["averaged"] else "none"
        low, high = row.get("ms_quartiles", (0, 0))
        times = ("-", "-") if row["ms"] is None else (f"{row['ms']:.2f}", f"{low:.2f} … {high:.2f}")
        efficiency = "-" if row["efficiency"] is None else f"{row['efficiency']:.3f}"
        work = (row[key] for key in ("backend", "precision", "devices", "scenes", "particle_spread"))
        lines.append(f"| {' | '.join(map(str, (*work, sent, *times, efficiency, row['check'])))} |")
    return "\n".join(lines)


if __name__ == "__main__":
    run_command(main, "scaling")
