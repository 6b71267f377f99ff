"""Tests checkpoints that are written during updates: their content, and the handling of faults."""

import errno
import os
import signal
import threading
from contextlib import nullcontext, suppress
from pathlib import Path

import pytest
import torch
from training.runs import train_mapping

from hgn import train
from hgn.system.files import write_atomically
from hgn.system.patience import VARIABLE
from hgn.training import checkpoint_writer
from hgn.training.checkpoint import LAST_NAMES, read_checkpoint
from hgn.training.checkpoint_writer import CheckpointWriter
from hgn.training.torch_updates import TorchUpdates


@pytest.fixture
def writer():
    made = CheckpointWriter()
    yield made
    made.teardown()


class Gate:
    """Blocks every write until it is opened, and records the events."""

    def __init__(self, monkeypatch):
        self.opened = threading.Event()
        self.events: list[str] = []
        monkeypatch.setattr(checkpoint_writer, "write_atomically", self.write)

    def write(self, path, *rest):
        self.events.append(f"begin {path.name}")
        assert self.opened.wait(60)
        write_atomically(path, *rest)
        self.events.append(f"end {path.name}")


def load(path):
    return torch.load(path, weights_only=True)


def test_the_content_is_that_of_the_moment(writer, tmp_path, monkeypatch):
    """Weights, moments and numbers that change while the file is written are in it as they were before."""
    gate = Gate(monkeypatch)
    weights = torch.arange(6.0)
    checkpoint = {"weights": weights[2:].view(2, 2), "moments": [weights[:2]], "update": {"number": 5}}
    writer.save_checkpoint(checkpoint, tmp_path / "last.ckpt")
    weights.zero_()
    checkpoint["update"]["number"] = 6
    gate.opened.set()
    writer.wait()
    found = load(tmp_path / "last.ckpt")
    assert torch.equal(found["weights"], torch.tensor([[2.0, 3.0], [4.0, 5.0]]))
    assert torch.equal(found["moments"][0], torch.tensor([0.0, 1.0])) and found["update"] == {"number": 5}


def test_shared_memory_is_stored_once(writer, tmp_path):
    """Tensors that are parts of one buffer, as on backend triton, take the buffer's size in the file."""
    flat = torch.randn(100_000)
    writer.save_checkpoint({str(n): part for n, part in enumerate(flat.split(1000))}, tmp_path / "a.ckpt")
    writer.wait()
    assert flat.nbytes < (tmp_path / "a.ckpt").stat().st_size < 1.1 * flat.nbytes
    assert torch.equal(torch.cat(list(load(tmp_path / "a.ckpt").values())), flat)


def test_one_write_at_a_time(writer, tmp_path, monkeypatch):
    """The next write waits for the present one, and both files are written."""
    gate = Gate(monkeypatch)
    writer.save_checkpoint({"value": 1}, tmp_path / "first.ckpt")
    second = threading.Thread(target=writer.save_checkpoint, args=({"value": 2}, tmp_path / "second.ckpt"))
    second.start()
    second.join(0.2)
    assert second.is_alive() and gate.events in ([], ["begin first.ckpt"])
    gate.opened.set()
    second.join()
    writer.wait()
    assert gate.events == ["begin first.ckpt", "end first.ckpt", "begin second.ckpt", "end second.ckpt"]
    assert load(tmp_path / "first.ckpt") == {"value": 1} and load(tmp_path / "second.ckpt") == {"value": 2}


def test_a_failed_write_is_raised(tmp_path):
    """By the next write, by waiting for it, or at the end; once."""
    (tmp_path / "folder.ckpt").mkdir()  # no file can take its place
    for raising in (
        lambda writer: writer.save_checkpoint({}, tmp_path / "good.ckpt"),
        CheckpointWriter.wait,
        CheckpointWriter.teardown,
    ):
        writer = CheckpointWriter()
        writer.save_checkpoint({"value": 1}, tmp_path / "folder.ckpt")
        with pytest.raises(IsADirectoryError, match=r"folder\.ckpt"):
            raising(writer)
        writer.wait()
        writer.teardown()
    assert [path.name for path in tmp_path.iterdir()] == ["folder.ckpt"]


@pytest.mark.parametrize(
    ("place", "name", "passing", "failing"),
    [
        *((Path, "open", 0, times) for times in (3, 100)),
        *((os, "fsync", 0, times) for times in (3, 100)),
        (os, "fsync", 1, 3),  # of the folder
        *((Path, "replace", passing, failing) for passing in range(3) for failing in (3, 100)),
        (Path, "touch", 0, 3),
    ],
)
def test_a_failed_write_loses_no_older_checkpoint(writer, tmp_path, monkeypatch, place, name, passing, failing):
    """Retries of a write replace one checkpoint by the new one, whichever step fails. A write that is given up
    leaves three different checkpoints too, the newest of them as last.ckpt."""

    def save(update):
        section = {"updates": update, "sampler_state": {}}
        writer.save_checkpoint({"state_dict": {}, "hgn": section}, tmp_path / "checkpoints" / "last.ckpt")
        writer.wait()

    def stored():
        return [read_checkpoint(tmp_path / "checkpoints" / name)["hgn"]["updates"] for name in LAST_NAMES]

    for update in (1, 2, 3):
        save(update)
    function, calls = getattr(place, name), []

    def step(*given, **named):
        calls.append(given)
        if passing < len(calls) <= passing + failing:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return function(*given, **named)

    monkeypatch.setenv(VARIABLE, "3" if failing == 3 else "0")
    with monkeypatch.context() as patch, suppress(OSError) if failing == 100 else nullcontext():
        patch.setattr(place, name, step)
        save(4)
    if failing == 3:
        assert stored() == [4, 3, 2]
    else:
        assert stored() in ([3, 2, 1], [4, 2, 1], [4, 3, 1]) and not [*(tmp_path / "checkpoints").glob(".*")]


@pytest.mark.parametrize("failing", ["best.ckpt", "last.ckpt"])
def test_a_training_ends_when_it_cannot_write(finished, monkeypatch, failing):
    """A full disk ends the training with the file's name, and leaves the last checkpoint that could be written."""
    data, run = finished
    kept = (run / "checkpoints" / "last.ckpt").read_bytes()

    def write(path, *rest):
        if path.name == failing:
            raise OSError(28, "No space left on device", str(path))
        write_atomically(path, *rest)

    monkeypatch.setenv(VARIABLE, "0")
    monkeypatch.setattr(checkpoint_writer, "write_atomically", write)
    with pytest.raises(OSError, match=rf"No space left on device.*{failing}"):
        train.main(train_mapping(data, run, maximum_updates=18))
    assert failing == "best.ckpt" or (run / "checkpoints" / "last.ckpt").read_bytes() == kept


def test_a_stopped_training_waits_for_its_checkpoint(data, tmp_path, monkeypatch):
    """A signal while a checkpoint is being written: that one and the last one are whole when the command returns."""
    gate = Gate(monkeypatch)
    original = TorchUpdates.step

    def signalled(updates, number):
        if number == 5:
            assert gate.events in ([], ["begin last.ckpt"])
            signal.raise_signal(signal.SIGTERM)
            threading.Timer(0.5, gate.opened.set).start()
        original(updates, number)

    monkeypatch.setattr(TorchUpdates, "step", signalled)
    run = tmp_path / "run"
    assert train.main(train_mapping(data, run, monitor_every=1000)) == 128 + signal.SIGTERM
    assert gate.events == ["begin last.ckpt", "end last.ckpt"] * 2
    assert read_checkpoint(run / "checkpoints" / "last.ckpt")["hgn"]["updates"] == 6
