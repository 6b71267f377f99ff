"""Walls that nothing passes (`network.wall_clearance`): what is held, what is free, and what has still come apart."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from network.states import gns_of, network_of, random_state, silent
from runtime.scenes import random_scene

from hgn.network.features import ParticleState
from hgn.runtime.divergence import DivergedError
from hgn.runtime.rollouts import simulate_scenes
from hgn.runtime.simulator import Simulator
from hgn.step.reference import advanced
from hgn.step_config import StepConfig

WALLS = (0.03, 0.05)  # near sides, far sides
DOMAIN = (1.0, 0.8, 0.6)
NETWORKS = {
    "absolute": lambda **changes: network_of(torch.float32, levels=2, **changes),
    "relative": lambda **changes: network_of(torch.float32, levels=2, inputs="relative", **changes),
    "gns": lambda **changes: gns_of(torch.float32, **changes),
}


def moved(x, velocity, size=1.0, acceleration=0.0, axis=0, dtype=torch.float64, **changes):
    """Position and velocity of a lone particle a frame later, on one axis; the others are in the domain's middle."""
    position_N3, velocity_NM3 = torch.full((1, 3), 0.5, dtype=dtype), torch.zeros(1, 5, 3, dtype=dtype)
    domain_S3, acceleration_N3 = torch.ones(1, 3, dtype=dtype), torch.zeros(1, 3, dtype=dtype)
    position_N3[0, axis], velocity_NM3[0, 0, axis], domain_S3[0, axis] = x, velocity, size
    acceleration_N3[0, axis] = acceleration
    nothing = torch.zeros(1, dtype=torch.int64)
    state = ParticleState(position_N3, velocity_NM3, nothing, nothing, domain_S3, torch.zeros_like(domain_S3), None)
    dimensions = changes.pop("dimensions", 3)
    after = advanced(state, acceleration_N3, StepConfig(**changes), dimensions)
    others = [i for i in range(3) if i != axis]
    assert (
        torch.equal(after.position_N3[:, others], position_N3[:, others]) and not after.velocity_NM3[:, 0, others].any()
    )
    return float(after.position_N3[0, axis]), float(after.velocity_NM3[0, 0, axis])


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ((0.5, 0.01), (0.51, 0.01)),
        ((0.04, -0.02), (0.03, -0.01)),  # arrives, as far as the wall
        ((0.03, -0.02), (0.03, 0.0)),
        ((0.03, 0.02), (0.05, 0.02)),
        ((0.94, 0.02), (0.95, 0.01)),
        ((0.01, -0.005), (0.01, 0.0)),  # begins nearer: stays, or leaves
        ((0.01, 0.005), (0.015, 0.005)),
        ((0.98, 0.5), (0.98, 0.0)),
        ((0.98, -0.1), (0.88, -0.1)),
        ((-0.2, -0.3), (-0.2, 0.0)),  # begins outside
        ((-0.2, 0.1), (-0.1, 0.1)),
        ((0.1, 1.5), (0.95, 0.85)),  # from wall to wall
        ((0.1, 2.0), (2.1, 2.0)),  # farther from the domain than its own size: what has come apart is not held
        ((0.1, -1.5), (-1.4, -1.5)),
    ],
)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_frame_at_a_wall(before, after, axis):
    """Positions go no nearer to a plane than the clearance, or than they were; the velocity is what was moved."""
    assert moved(*before, axis=axis, wall_clearance=WALLS) == pytest.approx(after, rel=0, abs=1e-12)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ((0.02, 0.01), (0.02, 0)),
        ((0.02, -0.01), (0.02, 0)),
        ((0.005, 0.1), (0.01, 0.005)),
        ((0.04, -0.05), (0.03, -0.01)),
    ],
)
def test_no_room_between_walls(before, after):
    """A domain of 0.06 has its near wall at 0.03 and its far one at 0.01: what is between them stays where it is, and
    what is outside comes as far as the first of them."""
    assert moved(*before, size=0.06, wall_clearance=WALLS) == pytest.approx(after, rel=0, abs=1e-12)


@pytest.mark.parametrize("acceleration", [float("nan"), float("inf"), -float("inf")])
def test_what_is_no_number_stays_none(acceleration):
    """No wall makes a number of it."""
    assert not np.isfinite(moved(0.04, 0.0, acceleration=acceleration, wall_clearance=WALLS)).any()


def test_the_third_axis_of_a_plane_has_no_walls():
    """In two dimensions z is that of the plane, however thin the domain is."""
    for axis, held in ((0, True), (1, True), (2, False)):
        x, velocity = moved(0.5, -0.49, axis=axis, wall_clearance=WALLS, dimensions=2)
        assert (x, velocity) == pytest.approx((0.03, -0.47) if held else (0.01, -0.49), rel=0, abs=1e-12)


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


@pytest.mark.parametrize(
    ("name", "backend"), [(name, "torch") for name in NETWORKS] + [("absolute", "cpu"), ("relative", "cpu")]
)
def test_nothing_leaves_the_domain(name, backend):
    """Whatever the weights: of random ones that throw particles about, all are between the walls in every frame, and
    without walls some leave the domain."""
    scenes = [
        random_scene(60, seed, size=0.4, domain_size=DOMAIN, velocity_N3=np.zeros((60, 3), np.float32))
        for seed in (0, 1)
    ]
    paths = {}
    for walls in (None, WALLS):
        network = NETWORKS[name](wall_clearance=walls)
        network.normaliser.acceleration_std.fill_(0.01)
        results = simulate_scenes(Simulator(network, 60.0, backend), scenes, 12)
        paths[walls] = [result.position_TN3.astype(np.float64) for result in results]
        if walls is not None:
            assert [result.cause for result in results] == [None, None]
    outside = [((path_TN3 < 0) | (path_TN3 > DOMAIN)).any() for path_TN3 in paths[None]]
    assert all(outside)
    for path_TN3 in paths[WALLS]:
        assert path_TN3.shape == (12, 60, 3)
        assert (path_TN3 >= WALLS[0] - 1e-7).all() and (path_TN3 <= np.subtract(DOMAIN, WALLS[1]) + 1e-7).all()


def test_what_rests_on_a_wall_leaves_it():
    """A particle that is pressed against the floor lies still, and its velocity is 0: it leaves with the first
    acceleration away from it."""
    network = silent(NETWORKS["relative"](wall_clearance=WALLS))
    scene = random_scene(1, low=0.1, velocity_N3=np.zeros((1, 3), np.float32), gravity=(0.0, -90.0, 0.0))
    simulator = Simulator(network, 60.0, "torch")
    state = simulator.start([scene])
    for _ in range(8):
        state = simulator.step(state)
    assert float(state.position_N3[0, 1]) == pytest.approx(0.03, abs=1e-7) and not state.velocity_NM3[0, 0].any()
    state = simulator.step(replace(state, gravity_S3=torch.tensor([[0.0, 0.01, 0.0]])))
    assert float(state.position_N3[0, 1]) == pytest.approx(0.04, abs=1e-7)


@pytest.mark.parametrize("value", [0.9, -0.9, float("nan"), float("inf")])
def test_divergence_is_seen(value):
    """By what positions would be without walls: a network that makes no numbers, or throws particles farther than the
    domain's own size, ends the simulation at the frame where it would without walls."""
    messages = []
    for walls in (None, WALLS):
        network = silent(NETWORKS["absolute"](wall_clearance=walls))
        network.normaliser.acceleration_mean.copy_(torch.tensor([2.5 * value, 0.0, 0.0]))
        with pytest.raises(DivergedError) as caught:
            Simulator(network, 60.0, "torch").rollout([random_scene(4)], 4)
        messages.append(str(caught.value))
    assert messages[0] == messages[1] and "diverged at frame 1: 4 of 4 particles" in messages[0]
