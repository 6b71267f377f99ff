"""python -m tools.studies.screens: the rows of its page."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install 'hgn[play]'")
from tools.studies.screens import main


def test_small(tmp_path: Path) -> None:
    """The page simulates without a browser, surfaces are closed and within 5 % of the volume, each file was written."""
    file = tmp_path / "screens.json"
    assert main({"particles": 100, "seconds": 1, "repeats": 1, "browser": False, "json": str(file)}) == 0
    report = json.loads(file.read_text())
    assert report["page"]["particles"] == 100 and report["page"]["viewers"] == 0
    assert all(row["closed"] and abs(row["volume_error"]) < 0.05 for row in report["surface"])
    assert [row["file"] for row in report["files"]] == [".usdc", ".ply", ".vtkhdf"]
    assert all(row["bytes_a_frame"] > 12 * 100 for row in report["files"])  # the positions
