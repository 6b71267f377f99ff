"""The training command on backend triton: counts, logs, checkpoints, resume, and the way back to backend torch."""

import gc
import re
import weakref
from dataclasses import replace

import pytest
import torch
from kernels.engines import device
from training.runs import metrics, train_mapping
from training.test_weights import data as data

from hgn import train
from hgn.config import TrainingConfig
from hgn.kernels.update.op import Updates
from hgn.runtime.parity import relative_error
from hgn.schema import ConfigError
from hgn.training import parity, schedule
from hgn.training.checkpoint import read_checkpoint
from hgn.training.data_module import chunk_length
from hgn.training.module import TrainingModule
from hgn.training.readers import EpisodeReader
from hgn.training.triton_updates import TritonUpdates

pytestmark = pytest.mark.usefixtures("large_tiles")

HISTORY = 5
NETWORK = {"width": 16, "levels": 1, "message_passing_steps": 1, "cell_size": 0.2}


def run_mapping(config, run, **training):
    values = {"maximum_updates": 4, "log_every": 4, "checkpoint_every": 4, "monitor_every": 4}
    values |= {"backend": "triton", "precision": "fp32", "device": "auto"} | training
    mapping = train_mapping(config, run, **values)
    return mapping | {"network": NETWORK}


def without_jitter(monkeypatch):
    """Both backends draw the grid's origin from random streams of their own."""
    monkeypatch.setattr("hgn.training.torch_updates.jittered_origin", lambda *_: None)
    monkeypatch.setattr(Updates, "jitter", False)


def test_fast_training_is_the_plain_one(data, tmp_path, monkeypatch, capsys):
    """Without noise and jitter both backends simulate the same scenes for the pushforward pool at the same updates and
    make the same updates: every count and log line is there, weights, their average and moments agree; a training may
    change backend at any checkpoint, and ends where the others do. The fast one tells where the time of its first
    updates went."""
    monkeypatch.setattr("hgn.training.triton_updates.REPORTED_UPDATES", 2)
    monkeypatch.setattr("hgn.training.session.triton_unsupported_reason", lambda *_: None)  # in float32
    without_jitter(monkeypatch)
    original = TrainingModule.set_statistics

    def set_statistics(self, statistics):
        original(self, statistics)
        self.network.normaliser.acceleration_std.fill_(1e-3)  # free fall has none, and rounding would be all there is
        self._begin_average()

    monkeypatch.setattr(TrainingModule, "set_statistics", set_statistics)
    same = {"noise_std": 0.0, "warmup_updates": 2, "ema_decay": 0.7, "symmetry": "gravity"}
    pool = {"pushforward_fraction": 0.5, "pushforward_every": 1, "pushforward_scenes": 2, "pushforward_frames": 2}
    counts = {"maximum_updates": 3, "log_every": 3, "checkpoint_every": 3, "monitor_every": 3}
    ends, lines = {}, {}
    for name, parts in {
        "torch": [("torch", 3)],
        "triton": [("triton", 3)],
        "mixed": [("torch", 1), ("triton", 2), ("torch", 3)],
    }.items():
        for backend, updates in parts:
            with monkeypatch.context() as patch:
                if updates < 3:
                    stop_at(patch, updates)
                assert train.main(run_mapping(data, tmp_path / name, backend=backend, **same, **pool, **counts)) == 0
            ends[name] = read_checkpoint(tmp_path / name / "checkpoints" / "last.ckpt")
            assert ends[name]["hgn"]["updates"] == updates
        lines[name] = metrics(tmp_path / name)
    errors = capsys.readouterr().err
    assert "training backend: triton, precision fp32" in errors
    assert re.findall(r"the first \d updates took .* s pushforward, .* capturing \d+ times", errors)

    def moments(end):
        return torch.cat([state["exp_avg"].flatten() for state in end["optimizer_states"][0]["state"].values()])

    expected = ends["torch"]
    for end in (ends["triton"], ends["mixed"]):
        assert end["hgn"] == expected["hgn"]
        # Adam's first steps are signs of gradients: where those are next to nothing, rounding decides
        for key, value in expected["state_dict"].items():
            assert float((end["state_dict"][key] - value).double().abs().mean()) < 1e-5, key
        assert float((moments(end) - moments(expected)).norm() / moments(expected).norm()) < 1e-4
        states = end["optimizer_states"][0]
        assert states["param_groups"] == expected["optimizer_states"][0]["param_groups"]
        assert {float(state["step"]) for state in states["state"].values()} == {3.0}
    (plain,), (fast,) = ([line for line in lines[name] if "loss" in line] for name in ("torch", "triton"))
    assert fast["update"] == plain["update"] == 3 and fast["skipped_updates"] == 0
    assert fast["learning_rate"] == plain["learning_rate"]
    assert fast["pushforward/windows"] == plain["pushforward/windows"] == 4
    for name in ("loss", "pushforward/mse", "gradient_norm"):
        assert fast[name] == pytest.approx(plain[name], rel=1e-3)
    (found,), (wanted,) = (
        [line["one_step/validation"] for line in lines[name] if "one_step/validation" in line]
        for name in ("triton", "torch")
    )
    assert found == pytest.approx(wanted, rel=1e-3)


def test_automatic_precision_of_a_training(data, tmp_path, monkeypatch, capsys, half_fails):
    """With precision auto a training whose fp16 fails the check is bitwise one in the next precision, pushforward and
    average included; it resumes in that precision without trying fp16. A named precision is refused. No graph outlives
    a training."""
    half_fails(parity, "hgn.training.session")
    monkeypatch.setattr("hgn.training.session.triton_unsupported_reason", lambda *_: None)
    made, build = [], TritonUpdates._build
    monkeypatch.setattr(
        TritonUpdates, "_build", lambda self, precision: (made.append(weakref.ref(self)), build(self, precision))
    )
    values = {"ema_decay": 0.7, "pushforward_fraction": 0.5, "pushforward_every": 1, "pushforward_frames": 1}
    values |= {"pushforward_scenes": 1, "noise_correlated_fraction": 0.0}
    ends = []
    for precision in ("fp32", "auto"):
        for updates in (1, 2) if precision == "auto" else (2,):
            with monkeypatch.context() as patch:
                stop_at(patch, updates)
                run = run_mapping(data, tmp_path / precision, precision=precision, **values)
                gc.disable()  # graphs must not wait for it: at the end NCCL waits for them
                try:
                    assert train.main(run) == 0
                    assert made and all(reference() is None for reference in made)
                finally:
                    gc.enable()
        ends.append(read_checkpoint(tmp_path / precision / "checkpoints" / "last.ckpt"))
    errors = capsys.readouterr().err
    assert errors.count("got fp16: its outputs differ") == 1 and "precision=auto trains in fp32" in errors
    assert ends[0]["hgn"] == ends[1]["hgn"] and ends[1]["hgn"]["precision"] == "fp32"
    for key, value in ends[0]["state_dict"].items():
        found = ends[1]["state_dict"][key]
        # on a GPU the order of sums changes
        assert torch.equal(found, value) or (device().type == "cuda" and relative_error(found, value) < 1e-3), key
    refused = run_mapping(data, tmp_path / "refused", precision="fp16", **values)
    with pytest.raises(ConfigError, match=r"training\.precision must be tf32 on this machine, got fp16"):
        train.main(refused)


def test_a_part_of_the_data_is_enough(make_config, make_dataset, tmp_path, monkeypatch):
    """A training with 6 of 14 episodes in memory at a time computes, into its second epoch, bitwise the same windows,
    rates and weights as one with all of them. Each episode is used once an epoch."""
    config = make_config(training_scenes=14, validation_scenes=1, test_scenes=0, frames=3)
    make_dataset(config)
    monkeypatch.setattr("hgn.training.session.triton_unsupported_reason", lambda *_: None)  # in float32
    monkeypatch.setattr(TritonUpdates, "_check", lambda *_: None)
    updates = {"maximum_updates": 20, "batch_scenes": 2, "log_every": 2, "checkpoint_every": 20, "monitor_every": 1000}
    original, built = TritonUpdates.run, EpisodeReader.__init__
    seen, most, brought = [], [], []

    def given(updates, chunk, rates, _):
        for samples, rate in zip(chunk, rates, strict=True):
            windows = [sample.episode.position_TN3[sample.frame :][: HISTORY + 2].clone() for sample in samples]
            seen[-1].append((windows, [tuple(sample[1:]) for sample in samples], rate))

    def run(trainer, chunk, first_update):
        original(trainer, chunk, first_update)
        brought[-1] += len(chunk.episodes)
        most[-1] = max(most[-1], len(trainer._episodes))

    for held in (6, 14):

        def limited(reader, *arguments, held=held):
            built(reader, *arguments)
            reader.capacity = held

        seen.append([])
        most.append(0)
        brought.append(0)
        monkeypatch.setattr(Updates, "run", given)
        monkeypatch.setattr(TritonUpdates, "run", run)
        monkeypatch.setattr(EpisodeReader, "__init__", limited)
        assert train.main(run_mapping(config, tmp_path / str(held), shuffle_episodes=3, **updates)) == 0
    assert most[0] <= 6 < most[1] and brought[0] <= 2 * 14 + 3 and len(seen[0]) == len(seen[1]) == 20
    for (windows, settings, rate), (expected, *others) in zip(*seen, strict=True):
        assert [settings, rate] == others and all(torch.equal(*pair) for pair in zip(windows, expected, strict=True))


def stop_at(monkeypatch, update):
    """Lets the next training end once it has made that many updates, or just after."""
    from hgn.training.callbacks import Stopper

    original = Stopper.on_train_batch_end

    def on_train_batch_end(self, trainer, module, *arguments):
        trainer.should_stop = module.update >= update
        return original(self, trainer, module, *arguments)

    monkeypatch.setattr(Stopper, "on_train_batch_end", on_train_batch_end)


def test_chunks_end_where_something_is_due(monkeypatch):
    """Chunks meet every multiple of the log, checkpoint, monitor and rollout intervals and the last update, whatever
    update a training begins at, and the first ones are short. Measurements begin early and become rarer."""
    monkeypatch.setattr(schedule, "FIRST_MEASUREMENT", 60)
    training = TrainingConfig(
        maximum_updates=1000,
        log_every=50,
        checkpoint_every=70,
        monitor_every=300,
        pushforward_fraction=0.2,
        pushforward_every=32,
    )
    for begun in (0, 37, 999):
        update, ends = begun, []
        while update < 1000:
            count = chunk_length(training, begun, update, EpisodeReader.updates_at_once)
            assert 1 <= count <= EpisodeReader.updates_at_once
            update += count
            ends.append(update)
        due = {n for every in (50, 70, 300, 32) for n in range(every, 1001, every) if n > begun} | {1000}
        due |= {n for n in (75, 150) if n > begun}
        assert due <= set(ends) and ends[-1] == 1000 and ends[0] == begun + 1
    monkeypatch.undo()
    measured = [0]
    while measured[-1] < 150_000:
        measured.append(schedule.next_measurement(replace(training, monitor_every=50_000), measured[-1]))
    assert measured[1:] == [3125, 6250, 12_500, 25_000, 50_000, 100_000, 150_000]
    assert schedule.next_measurement(replace(training, monitor_every=1000), 0) == 1000
