"""Shards and manifest: the same input gives the same bytes, and no interruption leaves anything half-written."""

import dataclasses
import errno
import os
import subprocess
from threading import Event, Lock, current_thread

import numpy as np
import pytest
import webdataset
from ballistic_dataset import publish
from written_files import claim_all, hashes

from datagen.pool.writer import DatasetWriter
from hgn.config import SceneConfig
from hgn.data.manifest import Manifest
from hgn.data.reader import EpisodeStore
from hgn.data.shard import locate_members
from hgn.data.statistics import Moments
from hgn.schema import ConfigError


def test_dataset_is_complete_and_in_order(folder, make_config, make_dataset, small_dataset):
    """Every episode is published in shards of growing size; the manifest's last revision lists them all. Two folders
    made from one config are bitwise equal, manifest included."""
    manifest = Manifest.load(folder)
    assert manifest.complete and manifest.revision == len(manifest.shards)
    assert [shard.name.removesuffix(".tar") for shard in manifest.shards] == [
        *("train-000000-000001", "validation-000000-000001", "train-000001-000002", "validation-000001-000002"),
        *("train-000002-000004", "train-000004-000005", "test-000000-000001"),
    ]
    assert {path.name for path in folder.iterdir()} == {*hashes(folder), "manifest.json", "index", ".lock"}
    made = make_dataset(make_config(folder=f"{folder}_again"))
    assert hashes(made) == hashes(small_dataset)
    assert (made / "manifest.json").read_bytes() == (small_dataset / "manifest.json").read_bytes()


# WebDataset leaves the file it iterated over to the garbage collector
@pytest.mark.filterwarnings("ignore:Exception ignored in. <_io.FileIO:pytest.PytestUnraisableExceptionWarning")
def test_plain_tar_and_webdataset_read_shards(folder):
    """Any tar program and a plain WebDataset pipeline read a shard without this project."""
    shard = folder / "train-000002-000004.tar"
    names = subprocess.run(["tar", "-tf", shard], capture_output=True, text=True, check=True).stdout.split()
    assert names[:6] == [
        f"train-000002.{name}"
        for name in ("position.npy", "velocity.npy", "material.npy", "obstacle_cell.npy", "obstacle_normal.npy", "json")
    ]
    samples = list(webdataset.WebDataset(str(shard), shardshuffle=False).decode())
    stored = EpisodeStore(folder, "train")[2:4]
    assert [sample["__key__"] for sample in samples] == ["train-000002", "train-000003"]
    for sample, episode in zip(samples, stored, strict=True):
        assert np.array_equal(sample["position.npy"], episode.position_TN3)
        assert np.array_equal(sample["material.npy"], episode.material_N)
        assert sample["json"]["seed"] == episode.seed


def test_manifest_statistics_equal_direct_ones(folder):
    """Statistics over all shards of a split equal those computed from all its episodes at once."""
    statistics = Manifest.load(folder).statistics("train")
    positions = [np.asarray(episode.position_TN3, np.float64) for episode in EpisodeStore(folder, "train")]
    for moments, order in ((statistics.velocity, 1), (statistics.acceleration, 2)):
        values = np.concatenate([np.diff(position, n=order, axis=0).reshape(-1, 3) for position in positions])
        assert moments.count == len(values)
        np.testing.assert_allclose(moments.mean, values.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(moments.std, values.std(axis=0), rtol=1e-9)
    assert Manifest.load(folder).statistics("test").velocity != Moments()


def test_lost_manifest(make_config, folder):
    """Published shards are verified and listed again. One of other settings is recognised and refused, and so is one
    that lacks an episode of its range: a cut at a member boundary does not pass."""
    before = {shard.name: shard for shard in Manifest.load(folder).shards}
    (folder / "manifest.json").unlink()
    with pytest.raises(ConfigError, match="belongs to another data set; move the file out"):
        DatasetWriter(dataclasses.replace(make_config(), scene=SceneConfig(obstacle_count=3))).__enter__()
    with DatasetWriter(make_config()) as writer:
        assert writer.complete
    assert {shard.name: shard for shard in Manifest.load(folder).shards} == before
    (folder / "manifest.json").unlink()
    shard = folder / "train-000002-000004.tar"
    os.truncate(shard, locate_members(shard)["train-000003"]["position.npy"][0] - 512)
    with pytest.raises(ConfigError, match="must contain train-000002, train-000003, got train-000002; delete it"):
        DatasetWriter(make_config()).__enter__()


def test_pipe_in_the_place_of_a_shard(make_config, tmp_path):
    """A pipe that has a shard's name is refused; opening it would wait for ever."""
    folder = tmp_path / "piped"
    folder.mkdir()
    os.mkfifo(folder / "train-000000-000001.tar")
    with pytest.raises(ConfigError, match="must be a complete tar"), DatasetWriter(make_config(folder=str(folder))):
        pass


def test_missing_shard_is_made_again(make_config, make_dataset, folder):
    """A shard that was deleted, the remedy for an altered one, is made again and listed."""
    before = hashes(folder)
    (folder / "train-000002-000004.tar").unlink()
    messages: list[str] = []
    with DatasetWriter(make_config(), messages.append) as writer:
        assert claim_all(writer) == [("train", 2), ("train", 3)]
    assert "train-000002-000004.tar is listed in the index but missing" in messages[0]
    make_dataset(make_config())
    assert hashes(folder) == before


@pytest.fixture
def full_disk(monkeypatch):
    """After the given number of further syncs the disk is full."""
    real = os.fsync
    left = -1
    counting = Lock()

    def fsync(descriptor):
        nonlocal left
        with counting:
            left -= 1
            full = left == -1
        if full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(descriptor)

    def fill(after):
        nonlocal left
        left = after

    monkeypatch.setattr(os, "fsync", fsync)
    yield fill
    left = -1


@pytest.mark.parametrize(("together", "after"), [*((False, n) for n in range(4)), *((True, n) for n in (0, 4, 10))])
def test_full_disk_leaves_nothing_half_written(make_config, make_dataset, stage, full_disk, together, after):
    """A full disk at any step, of one packer or several, ends the run with a message, keeps finished files and leaves
    no partial one. With space the run continues."""
    with DatasetWriter(make_config()) as writer:
        stage(writer, "train", 0)
        publish(writer)
        before = hashes(writer.folder)
    with pytest.raises(OSError, match=r"No space left on device: .*data"), DatasetWriter(make_config()) as writer:
        if together:
            for split, index in claim_all(writer):
                stage(writer, split, index)
        full_disk(after)
        for index in (1, 2, 3):
            if not together:
                stage(writer, "train", index)
            while publish(writer):
                pass
    assert before.items() <= hashes(writer.folder).items()
    assert not list(writer.folder.rglob("*.partial"))
    make_dataset(make_config())
    assert Manifest.load(writer.folder).complete


def test_packing_is_not_waited_for(make_config, stage, monkeypatch):
    """A pool goes on listening to its workers while shards are packed, and publishes what is packed first. Splits may
    be empty."""
    with DatasetWriter(make_config(validation_scenes=0, test_scenes=0)) as writer:
        shards = list(iter(writer.claim_next, None))
        for split, index in writer.remaining():
            stage(writer, split, index)
        going_on = Event()

        def pack(shard, own=writer._pack):
            assert shard != shards[0] or going_on.wait(60)
            return own(shard)

        monkeypatch.setattr(writer, "_pack", pack)
        published: list[str] = []
        while len(published) < len(shards):
            entry = writer.publish_next()
            published += [entry.name] if entry else []
            if len(published) == len(shards) - 1:
                assert shards[0].name not in published and writer.packing and not writer.complete
                going_on.set()
        assert published[-1] == shards[0].name and writer.complete and not writer.packing
    assert len(EpisodeStore(writer.folder, "test")) == 0


def test_shards_that_wait_are_packed_together(make_config, small_dataset, stage, monkeypatch):
    """Where several shards are ready they are packed side by side, published in order, and are the same files as those
    that are packed one by one."""
    with DatasetWriter(make_config()) as writer:
        for split, index in claim_all(writer):
            stage(writer, split, index)
        packed_by = []
        monkeypatch.setattr(
            writer, "_pack", lambda shard, pack=writer._pack: (packed_by.append(current_thread()), pack(shard))[1]
        )
        while publish(writer):
            pass
        assert writer.complete and len(set(packed_by)) > 1
    assert hashes(writer.folder) == hashes(small_dataset)
