"""Signals at any line of the programs that write frames: these stay in a readable file."""

import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from processes import exit_code

from hgn.render import exchange
from hgn.render.exchange import save_frames
from hgn.scene import rollout_file, simulated_frames
from hgn.scene.rollout_file import Rollout, read_rollout
from hgn.system import files, signals
from hgn.system.processes import start_child

FRAMES, STRIDE = 4, 23  # of the lines between two tested ones
PLACES = {module.__file__ for module in (exchange, rollout_file, simulated_frames, files, signals)}


class Interruption:
    """Raises signals at a line of the programs that write files, after the last frame was simulated."""

    def __init__(self, line, numbers):
        self.lines, self.line, self.numbers = 0, line, numbers

    def __call__(self, frame, event, argument):
        if frame.f_code.co_filename not in PLACES:
            return None
        if event == "line":
            self.lines += 1
            if self.lines == self.line:
                for number in self.numbers:
                    signal.raise_signal(number)
        return self

    def simulate(self, take):
        for frame in range(FRAMES):
            take(np.full((5, 3), 0.1 * frame, np.float32))
        sys.settrace(self)
        sys._getframe().f_back.f_trace = self


def frames_in(folder):
    """The number of frames in the files of a folder."""
    if rollouts := [*folder.glob("*.vtkhdf")]:
        return read_rollout(*rollouts).frame_count
    if stages := [*folder.glob("*.usda")]:
        from pxr import Usd

        return Usd.Stage.Open(str(stages[0])).GetEndTimeCode() + 1
    return len([*folder.glob("*.ply")])


def still():
    """A rollout of which no frame was simulated."""
    return Rollout(np.zeros((FRAMES, 5, 3), np.float32), np.zeros(5, np.uint8), (), (1.0, 1.0, 1.0), 60.0)


def report(connection):
    connection.send(signal.pthread_sigmask(signal.SIG_BLOCK, []))


def test_children_get_no_signals_of_the_terminal():
    """Ctrl-C reaches the whole process group. A child that starts printed a traceback, and its parent replaced it."""
    process, connection = start_child(report)
    assert connection.recv() == {signal.SIGINT}
    process.join()


@pytest.mark.parametrize("numbers", [[signal.SIGINT] * 2, [signal.SIGTERM, signal.SIGINT, signal.SIGTERM]])
@pytest.mark.parametrize("name", ["a.vtkhdf", "a.ply", "a.usda"])
def test_no_frame_is_lost(tmp_path, monkeypatch, capsys, name, numbers):
    """Signals at any line after the simulation: all frames are in a file, which a line names, and no other is left."""
    for line in range(1, 10_000, STRIDE):
        folder = tmp_path / str(line)
        interruption = Interruption(line, numbers)

        def main(_, folder=folder, interruption=interruption):
            try:
                save_frames(folder / name, still(), interruption.simulate)
            finally:
                sys.settrace(None)

        code, error = exit_code(main, "rollout", [], monkeypatch), capsys.readouterr().err
        assert frames_in(folder) == FRAMES, (line, error)
        if interruption.lines < line:
            assert code == 0 and line > STRIDE
            return
        said = f"{FRAMES} of {FRAMES} frames are in {folder}/"
        assert code - 128 in numbers and error.startswith(said), (line, error)
        assert Path(error.split("\n")[0].rpartition(" ")[2]).is_file()
        assert not [each for each in folder.iterdir() if each.name.startswith(".")]


def test_an_error_of_a_writer(tmp_path, monkeypatch, capsys):
    """It is raised, the frames are in a new VTKHDF file, and an older file stays."""
    monkeypatch.setattr(exchange, "_write_ply", lambda *_: 1 / 0)
    for file in ("a.ply.vtkhdf", "a.ply1.vtkhdf"):
        with pytest.raises(ZeroDivisionError):
            save_frames(tmp_path / "a.ply", still(), lambda take: [take(np.ones((5, 3))) for _ in range(FRAMES)])
        assert capsys.readouterr().err == f"{FRAMES} of {FRAMES} frames are in {tmp_path / file}\n"
        assert (read_rollout(tmp_path / file).position_TN3 == 1).all()
    assert len([*tmp_path.iterdir()]) == 2
