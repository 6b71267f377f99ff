"""python -m tools.scaling [--json FILE]: weak scaling of training on this machine's devices, and a model of clusters.

With update_ms=... it measures nothing: the model of an update that takes so long. Prints no time of what fails its
check. The JSON holds {"meta": provenance, "backward_seconds", "rows"}; a row's case is weak_scaling, all_reduce or
model.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import torch.multiprocessing

from hgn.command import run_command
from hgn.network.build import build_network
from hgn.schema import ConfigError, from_mapping, to_mapping
from hgn.system.files import write_json
from hgn.system.provenance import provenance, without_folders
from hgn.training.distributed import MESSAGE_MB
from tools.bench.contenders import PASS
from tools.scaling.config import ScalingConfig
from tools.scaling.measure import measure
from tools.scaling.model import Cluster, Link, Step, Update, all_reduce_seconds, fit, update

EXIT_RED = 1
SIZES = tuple(2**power for power in range(11))  # 1 to 1,024 GPUs
# The GPUs of a node where none are measured: 18 NVLinks of an H100 or H200 carry 450 GB/s each way.
NODE_LAUNCH_S, NODE_LINK = 15e-6, Link(latency_s=3e-6, bytes_per_second=300e9)
# What networks give one GPU in practice: 400 Gb/s for each of them, and 100 Gb/s for a node of eight.
NETWORKS = {
    "400 Gb/s a GPU": Link(latency_s=10e-6, bytes_per_second=40e9),
    "100 Gb/s a node": Link(latency_s=30e-6, bytes_per_second=10e9 / 8),
}


def main(mapping: dict[str, Any]) -> int:
    """Prints tables, and writes JSON where asked to; the exit code is 1 where a check is red."""
    config = from_mapping(ScalingConfig, mapping)
    if config.update_ms is not None:
        rows = given_rows(config)
        print(model_table(rows))
        _write(config, "cpu", {"rows": rows})
        return 0
    device_type, count = devices(config)
    with tempfile.TemporaryDirectory() as folder:
        torch.multiprocessing.spawn(measure, (count, config, device_type, Path(folder)), nprocs=count)
        report = json.loads((Path(folder) / "rows.json").read_text())
    rows = with_efficiency([{"case": "weak_scaling"} | row for row in report["updates"]])
    rows += predicted([{"case": "all_reduce"} | row for row in report["all_reduces"]], config.node_devices)
    rows += model_rows(rows, report["backward_seconds"], config)
    print(table(rows))
    _write(config, device_type, {"backward_seconds": report["backward_seconds"], "rows": rows})
    return 0 if all(row.get("check", PASS) == PASS for row in rows) else EXIT_RED


def _write(config: ScalingConfig, device_type: str, report: dict[str, Any]) -> None:
    if config.json is not None:
        meta = provenance(device_type) | {"config": without_folders(to_mapping(config))}
        write_json(config.json, {"meta": meta} | report)


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


def predicted(rows: list[dict[str, Any]], node_devices: int) -> list[dict[str, Any]]:
    """Adds what the model says of each all-reduce, once it is fitted to some of them."""
    if not rows:
        return rows
    cluster = fitted(rows, node_devices)
    for row in rows:
        row["model_ms"] = 1e3 * all_reduce_seconds(row["bytes"], row["devices"], cluster)
    return rows


def fitted(rows: Sequence[dict[str, Any]], node_devices: int) -> Cluster:
    """A node like this machine, with at least as many devices."""
    measured = [(row["devices"], row["bytes"], row["ms"] / 1e3) for row in rows if row["case"] == "all_reduce"]
    launch_s, inside = fit(measured)
    most = max(devices for devices, _, _ in measured)
    return Cluster(max(node_devices, most), launch_s, inside, inside)


def model_rows(
    rows: list[dict[str, Any]], backward_seconds: dict[str, float], config: ScalingConfig
) -> list[dict[str, Any]]:
    """One row for each backend, network and number of GPUs; none without several devices to take the figures from."""
    predicted_rows = []
    for backend in config.backends:
        trained = [row for row in rows if row["case"] == "weak_scaling" and row["backend"] == backend and row["ms"]]
        alone = next((row for row in trained if row["devices"] == 1 and row["particle_spread"] == 0), None)
        sent = next((row["messages"] for row in trained if row["messages"]), None)
        if alone is not None and sent is not None:
            step = Step(alone["ms"] / 1e3, backward_seconds[backend], tuple(sent), _spread(config))
            predicted_rows += _rows_of(step, backend, fitted(rows, config.node_devices), config)
    return predicted_rows


def given_rows(config: ScalingConfig) -> list[dict[str, Any]]:
    """The same for an update of `update_ms` and `backward_ms`, on a node that is assumed."""
    assert config.update_ms is not None
    gradient_bytes = 4 * sum(parameter.numel() for parameter in build_network(config.network).parameters())
    limit = MESSAGE_MB * 2**20 if config.backward_ms else gradient_bytes
    whole, rest = divmod(gradient_bytes, limit)
    messages = (limit,) * whole + ((rest,) if rest else ())
    step = Step(config.update_ms / 1e3, config.backward_ms / 1e3, messages, _spread(config))
    cluster = Cluster(config.node_devices, NODE_LAUNCH_S, NODE_LINK, NODE_LINK)
    return _rows_of(step, "given", cluster, config)


def _spread(config: ScalingConfig) -> float:
    # Scenes of a batch are drawn apart from each other; seconds are taken to grow with particles.
    return config.particle_spread / config.scenes**0.5


def _rows_of(step: Step, backend: str, node: Cluster, config: ScalingConfig) -> list[dict[str, Any]]:
    rows = []
    for name, link in NETWORKS.items():
        cluster = replace(node, between=link)
        rows += [_model_row(backend, name, update(step, gpus, cluster), cluster, config) for gpus in SIZES]
    return rows


def _model_row(backend: str, network: str, seen: Update, cluster: Cluster, config: ScalingConfig) -> dict[str, Any]:
    scene_bytes = config.particles * (config.network.velocity_history + 2) * 12  # a window of float32 positions
    read_bytes = config.scenes * min(seen.gpus, cluster.node_gpus) * scene_bytes
    return {
        "case": "model",
        "backend": backend,
        "network": network,
        "devices": seen.gpus,
        "nodes": seen.nodes,
        "all_reduce_ms": 1e3 * seen.all_reduce_s,
        "not_hidden_ms": 1e3 * seen.not_hidden_s,
        "slowest_ms": 1e3 * seen.slowest_s,
        "ms": 1e3 * seen.seconds,
        "efficiency": seen.efficiency,
        "scenes_per_second": seen.gpus * config.scenes / seen.seconds,
        "read_mb_per_second_and_node": read_bytes / seen.seconds / 1e6,
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The figures for people, as Markdown."""
    lines = [
        "| backend | precision | devices | scenes | spread | messages | update, ms | quartiles | efficiency | check |",
        "| :-- | :-- | --: | --: | --: | :-- | --: | --: | --: | :-- |",
    ]
    for row in rows:
        if row["case"] == "weak_scaling":
            sent = f"{len(row['messages'])}, up to {max(row['messages']) / 1e6:.1f} MB" if row["averaged"] else "none"
            times = ("-", "-") if row["ms"] is None else (f"{row['ms']:.2f}", _range(row["ms_quartiles"]))
            efficiency = "-" if row["efficiency"] is None else f"{row['efficiency']:.3f}"
            work = (row[key] for key in ("backend", "precision", "devices", "scenes", "particle_spread"))
            lines.append(_line((*work, sent, *times, efficiency, row["check"])))
    if any(row["case"] == "all_reduce" for row in rows):
        lines += ["", "| devices | bytes | all-reduce, ms | quartiles | model, ms |", "| --: | --: | --: | --: | --: |"]
    for row in rows:
        if row["case"] == "all_reduce":
            times = (f"{row['ms']:.4f}", _range(row["ms_quartiles"], 4))
            lines.append(_line((row["devices"], f"{row['bytes']:,}", *times, f"{row['model_ms']:.4f}")))
    return "\n".join([*lines, "", model_table(rows)])


def model_table(rows: list[dict[str, Any]]) -> str:
    """What the model says of clusters, as Markdown."""
    lines = [
        "| GPUs | nodes | all-reduce, ms | not hidden, ms | slowest rank, ms | update, ms | efficiency | scenes/s "
        "| read by a node, MB/s |",
        "| --: | --: | --: | --: | --: | --: | --: | --: | --: |",
    ]
    for row in rows:
        if row["case"] == "model":
            if row["devices"] == 1:
                lines.append(_line((f"*{row['backend']}, {row['network']}*", *[""] * 8)))
            parts = [f"{row[key]:.2f}" for key in ("all_reduce_ms", "not_hidden_ms", "slowest_ms", "ms", "efficiency")]
            reading = f"{row['read_mb_per_second_and_node']:,.0f}"
            lines.append(_line((row["devices"], row["nodes"], *parts, f"{row['scenes_per_second']:,.0f}", reading)))
    return "\n".join(lines)


def _line(cells: Sequence[object]) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def _range(pair: Sequence[float], digits: int = 2) -> str:
    return f"{pair[0]:.{digits}f} … {pair[1]:.{digits}f}"


if __name__ == "__main__":
    run_command(main, "scaling")
