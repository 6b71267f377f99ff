"""Kills processes of a generation by SIGKILL at random moments, and compares the data set with an undisturbed one.

Linux only: the processes are found in /proc.
"""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from datagen.pool.locks import LOCK_NAME
from hgn.data.index import INDEX_NAME
from hgn.data.manifest import MANIFEST_NAME, SPLITS, Manifest
from hgn.data.reader import EpisodeStore
from hgn.data.verification import verify_file
from hgn.scene.episode import Episode

TARGETS = ("worker", "pool", "service", "all of them")
POLL_S = 0.02
PATIENCE_S = 600.0  # without a new shard


def generate_with_kills(command: Sequence[str], folder: Path, count: int, interval_s: float, log: Path) -> list[str]:
    """Runs a service's command until `folder` is complete and kills `count` processes meanwhile; returns their kinds.

    After each kill every published shard is verified, and none published before may be missing. Kills are `interval_s`
    apart on average. Raises: AssertionError if the generation was complete before the last kill; RuntimeError if the
    service ended by itself, or publishes nothing more.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    generator = np.random.default_rng(0)
    published: list[str] = []
    order = [TARGETS[i] for _ in range(count) for i in generator.permutation(len(TARGETS))][:count]
    with log.open("ab") as stream:
        service = _Service(command, folder, stream, log)
        try:
            for number, target in enumerate(order):
                service.wait(generator.exponential(interval_s))
                assert service.kill(target, generator), f"complete after {number} of {count} kills"
                published = verified_shards(folder, published)
                if service.process.poll() is not None:
                    service = _Service(command, folder, stream, log)
            service.wait_until_complete()
        finally:
            service.stop()
    return order


def verified_shards(folder: Path, before: Sequence[str]) -> list[str]:
    """Verifies every published shard and returns their sha256. Raises: RuntimeError if one of `before` is missing."""
    if not (folder / MANIFEST_NAME).exists():
        return list(before)
    manifest = Manifest.load(folder)
    for shard in manifest.shards:
        verify_file(folder / shard.name, shard.sha256, shard.bytes, "it was published")
    now = [shard.sha256 for shard in manifest.shards]
    if now[: len(before)] != list(before):
        raise RuntimeError(f"{folder} has lost shards: {len(before)} were published, now {len(now)}")
    return now


def differences(peaceful: Path, killed: Path) -> list[str]:
    """Returns what a data set lacks, or has too much of, compared with an undisturbed one."""
    faults = []
    one, other = Manifest.load(peaceful), Manifest.load(killed)
    verified_shards(killed, ())
    if not other.complete:
        faults.append("it is not complete")
    if other.quarantined:
        cause = other.quarantined[0].cause
        faults.append(f"{len(other.quarantined)} scenes are quarantined, the first because {cause}")
    if sorted(shard.name for shard in one.shards) != sorted(shard.name for shard in other.shards):
        faults.append("its shards have other names")
    for split in SPLITS:
        first, second = ({e.key: e for e in EpisodeStore(folder, split)} for folder in (peaceful, killed))
        if first.keys() != second.keys():
            faults.append(f"{split}: other episodes")
        both = first.keys() & second.keys()
        faults += [f"{key}: another scene" for key in both if not _same(first[key], second[key])]
    index = {Path(name).name for name, _ in other.shards.files()}
    expected = {MANIFEST_NAME, INDEX_NAME, LOCK_NAME, *index, *(shard.name for shard in other.shards)}
    left = sorted(path.name for path in killed.rglob("*") if path.name not in expected)
    return faults + [f"{name} was left behind" for name in left]


def equal_shards(one: Path, other: Path) -> int:
    """Returns the number of bitwise equal shards; the solver on several threads rounds differently each time."""
    first, second = ({(s.name, s.sha256) for s in Manifest.load(folder).shards} for folder in (one, other))
    return len(first & second)


def _same(one: Episode, other: Episode) -> bool:
    """Compares seed, specification and initial state of two episodes, bitwise."""
    arrays = [
        (e.position_TN3[0], e.initial_velocity_N3, e.material_N, e.obstacle_grid.cell_K3, e.obstacle_grid.normal_K3)
        for e in (one, other)
    ]
    return (
        (one.seed, one.specification, one.frame_count) == (other.seed, other.specification, other.frame_count)
        and (one.domain_size, one.gravity) == (other.domain_size, other.gravity)
        and all(a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in zip(*arrays, strict=True))
    )


class _Service:
    """A running service that fills a folder, and the processes below it."""

    def __init__(self, command: Sequence[str], folder: Path, stream: Any, log: Path) -> None:
        self._folder, self._log = folder, log
        self.process = subprocess.Popen(command, stdout=stream, stderr=stream, start_new_session=True)

    def wait(self, seconds: float) -> None:
        """Waits until the time is over or the data set is complete. Raises: RuntimeError if the service has ended."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline and not self._complete():
            time.sleep(POLL_S)

    def wait_until_complete(self) -> None:
        """Raises: RuntimeError if the service has ended, or publishes nothing more."""
        revision, deadline = -1, time.monotonic() + PATIENCE_S
        while not self._complete():
            now = Manifest.load(self._folder).revision if (self._folder / MANIFEST_NAME).exists() else -1
            if now != revision:
                revision, deadline = now, time.monotonic() + PATIENCE_S
            self._poll(deadline, "nothing was published")

    def kill(self, target: str, generator: np.random.Generator) -> bool:
        """Kills a process of this kind once there is one; returns False if the data set is complete before."""
        deadline = time.monotonic() + PATIENCE_S
        while not self._complete():
            victims = self._processes(target)
            if victims and self._kill(target, victims[generator.integers(len(victims))]):
                return True
            self._poll(deadline, f"the service has no {target}")
        return False

    def stop(self) -> None:
        """Terminates the service and waits for it."""
        if self.process.poll() is None:
            self.process.terminate()
        self.process.wait(PATIENCE_S)

    def _kill(self, target: str, process: int) -> bool:
        try:
            (os.killpg if target == "all of them" else os.kill)(process, signal.SIGKILL)
        except ProcessLookupError:
            return False
        if process == self.process.pid:
            self.process.wait()
        return True

    def _processes(self, target: str) -> list[int]:
        if target in ("service", "all of them"):
            return [self.process.pid]
        pools = _spawned(self.process.pid)
        return pools if target == "pool" else [worker for pool in pools for worker in _spawned(pool)]

    def _complete(self) -> bool:
        """Raises: RuntimeError if the data set is not complete and the service has ended."""
        if (self._folder / MANIFEST_NAME).exists() and Manifest.load(self._folder).complete:
            return True
        if self.process.poll() is not None:
            tail = "\n".join(self._log.read_text(errors="replace").splitlines()[-5:])
            raise RuntimeError(f"the service ended by itself, exit code {self.process.returncode}: {tail}")
        return False

    def _poll(self, deadline: float, lacking: str) -> None:
        if time.monotonic() > deadline:
            raise RuntimeError(f"{lacking} for {PATIENCE_S:.0f} s; see {self._log}")
        time.sleep(POLL_S)


def _spawned(process: int) -> list[int]:
    """Returns the processes that multiprocessing has started from one, without its own helpers."""
    children = []
    try:
        for path in Path(f"/proc/{process}/task").glob("*/children"):
            for child in path.read_text().split():
                if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                    children.append(int(child))
    except (FileNotFoundError, ProcessLookupError):  # ended meanwhile
        return []
    return children
