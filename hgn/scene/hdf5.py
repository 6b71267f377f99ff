"""Reads untrusted HDF5 files: links to other files are refused, and damage results in one message.

Writes files on disks that fail: HDF5 loses refused data without an error or ends the process.
"""

from __future__ import annotations

import contextlib
import math
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hgn.schema import ConfigError
from hgn.system.claims import Claims
from hgn.system.files import LibraryFile, opened

if TYPE_CHECKING:
    import h5py

_DEPTH = 8  # largest depth of groups
EXPANDED = 1 << 18  # bytes of a dataset's compressed chunks that gzip expands to at most 270 MB
_CHUNK_BYTES = 512  # of HDF5's memory for a chunk of a few numbers
# exceptions of h5py for damage, and of NumPy for a size in a damaged file
_DAMAGE = (LookupError, OSError, ValueError, RuntimeError, TypeError, AttributeError, ArithmeticError, MemoryError)


@contextlib.contextmanager
def damage_named(rule: str, remedy: str) -> Iterator[None]:
    """Converts exceptions of reading a damaged file to a ConfigError `<rule>, got <cause>; <remedy>`.

    `rule` names the file, as in `a.h5: position must be whole`.
    """
    try:
        yield
    except ConfigError:
        raise
    except _DAMAGE as error:
        raise ConfigError(f"{rule}, got {' '.join(str(error).split())}; {remedy}") from error


class FileOnDisk(LibraryFile):
    """A new file for h5py that keeps what the disk refuses, until `settle` has written it."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "xb+")
        self._waiting: list[tuple[int, bytes | None]] = []  # places with their content, or the end without one

    def write(self, data: Any) -> int:
        content = bytes(data)
        self._attempt(self.place, content)
        self.place += len(content)
        self.size = max(self.size, self.place)
        return len(content)

    def truncate(self, size: int | None = None) -> int:
        self.size = self.place if size is None else size
        self._attempt(self.size, None)
        return self.size

    def readinto(self, buffer: Any) -> int:
        self.settle()
        return super().readinto(buffer)

    def _attempt(self, place: int, content: bytes | None) -> None:
        self._waiting.append((place, content))
        with contextlib.suppress(OSError):  # raised by the caller's `settle`
            self.settle()

    def settle(self) -> None:
        """Writes what waits. Raises: OSError of the disk; a later call tries again."""
        while self._waiting:
            place, content = self._waiting[0]
            if content is None:
                os.ftruncate(self.fileno(), place)
            elif (count := os.pwrite(self.fileno(), content, place)) < len(content):
                self._waiting[0] = place + count, content[count:]
                continue
            del self._waiting[0]


@contextlib.contextmanager
def open_hdf5(path: Path, rule: str, remedy: str) -> Iterator[h5py.File]:
    """Opens a file that contains all its data, each object once, and is large enough for them.

    Raises: ConfigError, as `damage_named` does, also for the caller's reading; OSError of the disk.
    """
    import h5py

    if not path.is_file():  # opening a pipe would wait for ever
        raise ConfigError(f"{rule}, got no plain file; {remedy}")
    claims = Claims(path)
    with opened(path) as content, damage_named(rule, remedy), h5py.File(content, "r") as file:
        stored = _require_own_data(file, path, claims, {h5py.h5o.get_info(file.id).addr})
        if stored > content.seek(0, os.SEEK_END):
            raise ConfigError(f"{path} must store the bytes of each dataset once, got {stored} of them; rewrite it")
        yield file


def _require_own_data(group: h5py.Group, path: Path, claims: Claims, visited: set[int], depth: int = 0) -> int:
    """Raises ConfigError for an object that is in another file, has two names, or is larger than the file.

    HDF5 would read another file with the rights of this reader. Returns the number of stored bytes of the datasets."""
    import h5py

    total = 0
    for name in group:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink) or depth > _DEPTH:
            raise ConfigError(f"{path}: {group.name} must contain its data itself, got a link in {name}")
        item = group[name]
        if (address := h5py.h5o.get_info(item.id).addr) in visited:
            raise ConfigError(f"{path}: {group.name} must contain its data itself, got a second name, {name}, for it")
        visited.add(address)
        if isinstance(item, h5py.Group):
            total += _require_own_data(item, path, claims, visited, depth + 1)
        elif isinstance(item, h5py.Dataset):
            if item.external or item.is_virtual:
                raise ConfigError(f"{path}: {item.name} must be stored in the file itself, got data in another file")
            if item.dtype.hasobject and item.size != 1:
                raise ConfigError(f"{path}: {item.name} must be numbers, got strings of variable length")
            if item.dtype.kind == "c":
                raise ConfigError(f"{path}: {item.name} must be real numbers, got {item.dtype}")
            chunk, shape = item.chunks or (), item.shape or ()
            count = math.prod(-(-length // own) for length, own in zip(shape, chunk, strict=False)) if chunk else 1
            size = item.dtype.itemsize * (math.prod(chunk) if chunk else item.size or 0)
            claims.add(item.name, max(count, 1), max(size, _CHUNK_BYTES) if chunk else size)
            plan, plain = item.id.get_create_plist(), (h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32)
            filters = [plan.get_filter(i)[::3] for i in range(plan.get_nfilters())]
            read = *plain, h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_LZF
            # other filters trust parameters in the file, and would read and write beyond their memory
            for number, label in filters:
                if number not in read:
                    rule, shown = "plain or compressed with gzip or lzf", label.decode("ascii", "replace")
                    raise ConfigError(f"{path}: {item.name} must be {rule}, got filter {number} ({shown}); rewrite it")
            packed = sum(number not in plain for number, _ in filters)
            stored = item.id.get_storage_size()  # HDF5 expands it without a limit
            total += stored
            written = item.id.get_num_chunks() if chunk else min(stored, 1)
            # HDF5 would read zeros, unless the file names another value
            if item.size and written < count and plan.fill_value_defined() != h5py.h5d.FILL_VALUE_USER_DEFINED:
                raise ConfigError(f"{path}: {item.name} must be written as a whole, got {written} of {count} chunks")
            more = packed > 1 or (packed and stored > 2 * count * size + (1 << 16))
            shuffled = any(number == h5py.h5z.FILTER_SHUFFLE for number, _ in filters[1:])
            if more or (packed and shuffled) or _expands(item, size):
                rule = f"shuffled first and compressed once, from its {count * size} bytes to fewer"
                raise ConfigError(f"{path}: {item.name} must be {rule}, got {len(filters)} filters, {stored} bytes")
    return total


def _expands(item: h5py.Dataset, size: int) -> bool:
    """Returns whether a chunk compressed with gzip expands to more than `size` bytes, and a checksum."""
    chunks: list[Any] = []
    if item.compression == "gzip":
        item.id.chunk_iter(chunks.append)
    before = 0
    for chunk in chunks:
        before += chunk.size
        if before > EXPANDED:
            with contextlib.suppress(zlib.error):  # of a chunk that is damaged, or not compressed
                content = item.id.read_direct_chunk(chunk.chunk_offset)[1]
                if len(zlib.decompressobj().decompress(content, size + 5)) > size + 4:
                    return True
    return False
