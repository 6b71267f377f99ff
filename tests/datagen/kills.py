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
from processes import processes_of_session, wait_until

from datagen.pool.locks import LOCK_NAME
from hgn.data.index import INDEX_NAME
from hgn.data.manifest import MANIFEST_NAME, Manifest
from hgn.data.verification import verify_file

TARGETS = ("worker", "pool", "service", "all of them")
POLL_S = 0.02
PATIENCE_S = 600.0  # without a new shard


def generate_with_kills(command: Sequence[str], folder: Path, count: int, interval_s: float, log: Path) -> list[str]:
    """Runs a service's command until `folder` is complete and kills `count` processes meanwhile; returns their kinds.

    After each kill every published shard is verified, and none published before may be missing; of a service that was
    killed no process stays behind. Kills are `interval_s`
    apart on average. Raises: AssertionError if the generation was complete before the last kill; RuntimeError if the
    service ended by itself, or publishes nothing more.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    generator = np.random.default_rng(0)
    published, sessions = list[str](), list[int]()
    order = [TARGETS[i] for _ in range(count) for i in generator.permutation(len(TARGETS))][:count]
    with log.open("ab") as stream:
        service = _Service(command, folder, stream, log)
        try:
            for number, target in enumerate(order):
                service.wait(generator.exponential(interval_s))
                assert service.kill(target, generator), f"complete after {number} of {count} kills"
                published = verified_shards(folder, published)
                if service.process.poll() is not None:
                    sessions.append(service.process.pid)
                    service = _Service(command, folder, stream, log)
            service.wait_until_complete()
        finally:
            service.stop()
    wait_until(lambda: not any(processes_of_session(session) for session in sessions))
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
    """Returns the names of files that one data set has and the other has not, or not the same; indexes may differ."""
    pairs = [{p.name: p.read_bytes() for p in folder.rglob("*") if p.is_file()} for folder in (peaceful, killed)]
    own = {MANIFEST_NAME, INDEX_NAME, LOCK_NAME}
    own |= {Path(name).name for folder in (peaceful, killed) for name, _ in Manifest.load(folder).shards.files()}
    found = Manifest.load(killed)
    assert found.complete and not found.quarantined
    names = pairs[0].keys() | pairs[1].keys()
    return sorted(name for name in names - own if pairs[0].get(name) != pairs[1].get(name))


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
