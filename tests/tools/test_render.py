"""Tests python -m tools.render: its files, and its messages for input that does not fit."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hgn.data.reader import find_episode
from hgn.render.pictures import rollout_of_episode
from hgn.scene.rollout_file import Rollout, read_rollout, write_rollout
from hgn.schema import ConfigError
from tools.render import main

FRAMES = 9


def rollout_file(folder, reference):
    generator = np.random.default_rng(0)
    start = 0.3 + 0.05 * generator.random((60, 3))
    position = (start - np.linspace(0, 0.2, FRAMES)[:, None, None] * (0, 1, 0)).astype(np.float32)
    material_N, source = np.repeat(np.arange(3, dtype=np.uint8), 20), {"weights": "model.safetensors"}
    truth = {"reference_TN3": position + np.float32(0.01)} if reference else {}
    rollout = Rollout(position, material_N, (), (1.0, 1.0, 1.0), 60.0, source=source, **truth)
    write_rollout(folder / "fall.vtkhdf", rollout)
    return folder / "fall.vtkhdf"


def names_in(folder):
    return {entry.name for entry in folder.iterdir()}


@pytest.mark.parametrize("ending", ["png", "gif", "webp"])
def test_single_file(tmp_path, ending):
    """If `out` is the name of a file, only this picture is drawn, with the requested frames."""
    out = tmp_path / f"one.{ending}"
    main({"rollout": str(rollout_file(tmp_path, True)), "out": str(out), "size": 80, "frames": [0, 8], "every": 4})
    assert names_in(tmp_path) == {"fall.vtkhdf", out.name}
    with Image.open(out) as picture:
        assert picture.format == ending.upper()


def test_an_episode_and_rollouts_beside_it(tmp_path, small_dataset):
    """An episode is drawn without a rollout, or as the truth before rollouts: each has a column, and a line in the
    plot of errors. A key that is not there is answered with those that are."""
    truth = rollout_of_episode(find_episode(str(small_dataset), "validation-000000"))
    moved = np.array(truth.position_TN3)
    moved[1:] += np.float32(0.01)
    for name, position_TN3 in (("a", truth.position_TN3), ("b", moved)):
        write_rollout(tmp_path / f"{name}.vtkhdf", dataclasses.replace(truth, position_TN3=position_TN3))
    mapping = {"data": str(small_dataset), "episode": "validation-000000", "size": 80}
    widths = []
    for others in ([], ["a"], ["a", "b"]):
        out = tmp_path / str(len(others))
        main(mapping | {"others": [str(tmp_path / f"{name}.vtkhdf") for name in others], "out": str(out)})
        ends = (".png", ".gif", "_error.png") if others else (".png", ".gif")
        assert names_in(out) == {f"validation-000000{end}" for end in ends}
        with Image.open(out / "validation-000000.gif") as moving:
            widths.append(moving.width)
    assert widths[2] == pytest.approx(1.5 * widths[1], abs=4)
    with pytest.raises(ConfigError, match="names must be given where others have the same file name"):
        main(mapping | {"others": [str(tmp_path / "a.vtkhdf")] * 2, "out": str(tmp_path / "bad")})
    with pytest.raises(ConfigError, match=r"one of the 2 validation episodes in .*; for example validation-000000$"):
        main(mapping | {"episode": "validation-000009", "out": str(tmp_path / "bad")})


def test_other_rollouts_stand_beside_it(tmp_path, capsys):
    """A folder gets the grid, the animation and, with ground truth, the error; each path is printed. Each other rollout
    has a row and a column of its own; one of another scene is refused. One of another length is drawn with a note."""
    path = rollout_file(tmp_path, True)
    (tmp_path / "other").mkdir()
    other, wanted = rollout_file(tmp_path / "other", False), ["fall.png", "fall.gif", "fall_error.png"]
    sizes = []
    for others in ([], [str(other)]):
        out = tmp_path / f"{len(others)}"
        names = ["ours", "theirs"][: 1 + len(others)]
        main({"rollout": str(path), "others": others, "names": names, "out": str(out), "size": 80})
        assert [Path(line).name for line in capsys.readouterr().out.split()] == wanted
        assert names_in(out) == set(wanted)
        with Image.open(out / "fall.png") as still, Image.open(out / "fall.gif") as moving:
            assert (getattr(still, "n_frames", 1), moving.n_frames) == (1, 3)
            sizes.append((still.height, moving.width))
    assert sizes[1][0] > sizes[0][0] + 60 and sizes[1][1] > sizes[0][1] + 60
    rollout, bad = read_rollout(other), {"rollout": str(path), "others": [str(other)], "out": str(tmp_path / "bad")}
    for count in (1, 12):
        write_rollout(other, dataclasses.replace(rollout, position_TN3=rollout.position_TN3.repeat(2, axis=0)[:count]))
        main(bad | {"out": str(tmp_path / "a.png"), "size": 80})
        line = f"{other} has {count} frames, {path} has {FRAMES}: pictures have {FRAMES}\n"
        assert capsys.readouterr().err == line
    for change, message in (
        ({"gravity": (0.0, -1.6, 0.0)}, r"others\[0\] must have the obstacles and the gravity of"),
        ({"frame_rate_hz": 30.0}, r"others\[0\] must have 60 frames a second, got 30"),
        ({"position_TN3": rollout.position_TN3 + np.float32(0.1)}, r"others\[0\] must begin with the same particles"),
    ):
        write_rollout(other, dataclasses.replace(rollout, **change))
        with pytest.raises(ConfigError, match=message):
            main(bad)
    assert not (tmp_path / "bad").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rollout": "nothing.h5"}, "rollout must be an existing file"),
        ({"out": "picture.jpg"}, r"out must be a folder or end in one of \.png, .*\.ply, got 'picture\.jpg'"),
        ({"frames": [0, 9]}, r"frames\[1\] must be in \[0, 9\)"),
        ({"rollout": None, "data": "d", "episode": "holiday-000000"}, "episode must begin with one of train"),
        ({"rollout": None, "data": "missing", "episode": "test-000000"}, "missing"),
    ],
)
def test_bad_input(tmp_path, change, message):
    """Every wrong value is named with its rule, and nothing is written."""
    mapping = {"rollout": str(rollout_file(tmp_path, False)), "out": str(tmp_path / "out"), "size": 80} | change
    with pytest.raises(ConfigError, match=message):
        main(mapping)
    assert names_in(tmp_path) == {"fall.vtkhdf"}
