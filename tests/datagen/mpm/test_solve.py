"""python -m datagen.solve: the solver's own simulation of a scene file, to be set beside a network's."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
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


def test_a_scene_that_bursts(tmp_path, monkeypatch):
    """If the solver stops, the command prints the cause and writes no file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(launch, "MAXIMUM_SUBSTEPS", 1)
    Path("mine.yaml").write_text(SCENE.split("\n")[3])
    with pytest.raises(ConfigError, match=r"mine\.yaml must be a scene that the solver can simulate, got frame 1"):
        main({"scene": "mine.yaml", "frames": 3, "mpm": {"device": "cpu"}})
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]
