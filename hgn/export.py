"""python -m hgn.export: writes a checkpoint's network as weights, or a network's step as ONNX or compiled package."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hgn.command import run_command
from hgn.config import StoredPrecision
from hgn.scene.barrier import barrier_pieces
from hgn.scene.moving import at_rest
from hgn.scene.scene import all_corners
from hgn.scene.scene_file import find_scene, load_scene
from hgn.schema import FileName, FolderName, NonNegative, Positive, from_mapping, require, require_bounds
from hgn.step_config import StepConfig, WallClearance
from hgn.system.extras import require_installed
from hgn.system.files import require_place
from hgn.system.loading import loading

if TYPE_CHECKING:
    from hgn.network.base import ParticleNetwork


@dataclass(frozen=True)
class ExportConfig:
    """`python -m hgn.export`."""

    checkpoint: str | None = None  # checkpoint file of the network that is exported
    weights: str | None = None  # file or name of shipped weights; only without checkpoint
    out: FileName | None = None  # the weights file to write
    stored_precision: StoredPrecision = "fp32"  # precision of the learned tensors; fp16 makes files half as large
    rest_threshold: NonNegative[float] | None = None  # step.rest_threshold of `out`; null: unchanged
    wall_clearance: WallClearance | None = None  # step.wall_clearance of `out`; null: unchanged
    obstacle_clearance: Positive[float] | None = None  # step.obstacle_clearance of `out`; null: unchanged
    # file for the graph of a step of `out`, or else of `weights`, for ONNX Runtime
    onnx: FileName | None = None
    package: FileName | None = None  # file for a step compiled for `device`, for PyTorch's C++ (.pt2)
    device: str = "cpu"  # device of the package: cpu, cuda or cuda:1
    arrays: FolderName | None = None  # folder for the first inputs of a step of `scene`, as .npy files
    scene: str | None = None  # a scene file, or the name of an example

    def __post_init__(self) -> None:
        require_bounds(self)
        given = self.checkpoint is not None or self.weights is not None
        require(given, "checkpoint", "given, or weights instead", self.checkpoint)
        require(self.checkpoint is None or self.weights is None, "weights", "null with checkpoint", self.weights)
        require(self.checkpoint is None or self.out is not None, "out", "given with checkpoint", self.out)
        named, others = (self.out or ".safetensors").endswith(".safetensors"), "onnx=, package= write other formats"
        require(named, "out", "a .safetensors name", self.out, others)
        require((self.arrays is None) == (self.scene is None), "scene", "given with arrays, and only then", self.scene)
        for name, value in self.step_changes.items():
            require(self.out is not None, name, "null without out, the file that it changes", value)
        some = any(name is not None for name in (self.out, self.onnx, self.package, self.arrays))
        require(some, "out", "given with weights, or onnx, package or arrays", self.out)
        if self.package is not None:
            require(self.package.endswith(".pt2"), "package", "a name that ends in .pt2", self.package)

    @property
    def step_changes(self) -> dict[str, Any]:
        """Returns the changed constraints of a frame in `out`, by the names of StepConfig."""
        chosen = {field.name: getattr(self, field.name) for field in fields(StepConfig)}
        return {name: value for name, value in chosen.items() if value is not None}


def main(mapping: dict[str, Any]) -> int:
    """Writes the files that the settings name. Returns the exit code."""
    with loading():
        from hgn.runtime.exported_step import initial_arrays, traced_step, write_onnx, write_package
        from hgn.runtime.simulator import InitialState, Simulator
        from hgn.runtime.weights import find_weights, load_weights
        from hgn.system.device import choose_device

    config = from_mapping(ExportConfig, mapping)
    if config.onnx is not None:
        require_installed("onnxscript")
    for file in (config.out, config.onnx, config.package):
        if file is not None:
            require_place(Path(file))
    if config.out is not None:
        if config.checkpoint is not None:
            export(Path(config.checkpoint), Path(config.out), config.stored_precision, **config.step_changes)
        else:
            assert config.weights is not None
            change(find_weights(config.weights), Path(config.out), config.stored_precision, **config.step_changes)
        print(config.out)
    if config.onnx is None and config.package is None and config.arrays is None:
        return 0
    device = choose_device(config.device)
    weights = config.out or config.weights
    assert weights is not None
    network, info = load_weights(find_weights(weights), device)
    moving = 0
    arrays: dict[str, np.ndarray] = {}
    if config.arrays is not None:
        assert config.scene is not None
        simulator = Simulator(network, info.frame_rate_hz, "torch", info=info)
        scene = load_scene(find_scene(config.scene))
        start = InitialState.of_scene(scene)
        rule = "without emitters with arrays, because exported frames have no new particles"
        require(start.emitting is None, "scene", rule, config.scene)
        moving = len(start.moving)
        corner_F33 = barrier_pieces(all_corners(at_rest(scene.obstacles)), scene.cell_size, scene.domain_size)
        arrays = initial_arrays(network.config, simulator.start([start]), corner_F33, start.parameters)
        others = {file.stem for file in Path(config.arrays).glob("*.npy")}
        rule = "a new folder, or one with the inputs of the same network"
        require(others in (set(), set(arrays)), "arrays", rule, config.arrays)
    if config.onnx is not None or config.package is not None:
        program = traced_step(network, info, moving)
    if config.package is not None:  # before the ONNX export, whose symbols in the graph the compiler refuses
        write_package(Path(config.package), program, info)
        print(config.package)
    if config.onnx is not None:
        write_onnx(Path(config.onnx), program, info)
        print(config.onnx)
    if config.arrays is not None:
        Path(config.arrays).mkdir(parents=True, exist_ok=True)
        for name, array in arrays.items():
            np.save(f"{config.arrays}/{name}.npy", array)
        print(config.arrays)
    return 0


def export(checkpoint_path: Path, out: Path, stored_precision: str = "fp32", **step_changes: Any) -> None:
    """Writes a checkpoint's network as weights. `step_changes`, fields of StepConfig, replace the network's own.

    Raises ConfigError if the checkpoint is missing or of another program, or if its network does not allow the changes.
    """
    from hgn.runtime.weights import WeightsInfo, save_weights
    from hgn.system.provenance import provenance

    # Lightning is imported here, because the other exports do not need it.
    from hgn.training.checkpoint import Progress, data_of_checkpoint, network_of_checkpoint, read_checkpoint

    checkpoint = read_checkpoint(checkpoint_path)
    network = network_of_checkpoint(checkpoint, checkpoint_path)
    change_step(network, step_changes)
    data = dict(vars(data_of_checkpoint(checkpoint)))
    origin = provenance() | {"checkpoint": checkpoint_path.name, "data_config_hash": data.pop("config_hash")}
    info = WeightsInfo(network.config, **data, updates=Progress.of(checkpoint).updates, provenance=origin)
    save_weights(out, network, info, stored_precision)


def change(file: Path, out: Path, stored_precision: str = "fp32", **step_changes: Any) -> None:
    """Writes weights to weights, with `step_changes` as in `export`. The provenance of `out` contains that of `file`.

    Raises ConfigError if the file is missing or of another program, or if its network refuses the changes.
    """
    from hgn.runtime.weights import load_weights, save_weights
    from hgn.system.provenance import provenance

    network, info = load_weights(file)
    changed = {"file": file.name, "step": step_changes, "provenance": info.provenance}
    change_step(network, step_changes)
    save_weights(out, network, replace(info, provenance=provenance() | {"changed": changed}), stored_precision)


def change_step(network: ParticleNetwork, changes: dict[str, Any]) -> None:
    """Changes the constraints of a network's frames. Raises ConfigError if the network cannot have them."""
    step = replace(network.step, **changes)
    step.require_fits(network.config.relative, network.config.dimensions)
    network.step = step


if __name__ == "__main__":
    run_command(main, "export")
