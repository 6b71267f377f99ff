"""The training command: from shards to checkpoints, resume, stop, and every refusal."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import yaml
from training.runs import metrics, train_mapping

import hgn.training.stop
from hgn import train
from hgn.config import DatagenConfig
from hgn.schema import ConfigError
from hgn.training.checkpoint import read_checkpoint
from hgn.training.module import TrainingModule

MakeConfig = Callable[..., DatagenConfig]
MakeDataset = Callable[[DatagenConfig], Path]


@pytest.fixture(autouse=True)
def keep_signal_handlers():
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.fixture
def data(make_config: MakeConfig, make_dataset: MakeDataset) -> DatagenConfig:
    config = make_config()
    make_dataset(config)
    return config


def weights(path: Path) -> dict[str, torch.Tensor]:
    return read_checkpoint(path)["state_dict"]


def test_a_run_leaves_what_it_promises(data, tmp_path):
    """Checkpoints, metrics with one-step and rollout errors of both splits, a picture, events, the resolved config."""
    run = tmp_path / "run"
    assert train.main(train_mapping(data, run)) == 0
    checkpoint = read_checkpoint(run / "checkpoints" / "last.ckpt")
    assert checkpoint["hgn"]["updates"] == 12 and (run / "checkpoints" / "best.ckpt").is_file()
    records = metrics(run)
    keys = set().union(*records)
    for split in ("training", "validation"):
        assert {f"one_step/{split}", f"trivial/{split}_ballistic_motion", f"one_step_gain/{split}"} <= keys
    assert {"loss", "learning_rate", "rollout/finished", "updates_per_second"} <= keys
    rates = [record["learning_rate"] for record in records if "learning_rate" in record]
    assert rates == pytest.approx([1e-3 * 0.1 ** (n / 12) for n in (4, 8, 12)])
    assert list((run / "tensorboard").glob("events.*"))
    stored = yaml.safe_load((run / "config.yaml").read_text())
    assert stored["training"]["maximum_updates"] == 12 and stored["provenance"]["data_schema_version"] == 1


def test_resume_equals_no_interruption(data, tmp_path):
    """Stopped after 7 of 12 updates and started again, a run ends bitwise where an uninterrupted one does: weights,
    optimiser, order, noise and jitter."""
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert train.main(train_mapping(data, whole)) == 0

    original = hgn.training.stop.StopRequest.requested
    calls = iter(range(100))
    try:
        hgn.training.stop.StopRequest.requested = property(lambda self: next(calls) >= 7)
        train.main(train_mapping(data, cut))
    finally:
        hgn.training.stop.StopRequest.requested = original
    stopped = read_checkpoint(cut / "checkpoints" / "last.ckpt")["hgn"]["updates"]
    assert 0 < stopped < 12
    assert train.main(train_mapping(data, cut)) == 0
    expected, found = (read_checkpoint(run / "checkpoints" / "last.ckpt") for run in (whole, cut))
    assert found["hgn"] == expected["hgn"]
    for name, tensor in expected["state_dict"].items():
        assert torch.equal(found["state_dict"][name], tensor), name
    states = [c["optimizer_states"][0]["state"] for c in (expected, found)]
    for index in states[0]:
        assert torch.equal(states[0][index]["exp_avg_sq"], states[1][index]["exp_avg_sq"])


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1, signal.SIGINT])
def test_signals_end_the_run_after_a_checkpoint(data, tmp_path, monkeypatch, number):
    """A real signal in the middle of an update ends the run at that update, with a checkpoint and 128 + its number."""
    original = TrainingModule.on_before_optimizer_step

    def signalled(module, optimizer):
        if module.global_step == 2:
            os.kill(os.getpid(), number)
        return original(module, optimizer)

    monkeypatch.setattr(TrainingModule, "on_before_optimizer_step", signalled)
    run = tmp_path / "run"
    assert train.main(train_mapping(data, run)) == 128 + number
    assert read_checkpoint(run / "checkpoints" / "last.ckpt")["hgn"]["updates"] == 3


def test_a_finished_run_stays_finished(data, tmp_path):
    """Starting a finished run again makes no update and changes no weight."""
    run = tmp_path / "run"
    train.main(train_mapping(data, run))
    before = weights(run / "checkpoints" / "last.ckpt")
    assert train.main(train_mapping(data, run)) == 0
    after = read_checkpoint(run / "checkpoints" / "last.ckpt")
    assert after["hgn"]["updates"] == 12
    assert all(torch.equal(before[name], tensor) for name, tensor in after["state_dict"].items())


def test_training_learns(make_config, make_dataset, tmp_path):
    """On free fall with strong velocity noise, 120 updates learn to undo a good part of the noise."""
    config = make_config(training_scenes=6, frames=30)
    make_dataset(config)
    run = tmp_path / "run"
    changes = {"maximum_updates": 120, "log_every": 10, "monitor_every": 120, "learning_rate": 1e-2, "noise_std": 0.02}
    train.main(train_mapping(config, run, **changes))
    losses = [record["loss"] for record in metrics(run) if "loss" in record]
    assert sum(losses[-4:]) < 0.9 * sum(losses[:4])


@pytest.mark.parametrize(
    ("section", "change", "message"),
    [
        ("network", {"width": 16}, "network.width must be 8 to go on with"),
        ("network", {"levels": 3}, "network.levels must be 2"),
        ("training", {"noise_std": 0.0}, "training.noise_std must be"),
    ],
)
def test_checkpoints_of_another_configuration_are_refused(data, tmp_path, section, change, message):
    """Resuming with another network or noise names the key, and leaves the checkpoint as it was."""
    run = tmp_path / "run"
    train.main(train_mapping(data, run, maximum_updates=2))
    before = (run / "checkpoints" / "last.ckpt").read_bytes()
    mapping = train_mapping(data, run)
    mapping[section] |= change
    with pytest.raises(ConfigError, match=message):
        train.main(mapping)
    assert (run / "checkpoints" / "last.ckpt").read_bytes() == before


def test_another_data_set_is_refused(data, make_config, tmp_path):
    """A run goes on with the data it began with; a folder that holds another data set is named."""
    run = tmp_path / "run"
    train.main(train_mapping(data, run, maximum_updates=2))
    with pytest.raises(ConfigError, match="frames is 6 there, 7 is asked for"):
        train.main(train_mapping(make_config(frames=7), run))


def test_damaged_checkpoints_are_refused(data, tmp_path):
    """A cut checkpoint ends in a message, not in a traceback, and stays."""
    run = tmp_path / "run"
    train.main(train_mapping(data, run, maximum_updates=2))
    path = run / "checkpoints" / "last.ckpt"
    cut = path.read_bytes()[: path.stat().st_size // 2]
    path.write_bytes(cut)
    with pytest.raises(ConfigError, match="must be a whole checkpoint file"):
        train.main(train_mapping(data, run))
    assert path.read_bytes() == cut


def test_missing_data_without_generator(make_config, tmp_path):
    """Without data and with generate=false the message says how to make some."""
    with pytest.raises(ConfigError, match="generate it with python -m datagen"):
        train.main(train_mapping(make_config(), tmp_path / "run"))


@pytest.mark.parametrize(
    ("section", "change", "message"),
    [
        ("training", {"learning_rate": float("nan")}, "training.learning_rate must be a finite number > 0"),
        ("training", {"learning_rate": -1.0}, "training.learning_rate must be a finite number > 0"),
        ("training", {"batch_scenes": 0}, "training.batch_scenes must be"),
        ("training", {"batch_scenes": "many"}, "training.batch_scenes must be a whole number"),
        ("training", {"batchscenes": 2}, "training.batchscenes is not a known key; did you mean batch_scenes"),
        ("network", {"materials": ["lava"]}, "network.materials"),
        ("scene", {"materials": ["lava"]}, "scene.materials"),
        ("network", {"obstacle_features": False}, "obstacle_features must be true"),
    ],
)
def test_bad_configuration(make_config, tmp_path, section, change, message):
    """Unknown keys, wrong types, negative and NaN numbers and unknown materials are named before anything starts."""
    mapping = train_mapping(make_config(), tmp_path / "run")
    mapping[section] |= change
    with pytest.raises(ConfigError, match=message):
        train.main(mapping)
    assert not (tmp_path / "run").exists()
