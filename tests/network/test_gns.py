"""GNS: the literal definition and its size."""

import pytest
from network.comparison import assert_same_function
from network.naive_gns import naive_gns_acceleration
from network.states import gns_of, random_state

from hgn.config import NetworkConfig
from hgn.network.build import build_network


def test_parameter_count():
    """The structure that the paper compares with has 1.49 million parameters at width 128 and 10 steps."""
    network = build_network(NetworkConfig(kind="gns", levels=1, message_passing_steps=10))
    per_step = (3 * 128 + 1) * 128 + (2 * 128 + 1) * 128 + 2 * (128 * 129 + 256)
    ends = (40 + 1) * 128 + (4 + 1) * 128 + 2 * (128 * 129 + 256) + 129 * 128 + 129 * 3 + 3 * 16
    assert network.parameter_count == 10 * per_step + ends


@pytest.mark.parametrize(("counts", "obstacles"), [((17, 6), True), ((12,), False), ((1,), True)])
def test_gns_equals_the_literal_definition(counts, obstacles):
    """Outputs and all parameter gradients equal the naive network's, in float64."""
    network = gns_of(obstacle_features=obstacles)
    state = random_state(counts, obstacles=obstacles, spread=0.15)
    expected = naive_gns_acceleration(network, state)
    assert_same_function(network, network.normalised_acceleration(state), expected)
