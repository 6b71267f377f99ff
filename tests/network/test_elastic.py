"""The deformation of elastic bodies as inputs: zero for rigid motions, closed forms, and gradients everywhere."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from network.states import network_of, random_state
from runtime.scenes import EMPTY_GRID, random_scene

from hgn.config import NetworkConfig, TrainConfig, TrainingConfig
from hgn.data.batch import make_batch
from hgn.network.elastic import STRETCH, RestShape, elastic_columns
from hgn.runtime.live import LiveSimulation
from hgn.runtime.simulation import joined
from hgn.runtime.simulator import Simulator
from hgn.runtime.weights import find_weights, load_weights
from hgn.scene.episode import Episode
from hgn.scene.material import ELASTIC, MATERIALS, SAND
from hgn.scene.rest_shape import rest_neighbours
from hgn.schema import ConfigError
from hgn.training.checkpoint import network_of_weights

OWN = {"inputs": "local", "own_physics": ("parameters", "elastic"), "materials": MATERIALS}
SCALE, SPACING = 2e-3, 1 / 128


def body(count=60, seed=0, x=0.4):
    """Random places in a cube with the solver's density."""
    side = SPACING * count ** (1 / 3)
    return (np.array([x, 0.4, 0.4]) + side * np.random.default_rng(seed).random((count, 3))).astype(np.float32)


def scene(*bodies, material=ELASTIC):
    """Bodies at rest, the last one elastic and others of `material`."""
    counts, place_N3 = [len(place_N3) for place_N3 in bodies], np.concatenate(bodies)
    material_N = np.repeat([*[material] * (len(counts) - 1), ELASTIC], counts).astype(np.uint8)
    own = {"position_N3": place_N3, "velocity_N3": 0 * place_N3, "material_N": material_N, "obstacle_grid": EMPTY_GRID}
    return random_scene(0, **own, body_N=np.repeat(range(len(counts)), counts))


def rest_of(*places):
    place_N3 = np.concatenate(places)
    position_N3, neighbour_NK = rest_neighbours(place_N3, np.ones(len(place_N3), bool), None)
    return RestShape.of(torch.from_numpy(position_N3), torch.from_numpy(neighbour_NK).long())


def columns(rest, place_N3):
    return elastic_columns(torch.as_tensor(place_N3), rest, torch.tensor(SCALE, dtype=torch.float64))


def turned(place_N3, seed):
    rotation_33, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return place_N3.double().numpy() @ rotation_33.T * np.linalg.det(rotation_33)


@pytest.mark.parametrize("seed", range(4))
def test_rigid_motions_have_no_columns(seed):
    """They are 0 to the rounding of the rest shape's float32 for bodies that moved and turned."""
    rest = rest_of(body(), body(5, 1, 0.6), body(1, 2, 0.8))
    place_N3 = turned(rest.position_N3, seed) + np.random.default_rng(seed).normal(size=3)
    assert columns(rest, place_N3).abs().max() < 1e-4
    assert columns(rest, 1.01 * place_N3).abs()[:60, :3].min() > 0.5


def test_columns_of_a_homogeneous_deformation():
    """All particles have (F F^T - 1) / 2, whatever the axes of the rest shape, and no residual. A particle that left
    its place has one towards its neighbours."""
    rest, deformation_33 = rest_of(body()), np.eye(3) + 0.1 * np.random.default_rng(1).normal(size=(3, 3))
    stretch_33 = (deformation_33 @ deformation_33.T - np.eye(3)) / (2 * STRETCH)
    expected_6 = np.arcsinh(stretch_33[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]])
    found_N9 = columns(rest, turned(rest.position_N3, 0) @ deformation_33.T)
    np.testing.assert_allclose(found_N9, np.tile([*expected_6, 0, 0, 0], (60, 1)), atol=2e-4)
    place_N3 = rest.position_N3.double()
    place_N3[7, 0] += 2e-3
    assert -3e-3 < SCALE * torch.sinh(columns(rest, place_N3)[7, 6]) < -1e-3


@pytest.mark.parametrize("factor", [1.0, 0.0, -1.0])
def test_gradients_are_those_of_differences(factor):
    """In float64, for bodies that are deformed, flat or inverted, and for bodies in a point."""
    rest = rest_of(body(20), body(4, 1, 0.6))
    for factors in ((factor, 1.0, 1.0), (0.0, 0.0, 0.0)):
        place_N3 = rest.position_N3.double() * torch.tensor(factors, dtype=torch.float64)
        place_N3 = (place_N3 + 1e-3 * factor * torch.tensor(body(24, 3)).double()).requires_grad_()
        assert torch.autograd.gradcheck(lambda x: columns(rest, x), place_N3, eps=1e-7, atol=1e-4)


def test_neighbours_stay_in_their_body():
    """They are the nearest of the same group or connected part, by number where equally near. A body of one particle or
    in a plane has none."""
    lattice_N3 = SPACING * np.stack(np.meshgrid(*[range(4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    at = lambda cells: np.concatenate([lattice_N3, lattice_N3 + np.array([cells * SPACING, 0, 0])])  # noqa: E731
    near_NK, joined_NK, apart_NK = (
        rest_neighbours(at(cells), np.ones(128, bool), body_N)[1]
        for cells, body_N in ((4, np.repeat([0, 1], 64)), (4, None), (4.7, None))
    )
    assert near_NK.min() >= 0 and ((near_NK < 64).all(1) == (np.arange(128) < 64)).all()
    assert (joined_NK[:64] >= 64).any() and (apart_NK == near_NK).all()
    assert near_NK[21].tolist() == [5, 17, 20, 22, 25, 37, 1, 4, 6, 9, 16, 18]
    for few_N3 in (lattice_N3[:1], lattice_N3[:16]):
        assert (rest_of(few_N3.astype(np.float32)).neighbour_NK == -1).all()


def test_particles_come_and_go_with_their_neighbours():
    """Batches, selected scenes and joined states have the columns of each scene. Where neighbours were removed, a
    homogeneous deformation still has its closed form."""
    first, second = scene(body(30)), scene(body(25, 1), body(20, 2, 0.6), material=SAND)
    simulator = Simulator(network_of(dtype=torch.float32, **OWN), 60.0, "torch")
    one, two, both = (simulator.start(scenes) for scenes in ([first], [second], [first, second]))
    found = lambda state: columns(state.rest, 1.01 * state.position_N3.double())  # noqa: E731
    expected_N9 = torch.cat([found(one), found(two)])
    assert not expected_N9[30:55].any() and expected_N9[55:].all()
    for same in (both, replace(one, **joined(one, two))):
        assert torch.equal(found(same), expected_N9)
    assert torch.equal(found(both.selected(both.scene_N == 1)), found(two))
    torch.testing.assert_close(found(one.selected(torch.arange(30) % 3 > 0)), found(one)[:20], rtol=0, atol=1e-3)


def test_a_simulation_keeps_the_rest_shape():
    """Samples of any frame have the rest shape of the first one. A body that was added moves as if it had been there.
    Scenes without elastic bodies have no rest shape and keep their bits. Weights without the input refuse the bodies,
    and begin a training with it."""
    network, bodies = network_of(dtype=torch.float32, **OWN), (body(30), body(20, 1, 0.6))
    torch.nn.init.normal_(network.encode.first.weight)
    simulator, both = Simulator(network, 60.0, "torch"), scene(*bodies)
    (path_TN3,), (alone_N3, added_N3) = simulator.rollout([both], 4), bodies
    live = LiveSimulation(simulator, scene(alone_N3))
    live.add_particles(added_N3, 0 * added_N3, np.full(20, ELASTIC))
    np.testing.assert_array_equal([live.step() for _ in range(3)], path_TN3[1:])
    groups = {"groups": [{"particle_count": 30}, {"particle_count": 20}]}
    own = {"frame_rate_hz": 60.0, "seed": 0, "specification": groups, "solver": {}}
    arrays = path_TN3, both.velocity_N3, both.material_N, EMPTY_GRID, both.domain_size, both.gravity
    state, start = make_batch([(Episode("a", *arrays, **own), 2)], network.config).state(), simulator.start([both])
    for name in ("neighbour_NK", "position_N3", "coefficient_NK4"):
        assert torch.equal(getattr(state.rest, name), getattr(start.rest, name))
    assert not torch.equal(network(replace(state, rest=None)), network(state))
    plain = random_state((20,), dtype=torch.float32)
    none = RestShape.joined([None, start.rest], [20, 50])[:20]
    assert simulator.start([random_scene(9)]).rest is None
    assert torch.equal(network(replace(plain, rest=none)), network(plain))
    with pytest.raises(ConfigError, match="material must be one of the training data's"):
        Simulator(network_of(inputs="local"), 60.0, "torch").start([both])
    with pytest.raises(ConfigError, match="materials must be a list with elastic if own_physics contains it"):
        NetworkConfig(inputs="local", own_physics=("elastic",))
    weights, training = load_weights(find_weights("mechanics"))[0], TrainingConfig(init_weights="mechanics")
    config = replace(weights.config, own_physics=OWN["own_physics"], materials=MATERIALS)
    config = TrainConfig(network=config, step=weights.step, training=training)
    assert torch.equal(network_of_weights(config)[0](plain), weights(plain))
