"""Published shards, saved checkpoints and cached shards survive a loss of power, a kill and a failing disk."""

from unittest import mock

import pytest
from data.power_loss import SCENARIOS, Disk, fail, lose_power

from hgn.system import files


@pytest.mark.parametrize(("name", "every"), [("generation", 20), ("checkpoints", 5), ("cache", 2)])
def test_nothing_is_lost(tmp_path, name, every):
    """After a power loss, a kill or a disk error before some call, with reads and writes of at most 1,000 bytes, all
    published or saved data are there, partial files are not used, and the next run writes the same files."""
    calls, tried, faults = lose_power(SCENARIOS[name], tmp_path, every)
    assert faults == [] and tried == calls // every > 3
    failed, faults = fail(SCENARIOS[name], tmp_path, 2 * every, 1000)
    assert faults == [] and failed > 1


def test_a_mapped_shard_never_shrinks(tmp_path):
    """A shard, cached or not, gets its name when it is complete and is never written to or truncated afterwards, so
    that mapping it is safe (a truncated map would end the reader with SIGBUS)."""
    for name in ("generation", "cache"):
        disk = Disk(tmp_path)
        with disk.followed():
            SCENARIOS[name].write(tmp_path, {})
        written = {path for path in disk.written if not path.endswith(files.TEMPORARY_SUFFIX)}
        assert disk.written - written and all(path.endswith(".jsonl") for path in written)


@pytest.mark.parametrize("skipped", ["sync_file", "sync_folder"])
def test_faults_are_found(tmp_path, skipped):
    """Without the sync of files, or of folders, saved checkpoints are lost."""
    with mock.patch.object(files, skipped):
        _, _, faults = lose_power(SCENARIOS["checkpoints"], tmp_path, 1, 3)
    assert any("was saved" in fault or "must be a whole checkpoint" in fault for fault in faults)
