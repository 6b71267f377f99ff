"""GNS: the literal definition, batches, order of particles."""

from dataclasses import replace

import pytest
import torch
from network.comparison import assert_same_function
from network.naive_gns import naive_gns_acceleration
from network.states import chosen, gns_of, random_state, scene_of

from hgn.config import NetworkConfig
from hgn.network.build import build_network


def test_parameter_count():
    """The structure that the paper compares with has 1.49 million parameters at width 128 and 10 steps."""
    network = build_network(NetworkConfig(kind="gns", levels=1, message_passing_steps=10))
    per_step = (3 * 128 + 1) * 128 + (2 * 128 + 1) * 128 + 2 * (128 * 129 + 256)
    ends = (40 + 1) * 128 + (4 + 1) * 128 + 2 * (128 * 129 + 256) + 129 * 128 + 129 * 3 + 3 * 16
    assert network.parameter_count == 10 * per_step + ends


@pytest.mark.parametrize("obstacles", [True, False])
@pytest.mark.parametrize("counts", [(17, 6), (1,)])
def test_gns_equals_the_literal_definition(obstacles, counts):
    """Outputs and all parameter gradients equal the naive network's, in float64."""
    network = gns_of(obstacle_features=obstacles)
    state = random_state(counts, obstacles=obstacles, spread=0.15)
    expected = naive_gns_acceleration(network, state)
    assert_same_function(network, network.normalised_acceleration(state), expected)


def test_batch_equals_single_scenes():
    """Each scene of a batch gets what it gets alone."""
    network = gns_of(torch.float32)
    state = random_state((40, 1, 25), spread=0.15, dtype=torch.float32)
    with torch.no_grad():
        together = network.normalised_acceleration(state)
        for scene in range(3):
            grid = state.obstacles and random_state((40, 1, 25), spread=0.15).obstacles
            if grid is not None:
                mine = grid.key_K >> 51 == scene
                grid = replace(grid, key_K=grid.key_K[mine] - (scene << 51), normal_K3=grid.normal_K3[mine])
            alone = scene_of(state, scene, grid)
            found = network.normalised_acceleration(alone)
            torch.testing.assert_close(found, together[state.scene_N == scene], rtol=1e-5, atol=1e-5)


def test_order_of_particles_is_irrelevant():
    """Particles in another order move alike."""
    network = gns_of()
    state = random_state((50,), spread=0.15)
    order = torch.randperm(50, generator=torch.Generator().manual_seed(2))
    expected = network.normalised_acceleration(state)[order]
    found = network.normalised_acceleration(chosen(state, order))
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)
