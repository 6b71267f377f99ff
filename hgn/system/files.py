"""Reads and writes files atomically: a file appears whole or not at all."""

import contextlib
import errno
import io
import json
import os
import re
import secrets
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

TEMPORARY_SUFFIX = ".partial"
_LOST_AT_MOST = 10  # number of retries
WRITTEN_BY_HGN = "written by HGN"  # the mark of files without other metadata
# matches all files that the commands write: reports begin with their provenance, binary files have metadata named hgn
_WRITTEN_BY_HGN = re.compile(
    rb'written by HGN|hgn rollout|"hgn"|\x03hgn\x12|\A\{\s*"meta": \{|^provenance:\n', re.MULTILINE
)
LONGEST_MARK, BLOCK_BYTES = 32, 1 << 24


def temporary_target(path: Path) -> str:
    """Returns the final name of a file of `temporary_file`."""
    return path.name.removeprefix(".").removesuffix(TEMPORARY_SUFFIX).rpartition(".")[0]


@contextlib.contextmanager
def temporary_file(path: Path) -> Iterator[Path]:
    """Yields a temporary name in the folder of `path`. Removes this file at the end unless the caller renamed it.

    A crash leaves only a file that ends in `.partial`. An OSError that names no file (a full disk) names `path`.
    """
    # a random part, because containers on several machines may have equal process numbers
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}{TEMPORARY_SUFFIX}")
    try:
        with errors_name(path):
            yield temporary
    finally:
        temporary.unlink(missing_ok=True)


def write_atomically(path: Path, data: bytes, before: Callable[[], object] = lambda: None) -> None:
    """Writes `data` to a temporary name in the same folder, syncs it, calls `before`, and renames it to `path`.

    Raises OSError (a full disk, no permission). It then leaves no new file, and an existing `path` is unchanged.
    """
    with temporary_file(path) as temporary:
        with temporary.open("wb") as file:
            file.write(data)
            sync_file(file)
        before()
        temporary.replace(path)
    sync_folder(path.parent)


def read_replaced(path: Path) -> bytes:
    """Reads a file that other machines replace. Retries if NFS has lost the opened file.

    Raises OSError.
    """
    for attempt in range(_LOST_AT_MOST + 1):
        try:
            with errors_name(path), open_at_once(path) as file:
                return file.read()
        except OSError as error:
            if error.errno != errno.ESTALE or attempt == _LOST_AT_MOST:
                raise
    raise AssertionError


class LibraryFile(io.RawIOBase):
    """A file for a library. It stores the last error of reading, and its own size and position."""

    def __init__(self, path: Path, mode: str = "rb") -> None:
        self._file = io.FileIO(path, mode)
        self.place, self.size = 0, os.fstat(self._file.fileno()).st_size
        self.fault: tuple[Any, ...] | None = None

    def close(self) -> None:
        self._file.close()
        super().close()

    def fileno(self) -> int:
        return self._file.fileno()

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        place = (0, self.place, self.size)[whence] + offset
        if place < 0:  # zipfile looks for records there
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        self.place = place
        return place

    def readinto(self, buffer: Any) -> int:
        try:
            count = os.preadv(self.fileno(), [buffer], self.place)
        except OSError as error:
            self.fault = error.args  # the error's traceback would keep objects of HDF5, which crash at the end
            raise
        self.place += count
        return count


@contextlib.contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """Yields a file for a library to read. Raises: OSError of the disk, which names `path`.

    Libraries take such an error for damage of the file, or for its end.
    """
    with errors_name(path), LibraryFile(path) as file:
        try:
            yield io.BufferedReader(file)
        finally:
            if file.fault is not None:
                raise OSError(*file.fault)


def open_at_once(path: Path) -> io.BufferedReader:
    """Opens a file for reading. A pipe or a device counts as empty, because reading it might not end."""
    file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))  # noqa: SIM115 - returned
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        file = Path(os.devnull).open("rb")  # noqa: SIM115
    return file


def write_json(path: Path | str, value: Any, allow_nan: bool = True) -> None:
    """Writes `value` as indented JSON, atomically, and makes a missing folder.

    Raises OSError as write_atomically does, and ValueError for a number outside JSON, unless `allow_nan`.
    """
    path = Path(path)
    make_folder(path.parent)
    write_atomically(path, json.dumps(value, indent=1, allow_nan=allow_nan).encode() + b"\n")


def require_place(path: Path) -> None:
    """Checks, before long work, that `path` can be written; creates nothing.

    Raises OSError if `path` is a folder, leads through a file, or lies in a folder without permission.
    """
    folder = next(folder for folder in path.absolute().parents if folder.exists())
    for wrong, number, place in (
        (path.is_dir(), errno.EISDIR, path),
        (not folder.is_dir(), errno.ENOTDIR, folder),
        (not os.access(folder, os.W_OK | os.X_OK), errno.EACCES, folder),
    ):
        if wrong:
            raise OSError(number, os.strerror(number), str(place))


def is_replaceable(path: Path) -> bool:
    """Returns whether writing `path` loses no file of another program, and no device, which a rename would replace."""
    if not path.is_file() or not path.stat().st_size:
        return path.is_file() or path.is_dir() or not path.exists()
    content = b""
    with path.open("rb") as file:
        while block := file.read(BLOCK_BYTES):  # not mapped: a file that was cut would end the process
            content = content[-LONGEST_MARK:] + block
            # from 1 on, because marks of the file's start do not count at the start of a later block
            if _WRITTEN_BY_HGN.search(content, int(len(content) > len(block))):
                return True
    return False


@contextlib.contextmanager
def space_reserved(path: Path, size: int) -> Iterator[Callable[[int], None]]:
    """Reserves `size` bytes in the folder of `path` during long work, so that the disk is not full at its end.

    Yields a function that releases some of these bytes; the caller then writes as many elsewhere. If the work fails, no
    new folder remains. Raises OSError before the work if the disk has less space.
    """
    missing = [folder for folder in path.parents if not folder.exists()]
    make_folder(path.parent)
    try:
        with temporary_file(path) as reservation, reservation.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, size)

            def release(count: int) -> None:
                os.ftruncate(file.fileno(), max(0, os.fstat(file.fileno()).st_size - count))

            yield release
    except BaseException:
        for folder in missing:
            with contextlib.suppress(OSError):  # another process may have written into the folder
                folder.rmdir()
        raise


def make_folder(path: Path) -> None:
    """Makes a folder and its missing parents, and syncs them, so that a power loss does not remove them."""
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(parents=True, exist_ok=True)
    for folder in missing:
        with contextlib.suppress(PermissionError):  # no permission to open the folder above
            sync_folder(folder.parent)


def sync_file(file: BinaryIO) -> None:
    """Flushes and syncs a file to the disk."""
    file.flush()
    os.fsync(file.fileno())


def sync_written(path: Path) -> None:
    """Syncs a file that a library has written."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Syncs a folder, so that renames in it survive a power loss."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with errors_name(folder):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def errors_name(path: Path) -> Iterator[None]:
    """Adds `path` to an OSError that names no file (a full disk), or a temporary one."""
    try:
        yield
    except OSError as error:
        if error.filename is None or str(error.filename).endswith(TEMPORARY_SUFFIX):
            error.filename = str(path)
        raise
