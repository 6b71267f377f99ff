"""NumPy archives, those with pickled arrays in them too, read by an unpickler that knows arrays alone.

geoelements/gns keeps trajectories as object arrays, which NumPy pickles; to load such a file in the usual way would
run whatever its writer put there.
"""

from __future__ import annotations

import io
import pickle
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hgn.schema import ConfigError

_MULTIARRAY = ("numpy.core.multiarray", "numpy._core.multiarray")
_rebuild: Any = np.zeros(0).__reduce__()[0]
_scalar: Any = np.float64(0).__reduce__()[0]
_PIECES = {  # of what the pickle of an array may name, and what it is given
    **{(module, "_reconstruct"): _rebuild for module in _MULTIARRAY},
    **{(module, "scalar"): _scalar for module in _MULTIARRAY},
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}


class _ArraysAlone(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        try:
            return _PIECES[module, name]
        except KeyError:
            raise pickle.UnpicklingError(f"{module}.{name}, which is no part of an array") from None

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError(f"a reference to an object outside ({pid!r})")


def read_npz(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Names and arrays of an archive, one after the other; object arrays hold arrays, numbers, tuples and lists alone.

    Raises: ConfigError naming the file and the array that is cut, altered, or holds anything else.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            for member in archive.namelist():
                name = f"{path}: {member.removesuffix('.npy')}"
                if not member.endswith(".npy"):
                    raise ConfigError(f"{name} must be an array (.npy)")
                yield member.removesuffix(".npy"), _read_array(archive.read(member), name)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, EOFError) as error:
        raise ConfigError(f"{path} must be a whole NumPy archive, got {error}; fetch it again") from None


def _read_array(data: bytes, name: str) -> np.ndarray:
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        if version == (1, 0):
            shape, _, dtype = np.lib.format.read_array_header_1_0(file)
        else:
            shape, _, dtype = np.lib.format.read_array_header_2_0(file)
        if not dtype.hasobject:
            file.seek(0)
            plain: np.ndarray = np.lib.format.read_array(file, allow_pickle=False)
            return plain
        array = _ArraysAlone(file).load()
    except RecursionError:
        raise ConfigError(f"{name} must be arrays alone, got too deep a nesting") from None
    # whatever a damaged or hostile pickle makes of these few pieces
    except (pickle.UnpicklingError, ValueError, EOFError, TypeError, AttributeError, LookupError, MemoryError) as error:
        raise ConfigError(f"{name} must be an array, or a pickle of arrays alone, got {error}") from None
    if not isinstance(array, np.ndarray) or array.shape != tuple(shape):
        raise ConfigError(f"{name} must be an array of shape {shape}, got {type(array).__name__}")
    return array
