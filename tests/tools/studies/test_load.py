"""The load test of the dataset service."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tools.studies.load import main


def test_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each way to read gets a line and a row with its speed and its ratio to the plain server."""
    main({"readers": 2, "files": 2, "file_mb": 1, "rounds": 1, "json": str(tmp_path / "load.json")})
    report = json.loads((tmp_path / "load.json").read_text())
    rows = {row["way"]: row for row in report["rows"]}
    assert list(rows) == ["plain file server, whole files", "service, whole files", "service, ranges"]
    assert rows["plain file server, whole files"]["ratio"] == 1 and rows["service, ranges"]["bytes_per_second"] > 0
    assert report["meta"]["config"]["readers"] == 2
    printed = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in printed] == list(rows)
