"""Relative inputs: what holds for any weights, in float64."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from network.states import ODD_BODIES, airborne, drawn_outputs, gns_of, in_flight, network_of, random_state

from hgn.config import NetworkConfig
from hgn.network.features import Normaliser, ParticleState
from hgn.network.grid import build_hierarchy
from hgn.network.obstacles import ObstacleCells
from hgn.network.relative import (
    QUIET,
    Contacts,
    balanced,
    coarsest_cells,
    obstacle_normals,
    surface_gate,
    touched_normals,
    wall_nearness,
)
from hgn.scene.obstacle_grid import ObstacleGrid

CONTACT, WALLS, NORMALS = slice(21, 24), slice(24, 30), slice(30, 36)  # with five velocities and three levels


def columns(network, state):
    return network.relative_features(state, network.grid(state))[0]


def test_what_is_disturbed_disturbs_its_body():
    """One particle that is slower than its neighbours frees the output of all within a coarsest cell, and of nothing
    in another scene."""
    network, zero_3 = network_of(inputs="relative"), torch.zeros(3, dtype=torch.float64)
    config = network.config
    state = in_flight(airborne((40, 17)), (1e-2, 0.0, 0.0), zero_3)
    reach = config.cell_size * 2 ** (config.levels - 1)
    near_N = (state.position_N3 - state.position_N3[3]).abs().amax(-1) < reach

    def gates(velocity_NH3):
        changed = replace(state, velocity_NM3=velocity_NH3)
        grid = network.grid(changed)
        contacts = network.relative_features(changed, grid)[1]
        assert not contacts.touched_C.any()
        return (grid.weight_N8 * contacts.disturbed_C[coarsest_cells(grid)]).sum(1)

    scale = float(network.normaliser.acceleration_std[0])
    for slower, full in ((3 * scale, True), (QUIET * scale / 4, False)):
        velocity_NH3 = state.velocity_NM3.clone()
        velocity_NH3[3, :, 0] -= slower
        gate_N = gates(velocity_NH3)
        assert gate_N[40:].max() < 1e-15
        assert gate_N[3] == pytest.approx(1) if full else 1e-3 < gate_N[3] < 1
        assert (gate_N[:40][near_N[:40]] > 0).all()
    assert gates(state.velocity_NM3).abs().max() < 1e-15


@pytest.mark.parametrize("levels", [1, 2, 3])
def test_momentum_is_kept_where_nothing_touches(levels):
    """With any weights, the accelerations of particles that move as they please, over many coarsest cells and alone in
    theirs, on lines, planes and in one place, sum to gravity's, and their moments to 0. Near a wall they do not, nor do
    those of a part; and the means of cells differ."""
    network = network_of(inputs="relative", levels=levels)
    state = airborne((60, 17, 1, 40, *map(len, ODD_BODIES)))
    place_N3 = torch.where((state.scene_N == 3)[:, None], 0.35 + state.position_N3 / 2, state.position_N3)
    place_N3[118:] = torch.cat(ODD_BODIES)
    state = replace(state, position_N3=place_N3)  # the fourth scene lies closely
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
    assert not contacts.touched_C.any()
    stressed = torch.cat([torch.zeros(len(extra_N3), 3), torch.randn(len(extra_N3), 6)], 1).double()
    pushed_N3 = balanced(stressed, contacts, grid)
    assert float(pushed_N3.abs().max()) > 1e-2
    by_wall = replace(state, domain_S3=state.position_N3.max(0).values.expand(state.scene_count, 3))
    extra_N3 = (network(by_wall) - state.gravity_S3[state.scene_N]).detach()
    assert float(extra_N3[state.scene_N == 0].sum(0).abs().max()) > 1e-2 * float(extra_N3.abs().max())


def pushed(place_N3, output_N9, levels=3, touched=0.0):
    """What `balanced` makes of outputs at such places, all disturbed: accelerations [N, 3]; places are normals, too."""
    scene_N, origin_13 = torch.zeros(len(place_N3), dtype=torch.long), place_N3.new_zeros(1, 3)
    grid = build_hierarchy(place_N3, scene_N, origin_13, 0.035, levels)
    one_C = place_N3.new_ones(grid.levels[-1].cell_count)
    normal_C33 = touched_normals(place_N3[:, :, None] * place_N3[:, None, :], grid)
    return balanced(output_N9, Contacts(one_C, touched * one_C, normal_C33), grid)


@pytest.mark.parametrize("levels", [1, 3])
@pytest.mark.parametrize("way", ["through a line", "through one place", "into another cell"])
def test_accelerations_are_continuous(way, levels):
    """Where three particles pass through a line, meet in one place, or a body enters another coarsest cell, smaller
    steps change accelerations less, in proportion: nothing jumps where a cell's inertia is that of a line or a point,
    or where a cell begins."""
    line_33 = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.4, 0.2], [2.0, 0.8, 0.4]], dtype=torch.float64)
    across_33 = torch.tensor([[0.1, 0.0, 0.0], [0.0, 0.9, -0.3], [0.0, 0.2, 0.4]], dtype=torch.float64)
    body_N3 = torch.rand(12, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64)

    def place(s):
        if way == "through a line":
            return 0.42 + 0.035 * (line_33 + (s - 0.5) * across_33)
        if way == "through one place":
            return 0.45 + 0.035 * ((s - 0.5) * (line_33 + across_33))
        return 0.5425 + 0.05 * (body_N3 - body_N3.amax(0)) + 0.14 * (s - 0.5)

    output_N9 = drawn_outputs(len(place(0.0)))
    jumps = []
    for steps in (2048, 16384):
        path = [pushed(place(0.5 + i / steps), output_N9, levels=levels) for i in range(-20, 21)]
        jumps.append(float(torch.stack(path).diff(dim=0).abs().max()))
    assert jumps[0] > 1e-9 and jumps[1] < jumps[0] / 4


@pytest.mark.parametrize("touched", [0.0, 0.3, 1.0])
def test_gradients_of_the_balance(touched):
    """Those with respect to outputs, and to places, are finite differences."""
    place_N3 = 0.42 + 0.2 * torch.rand(9, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64)

    def of(place, output):
        return pushed(place, output, 2, touched)

    inputs = (place_N3.requires_grad_(), drawn_outputs(9).requires_grad_())
    assert torch.autograd.gradcheck(of, inputs, eps=1e-7, atol=1e-4)


def test_a_body_may_still_turn():
    """Two cells push each other so that both turn, against the way that they go around each other; and a pair of
    particles in one cell is left alone, for no turn of a line is known."""
    corner_83 = torch.tensor([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], dtype=torch.float64)
    place_N3 = torch.cat([0.30 + 0.04 * corner_83, 0.30 + 0.04 * corner_83])
    place_N3[8:, 0] += 0.16
    shear = torch.zeros(16, 9, dtype=torch.float64)
    shear[:, 8] = 1.0
    found_N3 = pushed(place_N3, shear)
    first, second = found_N3[:8], found_N3[8:]
    assert first.mean(0).abs().max() > 1e-2
    torch.testing.assert_close(first.sum(0), -second.sum(0), rtol=0, atol=1e-12)
    halves = ((place_N3[:8], first), (place_N3[8:], second))
    around = [torch.linalg.cross(p - p.mean(0), a).sum(0)[2] for p, a in halves]
    assert around[0] * around[1] > 0 and abs(around[0]) > 1e-3
    assert pushed(ODD_BODIES[4], drawn_outputs(2), levels=4).abs().max() < 1e-12


def test_surfaces_beyond_reach_are_not_seen():
    """A hair beyond the reach of all walls the columns of contact are exactly zero, at any speed along them; a hair
    within it they are not, and the gate is 1 half way."""
    network = network_of(inputs="relative")
    reach = 3.0 * network.config.cell_size
    state = in_flight(airborne((1, 1, 1)), (0.0, 0.0, 2e-2), torch.zeros(3, dtype=torch.float64))
    place = torch.tensor([[reach * 1.0001, 0.5, 0.5], [reach * 0.9999, 0.5, 0.5], [0.5, 1 - reach / 2, 0.5]])
    state = replace(state, position_N3=place.double())
    found = columns(network, state)
    assert not found[0, CONTACT.start :].any()
    assert found[1, CONTACT].any() and int(found[1, WALLS].argmax()) == 0
    along = float(torch.asinh(torch.tensor(2e-2, dtype=torch.float64) / network.normaliser.acceleration_std[0]))
    assert float(found[2, CONTACT][2]) == pytest.approx(along) and int(found[2, WALLS].argmax()) == 4


def pile(*heights):
    """A scene for each list, in which particles lie one above the other, that many R = 0.035 above a floor; all slide
    at 0.3 m/s, and nothing else moves."""
    place_N3 = 0.035 * torch.tensor([[14.3, height, 14.2] for scene in heights for height in scene]).double()
    zero_N, zero_3 = torch.zeros(len(place_N3), dtype=torch.long), torch.zeros(3, dtype=torch.float64)
    scene_N = torch.repeat_interleave(torch.arange(len(heights)), torch.tensor([len(scene) for scene in heights]))
    one_S3 = torch.ones(len(heights), 3, dtype=torch.float64)
    state = ParticleState(place_N3, place_N3[:, None], zero_N, scene_N, one_S3, one_S3, None)
    return in_flight(state, (5e-3, 0.0, 0.0), zero_3)


def gates(network, state):
    """G of each particle: its column of contact over what that is of."""
    along_N = torch.asinh(state.velocity_NM3[:, 0, 0] / network.normaliser.acceleration_std[0])
    return columns(network, state)[:, CONTACT.start] / along_N


def own_gates(network, state):
    """How near each particle itself is to a surface."""
    found = columns(network, state)
    return surface_gate(found[:, WALLS], found[:, NORMALS])


def test_a_pile_knows_how_it_moves():
    """Only the foot of a pile is within reach of the floor; all particles in its coarsest cells and in those above see
    the velocity. Further up and without the foot none do."""
    network = network_of(inputs="relative")  # coarsest cells of 4 R
    heights = [0.7, 3.1, 3.3, 5.2, 6.8, 7.4, 8.6, 12.1]
    assert gates(network, pile(heights)).tolist() == pytest.approx([1, 1, 1, 1, 1, 1, 0, 0], abs=1e-12)
    assert not gates(network, pile(heights[1:])).any()
    assert own_gates(network, pile(heights)).tolist() == [1, 0, 0, 0, 0, 0, 0, 0]


@pytest.mark.parametrize("height", [0.4, 2.2, 2.98])  # R above the floor: the gate is 1, below 1, and next to 0
def test_bodies_slip_on_a_plane(height):
    """A floor pushes a body up or down only, whatever the weights, motions and materials: along it what is added to
    gravity sums to 0."""
    network, state = network_of(inputs="relative"), airborne((40,))
    low = state.position_N3[:, 1].min() - height * network.config.cell_size
    state = replace(state, position_N3=state.position_N3 - low * torch.tensor([0.0, 1.0, 0.0]).double())
    extra_N3 = (network(state) - state.gravity_S3[state.scene_N]).detach()
    extra_3 = extra_N3.sum(0) / extra_N3.abs().sum()
    assert float(extra_3[::2].abs().max()) < 1e-12
    assert height > 2.9 or float(extra_3[1].abs()) > 1e-3


def test_no_gate_is_less_than_the_own_one():
    """Among walls and obstacles the cells' gate is at most 1, and nowhere below a particle's own."""
    state = random_state((60, 9, 1), spread=0.5)
    state.velocity_NM3[:, :, 0] = 5e-3
    network = network_of(inputs="relative")
    own_N, found_N = own_gates(network, state), gates(network, state)
    assert (found_N > own_N - 1e-12).all() and (found_N < 1 + 1e-12).all()
    assert (own_N == 0).any() and (found_N > own_N + 0.1).any()


def test_the_gate_is_continuous():
    """On a particle's way up a pile, from cell to cell and out of reach, smaller steps change its gate less, in
    proportion, and no other's."""
    network, jumps = network_of(inputs="relative"), []
    for steps in (200, 1600):
        heights = torch.linspace(1.6, 11.0, steps).tolist()
        gate_TN = gates(network, pile(*([0.7, 5.2, 9.7, height] for height in heights))).view(steps, 4)
        assert float(gate_TN[:, :3].std(0).max()) < 1e-12
        assert float(gate_TN[0, 3]) == pytest.approx(1) and float(gate_TN[-1, 3]) == 0
        jumps.append(float(gate_TN.diff(dim=0).abs().max()))
    assert jumps[0] < 0.1 and jumps[1] < jumps[0] / 6


def test_gradients_of_the_columns():
    """Those by places and velocities are finite differences, near a floor."""
    network, state = network_of(inputs="relative"), airborne((5,))
    place_N3 = state.position_N3 * torch.tensor([1.0, 0.15, 1.0])

    def of(place_N3, velocity_NH3):
        moved = replace(state, position_N3=place_N3, velocity_NM3=velocity_NH3)
        return columns(network, moved)

    inputs = (place_N3.requires_grad_(), state.velocity_NM3.clone().requires_grad_())
    assert of(*inputs)[:, CONTACT.start].abs().max() > 0.1
    assert torch.autograd.gradcheck(of, inputs, eps=1e-7, atol=1e-4)


def test_walls_are_seen_a_frame_before_they_are_hit():
    """At 10 m/s towards a wall, one frame before the particle is there: so is its gate, while at rest, or at that speed
    away from the wall, nothing shows at that place."""
    sign_63 = torch.cat([-torch.eye(3), torch.eye(3)]).double()  # of the way to each wall
    place_63, domain_63 = 0.5 + sign_63 * (0.5 - 10 / 60), torch.ones(6, 3, dtype=torch.float64)
    towards_63, wall_6 = sign_63 * 10 / 60, torch.arange(6)
    seen_66 = wall_nearness(place_63, towards_63, domain_63, 0.0525)
    torch.testing.assert_close(seen_66, torch.eye(6).double())
    assert surface_gate(seen_66, None).tolist() == pytest.approx([1.0] * 6)
    for velocity_63 in (0 * towards_63, -towards_63):
        unseen_66 = wall_nearness(place_63, velocity_63, domain_63, 0.0525)
        assert not unseen_66.any() and not surface_gate(unseen_66, None).any()
    behind_66 = wall_nearness(place_63 + 2 * towards_63, towards_63, domain_63, 0.0525)  # beyond the plane by as much
    assert (behind_66[wall_6, wall_6] == 2.0).all()


def test_a_sheet_ahead_is_seen():
    """A particle that flies over a sheet of one cell within a frame sees the first normal on its way, in its own scene
    alone; one that flies away sees none, and the one in the sheet sees it twice where it stays."""
    cell_K3 = np.array([[i, 20, k] for i in range(10, 54) for k in range(10, 54)], np.int32)
    up = np.tile(np.array([[0, 1, 0]], np.float32), (len(cell_K3), 1))
    nothing = ObstacleGrid(1 / 64, np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
    obstacles = ObstacleCells.of([ObstacleGrid(1 / 64, cell_K3, up), nothing])
    height = torch.tensor([21.5, 21.5, 20.5, 21.5], dtype=torch.float64) / 64
    place = torch.stack([torch.full_like(height, 0.5), height, torch.full_like(height, 0.5)], 1)
    velocity = torch.zeros(4, 3, dtype=torch.float64)
    velocity[:, 1] = torch.tensor([-2.5, 2.5, 0.0, -2.5]) / 60
    found = obstacle_normals(place, velocity, torch.tensor([0, 0, 0, 1]), obstacles)
    assert found.tolist() == [[0, 0, 0, 0, 1, 0], [0] * 6, [0, 1, 0, 0, 1, 0], [0] * 6]
    no_wall = torch.zeros(4, 6, dtype=torch.float64)
    assert surface_gate(no_wall, found).tolist() == [1, 0, 1, 0]


def test_one_scale_for_all_axes():
    """The scale is the root mean square of the axes' spreads with the noise, there are no means; the target is the
    inverse of what the output means."""
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


def test_width_of_the_encoder():
    """55 numbers with five velocities and four levels, and others as the configuration says; weights of absolute inputs
    keep their shapes."""
    assert NetworkConfig(inputs="relative").feature_width == 12 + 12 + 3 + 6 + 6 + 16
    small = NetworkConfig(inputs="relative", levels=2, velocity_history=3, obstacle_features=False)
    assert small.feature_width == 6 + 6 + 3 + 6 + 16
    for network in (network_of(inputs="relative"), network_of(), gns_of()):
        assert network.encode.first.weight.shape[1] == network.config.feature_width
