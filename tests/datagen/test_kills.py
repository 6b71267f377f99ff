"""SIGKILL of any process of a generation, at any moment, costs only time."""

import sys

import pytest
from kills import TARGETS, differences, equal_shards, generate_with_kills
from processes import BALLISTIC_PATH

from hgn.data.manifest import Manifest


@pytest.fixture
def command(control, tmp_path, monkeypatch):
    """The command line of the ballistic service for a configuration; its data set goes to `killed`."""
    monkeypatch.setenv("PYTHONPATH", BALLISTIC_PATH)

    def make(config):
        keys = ("training_scenes", "validation_scenes", "test_scenes", "frames", "workers")
        overrides = [f"dataset.{key}={getattr(config.dataset, key)}" for key in keys]
        folder = f"out={tmp_path / 'killed'}"
        return [sys.executable, "-m", "ballistic_service", *overrides, folder, "port=0", "progress=off"]

    return make


@pytest.mark.skipif(sys.platform != "linux", reason="finds the processes in /proc")
def test_nothing_is_lost(make_config, make_dataset, command, control, tmp_path):
    """A generation whose worker, pool, service and all processes are killed writes the data set of an undisturbed one,
    bitwise, and leaves no temporary file."""
    config = make_config(training_scenes=6)
    peaceful, killed = make_dataset(config), tmp_path / "killed"
    (control / "slow").touch()
    kills = generate_with_kills(command(config), killed, 4, 0.5, tmp_path / "log")
    assert set(kills) == set(TARGETS)
    assert differences(peaceful, killed) == []
    assert equal_shards(peaceful, killed) == len(Manifest.load(peaceful).shards)


@pytest.mark.skipif(sys.platform != "linux", reason="finds the processes in /proc")
def test_faults_are_seen(make_config, make_dataset, command, tmp_path):
    """The comparison names each kind of damage."""
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
    with pytest.raises(AssertionError, match="complete after 0 of 1 kills"):
        generate_with_kills(
            command(make_config(training_scenes=1, validation_scenes=0, test_scenes=0)),
            tmp_path / "killed",
            1,
            1000,
            tmp_path / "log",
        )
