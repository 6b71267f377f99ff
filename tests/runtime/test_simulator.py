"""The simulation loop: scenes in a batch, the start, and what happens when a network is not good enough."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from network.states import network_of, silent
from runtime.scenes import EMPTY_GRID, GRAVITY, random_scene

from hgn.network.relative import history
from hgn.runtime.divergence import DivergedError
from hgn.runtime.simulator import InitialState, Simulator
from hgn.runtime.weights import WeightsInfo, save_weights
from hgn.scene.scene import Scene
from hgn.scene.scene_file import load_scene
from hgn.scene.shapes import shape_obstacle
from hgn.schema import ConfigError


def initial(particles, seed=0, obstacles=True, **changes):
    return random_scene(particles, seed, size=0.3, **({} if obstacles else {"obstacle_grid": EMPTY_GRID}), **changes)


def constant(acceleration, **changes):
    """A network that predicts the same acceleration everywhere, in frame units."""
    network = network_of(torch.float32, **changes)
    network.normaliser.set("acceleration", torch.tensor(acceleration), torch.ones(3), 0.0)
    return silent(network)


def free_flight(scene, frames):
    """x0 + v0 t + g t^2 / 2, [T, N, 3]."""
    time_T11 = (np.arange(frames) / 60)[:, None, None]
    return scene.position_N3 + scene.velocity_N3 * time_T11 + 0.5 * np.array(scene.gravity) * time_T11**2


def loaded(folder, network):
    """A simulator of a network's weights file."""
    save_weights(folder / "w.safetensors", network, WeightsInfo(network.config, 60.0, 1 / 64))
    return Simulator.load(folder / "w.safetensors", device="cpu")


@pytest.mark.parametrize("obstacles", [(True, False, True), (False, False, False)])
def test_batch_equals_each_alone(obstacles):
    """Scenes of different sizes, with and without obstacles, in one batch move as each does alone. Each simulated frame
    is reported once, frame 0 is the initial state, and the caller's arrays stay as they are."""
    simulator = Simulator(network_of(torch.float32), 60.0)
    scenes = [initial(n, seed, wanted) for seed, (n, wanted) in enumerate(zip((40, 1, 90), obstacles, strict=True))]
    before, seen = [scene.position_N3.copy() for scene in scenes], []
    together = simulator.rollout(scenes, 6, seen.append)
    assert seen == [1, 2, 3, 4, 5]
    for scene, path_TN3, begin_N3 in zip(scenes, together, before, strict=True):
        assert np.array_equal(path_TN3[0], begin_N3) and np.array_equal(scene.position_N3, begin_N3)
        assert path_TN3.shape == (6, len(scene.position_N3), 3) and path_TN3.dtype == np.float32
        (alone_TN3,) = simulator.rollout([scene], 6)
        np.testing.assert_allclose(path_TN3, alone_TN3, rtol=0, atol=2e-6)


def test_history_at_the_start_is_ballistic():
    """Before frame 0 particles flew freely into the initial state: v^{-k} = v0 dt - (k + 1/2) g dt^2, newest first."""
    simulator = Simulator(network_of(torch.float32), 60.0)
    scenes = [initial(20), initial(15, 1)]
    state = simulator.start(scenes)
    assert state.velocity_NM3.shape == (35, 5, 3)
    velocity_N3 = np.concatenate([scene.velocity_N3 for scene in scenes]).astype(np.float64) / 60
    for k in range(5):
        expected_N3 = velocity_N3 - (k + 0.5) * np.array(GRAVITY) / 3600
        np.testing.assert_allclose(state.velocity_NM3[:, k].numpy(), expected_N3, rtol=0, atol=3e-7)


@pytest.mark.parametrize("gravity", [GRAVITY, (0.0, 0.0, 0.0), (9.8, 0.0, -3.0), (0.0, 19.6, 0.0)])
def test_free_flight_is_the_closed_form(tmp_path, gravity):
    """Weights with relative inputs that add nothing to gravity move a scene along x0 + v0 t + g t^2 / 2, for any
    gravity, also in a batch with another one, and the initial history does not matter. Absolute weights that predict
    gravity do so too."""
    network = silent(network_of(torch.float32, inputs="relative"))
    simulator = loaded(tmp_path, network)
    scenes = [initial(9), initial(25, gravity=gravity)]
    state = simulator.start(scenes)
    shown = history(state.velocity_NM3, state.gravity_S3[state.scene_N]) / network.normaliser.acceleration_std[0]
    assert float(shown.abs().max()) < 1e-4
    paths = list(zip(scenes, simulator.rollout(scenes, 9), strict=True))
    if gravity == GRAVITY:
        absolute = Simulator(constant((0.0, -9.8 / 3600, 0.0)), 60.0)
        paths.append((scenes[0], absolute.rollout(scenes[:1], 9)[0]))
    for scene, path_TN3 in paths:
        np.testing.assert_allclose(path_TN3, free_flight(scene, 9), rtol=0, atol=2e-6)


@pytest.mark.parametrize(
    ("acceleration", "frame", "cause"),
    [
        ((0.5, 0.0, 0.0), 3, "farther from the domain than its own size"),  # x > 2 after 0.5 (1 + 2 + 3)
        ((float("nan"), 0.0, 0.0), 1, "40 of 40 particles are not finite"),
        ((float("inf"), 0.0, 0.0), 1, "40 of 40 particles are not finite"),
    ],
)
def test_divergence_names_the_frame(acceleration, frame, cause):
    """A network that throws particles out of reach, or makes them NaN, is stopped at that frame; what leaves a small
    domain is still inside a larger one."""
    scene = initial(40)
    scene.velocity_N3[:] = 0
    simulator = Simulator(constant(acceleration), 60.0)
    with pytest.raises(DivergedError, match=f"diverged at frame {frame}: .*{cause}") as raised:
        simulator.rollout([scene], 10)
    assert raised.value.frame == frame
    if frame == 3:
        simulator.rollout([replace(scene, domain_size=(4.0, 1.0, 1.0))], 4)


def test_materials_are_found_by_name():
    """A network with another list of materials looks them up by name, not by index."""
    scene = initial(4)
    scene.material_N[:] = [0, 2, 2, 0]
    found = Simulator(network_of(torch.float32, materials=("snow", "water")), 60.0).start([scene]).material_N
    assert found.tolist() == [1, 0, 0, 1]


def test_scene_file_to_rollout(tmp_path):
    """A scene file, obstacles and all, starts with its own particles and with normals where obstacles are."""
    path = tmp_path / "scene.yaml"
    path.write_text(
        "obstacles:\n  - {shape: half_box, size: 0.3, position: [0.5, 0.2, 0.5]}\n"
        "groups:\n  - {shape: cube, size: 0.06, position: [0.5, 0.5, 0.5], material: sand, velocity: [0, -1, 0]}\n"
    )
    scene: Scene = load_scene(path)
    state = Simulator(network_of(torch.float32), 60.0).start([InitialState.of_scene(scene)])
    assert state.obstacles is not None and len(state.obstacles.key_K) > 100
    assert np.array_equal(state.position_N3.numpy(), scene.position_N3)
    assert state.material_N.unique().tolist() == [1]
    assert state.velocity_NM3[:, 0, 1].numpy() == pytest.approx(-1 / 60 + 0.5 * 9.8 / 3600, abs=1e-6)


def test_frame_by_frame(tmp_path):
    """Single frames equal those of a rollout, also with another scene in the batch. A Scene is accepted directly."""
    simulator = loaded(tmp_path, network_of(torch.float32))
    assert simulator.frame_rate_hz == 60.0 and simulator.backend.note.startswith(
        "runtime backend: cpu (not triton: it needs a CUDA device, not cpu), precision fp32, rows "
    )
    start, other = initial(30), initial(10, 1)
    scene = Scene(start.position_N3, start.velocity_N3, start.material_N)
    (expected,) = simulator.rollout([scene], 4)
    first, second = simulator.frames(scene), simulator.frames(other)
    found = [(next(first), next(second))[0] for _ in range(4)]
    np.testing.assert_array_equal(np.stack(found), expected)


ONE = {"position_N3": np.full((1, 3), 0.5), "velocity_N3": np.zeros((1, 3)), "material_N": np.zeros(1, np.int64)}
COARSE = replace(EMPTY_GRID, cell_size=1 / 32)


def starting(*, network=None, **changes):
    """Starts a scene with so changed content by weights of a network."""
    return lambda folder: loaded(folder, network_of(torch.float32, **network or {})).start([initial(5, **changes)])


def scene_of(**change):
    return lambda folder: Scene(**(ONE | change))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (starting(gravity=(0.0,) * 3), r"gravity must be the weights' \(0.0, -9.8, 0.0\), .* got \(0.0, 0.0, 0.0\)"),
        (starting(gravity=(0.0, -9.82, 0.0)), "gravity must be the weights'"),
        (starting(network={"obstacle_features": False}, gravity=(0.0,) * 3), "gravity must be the weights'"),
        (starting(obstacle_grid=COARSE), r"cell_size must be the weights' 0.015625, .* got 0.03125"),
        *((starting(network={"inputs": "relative"}, gravity=gravity), "gravity must be at most 98 in size, ten times")
          for gravity in ((0.0, -99.0, 0.0), (60.0, 60.0, 60.0))),
        (starting(gravity=(0.0, float("nan"), 0.0)), r"gravity must be three numbers from -1e\+09 to 1e\+09, got \(0"),
        (starting(position_N3=np.full((5, 3), 45.0)),
         r"position_N3 must be finite and no farther from the domain than its own size, got \[45.0, 45.0, 45.0\]"),
        (starting(network={"materials": ("snow", "water")}, material_N=np.array([0, 1, 2, 2, 2])),
         r"material must be one of the training data's \(snow, water\), got sand"),
        (scene_of(position_N3=[[0.5, 0.5, 0.5]]), "position_N3 must be a NumPy array, got 'list'"),
        (scene_of(velocity_N3=np.zeros(3)), r"velocity_N3 must have shape \(1, 3\), got \(3,\)"),
        (scene_of(wall_friction=0.5), r"wall_friction must be three numbers from 0 to 1e\+09, got 0.5"),
        (scene_of(wall_friction=(0, -1, 0)), "wall_friction must be three numbers from 0 to"),
        (scene_of(domain_size=(1, 1)), r"domain_size must be three numbers from 0 to 1e\+09, got \(1, 1\)"),
        (scene_of(gravity=-9.8), "gravity must be three numbers from -1e"),
        (scene_of(gravity=([1], [2, 3], 4)), "gravity must be three numbers from -1e"),
        *((scene_of(material_parameters={"sand_friction_angle_deg": value}), message) for value, message in (
            (30.0, r"material_parameters\[sand_friction_angle_deg\] must be an array of shape \(1,\), got 30.0"),
            (np.array([130.0]), "sand_friction_angle_deg must be < 90, got 130.0"))),
        (lambda _: shape_obstacle("cone", -0.2), "size must be finite and > 0, got -0.2"),
        (scene_of(material_N=np.zeros(1)), "material_N must be whole numbers, got 'float64'"),
        *((scene_of(material_N=np.array([number])),
           rf"material_N must be 0 to 3 \(water, sand, snow, elastic\), got {number}") for number in (-1, 4)),
        *((lambda _, given=given: Simulator.load(**dict([given])), f"{given[0]} must be .*, got '{given[1]}'")
          for given in (("backend", "quick"), ("precision", "half"), ("weights", "obstacle"), ("device", "abacus"))),
        (lambda _: Simulator(network_of(torch.float32), 60.0).rollout([initial(3)], 0),
         "frames must be at least 1, got 0"),
    ],
)  # fmt: skip
def test_what_is_refused(tmp_path, call, message):
    """Scenes that weights were not trained for, arrays that people put together themselves, and options, by name."""
    with pytest.raises(ConfigError, match=message):
        call(tmp_path)


def test_what_is_near_enough_is_taken(tmp_path):
    """Gravity as it is estimated from trajectories; and cells of any size where a network sees none."""
    starting(gravity=(0.0, -9.8002, 1e-4))(tmp_path)
    starting(network={"obstacle_features": False}, obstacle_grid=COARSE)(tmp_path)
