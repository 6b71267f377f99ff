"""The pushforward pool on backend triton against that on torch."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from kernels.cases import swept
from kernels.engines import device
from kernels.test_large import let_half_sums_fail
from kernels.test_training import data as data
from network.states import network_of
from training.test_noise import episode
from training.test_pushforward import falling, training_of, wild_network, with_square
from training.test_symmetry import scene_with_obstacles

from hgn.data.episode_tensors import whole_episode
from hgn.kernels.moving import EpisodeMoving
from hgn.kernels.packing import pack_network
from hgn.kernels.scene_tables import SceneHash
from hgn.kernels.update.op import DeviceEpisode, DeviceSample
from hgn.scene.material import ELASTIC, MATERIALS
from hgn.schema import ConfigError
from hgn.training.noise import quiet_weight
from hgn.training.pushforward import PushforwardPool, simulated_barrier
from hgn.training.torch_pushforward import TorchScenes
from hgn.training.triton_pushforward import TritonScenes

pytestmark = pytest.mark.usefixtures("large_tiles")

CELL_SIZE = 1 / 64


def placed(made, network):
    clearance = network.step.obstacle_clearance
    barrier = None if clearance is None else simulated_barrier(made, clearance)
    whole, where = whole_episode(made, network.config, barrier), device()
    cells = SceneHash.of_grid(whole.obstacle_grid, "friction" in network.config.own_physics)
    parameter_NP = None if whole.parameter_NP is None else whole.parameter_NP.to(where)
    hashed = SceneHash.of_barrier(whole.barrier) if whole.barrier is not None else None
    position_TN3, material_N = whole.position_TN3.to(where), whole.material_N.to(where)
    scene = whole.domain_size, whole.gravity, whole.symmetries, hashed and hashed.to(where), whole.wall_friction
    rest = whole.rest and whole.rest.to(where)
    moving = EpisodeMoving.of(whole.moving, whole.frame_s, network.config, where)
    return DeviceEpisode(position_TN3, material_N, cells and cells.to(where), *scene, parameter_NP, rest, moving)


def let_move(monkeypatch, episodes, counts):
    """Gives episodes these numbers of moving obstacles."""
    pairs = enumerate(zip(episodes, counts, strict=True))
    known = {
        id(made): tuple(swept(8 + 2 * i + number, cells=20_000) for number in range(count))
        for i, (made, count) in pairs
    }
    for module in ("batch", "episode_tensors"):
        monkeypatch.setattr(f"hgn.data.{module}.moving_of_episode", lambda made: known.get(id(made), ()))


def with_parameters(made):
    """The episode with other elastic moduli and densities."""
    factor_N = np.linspace(0.5, 2.0, made.particle_count, dtype=np.float32)
    return replace(made, material_parameters={"youngs_modulus_pa": 1e6 * factor_N, "density_kg_m3": 1e3 * factor_N})


def pools_of(network, training):
    """The pool of each backend, triton's first."""
    scenes = TritonScenes(network, training, CELL_SIZE, training.precision)
    return PushforwardPool(scenes, training, 0), PushforwardPool(TorchScenes(network), training, 0)


def values_of(network):
    return pack_network(network).gather(list(network.parameters())).detach()


def refresh(fast, network, starts):
    """Simulates on backend triton from these episodes and frames."""
    fast._scenes.values = values_of(network)
    fast.refresh([(placed(made, network), frame) for made, frame in starts])


def assert_same_pools(fast, plain):
    for name, value in plain.figures.items():
        if name != "pushforward/seconds":
            assert fast.figures[name] == pytest.approx(value, rel=1e-3), name
    for (found, asked), (sample, acceleration) in zip(fast._samples, plain._samples, strict=True):
        position_TN3 = found.episode.position_TN3
        np.testing.assert_allclose(position_TN3.cpu().numpy(), sample.window_WN3, rtol=0, atol=1e-6)
        assert found.episode.particles == sample.episode.particle_count and position_TN3.is_contiguous()
        assert asked == pytest.approx(acceleration, abs=1e-6) and found.episode.first_frame == sample.frame


@pytest.mark.parametrize(
    "changes",
    [
        {"inputs": "relative", "wall_clearance": (0.45, 0.45)},
        {"inputs": "local", "own_physics": ("friction", "parameters"), "wall_clearance": (0.45, 0.45)},
        {"inputs": "local", "own_physics": ("parameters", "elastic"), "materials": MATERIALS},
        {"obstacle_clearance": 5e-3},
        {"inputs": "local", "own_physics": ("friction", "moving"), "obstacle_clearance": 5e-3},
    ],
    ids=("relative", "friction and parameters", "elastic bodies", "obstacles", "moving obstacles"),
)
def test_the_pool_is_that_of_the_plain_path(changes, monkeypatch):
    """Scenes with and without obstacles, first and later frames, one simulation after the other with other weights and
    other numbers of particles, in the same buffers where they suffice: both pools hold the same windows."""
    network = network_of(torch.float32, width=16, levels=1, message_passing_steps=1, **changes).to(device())
    scenes = [scene_with_obstacles(0, 7), episode(5, seed=1), scene_with_obstacles(2, 6), scene_with_obstacles(3, 12)]
    scenes[2] = with_parameters(scenes[2])
    if "materials" in changes:
        scenes[::2] = [replace(made, material_N=np.full_like(made.material_N, ELASTIC)) for made in scenes[::2]]
    drawn = {"quiet_acceleration": 1.0, "pushforward_importance": 0.5}
    training = training_of(precision="fp32", pushforward_frames=2, **drawn)
    fast, plain = pools_of(network, training)
    if "obstacle_clearance" in changes:
        scenes = [with_square(made, (0.25, 0.25, 0.25)) if made is not scenes[1] else made for made in scenes]
    if "inputs" in changes and "obstacle_clearance" in changes:
        let_move(monkeypatch, scenes, [2, 1, 0, 1])
    elif "obstacle_clearance" in changes:
        free_network = network_of(torch.float32, width=16, levels=1, message_passing_steps=1).to(device())
        plain.refresh([(scenes[0], 0)])
        free = PushforwardPool(TorchScenes(free_network), training, 0)
        free.refresh([(scenes[0], 0)])
        ends = [pool._samples[-1][0].window_WN3[-2] for pool in (plain, free)]
        assert 0 < (abs(ends[0] - ends[1]).max(-1) > 3e-4).sum() < 7  # others feel those that are held
    rollouts = []
    # from frame 9 on, one has an answer; the second begins with the barrier of the first scene in another place
    for starts in ([(0, 0), (1, 9)], [(1, 0), (0, 0)], [(2, 5), (3, 2)]):
        refresh(fast, network, [(scenes[i], frame) for i, frame in starts])
        plain.refresh([(scenes[i], frame) for i, frame in starts])
        assert_same_pools(fast, plain)
        rollouts.append(fast._scenes._stepper)
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.mul_(1.05)
    assert rollouts[0] is rollouts[1] is not rollouts[2]
    samples = [DeviceSample(placed(scenes[0], network), 2, seed, 0.5) for seed in (5, 6, 7, 8)]
    mixed = fast.replaced(samples, 11)
    assert [sample.seed for sample in mixed] == [5, 6, 7, 8] and mixed[2:] == samples[2:]
    asked = {sample.episode: acceleration for sample, acceleration in fast._samples}
    mean = sum(asked.values()) / len(asked)
    for sample in mixed[:2]:
        weight = quiet_weight(training, asked[sample.episode])
        assert weight > 1 and sample.frame == 0
        assert sample.weight == pytest.approx(weight / (0.5 + 0.5 * asked[sample.episode] / mean))


def test_long_episodes_are_simulated_for_longer():
    """Groups of scenes for different times, one after the other in the same buffers: the windows of the plain path."""
    network = network_of(torch.float32, width=16, levels=1, message_passing_steps=1).to(device())
    scenes = [episode(8, frames=12, seed=1), episode(7, frames=6, seed=2), episode(5, frames=6, seed=3)]
    training = training_of(precision="fp32", pushforward_frames=2, pushforward_episode_fraction=0.4)
    fast, plain = pools_of(network, training)
    refresh(fast, network, [(made, 1) for made in scenes])
    plain.refresh([(made, 1) for made in scenes])
    assert_same_pools(fast, plain)
    assert [found.episode.particles for found, _ in fast._samples] == [7, 7, 5, 5, 8, 8, 8, 8]


def test_lost_scenes_are_dropped():
    """A scene that leaves its domain, or is no longer made of numbers, ends alone: the other's frames are the plain
    path's, and the next simulation is whole again."""
    network = wild_network().to(device())
    small, large = falling(episode(4, seed=1), 0.27), episode(4, seed=2)
    starts = [(small, 2), (large, 2)]
    training = training_of(precision="fp32")
    fast, plain = pools_of(network, training)
    for mean, kept in ((0.02, 4), (float("nan"), 0), (0.01, 5)):
        network.normaliser.acceleration_mean.fill_(mean)
        refresh(fast, network, starts)
        plain.refresh(starts)
        assert_same_pools(fast, plain)
        assert len(fast._samples) == kept


def test_wrong_kernels_are_refused():
    """Before anything is trained on them, the simulation's kernels are compared with the reference network."""
    network = network_of(torch.float32, width=16, levels=1, message_passing_steps=1).to(device())
    fast, _ = pools_of(network, training_of(precision="fp32"))
    starts = [(scene_with_obstacles(i, 5), 2) for i in range(2)]
    kept = TritonScenes._first_scenes

    def another(self, *arguments):
        with torch.no_grad():
            next(network.decode.parameters()).mul_(1.5)
        return kept(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TritonScenes, "_first_scenes", another)
        with pytest.raises(ConfigError, match=r"must be torch on this machine.*set training.backend=torch"):
            refresh(fast, network, starts)


def test_larger_buffers_sum_in_float32_too(monkeypatch):
    """Where float16 sums fail the check, a later simulation in larger buffers sums in float32 unchecked."""
    network = network_of(torch.float32, width=16, levels=1, message_passing_steps=1).to(device())
    fast, _ = pools_of(network, training_of(precision="fp16"))
    checked, steppers = let_half_sums_fail(monkeypatch), []
    for count in (4, 40):
        refresh(fast, network, [(episode(count, seed=1), 2)])
        steppers.append(fast._scenes._stepper)
    assert steppers[0] is not steppers[1] and checked == [True, False]
    assert [stepper.fused.tuning.half_sums for stepper in steppers] == [False, False]
