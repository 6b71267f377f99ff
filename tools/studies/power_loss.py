"""python -m tools.studies.power_loss out=data/power_loss: the machine loses its power, or its disk fails, at any step.

A generation, a training's checkpoints and a reader's cache are written while every call that changes the folder is
followed. Before each of them the folder is laid out anew as a disk may have it after a loss of power: bytes are there
that were brought to it by fsync, names that were brought to it by fsync of their folder; of all others any may be
there, lost, cut or zeroed. POSIX promises no more (Pillai et al., OSDI 2014, found file systems that do no more). What
was said to be published or saved must be in each of these folders, and a next run must complete it, bitwise.
"""

from __future__ import annotations

import builtins
import errno
import hashlib
import io
import json
import os
import random
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

from datagen.pool.shard import stage_episode
from datagen.pool.writer import DatasetWriter
from hgn.command import run_command
from hgn.config import DatagenConfig, DatasetConfig
from hgn.data.manifest import Manifest
from hgn.data.shard_cache import CACHE_VARIABLE
from hgn.data.storage import open_storage
from hgn.scene.episode import Episode
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.schema import ConfigError, NonNegative, Positive, from_mapping, require_bounds
from hgn.system.files import TEMPORARY_SUFFIX, write_json
from hgn.training.checkpoint import LAST_NAMES, SECTION, read_checkpoint
from hgn.training.checkpoint_writer import CheckpointWriter
from tools.report import EXIT_RED, meta_of

SPLITS = (0.0, 1.0, 0.5)  # of what is not synced: nothing is there; all names are; each thing is or is not
SHARDS = 4
CALLS = ("replace", "rename", "link", "unlink", "remove", "mkdir", "rmdir", "truncate")


@dataclass(frozen=True)
class PowerLossConfig:
    """`python -m tools.studies.power_loss`: how many folders are laid out."""

    out: str
    every: Positive[int] = 1  # call
    rounds: Positive[int] = 9  # of drawing what is lost, for each call
    seed: NonNegative[int] = 0
    json: str | None = None

    def __post_init__(self) -> None:
        require_bounds(self)


class Disk:
    """Follows what of a folder is on the disk, and calls `before` before each call that changes it.

    With `piece` a call reads or writes so many bytes at most; what `before` raises, the call raises.
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
        """While it is entered Python's calls are followed, in all threads."""
        with self._stack as stack:
            for name in CALLS:
                stack.enter_context(mock.patch.object(os, name, self._followed(getattr(os, name))))
            stack.enter_context(mock.patch.object(os, "fsync", self._fsync))
            opened = self._opened(io.open)
            stack.enter_context(mock.patch.object(io, "open", opened))
            stack.enter_context(mock.patch.object(builtins, "open", opened))
            yield

    def step(self) -> None:
        """A call is about to be made."""
        with self._lock:
            self._before()

    def lay_out(self, target: Path, kept: float, draw: random.Random) -> None:
        """The folder as the disk may have it now; `kept` is the chance of what is not synced."""
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
        self.step()  # the study itself is not brought to the disk
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
    """Four shards, the last two of two episodes, the third of a second seed; the second is lost in between, so the
    index is written anew. What is staged goes to the disk at once where its shard lacks others."""

    def write(self, folder: Path, promised: dict[str, str]) -> None:
        """Adds to what is `promised`, by name, what must be there from now on."""
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
        """Raises: whatever is wrong."""
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
    """Four checkpoints of a run in a new folder; the last that was saved is there, or a later one."""

    def write(self, folder: Path, promised: dict[str, int]) -> None:
        """Adds how many updates are saved."""
        writer = CheckpointWriter()
        for updates in range(1, 5):
            content = {SECTION: {"updates": updates}, "state_dict": {"weight": torch.full((64,), float(updates))}}
            writer.save_checkpoint(content, folder / "runs" / "one" / "checkpoints" / LAST_NAMES[0])
            writer.wait()
            promised["updates"] = updates
        writer.teardown()

    def check(self, folder: Path, promised: dict[str, int]) -> None:
        """Raises: whatever is wrong."""
        paths = [folder / "runs" / "one" / "checkpoints" / name for name in LAST_NAMES]
        last = next((path for path in paths if path.exists()), None)
        found = 0 if last is None else read_checkpoint(last)[SECTION]["updates"]
        assert found >= promised.get("updates", 0), f"update {promised} was saved, {found} is there"


class Cache:
    """A shard that a reader keeps: it is there as it was published, or not at all."""

    content = random.Random(0).randbytes(10_000)

    def write(self, folder: Path, promised: dict[str, str]) -> None:
        """Promises nothing: what is lost is fetched again."""
        digest = hashlib.sha256(self.content).hexdigest()
        with tempfile.TemporaryDirectory() as served, mock.patch.dict(os.environ, {CACHE_VARIABLE: f"{folder}/cache"}):
            (Path(served) / "a.tar").write_bytes(self.content)
            path = open_storage(f"local://{served}").shard("a.tar", digest, len(self.content))
            assert path.read_bytes() == self.content

    def check(self, folder: Path, promised: dict[str, str]) -> None:
        """Raises: whatever is wrong."""
        self.write(folder, promised)


SCENARIOS = {"generation": Generation(), "checkpoints": Checkpoints(), "cache": Cache()}


def lose_power(scenario: Any, folder: Path, every: int, rounds: int, seed: int) -> tuple[int, int, list[str]]:
    """Calls that were made, folders that were laid out, and what was wrong with them."""
    calls, faults, promised = 0, list[str](), dict[str, Any]()
    laid_out: list[tuple[Path, dict[str, Any]]] = []

    def before() -> None:
        nonlocal calls
        calls += 1
        for number in range(0 if (calls + seed) % every else rounds):
            draw = random.Random(f"{seed}/{calls}/{number}")
            place = folder / f"{calls}-{number}"
            disk.lay_out(place, SPLITS[(calls // every + number) % len(SPLITS)], draw)
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
    """What a folder does not hold of what was promised, none or one."""
    try:
        scenario.check(place, promised)
    except (AssertionError, ConfigError, OSError, LookupError, ValueError) as error:
        return [f"{when}: {type(error).__name__}: {error}"]
    return []


def fail(scenario: Any, folder: Path, every: int, piece: int | None) -> tuple[int, list[str]]:
    """How many of the calls failed with EIO, one a run, and what was wrong afterwards; calls move `piece` bytes."""
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
        except Exception as error:  # noqa: BLE001 - a fault: it is told
            if not (isinstance(error, OSError) and error.errno == errno.EIO):
                faults.append(f"call {number}: {error!r}")
        if calls < number:
            return failed, faults
        failed += 1
        faults += broken(scenario, place, promised, f"after call {number}")
        shutil.rmtree(place)


def main(mapping: dict[str, Any]) -> int:
    """Prints what was tried and what was wrong; the exit code is 1 where anything was."""
    config, rows = from_mapping(PowerLossConfig, mapping), []
    for name, scenario in SCENARIOS.items():
        folder = Path(config.out) / name
        calls, tried, faults = lose_power(scenario, folder, config.every, config.rounds, config.seed)
        failed, wrong = fail(scenario, folder, config.every, piece=1000)
        counts = {"calls": calls, "power_losses": tried, "failed_calls": failed}
        rows.append({"what": name, **counts, "faults": faults + wrong})
        print(json.dumps(rows[-1]))
    if config.json is not None:
        write_json(config.json, {"meta": meta_of(config), "rows": rows})
    return EXIT_RED if any(row["faults"] for row in rows) else 0


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


if __name__ == "__main__":
    run_command(main, "power_loss")
