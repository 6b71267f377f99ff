"""python -m hgn.export checkpoint=… out=…: a checkpoint's network as inference weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hgn.command import run_command
from hgn.config import ExportConfig
from hgn.runtime.weights import WeightsInfo, save_weights
from hgn.schema import from_mapping
from hgn.system.provenance import provenance
from hgn.training.checkpoint import data_of_checkpoint, network_of_checkpoint, read_checkpoint, updates_of_checkpoint


def main(mapping: dict[str, Any]) -> int:
    """Writes the weights file; returns the exit code."""
    config = from_mapping(ExportConfig, mapping)
    export(Path(config.checkpoint), Path(config.out), config.stored_precision)
    print(config.out)
    return 0


def export(checkpoint_path: Path, out: Path, stored_precision: str = "fp32") -> None:
    """Checkpoint to weights. Raises: ConfigError when the checkpoint is missing or not ours."""
    checkpoint = read_checkpoint(checkpoint_path)
    network = network_of_checkpoint(checkpoint)
    data = data_of_checkpoint(checkpoint)
    info = WeightsInfo(
        network=network.config,
        frame_rate_hz=data.frame_rate_hz,
        obstacle_cell_size=data.obstacle_cell_size,
        gravity=data.gravity,
        maximum_initial_speed=data.maximum_initial_speed,
        updates=updates_of_checkpoint(checkpoint),
        provenance=provenance() | {"checkpoint": checkpoint_path.name, "data_config_hash": data.config_hash},
    )
    save_weights(out, network, info, stored_precision)


if __name__ == "__main__":
    run_command(main, "export")
