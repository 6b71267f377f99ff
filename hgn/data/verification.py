"""Verifies files by size and sha256, once in a process."""

import hashlib
from pathlib import Path

from hgn.schema import ConfigError
from hgn.system.files import errors_name, open_at_once


class StorageError(ConfigError):
    """A file of a data set is missing, refused, incomplete, altered or not JSON, perhaps temporarily."""


_verified: set[tuple[str | int, ...]] = set()  # identities of the files that this process has verified


def file_sha256(path: Path) -> str:
    """Returns the sha256 of a file in hexadecimal."""
    with errors_name(path), open_at_once(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def verify_file(path: Path, sha256: str, size: int, remedy: str) -> None:
    """Checks size and sha256 of a file. In a process it does so once, unless the file changes.

    Raises: StorageError naming file, expected and actual value, and remedy; FileNotFoundError.
    """
    status = path.stat()
    if status.st_size != size:
        raise StorageError(f"{path} must have {size} bytes, got {status.st_size}; {remedy}")
    identity = _identity(path, sha256)
    if identity in _verified:
        return
    actual = file_sha256(path)
    if actual != sha256:
        raise StorageError(f"{path} must have sha256 {sha256}, got {actual}: it was altered; {remedy}")
    _verified.add(identity)


def note_verified(path: Path, sha256: str) -> None:
    """Records a file as verified, whose bytes the caller hashed while it wrote them."""
    _verified.add(_identity(path, sha256))


def _identity(path: Path, sha256: str) -> tuple[str | int, ...]:
    """Returns an identity that changes with the file. A modification time can be set back; a change time cannot."""
    status = path.stat()
    times = status.st_mtime_ns, status.st_ctime_ns
    return str(path.resolve()), status.st_dev, status.st_ino, status.st_size, *times, sha256
