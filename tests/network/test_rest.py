"""Tests that slow deformations of bodies in contact stop, for any weights, in float64."""

from dataclasses import replace

import pytest
import torch
from network.states import ODD_BODIES, airborne, drawn_outputs, network_of

from hgn.network.features import ParticleState
from hgn.network.grid import build_hierarchy
from hgn.step.reference import Deformation, accelerations, rest

ONE = torch.ones((), dtype=torch.float64)
NONE_1, ALL_1 = ONE.new_zeros(1), ONE.new_ones(1)  # of one material, whether it rests between larger cells
THRESHOLDS = pytest.mark.parametrize("threshold", [0.3, 2.0, 1e3])  # few, half and all of the particles are slower


def touching(counts=(60, 17, 1, 40)):
    """Scenes on a floor, which all of the first's coarsest cells touch; particles move as they please."""
    state = airborne(counts)
    return replace(state, position_N3=state.position_N3 - torch.tensor([0.0, 0.37, 0.0], dtype=torch.float64))


def on_cells(place_N3, levels=3):
    """One scene at rest, its grid, and how its coarsest cells touch, all wholly; gravity is 1."""
    zero_N, one_13 = torch.zeros(len(place_N3), dtype=torch.long), place_N3.new_ones(1, 3)
    grid = build_hierarchy(place_N3, zero_N, 0 * one_13, 0.035, levels)
    one_C = place_N3.new_ones(grid.levels[-1].cell_count)
    gravity_13 = torch.tensor([[0.0, -1.0, 0.0]], dtype=place_N3.dtype)
    state = ParticleState(place_N3, 0 * place_N3[:, None], zero_N, zero_N, one_13, gravity_13, None)
    return state, grid, one_C


def within_a_cell(count=30):
    """Places in one coarsest cell of three levels."""
    place_N3 = torch.rand(count, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    return 0.42 + 0.035 * (0.6 + 2.8 * place_N3)


@THRESHOLDS
@pytest.mark.parametrize("widely_1", [NONE_1, ALL_1])
@pytest.mark.parametrize("levels", [1, 3])
@pytest.mark.parametrize("body", range(len(ODD_BODIES) + 1))
def test_momenta_stay_and_energy_never_grows(body, levels, widely_1, threshold):
    """Of a body over many cells, of lines, planes and points, whatever moves: momentum and angular momentum are as
    without rest to rounding, and the next displacements have at most the energy that they had."""
    place_N3 = [*ODD_BODIES, torch.cat([within_a_cell(), 4 * within_a_cell(80) - 1.6])][body]
    state, grid, contact_C = on_cells(place_N3, levels)
    velocity_N13 = drawn_outputs(len(place_N3))[:, None, 3:6] + torch.tensor([3.0, 0.0, 1.0])
    state = replace(state, velocity_NM3=velocity_N13)
    acceleration_N3 = drawn_outputs(len(place_N3))[:, :3]
    found_N3 = rest(acceleration_N3, state, contact_C, grid, threshold, ONE, widely_1)
    change_N3 = found_N3 - acceleration_N3
    assert float(change_N3.sum(0).abs().max()) < 1e-11
    assert float(torch.linalg.cross(place_N3 - 0.4, change_N3).sum(0).abs().max()) < 1e-11
    before, after = (float((velocity_N13[:, 0] + a).square().sum()) for a in (acceleration_N3, found_N3))
    assert after < before + 1e-11
    if body == len(ODD_BODIES) and threshold > 1 and levels > 1:
        assert after < before - 1


@THRESHOLDS
def test_nothing_changes_in_flight(threshold):
    """Where no surface is within reach, and where there is no gravity, a network's accelerations are bitwise those
    without rest; on a floor they are not."""
    network, resting = (network_of(inputs="relative", rest_threshold=value) for value in (0.0, threshold))
    falling, lying = airborne(), touching()
    weightless = replace(lying, gravity_S3=0 * lying.gravity_S3)
    for state, same in ((falling, True), (lying, False), (weightless, True)):
        found = accelerations(resting, state, resting.prediction(state))
        assert torch.equal(network(state), found) == same and torch.equal(network(state), resting(state))


@pytest.mark.parametrize("shift", [0.0, 0.05, 0.12])  # over a face of cells of 0.14, too
def test_a_pile_comes_to_rest(shift):
    """Under random pushes below the threshold a body of half a coarsest cell never deforms faster than by two pushes,
    at any place. Without pushes it comes to rest. Without the constraint the deformation grows and stays. Rigid motion
    is unchanged, and so is a deformation faster than 1.5 times the threshold."""
    place_N3 = within_a_cell() * 0.7 + shift
    state, grid, contact_C = on_cells(place_N3)
    rate_13 = torch.tensor([[9.0, 3.0, 5.0]]).double()
    turning_N3 = torch.linalg.cross(rate_13, place_N3 - place_N3.mean(0))
    rigid_N3 = torch.tensor([0.5, -2.0, 0.1]).double() + turning_N3
    sizes = {}
    for threshold in (0.0, 0.3):
        velocity_N3, generator = rigid_N3, torch.Generator().manual_seed(1)
        push_N3 = 0.02 * torch.randn(30, 3, generator=generator, dtype=torch.float64)
        push_N3 -= Deformation(0 * contact_C, grid)(push_N3) + push_N3.mean(0)
        for frame in range(60):
            moving = replace(state, velocity_NM3=velocity_N3[:, None])
            push_N3 = push_N3 * (frame < 40)
            velocity_N3 = velocity_N3 + rest(push_N3, moving, contact_C, grid, threshold, ONE, NONE_1)
            sizes[threshold, frame] = float(Deformation(contact_C, grid)(velocity_N3).norm(dim=1).max())
    assert sizes[0.0, 39] > 0.5 and sizes[0.0, 59] == pytest.approx(sizes[0.0, 39])
    assert max(sizes[0.3, frame] for frame in range(60)) < 0.12 and sizes[0.3, 59] < 1e-3
    moving = replace(state, velocity_NM3=rigid_N3[:, None])
    torch.testing.assert_close(rest(rigid_N3, moving, contact_C, grid, 0.3, ONE, NONE_1), rigid_N3, rtol=0, atol=1e-12)
    swift_N3 = 100 * drawn_outputs(30)[:, :3]
    torch.testing.assert_close(rest(swift_N3, moving, contact_C, grid, 0.3, ONE, NONE_1), swift_N3, rtol=0, atol=0)
