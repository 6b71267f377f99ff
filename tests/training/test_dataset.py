"""Tests the data set of a training: cost of its scenes, missing scenes, progress, and several data sets."""

import re
from pathlib import Path
from unittest import mock

import pytest
from omegaconf import OmegaConf
from training.runs import NETWORK, TRAINING, metrics, train_mapping

from hgn import train
from hgn.config import DatasetConfig, NetworkConfig, TrainConfig, TrainingConfig
from hgn.data.manifest import Manifest
from hgn.data.pooled import PooledStore
from hgn.data.reader import EpisodeStore
from hgn.data.statistics import merge_statistics
from hgn.schema import ConfigError, from_mapping
from hgn.system.progress import bar, duration
from hgn.training import callbacks
from hgn.training.checkpoint import Progress, read_checkpoint
from hgn.training.data_module import EpisodeDataModule
from hgn.training.dataset import WAY_OUT, PublishedEpisodes, estimate, warning_on_a_cpu
from hgn.training.readers import WindowReader


@pytest.fixture
def run(tmp_path):
    return tmp_path / "run"


def test_progress_reads_the_data_set_seldom(make_config, make_dataset, tmp_path, monkeypatch):
    """Reading a manifest of hundreds of scenes with every line cost a third of the updates: it is read once in a while,
    and never again once all scenes are there."""
    config = make_config(training_scenes=2)
    make_dataset(config)
    looks, now = [], [0.0]
    load = Manifest.load
    monkeypatch.setattr(Manifest, "load", lambda *a, **k: looks.append(now[0]) or load(*a, **k))
    monkeypatch.setattr("hgn.training.dataset.time.monotonic", lambda: now[0])
    for wanted, expected in ((3, [0.0, 12.0, 24.0]), (2, [0.0])):
        mapping = train_mapping(config, tmp_path)
        mapping["dataset"]["training_scenes"] = wanted
        del mapping["name"]
        text = PublishedEpisodes(from_mapping(TrainConfig, mapping), None)
        looks.clear()
        for now[0] in (0.0, 4.0, 8.0, 12.0, 16.0, 20.0, 24.0, 28.0):
            assert text() == f"2/{wanted} episodes"
        assert looks == expected


def test_what_a_training_takes_is_said(make_config, make_dataset, tmp_path, monkeypatch, capsys):
    """The first scenes determine the estimates of time and space for all, and the first updates that of the training's
    time. On a CPU the message names faster ways."""
    config = make_config()
    make_dataset(config)
    frames = config.dataset.frames
    scenes = sum(config.dataset.scenes(split) for split in ("train", "validation", "test"))
    for present in (0, 2):  # before a resume
        text = estimate(config, frames, present, 3600.0)
        assert text.startswith(f"about {scenes - 1 - present} hours for the rest of {scenes} scenes")
        assert " GB are free" in text
    assert duration(40) == "40 seconds" and duration(61.4 * 86400) == "61 days" and duration(12600) == "3.5 hours"
    monkeypatch.setattr(callbacks, "ESTIMATE_AFTER_S", 0.0)
    monkeypatch.setattr(callbacks, "LONG_ON_A_CPU_S", -1.0)
    bars = []
    monkeypatch.setattr(callbacks, "bar", lambda *given, **named: bars.append(bar(*given, **named)) or bars[-1])
    monkeypatch.setattr(callbacks.LogLines, "on_train_end", lambda *_: None)
    assert train.main(train_mapping(config, tmp_path / "run", maximum_updates=3, log_every=50)) == 0
    assert bars[0].n == 3
    bars[0].close()
    assert [record["update"] for record in metrics(tmp_path / "run") if "loss" in record] == [3]
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("about ")]
    assert "for the remaining updates, at" in line and "on a CPU: +experiment=demo (minutes), " in line


def test_the_trial_that_the_warning_offers_is_that_of_the_tutorial():
    """It has a run and a data set of its own, and fewer frames than one scene of the main job."""
    page = (Path(__file__).parents[2] / "docs/tutorials/train.md").read_text()
    block = next(block for block in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL) if "run: runs/trial" in block)
    trial = OmegaConf.create(block)
    offered = OmegaConf.from_dotlist(re.findall(r"(?<=[ (])[a-z_.]+=[\w/]+(?=[ )])", WAY_OUT))
    assert {"run", "dataset", "training"} == set(offered) and OmegaConf.merge(trial, offered) == trial
    assert offered.dataset.frames * (offered.dataset.training_scenes + offered.dataset.validation_scenes) < 300


@pytest.mark.parametrize(("update", "printed"), [(5, True), (11, False)])
def test_times_of_seconds_are_not_estimated(tmp_path, monkeypatch, update, printed):
    """After 100 seconds of 12 updates, 7 left take 140 seconds, which is said, and 1 left 9 seconds, which is not."""
    feed, progress = mock.Mock(training=mock.Mock(maximum_updates=12)), mock.Mock()
    feed.interrupted.return_value = False
    lines = callbacks.LogLines(tmp_path, {}, feed, str)
    lines._first = (0.0, 0)
    monkeypatch.setattr("hgn.training.callbacks.time.monotonic", lambda: 100.0)
    lines._estimate(mock.Mock(update=update), progress)
    assert progress.write.called == printed


def test_long_data_sets_are_announced_before_they_are_made(make_config, tmp_path, monkeypatch, capsys):
    """On a CPU, a data set of more than an hour is announced with time, space and the way out, before its generator
    starts. A finished one is not."""
    monkeypatch.setattr("hgn.training.dataset.available_cpus", lambda: 2)
    line = warning_on_a_cpu(TrainConfig(dataset=DatasetConfig(folder=str(tmp_path))), None)
    assert line.startswith(
        "no GPU: 825 scenes take roughly 19 hours and 10 GB here, before most of 20,000,000 updates;"
    )
    assert "dataset.test_scenes=0" in line
    assert warning_on_a_cpu(make_config(), None) is None
    monkeypatch.setattr("hgn.training.dataset.LONG_ON_A_CPU_S", 0.0)
    monkeypatch.setattr(
        "hgn.training.generator.Generator.__init__", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt)
    )
    with pytest.raises(KeyboardInterrupt):
        train.main(train_mapping(make_config(), tmp_path / "run", generate=True))
    assert capsys.readouterr().err.startswith("no GPU: ")


def test_missing_scenes_without_generator(data, run, capsys):
    """A training that makes no scenes names the splits that lack some."""
    mapping = train_mapping(data, run, maximum_updates=1)
    mapping["dataset"] |= {"validation_scenes": 3}
    assert train.main(mapping) == 0
    assert (
        f"{data.dataset.folder} has 2 of 3 validation scenes, and this training generates none\n"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize("generate", [False, True])
def test_manifest_is_read_once_for_missing_scenes(data, run, monkeypatch, generate):
    """The start reads the manifest for imported data, for the settings, and for the episodes: not for what lacks."""
    reads, load = [], Manifest.load
    monkeypatch.setattr(Manifest, "load", lambda *a, **k: reads.append(a) or load(*a, **k))
    monkeypatch.setattr("hgn.training.session.train_network", lambda *_: 0)
    assert train.main(train_mapping(data, run, generate=generate)) == 0
    assert len(reads) == 3


def test_missing_data_without_generator(make_config, run):
    """Without data and with generate=false the message explains how to make some."""
    with pytest.raises(ConfigError, match="generate it with python -m datagen"):
        train.main(train_mapping(make_config(), run))


@pytest.fixture
def other(make_config, make_dataset, tmp_path):
    """The configuration of a second data set, which is there: of another seed and longer episodes."""
    config = make_config(folder=str(tmp_path / "other"), seed=1, training_scenes=3, frames=9)
    make_dataset(config)
    return config


def test_more_data(data, other, run):
    """A run on two data sets has the episodes and the statistics of both, and resumes with both. Without the second set
    it does not resume within an epoch."""
    more = {"more_data": [other.dataset.folder], "minimum_episodes": 8}
    assert train.main(train_mapping(data, run, **more, maximum_updates=6)) == 0
    assert {record["episodes"] for record in metrics(run) if "loss" in record} == {8}
    stores = [EpisodeStore(config.dataset.folder, "train") for config in (other, data)]
    mean = merge_statistics(store.statistics() for store in stores).velocity.mean
    stored = read_checkpoint(run / "checkpoints" / "last.ckpt")["state_dict"]
    assert stored["network.normaliser.velocity_mean"].tolist() == pytest.approx(mean)
    with pytest.raises(ConfigError, match="data set must still contain the 8 training episodes"):
        train.main(train_mapping(data, run))
    assert train.main(train_mapping(data, run, **more)) == 0
    network, training = NetworkConfig(**NETWORK), TrainingConfig(**TRAINING)
    pooled = PooledStore(stores[1], stores[:1])
    *_, last = EpisodeDataModule(pooled, training, WindowReader(pooled, network, training)).chunks()
    progress = Progress.of(read_checkpoint(run / "checkpoints" / "last.ckpt"))
    assert progress == Progress(12, 0, last.sampler_state, "fp32")
