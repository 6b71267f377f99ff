"""What commands write: never over files of other programs, and only where there is space for it."""

import errno
import functools
import itertools
import json
import os
import signal

import ballistic_solver
import pytest
from end_to_end.places import COMMANDS, EVALUATE, OF_THE_RUN, ROLLOUT, content, refused
from processes import exit_code

from hgn import evaluate, play, rollout
from hgn.command import EXIT_INPUT, EXIT_MACHINE
from hgn.runtime.simulation import Simulation
from hgn.runtime.simulator import Simulator
from hgn.scene.rollout_file import read_rollout
from hgn.training import errors
from hgn.training.errors import SquaredError


@pytest.mark.parametrize("command", ["rollout", "solve"])
def test_full_disks_are_met_before_the_work(place, backend, command, capsys, monkeypatch):
    """Space for the file is reserved during the simulation; a disk without it is named before."""
    monkeypatch.setattr("datagen.mpm.solver.simulate", ballistic_solver.simulate)
    arguments, sizes, reserve = ["scene=scene.yaml", "out=made/r.vtkhdf", "frames=3"], [], os.posix_fallocate
    monkeypatch.setattr(os, "posix_fallocate", lambda *given: sizes.append(given[-1]) or reserve(*given))
    assert exit_code(COMMANDS[command], command, arguments, monkeypatch) == 0
    (file,) = place.path("made").iterdir()
    assert sizes[0] >= file.stat().st_size
    monkeypatch.setattr(os, "posix_fallocate", lambda *_: (_ for _ in ()).throw(OSError(errno.ENOSPC, "No space")))
    monkeypatch.setattr("hgn.system.progress.bar", lambda *_, **__: pytest.fail("the simulation began"))
    before = content(place.folder)
    code, line = refused(command, arguments, capsys, monkeypatch)
    assert code == EXIT_MACHINE and line.startswith("error: No space: made/r.vtkhdf; free some space"), line
    assert content(place.folder) == before


VTKHDF = ["rollout=rollout.vtkhdf"]
# command, arguments, file of another program
FOREIGN = [
    ("rollout", [*ROLLOUT, "out=mine.h5"], "mine.h5"),
    ("rollout", [*ROLLOUT, "out=mine.vtkhdf", "render=true"], "mine.gif"),
    ("rollout", ["out=mine.ply"], "mine_0007.ply"),
    ("rollout", ["scene=scene.yaml"], "rollout/scene.png"),
    ("solve", ["scene=scene.yaml", "out=mine.hdf5"], "mine.hdf5"),
    ("evaluate", [*EVALUATE, "json=mine.json"], "mine.json"),
    ("export", [OF_THE_RUN, "out=mine.safetensors"], "mine.safetensors"),
    ("export", ["weights=obstacles_small", "onnx=mine.onnx"], "mine.onnx"),
    ("export", ["weights=obstacles_small", "package=mine.pt2"], "mine.pt2"),
    ("export", ["weights=obstacles_small", "arrays=made", "scene=scene.yaml"], "made/mine.npy"),
    ("play", ["rollout=rollout.vtkhdf", "html=mine.html"], "mine.html"),
    ("render", [*VTKHDF, "out=mine.webp"], "mine.webp"),
    ("render", [*VTKHDF, "out=mine.usdc"], "mine.usdc"),
    ("render", [*VTKHDF, "out=made"], "made/rollout.gif"),
    ("render", [*VTKHDF, "out=made"], "made/rollout_error.png"),
    ("bench", ["json=mine.json"], "mine.json"),
    ("scaling", ["json=mine.json"], "mine.json"),
    ("curves", ["runs=[run]", "out=mine"], "mine.png"),
    ("error_vs_time", ["data=data", "out=mine"], "mine_frames.png"),
    ("error_vs_time", ["data=data", "out=mine"], "mine.json"),
    ("stability_network", ["json=mine.json"], "mine.json"),
    ("stability_solver", ["json=mine.json"], "mine.json"),
    ("train", ["run=mine"], "mine/config.yaml"),
]


@pytest.mark.parametrize(("command", "arguments", "name"), FOREIGN)
def test_files_of_other_programs_stay(place, command, arguments, name, capsys, monkeypatch):
    """No output replaces a file that HGN did not write; it is named before the work."""
    place.path(name).parent.mkdir(exist_ok=True)
    place.path(name).write_text("work of years, with hgn in it")
    monkeypatch.setattr(Simulator, "load", lambda *_: pytest.fail("the simulation began"))
    before = content(place.folder)
    code, line = refused(command, place.train(*arguments) if command == "train" else arguments, capsys, monkeypatch)
    arrays = name.endswith(".npy")
    rule = "arrays must be a new folder, or one with the inputs of the same network" if arrays else "that HGN wrote"
    assert code == EXIT_INPUT and f"{rule}, got" in line, line
    assert arrays or name in line
    assert content(place.folder) == before


def test_pipes_stay(place, capsys, monkeypatch):
    """A pipe, a socket or a device is not replaced by a file either."""
    os.mkfifo("pipe.safetensors")
    code, line = refused("export", [OF_THE_RUN, "out=pipe.safetensors"], capsys, monkeypatch)
    assert code == EXIT_INPUT and "that HGN wrote, got" in line and place.path("pipe.safetensors").is_fifo()


def test_pictures_refused_before_a_bar(place, capsys, monkeypatch):
    """An animation that viewers would not play is refused before its drawing begins."""
    assert exit_code(rollout.main, "rollout", [*ROLLOUT, "out=r.vtkhdf"], monkeypatch) == 0
    _, line = refused("render", ["rollout=r.vtkhdf", "out=r.gif", "every=1"], capsys, monkeypatch)
    assert "use every >= 2" in line and "drawing" not in capsys.readouterr().err


def test_own_files_are_replaced(place, monkeypatch):
    """A command that is run twice replaces the files of its first run, whatever their kind."""
    exported = ["export", [f"{OF_THE_RUN}", "out=made/w.safetensors", "arrays=made/a", "scene=scene.yaml"]]
    rollouts = [
        ["rollout", [*ROLLOUT[:2], f"out=made/r.{end}", "frames=3"]] for end in ("vtkhdf", "ply", "usdc", "usda")
    ]
    of_it = "rollout=made/r.vtkhdf"
    drawn = [["render", [of_it, f"out=made/r.{end}", "every=2", "size=64"]] for end in ("png", "gif", "webp")]
    others = [["evaluate", EVALUATE], ["play", [of_it, "html=made/r.html"]], ["curves", ["runs=[run]", "out=made/c"]]]
    for command, arguments in [exported, *rollouts, *drawn, *others] * 2:
        assert exit_code(COMMANDS[command], command, arguments, monkeypatch) == 0, (command, arguments)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_page_is_closed_by_signals(number, capsys, monkeypatch):
    """Ctrl-C is the normal end of hgn.play; other signals end it with their exit code and a line."""

    class Page:
        address = "http://127.0.0.1/"

        def run(self):
            signal.raise_signal(number)

        def close(self):
            print("closed")

    monkeypatch.setattr(play, "play_page", lambda config: Page())
    code = exit_code(play.main, "play", ["browser=false"], monkeypatch)
    normal = number == signal.SIGINT
    assert code == (0 if normal else 128 + number)
    assert capsys.readouterr() == (f"{Page.address}\nclosed\n", "" if normal else "error: interrupted\n")


def test_the_page_says_what_weights_do_not_know(tmp_path, capsys, monkeypatch):
    """As hgn.rollout does: ignored friction, and a faster throw than those of the data."""
    pages = pytest.importorskip("hgn.viewer.page", reason="viser is not installed: pip install 'hgn[play]'")
    monkeypatch.setattr(pages, "PlayPage", lambda *given: given)
    group = "{shape: cube, size: 0.05, position: [0.5, 0.5, 0.5], material: sand, velocity: [2.7, 0, 0]}"
    (tmp_path / "rough.yaml").write_text(f"floor_friction: 0.6\ngroups: [{group}]\n")
    play.play_page(play.PlayConfig(scene=str(tmp_path / "rough.yaml"), weights="obstacles_small", device="cpu"))
    said = capsys.readouterr().err
    assert "no effect: friction of surfaces; obstacles_small simulates that of its data" in said
    assert "velocity: groups start with up to 2.7 domain units per second, in the data of obstacles_small" in said


@pytest.mark.parametrize(
    ("name", "number"), [("a.vtkhdf", signal.SIGINT), ("a.vtkhdf", signal.SIGTERM), ("a.ply", signal.SIGHUP)]
)
def test_an_interrupted_simulation_keeps_its_frames(place, name, number, capsys, monkeypatch):
    """After Ctrl-C, SIGTERM or SIGHUP the file has the frames so far; a line says how many. No other file is left."""
    frames = Simulator.frames

    def interrupted(self, scene, count):
        yield from itertools.islice(frames(self, scene, count), 3)
        if number == signal.SIGINT:  # which shells ignore in the background
            raise KeyboardInterrupt
        signal.raise_signal(number)

    monkeypatch.setattr(Simulator, "frames", interrupted)
    code, line = refused("rollout", ["scene=scene.yaml", f"out=made/{name}", "frames=50"], capsys, monkeypatch)
    assert code == 128 + number and line == "error: interrupted"
    names = sorted(path.name for path in place.path("made").iterdir())
    if name == "a.vtkhdf":
        assert names == [name] and read_rollout(place.path("made") / name).frame_count == 3
    else:
        assert names == [*(f"a_{frame:04d}.ply" for frame in range(3)), "a_obstacle_0.ply"]


@pytest.mark.parametrize(
    ("number", "place_of_signal", "call", "frames"),
    [
        (signal.SIGINT, (SquaredError, "__init__"), 1, None),
        (signal.SIGTERM, (SquaredError, "add"), 6, [2] * 4),
        (signal.SIGHUP, (Simulation, "_count"), 1, [10] * 4 + [2]),
        (signal.SIGINT, (Simulation, "_count"), 3, [10] * 4 + [4]),
    ],
)
def test_an_interrupted_evaluation_keeps_its_rows(place, number, place_of_signal, call, frames, capsys, monkeypatch):
    """After a signal the table and the file have what was measured, with the number of frames, which a line states."""
    owner, name = place_of_signal
    work, calls = getattr(owner, name), itertools.count(1)

    def interrupted(*given):
        if next(calls) == call:
            signal.raise_signal(number)
        return work(*given)

    monkeypatch.setattr(owner, name, interrupted)
    monkeypatch.setattr(errors, "frame_batches", functools.partial(errors.frame_batches, particles_per_batch=1))
    code = exit_code(evaluate.main, "evaluate", [*EVALUATE, "rollout_frames=6", "backend=torch"], monkeypatch)
    file, (out, error) = place.path("made/errors.json"), capsys.readouterr()
    assert code == 128 + number
    if frames is None:
        assert not file.exists() and error.splitlines()[-1] == "error: interrupted"
        return
    report = json.loads(file.read_text())
    assert [row["frames"] for row in report["rows"]] == frames and "nan" not in out
    assert f"stopped early: {report['meta']['stopped_early']} were measured\n" in error
    assert f"of {frames[0]} frames, rollouts of {frames[4] if frames[4:] else 'no'} frames" in error
