"""Training updates on the device against the reference network under torch's Adam."""

import copy
import math
from dataclasses import replace

import pytest
import torch
from kernels.engines import device
from network.states import GRAVITY, network_of, random_grid

from hgn.config import TrainingConfig
from hgn.data.episode_tensors import EpisodeTensors
from hgn.kernels.scene_tables import SceneHash
from hgn.kernels.update.op import DeviceEpisode, DeviceSample, Updates
from hgn.network.features import ParticleState
from hgn.network.obstacles import ObstacleCells
from hgn.network.orthogonal import orthogonalised
from hgn.schema import ConfigError
from hgn.training.muon import Muon
from hgn.training.parity import require_update_parity

pytestmark = pytest.mark.usefixtures("large_tiles")

HISTORY = 5
CELL_SIZE = 1 / 64


def episode(seed, particles, obstacles, spread=0.12):
    """Particles that move at random, and the grids that the reference network asks for the same obstacles."""
    generator = torch.Generator().manual_seed(seed)
    start = torch.rand(1, particles, 3, generator=generator) * spread + 0.2
    position = start + (torch.randn(HISTORY + 4, particles, 3, generator=generator) * 1e-3).cumsum(0)
    grid = random_grid(seed, 4_000)
    made = DeviceEpisode(
        position.to(device()),
        torch.randint(0, 3, (particles,), generator=generator, dtype=torch.int32).to(device()),
        SceneHash.of_grid(grid).to(device()) if obstacles else None,
        (1.0, 1.0, 1.0),
    )
    return made, [grid] if obstacles else []


def one_with_obstacles():
    """A sample of each of two episodes, one among obstacles, and the same episodes as the parity check takes them."""
    made, grids = episode(1, 5, True)
    still, _ = episode(2, 3, False)
    none = replace(grids[0], cell_K3=grids[0].cell_K3[:0], normal_K3=grids[0].normal_K3[:0])
    episodes = [
        EpisodeTensors(each.position_TN3, each.material_N, grid, each.domain_size, (0.0, 0.0, 0.0))
        for each, grid in ((made, grids[0]), (still, none))
    ]
    return [(made, 1, 3), (still, 0, 4)], episodes


def plain_updates(network, chunk, grids, rates, optimizer=None):
    """The same with autograd and torch's Adam (or `optimizer`), without noise and jitter; the losses."""
    optimizer = optimizer or torch.optim.Adam(network.parameters(), lr=1.0)
    losses = []
    for samples, obstacles, rate in zip(chunk, grids, rates, strict=True):
        loss = torch.zeros((), dtype=torch.float64)
        for (made, frame, _, *weight), grid in zip(samples, obstacles, strict=True):
            window = made.position_TN3[frame : frame + HISTORY + 2].cpu().double()
            velocity = (window[1:-1] - window[:-2]).flip(0).transpose(0, 1)
            state = ParticleState(
                window[-2],
                velocity,
                made.material_N.cpu().long(),
                torch.zeros(made.particles, dtype=torch.long),
                torch.ones(1, 3, dtype=torch.float64),
                torch.zeros(1, 3, dtype=torch.float64),
                ObstacleCells.of(grid) if grid else None,
            )
            acceleration = (window[-1] - window[-2]) - (window[-2] - window[-3])
            target = network.normaliser.normalise_acceleration(acceleration)
            error = network.normalised_acceleration(state) - target
            loss = loss + error.square().mean() * math.prod(weight) / len(samples)
        losses.append(float(loss.detach()))
        optimizer.zero_grad()
        loss.backward()
        optimizer.param_groups[0]["lr"] = rate
        optimizer.step()
    return losses


def updates_of(network, scenes, capacities=(), precision="fp32", jitter=False, **changes):
    settings = {"noise_std": 0.0, "noise_correlated_fraction": 0.0} | changes
    updates = Updates(
        copy.deepcopy(network).float().to(device()),
        TrainingConfig(batch_scenes=scenes, **settings),
        CELL_SIZE,
        precision,
        torch.zeros(2, device=device()),
        torch.zeros(5, device=device()),
        capacities=capacities,
    )
    updates.jitter = jitter
    return updates


def parameters_of(updates):
    found = [torch.zeros_like(p) for p in updates.network.parameters()]
    updates.packed.scatter(updates.values, found)
    return torch.cat([tensor.flatten() for tensor in found]).cpu().double()


@pytest.mark.parametrize(
    ("optimizer", "directions", "levels"),
    [("adam", torch.float32, 2), ("muon", torch.float32, 1), ("muon", torch.bfloat16, 1)],
)
def test_updates_are_those_of_torch(optimizer, directions, levels, monkeypatch):
    """Two updates of two scenes, with and without obstacles, at different rates, weighted:
    losses and parameters are those of autograd in float64 with torch's Adam or with Muon; an update that needs more
    room than there is gets it, and is repeated. With Muon's directions in bfloat16, as a GPU makes them, parameters are
    at most twice as far away as bfloat16 alone takes autograd's."""
    monkeypatch.setattr("hgn.kernels.muon.op.direction_dtype", lambda _: directions)
    network = network_of(width=16, levels=levels, message_passing_steps=1, cell_size=0.1)
    small, grid = episode(1, 5, True)
    open_space, none = episode(2, 3, False)
    wide, other = episode(3, 5, True, spread=0.6)
    chunk = [[(small, 0, 1, 0.3), (open_space, 1, 2)], [(wide, 2, 3), (open_space, 0, 4, 1.7)]]
    rates = [1e-3, 3e-4]
    updates = updates_of(network, 2, capacities=(32, 16)[:levels], optimizer=optimizer)
    updates.run(chunk, rates)
    assert updates.growths >= 1
    reference = copy.deepcopy(network)
    muon = Muon(reference, 1.0) if optimizer == "muon" else None
    grids = [[grid, none], [other, none]]
    losses = plain_updates(reference, chunk, grids, rates, muon)
    total, count = updates.loss_sum.tolist()
    assert count == 2 and total == pytest.approx(sum(losses), rel=1e-5 if directions is torch.float32 else 1e-3)
    expected = torch.cat([p.detach().flatten() for p in reference.parameters()])
    before = torch.cat([p.detach().flatten() for p in network.parameters()])
    moved = (expected - before).norm()
    bound = 1e-3
    if directions is torch.bfloat16:
        rough = copy.deepcopy(network)
        monkeypatch.setattr("hgn.training.muon.orthogonalised", lambda m: orthogonalised(m.to(directions)).to(m))
        plain_updates(rough, chunk, grids, rates, Muon(rough, 1.0))
        bound = 2 * float((torch.cat([p.detach().flatten() for p in rough.parameters()]) - expected).norm() / moved)
    assert float((parameters_of(updates) - expected).norm() / moved) < bound < 0.2
    assert int(updates.step) == 2 and updates.counters[1] == 2 and updates.counters[2] == 0


def assembled(updates, *samples, room=512):
    """Draws these samples' noise and origins, without an update: velocities [N, HISTORY, 3], newest first."""
    updates._upload([samples], [1e-3])
    count = sum(sample[0].particles for sample in samples)
    if updates.particles == 0:
        updates.particles, updates.capacities = 16 * math.ceil(count / 16), (room,)
        updates._corners = (torch.zeros(3), torch.ones(3))
        updates._build()
    updates._assemble()
    return updates.buffers.velocity_NV[:count].cpu().view(count, HISTORY, 3)


def clean(made, frame):
    """An episode's positions up to a frame's window and behind, and its velocities, newest first, without noise."""
    window_WN3 = made.position_TN3[frame : frame + HISTORY + 2].cpu()
    return window_WN3, (window_WN3[1:-1] - window_WN3[:-2]).flip(0).transpose(0, 1)


def test_noise_and_jitter():
    """Noise is a random walk whose last step has the asked standard deviation, positions follow the velocities, the
    target undoes the velocity error; origins lie in [-cell, 0]; the same seed draws the same, another seed another."""
    network = network_of(width=16, levels=1, message_passing_steps=1, cell_size=0.1)
    made, still = (episode(seed, count, False, spread=0.3)[0] for seed, count in ((1, 160), (2, 120)))
    updates = updates_of(network, 2, noise_std=1e-3, jitter=True)
    names = ("position_N3", "velocity_NV", "target_N3", "origin_S3", "loss_weight_N", "scene_N")
    drawn = []
    for seeds in ((5, 6), (5, 6), (7, 6)):
        assembled(updates, (made, 1, seeds[0]), (still, 0, seeds[1]))
        found = vars(updates) | vars(updates.buffers)
        drawn.append({name: found[name].cpu().clone() for name in names})
    first, again, other = drawn
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert torch.equal(first["position_N3"][160:280], other["position_N3"][160:280])
    assert not torch.equal(first["position_N3"][:160], other["position_N3"][:160])
    torch.testing.assert_close(first["loss_weight_N"][:280], torch.tensor([1 / 320] * 160 + [1 / 240] * 120))
    assert first["scene_N"][:280].tolist() == [0] * 160 + [1] * 120
    assert ((first["origin_S3"] <= 0) & (first["origin_S3"] >= -0.1)).all() and first["origin_S3"].unique().numel() == 6
    window, velocity = clean(made, 1)
    walk = first["velocity_NV"][:160].view(160, HISTORY, 3) - velocity
    assert walk[:, 0].std() == pytest.approx(1e-3, rel=0.1)
    assert walk[:, -1].std() == pytest.approx(1e-3 / HISTORY**0.5, rel=0.1)
    moved = first["position_N3"][:160] - window[-2]
    torch.testing.assert_close(moved, walk.sum(1), rtol=0, atol=1e-6)
    wanted = (window[-1] - window[-2]) - first["velocity_NV"][:160, :3]
    expected = network.float().normaliser.normalise_acceleration(wanted)
    torch.testing.assert_close(first["target_N3"][:160], expected, rtol=0, atol=1e-3)
    assembled(updates, DeviceSample(made, 1, 5, 4.0), DeviceSample(still, 0, 6))
    torch.testing.assert_close(updates.loss_weight_N[:280].cpu(), torch.tensor([4 / 320] * 160 + [1 / 240] * 120))


def test_a_flat_network_is_shown_no_noise_across():
    """With two dimensions z and its velocities are the data's bit by bit, and the grid does not move along it."""
    network = network_of(width=16, levels=1, message_passing_steps=1, cell_size=0.1, dimensions=2)
    made, _ = episode(1, 64, False, spread=0.3)
    updates = updates_of(network, 1, noise_std=1e-3, jitter=True, noise_correlated_fraction=0.3)
    step_N3 = (assembled(updates, (made, 1, 5)) - clean(made, 1)[1])[:, 0]
    assert not step_N3[:, 2].any() and step_N3[:, :2].all()
    assert torch.equal(updates.buffers.position_N3[:64, 2].cpu(), clean(made, 1)[0][-2, :, 2])
    assert updates.buffers.origin_S3[0, 2] == 0 and (updates.buffers.origin_S3[0, :2] < 0).all()


def test_correlated_noise():
    """With noise_correlated_fraction=1 a scene gets the sum of its waves for noise, as in backend torch, of the asked
    spread; other scenes have other waves; half of the variance leaves the other half to each particle."""
    network = network_of(width=16, levels=1, message_passing_steps=1, cell_size=0.01)
    made, still = (episode(seed, count, False, spread=0.3)[0] for seed, count in ((1, 160), (2, 120)))
    samples, windows = ((made, 1, 5), (still, 0, 6)), (clean(made, 1), clean(still, 0))
    velocity, walks = torch.cat([velocity for _, velocity in windows]), {}
    for smooth in (0.0, 0.5, 1.0):
        updates = updates_of(network, 2, noise_std=1e-3, jitter=False, noise_correlated_fraction=smooth)
        walks[smooth] = assembled(updates, *samples, room=4096) - velocity
    waves = updates.waves_SKC.cpu()
    length = 2 * math.pi / waves[..., :3].norm(dim=-1) / 0.01
    assert 4 <= float(length.min()) < 8 and 32 < float(length.max()) <= 64.01
    assert not torch.isclose(waves[0], waves[1]).any()
    expected = []
    for (window, _), wave in zip(windows, waves, strict=True):
        height_NK = torch.cos(window[-2] @ wave[:, :3].T + wave[:, 3])
        expected.append((height_NK @ wave[:, 4:]).view(-1, HISTORY, 3).cumsum(1).flip(1))
    torch.testing.assert_close(walks[1.0], torch.cat(expected), rtol=0, atol=2e-6)
    assert 3e-4 < float(walks[1.0][:, 0].std()) < 3e-3
    torch.testing.assert_close(walks[0.5], (walks[0.0] + walks[1.0]) / 2**0.5, rtol=0, atol=2e-6)


def test_wrong_kernels_are_refused():
    """Before the first update outputs and gradients are compared with the reference's on the noisy, jittered batch:
    they agree to rounding, and kernels that compute another network are refused with the remedy."""
    network = network_of(width=16, levels=1, message_passing_steps=1, cell_size=0.1)
    samples, episodes = one_with_obstacles()
    updates = updates_of(network, 2, (64,), noise_std=1e-3, jitter=True)
    updates.predict(samples)
    assert max(require_update_parity(updates, episodes)) < 1e-3
    updates.values.mul_(1.3)
    updates.fused.refresh()
    updates.predict(samples)
    with pytest.raises(ConfigError, match=r"must be torch on this machine.*set training.backend=torch"):
        require_update_parity(updates, episodes)


def test_a_wrong_gradient_of_any_tensor_is_refused(monkeypatch):
    """The gradient of each tensor is compared by itself: one that is 0 or has the wrong sign is refused, although most
    tensors have a small part of all gradients. All of them off by a fifth are refused too, as rounding changes them
    less. With fp16 kernels that are right pass."""
    network = network_of(width=16, levels=1, message_passing_steps=1, cell_size=0.1)
    samples, episodes = one_with_obstacles()
    updates = updates_of(network, 2, (64,), precision="fp16", noise_std=1e-3, jitter=True)
    updates.predict(samples)
    assert max(require_update_parity(updates, episodes)) < 0.1
    totals, right = updates.fused.totals, updates.fused.totals.clone()
    monkeypatch.setattr(updates.fused, "backward", lambda: None)  # `totals` has the gradients already
    totals.mul_(0.8)
    with pytest.raises(ConfigError, match="its gradients differ"):
        require_update_parity(updates, episodes)
    index, end = updates.packed.index.to(totals.device), 0
    for parameter in updates.network.parameters():
        begin, end = end, end + parameter.numel()
        for factor in (0, -1):
            totals.copy_(right)
            totals[: updates.packed.size][(begin <= index) & (index < end)] *= factor
            with pytest.raises(ConfigError, match=r"must be tf32 on this machine.*its gradients differ"):
                require_update_parity(updates, episodes)


def sliding(seed):
    """A body that slides on a rough floor at constant speed, hardly deformed, as kernels and the check take it."""
    generator = torch.Generator().manual_seed(seed)
    size_3, low_3 = torch.tensor([[0.3, 0.04, 0.3], [0.2, 0.03, 0.2]])
    place_N3 = torch.rand(1, 24, 3, generator=generator) * size_3 + low_3
    angle, age_T11 = 2 * math.pi * torch.rand((), generator=generator), torch.arange(HISTORY + 4)[:, None, None]
    shift_T13 = 3e-3 * age_T11 * torch.stack([angle.cos(), torch.zeros(()), angle.sin()])
    position_TN3 = place_N3 + shift_T13 + 1e-5 * torch.randn(HISTORY + 4, 24, 3, generator=generator)
    material_N, scene = torch.zeros(24, dtype=torch.int32), {"gravity": GRAVITY, "wall_friction": (0.7, 0.7, 0.7)}
    made = DeviceEpisode(position_TN3.to(device()), material_N.to(device()), None, (1.0, 1.0, 1.0), **scene)
    return made, EpisodeTensors(position_TN3, material_N, random_grid(0, 0), (1.0, 1.0, 1.0), **scene)


def test_friction_that_rounding_switches(monkeypatch):
    """Rounding to 11 bits decides on which side of a jump the gradient of friction is: right kernels pass. A backward
    pass without the derivatives of friction, or without any one direction of edges, is refused."""
    changes = {"inputs": "local", "own_physics": ("friction",), "obstacle_features": False}
    network = network_of(width=16, levels=1, message_passing_steps=1, cell_size=0.07, **changes)
    with torch.no_grad():
        network.decode.second.weight.mul_(0.1)
        network.decode.second.bias.mul_(0.1)
    made, episodes = zip(sliding(1300), sliding(1301), strict=True)
    updates = updates_of(network, 2, (256,), precision="fp16")

    def errors(damage):
        updates.predict([(each, 0, 1) for each in made])
        backward = updates.fused.backward
        with monkeypatch.context() as patch:
            patch.setattr(updates.fused, "backward", lambda: (damage(updates.fused.grid), backward()))
            return require_update_parity(updates, episodes)

    assert max(errors(lambda _: None)) < 0.1
    faults = [lambda grid: grid.friction_fraction_C[:, 4:].zero_()]
    faults += [lambda grid, i=direction: grid.neighbour(0)[i].fill_(-1) for direction in range(6)]
    for fault in faults:
        with pytest.raises(ConfigError, match="its gradients differ"):
            errors(fault)
