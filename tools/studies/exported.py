"""python -m tools.studies.exported: steps that hgn.export wrote against the backend torch, and their times beside ours.

A frame from one particle on, with and without obstacles; and a scene that the examples in C++ simulate. A frame that
is not the backend's to 1e-6 ends in exit code 1. Frames after the first are told beside those of a scene displaced by
1e-6, for they are chaotic.
"""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch

from hgn.command import run_command
from hgn.export import main as export
from hgn.export import write_arrays
from hgn.runtime.backend import build
from hgn.runtime.exported_step import INPUTS, initial_arrays
from hgn.runtime.simulator import Simulator
from hgn.runtime.stepped_rollout import stepped
from hgn.scene.scene_file import find_scene, load_scene
from hgn.scene.shapes import shape_obstacle
from hgn.schema import Positive, from_mapping, require_bounds
from hgn.system.files import write_json
from hgn.system.provenance import provenance
from tools.bench.contenders import PASS
from tools.bench.states import Workload, scene_of
from tools.bench.timing import Timed, alternate

TOLERANCE = 1e-6  # domain units, of positions and displacements in a frame
SIZES = (1, 216, 4_096, 30_000)
PROGRAMS = {"step_onnx": "onnx", "step_package": "pt2"}
AFTER = (1, 10, 50, 299)  # frames
EXIT_RED = 1


@dataclass(frozen=True)
class ExportedConfig:
    """`python -m tools.studies.exported`: whose steps, where they are written, where the examples are."""

    folder: str  # of steps, by the weights' names; those that are missing are written
    weights: tuple[str, ...] = ("obstacles", "mechanics", "obstacles_small")
    examples: str | None = None  # the folder that CMake built tools/deploy in; none: without them
    scene: str = "play"  # what the examples simulate
    frames: Positive[int] = 300
    rounds: Positive[int] = 5
    json: str | None = None

    def __post_init__(self) -> None:
        require_bounds(self)


def main(mapping: dict[str, Any]) -> int:
    """Prints and stores a row for each frame and simulation; the exit code says whether all agree."""
    config = from_mapping(ExportedConfig, mapping)
    rows: dict[str, list[dict[str, Any]]] = {"steps": [], "examples": []}

    def add(kind: str, row: dict[str, Any]) -> None:
        rows[kind].append(row)
        print(json.dumps(row), flush=True)

    for name in config.weights:
        paths = {ending: Path(config.folder) / f"{name}.{ending}" for ending in PROGRAMS.values()}
        for key, path in zip(("onnx", "package"), paths.values(), strict=True):
            if not path.exists():
                export({"weights": name, "device": "cpu", key: str(path)})
        simulator = Simulator.load(name, "cpu", "torch", "fp32")
        for particles in SIZES:
            for obstacles in (False, True):
                row = measured(simulator, paths, particles, obstacles, config)
                add("steps", {"weights": name} | row)
        if config.examples is not None:
            for row in simulated(simulator, paths, config):
                add("examples", {"weights": name} | row)
    if config.json is not None:
        write_json(config.json, {"meta": provenance("cpu"), **rows})
    return 0 if all(row["check"] == PASS for kind in rows.values() for row in kind) else EXIT_RED


def measured(
    simulator: Simulator, paths: dict[str, Path], particles: int, obstacles: bool, config: ExportedConfig
) -> dict[str, Any]:
    """Errors on all threads, and the least CPU time of a frame on one, in turns: other work beside it counts little."""
    network = simulator.network
    scene = scene_of(Workload(particles, 1), 0, network.config.cell_size)
    if obstacles:
        size = scene.domain_size[0]
        scene = replace(scene, obstacles=(shape_obstacle("half_box", 0.6 * size, (size / 2, 0.2 * size, size / 2)),))
    state = simulator.start([scene])
    arrays = initial_arrays(state)
    tensors = [torch.from_numpy(arrays[name]) for name in INPUTS]
    onnx, compiled = paths["onnx"], torch._inductor.aoti_load_package(str(paths["pt2"]))
    own = build("cpu", network, "fp32")
    after = stepped(simulator.backend.predict, state)
    expected = (after.position_N3.numpy(), after.velocity_NM3.numpy())
    found = {"onnx": onnxruntime.InferenceSession(onnx).run(None, arrays), "package": compiled(*tensors)}
    row: dict[str, Any] = {"particles": particles, "obstacle_cells": len(arrays["obstacle_cell"])}
    for name, outputs in found.items():
        row[f"error_{name}"] = max(
            float(np.abs(np.asarray(x) - y).max()) for x, y in zip(outputs, expected, strict=True)
        )
    if config.examples is not None:
        folder = Path(config.folder) / "case_arrays"
        write_arrays(folder, state)
        for program in PROGRAMS:
            found_TN3 = run_example(program, paths, folder, 2, config)
            row[f"error_{program}"] = float(np.abs(found_TN3[1] - expected[0]).max())
    row["check"] = checked(*(value for key, value in row.items() if key.startswith("error_")))

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(onnx, options)
    steps: dict[str, Callable[[], Any]] = {
        "onnx": lambda: session.run(None, arrays),
        "package": lambda: compiled(*tensors),
        "torch": lambda: stepped(simulator.backend.predict, state),
        "cpu": lambda: stepped(own.predict, state),
    }
    contenders = [
        Timed(lambda step=step: [cpu_milliseconds(step)], config.rounds)  # type: ignore[misc]
        for step in steps.values()
    ]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    alternate(contenders, config.rounds, seconds=60.0)
    torch.set_num_threads(threads)
    return row | {f"ms_{name}": min(timed.milliseconds) for name, timed in zip(steps, contenders, strict=True)}


def simulated(simulator: Simulator, paths: dict[str, Path], config: ExportedConfig) -> list[dict[str, Any]]:
    """What each example makes of the scene, against the backend torch: the largest error of the first frame, and how
    far particles are apart later (root mean square), where a start displaced by 1e-6 is the measure."""
    scene, arrays = load_scene(find_scene(config.scene)), Path(config.folder) / f"{config.scene}_arrays"
    write_arrays(arrays, simulator.start([scene]))
    offset_N3 = TOLERANCE * np.random.default_rng(0).choice([-1, 1], scene.position_N3.shape).astype(np.float32)
    (expected_TN3,) = simulator.rollout([scene], config.frames)
    (displaced_TN3,) = simulator.rollout([replace(scene, position_N3=scene.position_N3 + offset_N3)], config.frames)
    rows = [{"program": "backend torch, displaced", "check": PASS} | distances(displaced_TN3, expected_TN3)]
    for program in PROGRAMS:
        found_TN3 = run_example(program, paths, arrays, config.frames, config)
        error = float(np.abs(found_TN3[1] - expected_TN3[1]).max())
        row = {"program": program, "error": error, "check": checked(error)}
        rows.append(row | distances(found_TN3, expected_TN3))
    return [{"scene": config.scene, "particles": len(offset_N3)} | row for row in rows]


def run_example(program: str, paths: dict[str, Path], arrays: Path, frames: int, config: ExportedConfig) -> np.ndarray:
    """The positions [T, N, 3] that a program in C++ makes of what a step is first given."""
    assert config.examples is not None
    out = Path(config.folder) / f"{program}.npy"
    words = (Path(config.examples) / program, paths[PROGRAMS[program]], arrays, frames, out)
    subprocess.run([str(word) for word in words], check=True, stdout=subprocess.DEVNULL)
    return np.asarray(np.load(out))


def distances(found_TN3: np.ndarray, expected_TN3: np.ndarray) -> dict[str, Any]:
    """Root mean square over particles, domain units, by frame."""
    rms_T = np.sqrt(np.square(found_TN3 - expected_TN3).sum(-1).mean(-1))
    return {"rms": {str(frame): float(rms_T[frame]) for frame in AFTER if frame < len(rms_T)}}


def checked(*errors: float) -> str:
    """Whether all are within TOLERANCE; what is not finite is not."""
    return PASS if all(error <= TOLERANCE for error in errors) else "fail"


def cpu_milliseconds(run: Callable[[], object]) -> float:
    """CPU time of one run, of all of the process' threads."""
    started = time.process_time()
    run()
    return (time.process_time() - started) * 1e3


if __name__ == "__main__":
    run_command(main, "exported")
