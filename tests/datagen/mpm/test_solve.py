"""python -m datagen.solve: the solver's own simulation of a scene file, to be set beside a network's."""

import signal
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from processes import exit_code
from tqdm import tqdm

from datagen.mpm import launch
from datagen.solve import main
from hgn.scene.rollout_file import read_rollout, write_rollout
from hgn.scene.scene_file import load_scene
from hgn.schema import ConfigError
from tools import render

SCENE = """
cell_size: 0.0625
obstacles: [{mesh: ramp.obj, scale: 0.3, position: [0.5, 0.2, 0.5]}]
groups: [{shape: cube, size: 0.2, position: [0.5, 0.65, 0.5], material: water, velocity: [0, -1, 0]}]
"""
RAMP = "v -0.5 0 -0.5\nv 0.5 0 -0.5\nv -0.5 0 0.5\nv 0.5 0 0.5\nf 1 3 2\nf 2 3 4\n"


def test_a_scene_file_is_solved(tmp_path, monkeypatch):
    """The file contains the scene's particles, which fall. In a drawing with another simulation of it, it is the ground
    truth. The bar's rate starts at frame 1, which includes compilation."""
    rate_begins = []
    monkeypatch.setattr(tqdm, "unpause", lambda bar: rate_begins.append(bar.n))
    monkeypatch.chdir(tmp_path)
    Path("ramp.obj").write_text(RAMP)
    Path("mine.yaml").write_text(SCENE)
    assert main({"scene": "mine.yaml", "frames": 3, "mpm": {"device": "cpu"}}) == 0
    assert rate_begins == [1]
    solved, scene = read_rollout("rollout/mine_solver.vtkhdf"), load_scene("mine.yaml")
    np.testing.assert_array_equal(solved.position_TN3[0], scene.position_N3)
    fallen = (solved.position_TN3[0] - solved.position_TN3[2])[:, 1]
    np.testing.assert_allclose(fallen, 2 / 60 + 0.5 * 9.8 * (2 / 60) ** 2, rtol=0.1)
    assert solved.source["solver"]["device"] == "cpu" and [one.name for one in solved.obstacles] == ["ramp"]
    other = read_rollout("rollout/mine_solver.vtkhdf")
    other.source.clear()
    other.position_TN3[1:] += np.float32(0.02)
    write_rollout("other.vtkhdf", other)
    render.main({"rollout": "rollout/mine_solver.vtkhdf", "others": ["other.vtkhdf"], "out": "drawn", "size": 80})
    names = [f"mine_solver{ending}" for ending in (".gif", ".png", "_error.png")]
    assert sorted(path.name for path in Path("drawn").iterdir()) == names
    with Image.open("drawn/mine_solver.gif") as moving:
        assert moving.width > 160


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_simulation_keeps_its_frames(tmp_path, monkeypatch, capsys, number):
    """After Ctrl-C or SIGTERM the file has the frames so far, also of particles that enter; lines give their number
    and that of the particles. No other file is left, and none before the second frame."""
    monkeypatch.chdir(tmp_path)
    emitter = "{shape: disc, size: 0.1, position: [0.4, 0.7, 0.4], material: water, velocity: [0, -2, 0], stop: 1}"
    Path("mine.yaml").write_text(f"{SCENE.splitlines()[1]}\nemitters: [{emitter}]\n")
    arguments = ["scene=mine.yaml", "mpm.device=cpu", "out=whole.vtkhdf", "frames=6"]
    assert exit_code(main, "solve", arguments, monkeypatch) == 0
    whole = read_rollout("whole.vtkhdf")
    assert whole.present(3) > whole.present(1)
    Path("whole.vtkhdf").unlink()
    for kept in (1, 4):

        def interrupted(progress, count, last=kept):
            if count == last:
                if number == signal.SIGINT:  # which shells ignore in the background
                    raise KeyboardInterrupt
                signal.raise_signal(number)

        monkeypatch.setattr("datagen.solve.advance_to", interrupted)
        capsys.readouterr()
        assert exit_code(main, "solve", arguments, monkeypatch) == 128 + number
        first, *notes, last = capsys.readouterr().err.splitlines()
        assert first == f"{whole.particle_count:,} particles, 6 frames" and last == "error: interrupted"
        assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.yaml", "whole.vtkhdf"][:kept]
    assert "4 of 6 frames are in whole.vtkhdf" in notes
    np.testing.assert_array_equal(read_rollout("whole.vtkhdf").position_TN3, whole.position_TN3[:4])


@pytest.mark.parametrize(("substeps", "kept"), [(1, 1), (20, 4)])
def test_a_scene_that_bursts(tmp_path, monkeypatch, capsys, substeps, kept):
    """If the solver stops, the command prints the cause. The file has the frames so far; without any there is none."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(launch, "MAXIMUM_SUBSTEPS", substeps)
    Path("mine.yaml").write_text(
        "cell_size: 0.0625\ngravity: [0, -200, 0]\n"
        "groups: [{shape: cube, size: 0.2, position: [0.5, 0.65, 0.5], material: water}]\n"
    )
    cause = rf"mine\.yaml must be a scene that the solver can simulate, got frame {kept}: the frame needs more than"
    with pytest.raises(ConfigError, match=cause):
        main({"scene": "mine.yaml", "frames": 6, "mpm": {"device": "cpu"}, "out": "made.vtkhdf"})
    names = ["made.vtkhdf", "mine.yaml"] if kept > 1 else ["mine.yaml"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    if kept > 1:
        assert "4 of 6 frames are in made.vtkhdf\n" in capsys.readouterr().err
        assert read_rollout("made.vtkhdf").frame_count == kept
