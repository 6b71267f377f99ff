"""Symmetry augmentation on backend triton against the plain one."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from kernels.cases import flat
from kernels.engines import device
from kernels.test_pushforward import let_move, placed, with_parameters
from kernels.test_training import without_jitter
from kernels.test_update import HISTORY, parameters_of, updates_of
from network.states import network_of
from training.test_symmetry import ALL_48, CELL_SIZE, EIGHT, doubled, scene_with_obstacles, seeds_of

from hgn.config import TrainingConfig
from hgn.data.batch import make_batch
from hgn.data.episode_tensors import EpisodeChunk, whole_episode
from hgn.data.sampler import Sample, SamplerState
from hgn.network.relative import STEPS_AHEAD
from hgn.runtime.parity import relative_error
from hgn.scene.material import ELASTIC, MATERIALS
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.training.symmetry import under_symmetries
from hgn.training.triton_updates import TritonUpdates
from hgn.training.updates import TrainedNetwork

pytestmark = pytest.mark.usefixtures("large_tiles")

FRAME, OWN = 6, ("friction", "parameters", "elastic")


def small_network():
    return network_of(width=16, levels=1, message_passing_steps=1, cell_size=0.1)


@pytest.mark.parametrize(("own_physics", "distance"), [((), False), (OWN, True), (("friction", "moving"), False)])
def test_an_update_under_symmetries_is_the_plain_one(own_physics, distance, monkeypatch):
    """An update of eight scenes, each under another of the cube's symmetries, which turn gravity and the walls'
    friction, one without obstacles, one without gravity, two with parameters of their own, four elastic: positions,
    velocities, targets, normals, loss and gradients are those of backend torch in float64, and the check passes."""
    network = network_of(
        width=16,
        levels=1,
        message_passing_steps=1,
        cell_size=0.1,
        inputs="relative",
        own_physics=own_physics,
        obstacle_distance=distance,
        materials=MATERIALS,
    )
    episodes = [scene_with_obstacles(i, 2 + i % 3 + 4 * bool(own_physics), 20_000) for i in range(8)]
    if "elastic" in own_physics:
        episodes[::2] = [replace(made, material_N=np.full_like(made.material_N, ELASTIC)) for made in episodes[::2]]
    bare = ObstacleGrid(CELL_SIZE, np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
    episodes[2] = replace(episodes[2], obstacle_grid=bare)
    episodes[0] = replace(episodes[0], gravity=(0.0, 0.0, 0.0))
    episodes[3:5] = [with_parameters(made) for made in episodes[3:5]]
    if "moving" in own_physics:
        let_move(monkeypatch, episodes, [1, 2, 0, 0, 1, 2, 0, 1])
    shown = [*ALL_48[1::6]]
    seeds = seeds_of(shown, ALL_48)
    batch = under_symmetries(doubled(make_batch([(e, FRAME) for e in episodes], network.config, seeds)), shown)
    state = batch.state()
    target = network.target(batch.acceleration(), batch.gravity_S3[batch.scene_N])
    loss = batch.mean_over_scenes((network.normalised_acceleration(state) - target).square().mean(-1))
    expected = flat(list(torch.autograd.grad(loss, list(network.parameters()))))

    trained = copy.deepcopy(network).float().to(device())
    training = TrainingConfig(batch_scenes=8, noise_std=0.0, symmetry="gravity", precision="fp32")
    loss_sum, counters = torch.zeros(2, device=device()), torch.zeros(5, device=device())
    without_jitter(monkeypatch)
    parts = TrainedNetwork(trained, torch.optim.Adam(trained.parameters()), loss_sum, counters)
    fast = TritonUpdates(parts, training, CELL_SIZE)
    samples = tuple(Sample(i, FRAME, seed) for i, seed in enumerate(seeds))
    wholes = {i: whole_episode(made, network.config) for i, made in enumerate(episodes)}
    fast.run(EpisodeChunk((samples,), wholes, SamplerState()), 0)
    updates, count = fast.updates, len(state.position_N3)
    width = 3 * HISTORY + 9
    assert fast.parity is not None and max(fast.parity) < 1e-3
    if "elastic" in own_physics:
        assert torch.equal(updates.buffers.wall_friction_S3.cpu(), state.wall_friction_S3.float())
        assert torch.equal(updates.buffers.parameter_NP[:count, :7].cpu(), state.parameter_NP)
    near = {"rtol": 0, "atol": 1e-7}
    torch.testing.assert_close(updates.buffers.position_N3[:count].cpu().double(), state.position_N3, **near)
    torch.testing.assert_close(
        updates.buffers.velocity_NV[:count].cpu().double(), state.velocity_NM3.flatten(1), **near
    )
    torch.testing.assert_close(updates.target_N3[:count].cpu().double(), target, rtol=0, atol=1e-4)
    assert state.obstacles is not None
    normal = state.obstacles.normals(state.position_N3, state.scene_N)
    assert normal.abs().sum(-1).gt(0).sum() > 10
    if state.moving is not None:
        at_rest_N3, place = normal, (state.position_N3, state.velocity_NM3[:, 0], state.scene_N)
        normal = state.moving.met(state.obstacles, place, STEPS_AHEAD)[0][:, :3]
        assert float((at_rest_N3 - normal).abs().amax(-1).gt(0.01).float().mean()) > 0.1
    seen_N3 = updates.grid.feature_NF[:count, width : width + 3].cpu().double()
    rounding = 1e-5 if distance else 0.0 if state.moving is None else 1e-6
    torch.testing.assert_close(seen_N3, normal, rtol=0, atol=rounding)
    assert float(loss_sum[0]) == pytest.approx(float(loss.detach()), rel=1e-5)
    found = [torch.zeros_like(parameter) for parameter in network.parameters()]
    updates.packed.scatter(updates.fused.totals[: updates.packed.size].cpu(), found)
    # differences of velocities have the rounding of positions in float32
    assert relative_error(flat(found), expected) < 1e-3
    fast.run(EpisodeChunk((samples[1:] + samples[:1], samples), wholes, SamplerState()), 1)  # another update before it
    again_N3 = updates.grid.feature_NF[:count, width : width + 3].cpu().double()
    torch.testing.assert_close(again_N3, seen_N3, rtol=0, atol=rounding)


def test_without_symmetry_nothing_changes():
    """With noise and jitter, an update under identities equals the one without symmetries, bitwise in the network's
    inputs. On a CPU its results are bitwise equal too; a GPU adds in another order each time."""
    network = small_network()
    seen, ends = [], []
    for symmetry, known in (("none", EIGHT), ("gravity", EIGHT[:1])):
        made = replace(placed(scene_with_obstacles(1, 5), network), symmetries=known)
        updates = updates_of(network, 1, (256,), noise_std=1e-3, jitter=True, symmetry=symmetry)
        updates.run([[(made, FRAME, 3)]], [1e-3])
        count = made.position_TN3.shape[1]
        seen.append(
            [
                rows[:count].cpu()
                for rows in (updates.buffers.position_N3, updates.buffers.velocity_NV, updates.target_N3)
            ]
        )
        ends.append((parameters_of(updates), updates.loss_sum.cpu(), updates.first_moment.cpu()))
    for found, expected in zip(*seen, strict=True):
        assert torch.equal(found, expected)
    (weights, *sums), (expected_weights, *expected_sums) = ends
    assert device().type == "cuda" or torch.equal(weights, expected_weights)
    for found, expected in zip(sums, expected_sums, strict=True):
        assert torch.equal(found, expected) if device().type == "cpu" else relative_error(found, expected) < 1e-4


def test_noise_and_jitter_are_those_without():
    """A sample's noise and grid origin are drawn in the image: they do not depend on the symmetry."""
    network = small_network()
    made = replace(placed(scene_with_obstacles(1, 5), network), obstacles=None)
    drawn = []
    for known in (EIGHT[:1], EIGHT[6:7]):
        noise = []
        for noise_std in (1e-3, 0.0):
            updates = updates_of(network, 1, (256,), noise_std=noise_std, jitter=True, symmetry="gravity")
            updates.predict([(replace(made, symmetries=known), FRAME, 3)])
            noise.append((updates.buffers.velocity_NV[:5].cpu().clone(), updates.buffers.origin_S3.cpu().clone()))
        drawn.append((noise[0][0] - noise[1][0], noise[0][1]))
    torch.testing.assert_close(drawn[0][0], drawn[1][0], rtol=0, atol=1e-9)
    assert torch.equal(drawn[0][1], drawn[1][1]) and drawn[0][0].std() > 1e-4
