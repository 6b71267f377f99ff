"""The README's Python examples run as they stand, and its commands compose."""

from __future__ import annotations

import importlib.util
import re
import shlex
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from hydra import compose, initialize_config_dir

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)  # language and content
EXAMPLES = [content for language, content in BLOCKS if language == "python"]


@pytest.mark.parametrize("example", range(2))
def test_python_examples(example: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each runs where a scene file and its mesh lie, for three frames here, and moves particles that stay finite."""
    assert len(EXAMPLES) == 2
    shutil.copy(ROOT / "conf" / "example" / "ramp.obj", tmp_path)
    shutil.copy(ROOT / "conf" / "example" / "own_mesh.yaml", tmp_path / "my_scene.yaml")
    monkeypatch.chdir(tmp_path)
    names: dict[str, np.ndarray] = {}
    exec(EXAMPLES[example].replace("300", "3"), names)
    last = names["position_TN3"][-1] if "position_TN3" in names else names["position_N3"]
    assert np.isfinite(last).all() and last.shape == names["scene"].position_N3.shape
    assert (last[:, 1] < names["scene"].position_N3[:, 1]).mean() > 0.9
    if "made" in names:  # as the README tells the file's layout
        with h5py.File("my_scene.vtkhdf") as file:
            points = file["VTKHDF/Points"][()].reshape(3, -1, 3)
            np.testing.assert_array_equal(points, names["position_TN3"])
            assert len(file["VTKHDF/PointData/material"]) == len(last)


def commands() -> list[str]:
    """What the README says to type, of blocks and of the table, without its comments and continued lines."""
    lines = [line for _, content in BLOCKS for line in content.replace("\\\n", " ").splitlines()]
    lines += re.findall(r"`(python -m [^`]+)`", README)
    found = {line.split("#")[0].strip() for line in lines if line.startswith("python -m ")}
    return sorted(line for line in found if "…" not in line.replace("[…]", ""))


def test_commands_compose() -> None:
    """Each command of the README is there, and each setting that it is given exists."""
    assert len(commands()) > 25
    for line in commands():
        _, _, module, *arguments = shlex.split(line.replace("[…]", "[a]"))
        assert importlib.util.find_spec(module) is not None, line
        name = module.rpartition(".")[2]
        if module == "tools.stability":
            name = f"stability_{arguments.pop(0)}"
        if "--help" in arguments:
            continue
        folder = ROOT / "conf" / ("command" if (ROOT / "conf" / "command" / f"{name}.yaml").is_file() else "")
        given = [f"json={arguments.pop()}" for argument in arguments[-2:-1] if argument == "--json"]
        with initialize_config_dir(str(folder), version_base="1.3"):
            compose(name, [argument for argument in arguments + given if argument != "--json"])
