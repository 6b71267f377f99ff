"""A step as ONNX and as a compiled package: what other programs run is what this one computes."""

from __future__ import annotations

import json
import os
import runpy
import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from network.states import network_of, random_state

from hgn import export
from hgn.config import config_directory
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.exported_step import INPUTS, initial_arrays
from hgn.runtime.simulator import Simulator
from hgn.runtime.stepped_rollout import stepped
from hgn.runtime.weights import WeightsInfo, save_weights
from hgn.scene.scene_file import load_scene
from hgn.schema import ConfigError

EXAMPLES = Path(__file__).resolve().parents[2] / "tools/deploy"
TOLERANCE = 1e-6  # of positions and displacements in a frame, domain units
FRAMES = 4
NETWORKS = {
    "absolute": {},
    "relative": {"inputs": "relative"},
    "angular": {"inputs": "relative", "momentum": "angular"},
}
SIZES = [(1, True), (1, False), (216, True), (216, False), (4_096, True)]


@pytest.fixture(autouse=True)
def whole_precision() -> Iterator[None]:
    """PyTorch multiplies in float32, whatever a backend has chosen for the process."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    yield
    torch.set_float32_matmul_precision(before)


@pytest.mark.parametrize(
    "name", ["absolute", *(pytest.param(name, marks=pytest.mark.slow) for name in list(NETWORKS)[1:])]
)
def test_onnx_is_the_step(tmp_path: Path, name: str) -> None:
    """ONNX Runtime computes the step to 1e-6 at any number of particles, with and without obstacles; the file says
    what its weights say of themselves; the example in Python simulates a scene's arrays."""
    path = tmp_path / "step.onnx"
    scene = {"scene": str(config_directory() / "example/own_mesh.yaml"), "arrays": str(tmp_path / "arrays")}
    network = exported(tmp_path, name, onnx=str(path), **scene)
    session = onnxruntime.InferenceSession(path)
    assert [item.name for item in session.get_inputs()] == list(INPUTS)
    declared = json.loads(session.get_modelmeta().custom_metadata_map["hgn"])
    assert declared["frame_rate_hz"] == 60.0 and declared["network"].items() >= NETWORKS[name].items()
    compare(network, lambda arrays: session.run(None, arrays))
    simulate = runpy.run_path(str(EXAMPLES / "step_onnx.py"))["simulate"]
    assert_rollout(network, scene["scene"], simulate(str(path), scene["arrays"], FRAMES))
    if shutil.which("cmake") is None or "ONNXRUNTIME_FOLDER" not in os.environ:
        pytest.skip("the C++ example needs cmake and a release of ONNX Runtime, ONNXRUNTIME_FOLDER")
    options = [f"-DONNXRUNTIME_FOLDER={os.environ['ONNXRUNTIME_FOLDER']}", "-DCMAKE_DISABLE_FIND_PACKAGE_Torch=ON"]
    assert_rollout(network, scene["scene"], built_and_run(tmp_path, "step_onnx", path, options))


@pytest.mark.slow
@pytest.mark.parametrize("name", NETWORKS)
def test_package_is_the_step(tmp_path: Path, name: str) -> None:
    """The same of a package that PyTorch compiled, and of the example in C++."""
    path = tmp_path / "step.pt2"
    scene = {"scene": str(config_directory() / "example/own_mesh.yaml"), "arrays": str(tmp_path / "arrays")}
    network = exported(tmp_path, name, package=str(path), **scene)
    package = torch._inductor.aoti_load_package(str(path))
    compare(network, lambda arrays: [x.numpy() for x in package(*map(torch.from_numpy, arrays.values()))])
    if shutil.which("cmake") is None:
        pytest.skip("the C++ example needs cmake")
    options = [f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}"]
    assert_rollout(network, scene["scene"], built_and_run(tmp_path, "step_package", path, options))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "checkpoint must be given, or weights with onnx, package or arrays, got None"),
        ({"checkpoint": "a"}, "out must be given with checkpoint, and only then, got None"),
        ({"weights": "gns"}, "onnx must be given with weights, or package or arrays, got None"),
        ({"weights": "gns", "onnx": "a.onnx"}, "weights must be an hgn network, got 'gns'"),
        ({"weights": "obstacles", "package": "a.so"}, "package must be a name that ends in .pt2, got 'a.so'"),
        ({"weights": "obstacles", "arrays": "a"}, "scene must be given with arrays, and only then, got None"),
    ],
)
def test_what_is_refused(options: dict[str, str], message: str) -> None:
    """By name, with the rule, before anything is written."""
    with pytest.raises(ConfigError, match=message):
        export.main(options)


def exported(folder: Path, name: str, **options: str) -> HierarchicalGraphNetwork:
    """The network whose step the command writes."""
    network = network_of(torch.float32, levels=2, message_passing_steps=1, **NETWORKS[name])
    save_weights(folder / "w.safetensors", network, WeightsInfo(network.config, 60.0, 1 / 64))
    assert export.main({"weights": str(folder / "w.safetensors"), **options}) == 0
    return network


def compare(network: HierarchicalGraphNetwork, step: Callable[[dict[str, np.ndarray]], Sequence[np.ndarray]]) -> None:
    for particles, obstacles in SIZES:
        state = random_state((particles,), dtype=torch.float32, obstacles=obstacles)
        position_N3, velocity_NM3 = step(initial_arrays(state))
        after = stepped(network, state)
        np.testing.assert_allclose(position_N3, after.position_N3.numpy(), rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(velocity_NM3, after.velocity_NM3.numpy(), rtol=0, atol=TOLERANCE)


def assert_rollout(network: HierarchicalGraphNetwork, scene: str, found_TN3: np.ndarray) -> None:
    (expected_TN3,) = Simulator(network, 60.0, "torch").rollout([load_scene(scene)], FRAMES)
    np.testing.assert_allclose(found_TN3, expected_TN3, rtol=0, atol=FRAMES * TOLERANCE)


def built_and_run(folder: Path, program: str, model: Path, options: Sequence[str]) -> np.ndarray:
    """Positions that a C++ example writes."""
    subprocess.run(["cmake", "-S", EXAMPLES, "-B", folder / "build", *options], check=True, capture_output=True)
    subprocess.run(["cmake", "--build", folder / "build", "--target", program], check=True, capture_output=True)
    arguments = [folder / "build" / program, model, folder / "arrays", str(FRAMES), folder / "out.npy"]
    subprocess.run(arguments, check=True, capture_output=True)
    return np.load(folder / "out.npy")
