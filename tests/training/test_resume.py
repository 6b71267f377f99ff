"""Tests order and resuming: each sample is used once an epoch, and an interruption at any point changes nothing."""

import dataclasses
import shutil
import signal
from itertools import islice
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from equality import assert_same
from hypothesis import given, settings
from hypothesis import strategies as st
from training.runs import NETWORK, TRAINING, metrics, train_mapping

from hgn import train
from hgn.config import NetworkConfig, TrainingConfig
from hgn.data.reader import EpisodeStore
from hgn.data.sampler import EpisodeSampler, SamplerState
from hgn.runtime.simulation import Simulation
from hgn.scene.history import window
from hgn.schema import ConfigError
from hgn.training import monitor
from hgn.training.callbacks import Stopper
from hgn.training.checkpoint import read_checkpoint
from hgn.training.data_module import EpisodeDataModule
from hgn.training.module import TrainingModule
from hgn.training.readers import WindowReader
from hgn.training.stop import StopRequest
from hgn.training.torch_pushforward import TorchScenes

UPDATES = 16  # of 2 samples, where an epoch has 25
MORE = {"optimizer": "muon", "symmetry": "gravity", "warmup_updates": 6, "ema_decay": 0.8}
MORE |= {"pushforward_fraction": 0.5, "pushforward_every": 4, "pushforward_scenes": 3, "pushforward_frames": 2}
STARTS = ((1, 8), (1, 2), (0, 3), (1, 4))  # from, to: ranks, scenes each, batches read ahead, batches


class Samples:
    """The samples of an epoch as (episode, frame), in the order in which they were trained on."""

    def __init__(self):
        self.epochs: dict[int, list[tuple[int, int]]] = {}

    def take(self, orders):
        """One global batch: the ranks' shares follow each other, and may run over the end of an epoch."""
        sampler_state = orders[0].state
        left = len(orders[0]._order) - sampler_state.position
        for number, sample in enumerate(sample for order in orders for sample in order.next_batch()):
            self.epochs.setdefault(sampler_state.epoch + (number >= left), []).append((sample.episode, sample.frame))
        assert all(order.state == orders[0].state for order in orders)

    def require_each_once(self, sampler_state, frames):
        """Every epoch before that state's has each sample of episodes of `frames` frames once, its own none twice."""
        for epoch, samples in self.epochs.items():
            expected = [(e, n) for e, count in enumerate(frames(epoch)) for n in range(count - 1)]
            if epoch < sampler_state.epoch:
                assert sorted(samples) == expected
            else:
                assert len(set(samples)) == len(samples) and set(samples) <= set(expected)


def ranks_of(world_size, batch, published, sampler_state=None):
    return [EpisodeSampler(5, batch, published, sampler_state, rank, world_size) for rank in range(world_size)]


@settings(max_examples=80, deadline=None)
@given(
    st.lists(st.integers(1, 3), min_size=1, max_size=6),
    st.integers(1, 4),
    st.lists(st.tuples(st.integers(1, 6), st.integers(0, 2)), min_size=1, max_size=8),
)
def test_an_epoch_keeps_the_revision_it_began_with(growth, world_size, starts):
    """While a data set grows at every look, and the training is interrupted at any batch, each epoch has exactly the
    episodes that were published when it began, each sample once."""
    published: list[int] = [4, 3, 5]
    begun: dict[int, int] = {}
    looks = iter(growth * 1000)

    def look(epoch):
        if epoch not in begun:
            published.extend([3] * next(looks))
            begun[epoch] = len(published)
        return list(published)

    seen, sampler_state = Samples(), SamplerState()
    for batches, grown_meanwhile in starts:
        published.extend([2] * grown_meanwhile)
        orders = ranks_of(world_size, 1, look, sampler_state)
        for _ in range(batches):
            seen.take(orders)
            published.extend([2] * grown_meanwhile)
        sampler_state = orders[0].state
    assert sampler_state.episodes == begun[sampler_state.epoch]
    seen.require_each_once(sampler_state, lambda epoch: published[: begun[epoch]])


class Shared:
    """Replaces the trainer of one rank of several, if all ranks see the same data set."""

    def __init__(self, rank, world_size):
        self.global_rank, self.world_size, self.strategy = rank, world_size, self

    def broadcast(self, mine):
        return mine

    def reduce_boolean_decision(self, decision, all):
        return decision


def test_feeds_of_all_ranks_resume_anywhere(data):
    """Interrupted after any batches, on 1 to 8 ranks that may be others at each start, with 0 to 3 batches read ahead
    at that moment, the ranks together get the samples of one uninterrupted process, update by update, and each sample's
    window bit by bit."""
    network = NetworkConfig(**NETWORK)
    store = EpisodeStore(data.dataset.folder, "train")
    whole = EpisodeSampler(TrainingConfig(**TRAINING).seed, 1, lambda _: [6] * 5)
    expected = [whole.next_batch()[0] for _ in range(8 * 2 * 3 * 4)]
    seeds = [sample.seed for sample in expected]
    windows = {s.seed: window(store[s.episode], s.frame, network.velocity_history) for s in expected}

    @settings(max_examples=25, deadline=None, derandomize=True)
    @given(st.lists(st.tuples(*(st.integers(*ends) for ends in STARTS)), min_size=1, max_size=3))
    def interrupted(starts):
        seen: list[int] = []
        sampler_state = SamplerState()
        for world_size, batch_scenes, ahead, count in starts:
            training = TrainingConfig(**TRAINING | {"batch_scenes": batch_scenes})
            ranks = []
            for rank in range(world_size):
                feed = EpisodeDataModule(store, training, WindowReader(store, network, training))
                feed.sampler_state, feed.trainer = sampler_state, Shared(rank, world_size)
                with mock.patch("hgn.training.data_module.CHUNKS_AHEAD", ahead):
                    ranks.append(list(islice(feed.chunks(), count)))
            for chunks in zip(*ranks, strict=True):
                update = [seed for chunk in chunks for seed in chunk.batch.seeds_S]
                assert sorted(update) == sorted(seeds[len(seen) :][: len(update)])
                seen += update
                assert len({chunk.sampler_state for chunk in chunks}) == 1
                for batch in (chunk.batch for chunk in chunks):
                    found = np.concatenate([windows[seed] for seed in batch.seeds_S], axis=1)
                    assert np.array_equal(found, batch.window_WN3.numpy())
            sampler_state = ranks[0][-1].sampler_state

    interrupted()


def test_resume_equals_no_interruption(data, tmp_path, monkeypatch):
    """A training that is interrupted at updates with a new pushforward pool ends bitwise as an uninterrupted one:
    parameters, their average, both moments, learning rate and order of samples. Noise, jitter and symmetries depend on
    the samples' seeds, so they agree too. After an interruption at another update the training continues with a
    different pool."""
    place: dict[str, Any] = {}
    step = TrainingModule.training_step
    monkeypatch.setattr(TrainingModule, "training_step", lambda m, chunk: place.update(module=m) or step(m, chunk))
    requested = property(lambda _: "module" in place and place["module"].update >= place["stop"])
    monkeypatch.setattr(StopRequest, "requested", requested)

    def trained(name, *stops):
        for stop in (*stops, UPDATES):
            place.clear()
            place["stop"] = stop
            mapping = train_mapping(data, tmp_path / name, maximum_updates=UPDATES, monitor_every=1000, **MORE)
            assert train.main(mapping) == 0
            stored = read_checkpoint(tmp_path / name / "checkpoints" / "last.ckpt")
            assert stored["hgn"]["updates"] == stop
        return stored, [line for line in metrics(tmp_path / name) if "loss" in line]

    (whole, lines), (again, _), (elsewhere, resumed) = trained("whole"), trained("cut", 4, 12), trained("pool", 6)
    digest = EpisodeStore(data.dataset.folder, "train").digest(5)
    expected = SamplerState(1, 7, 5, digest, seed=TrainingConfig(**TRAINING).seed)
    assert dataclasses.asdict(expected) == whole["hgn"]["sampler_state"]
    for part in ("state_dict", "optimizer_states", "hgn"):
        assert_same(again[part], whole[part], part)
    assert elsewhere["hgn"] == whole["hgn"]
    assert any(not torch.equal(elsewhere["state_dict"][name], value) for name, value in whole["state_dict"].items())
    assert all(line["pushforward/windows"] > 0 for line in resumed)  # also between updates 6 and 8
    assert all(line["pushforward/windows"] == 6 and line["pushforward/dropped"] == 0 for line in lines)


@pytest.mark.parametrize(
    ("stopped_at", "split", "every"),
    [(6, "training", 6), (6, "validation", 6), (12, "validation", 6), (12, "training", 7)],
)
def test_a_stopped_measurement_is_made_on_resume(data, tmp_path, monkeypatch, capsys, stopped_at, split, every):
    """A signal while update 6 or the last one is measured: the resumed run measures that update before the next one,
    and then no second time. Errors, losses, best.ckpt and parameters are those of a run without a stop, bit by bit."""
    measured, real = [], monitor.Monitor._one_step

    def trained(name):
        return train.main(train_mapping(data, tmp_path / name, log_every=2, monitor_every=every))

    def signalled(self, trainer, module, measured_split, episodes):
        if (module.update, measured_split) == (stopped_at, split) and not measured:
            measured.append(split)
            signal.raise_signal(signal.SIGTERM)
        return real(self, trainer, module, measured_split, episodes)

    assert trained("whole") == 0
    monkeypatch.setattr(monitor.Monitor, "_one_step", signalled)
    capsys.readouterr()
    assert trained("cut") == 128 + signal.SIGTERM
    output = capsys.readouterr()
    assert "resuming" not in output.err and "stopped; the same command resumes it" in output.out
    stored = read_checkpoint(tmp_path / "cut" / "checkpoints" / "last.ckpt")
    assert stored["hgn"]["updates"] == stopped_at
    assert not [line for line in metrics(tmp_path / "cut") if line["update"] == stopped_at and "loss" not in line]
    assert trained("cut") == 0
    output = capsys.readouterr()
    assert f"resuming at update {stopped_at}\n" in output.err and "every fourth frame" in output.out
    assert trained("cut") == 0
    assert "stopped;" not in output.out and "no best.ckpt" not in output.out
    names = ("update", "loss", "one_step/training", "one_step/validation")
    whole, cut = ([[line.get(name) for name in names] for line in metrics(tmp_path / run)] for run in ("whole", "cut"))
    assert cut == whole
    for name in ("last.ckpt", "best.ckpt"):
        whole, cut = (read_checkpoint(tmp_path / run / "checkpoints" / name) for run in ("whole", "cut"))
        for part in ("state_dict", "optimizer_states", "hgn"):
            assert_same(cut[part], whole[part], part)


@pytest.mark.parametrize("update", [0, 4])
def test_a_signal_ends_simulations_before_an_update(data, tmp_path, monkeypatch, update):
    """The run ends within a frame, with the state before the update, and then ends where an uninterrupted one does."""
    frames, real = [], TorchScenes.simulate
    settings = {"maximum_updates": 8, "monitor_every": 1000, **MORE, "pushforward_frames": 4}

    def trained(name):
        return train.main(train_mapping(data, tmp_path / name, **settings))

    def signalled(self, starts, count):
        run = Simulation.run

        def first_frame(simulation, number, on_frame):
            def after(frame):
                frames.append(frame)
                signal.raise_signal(signal.SIGTERM)
                on_frame(frame)

            return run(simulation, number, after)

        simulated.append(update)
        if len(simulated) == 1 + update // 4 and not frames:
            with monkeypatch.context() as patch:
                patch.setattr(Simulation, "run", first_frame)
                return real(self, starts, count)
        return real(self, starts, count)

    simulated: list[int] = []
    assert trained("whole") == 0
    monkeypatch.setattr(TorchScenes, "simulate", signalled)
    assert trained("cut") == 128 + signal.SIGTERM
    assert len(frames) == 1
    assert read_checkpoint(tmp_path / "cut" / "checkpoints" / "last.ckpt")["hgn"]["updates"] == update
    assert trained("cut") == 0
    whole, cut = (read_checkpoint(tmp_path / run / "checkpoints" / "last.ckpt") for run in ("whole", "cut"))
    for part in ("state_dict", "optimizer_states", "hgn"):
        assert_same(cut[part], whole[part], part)


def test_ranks_stop_before_the_next_update_after_a_stopped_measurement():
    """After another update the checkpoint would be later than the measurement, which would be lost."""
    stop, trainer = StopRequest(), mock.Mock(world_size=2, should_stop=False)
    trainer.strategy.reduce = lambda mine, reduce_op: mine
    stop.signal = signal.SIGTERM
    module = mock.Mock(spec=TrainingModule, training_config=TrainingConfig(**TRAINING), device=torch.device("cpu"))
    for module.update in (5, 6):
        Stopper(stop, mock.Mock()).on_train_batch_end(trainer, module)
        assert trainer.should_stop == (module.update == TRAINING["monitor_every"])


def test_the_end_of_a_run_is_measured_once(data, tmp_path, monkeypatch):
    """Also if a checkpoint of the last update precedes the measurement, and if its error is not the lowest."""
    run, real = tmp_path / "run", monitor.Monitor._one_step

    def growing(self, trainer, module, split, episodes):
        return real(self, trainer, module, split, episodes) | {f"one_step/{split}": float(module.update)}

    monkeypatch.setattr(monitor.Monitor, "_one_step", growing)
    for _ in range(2):
        assert train.main(train_mapping(data, run, maximum_updates=5, monitor_every=3)) == 0
    assert [line["update"] for line in metrics(run) if "one_step/training" in line] == [3, 5]


def of_state(**changes):
    """Other values of the sampler's state."""
    return lambda checkpoint: checkpoint["hgn"]["sampler_state"].update(changes)


def moments(checkpoint):
    """The optimiser's state of each parameter."""
    return checkpoint["optimizer_states"][0]["state"]


STATE = "checkpoint must contain the state of a training of this version, got .*last.ckpt: "
ODD = [
    (lambda checkpoint: checkpoint.pop("callbacks"), STATE + "KeyError: 'callbacks'"),
    *(
        (lambda checkpoint, name=name, value=value: checkpoint.update({name: value}), STATE)
        for name, values in {
            "callbacks": ([], None, {"Checkpoints": 5}, {"Checkpoints": {"best_error": "x"}}),
            "optimizer_states": ([5], [{"state": {}, "param_groups": []}]),
            "pytorch-lightning_version": ("abc", 5, "0.0.1"),
            "state_dict": ({}, {"x": torch.zeros(1)}),
        }.items()
        for value in values
    ),
    *(
        (lambda checkpoint, name=name: moments(checkpoint)[3].update({name: torch.ones(3, 5)}), STATE + f".* {name} of")
        for name in ("step", "exp_avg", "exp_avg_sq")
    ),
    (lambda checkpoint: moments(checkpoint).pop(3), STATE + "KeyError: 'step'"),
    (lambda checkpoint: moments(checkpoint)[3]["exp_avg"].fill_(torch.nan), STATE + ".* exp_avg .* finite"),
    (lambda checkpoint: checkpoint.update(optimizer_states=[]), STATE + "IndexError"),
    (of_state(position=10**9), "sampler_state.position must be at most the 25 samples of epoch 0, got 1000000000"),
    *((of_state(**{key: -1}), f"{key} must be a finite number >= 0") for key in ("epoch", "position", "window")),
]


@pytest.mark.parametrize(("change", "message"), ODD)
def test_checkpoints_with_other_parts_are_refused(finished, change, message):
    """A checkpoint that is whole, but whose parts are not those of a training, is named."""
    data, run = finished
    path = run / "checkpoints" / "last.ckpt"
    checkpoint = read_checkpoint(path)
    change(checkpoint)
    torch.save(checkpoint, path)
    with pytest.raises(ConfigError, match=message):
        train.main(train_mapping(data, run, maximum_updates=16))


@pytest.fixture(scope="module")
def parameters_after_resuming(finished_once, tmp_path_factory):
    """The parameters of the training that ended, after four more updates."""
    data, run, _ = finished_once
    resumed = shutil.copytree(run, tmp_path_factory.mktemp("resumed") / "run")
    assert train.main(train_mapping(data, resumed, maximum_updates=16)) == 0
    return read_checkpoint(resumed / "checkpoints" / "last.ckpt")["state_dict"]


@pytest.mark.parametrize(
    "options", [{"maximize": True}, {"betas": (0.9,)}, {"amsgrad": True}, {"differentiable": True}, None]
)
def test_the_optimiser_keeps_the_settings_of_this_version(finished, parameters_after_resuming, options):
    """Those in a checkpoint, or none in it, change no update of a resumed training."""
    data, run = finished
    path = run / "checkpoints" / "last.ckpt"
    checkpoint = read_checkpoint(path)
    (group,) = checkpoint["optimizer_states"][0]["param_groups"]
    group.update(options) if options else [group.pop(name) for name in ("betas", "eps")]
    torch.save(checkpoint, path)
    assert train.main(train_mapping(data, run, maximum_updates=16)) == 0
    assert_same(read_checkpoint(path)["state_dict"], parameters_after_resuming)


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_checkpoint_with_numbers_that_are_not_finite_is_damaged(finished, capsys, value):
    """Updates from it would all be skipped. The one before it is taken."""
    data, run = finished
    path = run / "checkpoints" / "last.ckpt"
    checkpoint = read_checkpoint(path)
    checkpoint["state_dict"]["network.encode.first.weight"][0, 0] = value
    torch.save(checkpoint, path)
    assert train.main(train_mapping(data, run, maximum_updates=16)) == 0
    assert "network.encode.first.weight has others; trying the previous one" in capsys.readouterr().err
