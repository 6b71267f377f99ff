"""python -m tools.studies.many_shards: what is counted, and that harm is seen."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import pytest

from hgn.schema import ConfigError
from tools.studies.many_shards import Work, found, main


@pytest.mark.skipif(sys.platform != "linux", reason="counts in /proc")
def test_small(tmp_path: Path) -> None:
    """A publication, a claim and a look behind 272 shards cost what they cost behind 144; readers that poll the service
    see each shard that is published meanwhile."""
    file = tmp_path / "many.json"
    options = {"shards": 280, "readers": 10, "seconds": 0.4, "publish_every_s": 0.2, "json": str(file)}
    assert main({"out": str(tmp_path / "many"), **options}) == 0
    report = json.loads(file.read_text())
    assert [row["shards"] for row in report["rows"]] == 4 * [144] + 4 * [272] and report["faults"] == []
    service = report["service"]
    assert service["shards"] == 283 and service["readers_that_saw_all"] == 10 and service["service_memory_mb"] > 10
    assert service["publications_seen"] <= 30 and service["healthz_wall_s"]["samples"] > 1
    with pytest.raises(ConfigError, match="out must be a new folder"):
        main({"out": str(tmp_path / "many")})


def test_harm_is_seen() -> None:
    """Work that grows, a start that reads much, a lost connection and a reader that missed a shard are faults."""
    work = [Work(144, what, 1000, 10**5, 10**4, 1.0) for what in ("claim", "publication", "look", "start")]
    last = [dataclasses.replace(row, shards=99_984) for row in work]
    fine = {"lost_connections": 0, "readers_that_saw_all": 9, "readers": 9}
    assert found(work + last, fine) == []
    last[1] = dataclasses.replace(last[1], written=13_000)
    last[3] = dataclasses.replace(last[3], read=2_000_000)
    faults = found(work + last, fine | {"readers_that_saw_all": 8})
    assert [fault.split(":")[0] for fault in faults] == [
        "publication",
        "a reader's start reads 2000000 bytes",
        "0 connections were lost, 8 readers saw all",
    ]
