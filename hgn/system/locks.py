"""Locks files, or bytes of files. The kernel releases the locks of a process at its end, even after a crash."""

import contextlib
import errno
import fcntl
import os
import stat
import struct
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import IO, Any

from hgn.schema import ConfigError
from hgn.system.files import make_folder

NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)  # errors of file systems without locks


def open_lock(path: Path | str, flags: int = 0) -> int:
    """Opens a file that processes lock, for reading and writing, and creates a missing one.

    Raises ConfigError for a link, which could lead to a file of another program, and for a pipe, device or folder.
    """
    try:
        opened = os.open(path, flags | os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)
        if not stat.S_ISREG(os.fstat(opened).st_mode):
            os.close(opened)
            raise OSError(errno.ENXIO, os.strerror(errno.ENXIO), str(path))
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.ENXIO, errno.EISDIR):
            raise
        raise ConfigError(f"{path} must be a file, got a link, pipe, device or folder; delete it") from None
    return opened


def lock_file(file: IO[Any] | int, kind: int = fcntl.LOCK_EX) -> bool:
    """Locks a file. Returns False if another process has the lock. Raises OSError with one of NO_LOCKS."""
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def lock_if_supported(opened: int, kind: int = fcntl.LOCK_EX) -> bool:
    """Locks a file or folder as `lock_file`. On file systems without locks of these every process succeeds."""
    try:
        return lock_file(opened, kind)
    except OSError as error:
        if error.errno not in (*NO_LOCKS, errno.EBADF):  # EBADF is the error of folders on NFS
            raise
    return True


def lock_bytes(file: int, kind: int, start: int, length: int = 1, wait: bool = False) -> bool:
    """Locks bytes of an open file, which need not exist. Returns False if others have the lock and `wait` is False.

    kind is fcntl.F_RDLCK (shared), F_WRLCK (exclusive) or F_UNLCK. Raises OSError with one of NO_LOCKS.
    """
    try:
        # The lock belongs to the open file, so that two generators in one process exclude each other too.
        request = struct.pack("hhqqi4x", kind, os.SEEK_SET, start, length, 0)
        fcntl.fcntl(file, fcntl.F_OFD_SETLKW if wait else fcntl.F_OFD_SETLK, request)
    except OSError as error:
        if error.errno in (errno.EAGAIN, errno.EACCES) and not wait:
            return False
        raise
    return True


_again: dict[Path, Callable[[], None]] = {}  # for each folder that `locked` locks, what makes and locks it again


def make_again(folder: Path) -> None:
    """Creates a folder if it was deleted, and locks it again if this process had locked it.

    Raises ConfigError as `locked` if another process has locked a folder of this name since.
    """
    _again.get(folder, partial(make_folder, folder))()


@contextlib.contextmanager
def locked(path: Path, field: str, refusal: str) -> Iterator[None]:
    """Locks a file for this process, and its folder too, because another user may delete the file.

    Raises ConfigError `<field> must be ...`, with `refusal`, if another process has the lock. On a file system
    without locks every process succeeds.
    """
    stack, own, one_at_a_time = contextlib.ExitStack(), list[os.stat_result](), threading.Lock()

    def again() -> None:
        with one_at_a_time:
            lock()

    def lock() -> None:
        make_folder(path.parent)
        if own and os.path.samestat(own[0], path.parent.stat()):
            return
        own.clear()
        stack.close()  # the locks of a folder that was deleted or renamed
        for opening in (partial(open_lock, path), partial(os.open, path.parent, os.O_RDONLY)):
            opened = opening()
            stack.callback(os.close, opened)
            if not lock_if_supported(opened):
                raise ConfigError(
                    f"{field} must be a folder of its own, got {path.parent}: {refusal} another {field}=..."
                )
        own.append(os.fstat(opened))

    with stack:
        lock()
        _again[path.parent] = again
        try:
            yield
        finally:
            del _again[path.parent]
