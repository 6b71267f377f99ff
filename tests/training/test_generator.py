"""The generator that a training starts itself: a process of its own, that makes what is missing."""

import signal
import time
from dataclasses import replace
from unittest import mock

import pytest
import yaml
from processes import PATIENCE_S

from hgn.config import DatagenConfig, DatasetConfig, MpmConfig, SceneConfig, TrainConfig, TrainingConfig
from hgn.data.manifest import Manifest
from hgn.data.reader import EpisodeStore
from hgn.schema import ConfigError
from hgn.system.progress import bar
from hgn.training.dataset import wait_for_episodes
from hgn.training.generator import Generator
from hgn.training.stop import StopRequest


def small_config(folder):
    return DatagenConfig(
        scene=SceneConfig(
            obstacle_count=1, obstacle_shapes=("cone",), group_count=1, group_size=0.03, materials=("water",)
        ),
        mpm=MpmConfig(device="cpu"),
        dataset=DatasetConfig(
            folder=str(folder), training_scenes=2, validation_scenes=1, test_scenes=0, frames=3, workers=1
        ),
    )


def wait(generator):
    """Until it has ended; the numbers of frames that it told of."""
    end, done = time.monotonic() + PATIENCE_S, set()
    while generator.running and time.monotonic() < end:
        time.sleep(0.05)
        done.add(generator.frames_done())
    assert not generator.running
    return done | {generator.frames_done()}


def test_makes_what_is_missing(tmp_path):
    """The generator makes the first episodes early, reports the number of finished frames, continues after a stop, and
    completes the data set. If the folder contains another data set, `check` raises the generator's message and names
    its log."""
    config = small_config(tmp_path / "data")
    generator = Generator(config, tmp_path / "run")
    assert yaml.safe_load((tmp_path / "run/dataset.yaml").read_text())["progress"] == "json"  # few scenes first
    while generator.running and b"{" not in generator.log_path.read_bytes():
        time.sleep(0.05)
    generator.stop()
    assert not generator.running
    generator = Generator(config, tmp_path / "run")
    done = wait(generator)
    generator.check()
    manifest = Manifest.load(config.dataset.folder)
    assert manifest.complete and sum(len(shard.episodes) for shard in manifest.shards) == 3
    assert min(done) == 0 < max(done) <= 9
    assert generator.kept == 3 and max(done) == 3 * (3 - generator.present)
    for episode in EpisodeStore(config.dataset.folder, "train"):  # the real solver's
        assert episode.solver["counters"]["substeps"] > 0 and len(episode.obstacle_grid.cell_K3) > 0

    other = Generator(replace(config, mpm=replace(config.mpm, poisson_ratio=0.3)), tmp_path / "other")
    wait(other)
    with pytest.raises(ConfigError, match=r"contains another data set: mpm.poisson_ratio .*log: .*datagen.log"):
        other.check()


def test_the_bar_counts_the_frames_that_are_waited_for(tmp_path, monkeypatch, capsys):
    """The bar counts the frames of validation scenes that are made before the last training scene needed. Its rate
    and the estimate leave out the time until the first frame, in which processes start and kernels are compiled."""
    dataset = DatasetConfig(folder=str(tmp_path), training_scenes=4, validation_scenes=5, frames=40)
    config = TrainConfig(dataset=dataset, training=TrainingConfig(minimum_episodes=2))
    bars, stop, store = [], StopRequest(), mock.MagicMock()
    monkeypatch.setattr(
        "hgn.training.dataset.bar", lambda *given, **named: bars.append(bar(*given, **named)) or bars[0]
    )

    def pass_time(_):
        seconds = next(looks)
        bars[0]._time = lambda: start_s + seconds

    looks = iter((60.0, 65.0))
    start_s = time.time()
    monkeypatch.setattr("hgn.training.dataset.time.sleep", pass_time)
    generator = mock.Mock(running=True, frames_done=mock.Mock(side_effect=(0, 1, 3)), present=0, found=0)
    store.available.side_effect = (False, False, True)
    store.return_value.__len__.return_value = 2
    store.return_value.manifest.published.return_value = 1
    monkeypatch.setattr("hgn.training.dataset.EpisodeStore", store)
    monkeypatch.setattr("hgn.training.dataset.estimate", lambda *given: given)
    assert wait_for_episodes(config, generator, stop) is store.return_value
    (progress,) = bars
    assert str((config, 3, 0, 5.0)) in capsys.readouterr().err
    assert progress.total == 3 * 40 and progress.n == 1
    assert progress.format_dict["elapsed"] == pytest.approx(5.0)
    progress.close()


def test_a_resumed_wait_counts_the_scenes_that_are_there(make_config, make_dataset, monkeypatch, capsys):
    """The bar begins with the published scenes that are waited for, and a staged one advances it. The lines at the
    start and after a stop tell how many scenes are missing and kept."""
    make_dataset(make_config(training_scenes=1, validation_scenes=0, test_scenes=0))
    made = make_config(training_scenes=2, validation_scenes=3, test_scenes=0)
    config = TrainConfig(scene=made.scene, dataset=made.dataset, training=TrainingConfig(minimum_episodes=2))
    frames, bars, stop = made.dataset.frames, [], StopRequest()
    monkeypatch.setattr(
        "hgn.training.dataset.bar", lambda *given, **named: bars.append(bar(*given, **named)) or bars[0]
    )
    monkeypatch.setattr("hgn.training.dataset.time.sleep", lambda _: setattr(stop, "signal", signal.SIGINT))
    generator = mock.Mock(running=True, frames_done=lambda: 1, found=1, kept=2)
    assert wait_for_episodes(config, generator, stop) is None
    assert (bars[0].initial, bars[0].n, bars[0].total) == (frames, 2 * frames + 1, 3 * frames)
    (waiting, stopped) = (line for line in capsys.readouterr().err.splitlines() if "waiting" in line)
    missing = "waiting for 1 training and 1 validation scenes"
    assert waiting == f"{missing} in {config.dataset.folder}"
    assert stopped.startswith(f"stopped while {missing}; 2 of 5 scenes are kept, ")
    assert generator.stop.called  # before the line


def test_waits_for_a_validation_scene(make_config, make_dataset, monkeypatch):
    """While its generator runs, a training waits for a validation scene: a short training might end without one, and
    without best.ckpt. It does not wait if no scene is requested or nothing makes one. A generator may make the last
    scene and end just after a check."""
    config, looks = make_config(validation_scenes=1, test_scenes=0), []
    few = make_config(training_scenes=1, validation_scenes=0, test_scenes=0)
    make_dataset(few)
    ended, generator = mock.Mock(running=False), mock.Mock(running=True, frames_done=lambda: 0, found=0)

    def validation_scenes(config, generator):
        training = TrainConfig(scene=config.scene, dataset=config.dataset)
        return len(wait_for_episodes(training, generator, StopRequest()).of_split("validation"))

    def look(store, *given):
        load(store, *given)
        if not looks:
            make_dataset(config)
        looks.append(len(store))
        generator.running = False

    for wanted, maker in ((few, generator), (config, None), (config, ended)):
        assert validation_scenes(wanted, maker) == 0
    load = EpisodeStore.__init__
    monkeypatch.setattr(EpisodeStore, "__init__", look)
    monkeypatch.setattr("hgn.training.dataset.time.sleep", lambda _: None)
    assert validation_scenes(config, generator) == 1 and looks == [1, 5]
