"""Reads untrusted NumPy files: headers are checked, and pickles can only create arrays.

geoelements/gns stores trajectories as object arrays, which NumPy pickles. NumPy's loader would run any code in such a
file. An invalid array state would make it write outside its memory.
"""

import contextlib
import io
import math
import pickle
import re
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from hgn.schema import ConfigError
from hgn.system.claims import Claims, require_plain_pickle
from hgn.system.files import opened

_MULTIARRAY = ("numpy.core.multiarray", "numpy._core.multiarray")
_PLAIN_TYPE = re.compile(r"b1|[iu][1248]|f[248]|O8?")
# errors of headers, which NumPy evaluates as Python, of the sizes in them, and of unpickling
_ERRORS = (
    *(pickle.UnpicklingError, ValueError, TypeError, OverflowError, EOFError, OSError, AttributeError, LookupError),
    *(SyntaxError, tokenize.TokenError, RecursionError, MemoryError),
)


class _Type:
    """The type of a pickled array. NumPy's own type would accept any state, and is shared by the whole process."""

    def __init__(self, name: str, *_: Any) -> None:
        if _PLAIN_TYPE.fullmatch(name) is None:
            raise pickle.UnpicklingError(f"the type {name!r}, which is not a number")
        self.plain = np.dtype(name)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.plain = self.plain.newbyteorder(state[1])


class _Array(np.ndarray):
    """An array that accepts only a state of matching size."""

    def __setstate__(self, state: Any) -> None:
        _, shape, kind, fortran_order, content = state
        size, plain = math.prod(shape), kind.plain
        if plain.hasobject:
            fits = isinstance(content, list) and len(content) == size
        else:
            fits = isinstance(content, bytes) and len(content) == size * plain.itemsize
        if not fits or min(shape, default=0) < 0:
            raise pickle.UnpicklingError(f"an array of shape {shape} with other contents")
        super().__setstate__((1, tuple(shape), plain, bool(fortran_order), content))  # type: ignore[arg-type]


class _ArraysAlone(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if module in _MULTIARRAY and name in ("_reconstruct", "scalar"):
            return _empty_array if name == "_reconstruct" else _scalar
        if module == "numpy" and name in ("ndarray", "dtype"):
            return _Type if name == "dtype" else name  # every array becomes an _Array
        raise pickle.UnpicklingError(f"{module}.{name}, which is not part of an array")

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError(f"a reference to an external object ({pid!r})")


def _empty_array(*_: Any) -> _Array:
    return np.empty(0, np.uint8).view(_Array)


def _scalar(kind: _Type, content: bytes) -> Any:
    return np.frombuffer(content, kind.plain, 1)[0]


def read_npz(path: Path | BinaryIO, objects: bool = False) -> Iterator[tuple[str, np.ndarray]]:
    """Yields names and read-only arrays of an archive. Arrays of one folder follow one another.

    With `objects` arrays may contain arrays, numbers, tuples, lists and dicts. Raises: ConfigError naming the file and
    the array that is incomplete, altered, or contains other objects; OSError of the disk.
    """
    with opened(path) if isinstance(path, Path) else contextlib.nullcontext(path) as file:
        yield from _read_archive(file, path, objects)


def _read_archive(file: BinaryIO, path: Path | BinaryIO, objects: bool) -> Iterator[tuple[str, np.ndarray]]:
    try:
        with zipfile.ZipFile(file) as archive:
            claims, folders = Claims(str(path), _size(archive)), dict[str, int]()
            for info in archive.infolist():
                if archive.getinfo(info.filename) is not info:
                    raise ConfigError(f"{path}: {info.filename.removesuffix('.npy')} must appear once, got two of it")
                claims.add(info.filename, info.file_size)
                folders.setdefault(info.filename.rpartition("/")[0] or info.filename, len(folders))
            # sorted, so that the members of a folder follow one another
            for info in sorted(archive.infolist(), key=lambda i: folders[i.filename.rpartition("/")[0] or i.filename]):
                member = info.filename.removesuffix(".npy")
                kinds = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
                if member == info.filename or info.compress_type not in kinds:
                    raise ConfigError(f"{path}: {member} must be an array (.npy), as numpy.savez writes it")
                with archive.open(info) as content:
                    data = content.read(info.file_size)  # without a size zipfile expands a longer stream first
                yield member, _read_array(data, f"{path}: {member}", claims if objects else None)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError) as error:
        raise ConfigError(f"{path} must be a complete NumPy archive, got {error}; fetch it again") from None


def read_header(
    file: BinaryIO, name: str, newest: tuple[int, int] = (2, 0)
) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Returns shape, Fortran order and type of the array that follows a `.npy` header.

    Raises: ConfigError naming `name` for another kind of file, or a version after `newest`.
    """
    try:
        version = np.lib.format.read_magic(file)
        if version > newest:
            raise ValueError(f"not version {'.'.join(map(str, newest))}")
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran_order, dtype = read(file)
        if any(type(length) is not int or length < 0 for length in shape):
            raise ValueError(f"the shape {shape}")
    except _ERRORS as error:
        raise ConfigError(f"{name} must be a plain .npy file, got {str(error).partition(chr(10))[0]}") from None
    return shape, fortran_order, dtype


def _size(archive: zipfile.ZipFile) -> int:
    assert archive.fp is not None
    return archive.fp.seek(0, io.SEEK_END)


def _read_array(data: bytes, name: str, claims: Claims | None) -> np.ndarray:
    file = io.BytesIO(data)
    shape, fortran_order, dtype = read_header(file, name)
    try:
        if not dtype.hasobject:
            flat = np.frombuffer(data, dtype, math.prod(shape), file.tell()) if 0 not in shape else np.empty(0, dtype)
            return flat.reshape(shape, order="F" if fortran_order else "C")
        if claims is None:
            raise pickle.UnpicklingError("a pickle")
        require_plain_pickle(data[file.tell() :], claims)
        array = _ArraysAlone(file).load()
    except _ERRORS as error:
        raise ConfigError(f"{name} must be an array, or a pickle of arrays only, got {error}") from None
    if not isinstance(array, np.ndarray) or array.shape != shape:
        raise ConfigError(f"{name} must be an array of shape {shape}, got {type(array).__name__}")
    return array.view(np.ndarray)
