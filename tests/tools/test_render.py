"""python -m tools.render: which files it writes, and what it says of input that does not fit."""

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
    rollout = Rollout(
        position_TN3=position,
        material_N=np.repeat(np.arange(3, dtype=np.uint8), 20),
        obstacles=(),
        domain_size=(1.0, 1.0, 1.0),
        frame_rate_hz=60.0,
        source={"weights": "model.safetensors"},
        reference_TN3=position + np.float32(0.01) if reference else None,
    )
    write_rollout(folder / "fall.vtkhdf", rollout)
    return folder / "fall.vtkhdf"


@pytest.mark.parametrize("reference", [False, True])
def test_folder(tmp_path, capsys, reference):
    """A folder gets the grid, the animation and, with ground truth, the error; each path is printed."""
    path = rollout_file(tmp_path, reference)
    main({"rollout": str(path), "out": str(tmp_path / "pictures"), "size": 80})
    wanted = ["fall.png", "fall.gif"] + ["fall_error.png"] * reference
    assert [Path(line).name for line in capsys.readouterr().out.split()] == wanted
    assert sorted(entry.name for entry in (tmp_path / "pictures").iterdir()) == sorted(wanted)
    for name in wanted:
        with Image.open(tmp_path / "pictures" / name) as picture:
            picture.load()
            assert getattr(picture, "n_frames", 1) == (3 if name.endswith("gif") else 1)


@pytest.mark.parametrize("ending", ["png", "gif", "webp"])
def test_single_file(tmp_path, ending):
    """A file name as `out` gets that picture alone, with the frames asked for."""
    path = rollout_file(tmp_path, True)
    out = tmp_path / f"one.{ending}"
    main({"rollout": str(path), "out": str(out), "size": 80, "frames": [0, 8], "every": 4})
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["fall.vtkhdf", f"one.{ending}"]
    with Image.open(out) as picture:
        assert picture.format == ending.upper()


def test_episode_of_a_data_set(tmp_path, make_dataset, make_config):
    """An episode is drawn without a rollout; a key that is not there is answered with those that are."""
    folder = make_dataset(make_config(training_scenes=1, validation_scenes=2, test_scenes=1))
    mapping = {"data": str(folder), "out": str(tmp_path / "out"), "size": 80}
    main(mapping | {"episode": "validation-000001"})
    assert sorted(entry.name for entry in (tmp_path / "out").iterdir()) == [
        "validation-000001.gif",
        "validation-000001.png",
    ]
    with pytest.raises(ConfigError, match="one of the 2 validation episodes"):
        main(mapping | {"episode": "validation-000009"})


def test_rollouts_beside_an_episode(tmp_path, make_dataset, make_config):
    """The episode is the truth and comes first; each rollout has a column, and a line in the plot of errors."""
    data = str(make_dataset(make_config(training_scenes=1, validation_scenes=1, test_scenes=1)))
    truth = rollout_of_episode(find_episode(data, "validation-000000"))
    write_rollout(tmp_path / "a.vtkhdf", truth)
    moved = np.array(truth.position_TN3)
    moved[1:] += np.float32(0.01)
    write_rollout(tmp_path / "b.vtkhdf", dataclasses.replace(truth, position_TN3=moved))
    mapping = {"data": data, "episode": "validation-000000", "size": 80}
    widths = []
    for others in (["a"], ["a", "b"]):
        out = tmp_path / str(len(others))
        files = [str(tmp_path / f"{name}.vtkhdf") for name in others]
        main(mapping | {"others": files, "out": str(out)})
        assert {path.name for path in out.iterdir()} == {
            f"validation-000000{end}" for end in (".png", ".gif", "_error.png")
        }
        with Image.open(out / "validation-000000.gif") as moving:
            widths.append(moving.width)
    assert widths[1] == pytest.approx(1.5 * widths[0], abs=4)
    with pytest.raises(ConfigError, match="names must be given where others have the same file name"):
        main(mapping | {"others": [str(tmp_path / "a.vtkhdf")] * 2, "out": str(tmp_path / "bad")})


def test_other_rollouts_stand_beside_it(tmp_path):
    """Each other rollout has a row and a column of its own; one of another scene is refused."""
    path = rollout_file(tmp_path, True)
    (tmp_path / "other").mkdir()
    other = rollout_file(tmp_path / "other", False)
    sizes = []
    for others in ([], [str(other)]):
        out = tmp_path / f"{len(others)}"
        names = ["ours", "theirs"][: 1 + len(others)]
        main({"rollout": str(path), "others": others, "names": names, "out": str(out), "size": 80})
        with Image.open(out / "fall.png") as still, Image.open(out / "fall.gif") as moving:
            sizes.append((still.height, moving.width))
    assert sizes[1][0] > sizes[0][0] + 60 and sizes[1][1] > sizes[0][1] + 60
    rollout = read_rollout(other)
    write_rollout(other, dataclasses.replace(rollout, frame_rate_hz=30.0))
    with pytest.raises(ConfigError, match=r"others\[0\] must have 60 frames a second, got 30"):
        main({"rollout": str(path), "others": [str(other)], "out": str(tmp_path / "bad")})
    write_rollout(other, dataclasses.replace(rollout, position_TN3=rollout.position_TN3 + np.float32(0.1)))
    with pytest.raises(ConfigError, match=r"others\[0\] must begin with the same particles as"):
        main({"rollout": str(path), "others": [str(other)], "out": str(tmp_path / "bad")})
    assert not (tmp_path / "bad").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rollout": None}, "rollout must be a file, or else data and episode given"),
        ({"data": "folder"}, "rollout must be left out where data and episode are given"),
        ({"rollout": "nothing.h5"}, "rollout must be an existing file"),
        ({"names": ["a", "b"]}, "names must be 1 different ones"),
        ({"out": "picture.jpg"}, r"out must be a folder or end in one of \.png, .*\.ply, got 'picture\.jpg'"),
        ({"frames": [0, 9]}, r"frames\[1\] must be in \[0, 9\)"),
        ({"every": 0}, "every must be at least 1"),
        ({"size": 10}, "size must be 64 to 4096 pixels"),
        ({"colour": "red"}, "colour is not a known key"),
        ({"rollout": None, "data": "d", "episode": "holiday-000000"}, "episode must begin with one of train"),
        ({"rollout": None, "data": "missing", "episode": "test-000000"}, "missing"),
    ],
)
def test_bad_input(tmp_path, change, message):
    """Every wrong value is named with its rule, and nothing is written."""
    mapping = {"rollout": str(rollout_file(tmp_path, False)), "out": str(tmp_path / "out"), "size": 80} | change
    with pytest.raises(ConfigError, match=message):
        main(mapping)
    assert [entry.name for entry in tmp_path.iterdir()] == ["fall.vtkhdf"]
