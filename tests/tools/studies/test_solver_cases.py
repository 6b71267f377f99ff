"""python -m tools.studies.solver_cases: a row for each mixture, with the gain over kernels that hold every branch."""

import json
from pathlib import Path

import pytest

import tools.studies.solver_cases
from hgn.schema import ConfigError
from tools.studies.solver_cases import CASES, main


def test_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Rows carry times, steps and the gain; the table names them."""
    monkeypatch.setattr(tools.studies.solver_cases, "CASES", CASES[:1])
    file = tmp_path / "cases.json"
    assert main({"frames": 2, "rounds": 1, "size": 0.03, "device": "cpu", "json": str(file)}) == 0
    (row,) = json.loads(file.read_text())["rows"]
    assert row["case"] == "water" and row["ms"] > 0
    assert row["gain"] == pytest.approx(row["ms_every_branch"] / row["ms"])
    assert row["substeps"] >= 60
    assert "every branch" in capsys.readouterr().out


def test_bad_options_are_refused() -> None:
    """One frame has no time."""
    with pytest.raises(ConfigError, match="frames"):
        main({"frames": 1})
