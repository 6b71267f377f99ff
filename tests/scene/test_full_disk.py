"""Rollouts on a disk that refuses data for a while or for good; a limit on the size of files stands in for it. And
signals at the end of a file."""

import dataclasses
import os
import signal

import numpy as np
import pytest
from scene.test_rollout_file import contents, growing

from hgn.scene import rollout_file
from hgn.scene.hdf5 import FileOnDisk
from hgn.scene.rollout_file import read_rollout, write_frames, write_rollout
from hgn.scene.simulated_frames import SimulatedFrames


@pytest.fixture
def no_file(monkeypatch):
    """Puts a pipe in place of the written file, because a pipe also refuses to seek. None undoes this."""
    disks, ends = [], os.pipe()
    monkeypatch.setattr(rollout_file, "FileOnDisk", lambda path: disks.append(FileOnDisk(path)) or disks[-1])

    def replace(size):
        if size is not None:
            disks.append(os.dup(disks[-1].fileno()))
            os.dup2(ends[1], disks[-2].fileno())
        else:
            os.dup2(disks[-1], disks[-2].fileno())

    yield replace
    for number in (*ends, disks[-1]):
        os.close(number)


@pytest.mark.parametrize(
    ("how", "size"), [("file_limit", 0), ("file_limit", 5000), ("file_limit", 40_000), ("no_file", 0)]
)
@pytest.mark.parametrize("refused", [1, 2, 5])
@pytest.mark.parametrize("lasting", [False, True])
def test_refused_data(tmp_path, monkeypatch, request, refused, how, size, lasting):
    """Data that the disk refuses for a while are written later, and else the file of before stays. HDF5 lost such data
    without an error, or ended the process."""
    file_limit = request.getfixturevalue(how)
    monkeypatch.setattr(rollout_file, "WRITE_EVERY_S", -1.0)
    whole, path, take = growing(), tmp_path / "a.vtkhdf", SimulatedFrames.take
    write_rollout(path, dataclasses.replace(whole, position_TN3=whole.position_TN3[: refused + 1]))
    expected = contents(path)
    if not lasting:
        path.unlink()
        monkeypatch.setattr(SimulatedFrames, "take", lambda *rest: (take(*rest), file_limit(None)))

    def simulate(take):
        for frame, position_N3 in enumerate(whole.position_TN3):
            if frame == refused:
                file_limit(size)
            take(position_N3[: whole.present(frame)])

    with pytest.raises(OSError, match=r"File too large|Illegal seek"):
        write_frames(path, dataclasses.replace(whole, position_TN3=np.full_like(whole.position_TN3, np.nan)), simulate)
    np.testing.assert_equal(contents(path), expected)
    assert [each.name for each in tmp_path.iterdir()] == ["a.vtkhdf"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("name", ["_extend", "sync_written", "sync_folder"])
def test_signals_while_a_file_is_completed(tmp_path, monkeypatch, number, name):
    """They end the command when the file is complete, in the handler of before."""
    whole, path, function = growing(), tmp_path / "a.vtkhdf", getattr(rollout_file, name)
    outer = signal.signal(number, signal.default_int_handler)
    monkeypatch.setattr(rollout_file, name, lambda *given: (signal.raise_signal(number), function(*given)))
    try:
        with pytest.raises(KeyboardInterrupt):
            write_frames(path, whole, lambda take: list(map(take, whole.position_TN3)))
        assert signal.getsignal(number) is signal.default_int_handler
    finally:
        signal.signal(number, outer)
    assert read_rollout(path).frame_count == whole.frame_count and [*tmp_path.iterdir()] == [path]
