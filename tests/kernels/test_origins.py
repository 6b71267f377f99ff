"""Tests the grid origins of simulations: a new one in each frame, the same on all backends."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from kernels.engines import device
from network.states import network_of
from runtime.scenes import random_scene

from hgn.kernels.step.kernel import SCENE_BLOCK, advance
from hgn.network.origins import frame_origin
from hgn.runtime import triton_stepper
from hgn.runtime.live import LiveSimulation
from hgn.runtime.simulation import Entry
from hgn.runtime.simulator import Simulator
from hgn.runtime.triton_stepper import TritonStepper
from hgn.step.reference import accelerations, advanced

BACKENDS = ("torch", "cpu", "triton") if device().type == "cpu" else ("torch", "triton")
SAME = 0 if device().type == "cpu" else 2e-6  # on a GPU the order of sums changes
ROOT = 1.22074408460575947536  # of x^4 = x + 1
scene = partial(random_scene, domain_size=(0.4, 0.4, 0.4))
pytestmark = pytest.mark.usefixtures("large_tiles")


@pytest.fixture(autouse=True)
def unchecked(monkeypatch):
    """Leaves out the check of a simulation's first output, which takes as long as a frame."""
    if device().type == "cpu":
        monkeypatch.setattr(TritonStepper, "require_parity", lambda *_: None)


def simulator_of(backend, **changes):
    """A simulator whose accelerations are large, so that another origin changes the next positions."""
    network = network_of(torch.float32, width=16, levels=2, message_passing_steps=1, inputs="relative", **changes)
    network.normaliser.acceleration_std.fill_(0.01)
    return Simulator(network.to(device()), 60.0, backend, "fp32")


def bits(value):
    return value.cpu().view(torch.int32).tolist()


def expected_path(network, state, frames, moving=True):
    """Positions [T, N, 3] of the next frames of the plain loop, with origins and images of its frames, or without."""
    path = []
    for _ in range(frames):
        origin_S3 = None if moving else torch.zeros_like(state.domain_S3)
        acceleration_N3 = accelerations(network, state, network.prediction(state, origin_S3))
        state = advanced(state, acceleration_N3.detach(), network.step, network.config.dimensions)
        path.append(state.position_N3)
    return torch.stack(path).cpu().numpy()


def test_origins_fill_a_cell():
    """Origins are those of the R3 sequence and lie in (-R, 0]; frame 0 has the origin 0. Of 4,096 frames each 64th
    part of a cell, a cube, has 54 to 74 (random ones 40 to 90). The unused axis of a plane keeps 0."""
    frame_S = torch.arange(4096)
    origin_S3 = frame_origin(frame_S, 0.035, 3)
    assert origin_S3.dtype == torch.float32 and not origin_S3[0].any()
    assert float(origin_S3.max()) <= 0 and float(origin_S3.min()) > -0.035
    place_S3 = frame_S.numpy()[:, None] / ROOT ** np.arange(1, 4) % 1
    np.testing.assert_allclose(origin_S3 / -0.035, place_S3, rtol=0, atol=3e-6)
    cube_S3 = (origin_S3 / -0.035 * 4).long()
    counts = torch.bincount(cube_S3 @ torch.tensor([16, 4, 1]), minlength=64)
    assert counts.min() >= 54 and counts.max() <= 74, counts
    plane_S3 = frame_origin(frame_S, 0.035, 2)
    assert torch.equal(plane_S3[:, :2], origin_S3[:, :2]) and not plane_S3[:, 2].any()


@pytest.mark.parametrize("cell_size", [0.035, 1 / 64, 0.1])
@pytest.mark.parametrize("dimensions", [2, 3])
def test_the_kernel_has_the_bits_of_the_reference(cell_size, dimensions):
    """The kernel's next origins have the reference's bits, also of late frames and of more scenes than its block. If a
    frame was not integrated, frames and origins stay."""
    late = [2**24 - 1, 2**24, 2**31 - 2, 2**31 - 1, 2**40]
    frame_S = torch.tensor([*range(SCENE_BLOCK), *late, *range(10**6, 10**6 + SCENE_BLOCK)], device=device())
    expected_S3 = frame_origin(frame_S + 1, cell_size, dimensions)
    for status in (1, 0):
        numbers = [torch.full((1,), x, dtype=torch.int32, device=device()) for x in (status, 0, 5)]
        found_S, origin_S3 = frame_S.clone(), torch.zeros(len(frame_S), 3, device=device())
        advance[(1,)](
            *numbers, frame_of=found_S, origin=origin_S3, scenes=len(frame_S), origin_range=cell_size,
            sign=origin_S3, gravity=origin_S3, image_gravity=origin_S3, DIMENSIONS=dimensions, IMAGES=0,
            OVERLAP=False, num_warps=1,
        )  # fmt: skip
        assert torch.equal(found_S, frame_S + (status == 0)) and int(numbers[2]) == 5 + (status == 0)
        if status:
            assert not origin_S3.any()
        else:
            assert bits(origin_S3[:, :dimensions]) == bits(expected_S3[:, :dimensions])
            assert not origin_S3[:, dimensions:].any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_each_scene_has_the_origins_of_its_frames(backend):
    """Scenes of a batch at different frames move as the plain loop with their origins, and not as with origin 0. In
    two dimensions too. The state at the end has the scenes' frames."""
    for dimensions in (3, 2):
        simulator = simulator_of(backend, dimensions=dimensions)
        scenes = [replace(scene(count, count), dimensions=dimensions) for count in (4, 3, 2)]
        first_S = torch.tensor([0, 7, 2**31 - 1], device=device())
        state = replace(simulator.start(scenes), frame_S=first_S)
        expected_TN3, still_TN3 = (expected_path(simulator.network, state, 3, moving) for moving in (True, False))
        with simulator.simulation(state) as simulation:
            path_TN3, last = simulation.run(3), simulation.state
            if backend == "triton":
                origin_S3 = frame_origin(first_S + 3, simulator.network.config.cell_size, dimensions)
                assert bits(simulation.stepper.buffers.origin_S3) == bits(origin_S3)
        assert torch.equal(last.frame_S, first_S + 3)
        np.testing.assert_allclose(path_TN3, expected_TN3, rtol=0, atol=2e-6)
        assert np.abs(path_TN3 - still_TN3).max() > 1e-4


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_rest_constraint_keeps_the_origin(backend):
    """Networks with the rest constraint have the origin 0 in all frames."""
    simulator = simulator_of(backend, rest_threshold=0.1)
    state = replace(simulator.start([scene(4)]), frame_S=torch.tensor([7], device=device()))
    still_TN3, moving_TN3 = (expected_path(simulator.network, state, 2, moving) for moving in (False, True))
    np.testing.assert_allclose(still_TN3, moving_TN3, rtol=0, atol=SAME)
    with simulator.simulation(state) as simulation:
        np.testing.assert_allclose(simulation.run(2), still_TN3, rtol=0, atol=2e-6)
        if backend == "triton":
            assert not simulation.stepper.buffers.origin_S3.any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_scenes_that_change_continue_with_their_frames(backend):
    """Scenes of a batch that start, are reset or go back to an earlier frame equal each alone. Changes of obstacles or
    gravity and particles that enter continue with the frames. So do particles that enter from the start on."""
    simulator, first, second = simulator_of(backend), scene(4), scene(3, 1)
    close = partial(np.testing.assert_allclose, rtol=0, atol=2e-6)
    (alone_TN3,) = simulator.rollout([second], 5)
    with LiveSimulation(simulator, [first, first], capacity=12) as live:
        live.step()
        live.reset(1, second)
        assert live.frames == (1, 0)
        path = [live.step()[4:] for _ in range(2)]
        state = live.state
        close(path, alone_TN3[1:3])
        live.set_gravity(second.gravity, 1)
        live.step()
        assert live.frames == (4, 3)
        here_N = state.scene_N == 1
        live.restore(state.position_N3[here_N].cpu().numpy(), state.velocity_NM3[here_N].cpu().numpy(), 2, 1)
        assert live.frames == (4, 2) and live.state.frame_S.tolist() == [4, 2]
        close([live.step()[4:] for _ in range(2)], alone_TN3[3:])
        live.frame = 9
        assert live.frames == (9, 9) and live.advance().frame_S.tolist() == [10, 10]
    start = simulator.start([first])
    with simulator.simulation(start, entries=[Entry(2, simulator.start([second]))]) as simulation:
        simulation.run(3)
        entered = simulation.state
        expected_TN3 = expected_path(simulator.network, entered, 1)
        close(simulation.run(1), expected_TN3)
    assert entered.frame_S.tolist() == [3] and len(entered.position_N3) == 7


def test_growing_buffers_repeat_no_origin(monkeypatch):
    """If the grid needs more memory within a block, the frame that lacked it is computed with its own origin."""
    monkeypatch.setattr(triton_stepper, "BLOCK_FRAMES", 8)
    simulator = simulator_of("triton")
    state = simulator.start([scene(5), scene(4, 1)])
    expected_TN3 = expected_path(simulator.network, state, 4)
    stepper = TritonStepper(simulator.network, state, "fp32", (16, 16))
    stepper._build((16, 16))
    path_TN3 = np.concatenate([block_TN3.cpu().numpy().copy() for block_TN3, _ in stepper.blocks(4)])
    assert stepper.growths > 0 and stepper.buffers.frame_S.tolist() == [4, 4]
    np.testing.assert_allclose(path_TN3, expected_TN3, rtol=0, atol=2e-6)


def test_one_step_on_data_has_the_origin_0():
    """A state that no simulation computed is at frame 0, whose origin is 0: errors of one step do not depend on it."""
    simulator = simulator_of("torch")
    state, zero_S3 = simulator.start([scene(4), scene(3)]), torch.zeros(2, 3, device=device())
    outputs = [simulator.network.prediction(state, origin).acceleration_N3 for origin in (None, zero_S3)]
    assert state.frame_S.tolist() == [0, 0]
    torch.testing.assert_close(*outputs, rtol=0, atol=10 * SAME)
    assert simulator.step(simulator.step(state)).frame_S.tolist() == [2, 2]
