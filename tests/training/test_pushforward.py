"""Pushforward on backend torch."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch
from network.states import gns_of, network_of
from training.test_noise import episode
from training.test_symmetry import scene_with_obstacles

from hgn.config import TrainingConfig
from hgn.data.batch import BatchSample, join, make_batch
from hgn.runtime.simulator import Simulator
from hgn.scene.history import window
from hgn.schema import ConfigError
from hgn.step_config import StepConfig
from hgn.training import pushforward
from hgn.training.pushforward import PoolDraws, PushforwardPool, drawn_starts
from hgn.training.pushforward_targets import pushforward_windows
from hgn.training.torch_pushforward import TorchScenes

HISTORY, CELL = 5, 0.1


def training_of(**changes):
    values = {"batch_scenes": 4, "pushforward_fraction": 0.5, "pushforward_frames": 3}
    return TrainingConfig(**values | {"pushforward_scenes": 2} | changes)


def test_what_is_simulated_is_drawn_from_seed_and_update():
    """Every episode of three frames comes once before one comes twice, from any frame from which on the truth is known
    for long enough, the first included, or for half of what it has; the same for the same update and rank, another for
    another. Without any episode it is refused."""
    training = training_of(pushforward_scenes=5)
    frames, last = [10, 2, 12, 6, 3], [5, None, 7, 2, 0]  # from frame 2 of 6 on two frames have an answer, of three
    drawn = [drawn_starts(training, update, 0, frames) for update in range(200)]
    for starts in drawn:
        assert len(starts) == 5 and {index for index, _ in starts[:4]} == {0, 2, 3, 4}
    for index in (0, 2, 3, 4):
        assert {frame for starts in drawn for i, frame in starts if i == index} == set(range(last[index] + 1))
    assert drawn_starts(training, 7, 0, frames) == drawn[7] != drawn[8]
    assert drawn_starts(training, 7, 1, frames) != drawn[7]
    long = training_of(pushforward_scenes=5, pushforward_episode_fraction=0.5)  # of 10 and 12 frames 4 and 5, half each
    starts = {start for update in range(200) for start in drawn_starts(long, update, 0, frames)}
    for index, latest in ((0, 4), (2, 5), (3, 2), (4, 0)):
        assert {frame for i, frame in starts if i == index} == set(range(latest + 1))
    with pytest.raises(ConfigError, match=r"pushforward_fraction must be 0 if no episode has 3 frames, got 0.5"):
        drawn_starts(training, 0, 0, [2, 1])


@pytest.mark.parametrize(("share", "scenes"), [(0.3, 4), (0.25, 8), (0.1, 1), (0.0, 4)])
def test_the_share_is_kept(share, scenes):
    """On average this share of the samples is replaced, at most one sample more or less in an update, by windows of the
    whole pool; with an empty pool none is."""
    training = training_of(pushforward_fraction=share, batch_scenes=scenes)
    pool = PoolDraws(training, 0, [0.0, *range(9)])  # alike, whatever they ask for
    drawn = [pool.drawn(update) for update in range(2000)]
    counts = [len(entries) for entries in drawn]
    assert np.mean(counts) == pytest.approx(share * scenes, abs=0.03)
    assert all(abs(count - share * scenes) < 1 for count in counts)
    if share:
        assert {entry for entries in drawn for entry in entries} == {(number, 1.0) for number in range(10)}
    assert PoolDraws(training, 0, []).drawn(3) == []


def test_windows_that_ask_for_more_come_more_often():
    """A fraction of the draws is in proportion to the acceleration asked for; weighted means stay those of the pool.
    Where nothing accelerates, all come alike."""
    accelerations = [0.0, 1.0, 2.0, 5.0]
    training = training_of(pushforward_importance=0.6)
    drawn = [entry for update in range(5000) for entry in PoolDraws(training, 0, accelerations).drawn(update)]
    assert len(drawn) == 10_000
    for number, acceleration in enumerate(accelerations):
        chance = 0.4 / 4 + 0.6 * acceleration / 8
        assert sum(i == number for i, _ in drawn) / 10_000 == pytest.approx(chance, abs=0.015)
        assert all(weight == pytest.approx(1 / (4 * chance)) for i, weight in drawn if i == number)
    for number in range(4):
        assert sum(weight for i, weight in drawn if i == number) / 10_000 == pytest.approx(0.25, abs=0.02)
    still = [entry for update in range(400) for entry in PoolDraws(training, 0, [0.0] * 3).drawn(update)]
    assert set(still) == {(0, 1.0), (1, 1.0), (2, 1.0)}


def samples_of(episodes, frame, seeds):
    pairs = zip(episodes, seeds, strict=True)
    return [BatchSample(e, frame, window(e, frame, HISTORY), seed) for e, seed in pairs]


def pool_of(network, training=None):
    return PushforwardPool(TorchScenes(network), training or training_of(), 0)


LONG, SHORT, OTHER = episode(7, frames=12, seed=1), episode(7, frames=6, seed=2), episode(5, frames=6, seed=3)


@pytest.mark.parametrize(
    ("share", "starts"),
    [  # episodes, first frames, windows
        (0.0, ((LONG, 1, 3), (SHORT, 2, 2))),  # of frames that no truth answers there is no window
        (0.0, ((LONG, 1, 3), (SHORT, 3, 1))),
        (0.35, ((LONG, 1, 4), (SHORT, 1, 3), (OTHER, 0, 3))),  # a fraction that is more than what all have
    ],
)
def test_episodes_are_simulated_as_far_as_the_truth_and_their_fraction_go(share, starts):
    """As they are by themselves, in whatever order they come; what is dropped is counted of the others."""
    network = network_of(torch.float32, levels=1, message_passing_steps=1)
    own = pool_of(network, training_of(pushforward_episode_fraction=share))
    own.refresh([(made, frame) for made, frame, _ in starts])
    windows = sum(count for *_, count in starts)
    assert own.figures["pushforward/windows"] == windows and own.figures["pushforward/dropped"] == 0
    for made, frame, count in starts:
        alone = pool_of(network, training_of(pushforward_frames=count))
        alone.refresh([(made, frame)])
        mine = [sample for sample, _ in own._samples if sample.episode is made]
        for found, (expected, _) in zip(mine, alone._samples, strict=True):
            assert found.frame == expected.frame
            np.testing.assert_allclose(found.window_WN3, expected.window_WN3, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    "network",
    [
        network_of(torch.float32, levels=2, message_passing_steps=1),
        gns_of(torch.float32, message_passing_steps=1, cell_size=0.05),
    ],
    ids=["hgn", "gns"],
)
def test_the_pool_is_what_the_network_does(network):
    """From frame 0, whose past is ballistic, and from a later one, the pool holds the windows of each scene simulated
    by itself; a batch gets them in place of its first samples, with its seeds, and the others stay."""
    episodes = [scene_with_obstacles(i, 5 + i, cells=200) for i in range(2)]
    starts = [(episodes[0], 0), (episodes[1], 6)]
    own = pool_of(network)
    own.refresh(starts)
    assert own.figures["pushforward/windows"] == 6 and own.figures["pushforward/dropped"] == 0
    expected = []
    for made, frame in starts:
        state = make_batch([(made, frame)], network.config).state()
        state = replace(state, frame_S=torch.tensor([frame]))
        path = []
        for _ in range(3):
            state = Simulator(network, 60.0).step(state)
            path.append(state.position_N3)
        true = torch.from_numpy(window(made, frame, HISTORY, 4))
        materials = torch.tensor(made.material_N)
        expected += list(pushforward_windows(true, torch.stack(path), network.config.cell_size, materials))
    for (sample, _), wanted, origin in zip(own._samples, expected, [0, 0, 0, 1, 1, 1], strict=True):
        assert sample.episode is episodes[origin]
        np.testing.assert_allclose(sample.window_WN3, wanted.numpy(), rtol=0, atol=1e-7)
    samples = samples_of([*episodes, *episodes], 3, seeds=(5, 6, 7, 8))
    replaced = own.replaced(samples, 11)
    chosen = PoolDraws(own.training, 0, [acceleration for _, acceleration in own._samples]).drawn(11)
    assert len(chosen) == 2 and [sample.seed for sample in replaced] == [5, 6, 7, 8]
    for slot, (number, _) in enumerate(chosen):
        assert replaced[slot].window_WN3 is own._samples[number][0].window_WN3
    assert replaced[2:] == samples[2:]
    batch = join(own.replaced(samples, 11), network.config)
    by_scene = batch.window_WN3.split(list(batch.particles_S), dim=1)
    assert all(np.array_equal(scene, sample.window_WN3) for scene, sample in zip(by_scene, replaced, strict=True))


def falling(episode, domain):
    return replace(episode, domain_size=(domain, domain, domain))


def wild_network():
    """One that accelerates everything by 0.02 a frame, along each axis."""
    network = network_of(torch.float32, levels=1, message_passing_steps=1, cell_size=0.5)
    with torch.no_grad():
        network.normaliser.acceleration_mean.fill_(0.02)
        network.normaliser.acceleration_std.fill_(0.0)
    return network


def with_square(episode, at, size=0.6):
    """The episode among one obstacle that its specification tells of: a square across y."""
    record = {"shape": "square", "size": size, "position": [*at], "quaternion": [1.0, 0.0, 0.0, 0.0]}
    return replace(episode, specification={"kind": "random", "obstacles": [record]})


def test_barriers_are_remembered(monkeypatch):
    """The pool is made anew, from other frames of the same episodes, without their obstacles' lists being built again;
    another clearance has its own. Episodes are read again each time, and no earlier one stays in memory."""
    built, real = [], pushforward.build_barrier
    monkeypatch.setattr(pushforward, "build_barrier", lambda *given: built.append(given[2]) or real(*given))
    scenes = [with_square(episode(8, seed=seed), (0.5, 0.53 + seed / 1000, 0.5)) for seed in (1, 2)]
    network = wild_network()
    for clearance in (2e-3, 1e-3):
        network.step = StepConfig(obstacle_clearance=clearance)
        own = pool_of(network)
        for frame in (2, 3, 4):
            read = [replace(scene) for scene in scenes]
            own.refresh([(scene, frame) for scene in read])
            first, _ = map(weakref.ref, read)
            own.refresh([(scene, frame) for scene in scenes])
            del read
            gc.collect()
            assert first() is None
    assert built == [2e-3, 2e-3, 1e-3, 1e-3]


def test_lost_scenes_are_dropped():
    """A scene whose particles leave its domain by more than its size, or are no longer numbers, gives the windows
    before that and none after; the others give all, and one too far from the truth none from there on."""
    network = wild_network()
    small, large = falling(episode(4, seed=1), 0.27), episode(4, seed=2)  # both around 0.5: 0.02, 0.06, 0.12 on
    own = pool_of(network)
    own.refresh([(small, 2), (large, 2)])
    assert [sample.episode is small for sample, _ in own._samples] == [True, False, False, False]
    assert own.figures["pushforward/dropped"] == 2
    network.config = replace(network.config, cell_size=0.1)  # 0.02 sqrt(3) < 0.05 < 0.06 sqrt(3)
    own.refresh([(small, 2), (large, 2)])
    assert [sample.episode is small for sample, _ in own._samples] == [True, False]
    with torch.no_grad():
        network.normaliser.acceleration_mean.fill_(torch.nan)
    own.refresh([(small, 2), (large, 2)])
    assert own._samples == [] and own.figures["pushforward/windows"] == 0 and "pushforward/mse" not in own.figures
    samples = samples_of([small] * 4, 2, seeds=(5, 6, 7, 8))
    assert own.replaced(samples, 0) == samples
