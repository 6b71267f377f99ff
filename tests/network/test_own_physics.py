"""Friction of surfaces and parameters of materials as inputs: exact where they are 0; Coulomb's law for any weights."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from network.states import airborne, network_of, random_state

from hgn.network.build import build_network
from hgn.network.own_physics import TINY, physics_fields, physics_widths
from hgn.network.relative import balanced
from hgn.runtime.simulator import Simulator
from hgn.runtime.weights import find_weights, load_weights
from hgn.scene.material import INPUT_PARAMETERS, MATERIALS
from hgn.scene.own_physics import NOMINAL_P, input_parameters
from hgn.scene.scene_file import find_scene, load_scene

OWN = ("friction", "parameters")
SCALE = 2e-3


def own_network(seed=5, **changes):
    """Random weights; every seed gives others."""
    network = network_of(inputs="relative", own_physics=OWN, **changes)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype))
    return network


def widened(network):
    """The network with inputs for own physics whose weights are 0."""
    config = replace(network.config, own_physics=OWN)
    wide, state = build_network(config, network.step), dict(network.state_dict())
    first = state["encode.first.weight"]
    state["encode.first.weight"] = torch.cat([first, first.new_zeros(len(first), sum(physics_widths(config)))], 1)
    wide.to(first.dtype).load_state_dict(state)
    return wide.eval()


def rough(state, friction=1.0, seed=0):
    """The state with random friction everywhere and random columns of parameters."""
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, generator=generator, dtype=state.position_N3.dtype)  # noqa: E731
    obstacles = state.obstacles and replace(state.obstacles, friction_K=friction * draw(len(state.obstacles.key_K)))
    walls, parameter_NP = friction * draw(state.scene_count, 3), draw(len(state.scene_N), len(INPUT_PARAMETERS))
    return replace(state, obstacles=obstacles, wall_friction_S3=walls, parameter_NP=parameter_NP)


def on_floor(friction=0.4, velocity=None, gravity=(0.0, -2.7e-3, 0.0), count=30, seed=0):
    """A small body in one coarsest cell of 0.14, above the floor and far from all else; the weights of its particles in
    that cell are 1."""
    generator = torch.Generator().manual_seed(seed)
    state = airborne((count,))
    low_3 = torch.tensor([0.58, 0.035, 0.58], dtype=torch.float64)
    place_N3 = low_3 + 0.06 * torch.rand(count, 3, generator=generator, dtype=torch.float64)
    velocity_NM3 = 1e-3 * torch.randn(count, 5, 3, generator=generator, dtype=torch.float64)
    if velocity is not None:
        velocity_NM3 = torch.tensor(velocity, dtype=torch.float64).expand(count, 5, 3)
    walls = torch.tensor([[0.0, friction, 0.0]], dtype=torch.float64)
    gravity_S3 = torch.tensor([gravity], dtype=torch.float64)
    zero_NP = torch.zeros(count, len(INPUT_PARAMETERS), dtype=torch.float64)
    return replace(
        state, position_N3=place_N3, velocity_NM3=velocity_NM3, gravity_S3=gravity_S3, wall_friction_S3=walls,
        parameter_NP=zero_NP,
    )  # fmt: skip


def mean_push(network, state):
    """The mean acceleration of the particles beyond gravity, in units of frames."""
    assert len(torch.unique(network.grid(state).coarsest_cells)) == 1
    return (network(state) - state.gravity_S3[state.scene_N]).detach().mean(0)


@pytest.mark.parametrize("name", ["mechanics", None])
def test_zero_columns_change_no_bit(name):
    """A network that begins with zero columns computes what it did before, in float32 for shipped weights: without
    friction and parameters, and with parameters alone. Weights that are not 0 see both."""
    network, state = network_of(inputs="relative"), random_state((40, 17))
    if name is not None:
        network, _ = load_weights(find_weights(name))
        state = random_state((40, 17), dtype=torch.float32)
    wide, given = widened(network), rough(state)
    expected = network(state)
    assert torch.equal(wide(state), expected)
    assert torch.equal(wide(replace(state, parameter_NP=given.parameter_NP)), expected)
    assert not torch.equal(wide(given), expected)
    assert torch.equal(wide(rough(state, friction=0.0)), expected)  # friction of 0 skips nothing and changes nothing
    seen = own_network()
    for changed in (replace(state, parameter_NP=given.parameter_NP), replace(given, parameter_NP=None)):
        changed = replace(changed, position_N3=changed.position_N3.double(), velocity_NM3=changed.velocity_NM3.double())
        changed = replace(changed, domain_S3=changed.domain_S3.double(), gravity_S3=changed.gravity_S3.double())
        plain = replace(changed, parameter_NP=None, wall_friction_S3=None)
        plain = replace(plain, obstacles=state.obstacles)
        assert float((seen(changed) - seen(plain)).detach().abs().max()) > 1e-5


def test_a_scene_without_friction_is_alone_in_a_batch():
    """Beside a scene with friction and parameters it has the bits that it has in a batch without them."""
    network = own_network()
    state = random_state((40, 30))
    given, second = rough(state), state.scene_N == 1
    mixed = replace(
        given,
        obstacles=replace(given.obstacles, friction_K=given.obstacles.friction_K * (given.obstacles.key_K >> 51 == 0)),
        wall_friction_S3=given.wall_friction_S3 * torch.tensor([[1.0], [0.0]]),
        parameter_NP=given.parameter_NP * ~second[:, None],
    )
    assert torch.equal(network(mixed)[second], network(state)[second])
    assert not torch.equal(network(mixed)[~second], network(state)[~second])


@pytest.mark.parametrize("friction", [0.0, 0.1, 0.6, 3.0])
def test_the_force_of_a_floor_lies_in_its_cone(friction):
    """For 40 random networks and motions the mean force along a floor is at most mu times its push, 0 where it would
    pull; some forces are at the cone's edge, and some pull."""
    ratios, pulls = [], 0
    for seed in range(40):
        push_3 = mean_push(own_network(seed), on_floor(friction, seed=seed))
        along, up = float(push_3[::2].norm()), float(push_3[1])
        assert along <= friction * max(up, 0.0) + 1e-15
        pulls += up < 0
        ratios.append(along / max(friction * up, TINY))
    assert pulls > 5 and (friction in (0.0, 3.0) or max(ratios) > 0.98)


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_friction_slows_and_never_reverses(tilt):
    """For 40 random networks and bodies that move as one, on a level or tilted floor, friction opposes the velocity
    that it leaves: its power is never positive, neither before nor after it acts."""
    kept = 0
    gravity = (2.7e-3 * math.sin(tilt), -2.7e-3 * math.cos(tilt), 0.0)
    for seed in range(40):
        speed = np.random.default_rng(seed).normal(size=3) * (4e-3, 0.0, 4e-3) * (seed % 4 > 0)
        state = on_floor(0.8, velocity=tuple(speed), gravity=gravity, seed=seed)
        along_2 = mean_push(own_network(seed), state)[::2]
        free_2 = (state.velocity_NM3[0, 0] + state.gravity_S3[0])[::2]
        sizes = float(along_2.norm() * (free_2 + along_2).norm())
        assert float(along_2 @ (free_2 + along_2)) <= 1e-3 * sizes + 1e-15  # FEW leaves a part of the push in T
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
        cells = random_state((1,)).obstacles
        place_N3 = state.position_N3 + torch.tensor([0.0, 0.3, 0.0])
        key_K = torch.unique(cells_of(place_N3))
        obstacles = replace(
            cells, key_K=key_K, normal_K3=normal_3.expand(len(key_K), 3), friction_K=torch.full((len(key_K),), friction)
        )
        state = replace(
            state, position_N3=place_N3, obstacles=obstacles, wall_friction_S3=None,
            gravity_S3=2.7e-3 * down_3[None],
        )  # fmt: skip
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


def cells_of(position_N3):
    from hgn.network.cell_keys import pack

    cell_N3 = torch.floor(position_N3 * 64).long()
    return pack(torch.zeros(len(cell_N3), dtype=torch.int64), cell_N3)


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
        assert walls.grad.isfinite().all()
        assert all(p.grad is None or p.grad.isfinite().all() for p in network.parameters())


def test_columns_of_parameters():
    """0 for defaults and for parameters of other materials; the logarithm for those over decades, the relative change
    for others, log(1 + p) for viscosity; the solver's settings are what a scene does not name; NaN is not named."""
    config = network_of(inputs="relative", own_physics=OWN).config
    material_N = np.array([0, 1, 2])
    given = {
        "youngs_modulus_pa": np.array([1e6, 2e6, np.nan], np.float32),
        "water_viscosity_pa_s": np.array([3.0, 3.0, 3.0], np.float32),
        "snow_hardening": np.full(3, 15.0, np.float32),
    }
    value_NP = input_parameters(given, {"sand_friction_angle_deg": 16.5}, 3)
    smooth = [(0.0, 0.0, 0.0)]
    found = fields_of(config, smooth, [value_NP], [3], torch.from_numpy(material_N))["parameter_NP"]
    expected = np.zeros((3, len(INPUT_PARAMETERS)))
    names = list(INPUT_PARAMETERS)
    expected[1, names.index("youngs_modulus_pa")] = math.log(2)
    expected[1, names.index("sand_friction_angle_deg")] = -0.5
    expected[0, names.index("water_viscosity_pa_s")] = math.log(4)
    expected[2, names.index("snow_hardening")] = 0.5
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-6, atol=0)
    nominal = {name: np.full(3, value, np.float32) for name, value in zip(names, NOMINAL_P, strict=True)}
    assert input_parameters(nominal, {}, 3) is None
    others = np.array([NOMINAL_P] * 3, np.float32)
    others[1, names.index("water_viscosity_pa_s")] = 5.0  # of sand
    assert fields_of(config, smooth * 2, [others, None], [3, 1], torch.ones(4, dtype=torch.int64)) == {}
    plain = network_of(inputs="relative").config
    assert fields_of(plain, [(0.0, 0.5, 0.0)], [value_NP], [3], torch.from_numpy(material_N)) == {}
    walls = fields_of(config, [(0.0, 0.5, 0.0)], [None], [3], torch.from_numpy(material_N))
    assert {name: value.tolist() for name, value in walls.items()} == {"wall_friction_S3": [[0.0, 0.5, 0.0]]}


def fields_of(config, frictions, parameters, counts, material_N):
    rows = zip(frictions, parameters, counts, strict=True)
    scenes = [SimpleNamespace(wall_friction=mu, parameters=p, material_N=np.zeros(n)) for mu, p, n in rows]
    return physics_fields(config, scenes, material_N)


def test_scenes_bring_their_own_physics():
    """The state of a scene file has the friction of floor, walls and each obstacle, and its groups' parameters; one
    without them skips the inputs; particles that enter bring theirs."""
    simulator = Simulator(own_network(), 60.0, "torch")
    slopes = simulator.start([load_scene(find_scene("friction_slopes"))])
    assert {round(mu, 5) for mu in slopes.obstacles.friction_K.tolist()} == {0.0, 0.1, 0.2, 0.3, 0.8}
    sand = simulator.start([load_scene(find_scene("loose_sand"))])
    assert sand.wall_friction_S3.tolist() == [[0.0, pytest.approx(0.6), 0.0]]
    angles = {
        round(value, 4)
        for value in sand.parameter_NP[:, list(INPUT_PARAMETERS).index("sand_friction_angle_deg")].tolist()
    }
    assert angles == {round(18 / 33 - 1, 4), round(42 / 33 - 1, 4)}
    plain = simulator.start([load_scene(find_scene("torus"))])
    assert plain.parameter_NP is None and plain.wall_friction_S3 is None and plain.obstacles.friction_K is None
    assert len(MATERIALS) == 4
