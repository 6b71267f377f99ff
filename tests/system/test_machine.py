"""hgn.system.machine: the cores and the memory that a process may use, as Linux tells them, and folders."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import torch

from hgn.system import device, machine
from hgn.system.machine import available_cpus, available_memory, writable_folder

GIB = 2**30


@pytest.fixture
def root(tmp_path, monkeypatch):
    """A file system of its own, of a machine of 16 cores and 64 GiB."""
    monkeypatch.setattr(machine, "ROOT", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(16)), raising=False)
    values = {"SC_PHYS_PAGES": 16 * 2**20, "SC_PAGE_SIZE": 4096}
    monkeypatch.setattr(os, "sysconf", values.__getitem__)
    return tmp_path


CGROUP, CPU, MEMORY = "proc/self/cgroup", "sys/fs/cgroup/cpu.max", "sys/fs/cgroup/memory.max"
OLD_CPU, OLD_MEMORY = "sys/fs/cgroup/cpu,cpuacct", "sys/fs/cgroup/memory"
OLD = {CGROUP: "9:name=systemd:/x\n4:memory:/pod/one\n2:cpu,cpuacct:/pod/one\n1:cpuset:/\n0::/"}
OLD |= {f"{OLD_CPU}/cpu.cfs_quota_us": "-1", f"{OLD_CPU}/cpu.cfs_period_us": "100000"}
OLD |= {f"{OLD_MEMORY}/memory.limit_in_bytes": "9223372036854771712"}
POD = {f"{OLD_CPU}/pod/one/cpu.cfs_quota_us": "250000", f"{OLD_CPU}/pod/one/cpu.cfs_period_us": "50000"}
POD |= {f"{OLD_MEMORY}/pod/one/memory.limit_in_bytes": str(4 * GIB)}
A, C, OWN = "sys/fs/cgroup/a", "sys/fs/cgroup/a/b/c", {CGROUP: "0::/"}
NESTED = {CGROUP: "0::/a/b/c", f"{A}/cpu.max": "400000 100000", f"{A}/memory.max": str(32 * GIB)}
NESTED |= {f"{A}/b/cpu.max": "300000 100000", f"{A}/b/memory.max": "max"}
NESTED |= {f"{C}/cpu.max": "max 100000", f"{C}/memory.max": str(48 * GIB)}
UNSEEN = {CPU: "400000 100000", "sys/machine.slice/cpu.max": "100000 100000"}
LIMITS = [  # files, cores, GiB
    ({}, 16, 64),  # another system, a machine without control groups, and groups without limits
    (OWN | {"sys/fs/cgroup/cgroup.procs": "1"}, 16, 64),
    (OWN | {CPU: "max 100000", MEMORY: "max"}, 16, 64),
    (OWN | {CPU: "max 100000", f"{MEMORY}/a": ""}, 16, 64),  # cannot be read
    # version 2: its own group is the outermost that a container sees; parts of a core count as one
    *((OWN | {CPU: f"{q} 100000", MEMORY: str(8 * GIB)}, n, 8) for q, n in ((150000, 2), (200000, 2), (10000, 1))),
    (OWN | {CPU: "9900000 100000"}, 16, 64),
    (NESTED, 3, 32),  # a limit of any group holds for what is within
    # version 1: a tree for each controller, or for several; -1 and a number that no memory has are no limits
    (OLD, 16, 64),
    (OLD | POD, 5, 4),
    # a container is told of groups outside of it, and sees its own as the outermost
    *(({CGROUP: f"0::{own}"} | UNSEEN, 4, 64) for own in ("/docker/0a1b", "/../../machine.slice")),
]


@pytest.mark.parametrize(("files", "cpus", "gib"), LIMITS, ids=range(len(LIMITS)))
def test_limits(root, files, cpus, gib):
    """The least of the machine's cores and memory and of the limits of all groups around a process."""
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(f"{text}\n")
    assert (available_cpus(), available_memory()) == (cpus, gib * GIB)


def test_this_machine():
    """The number of cores is at least one, and at most the number of this machine."""
    assert 1 <= available_cpus() <= (os.cpu_count() or 1)
    assert 0 < available_memory() <= os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def test_threads_keep_to_a_quota(monkeypatch):
    """PyTorch's are as many as there are cores to keep busy, never more than they were, unless somebody chose."""
    before = torch.get_num_threads()
    try:
        for cpus, chosen, threads in ((3, None, 3), (9, None, 6), (3, "6", 6)):
            torch.set_num_threads(6)
            monkeypatch.setattr(device, "available_cpus", lambda cpus=cpus: cpus)
            monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
            if chosen is not None:
                monkeypatch.setenv("OMP_NUM_THREADS", chosen)
            assert device.choose_device("cpu") == torch.device("cpu")
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)


def test_folders_that_can_be_written_to(tmp_path, monkeypatch):
    """The result is the usual folder, whether it exists or not, and nothing is created. If it is not writable, the
    result is a private folder of this user, the same one each time, and never a link in its place."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    (tmp_path / "file").touch()
    for usual in (tmp_path, tmp_path / "a" / "b"):
        assert writable_folder(usual, "x") == usual
    assert not (tmp_path / "a").exists()
    own = tmp_path / "temporary" / f"x-{os.getuid()}"
    for usual in (tmp_path / "file", tmp_path / "file" / "a", Path("~") / "a"):
        assert writable_folder(usual, "x") == own and own.stat().st_mode & 0o777 == 0o700
    own.rmdir()
    own.symlink_to(tmp_path)
    other = writable_folder(tmp_path / "file", "x")
    assert other.parent == own.parent and other != own and other.stat().st_mode & 0o777 == 0o700


PROGRAM = """
import importlib, os, sys
names = ("TRITON_HOME", "TRITON_CACHE_DIR")
for named in (None, *names):
    for name in (*names, "TRITON_DEFAULT_FP_FUSION"):
        os.environ.pop(name, None)
    if named:
        os.environ[named] = "/mine"
    sys.modules.pop("hgn.kernels", None)
    importlib.import_module("hgn.kernels")
    print(os.environ.get("TRITON_CACHE_DIR"), os.environ["TRITON_DEFAULT_FP_FUSION"])
"""


def test_where_triton_keeps_what_it_compiles(tmp_path):
    """A home that cannot be written to is replaced by a temporary folder, unless one is named; the rounding of sums
    and products is fixed, which Triton's next version would change."""
    (tmp_path / "file").touch()
    environment = os.environ | {"HOME": str(tmp_path / "file"), "TMPDIR": str(tmp_path)}
    environment |= {"PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, "-c", PROGRAM]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    folders = (tmp_path / f"triton-{os.getuid()}", None, "/mine")
    assert ended.stdout.splitlines() == [f"{folder} 1" for folder in folders]
