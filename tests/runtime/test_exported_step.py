"""A step as ONNX and as a compiled package: what other programs run is what this one computes."""

import json
import os
import runpy
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np
import pytest
import torch
from network.states import gns_of, network_of, random_state
from network.test_barriers import scattered

from hgn import export
from hgn.config import config_directory
from hgn.network.barriers import Barriers
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.exported_step import INPUTS, initial_arrays, write_package
from hgn.runtime.simulator import Simulator
from hgn.runtime.torch_backend import Backend
from hgn.runtime.torch_stepper import stepped
from hgn.runtime.weights import WeightsInfo, save_weights
from hgn.scene.barrier import barrier_of_pieces, barrier_pieces
from hgn.scene.scene_file import load_scene
from hgn.schema import ConfigError, to_mapping

EXAMPLES = Path(__file__).resolve().parents[2] / "tools/deploy"
TOLERANCE = 1e-6  # of positions and displacements in a frame, domain units
FRAMES = 4
# At its walls random states begin, or end, for some particles, and their ways meet the triangles below.
WALLED = {"wall_clearance": (0.1, 0.7)}
WHOLE = WALLED | {"inputs": "relative", "rest_threshold": 0.3, "obstacle_clearance": 1e-3, "levels": 1}
SIZES = [(particles, obstacles) for particles in (1, 216, 3_000) for obstacles in (True, False)]
CELL = 1 / 64
ENDINGS = {"onnx": "onnx", "package": "pt2"}
SCENE = """
obstacles:
  - {shape: cone, size: 0.3, position: [0.5, 0.3, 0.5], rotation: [0, 20, 10]}
  - {mesh: ramp.obj, scale: 0.4, rotation: [0, 90, 0], position: [0.5, 0.1, 0.2]}
groups:
  - {shape: cube, size: 0.08, position: [0.5, 0.5, 0.5], material: water, velocity: [0, -4, 0]}
"""


class Written(NamedTuple):
    """A network and the folder with `step.onnx`, `step.pt2`, `scene.yaml` and the folder `arrays` of that scene."""

    network: HierarchicalGraphNetwork
    folder: Path


@pytest.fixture(autouse=True)
def whole_precision():
    """PyTorch multiplies in float32, whatever a backend has chosen for the process."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    yield
    torch.set_float32_matmul_precision(before)


@pytest.fixture(autouse=True, scope="module")
def one_turn():
    """A triangle stops a way once, and bodies rest between cells of one size: each turn more is more of the same."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hgn.step.reference.SURFACES", 1)
        patch.setattr("hgn.step.reference.REST_SIZES", 1)
        yield


@pytest.fixture(autouse=True, scope="module")
def rules_by_operator():
    """The optimiser of ONNX tries each of its rules at each node, some on the whole graph: half the export's time. Here
    it leaves out those for another operator, which end without a match all the same."""
    from onnxscript.rewriter._basics import MatchResult
    from onnxscript.rewriter._matcher import SimplePatternMatcher

    match = SimplePatternMatcher.match

    def matched(self, model, graph, node, **options):
        operator = self.pattern.output_nodes[0].op_identifier()
        if operator is not None and operator != node.op_identifier():
            return MatchResult().fail("another operator")
        return match(self, model, graph, node, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SimplePatternMatcher, "match", matched)
        yield


@pytest.fixture(scope="module")
def as_package(tmp_path_factory):
    """A network of relative inputs with all constraints, as by default: compiled, and as ONNX, of one graph."""
    return exported(tmp_path_factory.mktemp("package"), ("onnx", "package"), WHOLE)


@pytest.fixture(scope="module", params=["walled", pytest.param("whole", marks=pytest.mark.slow)])
def as_onnx(request, tmp_path_factory):
    """A network as ONNX: of absolute inputs on two levels with walls, or that one."""
    if request.param == "whole":
        return request.getfixturevalue("as_package")
    return exported(tmp_path_factory.mktemp("onnx"), ("onnx",), WALLED | {"levels": 2})


def test_onnx_is_the_step(as_onnx):
    """ONNX Runtime computes the step to 1e-6 at any number of particles, with and without obstacles, which hold some of
    them; the file says what its weights say of themselves; the example in Python simulates a scene's arrays."""
    import onnxruntime

    network, folder = as_onnx
    session = onnxruntime.InferenceSession(folder / "new/step.onnx")
    assert [item.name for item in session.get_inputs()] == list(INPUTS)
    declared = json.loads(session.get_modelmeta().custom_metadata_map["hgn"])
    assert declared["frame_rate_hz"] == 60.0 and declared["network"] == to_mapping(network.config)
    compare(network, lambda arrays: session.run(None, arrays))
    simulate = runpy.run_path(str(EXAMPLES / "step_onnx.py"))["simulate"]
    assert_rollout(as_onnx, simulate(str(folder / "new/step.onnx"), str(folder / "arrays"), FRAMES))


@pytest.mark.slow
def test_a_package_is_the_step(as_package):
    """The same of a package that PyTorch compiled, and of the example in C++."""
    package = torch._inductor.aoti_load_package(str(as_package.folder / "new/step.pt2"))
    compare(as_package.network, lambda arrays: [x.numpy() for x in package(*map(torch.from_numpy, arrays.values()))])
    if shutil.which("cmake") is None:
        pytest.skip("the C++ example needs cmake")
    options = [f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}"]
    assert_rollout(as_package, built_and_run("step_package", as_package.folder, "new/step.pt2", options))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cmake") is None, reason="needs cmake")
@pytest.mark.skipif(
    "ONNXRUNTIME_FOLDER" not in os.environ, reason="needs ONNXRUNTIME_FOLDER, a release of ONNX Runtime"
)
def test_onnx_runs_in_cpp(as_onnx):
    """The example in C++ simulates a scene's arrays."""
    options = [f"-DONNXRUNTIME_FOLDER={os.environ['ONNXRUNTIME_FOLDER']}", "-DCMAKE_DISABLE_FIND_PACKAGE_Torch=ON"]
    assert_rollout(as_onnx, built_and_run("step_onnx", as_onnx.folder, "new/step.onnx", options))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "checkpoint must be given, or else weights, got None"),
        ({"checkpoint": "a"}, "out must be given with checkpoint, got None"),
        ({"checkpoint": "a", "weights": "gns"}, "weights must be null with checkpoint, got 'gns'"),
        ({"weights": "gns"}, "out must be given with weights, or onnx, package or arrays, got None"),
        ({"weights": "obstacles", "package": "a.so"}, "package must be a name that ends in .pt2, got 'a.so'"),
        ({"weights": "obstacles", "arrays": "a"}, "scene must be given with arrays, and only then, got None"),
    ],
)
def test_what_is_refused(options, message):
    """By name, with the rule, before anything is written."""
    with pytest.raises(ConfigError, match=message):
        export.main(options)


@pytest.mark.parametrize(
    ("made", "values", "message"),
    [
        (gns_of, {}, "weights must be an hgn network, got 'gns'"),
        (network_of, {"inputs": "local", "own_physics": ("friction",)}, r"without own_physics, .* got \['friction'\]"),
    ],
)
def test_networks_that_are_not_exported(made, values, message, tmp_path):
    """Neighbour lists, and inputs of scenes that graphs lack, are refused."""
    network, path = made(torch.float32, **values), tmp_path / "own.safetensors"
    save_weights(path, network, WeightsInfo(network.config, 60.0, CELL))
    with pytest.raises(ConfigError, match=message):
        export.main({"weights": str(path), "onnx": str(tmp_path / "a.onnx")})
    assert not (tmp_path / "a.onnx").exists()


def test_a_package_is_written_first(tmp_path, monkeypatch):
    """What writes ONNX leaves symbols in the graph, of both formats, that the compiler refuses."""
    network, written = network_of(torch.float32), []
    save_weights(tmp_path / "w.safetensors", network, WeightsInfo(network.config, 60.0, CELL))
    monkeypatch.setattr("hgn.runtime.exported_step.traced_step", lambda *_: None)
    for kind in ("onnx", "package"):
        monkeypatch.setattr(f"hgn.runtime.exported_step.write_{kind}", lambda path, *_: written.append(path.name))
    files = {"onnx": str(tmp_path / "a.onnx"), "package": str(tmp_path / "a.pt2")}
    assert export.main({"weights": str(tmp_path / "w.safetensors"), "device": "cpu"} | files) == 0
    assert written == ["a.pt2", "a.onnx"]


def test_a_package_that_is_cut_off_leaves_nothing(tmp_path, monkeypatch):
    """Ctrl-C while the compiler is at it."""

    def interrupted(program, package_path, inductor_configs):
        Path(package_path).write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(torch._inductor, "aoti_compile_and_package", interrupted)
    info = WeightsInfo(network_of(torch.float32).config, 60.0, 1 / 64)
    with pytest.raises(KeyboardInterrupt):
        write_package(tmp_path / "step.pt2", None, info)
    assert not list(tmp_path.iterdir())


def exported(folder, kinds, constraints):
    """What the command writes of a small network, and a scene and its arrays."""
    from torch._inductor import cpu_vec_isa

    network = network_of(torch.float32, message_passing_steps=1, **{"levels": 1} | constraints)
    save_weights(folder / "w.safetensors", network, WeightsInfo(network.config, 60.0, CELL, step=network.step))
    shutil.copy(config_directory() / "example/ramp.obj", folder)
    (folder / "scene.yaml").write_text(SCENE)
    options = {kind: str(folder / "new" / f"step.{ENDINGS[kind]}") for kind in kinds}
    options |= {"scene": str(folder / "scene.yaml"), "arrays": str(folder / "arrays"), "device": "cpu"}
    # compiled without optimisation and vectors, which are PyTorch's; which of these the CPU has, a dozen programs tell
    settings = torch._inductor.config.patch({"aot_inductor.compile_wrapper_opt_level": "O0"})
    with settings, mock.patch.object(cpu_vec_isa, "valid_vec_isa_list", list):
        assert export.main({"weights": str(folder / "w.safetensors"), **options}) == 0
    return Written(network, folder)


def compare(network, step):
    corner_F33, _, _ = scattered(0)
    corner_F33 = barrier_pieces(0.2 + 0.5 * (corner_F33 - 0.5), CELL)  # where the particles are
    clearance, predict = network.step.obstacle_clearance, Backend(network).predict
    for particles, obstacles in SIZES:
        state = random_state((particles,), dtype=torch.float32, obstacles=obstacles)
        state = replace(state, velocity_NM3=10 * state.velocity_NM3)
        if obstacles and clearance is not None:
            state = replace(state, barriers=Barriers.of([barrier_of_pieces(corner_F33, CELL, clearance)]))
        position_N3, velocity_NM3 = step(initial_arrays(state, corner_F33 if obstacles else None))
        after = stepped(predict, state, network.step, network.config.dimensions)
        np.testing.assert_allclose(position_N3, after.position_N3.numpy(), rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(velocity_NM3, after.velocity_NM3.numpy(), rtol=0, atol=TOLERANCE)
        if state.barriers is not None and particles > 1:
            free = stepped(predict, replace(state, barriers=None), network.step, network.config.dimensions)
            assert (free.position_N3 != after.position_N3).any(-1).float().mean() > 0.01


def assert_rollout(written, found_TN3):
    """The frames of backend torch, in some of which obstacles stop particles if they can."""
    simulator, scene = Simulator(written.network, 60.0, "torch"), load_scene(written.folder / "scene.yaml")
    (expected_TN3,) = simulator.rollout([scene], FRAMES)
    np.testing.assert_allclose(found_TN3, expected_TN3, rtol=0, atol=FRAMES * TOLERANCE)
    if written.network.step.obstacle_clearance is None:
        return
    state = replace(simulator.start([scene]), barriers=None)
    for _ in range(FRAMES - 1):
        state = simulator.step(state)
    assert np.abs(state.position_N3.numpy() - found_TN3[-1]).max() > 0.01


def built_and_run(program, folder, model, options):
    """Positions that a C++ example writes."""
    options = ["-DCMAKE_BUILD_TYPE=Debug", "-DCMAKE_CXX_FLAGS_DEBUG=-O0", *options]
    subprocess.run(["cmake", "-S", EXAMPLES, "-B", folder / "build", *options], check=True, capture_output=True)
    subprocess.run(["cmake", "--build", folder / "build", "--target", program], check=True, capture_output=True)
    arguments = [folder / "build" / program, folder / model, folder / "arrays", str(FRAMES), folder / "out.npy"]
    subprocess.run(arguments, check=True, capture_output=True)
    return np.load(folder / "out.npy")
