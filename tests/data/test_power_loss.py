"""Tests that published shards, saved checkpoints and cached shards survive a loss of power, a kill and a failing disk.

Python's file system calls are intercepted while data are written. Before a call the folder is copied as a disk may
contain it after a power loss: it contains bytes if the file was synced, and names if their folder was. Other bytes and
names may be there, lost, cut or zeroed, because POSIX and some file systems guarantee no more (Pillai et al., OSDI
2014). Each copy must contain everything published or saved, and the next run must complete it, bitwise.
"""

import builtins
import errno
import hashlib
import io
import os
import random
import shutil
import threading
from contextlib import ExitStack, contextmanager
from pathlib import Path
from unittest import mock

import ballistic_dataset
import pytest
import torch

from datagen.pool.writer import DatasetWriter
from hgn.config import DatagenConfig, DatasetConfig
from hgn.data.manifest import Manifest
from hgn.data.sampler import SamplerState
from hgn.data.shard_cache import CACHE_VARIABLE
from hgn.data.storage import open_storage
from hgn.schema import ConfigError, to_mapping
from hgn.system import files
from hgn.training.checkpoint import LAST_NAMES, SECTION, read_checkpoint
from hgn.training.checkpoint_writer import CheckpointWriter

KEPT = (0.0, 1.0, 0.5)  # probability that anything not synced is on the disk
CALLS = ("replace", "rename", "link", "unlink", "remove", "mkdir", "rmdir", "truncate")


def path_of(file):
    return Path(f"/proc/self/fd/{file}").readlink() if isinstance(file, int) else Path(os.fsdecode(file)).absolute()


def entries(folder):
    return {entry.name: entry.stat(follow_symlinks=False).st_ino for entry in os.scandir(folder)}


class Disk:
    """Tracks which parts of a folder are on the disk, and calls `before` before each call that changes the folder.

    `piece` is the largest number of bytes that one call reads or writes. An error of `before` is the call's error.
    """

    def __init__(self, folder, before=lambda: None, piece=None):
        self.folder, self.piece, self._before = folder.resolve(), piece, before
        self._names, self._bytes, self._folders = {}, {}, set()  # by inode: entries of folders, bytes of files
        self.written = set()  # names of files that were opened for writing, or truncated
        self._lock = threading.RLock()

    @contextmanager
    def followed(self):
        """Intercepts Python's calls in all threads."""
        with ExitStack() as self._stack:
            opened = self._opened(io.open)
            calls = [(os, name, self._followed(getattr(os, name))) for name in CALLS]
            calls += [(os, "fsync", self._fsync), (io, "open", opened), (builtins, "open", opened)]
            for owner, name, call in calls:
                self._stack.enter_context(mock.patch.object(owner, name, call))
            yield

    def step(self):
        with self._lock:
            self._before()

    def lay_out(self, target, kept, draw):
        """Copies the folder as the disk may contain it; `kept` is the probability of anything that is not synced."""
        paths = {path.stat().st_ino: path for path in (self.folder, *self.folder.rglob("*"))}

        def lay_out(inode, target):
            target.mkdir()
            synced, now = self._names.get(inode, {}), entries(paths[inode]) if inode in paths else {}
            for name in sorted(synced.keys() | now.keys()):
                entry = (now if draw.random() < kept else synced).get(name)
                path = paths.get(entry)
                if entry in self._folders or (path is not None and path.is_dir()):
                    lay_out(entry, target / name)
                elif entry is not None:
                    (target / name).write_bytes(self._content(entry, path, kept, draw))

        lay_out(self.folder.stat().st_ino, target)

    def _content(self, inode, path, kept, draw):
        synced = self._bytes.get(inode, b"")
        now = synced if path is None else path.read_bytes()
        different = (i for i, (a, b) in enumerate(zip(synced, now, strict=False)) if a != b)
        same = next(different, min(len(synced), len(now)))
        choices = [synced, now, now[: (same + len(now)) // 2], now[:same] + bytes(len(now) - same)]
        return choices[draw.randrange(4) if 0 < kept < 1 else 0]

    def _followed(self, call):
        def followed(path, *arguments, **options):
            if path_of(path).is_relative_to(self.folder):
                self.written |= {path_of(path).name} if call.__name__ == "truncate" else set()
                self.step()
            return call(path, *arguments, **options)

        return followed

    def _fsync(self, descriptor):
        path = path_of(descriptor)
        if not path.is_relative_to(self.folder):
            return
        self.step()  # the data are not really synced: that would be slow
        with self._lock:
            inode = os.fstat(descriptor).st_ino
            self._stack.callback(os.close, os.dup(descriptor))  # so that no other file gets the inode's number
            if path.is_dir():
                self._names[inode] = entries(path)
                self._folders |= {inode for name, inode in self._names[inode].items() if (path / name).is_dir()}
            else:
                self._bytes[inode] = Path(f"/proc/self/fd/{descriptor}").read_bytes()

    def _opened(self, call):
        disk = self

        class Raw(io.FileIO):
            def write(self, data):
                disk.step()
                return super().write(memoryview(data)[: disk.piece])

            def readinto(self, buffer):
                return super().readinto(memoryview(buffer)[: disk.piece])

            def read(self, size=-1):
                return super().read(size if disk.piece is None or size is None or size < 0 else min(size, disk.piece))

        def opened(file, mode="r", buffering=-1, encoding=None, errors=None, newline=None, closefd=True, opener=None):
            writes = bool(set("wax+") & set(mode))
            if not path_of(file).is_relative_to(disk.folder) or not (writes or disk.piece):
                return call(file, mode, buffering, encoding, errors, newline, closefd, opener)
            if writes:
                disk.written.add(path_of(file).name)
                if not isinstance(file, int):
                    disk.step()
            raw = Raw(file, mode.replace("b", "").replace("t", ""), closefd, opener)
            kind = io.BufferedRandom if "+" in mode else io.BufferedWriter if writes else io.BufferedReader
            stream = raw if buffering == 0 else kind(raw)
            return stream if "b" in mode else io.TextIOWrapper(stream, encoding, errors, newline)

        return opened


# what is written: `write` adds what must be there from now on to `promised`; `check` raises an error where it is not


class Generation:
    """Four shards; one scene is quarantined and drawn again, and the second shard is lost and generated again."""

    def write(self, folder, promised):
        counts = {"training_scenes": 6, "validation_scenes": 0, "test_scenes": 0, "frames": 3, "episodes_per_shard": 2}
        config = DatagenConfig(dataset=DatasetConfig(folder=str(folder / "data"), **counts))
        for lost in (None, "train-000001-000002.tar"):
            if lost is not None:
                del promised[lost]
                (folder / "data" / lost).unlink()
            with mock.patch("datagen.pool.writer.STAGED_SECONDS", 0.0), DatasetWriter(config) as writer:
                while (shard := writer.claim_next()) is not None:
                    attempt = writer.task("train", shard.first)
                    if shard.first == 2 and attempt.attempt == 0:
                        writer.quarantine(attempt, "drawn by lot")
                        promised["quarantined"] = attempt.key
                    entry = None
                    for split, index in writer.remaining():
                        ballistic_dataset.stage(writer, split, index)
                        entry = ballistic_dataset.publish(writer)
                    entry = entry or ballistic_dataset.publish(writer)  # of what an earlier run had staged
                    promised[entry.name] = entry.sha256

    def check(self, folder, promised):
        listed = {}
        if (folder / "data" / "manifest.json").exists():
            manifest = Manifest.load(folder / "data")
            listed = {shard.name: shard.sha256 for shard in manifest.shards}
            listed |= dict.fromkeys(["quarantined"][: len(manifest.quarantined)], "train-000002")
        assert not {name for name in promised if listed.get(name) != promised[name]}, "published, and lost"
        self.write(folder, {"train-000001-000002.tar": ""})
        hashes = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in (folder / "data").glob("*.tar")}
        assert len(hashes) == 4 and all(hashes.get(n, d) == d for n, d in promised.items() if n != "quarantined")
        assert not list(folder.rglob(f"*{files.TEMPORARY_SUFFIX}"))


class Checkpoints:
    """Four checkpoints of a run in a new folder; the last saved one must be there, or a later one."""

    def write(self, folder, promised):
        writer = CheckpointWriter()
        for updates in range(1, 5):
            own = {"updates": updates, "sampler_state": to_mapping(SamplerState())}
            content = {SECTION: own, "state_dict": {"weight": torch.full((64,), float(updates))}}
            writer.save_checkpoint(content, folder / "runs" / "one" / "checkpoints" / LAST_NAMES[0])
            writer.wait()
            promised["updates"] = updates
        writer.teardown()

    def check(self, folder, promised):
        paths = [folder / "runs" / "one" / "checkpoints" / name for name in LAST_NAMES]
        last = next((path for path in paths if path.exists()), None)
        found = 0 if last is None else read_checkpoint(last)[SECTION]["updates"]
        assert found >= promised.get("updates", 0), f"update {promised} was saved, {found} is there"


class Cache:
    """A cached shard is there as it was published, or not at all: a lost one is fetched again."""

    content = random.Random(0).randbytes(10_000)

    def write(self, folder, promised):
        served = folder.parent / "served"
        served.mkdir(exist_ok=True)
        (served / "a.tar").write_bytes(self.content)
        with mock.patch.dict(os.environ, {CACHE_VARIABLE: f"{folder}/cache"}):
            digest = hashlib.sha256(self.content).hexdigest()
            path = open_storage(f"local://{served}").shard("a.tar", digest, len(self.content))
            assert path.read_bytes() == self.content

    check = write


SCENARIOS = {"generation": Generation(), "checkpoints": Checkpoints(), "cache": Cache()}


def broken(scenario, place, promised, when):
    """Why a folder breaks a promise, as a list of one or none."""
    try:
        scenario.check(place, promised)
    except (AssertionError, ConfigError, OSError, LookupError, ValueError) as error:
        return [f"{when}: {type(error).__name__}: {error}"]
    return []


def lose_power(scenario, folder, every, rounds=1):
    """Loses power before every `every`-th call, `rounds` times; returns counts of calls and copies, and the faults."""
    calls, faults, promised, laid_out = 0, [], {}, []

    def before():
        nonlocal calls
        calls += 1
        for number in range(0 if calls % every else rounds):
            place = folder / f"{calls}-{number}"
            disk.lay_out(place, KEPT[(calls // every + number) % len(KEPT)], random.Random(f"0/{calls}/{number}"))
            laid_out.append((place, dict(promised)))

    (folder / "disk").mkdir(parents=True)
    disk = Disk(folder / "disk", before)
    with disk.followed():
        scenario.write(folder / "disk", promised)
    for place, then in laid_out:
        faults += broken(scenario, place, then, place.name)
        shutil.rmtree(place)
    return calls, len(laid_out), faults


def fail(scenario, folder, every, piece):
    """Lets one call a run fail with EIO; returns the number of failed calls and the faults."""
    faults, failed = [], 0
    while True:
        calls, number, promised, place = 0, 1 + failed * every, {}, folder / f"failing-{1 + failed * every}"

        def before(number=number):
            nonlocal calls
            calls += 1
            if calls == number:
                raise OSError(errno.EIO, os.strerror(errno.EIO))

        place.mkdir(parents=True)
        try:
            with Disk(place, before, piece).followed():
                scenario.write(place, promised)
        except Exception as error:  # noqa: BLE001 - any other error is a fault
            if not (isinstance(error, OSError) and error.errno == errno.EIO):
                faults.append(f"call {number}: {error!r}")
        if calls < number:
            return failed, faults
        failed += 1
        faults += broken(scenario, place, promised, f"after call {number}")
        shutil.rmtree(place)


@pytest.mark.parametrize(("name", "every"), [("generation", 20), ("checkpoints", 5), ("cache", 2)])
def test_nothing_is_lost(tmp_path, backend, name, every):
    """After a power loss, a kill or a disk error before some call, with reads and writes of at most 1,000 bytes, all
    published or saved data are there, partial files are not used, and the next run writes the same files."""
    calls, tried, faults = lose_power(SCENARIOS[name], tmp_path, every)
    assert faults == [] and tried == calls // every > 3
    failed, faults = fail(SCENARIOS[name], tmp_path, 2 * every, 1000)
    assert faults == [] and failed > 1


def test_a_shard_never_shrinks(tmp_path, backend):
    """A shard, cached or not, gets its name when it is complete and is never written to or truncated afterwards. Its
    name is on the disk when a manifest lists it, even for a moment."""
    data, counts = tmp_path / "disk" / "data", set()

    def before():
        if (data / "manifest.json").exists():
            listed = {shard.name for shard in Manifest.load(data).shards if (data / shard.name).exists()}
            assert listed <= disk._names[data.stat().st_ino].keys()
            counts.add(len(listed))

    data.parent.mkdir()
    for name, look in (("generation", before), ("cache", lambda: None)):
        disk = Disk(tmp_path / "disk", look)
        with disk.followed():
            SCENARIOS[name].write(tmp_path / "disk", {})
        written = {path for path in disk.written if not path.endswith(files.TEMPORARY_SUFFIX)}
        assert disk.written - written and all(path.endswith(".jsonl") for path in written)
        assert counts == {0, 1, 2, 3, 4}


@pytest.mark.parametrize("skipped", ["sync_file", "sync_folder"])
def test_faults_are_found(tmp_path, skipped):
    """Without the sync of files, or of folders, saved checkpoints are lost."""
    with mock.patch.object(files, skipped):
        _, _, faults = lose_power(SCENARIOS["checkpoints"], tmp_path, 1, 3)
    assert any("was saved" in fault or "must be a complete checkpoint" in fault for fault in faults)
