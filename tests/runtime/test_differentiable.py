"""Gradients through a simulation: against central differences in float64, and what is refused."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from network.states import gns_of, network_of, silent

from hgn.network.obstacles import ObstacleCells
from hgn.network.posed_obstacles import Placement, PosedObstacleCells
from hgn.runtime.differentiable import Inputs, Pose, _obstacles
from hgn.runtime.divergence import DivergedError
from hgn.runtime.simulator import Simulator
from hgn.scene.obstacle_grid import build_obstacle_grid
from hgn.scene.scene import Scene
from hgn.scene.shapes import shape_obstacle
from hgn.schema import ConfigError

STEP = 1e-8  # of the central differences in float64: roundoff leaves about 1e-7 of the slope
PARTICLES = 12
HELD_FRAMES = 30
CLEARANCE = 1e-3


@pytest.fixture(autouse=True, scope="module")
def sampled_once():
    """Obstacles of a scene are the same in all its simulations."""
    with pytest.MonkeyPatch.context() as patch:
        for module in ("differentiable", "simulator"):
            name = f"hgn.runtime.{module}.build_obstacle_grid"
            patch.setattr(name, lambda obstacles, *rest, **named: grid_of(tuple(obstacles), *rest, **named))
        yield


grid_of = cache(build_obstacle_grid)


@cache
def scene():
    """Particles of all materials that fall on a cone, a bowl around both."""
    rng = np.random.default_rng(0)
    return Scene(
        position_N3=(np.array([0.4, 0.42, 0.4]) + 0.15 * rng.random((PARTICLES, 3))).astype(np.float32),
        velocity_N3=rng.normal(0, 0.2, (PARTICLES, 3)).astype(np.float32),
        material_N=rng.integers(0, 3, PARTICLES).astype(np.uint8),
        obstacles=(shape_obstacle("cone", 0.2, (0.5, 0.38, 0.5)), shape_obstacle("square", 0.2, (0.5, 0.36, 0.5))),
    )


def network(kind, dtype=torch.float64):
    if kind == "gns":
        return gns_of(dtype, message_passing_steps=2, obstacle_features=False)
    changes = {
        "relative": {"inputs": "relative", "rest_threshold": 1.0},
        "distance": {"inputs": "relative", "obstacle_distance": True},
        # The cone holds some particles; some begin beyond the walls, some come to them.
        "held": {"wall_clearance": (0.43, 0.1), "obstacle_clearance": CLEARANCE},
    }
    return network_of(dtype, levels=2, message_passing_steps=1, **changes.get(kind, {}))


INPUTS = {
    "position_N3": torch.from_numpy(scene().position_N3).double(),
    "velocity_N3": torch.from_numpy(scene().velocity_N3).double(),
    "gravity_3": torch.tensor([0.3, -9.8, 0.1], dtype=torch.float64),
    "domain_size_3": torch.tensor([1.0, 1.1, 0.6], dtype=torch.float64),
    "rotation_3": torch.tensor([0.1, 0.2, -0.3], dtype=torch.float64),
    "translation_3": torch.tensor([0.01, -0.02, 0.015], dtype=torch.float64),
}
INPUTS_OF_ABSOLUTE = {name: value for name, value in INPUTS.items() if name != "gravity_3"}


def positions(simulator, inputs, smoothing, frames):
    rest = {name: value for name, value in inputs.items() if name not in ("rotation_3", "translation_3")}
    pose = Pose(inputs["rotation_3"], inputs["translation_3"])
    return simulator.differentiable(scene(), frames, **rest, poses={0: pose}, smoothing=smoothing)


@pytest.mark.parametrize(
    ("kind", "smoothing", "frames"),
    [("absolute", 0.5, 6), ("relative", 1.0, 6), ("gns", 0.0, 6), ("held", 0.0, HELD_FRAMES), ("distance", 0.0, 6)],
)
def test_gradients_are_those_of_central_differences(kind, smoothing, frames):
    """Over up to 30 frames, along a random direction of each input, along which its own slope is one, in all of them
    together; no particle changes a cell in between."""
    simulator = Simulator(network(kind), 60.0, "torch")
    inputs = {name: value.clone().requires_grad_() for name, value in INPUTS.items()}
    if kind not in ("relative", "distance"):
        del inputs["gravity_3"]
    generator = torch.Generator().manual_seed(1)
    weight_TN3 = torch.randn(frames, PARTICLES, 3, generator=generator, dtype=torch.float64)
    (positions(simulator, inputs, smoothing, frames) * weight_TN3).sum().backward()
    directions, nonzero = {}, 0
    for name, value in inputs.items():
        direction = torch.randn(value.shape, generator=generator, dtype=torch.float64)
        # without smoothing or distances a translation has no gradient
        slope = 0.0 if value.grad is None else (value.grad * direction).sum().item()
        directions[name], nonzero = direction / (slope or 1.0), nonzero + bool(slope)
    with torch.no_grad():
        high_TN3, low_TN3 = (
            positions(simulator, {name: x + step * directions[name] for name, x in inputs.items()}, smoothing, frames)
            for step in (STEP, -STEP)
        )
    cell_size = simulator.network.config.cell_size
    crossed = (high_TN3 / cell_size - 0.5).floor() != (low_TN3 / cell_size - 0.5).floor()
    assert not bool(crossed.any())
    assert kind != "distance" or inputs["translation_3"].grad.abs().max() > 0
    difference = ((high_TN3 - low_TN3) * weight_TN3).sum() / (2 * STEP)
    assert difference.item() == pytest.approx(nonzero, rel=0, abs=1e-4 / len(inputs))


@pytest.mark.parametrize("kind", ["absolute", "relative", "gns", "held", "distance"])
def test_positions_are_those_of_a_rollout(kind):
    """What nothing replaces moves as in a rollout."""
    simulator = Simulator(network(kind, torch.float32), 60.0, "torch")
    (expected_TN3,) = simulator.rollout([scene()], 6)
    found_TN3 = simulator.differentiable(scene(), 6)
    assert not found_TN3.requires_grad
    np.testing.assert_allclose(found_TN3.numpy(), expected_TN3, rtol=0, atol=2e-6)


@pytest.mark.parametrize("smoothing", [0.0, 0.5])
def test_obstacles_hold_where_they_are_put(smoothing):
    """A square that is rotated and shifted into a particle's path stops the particle at the clearance. The particle
    keeps its position along the square. A shift of the square moves it only along the normal, and a shift of its own
    start only along the square."""
    free = silent(network_of(inputs="relative", obstacle_clearance=CLEARANCE))
    down_13 = np.array([[0.0, -6.0, 0.0]], np.float32)  # 0.1 in a frame
    square = shape_obstacle("square", 0.2, (0.5, 0.125, 0.5))
    falling = Scene(np.full((1, 3), 0.5, np.float32), down_13, np.zeros(1, np.uint8), (square,), gravity=(0.0,) * 3)
    shift_3 = torch.tensor([0.0, 0.325, 0.0], dtype=torch.float64, requires_grad=True)
    start_13 = torch.full((1, 3), 0.5, dtype=torch.float64, requires_grad=True)
    pose = Pose(torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64), shift_3)

    def end(**inputs):
        simulator = Simulator(free, 60.0, "torch")
        return simulator.differentiable(falling, 2, position_N3=start_13, smoothing=smoothing, **inputs)[1, 0]

    normal_3 = torch.tensor([-np.sin(0.5), np.cos(0.5), 0.0])
    free_3 = torch.tensor([0.5, 0.4, 0.5], dtype=torch.float64)
    torch.testing.assert_close(end(), free_3, rtol=0, atol=1e-7)
    end_3 = end(poses={0: pose})
    torch.testing.assert_close(end_3, free_3 + (CLEARANCE + 0.05 * np.cos(0.5)) * normal_3, rtol=0, atol=1e-7)
    slopes = [torch.autograd.grad(x, (shift_3, start_13), retain_graph=True) for x in end_3]
    shifted_33, started_33 = (torch.stack([slope[i].view(3) for slope in slopes]) for i in (0, 1))
    across_33 = normal_3[:, None] * normal_3
    torch.testing.assert_close(shifted_33, across_33, rtol=0, atol=1e-6)
    torch.testing.assert_close(started_33, torch.eye(3, dtype=torch.float64) - across_33, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("height", "ends", "slope"),
    [
        (0.25, (0.4, 0.3, 0.25 + CLEARANCE, 0.25 + CLEARANCE), 1.0),  # it comes to the square in the third frame
        (0.8, (0.4, 0.3, 0.2, 0.1), None),  # above it, and in no frame's way
    ],
)
def test_frames_in_which_no_obstacle_holds(height, ends, slope):
    """A network that sees no obstacles falls on a square that is shifted there: the frames before and behind do not
    depend on the shift, and its gradient is that of the frame that does. Where none does there is no gradient."""
    blind = silent(network_of(inputs="relative", obstacle_features=False, obstacle_clearance=CLEARANCE))
    down_13, square = np.array([[0.0, -6.0, 0.0]], np.float32), shape_obstacle("square", 0.2, (0.5, 0.125, 0.5))
    falling = Scene(np.full((1, 3), 0.5, np.float32), down_13, np.zeros(1, np.uint8), (square,), gravity=(0.0,) * 3)
    shift_3 = torch.tensor([0.0, height - 0.125, 0.0], dtype=torch.float64, requires_grad=True)
    path_T13 = Simulator(blind, 60.0, "torch").differentiable(falling, 5, poses={0: Pose(None, shift_3)})
    assert path_T13[1:, 0, 1].tolist() == pytest.approx(ends, abs=1e-7)
    (gradient_3,) = torch.autograd.grad(path_T13[-1, 0, 1], shift_3, allow_unused=True)
    assert gradient_3 is None if slope is None else gradient_3.tolist() == pytest.approx([0.0, slope, 0.0], abs=1e-6)


def test_the_cone_holds_particles():
    """In the scene of the central differences, so that these see it."""
    held, free = (network_of(levels=2, message_passing_steps=1, obstacle_clearance=c) for c in (CLEARANCE, None))
    held_TN3, free_TN3 = (
        positions(Simulator(n, 60.0, "torch"), INPUTS_OF_ABSOLUTE, 0.0, HELD_FRAMES) for n in (held, free)
    )
    assert ((held_TN3 - free_TN3).abs().amax(dim=(0, 2)) > CLEARANCE).sum() > 2


def test_normals_turn_with_their_obstacle():
    """A plate turned by a quarter has its normal along the turned axis, at the turned place and nowhere else; the mean
    over a cube falls off linearly across its layer of cells."""
    cell_size, still = 1 / 64, torch.zeros(1, dtype=torch.int64)
    grid = build_obstacle_grid([shape_obstacle("square", 0.2, (0.5, 0.4921875, 0.5))], cell_size, 0)
    cells = ObstacleCells.of([grid])
    assert cells is not None
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    centre = torch.tensor([0.5, 0.4921875, 0.5])
    placement = Placement(quarter, centre, torch.tensor([0.1, 0.0, 0.0]))
    empty = ObstacleCells(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 3), cell_size)
    for smoothing, shares in ((0.0, (1, 1, 0)), (1.0, (1, 0.6, 0))):
        posed = PosedObstacleCells(empty.key_K, empty.normal_K3, cell_size, ((cells, placement),), smoothing)
        for offset, share in zip((0.0, 0.4, 1.2), shares, strict=True):
            point_N3 = (centre + torch.tensor([0.1 + offset * cell_size, 0.03, 0.0]))[None]
            normal_3 = posed.normals(point_N3, still)[0].abs()
            np.testing.assert_allclose(normal_3.numpy(), [share, 0, 0], atol=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames": 0}, "frames must be at least 1, got 0"),
        *(({"frames": frames}, "frames must be a whole number, got") for frames in ("2", 2.0, None, torch.tensor(2))),
        ({"smoothing": "x"}, "smoothing must be 0 to 1 cells, got 'x'"),
        *(
            (
                {"position_N3": value},
                f"position_N3 must be a dense tensor of real numbers, got '{type(value).__name__}'",
            )
            for value in ("x", np.zeros((12, 3)), [], torch.zeros((12, 3), device="meta"), torch.zeros((12, 3)) * 1j)
        ),
        ({"velocity_N3": torch.full((12, 3), torch.nan)}, "velocity_N3 must be finite, got 'nan or inf'"),
        ({"poses": {0: Pose(pivot_3=(0.0, 0.0, torch.inf))}}, "poses pivot_3 must be finite"),
        ({"poses": {0: Pose(translation_3=(0, 0, 1))}}, "poses translation_3 must be a dense tensor of real numbers"),
        *(({"poses": poses}, "poses must be a Pose by the number") for poses in ("x", [Pose()], {0: None})),
        ({"poses": {0.0: Pose()}}, "poses must be 0 to 1, got 0.0"),
        ({"smoothing": 1.5}, "smoothing must be 0 to 1 cells, got 1.5"),
        ({"gravity_3": torch.zeros(3)}, "gravity_3 must be left out for a network with absolute inputs"),
        ({"position_N3": torch.zeros(3)}, r"position_N3 must be of shape \(12, 3\), got \(3,\)"),
        ({"poses": {2: Pose()}}, "poses must be 0 to 1, got 2"),
        ({"poses": {0: Pose(rotation_3=torch.zeros(1))}}, r"rotation_3 must be of shape \(3,\), got \(1,\)"),
    ],
)
def test_what_is_refused(options, message):
    """By name, with the rule."""
    with pytest.raises(ConfigError, match=message):
        Simulator(network("absolute"), 60.0, "torch").differentiable(scene(), **({"frames": 2} | options))


def test_emitters_are_refused():
    """By name: the result has the same particles in all frames."""
    emitting = replace(scene(), entry_s_N=np.linspace(0, 1, PARTICLES))
    with pytest.raises(ConfigError, match="emitters must be left out here, got 'some'; use rollout"):
        Simulator(network("absolute"), 60.0, "torch").differentiable(emitting, 2)


def test_friction_between_posed_obstacles_is_their_mean():
    """With distances a particle is within reach of two plates whose normals are short: friction is no sum."""
    plates = tuple(
        replace(shape_obstacle("square", 0.3, (0.5, y, 0.5)), friction=friction)
        for y, friction in ((0.48, 0.4), (0.51, 0.8))
    )
    network = network_of(torch.float64, inputs="relative", own_physics=("friction",), obstacle_distance=True)
    start = Simulator(network, 60.0, "torch").start([replace(scene(), obstacles=plates)])
    posed = _obstacles(network, start, replace(scene(), obstacles=plates), Inputs(poses={0: Pose(), 1: Pose()}))[0]
    place_N3 = torch.tensor([[0.5, 0.493, 0.5], [0.5, 0.47, 0.5], [0.5, 0.3, 0.5]], dtype=torch.float64)
    friction_N = posed.surfaces(place_N3, torch.zeros(3, dtype=torch.int64))[:, 3]
    torch.testing.assert_close(friction_N, torch.tensor([0.6, 0.4, 0.0]).double(), rtol=1e-6, atol=0)


def test_distances_take_no_smoothing():
    with pytest.raises(ConfigError, match=r"smoothing must be 0 with obstacle_distance, got 0\.5"):
        Simulator(network("distance"), 60.0, "torch").differentiable(scene(), 2, smoothing=0.5)


def test_divergence_names_the_frame():
    """What flies out of reach ends the simulation as in a rollout."""
    velocity_N3 = torch.full((PARTICLES, 3), 100.0)
    with pytest.raises(DivergedError, match="diverged at frame 1: 12 of 12 particles"):
        Simulator(network("absolute"), 60.0, "torch").differentiable(scene(), 4, velocity_N3=velocity_N3)
