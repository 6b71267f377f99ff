"""Invariances and conservation laws of a network's accelerations, for any parameters, in float64."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from network.states import ODD_BODIES, airborne, chosen, gns_of, in_flight, network_of, random_state, scene_of

from hgn.network.features import Normaliser
from hgn.network.relative import balanced

KINDS = {
    "absolute": network_of,
    "relative": partial(network_of, inputs="relative"),
    "rest": partial(network_of, inputs="relative", rest_threshold=2.0),
    "gns": gns_of,
}
SHIFT_3 = torch.tensor([0.07, -0.05, 0.11], dtype=torch.float64)
MOTION = slice(0, 21)  # columns with five velocities and three levels


def reordered(state):
    order = torch.randperm(len(state.position_N3), generator=torch.Generator().manual_seed(2))
    return chosen(state, order), None, order


def elsewhere(state):
    """Shifts particles and the grid's origin together."""
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
    """Accelerations do not depend on the order of particles. With relative inputs and away from surfaces they do not
    depend on the position or on a common velocity of up to 3 m/s, but they depend on relative velocities."""
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
    """A scene's accelerations do not depend on the other scenes of its batch, which have other gravities. A scene
    without particles has no accelerations."""
    network, state = KINDS[kind](), airborne()
    together_N3 = network(state)
    for scene in range(3):
        found_N3 = network(scene_of(state, scene))
        torch.testing.assert_close(found_N3, together_N3[state.scene_N == scene], rtol=0, atol=1e-14)
    other_N3 = network(replace(state, gravity_S3=state.gravity_S3.flip(0)))
    assert (float((other_N3 - together_N3).detach().abs().max()) > 1e-4) == network.config.relative
    assert network(chosen(state, slice(0))).shape == (0, 3)


@pytest.mark.parametrize("gap", [0.0701, 0.0349])
def test_bodies_apart_do_not_act_on_each_other(gap):
    """With local inputs bodies at least 2 R apart do not act on each other, near walls and obstacles and in the same
    coarse cells as a fast body. A body nearer than R acts."""
    network, state = network_of(inputs="local", levels=4), random_state((90,), spread=0.06)
    position_N3, velocity_NM3 = state.position_N3.clone(), state.velocity_NM3.clone()
    position_N3[60:, 0] += position_N3[:60, 0].max() - position_N3[60:, 0].min() + gap
    velocity_NM3[60:] *= 20
    state = replace(state, position_N3=position_N3, velocity_NM3=velocity_NM3)
    together_N3 = network(state)
    for body in (slice(60), slice(60, 90)):
        change = float((network(chosen(state, body)) - together_N3[body]).detach().abs().max())
        assert change < 1e-15 if gap > 2 * network.config.cell_size else change > 1e-7, change


@pytest.mark.parametrize(
    ("velocity", "gravity"),
    [
        ((2.0**-5, -(2.0**-6), 2.0**-7), (2.0**-9, 2.0**-10, -(2.0**-7))),
        ((1.7e-1, 0.0, 0.0), (2e-3, -5e-3, 1e-3)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ],
)
def test_free_flight_in_one_piece_is_exact(velocity, gravity):
    """With any parameters, gravity and velocity up to 10 m/s, a rigid body or a single particle in free flight has the
    acceleration g up to rounding. All columns are 0, exactly for numbers with short binary fractions."""
    network, gravity_3 = network_of(inputs="relative"), torch.tensor(gravity, dtype=torch.float64)
    state = in_flight(airborne(), velocity, gravity_3)
    torch.testing.assert_close(network(state), gravity_3.expand_as(state.position_N3), rtol=0, atol=1e-15)
    found = network.relative_features(state, network.grid(state))[0]
    assert float(found[:, MOTION].abs().max()) < 1e-11 and not found[:, MOTION.stop :].any()
    assert velocity[0] == 1.7e-1 or not found[:, :12].any()


@pytest.mark.parametrize("levels", [1, 2, 3])
def test_momentum_is_kept_where_nothing_touches(levels):
    """With any parameters and motion, the accelerations minus gravity sum to 0, and so do their moments: over many
    coarsest cells, in one, and for particles on a line, on a plane or at one point. The sums are not 0 near a wall or
    for a part of the particles."""
    network = network_of(inputs="relative", levels=levels)
    state = airborne((60, 17, 1, 40, *map(len, ODD_BODIES)))
    place_N3 = torch.where((state.scene_N == 3)[:, None], 0.35 + state.position_N3 / 2, state.position_N3)
    place_N3[118:] = torch.cat(ODD_BODIES)
    state = replace(state, position_N3=place_N3)  # the particles of the fourth scene are close together
    extra_N3 = (network(state) - state.gravity_S3[state.scene_N]).detach()
    moment_N3 = torch.linalg.cross(place_N3 - 0.5, extra_N3)
    for scene in range(state.scene_count):
        mine_N3, turn_3 = extra_N3[state.scene_N == scene], moment_N3[state.scene_N == scene].sum(0)
        sizes = float(mine_N3.abs().sum())
        assert float(mine_N3.sum(0).abs().max()) < 1e-12 * sizes + 3e-16
        assert float(turn_3.abs().max()) < 1e-11 * sizes + 3e-16
        if scene < 4 and len(mine_N3) > 1:
            assert float(mine_N3[::2].sum(0).abs().max()) > 1e-3 * sizes
    grid = network.grid(state)
    contacts = network.relative_features(state, grid)[1]
    assert not contacts.contact_C.any()
    stressed = torch.cat([torch.zeros(len(extra_N3), 3), torch.randn(len(extra_N3), 6)], 1).double()
    pushed_N3 = balanced(stressed, contacts, grid)
    assert float(pushed_N3.abs().max()) > 1e-2
    by_wall = replace(state, domain_S3=state.position_N3.max(0).values.expand(state.scene_count, 3))
    extra_N3 = (network(by_wall) - state.gravity_S3[state.scene_N]).detach()
    assert float(extra_N3[state.scene_N == 0].sum(0).abs().max()) > 1e-2 * float(extra_N3.abs().max())


@pytest.mark.parametrize(
    ("inputs", "height", "pushes"),
    [
        *(("relative", height, height < 2.9) for height in (0.4, 2.2, 2.98)),  # gates of 1, below 1, and next to 0
        *(("local", height, height < 1.8) for height in (0.4, 1.7, 1.9)),
    ],
)
def test_bodies_slip_on_a_plane(inputs, height, pushes):
    """With any parameters, motions and materials a floor pushes along its normal only: accelerations minus gravity sum
    to 0 along the floor. With local inputs a floor 1.8 R below does not push. `height` is in R."""
    network, state = network_of(inputs=inputs), airborne((40,))
    low = state.position_N3[:, 1].min() - height * network.config.cell_size
    velocity_NM3 = state.velocity_NM3 * torch.tensor([1.0, inputs != "local", 1.0])  # none approaches the floor
    position_N3 = state.position_N3 - low * torch.tensor([0.0, 1.0, 0.0]).double()
    state = replace(state, position_N3=position_N3, velocity_NM3=velocity_NM3)
    extra_N3 = (network(state) - state.gravity_S3[state.scene_N]).detach()
    extra_3 = extra_N3.sum(0) / extra_N3.abs().sum()
    assert float(extra_3[::2].abs().max()) < 1e-12
    assert pushes == (float(extra_3[1].abs()) > 1e-3) or height > 2.9


def test_one_scale_for_all_axes():
    """The scale is the root mean square of the axes' standard deviations with noise, and means are 0. `target` inverts
    `restored_acceleration`."""
    normaliser = Normaliser()
    normaliser.set_isotropic(torch.tensor([3e-3, 0.0, 6e-3]), 4e-3)
    expected = ((9 + 0 + 36) / 3 + 16) ** 0.5 * 1e-3
    for quantity in ("velocity", "acceleration"):
        torch.testing.assert_close(getattr(normaliser, f"{quantity}_std"), torch.full((3,), expected))
        assert not getattr(normaliser, f"{quantity}_mean").any()
    network, state = network_of(inputs="relative"), airborne()
    raw = network.normalised_acceleration(state)
    back = network.target(network.restored_acceleration(raw, state), state.gravity_S3[state.scene_N])
    torch.testing.assert_close(back, raw, rtol=1e-9, atol=1e-9)
