"""Tests temporary faults of a run's folder before the first update."""

import errno
import os
import sys
from pathlib import Path

import pytest
from training.runs import metrics, train_mapping

from hgn import train
from hgn.system.patience import VARIABLE
from hgn.training.checkpoint import read_checkpoint


class Faults:
    """Lets each opening, renaming, listing and removing of a file in a folder fail once."""

    folder = None  # an audit hook cannot be removed
    number, seen = errno.EIO, set[tuple[str, str]]()

    @classmethod
    def hook(cls, event, arguments):
        if cls.folder is None or event not in (
            "open",
            "os.mkdir",
            "os.rename",
            "os.remove",
            "os.scandir",
            "os.listdir",
        ):
            return
        path = arguments[0] if isinstance(arguments[0], str) else ""
        place = event, path.partition(".partial")[0].rpartition(".")[0] if ".partial" in path else path
        if path.startswith(cls.folder) and place not in cls.seen:
            cls.seen.add(place)
            raise OSError(cls.number, os.strerror(cls.number), path)


sys.addaudithook(Faults.hook)


@pytest.fixture
def faults(monkeypatch, tmp_path):
    monkeypatch.setattr("hgn.system.patience.FIRST_PAUSE_S", 0.02)
    monkeypatch.setattr(Faults, "folder", str(tmp_path / "run"))
    monkeypatch.setattr(Faults, "seen", set())
    return Faults


def test_a_start_outlives_faults_of_a_server(data, faults, tmp_path):
    """A new run and a resumed one train as ever, although each file of the folder fails at first."""
    run = tmp_path / "run"
    for updates in (6, 8):
        faults.seen.clear()
        assert train.main(train_mapping(data, run, maximum_updates=updates, loggers=[], monitor_every=100)) == 0
        assert {Path(path).name for _, path in faults.seen} >= {".lock", ".config.yaml"}
    faults.folder = None
    assert read_checkpoint(run / "checkpoints" / "last.ckpt")["hgn"]["updates"] == 8
    lines = [line["update"] for line in metrics(run) if "loss" in line]
    assert lines == sorted(set(lines))


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS, errno.ENAMETOOLONG, errno.ENOSPC])
def test_a_start_does_not_wait_for_other_faults(data, faults, tmp_path, monkeypatch, number):
    """A folder that cannot be used is an error at once, because it may be a mistake in its name."""
    monkeypatch.setattr("hgn.system.patience.FIRST_PAUSE_S", 100.0)
    monkeypatch.setattr(faults, "number", number)
    with pytest.raises(OSError, match=os.strerror(number)) as raised:
        train.main(train_mapping(data, tmp_path / "run", loggers=[]))
    assert raised.value.errno == number


def test_a_start_ends_after_the_patience(data, faults, tmp_path, monkeypatch):
    """The error names a file of the run."""
    monkeypatch.setenv(VARIABLE, "0")
    with pytest.raises(OSError, match=r"no answer for 0 s .*Input/output error.*run"):
        train.main(train_mapping(data, tmp_path / "run", loggers=[]))
