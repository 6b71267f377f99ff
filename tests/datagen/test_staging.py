"""Tests locks, staged episodes and quarantine: after any interruption the next writer makes the same shards."""

import dataclasses
import os
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from ballistic_dataset import publish
from written_files import claim_all, hashes, simulated_once, snapshot

import datagen.pool.shard
import datagen.pool.writer
from datagen.pool.plan import scene_seed
from datagen.pool.writer import STAGED_SECONDS, DatasetWriter
from hgn.config import MpmConfig, SceneConfig
from hgn.data.manifest import Manifest
from hgn.data.reader import EpisodeStore
from hgn.data.shard import locate_members
from hgn.schema import ConfigError


class InterruptionError(Exception):
    """A stand-in for a crash."""


@pytest.mark.parametrize("call", [1, 2, 3, 5, 13, 23])
def test_resume_after_a_crash_makes_the_same_shards(
    make_config, make_dataset, small_dataset, stage, monkeypatch, control, call
):
    """Wherever a run stops, running again gives bitwise the same shards and simulates no staged episode twice."""
    config = make_config()
    calls = 0

    def crash(path):
        nonlocal calls
        calls += 1
        if calls == call:
            raise InterruptionError

    stage_parts = datagen.pool.shard.stage_parts

    def stage_and_crash(folder, key, parts):
        stage_parts(folder, key, parts)
        crash(folder)

    with monkeypatch.context() as patch:
        # the last step of each staging and of each shard, so a crash there is a crash between files
        patch.setattr(datagen.pool.shard, "stage_parts", stage_and_crash)
        patch.setattr(datagen.pool.writer, "sync_folder", crash)
        patch.setattr("hgn.system.files.sync_folder", crash)
        try:
            make_dataset(config)
        except InterruptionError:
            assert Path(config.dataset.folder).exists()
    make_dataset(config)
    assert hashes(Path(config.dataset.folder)) == hashes(small_dataset)
    assert Manifest.load(config.dataset.folder).complete and simulated_once(control) == 8


def test_growth_keeps_what_is_there(make_config, make_dataset, tmp_path, control):
    """Asking for more scenes later adds just those; shards that were published keep their bytes and places."""
    small, large = (make_config(training_scenes=count, folder=str(tmp_path / "grown")) for count in (3, 9))
    folder = make_dataset(small)
    before, published = hashes(folder), Manifest.load(folder).shards
    make_dataset(large)
    after = Manifest.load(folder)
    assert after.shards[: len(published)] == published
    assert before.items() <= hashes(folder).items()
    ends = [0, 1, 2, 3, 4, 8, 9]
    assert [(shard.first, shard.stop) for shard in after.shards_of("train")] == list(pairwise(ends))
    assert after.requested["train"] == 9 and after.complete and simulated_once(control) == 9 + 2 + 1
    direct = make_dataset(make_config(training_scenes=9, folder=str(tmp_path / "direct")))
    for grown, made in zip(EpisodeStore(folder, "train"), EpisodeStore(direct, "train"), strict=True):
        assert np.array_equal(grown.position_TN3, made.position_TN3) and grown.seed == made.seed


def test_what_is_complete(make_config, make_dataset, folder, stage, tmp_path):
    """A command for existing episodes, or for fewer, changes no file, with any device, launch size, number of workers
    and shard size. A folder that was started for five episodes is complete for a command for one, once this one
    exists."""
    before = snapshot(folder)
    mpm = MpmConfig(device="cuda", scenes_per_launch=64)
    for config in (
        *(make_config(training_scenes=count) for count in (5, 3)),
        dataclasses.replace(make_config(workers=3, episodes_per_shard=2), mpm=mpm),
    ):
        with DatasetWriter(config) as writer:
            assert writer.complete and writer.claim_next() is None
    assert snapshot(folder) == before
    begun = {"folder": str(tmp_path / "begun")}
    with DatasetWriter(make_config(**begun)) as writer:
        stage(writer, "train", 0)
        publish(writer)
    with DatasetWriter(make_config(training_scenes=1, validation_scenes=0, test_scenes=0, **begun)) as writer:
        assert writer.complete
    assert Manifest.load(writer.folder).complete


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scene": SceneConfig(obstacle_count=3)}, "scene.obstacle_count is 5 there, 3 is requested"),
        ({"mpm": MpmConfig(snow_hardening=5.0)}, "mpm.snow_hardening is 10.0 there, 5.0 is requested"),
        ({"seed": 1}, "seed is 0 there, 1 is requested"),
        ({"frames": 7}, "frames is 6 there, 7 is requested"),
        ({"frame_rate_hz": 30.0}, "frame_rate_hz is 60.0 there, 30.0 is requested"),
    ],
)
def test_other_settings_are_refused(make_config, folder, changes, message):
    """A folder takes no episodes of another distribution, and the message names the keys and the remedy."""
    parts = {name: changes[name] for name in ("scene", "mpm") if name in changes}
    config = dataclasses.replace(make_config(**({} if parts else changes)), **parts)
    before = snapshot(folder)
    with pytest.raises(ConfigError, match=f"contains another data set: {message}; choose another folder"):
        DatasetWriter(config).__enter__()
    assert snapshot(folder) == before


def test_generators_share_a_folder(make_config, small_dataset, stage, control):
    """Each of two generators makes the shards that it claims; what one leaves behind the other makes; each sees what
    the other published."""
    with DatasetWriter(make_config()) as other:
        with DatasetWriter(make_config()) as writer:
            first, second = writer.claim_next(), other.claim_next()
            assert first and second and not set(writer.remaining()) & set(other.remaining())
            stage(writer, first.split, first.first)
            partial = writer.folder / f".{second.name}.77.partial"
            partial.touch()
            assert publish(writer)
            assert claim_all(writer) and other.claim_next() is None and not other.complete
        assert partial.exists() and (other.folder / ".staging").exists()
        other.refresh()
        assert other.done == 1
        for split, index in claim_all(other):
            stage(other, split, index)
        while publish(other):
            pass
        assert other.complete
    assert not partial.exists() and not (other.folder / ".staging").exists()
    assert hashes(other.folder) == hashes(small_dataset) and Manifest.load(other.folder).complete
    assert simulated_once(control) == 8


def test_first_writer_wins(make_config, stage, monkeypatch):
    """Where locks do not hold, two generators make a shard; the second copy is dropped, and it is listed once."""
    monkeypatch.setattr("datagen.pool.locks.ShardLocks.take", lambda self, shard: True)
    messages: list[str] = []
    with DatasetWriter(make_config()) as writer, DatasetWriter(make_config(), messages.append) as other:
        assert writer.claim_next() == other.claim_next()
        stage(writer, "train", 0)
        stage(other, "train", 0)
        assert publish(writer)
        before = snapshot(writer.folder)
        assert publish(other) == writer.manifest.shards[0]
        assert snapshot(writer.folder) == before
    assert messages == ["train-000000-000001.tar was published by another generator; this copy is dropped"]
    assert len(Manifest.load(writer.folder).shards) == 1


def test_array_tasks_make_one_dataset(make_config, make_dataset, small_dataset, control):
    """Three tasks of an array make all shards once between them, each knowing nothing of the others."""
    for task in range(3):
        folder = make_dataset(make_config(array_task=task, array_tasks=3))
        assert Manifest.load(folder).complete == (task == 2)
    assert hashes(folder) == hashes(small_dataset) and simulated_once(control) == 8


@pytest.mark.parametrize("seconds", [0, 2**33])
def test_no_clock_is_asked(make_config, make_dataset, small_dataset, stage, seconds):
    """Machines with clocks in 1970 or far in the future make the same data set together with others. No time of a file
    determines whether it is whole, abandoned or new."""

    def turn_back(folder):
        for path in (*folder.rglob("*"), folder):
            os.utime(path, (seconds, seconds))

    with DatasetWriter(make_config()) as writer:
        store = None
        for index in range(2):
            with DatasetWriter(make_config()) as other:
                stage(other, "train", index)
                (writer.folder / ".staging" / f".train-00000{index}.tar.77.partial").touch()
                turn_back(writer.folder)
                publish(other)
                turn_back(writer.folder)
            store = store or EpisodeStore(writer.folder, "train")
            store.refresh()
            writer.refresh()
            assert len(store) == len(store[:]) == writer.done == index + 1
    make_dataset(make_config())
    turn_back(writer.folder)
    assert hashes(make_dataset(make_config())) == hashes(small_dataset)
    assert not list(writer.folder.rglob("*.partial"))


@pytest.mark.parametrize("damage", ["cut", "zeroed", "a bit", "no seal", "device", "pipe"])
def test_broken_staged_file_is_made_again(make_config, make_dataset, small_dataset, stage, damage):
    """An altered staged file is dropped and its episode made again, even if it can be read (zero positions). The shards
    equal those of an undisturbed run. A file that changes after its check is not packed. A device or a pipe is not
    read, because reading might not end."""
    with DatasetWriter(make_config()) as writer:
        stage(writer, "train", 1)
        staged = writer.folder / ".staging" / "train-000001.tar"
        content = bytearray(staged.read_bytes())
        place, size = locate_members(staged)["train-000001"]["position.npy"]
        if damage == "zeroed":
            content[place + 128 : place + size] = bytes(size - 128)
        content[place + 200] ^= damage == "a bit"
        staged.write_bytes({"cut": content[:2000], "no seal": content[:-72]}.get(damage, content))
        if damage in ("device", "pipe"):
            staged.unlink()
            staged.symlink_to("/dev/zero") if damage == "device" else os.mkfifo(staged)
        with pytest.raises(ConfigError, match=r"train-000001\.tar must end with the sha256"):
            while publish(writer):
                pass
    messages: list[str] = []
    with DatasetWriter(make_config(), messages.append) as writer:
        assert ("train", 1) in claim_all(writer)
    assert "must end with the sha256 of its content" in messages[0] and "is generated again" in messages[0]
    assert hashes(make_dataset(make_config())) == hashes(small_dataset)


def test_what_is_published_is_on_the_disk(make_config, stage, monkeypatch):
    """No shard and no index gets its name before its bytes are on the disk. A staged episode gets there when its shard
    has lacked others for a while, and not where it is packed at once."""
    synced: set[int] = set()
    real_sync, real_link, real_replace = os.fsync, Path.hardlink_to, Path.replace

    def sync(descriptor):
        synced.add(os.fstat(descriptor).st_ino)
        real_sync(descriptor)

    def link(path, target):
        assert target.stat().st_ino in synced, path
        real_link(path, target)

    def replace(path, target):
        assert target.parent.name == ".staging" or path.stat().st_ino in synced, target
        return real_replace(path, target)

    def on_disk(index):
        path = writer.folder / ".staging" / f"train-{index:06d}.tar"
        return path.stat().st_ino in synced

    monkeypatch.setattr(os, "fsync", sync)
    monkeypatch.setattr(Path, "hardlink_to", link)
    monkeypatch.setattr(Path, "replace", replace)
    now = [1000.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    with DatasetWriter(make_config(training_scenes=9)) as writer:
        stage(writer, "train", 0)
        assert not on_disk(0) and publish(writer)
        synced.clear()  # numbers of files that are gone are given again
        stage(writer, "train", 4)  # of a shard of four
        assert writer.publish_next() is None and not on_disk(4)
        now[0] += STAGED_SECONDS
        assert writer.publish_next() is None
        while not on_disk(4):  # or the test's time is over
            time.sleep(0.01)


def test_locks_that_exclude_nobody(make_config, monkeypatch):
    """A file system that grants every lock to everybody is refused: generators would sweep each other's files."""
    monkeypatch.setattr("datagen.pool.locks.fcntl.fcntl", lambda *arguments: 0)
    with pytest.raises(ConfigError, match=r"must be on a file system with exclusive locks.*-o flock"):
        DatasetWriter(make_config()).__enter__()


def test_quarantined_seed_is_replaced(make_config, stage):
    """The next attempt's seed takes the place, the manifest keeps seed and cause, and a later run goes on there."""
    config = make_config()
    with DatasetWriter(config) as writer:
        replacement = writer.quarantine(writer.task("train", 0), "diverged")
        assert replacement.seed == scene_seed(0, "train", 0, attempt=1)
    with DatasetWriter(config) as writer:
        assert writer.task("train", 0) == replacement
        stage(writer, "train", 0)
        publish(writer)
    manifest = Manifest.load(writer.folder)
    (failure,) = manifest.quarantined
    first_seed = scene_seed(0, "train", 0, attempt=0)
    assert (failure.key, failure.seed, failure.cause) == ("train-000000", first_seed, "diverged")
    (entry,) = manifest.shards[0].episodes
    assert (entry.attempt, entry.seed) == (1, replacement.seed)
