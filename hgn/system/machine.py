"""Finds the cores, the memory and the folders that this process may use, within a container's limits.

Control groups (Linux, cgroups(7)) limit containers. A process in a container sees all cores and all memory of the
machine. The system slows it above its CPU quota, and kills it above its memory limit.
"""

import math
import os
import re
import resource
import tempfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path("/")  # root of the file system
_FULL_MEMORY = re.compile(  # messages of torch, Taichi, CUDA, C++, the loader and Python's threads
    "out of memory|(can't|cannot) allocate memory|memory allocation .*failed|bad_alloc"
    "|failed to map segment|can't start new thread",
    re.IGNORECASE,
)


def available_cpus() -> int:
    """Returns the number of usable cores: the CPU affinity, but at most the groups' quota, rounded up."""
    cores = len(os.sched_getaffinity(0))
    quotas = [quota for group in _groups("cpu") if (quota := _quota(group)) is not None]
    return max(1, min([cores, *(math.ceil(quota) for quota in quotas)]))


def available_memory() -> int:
    """Returns the bytes of usable memory: the machine's memory, or the groups' smallest limit."""
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    limits = [_read(group / name) for group in _groups("memory") for name in ("memory.max", "memory.limit_in_bytes")]
    return min([machine, *(int(limit) for limit in limits if limit not in (None, "max"))])


def memory_is_full(error: Exception) -> bool:
    """Returns whether an error reports full memory. Libraries report it by errors of other types than MemoryError."""
    by_message = isinstance(error, (RuntimeError, ImportError)) and _FULL_MEMORY.search(str(error))
    return isinstance(error, MemoryError) or bool(by_message)


def writable_folder(usual: Path, name: str) -> Path:
    """Returns a cache's usual folder, or a temporary folder NAME-UID of this user if the usual one is not writable."""
    existing = next((folder for folder in (usual, *usual.parents) if os.path.lexists(folder)), usual)
    if usual.is_absolute() and existing.is_dir() and os.access(existing, os.W_OK | os.X_OK):
        return usual
    own = Path(tempfile.gettempdir()) / f"{name}-{os.getuid()}"
    own.mkdir(mode=0o700, exist_ok=True)
    trusted = not own.is_symlink() and own.stat().st_uid == os.getuid()
    return own if trusted else Path(tempfile.mkdtemp(prefix=f"{name}-"))


def _groups(controller: str) -> Iterator[Path]:
    """Yields the folders of this process's control groups, from the outermost visible one inwards."""
    folder = ROOT / "sys" / "fs" / "cgroup"
    for line in (_read(ROOT / "proc" / "self" / "cgroup") or "").splitlines():
        _, controllers, own = line.split(":", 2)
        if not controllers:  # version 2 has one tree for all controllers
            mount = folder
        elif controller in controllers.split(","):
            mount = folder / controllers if (folder / controllers).is_dir() else folder / controller
        else:
            continue
        yield mount
        group = mount
        for part in Path(own.lstrip("/")).parts:
            group = group / part
            if part == ".." or not group.is_dir():  # a container may see only its own group as the outermost
                break
            yield group


def _quota(group: Path) -> float | None:
    """Returns the CPU quota of a group in cores, or None without a limit."""
    limit = _read(group / "cpu.max")
    if limit is None:
        limit = f"{_read(group / 'cpu.cfs_quota_us') or 'max'} {_read(group / 'cpu.cfs_period_us') or 0}"
    quota, _, period = limit.partition(" ")
    return None if quota == "max" or int(quota) <= 0 else int(quota) / int(period)


def _read(file: Path) -> str | None:
    """Returns the text of a file, or None if it does not exist or cannot be read. None means no known limit."""
    try:
        return file.read_text(encoding="ascii").strip()
    except OSError:
        return None


def allow_open_files(wanted: int) -> int:
    """Raises this process's limit of open files up to `wanted`. Returns the limit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = max(soft, min(wanted, hard)) if hard != resource.RLIM_INFINITY else max(soft, wanted)
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
    return limit
