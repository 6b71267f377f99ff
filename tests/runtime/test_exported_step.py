"""Tests a step as ONNX and as a compiled package: other programs compute the same as this one."""

import gc
import json
import os
import re
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
from network.states import gns_of, near_state, network_of, random_state
from network.test_barriers import scattered

from hgn import export
from hgn.config import config_directory
from hgn.network.barriers import Barriers
from hgn.network.elastic import RestShape
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.network.own_physics import scaled_parameters
from hgn.runtime.exported_step import INPUTS, OWN_INPUTS, initial_arrays, input_names, write_package
from hgn.runtime.simulator import InitialState, Simulator
from hgn.runtime.torch_backend import Backend
from hgn.runtime.torch_stepper import stepped
from hgn.runtime.weights import WeightsInfo, save_weights
from hgn.scene.barrier import barrier_of_pieces, barrier_pieces
from hgn.scene.material import MATERIALS, OWN_PHYSICS
from hgn.scene.own_physics import NOMINAL_P
from hgn.scene.rest_shape import NEIGHBOURS
from hgn.scene.scene_file import load_scene
from hgn.schema import ConfigError, to_mapping

EXAMPLES = Path(__file__).resolve().parents[2] / "tools/deploy"
TOLERANCE = 1e-6  # of positions and displacements in a frame, domain units
FRAMES = 4
# At its walls random states begin, or end, for some particles, and their ways meet the triangles below.
WALLED = {"wall_clearance": (0.1, 0.7)}
OWN = WALLED | {"inputs": "local", "own_physics": OWN_PHYSICS, "materials": MATERIALS, "levels": 2}
OWN = OWN | {"obstacle_distance": True}
WHOLE = WALLED | {"inputs": "relative", "rest_threshold": 0.3, "obstacle_clearance": 1e-3, "levels": 1}
SIZES = [(particles, obstacles) for particles in (1, 216, 3_000) for obstacles in (True, False)]
CELL = 1 / 64
ENDINGS = {"onnx": "onnx", "package": "pt2"}
SCENE = """
wall_friction: 0.3
obstacles:
  - {shape: cone, size: 0.3, position: [0.5, 0.3, 0.5], rotation: [0, 20, 10], friction: 0.5}
  - {mesh: ramp.obj, scale: 0.4, rotation: [0, 90, 0], position: [0.5, 0.1, 0.2]}
groups:
  - {shape: cube, size: 0.08, position: [0.5, 0.5, 0.5], material: water, velocity: [0, -4, 0], density_kg_m3: 1500}
"""
MOVING_SCENE = """
domain_size: [0.4375, 0.3125, 0.4375]
obstacles:
  - shape: square
    size: 0.2
    position: [0.2, 0.112, 0.2]
    friction: 0.5
    keyframes: [{time: 0}, {time: 0.25, translation: [0.03, 0.06, 0], rotation: [0, 60, 10]}]
  - shape: square
    size: 0.2
    position: [0.24, 0.2, 0.2]
    rotation: [0, 0, 90]
    keyframes: [{time: 0.05}, {time: 0.3, translation: [-0.06, 0, 0]}]
groups:
  - {shape: cube, size: 0.06, position: [0.2, 0.15, 0.2], material: sand}
"""
# scenes with own physics, and the inputs that change their frames
OWN_SCENES = {
    "sand on a rough slope": (
        "obstacles: [{shape: square, size: 0.24, position: [0.25, 0.16, 0.15], rotation: [0, 0, -25], friction: 0.6}]",
        "{shape: cube, size: 0.06, position: [0.22, 0.23, 0.15], material: sand, velocity: [0.5, -1, 0]}",
        ("obstacle_friction",),
    ),
    "elastic body on the floor": (
        "floor_friction: 0.3",
        "{shape: sphere, size: 0.06, position: [0.15, 0.1, 0.15], material: elastic, velocity: [0.5, -2, 0]}",
        ("wall_friction", "rest_position", "rest_neighbour"),
    ),
    "mixed pool with other parameters": (
        "floor_friction: 0.2\nwall_friction: 0.5",
        "{shape: box, size: [0.08, 0.03, 0.08], position: [0.1, 0.12, 0.15], material: water, water_viscosity_pa_s: 8},"
        "{shape: cube, size: 0.04, position: [0.1, 0.16, 0.15], material: sand, sand_friction_angle_deg: 20},"
        "{shape: cube, size: 0.03, position: [0.15, 0.16, 0.15], material: elastic, youngs_modulus_pa: 3.0e+5}",
        ("wall_friction", "parameters", "rest_position", "rest_neighbour"),
    ),
}


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
        gc.disable()  # an export's graphs are looked through again and again
        yield
        gc.enable()


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


@pytest.fixture(scope="module")
def as_own(tmp_path_factory):
    """A network with walls and all own physics as ONNX."""
    return exported(tmp_path_factory.mktemp("own"), ("onnx",), OWN)


@pytest.fixture(
    scope="module", params=["as_own", *(pytest.param(x, marks=pytest.mark.slow) for x in ("", "as_package"))]
)
def as_onnx(request, tmp_path_factory):
    """A network as ONNX: one of these, or one of absolute inputs on three levels with walls."""
    if request.param:
        return request.getfixturevalue(request.param)
    return exported(tmp_path_factory.mktemp("onnx"), ("onnx",), WALLED | {"levels": 3})


def test_operators_of_torchvision_are_not_missed(caplog):
    """PyTorch warns of each operator of a package that no step needs; its other warnings are printed."""
    from torch.onnx._internal.exporter._registration import ONNXRegistry, logger

    ONNXRegistry.from_torchlib()
    logger.warning("another")
    assert caplog.messages == ["another"]


def test_onnx_is_the_step(as_onnx):
    """ONNX Runtime computes the step to 1e-6 for any number of particles, with and without obstacles, some of which
    stop particles. The file contains the weights' metadata. The example in Python simulates a scene's arrays."""
    import onnxruntime

    network, folder = as_onnx
    session = onnxruntime.InferenceSession(folder / "new/step.onnx")
    names = [item.name for item in session.get_inputs()]
    assert names == [name for name in input_names(network.config) if name not in OWN_INPUTS["moving"]]
    assert (names == list(INPUTS)) == (network.config.own_physics == ())
    declared = json.loads(session.get_modelmeta().custom_metadata_map["hgn"])
    assert declared["frame_rate_hz"] == 60.0 and declared["network"] == to_mapping(network.config)
    compare(network, lambda arrays: session.run(None, arrays))
    simulate = runpy.run_path(str(EXAMPLES / "step_onnx.py"))["simulate"]
    assert_rollout(as_onnx, simulate(str(folder / "new/step.onnx"), str(folder / "arrays"), FRAMES))


@pytest.mark.slow
def test_moving_obstacles_are_in_the_step(tmp_path):
    """ONNX Runtime computes each of 20 frames with two moving obstacles to 1e-6, but not if they stand still or swap
    their triangles; the example in Python gives their poses."""
    import onnxruntime

    changes = OWN | {"levels": 1, "wall_clearance": (0.03, 0.04), "obstacle_clearance": 5e-4}
    written = exported(tmp_path, ("onnx",), changes, MOVING_SCENE)
    session = onnxruntime.InferenceSession(tmp_path / "new/step.onnx")
    simulator, start = (
        Simulator(written.network, 60.0, "torch"),
        InitialState.of_scene(load_scene(tmp_path / "scene.yaml")),
    )
    state = simulator.start([start])
    others = {name: np.load(tmp_path / "arrays" / f"{name}.npy") for name in OWN_INPUTS["moving"]}
    poses, largest = others["moving_pose"], {"moving_pose": 0.0, "moving_triangle": 0.0}
    for frame in range(20):
        arrays = initial_arrays(written.network.config, state, None, start.parameters) | others
        first, state = min(frame, len(poses) - 2), simulator.step(state)
        arrays["moving_pose"] = poses[first : first + 2]
        position_N3, velocity_NM3 = session.run(None, arrays)
        np.testing.assert_allclose(position_N3, state.position_N3.numpy(), rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(velocity_NM3, state.velocity_NM3.numpy(), rtol=0, atol=TOLERANCE)
        still = {"moving_pose": poses[[first, first]], "moving_triangle": others["moving_triangle"][::-1]}
        for name, value in still.items():
            wrong_N3, _ = session.run(None, arrays | {name: np.ascontiguousarray(value)})
            largest[name] = max(largest[name], np.abs(wrong_N3 - position_N3).max())
    assert min(largest.values()) > 10 * TOLERANCE, largest
    simulate = runpy.run_path(str(EXAMPLES / "step_onnx.py"))["simulate"]
    found_TN3 = simulate(str(tmp_path / "new/step.onnx"), str(tmp_path / "arrays"), FRAMES)
    np.testing.assert_allclose(found_TN3, simulator.rollout([start], FRAMES)[0], rtol=0, atol=FRAMES * TOLERANCE)


@pytest.mark.parametrize("scene", OWN_SCENES)
def test_own_physics_is_the_step(as_own, scene, tmp_path):
    """ONNX Runtime computes each of 20 frames to 1e-6, and other frames if an input lacks or mixes own physics, or if
    the number of the frame stays 0."""
    import onnxruntime

    session = onnxruntime.InferenceSession(as_own.folder / "new/step.onnx")
    surfaces, groups, names = OWN_SCENES[scene]
    (tmp_path / "scene.yaml").write_text(f"domain_size: [0.5, 0.5, 0.5]\n{surfaces}\ngroups: [{groups}]\n")
    start = InitialState.of_scene(load_scene(tmp_path / "scene.yaml"))
    simulator = Simulator(as_own.network, 60.0, "torch")
    state = simulator.start([start])
    largest = dict.fromkeys(names := ("frame", *names), 0.0)
    for _ in range(20):
        arrays, state = initial_arrays(as_own.network.config, state, None, start.parameters), simulator.step(state)
        for name in ("", *(each for each in names if largest[each] <= 10 * TOLERANCE)):
            without = np.roll(arrays[name], 1, 0) if name.startswith("rest") else 0 * arrays.get(name, 0)
            if name == "parameters":
                without = np.tile(np.array(NOMINAL_P, np.float32), (len(without), 1))
            position_N3, velocity_NM3 = session.run(None, arrays | ({name: without} if name else {}))
            error = np.abs(position_N3 - state.position_N3.numpy()).max()
            if name:
                largest[name] = max(largest[name], error)
                continue
            assert error < TOLERANCE
            np.testing.assert_allclose(velocity_NM3, state.velocity_NM3.numpy(), rtol=0, atol=TOLERANCE)
    assert min(largest.values()) > 10 * TOLERANCE, largest


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
        ({}, "checkpoint must be given, or weights instead, got None"),
        ({"checkpoint": "a"}, "out must be given with checkpoint, got None"),
        ({"checkpoint": "a", "weights": "gns"}, "weights must be null with checkpoint, got 'gns'"),
        ({"weights": "gns"}, "out must be given with weights, or onnx, package or arrays, got None"),
        ({"weights": "obstacles_small", "package": "a.so"}, "package must be a name that ends in .pt2, got 'a.so'"),
        ({"weights": "obstacles_small", "arrays": "", "scene": "a"}, "arrays must be a folder name, got ''"),
        ({"weights": "obstacles_small", "arrays": "a"}, "scene must be given with arrays, and only then, got None"),
    ],
)
def test_what_is_refused(options, message):
    """By name, with the rule, before anything is written."""
    with pytest.raises(ConfigError, match=message):
        export.main(options)


def test_neighbour_lists_are_not_exported(tmp_path):
    """A GNS is refused by name."""
    network, path = gns_of(torch.float32), tmp_path / "gns.safetensors"
    save_weights(path, network, WeightsInfo(network.config, 60.0, CELL))
    with pytest.raises(ConfigError, match="weights must be an hgn network, got 'gns'"):
        export.main({"weights": str(path), "onnx": str(tmp_path / "a.onnx")})
    assert not (tmp_path / "a.onnx").exists()


@pytest.mark.parametrize(("obstacles", "last_s", "poses"), [(2, 3e8, "36000000004"), (20, 100, "120040")])
def test_poses_of_a_motion_without_end(tmp_path, obstacles, last_s, poses):
    """A keyframe in ten years is refused, because its poses would fill the memory; so are poses of many obstacles."""
    network, scene = network_of(torch.float32, **OWN), tmp_path / "scene.yaml"
    save_weights(tmp_path / "w.safetensors", network, WeightsInfo(network.config, 60.0, CELL))
    text = MOVING_SCENE.replace("time: 0.3", f"time: {last_s:e}")
    begin, first, last, group = re.split("(?=  - shape)|(?=groups)", text)
    scene.write_text(begin + first + (obstacles - 1) * last + group)
    options = {"weights": str(tmp_path / "w.safetensors"), "arrays": str(tmp_path / "arrays"), "scene": str(scene)}
    with pytest.raises(
        ConfigError,
        match=rf"keyframes must be at most 100000 poses \(frames times obstacles\) with arrays, got {poses}",
    ):
        export.main(options)
    assert not (tmp_path / "arrays").exists()


def test_scenes_with_emitters_have_no_arrays(tmp_path):
    """They are refused by name, because the particles that enter later would be left out."""
    options = {"weights": "mechanics", "arrays": str(tmp_path / "arrays"), "scene": "tap_over_stairs"}
    with pytest.raises(ConfigError, match=r"scene must be without emitters with arrays, .*, got 'tap_over_stairs'"):
        export.main(options)
    assert not (tmp_path / "arrays").exists()


def test_an_export_that_fails_leaves_no_arrays(tmp_path, monkeypatch):
    """Arrays are written last, so the same folder serves for the next network."""
    network = network_of(torch.float32)
    save_weights(tmp_path / "w.safetensors", network, WeightsInfo(network.config, 60.0, CELL))
    monkeypatch.setattr("hgn.runtime.exported_step.traced_step", lambda *_: None)
    monkeypatch.setattr("hgn.runtime.exported_step.write_onnx", mock.Mock(side_effect=RuntimeError("no such operator")))
    options = {"weights": str(tmp_path / "w.safetensors"), "scene": "funnel", "onnx": str(tmp_path / "a.onnx")}
    with pytest.raises(RuntimeError, match="no such operator"):
        export.main(options | {"arrays": str(tmp_path / "arrays")})
    assert not (tmp_path / "arrays").exists()


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


def exported(folder, kinds, constraints, scene=SCENE):
    """What the command writes of a small network, and a scene and its arrays."""
    from torch._inductor import cpu_vec_isa

    network = network_of(torch.float32, message_passing_steps=1, **{"levels": 1} | constraints)
    save_weights(folder / "w.safetensors", network, WeightsInfo(network.config, 60.0, CELL, step=network.step))
    shutil.copy(config_directory() / "example/ramp.obj", folder)
    (folder / "scene.yaml").write_text(scene)
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
        state = replace(state, velocity_NM3=10 * state.velocity_NM3, frame_S=torch.tensor([particles]))
        state = near_state(state) if obstacles and network.config.obstacle_distance else state
        if obstacles and clearance is not None:
            state = replace(state, barriers=Barriers.of([barrier_of_pieces(corner_F33, CELL, clearance)]))
        state, parameter_NP = drawn_physics(state, network.config)
        position_N3, velocity_NM3 = step(
            initial_arrays(network.config, state, corner_F33 if obstacles else None, parameter_NP)
        )
        after = stepped(predict, state, network.step, network.config.dimensions)
        np.testing.assert_allclose(position_N3, after.position_N3.numpy(), rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(velocity_NM3, after.velocity_NM3.numpy(), rtol=0, atol=TOLERANCE)
        if state.barriers is not None and particles > 1:
            free = stepped(predict, replace(state, barriers=None), network.step, network.config.dimensions)
            assert (free.position_N3 != after.position_N3).any(-1).float().mean() > 0.01


def drawn_physics(state, config):
    """The state with friction, parameters and rest shapes of the network's own physics, and the parameters' values."""
    if not config.own_physics:
        return state, None
    rng, count = np.random.default_rng(1), len(state.position_N3)
    value_NP = (np.array(NOMINAL_P) * rng.uniform(0.5, 2, (count, len(NOMINAL_P)))).astype(np.float32)
    neighbour_NK = torch.from_numpy(rng.integers(-1, count, (count, NEIGHBOURS)))
    state = replace(
        state,
        wall_friction_S3=torch.from_numpy(rng.random((1, 3), np.float32)),
        parameter_NP=scaled_parameters(torch.from_numpy(value_NP), state.material_N, config.materials),
        rest=RestShape.of(state.position_N3, neighbour_NK),
    )
    if state.obstacles is None:
        return replace(state, rest=None), value_NP
    friction_K = torch.from_numpy(rng.random(len(state.obstacles.key_K), np.float32))
    return replace(state, obstacles=replace(state.obstacles, friction_K=friction_K)), value_NP


def assert_rollout(written, found_TN3):
    """The frames of backend torch, in some of which obstacles stop particles if they can.

    Rounding decides whether an obstacle stops a few of them, so these may differ: between float32 and float64, with
    obstacles, 1.1 % of the particles do.
    """
    simulator, scene = Simulator(written.network, 60.0, "torch"), load_scene(written.folder / "scene.yaml")
    (expected_TN3,) = simulator.rollout([scene], FRAMES)
    clearance = written.network.step.obstacle_clearance
    off_N = (np.abs(found_TN3 - expected_TN3) > FRAMES * TOLERANCE).any((0, 2))
    assert off_N.mean() <= (0.0 if clearance is None else 0.005)
    if clearance is None:
        return
    np.testing.assert_allclose(found_TN3, expected_TN3, rtol=0, atol=5 * clearance)
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
