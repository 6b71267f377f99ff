"""The README's Python examples run as they stand, and its commands compose."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


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
