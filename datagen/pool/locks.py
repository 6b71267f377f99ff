"""Locks episodes, so that several generators share one folder without a coordinator.

Locks are on bytes of the data set's file `.lock`. A process that changes the manifest locks byte 0. All generators
share a lock on byte 1, and one on the folder, which shows that `.lock` was deleted. Each episode has a byte of its own,
locked by the generator that makes the episode. The kernel releases the locks of a process at its end, also after a
crash. So no claim becomes stale, and no clock is needed.
"""

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from datagen.pool.plan import ShardRange
from hgn.data.manifest import SPLITS
from hgn.schema import ConfigError
from hgn.system.locks import NO_LOCKS, lock_bytes, lock_if_supported, open_lock

LOCK_NAME = ".lock"
_MANIFEST_BYTE, _GENERATORS_BYTE, _FIRST_EPISODE_BYTE = 0, 1, 2
_REMEDY = "mount it with locks (NFS with its lock service, Lustre with -o flock) or choose another out=..."
_EPISODES_OF_A_SPLIT = 1 << 40  # bytes between the first episodes of two splits; a locked byte need not exist


class ShardLocks:
    """Manages one generator's locks on a folder."""

    def __init__(self, folder: Path) -> None:
        """Raises: ConfigError if the file system has no locks, or grants a lock twice, or if `.lock` was deleted."""
        self._path = folder / LOCK_NAME
        with contextlib.ExitStack() as stack:
            opened = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, opened)
            # a training may have locked the folder exclusively
            shared = not lock_if_supported(opened) and lock_if_supported(opened, fcntl.LOCK_SH)
            if shared and not self._path.exists():
                raise ConfigError(
                    f"{self._path} must exist while generators run in its folder, got none: it was deleted; "
                    "wait for their end, or end them, and run the same command again"
                )
            self._file = open_lock(self._path)
            stack.callback(os.close, self._file)
            lock_if_supported(opened, fcntl.LOCK_SH)
            self._lock(fcntl.F_RDLCK, _GENERATORS_BYTE, wait=True)
            self._require_exclusion()
            self.close = stack.pop_all().close  # frees every lock

    def _require_exclusion(self) -> None:
        """Raises ConfigError if a lock does not exclude others. Generators would overwrite each other's files."""
        other = open_lock(self._path)
        try:
            if self._lock(fcntl.F_WRLCK, _GENERATORS_BYTE, file=other):
                raise ConfigError(
                    f"{self._path} must be on a file system with exclusive locks, got one that grants a lock twice; "
                    f"{_REMEDY}"
                )
        finally:
            os.close(other)

    @contextlib.contextmanager
    def manifest(self) -> Iterator[None]:
        """Locks the manifest for a change. Waits until no other generator has the lock."""
        self._lock(fcntl.F_WRLCK, _MANIFEST_BYTE, wait=True)
        try:
            yield
        finally:
            self._lock(fcntl.F_UNLCK, _MANIFEST_BYTE)

    def take(self, shard: ShardRange) -> bool:
        """Claims the episodes of a range. Returns False if another generator has any of them."""
        return self._lock(fcntl.F_WRLCK, *_bytes_of(shard))

    def free(self, shard: ShardRange) -> None:
        """Frees a claim."""
        self._lock(fcntl.F_UNLCK, *_bytes_of(shard))

    @contextlib.contextmanager
    def alone(self) -> Iterator[bool]:
        """Yields whether this is the only generator. If it is, generators that start wait until the block ends."""
        alone = self._lock(fcntl.F_WRLCK, _GENERATORS_BYTE)
        try:
            yield alone
        finally:
            if alone:
                self._lock(fcntl.F_RDLCK, _GENERATORS_BYTE)

    def _lock(self, kind: int, start: int, length: int = 1, wait: bool = False, file: int | None = None) -> bool:
        try:
            return lock_bytes(self._file if file is None else file, kind, start, length, wait)
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
            raise ConfigError(
                f"{self._path} must be on a file system with file locks, got {error.strerror}; {_REMEDY}"
            ) from None


def _bytes_of(shard: ShardRange) -> tuple[int, int]:
    start = _FIRST_EPISODE_BYTE + SPLITS.index(shard.split) * _EPISODES_OF_A_SPLIT
    return start + shard.first, shard.stop - shard.first
