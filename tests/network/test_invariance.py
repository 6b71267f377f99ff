"""What leaves a network's accelerations as they are, and what turns them: for any weights, in float64."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from network.states import (
    airborne,
    chosen,
    drawn_outputs,
    gns_of,
    in_flight,
    network_of,
    random_grid,
    random_state,
    scene_of,
)
from scene.test_symmetry import CUBE, matrix_of

from hgn.network.cell_keys import unpack
from hgn.network.grid import build_hierarchy
from hgn.network.obstacles import ObstacleCells
from hgn.network.relative import STRESS_33, Contacts, balanced
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.scene.symmetry import scene_symmetries

KINDS = {
    "absolute": network_of,
    "relative": partial(network_of, inputs="relative"),
    "rest": partial(network_of, inputs="relative", rest_threshold=2.0),
    "gns": gns_of,
}
SHIFT_3 = torch.tensor([0.07, -0.05, 0.11], dtype=torch.float64)
CONTACT, WALLS, NORMALS = slice(21, 24), slice(24, 30), slice(30, 36)  # with five velocities and three levels
ALL_48 = scene_symmetries((0.0, 0.0, 0.0), CUBE, 1 / 64)


def reordered(state):
    order = torch.randperm(len(state.position_N3), generator=torch.Generator().manual_seed(2))
    return chosen(state, order), None, order


def elsewhere(state):
    """With the grid's origin."""
    origin_S3 = SHIFT_3.expand(state.scene_count, 3)
    return replace(state, position_N3=state.position_N3 + SHIFT_3), origin_S3, slice(None)


def faster(*velocity):
    def change(state):
        boost_3 = torch.tensor(velocity, dtype=torch.float64)
        return replace(state, velocity_NM3=state.velocity_NM3 + boost_3), None, slice(None)

    return change


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        *((kind, reordered) for kind in KINDS),
        *(("relative", change) for change in (elsewhere, faster(5e-2, 0, 0), faster(0, 1.7e-2, 0))),
        ("rest", faster(-1e-3, 5e-3, 2e-2)),
    ],
)
def test_accelerations_stay(kind, change):
    """In another order of particles; away from surfaces, with relative inputs, elsewhere and with up to 3 m/s more for
    all, whatever the particles do among themselves; and they depend on that."""
    network = KINDS[kind]()
    for counts in ((40, 17, 1), (1,)):
        state = airborne(counts)
        changed, origin_S3, order = change(state)
        expected_N3 = network(state)
        torch.testing.assert_close(network(changed, origin_S3), expected_N3[order], rtol=0, atol=1e-13)
        if kind == "relative":
            stirred_N3 = network(replace(state, velocity_NM3=state.velocity_NM3 * 2))
            assert (float((stirred_N3 - expected_N3).detach().abs().max()) > 1e-6) == (len(state.position_N3) > 1)


@pytest.mark.parametrize("kind", KINDS)
def test_each_scene_is_alone(kind):
    """A scene's accelerations in a batch of other gravities are those that it has alone with its own; a scene without
    particles has none."""
    network, state = KINDS[kind](), airborne()
    together_N3 = network(state)
    for scene in range(3):
        found_N3 = network(scene_of(state, scene))
        torch.testing.assert_close(found_N3, together_N3[state.scene_N == scene], rtol=0, atol=1e-14)
    other_N3 = network(replace(state, gravity_S3=state.gravity_S3.flip(0)))
    assert (float((other_N3 - together_N3).detach().abs().max()) > 1e-4) == network.config.relative
    assert network(chosen(state, slice(0))).shape == (0, 3)


def test_translation_by_coarsest_cells_changes_nothing():
    """Moving particles by whole coarsest cells, latent features held fixed, leaves every output bitwise as it was."""
    network, state = network_of(cell_size=1 / 32, levels=4), random_state((60,), obstacles=False, spread=0.5)
    position_N3 = torch.round(state.position_N3 * 2**20) / 2**20  # so that the shifted positions are exact
    latent_NW, origin_13 = network.encode_particles(state), torch.zeros(1, 3, dtype=torch.float64)
    outputs = [
        network.propagate(latent_NW, build_hierarchy(place_N3, state.scene_N, origin_13, 1 / 32, 4))
        for place_N3 in (position_N3, position_N3 + torch.tensor([3, -5, 2]) * 8 / 32)
    ]
    assert torch.equal(*outputs)


@pytest.mark.parametrize(
    ("velocity", "gravity"),
    [
        ((2.0**-5, -(2.0**-6), 2.0**-7), (2.0**-9, 2.0**-10, -(2.0**-7))),
        ((1.7e-1, 0.0, 0.0), (2e-3, -5e-3, 1e-3)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ],
)
def test_free_flight_in_one_piece_is_exact(velocity, gravity):
    """With any weights, velocity up to 10 m/s and gravity, what flies freely as one has the acceleration g to rounding,
    and so has a single particle, however it got there; all columns show nothing, exactly so for numbers with short
    binary fractions."""
    network, gravity_3 = network_of(inputs="relative"), torch.tensor(gravity, dtype=torch.float64)
    state = in_flight(airborne(), velocity, gravity_3)
    torch.testing.assert_close(network(state), gravity_3.expand_as(state.position_N3), rtol=0, atol=1e-15)
    found = network.relative_features(state, network.grid(state))[0]
    assert float(found[:, : CONTACT.start].abs().max()) < 1e-11 and not found[:, CONTACT.start :].any()
    assert velocity[0] == 1.7e-1 or not found[:, :12].any()


def turned_outputs(output_N9, turn_33):
    """An acceleration turns as a vector, a stress as a tensor."""
    stress_N33 = turn_33 @ output_N9[:, torch.tensor(STRESS_33)] @ turn_33.T
    rows, columns = [0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]
    return torch.cat([output_N9[:, :3] @ turn_33.T, stress_N33[:, rows, columns]], 1)


@pytest.mark.parametrize("symmetry", ALL_48[1::8], ids=lambda s: f"{s.source}{s.mirrored}")
def test_columns_and_impulses_turn_with_the_scene(symmetry):
    """Scene and gravity turned and mirrored together by what keeps a cube, obstacles and walls within reach: columns of
    vectors do as they, walls change places; and so does what `balanced` makes of outputs. The grid's cells are their
    own images here."""
    network, grid = network_of(inputs="relative", cell_size=1 / 8), random_grid(3, 40_000, extent=64)
    state = replace(random_state((60,), spread=0.95), obstacles=ObstacleCells.of([grid]))
    state = replace(state, velocity_NM3=10 * state.velocity_NM3)
    turn_33 = torch.tensor(matrix_of(symmetry), dtype=torch.float64)
    centre_K3 = (grid.cell_K3 + 0.5) / 64 - 0.5
    cell_K3 = np.floor((centre_K3 @ turn_33.numpy().T + 0.5) * 64).astype(np.int32)
    order = np.lexsort(cell_K3.T[::-1])
    normal_K3 = (grid.normal_K3 @ turn_33.numpy().T.astype(np.float32))[order]
    image = replace(
        state,
        position_N3=(state.position_N3 - 0.5) @ turn_33.T + 0.5,
        velocity_NM3=state.velocity_NM3 @ turn_33.T,
        gravity_S3=state.gravity_S3 @ turn_33.T,
        obstacles=ObstacleCells.of([ObstacleGrid(1 / 64, cell_K3[order], normal_K3)]),
    )
    before, after = (network.relative_features(x, network.grid(x))[0] for x in (state, image))
    assert before.abs().amax(0).min() > 0, "every column shows something"
    vectors = [*range(0, CONTACT.stop), *range(NORMALS.start, NORMALS.stop)]
    expected = (before[:, vectors].unflatten(1, (-1, 3)) @ turn_33.T).flatten(1)
    torch.testing.assert_close(after[:, vectors], expected, rtol=0, atol=1e-10)
    outward_63 = torch.cat([-torch.eye(3), torch.eye(3)]).double()
    place_6 = (outward_63 @ turn_33.T @ outward_63.T).argmax(1)  # of each wall's image
    torch.testing.assert_close(after[:, WALLS][:, place_6], before[:, WALLS], rtol=0, atol=1e-12)

    output_N9 = drawn_outputs(60)
    # of the coarsest cells: functions of their centres' distance from the domain's
    results = []
    for outputs, scene in ((output_N9, state), (turned_outputs(output_N9, turn_33), image)):
        hierarchy = network.grid(scene)
        place_C3 = (unpack(hierarchy.levels[-1].key_C)[1].double() + 0.5) * 4 / 8 - 0.5
        normal_C33, distance_C = place_C3[:, :, None] * place_C3[:, None, :], place_C3.square().sum(1)
        results.append(balanced(outputs, Contacts(torch.exp(-distance_C), distance_C / 4, normal_C33), hierarchy))
    assert float(results[0].norm()) > 1
    torch.testing.assert_close(results[1], results[0] @ turn_33.T, rtol=0, atol=1e-12)
