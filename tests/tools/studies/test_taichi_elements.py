"""python -m tools.studies.taichi_elements: what it compares, without a copy of Taichi Elements."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

import tools.studies.taichi_elements
from hgn.config import MpmConfig
from hgn.schema import ConfigError
from tools.studies.taichi_elements import TaichiElementsConfig, cases, faithful_mode, main, taichi_elements_substeps


@pytest.fixture
def copy(tmp_path: Path) -> str:
    (tmp_path / "engine").mkdir()
    (tmp_path / "engine" / "mpm_solver.py").touch()
    return str(tmp_path)


def test_report(copy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Trajectories within the bounds hold; a shift of 2 % of the domain does not, and says in what."""
    path = np.random.default_rng(0).uniform(0.4, 0.5, (6, 50, 3))
    monkeypatch.setattr(tools.studies.taichi_elements, "_run_ours", lambda scene, config: (path, 0.1))
    file = tmp_path / "report.json"
    for shift, held in ((0.0, True), (0.02, False)):
        moved = (path + shift, 0.4)
        monkeypatch.setattr(tools.studies.taichi_elements, "run_theirs", lambda *given, moved=moved: moved)
        assert main({"folder": copy, "frames": 6, "seeds": 2, "json": str(file)}) == 0
        rows = json.loads(file.read_text())["rows"]
        assert [row["case"] for row in rows] == ["water", "sand", "snow", "mixed"]
        assert all(row["held"] is held and row["time_ratio"] == pytest.approx(0.25) for row in rows)
        assert rows[0]["centre"] == pytest.approx(shift * 3**0.5) and rows[0]["seeds"] == 2
        assert rows[0]["floor"] == dict.fromkeys(("first_frame", "centre", "height", "spread"), 0)
    assert "TE ms" in capsys.readouterr().out


def test_cases_and_steps(copy: str) -> None:
    """A cube has 1,074 particles, the mixed case three of them; Taichi Elements takes 54 or 55 steps a frame."""
    assert [scene.particle_count for _, scene in cases(0.08)] == [1074, 1074, 1074, 3222]
    assert taichi_elements_substeps() in (54, 55)
    with pytest.raises(ConfigError, match="folder must hold a copy"):
        TaichiElementsConfig("nowhere")


def test_faithful_mode_is_that_of_the_config() -> None:
    """The comparison takes what conf/mpm/taichi_elements.yaml says, but for the step, which is a hair shorter."""
    given = yaml.safe_load((Path(__file__).resolve().parents[3] / "conf" / "mpm" / "taichi_elements.yaml").read_text())
    own, _ = faithful_mode("cpu")
    # without obstacles the band is nowhere, and with a fixed step every step is a transfer
    for name in given.keys() - {"defaults", "collider_band_cells", "transfer_speed_m_s"}:
        assert getattr(own, name) == given[name], name
    assert own.fixed_time_step_s == pytest.approx(MpmConfig().fixed_time_step_s, rel=0.02)
