"""Simulations with moving obstacles on the device against the plain ones; the network's outputs are in test_network."""

import itertools
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch
from kernels.cases import PUSHING, swept
from kernels.engines import device
from kernels.test_pushforward import CELL_SIZE, let_move
from kernels.test_rollout import motion, path_of, scene, thrown
from kernels.test_rollout import unchecked as unchecked
from network.barrier_scenes import crossings
from network.states import network_of
from training.test_symmetry import scene_with_obstacles

from hgn.config import TrainingConfig
from hgn.data.episode_tensors import EpisodeChunk, whole_episode
from hgn.data.sampler import Sample, SamplerState
from hgn.network.moving import poses_of
from hgn.runtime import triton_stepper
from hgn.runtime.parity import ParityError
from hgn.runtime.simulation import Simulation
from hgn.runtime.triton_stepper import TritonStepper
from hgn.step.reference import accelerations, advanced
from hgn.training.triton_updates import TritonUpdates
from hgn.training.updates import TrainedNetwork

pytestmark = pytest.mark.usefixtures("large_tiles")

REQUIRE_PARITY = TritonStepper.require_parity  # which other tests leave out


@pytest.mark.parametrize("clearance", [None, 2e-3])
def test_moving_obstacles(clearance, monkeypatch):
    """Frames of scenes with two, one and no moving obstacles are those of backend torch, over several blocks. The same
    buffers go on with fewer obstacles in another frame, and with none, to the rounding of a GPU's sums."""
    monkeypatch.setattr(triton_stepper, "BLOCK_FRAMES", 2)
    monkeypatch.setattr(triton_stepper, "FEWEST_FRAMES", 2)
    changes = {"inputs": "local", "own_physics": ("friction", "moving"), "wall_clearance": (0.01, 0.01)}
    changes |= {"obstacle_clearance": clearance, "levels": 2, "deviation": 0.01}
    own = [(swept(7), swept(8)), (swept(9),), ()]
    scenes = [scene(count, seed, wall_friction=(0.2, 0.0, 0.1)) for seed, count in enumerate((20, 12, 5))]
    scenes = [replace(each, moving=moving) for each, moving in zip(scenes, own, strict=True)]
    expected_TN3, expected_NM3 = motion(thrown("torch", **changes), scenes, 5)
    fast = thrown("triton", **changes)
    found_TN3, found_NM3 = motion(fast, scenes, 5)
    np.testing.assert_allclose(found_TN3, expected_TN3, rtol=0, atol=5e-6)
    np.testing.assert_allclose(found_NM3, expected_NM3, rtol=0, atol=5e-6)
    still = [replace(each, moving=()) for each in scenes]
    assert abs(motion(thrown("torch", **changes), still, 5)[0] - expected_TN3).max(-1).mean() > 1e-3
    rollout = TritonStepper(fast.network, fast.start(scenes), "fp32")
    path_of(rollout, 3)
    other = fast.start([still[0], scenes[1], still[2]])
    for state in (replace(other, moving=other.moving.at([4] * 3)), fast.start(still)):
        assert rollout.take(state)
        expected = path_of(TritonStepper(fast.network, state, "fp32"), 3)
        np.testing.assert_allclose(path_of(rollout, 3), expected, rtol=0, atol=1e-6)


PUSHED = {"inputs": "local", "own_physics": ("friction", "moving"), "deviation": 1e-3, "obstacle_clearance": 1e-3}
PUSHED_FRAMES = 6


def pushed_scenes():
    """The scenes of PUSHING, one of them without moving obstacles."""
    bare = [scene(count, seed, gravity=(0.0, -2.0, 0.0)) for seed, count in enumerate((40, 12, 50, 60))]
    return [replace(each, moving=own) for each, own in zip(bare, PUSHING.values(), strict=True)]


def path_in_float64(simulator, scenes):
    """Positions [T + 1, N, 3] by PyTorch in float64."""
    network, state = simulator.network.double(), simulator.start(scenes)
    names = ("position_N3", "velocity_NM3", "domain_S3", "gravity_S3")
    state = replace(state, **{name: getattr(state, name).double() for name in names})
    path = [state.position_N3]
    for _ in range(PUSHED_FRAMES):
        with torch.no_grad():
            acceleration_N3 = accelerations(network, state, network.prediction(state))
            state = advanced(state, acceleration_N3, network.step, 3)
        path.append(state.position_N3)
    return torch.stack(path).cpu().numpy()


def passed(path_TN3, scenes):
    """The number of ways that pass an obstacle, for each scene, seen from the obstacle."""
    ends, counts = np.cumsum([len(each.position_N3) for each in scenes]).tolist(), []
    for each, end in zip(scenes, ends, strict=True):
        own_TN3, count = path_TN3[:, end - len(each.position_N3) : end].astype(np.float64), 0
        for body in each.moving:
            poses = [body.motion.transform(frame / 60) for frame in range(len(own_TN3))]
            seen = [(at_N3 - shift) @ turn for at_N3, (turn, shift) in zip(own_TN3, poses, strict=True)]
            count += sum(crossings(*ways, body.corner_F33) for ways in itertools.pairwise(seen))
        counts.append(count)
    return counts


@pytest.mark.parametrize("overlap", [False, True])
def test_moving_barriers(overlap, monkeypatch):
    """Obstacles that translate, rotate, and come from two sides push particles of some scenes of a batch. The frames
    are PyTorch's in float64, over several blocks, and no particle passes an obstacle. With `overlap` blocks start
    before earlier ones are read, and buffers grow. PyTorch's own float32 differs by 8e-8; a pose of another frame by
    1e-3."""
    monkeypatch.setattr(triton_stepper, "BLOCK_FRAMES", 2)
    monkeypatch.setattr(triton_stepper, "FEWEST_FRAMES", 2)
    scenes, simulator = pushed_scenes(), thrown("triton", **PUSHED)
    state = simulator.start(scenes)
    stepper = TritonStepper(simulator.network, state, "fp32", (16,) if overlap else None)
    stepper.overlap = overlap
    found_TN3 = Simulation(lambda _: nullcontext(stepper), state).run(PUSHED_FRAMES)
    assert (stepper.growths > 0) == overlap
    expected_TN3 = path_in_float64(thrown("torch", **PUSHED), scenes)
    np.testing.assert_allclose(found_TN3, expected_TN3[1:], rtol=0, atol=1e-6)
    assert passed(np.concatenate([expected_TN3[:1], found_TN3]), scenes) == [0] * 4
    free_TN3, _ = motion(thrown("torch", **PUSHED | {"obstacle_clearance": None}), scenes, PUSHED_FRAMES)
    assert [count > 10 for count in passed(free_TN3, scenes)] == [bool(each.moving) for each in scenes]


def poses_before(scenes, frames, frame_s):
    return poses_of(scenes, [frame - 1 for frame in frames], frame_s)


def poses_turned_back(scenes, frames, frame_s):
    """Obstacles that move the other way from where they are."""
    poses = poses_of(scenes, frames, frame_s)
    return replace(poses, change_V33=-poses.change_V33, shift_V3=-poses.shift_V3)


def poses_of_others(scenes, frames, frame_s):
    """The poses of the obstacles of each scene in another order."""
    return poses_of([own[::-1] for own in scenes], frames, frame_s)


def poses_of_the_end(scenes, frames, frame_s):
    """Obstacles that have already moved."""
    return poses_of(scenes, frames, frame_s).later


BROKEN = [poses_before, poses_turned_back, poses_of_the_end, poses_of_others]


@pytest.mark.parametrize(("inputs", "broken"), [*itertools.product([False], BROKEN), *((True, x) for x in BROKEN[:3])])
def test_wrong_poses_are_refused(inputs, broken, monkeypatch):
    """At the start of a simulation: by the network's output where it sees moving obstacles, and by where ways end at
    them, also if no particle is near one in the first frame. Right ones pass."""
    scenes = pushed_scenes()
    fast = thrown("triton", **PUSHED, obstacle_features=inputs)
    if not inputs:
        scenes = [replace(each, position_N3=each.position_N3 + np.float32(0.2)) for each in scenes]
    state = fast.start([scenes[3], scenes[1], scenes[2]])
    REQUIRE_PARITY(TritonStepper(fast.network, state, "fp32"), fast.network, state)
    monkeypatch.setattr("hgn.kernels.moving.poses_of", broken)
    stepper = TritonStepper(fast.network, state, "fp32")
    with pytest.raises(ParityError, match="outputs differ" if inputs else "shifts at moving obstacles differ"):
        REQUIRE_PARITY(stepper, fast.network, state)


@pytest.mark.parametrize("broken", BROKEN[:3])
def test_wrong_poses_train_nothing(broken, monkeypatch):
    """The first batch of a training is refused; that of right poses passes in test_symmetry."""
    changes = {"inputs": "relative", "own_physics": ("friction", "moving")}
    network = network_of(torch.float32, width=16, levels=1, message_passing_steps=1, **changes).to(device())
    episodes = [scene_with_obstacles(i, 6, 20_000) for i in range(2)]
    let_move(monkeypatch, episodes, [2, 1])
    monkeypatch.setattr("hgn.kernels.moving.poses_of", broken)
    loss_sum, counters = torch.zeros(2, device=device()), torch.zeros(5, device=device())
    parts = TrainedNetwork(network, torch.optim.Adam(network.parameters()), loss_sum, counters)
    training = TrainingConfig(batch_scenes=2, noise_std=0.0, symmetry="gravity", precision="fp32")
    fast = TritonUpdates(parts, training, CELL_SIZE)
    wholes = {i: whole_episode(made, network.config) for i, made in enumerate(episodes)}
    chunk = EpisodeChunk((tuple(Sample(i, 6, i) for i in range(2)),), wholes, SamplerState())
    with pytest.raises(ParityError, match="outputs differ"):
        fast.run(chunk, 0)
