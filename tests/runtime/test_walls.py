"""Tests walls (`step.wall_clearance`): which positions are constrained, which are not, and which still diverge."""

from functools import partial

import numpy as np
import pytest
import torch
from network.states import gns_of, network_of, random_state
from runtime.scenes import random_scene

from hgn.network.features import ParticleState
from hgn.runtime.rollouts import simulate_scenes
from hgn.runtime.simulator import Simulator
from hgn.step.reference import advanced
from hgn.step_config import StepConfig

WALLS = (0.03, 0.05)  # near sides, far sides
DOMAIN = (1.0, 0.8, 0.6)
NETWORKS = {
    "absolute": partial(network_of, torch.float32, levels=2),
    "relative": partial(network_of, torch.float32, levels=2, inputs="relative"),
    "gns": partial(gns_of, torch.float32),
}
NAN, INF = float("nan"), float("inf")
FRAMES = [  # place, velocity, acceleration and the domain's size on one axis; place and velocity a frame later
    (0.5, 0.01, 0, 1, 0.51, 0.01),
    (0.04, -0.02, 0, 1, 0.03, -0.01),  # arrives, as far as the wall
    (0.03, -0.02, 0, 1, 0.03, 0.0),
    (0.03, 0.02, 0, 1, 0.05, 0.02),
    (0.94, 0.02, 0, 1, 0.95, 0.01),
    (0.01, -0.005, 0, 1, 0.01, 0.0),  # begins nearer: stays, or leaves
    (0.01, 0.005, 0, 1, 0.015, 0.005),
    (0.98, 0.5, 0, 1, 0.98, 0.0),
    (0.98, -0.1, 0, 1, 0.88, -0.1),
    (-0.2, -0.3, 0, 1, -0.2, 0.0),  # begins outside
    (-0.2, 0.1, 0, 1, -0.1, 0.1),
    (0.1, 1.5, 0, 1, 0.95, 0.85),  # from wall to wall
    (0.1, 2.0, 0, 1, 2.1, 2.0),  # farther from the domain than its own size: what has come apart is not held
    (0.1, -1.5, 0, 1, -1.4, -1.5),
    # the walls of a small domain, at 0.03 and 0.01: what is between them stays, the rest comes as far as the first
    (0.02, 0.01, 0, 0.06, 0.02, 0),
    (0.02, -0.01, 0, 0.06, 0.02, 0),
    (0.005, 0.1, 0, 0.06, 0.01, 0.005),
    (0.04, -0.05, 0, 0.06, 0.03, -0.01),
    *((0.04, 0.0, value, 1, value, value) for value in (NAN, INF, -INF)),  # no wall makes a number of it
]


@pytest.mark.parametrize(("axis", "dimensions"), [(0, 3), (1, 3), (2, 3), (1, 2), (2, 2)])
def test_a_frame_at_a_wall(axis, dimensions):
    """A position does not come closer to a plane than the clearance, or than before. The velocity is the displacement.
    In two dimensions z has no walls. The other axes, in the domain's middle, stay unchanged."""
    x_N, v_N, a_N, size_N, end_N, left_N = torch.tensor(FRAMES, dtype=torch.float64).T
    count, others = len(x_N), [i for i in range(3) if i != axis]
    position_N3, velocity_NM3 = torch.full((count, 3), 0.5).double(), torch.zeros(count, 5, 3).double()
    domain_S3, acceleration_N3 = torch.ones(count, 3).double(), torch.zeros(count, 3).double()
    position_N3[:, axis], velocity_NM3[:, 0, axis], domain_S3[:, axis], acceleration_N3[:, axis] = x_N, v_N, size_N, a_N
    own_N = torch.arange(count)
    state = ParticleState(position_N3, velocity_NM3, 0 * own_N, own_N, domain_S3, 0 * domain_S3, None)
    after = advanced(state, acceleration_N3, StepConfig(wall_clearance=WALLS), dimensions)
    if axis >= dimensions:
        end_N, left_N = x_N + v_N + a_N, v_N + a_N
    for found_N, expected_N in ((after.position_N3[:, axis], end_N), (after.velocity_NM3[:, 0, axis], left_N)):
        number_N = expected_N.isfinite()
        assert torch.equal(found_N.isfinite(), number_N)
        torch.testing.assert_close(found_N[number_N], expected_N[number_N], rtol=0, atol=1e-12)
    assert torch.equal(after.position_N3[:, others], position_N3[:, others])
    assert not after.velocity_NM3[:, 0, others].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_free_of_walls_nothing_changes(dtype):
    """What comes to no wall moves bitwise as without any: positions and histories."""
    state = random_state((200, 50), dtype=dtype)
    acceleration_N3 = 1e-3 * torch.randn(250, 3, dtype=dtype)
    free, walled = (
        advanced(state, acceleration_N3, step, 3) for step in (StepConfig(), StepConfig(wall_clearance=(0.0, 0.1)))
    )
    assert torch.equal(free.position_N3, walled.position_N3) and torch.equal(free.velocity_NM3, walled.velocity_NM3)
    assert walled.position_N3.dtype == dtype


@pytest.mark.parametrize(("name", "backend"), [("absolute", "torch"), ("relative", "cpu"), ("gns", "torch")])
def test_nothing_leaves_the_domain(name, backend):
    """Whatever the weights: of random ones that throw particles about, all are between the walls in every frame, and
    without walls some leave the domain."""
    still_N3 = np.zeros((40, 3), np.float32)
    scenes = [random_scene(40, seed, size=0.4, domain_size=DOMAIN, velocity_N3=still_N3) for seed in (0, 1)]
    for walls in (None, WALLS):
        network = NETWORKS[name](wall_clearance=walls)
        network.normaliser.acceleration_std.fill_(0.01)
        for result in simulate_scenes(Simulator(network, 60.0, backend), scenes, 12):
            path_TN3 = result.position_TN3.astype(np.float64)
            if walls is None:
                assert ((path_TN3 < 0) | (path_TN3 > DOMAIN)).any()
                continue
            assert result.cause is None and path_TN3.shape == (12, 40, 3)
            assert (path_TN3 >= WALLS[0] - 1e-7).all() and (path_TN3 <= np.subtract(DOMAIN, WALLS[1]) + 1e-7).all()
