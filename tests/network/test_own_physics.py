"""Friction of surfaces and parameters of materials as inputs: exact where they are 0; Coulomb's law for any weights."""

import functools
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml
from network.states import airborne, network_of, random_state

from hgn.config import NetworkConfig, TrainConfig, TrainingConfig
from hgn.network.cell_keys import pack
from hgn.network.obstacles import ObstacleCells
from hgn.network.own_physics import physics_fields
from hgn.network.relative import balanced
from hgn.runtime.simulator import InitialState, Simulator
from hgn.runtime.weights import find_weights, load_weights
from hgn.scene.emission import at_start
from hgn.scene.material import INPUT_PARAMETERS
from hgn.scene.own_physics import NOMINAL_P, input_parameters
from hgn.scene.scene_file import find_scene, load_scene, scene_of
from hgn.schema import ConfigError
from hgn.training.checkpoint import network_of_weights

OWN = ("friction", "parameters")


def own_network(seed=5, **changes):
    """Random weights; every seed gives others."""
    network = network_of(inputs="relative", own_physics=OWN, **changes)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype))
    return network


drawn_network = functools.cache(own_network)  # the same for each friction


def rough(state, friction=1.0, seed=0):
    """The state with random friction everywhere and random columns of parameters."""
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, generator=generator, dtype=state.position_N3.dtype)  # noqa: E731
    obstacles = state.obstacles and replace(state.obstacles, friction_K=friction * draw(len(state.obstacles.key_K)))
    walls, parameter_NP = friction * draw(state.scene_count, 3), draw(len(state.scene_N), len(INPUT_PARAMETERS))
    return replace(state, obstacles=obstacles, wall_friction_S3=walls, parameter_NP=parameter_NP)


def on_floor(friction=0.4, velocity=None, gravity=(0.0, -2.7e-3, 0.0), count=30, seed=0):
    """A small body in one coarsest cell, 0.14 wide, above the floor and far from all else."""
    generator = torch.Generator().manual_seed(seed)
    state = airborne((count,))
    low_3 = torch.tensor([0.58, 0.035, 0.58], dtype=torch.float64)
    place_N3 = low_3 + 0.06 * torch.rand(count, 3, generator=generator, dtype=torch.float64)
    velocity_NM3 = 1e-3 * torch.randn(count, 5, 3, generator=generator, dtype=torch.float64)
    if velocity is not None:
        velocity_NM3 = torch.tensor(velocity, dtype=torch.float64).expand(count, 5, 3)
    scene = {"gravity_S3": [gravity], "wall_friction_S3": [[0.0, friction, 0.0]]}
    scene = {name: torch.tensor(value, dtype=torch.float64) for name, value in scene.items()}
    return replace(state, position_N3=place_N3, velocity_NM3=velocity_NM3, **scene)


def mean_push(network, state):
    """The mean acceleration of the particles beyond gravity, in units of frames."""
    assert len(torch.unique(network.grid(state).coarsest.centre_G8)) == 1
    return (network(state) - state.gravity_S3[state.scene_N]).detach().mean(0)


def test_training_begins_with_zero_columns_that_change_no_bit():
    """A network initialised with shipped weights computes the same as these in float32: without friction and
    parameters, with parameters only, and with friction 0, which is still computed."""
    network, state = load_weights(find_weights("mechanics"))[0], random_state((40, 17), dtype=torch.float32)
    training = TrainingConfig(init_weights="mechanics")
    config = TrainConfig(network=replace(network.config, own_physics=OWN), step=network.step, training=training)
    wide, given, expected = network_of_weights(config)[0], rough(state), network(state)
    for same in (state, replace(state, parameter_NP=given.parameter_NP), rough(state, friction=0.0)):
        assert torch.equal(wide(same), expected)
    assert not torch.equal(wide(given), expected)


def test_a_scene_without_friction_is_alone_in_a_batch():
    """Beside a scene with friction and parameters it has the bits that it has in a batch without them."""
    network = own_network()
    state = random_state((40, 30))
    given, second = rough(state), state.scene_N == 1
    cells = given.obstacles
    cells = replace(cells, friction_K=cells.friction_K * (cells.key_K >> 51 == 0))
    walls, parameter_NP = given.wall_friction_S3 * torch.tensor([[1.0], [0.0]]), given.parameter_NP * ~second[:, None]
    mixed = replace(given, obstacles=cells, wall_friction_S3=walls, parameter_NP=parameter_NP)
    assert torch.equal(network(mixed)[second], network(state)[second])
    assert not torch.equal(network(mixed)[~second], network(state)[~second])


@pytest.mark.parametrize("friction", [0.0, 0.1, 0.6, 3.0])
def test_the_force_of_a_floor_lies_in_its_cone(friction):
    """For 40 random networks and motions the mean force along a floor is at most mu times its push, 0 where it would
    pull; some forces are at the cone's edge, and some pull."""
    pushes = [mean_push(drawn_network(seed), on_floor(friction, seed=seed)) for seed in range(40)]
    ratios = [float(push_3[::2].norm()) / max(friction * float(push_3[1]), 1e-15) for push_3 in pushes]
    assert max(ratios) <= 1 + 1e-12 and sum(float(push_3[1]) < 0 for push_3 in pushes) > 5
    assert friction in (0.0, 3.0) or max(ratios) > 0.98


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_friction_slows_and_never_reverses(tilt):
    """For 40 random networks and rigid motions on a level or tilted floor, friction opposes the velocity: its power is
    never positive, with the velocity before and after it."""
    gravity, kept = (2.7e-3 * math.sin(tilt), -2.7e-3 * math.cos(tilt), 0.0), 0
    for seed in range(40):
        speed = np.random.default_rng(seed).normal(size=3) * (4e-3, 0.0, 4e-3) * (seed % 4 > 0)
        state = on_floor(0.8, velocity=tuple(speed), gravity=gravity, seed=seed)
        along_2 = mean_push(drawn_network(seed), state)[::2]
        left_2 = (state.velocity_NM3[0, 0] + state.gravity_S3[0])[::2] + along_2
        sizes = float(along_2.norm() * left_2.norm())
        assert float(along_2 @ left_2) <= 1e-3 * sizes + 1e-15  # FEW leaves a part of the push in T
        kept += float(along_2.norm()) > 1e-6
    assert tilt == 0.0 or kept > 5


@pytest.mark.parametrize("angle", [5.0, 20.0, 30.0, 44.0])
@pytest.mark.parametrize("friction", [0.0, 0.2, 0.6])
@pytest.mark.parametrize("surface", ["wall", "plate"])
def test_a_block_stays_on_a_slope_up_to_the_angle_of_friction(angle, friction, surface):
    """A block at rest whose output cancels gravity stays exactly up to tan(angle) = mu; beyond, it accelerates along
    the slope by g (sin - mu cos). On the floor in tilted gravity, and on a tilted plate of obstacle cells. The push is
    0.99 of what the contacts bear, by the weights FEW and RARE."""
    network, radians = network_of(inputs="relative", own_physics=OWN), math.radians(angle)
    normal_3 = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    down_3 = torch.tensor([math.sin(radians), -math.cos(radians), 0.0], dtype=torch.float64)
    state = on_floor(friction, velocity=(0.0, 0.0, 0.0), gravity=tuple((2.7e-3 * down_3).tolist()), count=200)
    if surface == "plate":
        normal_3 = torch.tensor([-math.sin(radians), math.cos(radians), 0.0], dtype=torch.float64)
        down_3 = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
        place_N3 = state.position_N3 + torch.tensor([0.0, 0.3, 0.0])
        key_K = torch.unique(pack(state.scene_N, torch.floor(place_N3 * 64).long()))
        cells = ObstacleCells(key_K, normal_3.expand(len(key_K), 3), 1 / 64, friction_K=0 * key_K.double() + friction)
        state = replace(state, position_N3=place_N3, obstacles=cells, gravity_S3=2.7e-3 * down_3[None])
        state = replace(state, wall_friction_S3=None)
    grid = network.grid(state)
    _, contacts = network.relative_features(state, grid)
    scale = network.normaliser.acceleration_std[0]
    output_N9 = torch.cat([-2.7e-3 * down_3 / scale, torch.zeros(6)]).double().expand(200, 9)
    left_3 = (balanced(output_N9, contacts, grid) * scale + 2.7e-3 * down_3).detach().mean(0)
    slope = float((left_3 - (left_3 @ normal_3) * normal_3).norm()) / 2.7e-3
    expected = max(math.sin(radians) - friction * math.cos(radians), 0.0)
    assert slope == pytest.approx(expected, abs=0.012 * max(friction, 0.02))
    if friction > 1.05 * math.tan(radians):
        assert slope < 1e-12


def test_gradients_are_those_of_differences():
    """Of a random sum of accelerations: by friction of walls and obstacle cells, by parameters and by velocities."""
    network, state = own_network(levels=2), rough(random_state((25,), spread=0.1), friction=0.3)
    weight_N3 = torch.randn(25, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    state = replace(state, obstacles=replace(state.obstacles, friction_K=state.obstacles.friction_K.double()))

    def total(walls, cells, parameters, velocities):
        obstacles = replace(state.obstacles, friction_K=cells)
        changed = replace(state, obstacles=obstacles, wall_friction_S3=walls, parameter_NP=parameters)
        return (network(replace(changed, velocity_NM3=velocities)) * weight_N3).sum()

    inputs = [state.wall_friction_S3, state.obstacles.friction_K, state.parameter_NP, state.velocity_NM3]
    inputs = [tensor.clone().requires_grad_() for tensor in inputs]
    gradients = torch.autograd.grad(total(*inputs), inputs)
    for number, (tensor, gradient) in enumerate(zip(inputs, gradients, strict=True)):
        way = torch.randn(tensor.shape, generator=torch.Generator().manual_seed(number), dtype=torch.float64)
        step = 1e-6 if number < 3 else 1e-9
        ends = [[x + sign * step * way if x is tensor else x for x in inputs] for sign in (1, -1)]
        with torch.no_grad():
            slope = float(total(*ends[0]) - total(*ends[1])) / (2 * step)
        assert slope == pytest.approx(float((gradient * way).sum()), rel=1e-5) and slope != 0


def test_gradients_at_rest_are_finite():
    """A body at rest on a level floor, whose forces along it and whose slip are 0, has finite gradients, also without
    friction."""
    for friction in (0.0, 0.5):
        network, state = own_network(), on_floor(friction, velocity=(0.0, 0.0, 0.0))
        walls = state.wall_friction_S3.clone().requires_grad_()
        network(replace(state, wall_friction_S3=walls)).square().sum().backward()
        assert all(x.grad is None or x.grad.isfinite().all() for x in (walls, *network.parameters()))


def test_columns_of_parameters():
    """0 for defaults and for parameters of other materials; the logarithm for those over decades, the relative change
    for others, log(1 + p) for viscosity; the solver's settings are what a scene does not name; NaN is not named."""
    names, material_N = list(INPUT_PARAMETERS), torch.arange(3)
    given = {"youngs_modulus_pa": [1e6, 2e6, np.nan], "water_viscosity_pa_s": [3.0] * 3, "snow_hardening": [15.0] * 3}
    given = {name: np.array(values, np.float32) for name, values in given.items()}
    value_NP = input_parameters(given, {"sand_friction_angle_deg": 16.5}, 3)
    found = fields_of(OWN, value_NP, material_N)["parameter_NP"]
    expected, column = np.zeros((3, len(names))), names.index
    expected[1, [column("youngs_modulus_pa"), column("sand_friction_angle_deg")]] = math.log(2), -0.5
    expected[0, column("water_viscosity_pa_s")], expected[2, column("snow_hardening")] = math.log(4), 0.5
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-6, atol=0)
    nominal = {name: np.full(3, value, np.float32) for name, value in zip(names, NOMINAL_P, strict=True)}
    assert input_parameters(nominal, {}, 3) is None
    nominal["water_viscosity_pa_s"][1] = 5.0  # of sand
    assert fields_of(OWN, input_parameters(nominal, {}, 3), material_N) == {}
    assert fields_of((), value_NP, material_N, (0.0, 0.5, 0.0)) == {}
    walls = fields_of(OWN, None, material_N, (0.0, 0.5, 0.0))
    assert {name: value.tolist() for name, value in walls.items()} == {"wall_friction_S3": [[0.0, 0.5, 0.0]]}


def fields_of(own, value_NP, material_N, frictions=(0.0, 0.0, 0.0)):
    scene = SimpleNamespace(wall_friction=frictions, parameters=value_NP, material_N=material_N)
    return physics_fields(NetworkConfig(inputs="relative", own_physics=own), [scene], material_N)


def test_scenes_bring_their_own_physics():
    """The state of a scene file has the friction of floor and obstacles, and its groups' parameters; one without them
    skips the inputs."""
    simulator = Simulator(own_network(), 60.0, "torch")
    names = "friction_slopes", "loose_sand", "torus"
    slopes, sand, plain = (simulator.start([load_scene(find_scene(name))]) for name in names)
    assert {round(mu, 5) for mu in slopes.obstacles.friction_K.tolist()} == {0.0, 0.1, 0.2, 0.3, 0.8}
    assert sand.wall_friction_S3.tolist() == [[0.0, pytest.approx(0.6), 0.0]]
    angles = {round(33 * (1 + value)) for value in sand.parameter_NP[:, 2].tolist()}
    assert angles == {18, 42} and not sand.parameter_NP[:, 3:].any()
    assert plain.parameter_NP is None and plain.wall_friction_S3 is None and plain.obstacles.friction_K is None


def test_gradients_of_a_rollout_by_physics():
    """`differentiable` has the rollout's frames, also for tensors that replace a scene's own; their gradients are those
    of differences; names that are no inputs are refused. Particles that enter bring parameters of their own."""
    group = "{shape: cube, size: 0.03, position: [0.5, 0.08, 0.5], material: sand, sand_friction_angle_deg: 20}"
    drop = "{shape: disc, size: 0.03, position: [0.5, 0.3, 0.5], velocity: [0, -2, 0], material: water, stop: 0.1"
    text = f"{{groups: [{group}], emitters: [{drop}, water_viscosity_pa_s: 3}}], floor_friction: 0.3}}"
    scene = scene_of(yaml.safe_load(text), "a.yaml")
    simulator = Simulator(own_network(dtype=torch.float32), 60.0, "torch")
    with simulator.simulation(simulator.start([scene]), entries=simulator._entries([InitialState.of(scene)])) as run:
        run.run(5)
        later_NP = run.state.parameter_NP
    assert bool((later_NP[:, 2] != 0).any()) and bool((later_NP[:, 6] > 1).any())
    scene, simulator = at_start(scene), Simulator(own_network(), 60.0, "torch")
    angle_N = torch.full((scene.particle_count,), 20.0, dtype=torch.float64, requires_grad=True)
    walls_3 = torch.tensor([0.0, 0.3, 0.0], dtype=torch.float64, requires_grad=True)
    own = {"sand_friction_angle_deg": angle_N, "wall_friction": walls_3}
    path_TN3 = simulator.differentiable(scene, 3, **own)
    torch.testing.assert_close(path_TN3, simulator.differentiable(scene, 3), rtol=0, atol=1e-6)
    gradients = torch.autograd.grad(path_TN3[-1].sum(), [*own.values()])
    for (name, value), gradient in zip(own.items(), gradients, strict=True):
        ends = [simulator.differentiable(scene, 3, **own | {name: value.detach() + s})[-1].sum() for s in (1e-5, -1e-5)]
        assert float((ends[0] - ends[1]).detach()) / 2e-5 == pytest.approx(float(gradient.sum()), rel=1e-4)
    with pytest.raises(ConfigError, match=r"physics must be one of the network's inputs \(none\), got 'wall_friction'"):
        Simulator(network_of(inputs="relative"), 60.0, "torch").differentiable(scene, 2, wall_friction=walls_3)
