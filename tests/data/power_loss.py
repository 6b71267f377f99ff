"""Loses the power, or fails the disk, before any call of a generation, a checkpoint or a reader's cache.

Python's file system calls are intercepted while data are written. Before each call the folder is copied as a disk may
contain it after a power loss: bytes are there if the file was synced, names if their folder was; all others may be
there, lost, cut or zeroed. POSIX guarantees no more, nor do some file systems (Pillai et al., OSDI 2014). Everything
published or saved must be in each copy, and the next run must complete it, bitwise.
"""

from __future__ import annotations

import builtins
import errno
import hashlib
import io
import os
import random
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

from datagen.pool.shard import stage_episode
from datagen.pool.writer import DatasetWriter
from hgn.config import DatagenConfig, DatasetConfig
from hgn.data.manifest import Manifest
from hgn.data.shard_cache import CACHE_VARIABLE
from hgn.data.storage import open_storage
from hgn.scene.episode import Episode
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.schema import ConfigError
from hgn.system.files import TEMPORARY_SUFFIX
from hgn.training.checkpoint import LAST_NAMES, SECTION, read_checkpoint
from hgn.training.checkpoint_writer import CheckpointWriter

KEPT = (0.0, 1.0, 0.5)  # probability that anything not synced is on the disk
SHARDS = 4
CALLS = ("replace", "rename", "link", "unlink", "remove", "mkdir", "rmdir", "truncate")


class Disk:
    """Tracks which parts of a folder are on the disk, and calls `before` before each call that changes the folder.

    `piece` is the largest number of bytes that one call reads or writes. An error of `before` is the call's error.
    """

    def __init__(self, folder: Path, before: Callable[[], None] = lambda: None, piece: int | None = None) -> None:
        self.folder, self.piece, self._before = folder.resolve(), piece, before
        self._names: dict[int, dict[str, int]] = {}  # of folders: their entries' inodes
        self._bytes: dict[int, bytes] = {}  # of files
        self._folders: set[int] = set()
        self.written = set[str]()  # names of files that were opened for writing, or truncated
        self._stack = ExitStack()
        self._lock = threading.RLock()

    @contextmanager
    def followed(self) -> Iterator[None]:
        """Intercepts Python's calls in all threads."""
        with self._stack as stack:
            for name in CALLS:
                stack.enter_context(mock.patch.object(os, name, self._followed(getattr(os, name))))
            stack.enter_context(mock.patch.object(os, "fsync", self._fsync))
            opened = self._opened(io.open)
            stack.enter_context(mock.patch.object(io, "open", opened))
            stack.enter_context(mock.patch.object(builtins, "open", opened))
            yield

    def step(self) -> None:
        with self._lock:
            self._before()

    def lay_out(self, target: Path, kept: float, draw: random.Random) -> None:
        """Copies the folder as the disk may contain it; `kept` is the probability of anything that is not synced."""
        paths = {path.stat().st_ino: path for path in (self.folder, *self.folder.rglob("*"))}

        def lay_out(inode: int, target: Path) -> None:
            target.mkdir()
            synced, now = self._names.get(inode, {}), _entries(paths[inode]) if inode in paths else {}
            for name in sorted(synced.keys() | now.keys()):
                entry = (now if draw.random() < kept else synced).get(name)
                if entry is None:
                    continue
                path = paths.get(entry)
                if entry in self._folders or (path is not None and path.is_dir()):
                    lay_out(entry, target / name)
                else:
                    (target / name).write_bytes(self._content(entry, path, kept, draw))

        lay_out(self.folder.stat().st_ino, target)

    def _content(self, inode: int, path: Path | None, kept: float, draw: random.Random) -> bytes:
        synced = self._bytes.get(inode, b"")
        now = synced if path is None else path.read_bytes()
        different = (i for i, (a, b) in enumerate(zip(synced, now, strict=False)) if a != b)
        same = next(different, min(len(synced), len(now)))
        choices = [synced, now, now[: (same + len(now)) // 2], now[:same] + bytes(len(now) - same)]
        return choices[draw.randrange(4) if 0 < kept < 1 else 0]

    def _followed(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def followed(path: Any, *arguments: Any, **options: Any) -> Any:
            if _path_of(path).is_relative_to(self.folder):
                self.written |= {_path_of(path).name} if call.__name__ == "truncate" else set()
                self.step()
            return call(path, *arguments, **options)

        return followed

    def _fsync(self, descriptor: int) -> None:
        path = Path(f"/proc/self/fd/{descriptor}").readlink()
        if not path.is_relative_to(self.folder):
            return
        self.step()  # the data are not really synced: that would be slow
        with self._lock:
            inode = os.fstat(descriptor).st_ino
            self._stack.callback(os.close, os.dup(descriptor))  # so that no other file gets the inode's number
            if path.is_dir():
                self._names[inode] = _entries(path)
                self._folders |= {inode for name, inode in self._names[inode].items() if (path / name).is_dir()}
            else:
                self._bytes[inode] = Path(f"/proc/self/fd/{descriptor}").read_bytes()

    def _opened(self, call: Callable[..., Any]) -> Callable[..., Any]:
        disk = self

        class Raw(io.FileIO):
            def write(self, data: Any) -> int:
                disk.step()
                return super().write(memoryview(data)[: disk.piece])

            def readinto(self, buffer: Any) -> int | None:
                return super().readinto(memoryview(buffer)[: disk.piece])

            def read(self, size: int | None = -1) -> Any:
                return super().read(size if disk.piece is None or size is None or size < 0 else min(size, disk.piece))

        def opened(
            file: Any, mode: str = "r", buffering: int = -1, encoding: str | None = None, errors: str | None = None,
            newline: str | None = None, closefd: bool = True, opener: Any = None,
        ) -> Any:  # fmt: skip
            writes = bool(set("wax+") & set(mode))
            if not _path_of(file).is_relative_to(self.folder) or not (writes or self.piece):
                return call(file, mode, buffering, encoding, errors, newline, closefd, opener)
            if writes:
                self.written.add(_path_of(file).name)
            if writes and not isinstance(file, int):
                self.step()
            raw = Raw(file, mode.replace("b", "").replace("t", ""), closefd, opener)
            kind = io.BufferedRandom if "+" in mode else io.BufferedWriter if writes else io.BufferedReader
            stream = raw if buffering == 0 else kind(raw)
            return stream if "b" in mode else io.TextIOWrapper(stream, encoding, errors, newline)

        return opened


def _path_of(file: Any) -> Path:
    return Path(f"/proc/self/fd/{file}").readlink() if isinstance(file, int) else Path(os.fsdecode(file)).absolute()


def _entries(folder: Path) -> dict[str, int]:
    return {entry.name: entry.stat(follow_symlinks=False).st_ino for entry in os.scandir(folder)}


class Generation:
    """Four shards; one scene is quarantined and drawn again, and the second shard is lost and generated again."""

    def write(self, folder: Path, promised: dict[str, str]) -> None:
        """Adds the names and hashes that must be there from now on to `promised`."""
        for lost in (None, "train-000001-000002.tar"):
            if lost is not None:
                del promised[lost]
                (folder / "data" / lost).unlink()
            with mock.patch("datagen.pool.writer.STAGED_SECONDS", 0.0), self._writer(folder) as writer:
                while (shard := writer.claim_next()) is not None:
                    attempt = writer.task("train", shard.first)
                    if shard.first == 2 and attempt.attempt == 0:
                        writer.quarantine(attempt, "drawn by lot")
                        promised["quarantined"] = attempt.key
                    entry = None
                    for _, index in writer.remaining():
                        stage_small(writer, index)
                        entry = writer.publish_next()
                    entry = entry or writer.publish_next()  # of what an earlier run had staged
                    assert entry is not None
                    promised[entry.name] = entry.sha256

    def check(self, folder: Path, promised: dict[str, str]) -> None:
        """Raises an error if anything promised is missing."""
        if (folder / "data" / "manifest.json").exists():
            manifest = Manifest.load(folder / "data")
            listed = {shard.name: shard.sha256 for shard in manifest.shards}
            listed |= dict.fromkeys(["quarantined"][: len(manifest.quarantined)], "train-000002")
        else:
            listed = {}
        lost = {name for name in promised if listed.get(name) != promised[name]}
        assert not lost, f"{sorted(lost)} were published, and are lost"
        self.write(folder, {"train-000001-000002.tar": ""})
        files = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in (folder / "data").glob("*.tar")}
        assert len(files) == SHARDS and all(files.get(n, d) == d for n, d in promised.items() if n != "quarantined")
        assert not list(folder.rglob(f"*{TEMPORARY_SUFFIX}"))

    def _writer(self, folder: Path) -> DatasetWriter:
        dataset = DatasetConfig(
            folder=str(folder / "data"), training_scenes=6, validation_scenes=0, test_scenes=0, frames=3,
            episodes_per_shard=2,
        )  # fmt: skip
        return DatasetWriter(DatagenConfig(dataset=dataset))


class Checkpoints:
    """Four checkpoints of a run in a new folder; the last saved one must be there, or a later one."""

    def write(self, folder: Path, promised: dict[str, int]) -> None:
        """Adds the number of saved updates to `promised`."""
        writer = CheckpointWriter()
        for updates in range(1, 5):
            content = {SECTION: {"updates": updates}, "state_dict": {"weight": torch.full((64,), float(updates))}}
            writer.save_checkpoint(content, folder / "runs" / "one" / "checkpoints" / LAST_NAMES[0])
            writer.wait()
            promised["updates"] = updates
        writer.teardown()

    def check(self, folder: Path, promised: dict[str, int]) -> None:
        """Raises an error if anything promised is missing."""
        paths = [folder / "runs" / "one" / "checkpoints" / name for name in LAST_NAMES]
        last = next((path for path in paths if path.exists()), None)
        found = 0 if last is None else read_checkpoint(last)[SECTION]["updates"]
        assert found >= promised.get("updates", 0), f"update {promised} was saved, {found} is there"


class Cache:
    """A cached shard is there as it was published, or not at all."""

    content = random.Random(0).randbytes(10_000)

    def write(self, folder: Path, promised: dict[str, str]) -> None:
        """Promises nothing: a lost shard is fetched again."""
        digest = hashlib.sha256(self.content).hexdigest()
        with tempfile.TemporaryDirectory() as served, mock.patch.dict(os.environ, {CACHE_VARIABLE: f"{folder}/cache"}):
            (Path(served) / "a.tar").write_bytes(self.content)
            path = open_storage(f"local://{served}").shard("a.tar", digest, len(self.content))
            assert path.read_bytes() == self.content

    def check(self, folder: Path, promised: dict[str, str]) -> None:
        """Raises an error if anything promised is missing."""
        self.write(folder, promised)


SCENARIOS = {"generation": Generation(), "checkpoints": Checkpoints(), "cache": Cache()}


def lose_power(scenario: Any, folder: Path, every: int, rounds: int = 1) -> tuple[int, int, list[str]]:
    """Loses power before every `every`-th call, `rounds` times; returns counts of calls and copies, and the faults."""
    calls, faults, promised = 0, list[str](), dict[str, Any]()
    laid_out: list[tuple[Path, dict[str, Any]]] = []

    def before() -> None:
        nonlocal calls
        calls += 1
        for number in range(0 if calls % every else rounds):
            draw = random.Random(f"0/{calls}/{number}")
            place = folder / f"{calls}-{number}"
            disk.lay_out(place, KEPT[(calls // every + number) % len(KEPT)], draw)
            laid_out.append((place, dict(promised)))

    (folder / "disk").mkdir(parents=True)
    disk = Disk(folder / "disk", before)
    with disk.followed():
        scenario.write(folder / "disk", promised)
    for place, then in laid_out:
        faults += broken(scenario, place, then, place.name)
        shutil.rmtree(place)
    return calls, len(laid_out), faults


def broken(scenario: Any, place: Path, promised: dict[str, Any], when: str) -> list[str]:
    """Returns why a folder breaks a promise, as a list of one or none."""
    try:
        scenario.check(place, promised)
    except (AssertionError, ConfigError, OSError, LookupError, ValueError) as error:
        return [f"{when}: {type(error).__name__}: {error}"]
    return []


def fail(scenario: Any, folder: Path, every: int, piece: int | None) -> tuple[int, list[str]]:
    """Lets one call a run fail with EIO; returns the number of failed calls and the faults."""
    faults, failed = list[str](), 0
    while True:
        calls, number, promised = 0, 1 + failed * every, dict[str, Any]()
        place = folder / f"failing-{number}"

        def before(number: int = number) -> None:
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


def stage_small(writer: DatasetWriter, number: int) -> None:
    """An episode of two particles."""
    task = writer.task("train", number)
    generator = np.random.default_rng(number)
    none = np.zeros((0, 3))
    episode = Episode(
        key=task.key,
        position_TN3=(0.4 + 0.2 * generator.random((3, 2, 3))).astype(np.float32),
        initial_velocity_N3=np.zeros((2, 3), np.float32),
        material_N=np.zeros(2, np.uint8),
        obstacle_grid=ObstacleGrid(1 / 64, none.astype(np.int32), none.astype(np.float32)),
        domain_size=(1.0, 1.0, 1.0),
        gravity=(0.0, -9.8, 0.0),
        frame_rate_hz=writer.config.dataset.frame_rate_hz,
        seed=task.seed,
        material_parameters={},
        specification={},
        solver={"dataset": {"config_hash": writer.config_hash, "attempt": task.attempt}},
    )
    stage_episode(writer.folder, episode)
    writer.add_staged("train", number)
