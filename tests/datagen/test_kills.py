"""SIGKILL of any process of a generation, at any moment, costs only time."""

import sys

import pytest
from kills import TARGETS, differences, generate_with_kills
from processes import BALLISTIC_PATH


@pytest.mark.skipif(sys.platform != "linux", reason="finds the processes in /proc")
def test_nothing_is_lost(make_config, make_dataset, control, tmp_path, monkeypatch):
    """A generation whose worker, pool, service and all processes are killed writes the data set of an undisturbed one,
    bitwise, and leaves no temporary file."""
    monkeypatch.setenv("PYTHONPATH", BALLISTIC_PATH)
    config = make_config(training_scenes=6)
    peaceful, killed = make_dataset(config), tmp_path / "killed"
    (control / "slow").touch()
    keys = ("training_scenes", "validation_scenes", "test_scenes", "frames", "workers")
    settings = [f"dataset.{key}={getattr(config.dataset, key)}" for key in keys]
    command = [sys.executable, "-m", "ballistic_service", *settings, f"out={killed}", "port=0", "progress=off"]
    kills = generate_with_kills(command, killed, 4, 0.5, tmp_path / "log")
    assert set(kills) == set(TARGETS)
    assert differences(peaceful, killed) == []
    (killed / ".train-000000-000001.tar.1.partial").touch()
    (killed / "train-000000-000001.tar").write_bytes(b"")
    assert len(differences(peaceful, killed)) == 2
