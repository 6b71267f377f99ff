"""SIGKILL of any process of a generation, at any moment, costs only time."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from processes import BALLISTIC_PATH, processes_of_session, wait_until
from written_files import differences

from hgn.data.manifest import MANIFEST_NAME, Manifest
from hgn.data.verification import verify_file

TARGETS = ["worker", "pool", "service", "all of them"]


def spawned(process):
    """The processes that multiprocessing has started from one, without its own helpers."""
    children = []
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # ended meanwhile
        for path in Path(f"/proc/{process}/task").glob("*/children"):
            numbers = path.read_text().split()
            children += [int(n) for n in numbers if b"spawn_main" in Path(f"/proc/{n}/cmdline").read_bytes()]
    return children


def kill(service, target, draw):
    """Kills a process of this kind; False where there is none."""
    pools = spawned(service.pid)
    workers = [worker for pool in pools for worker in spawned(pool)]
    victims = {"worker": workers, "pool": pools}.get(target, [service.pid])
    if not victims:
        return False
    with contextlib.suppress(ProcessLookupError):
        (os.killpg if target == "all of them" else os.kill)(draw.choice(victims), signal.SIGKILL)
        return True
    return False


def published(folder):
    """The sha256 of each published shard; its file has it."""
    if not (folder / MANIFEST_NAME).exists():
        return []
    shards = list(Manifest.load(folder).shards)
    for shard in shards:
        verify_file(folder / shard.name, shard.sha256, shard.bytes, "it was published")
    return [shard.sha256 for shard in shards]


@pytest.mark.skipif(sys.platform != "linux", reason="finds the processes in /proc")
def test_nothing_is_lost(make_config, make_dataset, control, tmp_path, monkeypatch):
    """A generation whose worker, pool, service and all processes are killed keeps every published shard after each
    kill, writes the data set of an undisturbed one, bitwise, and leaves no process and no temporary file."""
    monkeypatch.setenv("PYTHONPATH", BALLISTIC_PATH)
    config = make_config(training_scenes=6)
    peaceful, killed, draw = make_dataset(config), tmp_path / "killed", random.Random(0)
    (control / "slow").touch()
    keys = ("training_scenes", "validation_scenes", "test_scenes", "frames", "workers")
    settings = [f"dataset.{key}={getattr(config.dataset, key)}" for key in keys]
    command = [sys.executable, "-m", "ballistic_service", *settings, f"out={killed}", "port=0", "progress=off"]
    before, services = [], []

    def complete():
        assert services[-1].poll() is None, "the service ended by itself"
        return (killed / MANIFEST_NAME).exists() and Manifest.load(killed).complete

    try:
        services.append(subprocess.Popen(command, start_new_session=True))
        for target in draw.sample(TARGETS, 4):
            time.sleep(draw.expovariate(2))
            wait_until(lambda target=target: complete() or kill(services[-1], target, draw))
            if target in ("service", "all of them"):
                services[-1].wait()
                services.append(subprocess.Popen(command, start_new_session=True))
            assert not complete() and published(killed)[: len(before)] == before, f"{target}: lost, or too late"
            before = published(killed)
        wait_until(complete)
    finally:
        services[-1].terminate()
        services[-1].wait()
    wait_until(lambda: not any(processes_of_session(service.pid) for service in services))
    assert differences(peaceful, killed) == []
    (killed / ".train-000000-000001.tar.1.partial").touch()
    (killed / "train-000000-000001.tar").write_bytes(b"")
    assert len(differences(peaceful, killed)) == 2
