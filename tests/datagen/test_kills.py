"""SIGKILL of anything, at any moment, costs time and nothing else; `python -m tools.studies.kills` is longer."""

import sys

import pytest
from processes import BALLISTIC_PATH

from hgn.data.manifest import Manifest
from hgn.schema import ConfigError
from tools.studies.kills import TARGETS, KillsConfig, differences, equal_shards, generate_with_kills


@pytest.fixture
def command(control, tmp_path, monkeypatch):
    """The command line of the ballistic service for a configuration; its data set goes to `killed`."""
    monkeypatch.setenv("PYTHONPATH", BALLISTIC_PATH)

    def make(config):
        keys = ("training_scenes", "validation_scenes", "test_scenes", "frames", "workers", "maximum_attempts")
        overrides = [f"dataset.{key}={getattr(config.dataset, key)}" for key in keys]
        folder = f"out={tmp_path / 'killed'}"
        return [sys.executable, "-m", "ballistic_service", *overrides, folder, "port=0", "progress=off"]

    return make


@pytest.mark.skipif(sys.platform != "linux", reason="finds the processes in /proc")
def test_nothing_is_lost(make_config, make_dataset, command, control, tmp_path):
    """A generation whose worker, pool, service and all of these are killed makes the data set of one in peace, bitwise,
    and leaves no temporary file."""
    config = make_config(training_scenes=6, maximum_attempts=100)
    peaceful, killed = make_dataset(config), tmp_path / "killed"
    (control / "slow").touch()
    kills = generate_with_kills(command(config), killed, KillsConfig(kills=4, interval_s=0.5), tmp_path / "log")
    assert {kill.target for kill in kills} == set(TARGETS)
    assert differences(peaceful, killed) == []
    assert equal_shards(peaceful, killed) == len(Manifest.load(peaceful).shards)


@pytest.mark.skipif(sys.platform != "linux", reason="finds the processes in /proc")
def test_faults_are_seen(make_config, make_dataset, command, tmp_path):
    """A comparison that could not fail would prove nothing: each kind of harm is named."""
    peaceful = make_dataset(make_config(folder=str(tmp_path / "peaceful")))
    other = make_dataset(make_config(folder=str(tmp_path / "other"), seed=1))
    assert sum("another scene" in text for text in differences(peaceful, other)) == 8
    fewer = make_dataset(make_config(folder=str(tmp_path / "fewer"), training_scenes=3))
    (fewer / ".train-000000-000001.tar.1.partial").touch()
    assert differences(peaceful, fewer) == [
        "its shards have other names",
        "train: other episodes",
        ".train-000000-000001.tar.1.partial was left behind",
    ]
    with pytest.raises(ConfigError, match="kills must fall into the generation, got 0 of 1 before it was complete"):
        generate_with_kills(
            command(make_config(training_scenes=1, validation_scenes=0, test_scenes=0)),
            tmp_path / "killed",
            KillsConfig(kills=1, interval_s=1000),
            tmp_path / "log",
        )
