"""python -m tools.studies.power_loss: a few of its folders, and that harm is seen."""

import json
from unittest import mock

import pytest

import hgn.training.checkpoint_writer
from hgn.system import files
from tools.studies import power_loss
from tools.studies.power_loss import SCENARIOS, Disk, fail, lose_power


@pytest.mark.parametrize(("name", "every"), [("generation", 20), ("checkpoints", 5), ("cache", 2)])
def test_nothing_is_lost(tmp_path, name, every):
    """After a loss of power, a kill (all calls before it count) or an error of the disk, before some calls, with reads
    and writes of 1,000 bytes at most: what was published or saved is there, nothing else is taken for whole, and the
    next run makes the same files."""
    calls, tried, faults = lose_power(SCENARIOS[name], tmp_path, every, 1, 0)
    assert faults == [] and tried == calls // every > 3
    failed, faults = fail(SCENARIOS[name], tmp_path, 2 * every, 1000)
    assert faults == [] and failed > 1


def test_what_is_mapped_never_shrinks(tmp_path):
    """No file is written to under a shard's name, in a data set or in a cache: it gets that name when it is whole, and
    loses it whole. So a map of a shard ends a reader (SIGBUS) only where another program truncates it."""
    for name in ("generation", "cache"):
        disk = Disk(tmp_path)
        with disk.followed():
            SCENARIOS[name].write(tmp_path, {})
        written = {path for path in disk.written if not path.endswith(files.TEMPORARY_SUFFIX)}
        assert disk.written - written and all(path.endswith(".jsonl") for path in written)


@pytest.mark.parametrize("skipped", ["sync_file", "sync_folder"])
def test_harm_is_seen(tmp_path, skipped):
    """Without the sync of files, or of folders, saved checkpoints are lost."""
    with mock.patch.object(files, skipped):
        _, _, faults = lose_power(SCENARIOS["checkpoints"], tmp_path, 1, 3, 0)
    assert any("was saved" in fault or "must be a whole checkpoint" in fault for fault in faults)


def test_command(tmp_path, monkeypatch):
    """The exit code and the report say what was wrong."""
    monkeypatch.setattr(power_loss, "SCENARIOS", {"checkpoints": SCENARIOS["checkpoints"]})
    monkeypatch.setattr(hgn.training.checkpoint_writer, "write_atomically", lambda path, data: path.write_bytes(data))
    out = tmp_path / "out.json"
    assert power_loss.main({"out": str(tmp_path / "out"), "every": 4, "rounds": 1, "json": str(out)}) == 1
    (row,) = json.loads(out.read_text())["rows"]
    assert row["what"] == "checkpoints" and row["power_losses"] > 5 and row["faults"]
