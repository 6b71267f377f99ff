"""The deformation of elastic bodies as inputs: zero for rigid motions, closed forms, and gradients everywhere."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from network.states import network_of, random_state
from runtime.scenes import EMPTY_GRID

from hgn.config import NetworkConfig, TrainConfig, TrainingConfig
from hgn.data.batch import make_batch
from hgn.network.elastic import STRETCH, RestShape, elastic_columns, rest_shape
from hgn.runtime.live import LiveSimulation
from hgn.runtime.simulation import joined, selected
from hgn.runtime.simulator import InitialState, Simulator
from hgn.runtime.weights import find_weights, load_weights
from hgn.scene.episode import Episode
from hgn.scene.material import ELASTIC, MATERIALS, SAND
from hgn.scene.rest_shape import rest_neighbours
from hgn.schema import ConfigError
from hgn.training.checkpoint import network_of_weights

OWN = {"inputs": "local", "own_physics": ("parameters", "elastic"), "materials": MATERIALS}
SCALE, SPACING = 2e-3, 1 / 128


def body(count=60, seed=0, low=(0.4, 0.4, 0.4)):
    """Random places in a cube with the solver's density, float64."""
    side = SPACING * count ** (1 / 3)
    return np.array(low) + side * np.random.default_rng(seed).random((count, 3))


def shape_of(*places, body_N=None):
    place_N3 = np.concatenate(places).astype(np.float32)
    position_N3, neighbour_NK = rest_neighbours(place_N3, np.ones(len(place_N3), bool), body_N)
    return RestShape.of(torch.from_numpy(position_N3), torch.from_numpy(neighbour_NK).long())


def columns(shape, place_N3):
    return elastic_columns(torch.as_tensor(place_N3), shape, torch.tensor(SCALE, dtype=torch.float64))


def turned(seed):
    rotation_33, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return rotation_33 * np.linalg.det(rotation_33)


def scene(*bodies, materials=None, **changes):
    """Bodies at rest, elastic ones unless `materials` names others."""
    place_N3, counts = np.concatenate(bodies).astype(np.float32), [len(place_N3) for place_N3 in bodies]
    values = {"position_N3": place_N3, "velocity_N3": np.zeros_like(place_N3), "obstacle_grid": EMPTY_GRID}
    values |= {"material_N": np.repeat(materials or [ELASTIC] * len(counts), counts).astype(np.uint8)}
    values |= {
        "domain_size": (1.0, 1.0, 1.0),
        "gravity": (0.0, -9.8, 0.0),
        "body_N": np.repeat(range(len(counts)), counts),
    }
    return InitialState(**(values | changes))


@pytest.mark.parametrize("seed", range(4))
def test_rigid_motions_have_no_columns(seed):
    """They are 0 to float32's rounding of the rest shape for a body that moved and turned, of any shape."""
    shape = shape_of(body(), body(5, 1, (0.6, 0.4, 0.4)), body(1, 2, (0.8, 0.4, 0.4)))
    place_N3 = shape.position_N3.double().numpy() @ turned(seed).T + np.random.default_rng(seed).normal(size=3)
    assert columns(shape, place_N3).abs().max() < 2e-5
    assert columns(shape, 1.01 * place_N3).abs()[:60, :3].min() > 0.1


def test_columns_of_a_homogeneous_deformation():
    """F has the closed form (F F^T - 1) / 2 in every particle, whatever the axes of the rest shape, and no residual; a
    particle that left its place has one, towards its neighbours."""
    shape, deformation_33 = shape_of(body()), np.eye(3) + 0.1 * np.random.default_rng(1).normal(size=(3, 3))
    found_N9 = columns(shape, shape.position_N3.double().numpy() @ turned(0).T @ deformation_33.T)
    stretch_33 = (deformation_33 @ deformation_33.T - np.eye(3)) / (2 * STRETCH)
    expected_6 = np.arcsinh(stretch_33[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]])
    np.testing.assert_allclose(found_N9, np.tile([*expected_6, 0, 0, 0], (60, 1)), atol=1e-4)
    place_N3 = shape.position_N3.double()
    place_N3[7] += torch.tensor([2e-3, 0.0, 0.0])
    residual_3 = SCALE * torch.sinh(columns(shape, place_N3)[7, 6:])
    assert -3e-3 < residual_3[0] < -1e-3


@pytest.mark.parametrize("squash", [1.0, 0.0, -1.0])
def test_gradients_are_those_of_differences(squash):
    """In float64, for bodies that are deformed, flat or inverted along x, and for one squeezed into a point."""
    shape = shape_of(body(20), body(4, 1, (0.6, 0.4, 0.4)))
    for factors in ((squash, 1.0, 1.0), (0.0, 0.0, 0.0)):
        place_N3 = shape.position_N3.double() * torch.tensor(factors, dtype=torch.float64)
        place_N3 = (place_N3 + 1e-3 * torch.tensor(body(24, 3)) * squash).requires_grad_()
        assert torch.autograd.gradcheck(lambda x: columns(shape, x), place_N3, eps=1e-6, atol=1e-5)


def test_neighbours_stay_in_their_body():
    """They are the 12 nearest of the same body, by number where equally near: of a group, or of a connected part.
    Bodies of one particle and of a plane have none."""
    lattice_N3 = SPACING * np.stack(np.meshgrid(*[range(4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    touching_N3 = lattice_N3 + np.array([4 * SPACING, 0, 0])
    both_N3, every_N = np.concatenate([lattice_N3, touching_N3]), np.ones(128, bool)
    _, one_NK = rest_neighbours(both_N3, every_N, np.repeat([0, 1], 64))
    assert (one_NK[:64] < 64).all() and (one_NK[64:] >= 64).all() and one_NK.min() >= 0
    assert (rest_neighbours(both_N3, every_N, None)[1][:64] >= 64).any()
    _, apart_NK = rest_neighbours(
        both_N3 + [[0.7 * SPACING, 0, 0]] * every_N[:, None] * (np.arange(128) >= 64)[:, None], every_N, None
    )
    np.testing.assert_array_equal(apart_NK, one_NK)
    offset_K3 = lattice_N3[one_NK[21]] - lattice_N3[21]
    np.testing.assert_array_equal(one_NK[21][:6], np.sort(one_NK[21][:6]))
    assert np.allclose((offset_K3**2).sum(1), [SPACING**2] * 6 + [2 * SPACING**2] * 6)
    for few_N3 in (lattice_N3[:1], lattice_N3[:16]):
        assert (shape_of(few_N3).neighbour_NK == -1).all()


def test_particles_come_and_go_with_their_neighbours():
    """A batch of scenes, selected scenes and reordered particles have the columns of each scene. Where neighbours were
    removed, a deformation still has its closed form."""
    first, second = scene(body(30)), scene(body(25, 1), body(20, 2, (0.6, 0.4, 0.4)), materials=[SAND, ELASTIC])
    simulator = Simulator(network_of(dtype=torch.float32, **OWN), 60.0, "torch")
    one, two, both = (simulator.start(scenes) for scenes in ([first], [second], [first, second]))
    found = lambda state: columns(state.rest, 1.01 * state.position_N3.double())  # noqa: E731
    expected_N9 = torch.cat([found(one), found(two)])
    assert torch.equal(found(both), expected_N9) and not expected_N9[30:55].any() and expected_N9[55:].all()
    assert torch.equal(found(replace(one, **joined(one, two))), expected_N9)
    assert torch.equal(found(selected(both, both.scene_N == 1)), found(two))
    fewer = selected(one, torch.arange(30) % 3 > 0)
    torch.testing.assert_close(found(fewer), found(one)[:20], rtol=0, atol=1e-4)
    assert simulator.start([scene(body(9), materials=[SAND])]).rest is None


def test_a_simulation_keeps_the_rest_shape():
    """Samples of any frame of an episode have the rest shape of its first one. A body that was added moves as if it had
    been there from the start. Weights without the input refuse the material; without elastic bodies it does nothing."""
    network = network_of(dtype=torch.float32, **OWN)
    torch.nn.init.normal_(network.encode.first.weight)
    simulator, first, second = Simulator(network, 60.0, "torch"), scene(body(30)), scene(body(20, 1, (0.6, 0.4, 0.4)))
    both = scene(body(30), body(20, 1, (0.6, 0.4, 0.4)))
    (path_TN3,) = simulator.rollout([both], 4)
    live = LiveSimulation(simulator, first)
    live.add_particles(second.position_N3, second.velocity_N3, second.material_N)
    np.testing.assert_array_equal([live.step() for _ in range(3)], path_TN3[1:])
    known = {"obstacle_grid": EMPTY_GRID, "domain_size": (1.0, 1.0, 1.0), "gravity": (0.0, -9.8, 0.0)}
    known |= {"seed": 0, "solver": {}}
    groups = {"groups": [{"particle_count": 30}, {"particle_count": 20}]}
    episode = Episode(
        "a", path_TN3, both.velocity_N3, both.material_N, frame_rate_hz=60.0, specification=groups, **known
    )
    state, start = make_batch([(episode, 2)], network.config).state(), simulator.start([both])
    for name in ("neighbour_NK", "position_N3", "coefficient_NK4"):
        assert torch.equal(getattr(state.rest, name), getattr(start.rest, name))
    assert not torch.equal(network(replace(state, rest=None)), network(state))
    plain = random_state((20,), dtype=torch.float32)
    assert torch.equal(
        network(replace(plain, rest=RestShape.joined([None, start.rest], [20, 50])[:20])), network(plain)
    )
    with pytest.raises(ConfigError, match="material must be one of the network's"):
        Simulator(network_of(inputs="local"), 60.0, "torch").start([first])
    with pytest.raises(ConfigError, match="materials must be with elastic where own_physics has it"):
        NetworkConfig(inputs="local", own_physics=("elastic",))
    assert rest_shape([scene(body(9), materials=[SAND])]) is None


def test_training_begins_with_weights_without_the_input():
    """It begins as their network, bit by bit, with a new material."""
    weights, state = load_weights(find_weights("mechanics"))[0], random_state((20,), dtype=torch.float32)
    settings = {"own_physics": OWN["own_physics"], "materials": MATERIALS}
    training = TrainingConfig(init_weights="mechanics")
    config = TrainConfig(network=replace(weights.config, **settings), step=weights.step, training=training)
    assert torch.equal(network_of_weights(config)(state), weights(state))
