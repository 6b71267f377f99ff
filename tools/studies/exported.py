"""python -m tools.studies.exported: steps that hgn.export wrote against the backend torch, and their times beside ours.

From one particle on, with and without obstacles. Where one is not the backend's to 1e-6 the exit code is 1.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import onnxruntime
import torch

from hgn.command import run_command
from hgn.runtime.backend import build
from hgn.runtime.exported_step import INPUTS, initial_arrays
from hgn.runtime.simulator import Simulator
from hgn.runtime.stepped_rollout import stepped
from hgn.scene.shapes import shape_obstacle
from hgn.schema import Positive, from_mapping, require_bounds
from hgn.system.files import write_json
from hgn.system.provenance import provenance
from tools.bench.contenders import PASS
from tools.bench.states import Workload, scene_of
from tools.bench.timing import Timed, alternate, once

TOLERANCE = 1e-6  # domain units, of positions and displacements in a frame
SIZES = (1, 216, 4_096, 30_000)
EXIT_RED = 1


@dataclass(frozen=True)
class ExportedConfig:
    """`python -m tools.studies.exported`: whose steps, compiled for the CPU."""

    onnx: str
    package: str
    weights: str = "obstacles"
    rounds: Positive[int] = 5
    json: str | None = None

    def __post_init__(self) -> None:
        require_bounds(self)


def main(mapping: dict[str, Any]) -> int:
    """Prints and stores a row for each size; the exit code says whether all agree."""
    config = from_mapping(ExportedConfig, mapping)
    simulator = Simulator.load(config.weights, "cpu", "torch", "fp32")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = onnxruntime.InferenceSession(config.onnx, options)
    package = torch._inductor.aoti_load_package(config.package)
    rows = []
    for particles in SIZES:
        for obstacles in (False, True):
            rows.append(measured(simulator, session, package, particles, obstacles, config.rounds))
            print(json.dumps(rows[-1]), flush=True)
    if config.json is not None:
        meta = provenance("cpu") | {"weights": config.weights, "threads": torch.get_num_threads()}
        write_json(config.json, {"meta": meta, "rows": rows})
    return 0 if all(row["check"] == PASS for row in rows) else EXIT_RED


def measured(
    simulator: Simulator, session: Any, package: Any, particles: int, obstacles: bool, rounds: int
) -> dict[str, Any]:
    """Errors, and the median milliseconds of each."""
    network = simulator.network
    scene = scene_of(Workload(particles, 1), 0, network.config.cell_size)
    if obstacles:
        size = scene.domain_size[0]
        scene = replace(scene, obstacles=(shape_obstacle("half_box", 0.6 * size, (size / 2, 0.2 * size, size / 2)),))
    state = simulator.start([scene])
    arrays = initial_arrays(state)
    tensors = [torch.from_numpy(arrays[name]) for name in INPUTS]
    after = stepped(simulator.backend.predict, state)
    steps: dict[str, Callable[[], Any]] = {
        "onnx": lambda: session.run(None, arrays),
        "package": lambda: package(*tensors),
        "torch": lambda: stepped(simulator.backend.predict, state),
        "cpu": lambda: stepped(build("cpu", network, "fp32").predict, state),
    }
    row: dict[str, Any] = {"particles": particles, "obstacle_cells": len(arrays["obstacle_cell"])}
    for name in ("onnx", "package"):
        found = zip(map(np.asarray, steps[name]()), (after.position_N3, after.velocity_NM3), strict=True)
        row[f"error_{name}"] = max(float(np.abs(value - expected.numpy()).max()) for value, expected in found)
    row["check"] = PASS if max(row["error_onnx"], row["error_package"]) <= TOLERANCE else "fail"
    contenders = [Timed(lambda step=step: [once(step, simulator.device)]) for step in steps.values()]  # type: ignore[misc]
    alternate(contenders, rounds, seconds=60.0)
    for name, timed in zip(steps, contenders, strict=True):
        row[f"ms_{name}"] = timed.quartiles()[1]
    return row


if __name__ == "__main__":
    run_command(main, "exported")
