"""Copies results of a device to host memory.

Taichi's to_numpy allocates new memory each time. It copies this memory to the GPU as it is, and then the result back,
while the GPU is idle. Here only the result is copied, into memory that is reused. If the system allows it, the memory
is page-locked, so that a GPU writes to it at the speed of its bus.
"""

import ctypes

import numpy as np
import taichi as ti

from datagen.mpm.device import cuda_driver
from datagen.mpm.device_memory import address

SUCCESS = 0  # CUresult


class HostCopy:
    """Memory into which arrays of float32 are read, one after another. It grows to the largest of them."""

    def __init__(self) -> None:
        self._on_gpu = ti.lang.impl.current_cfg().arch == ti.cuda
        self._memory = np.empty(0, np.float32)
        self._locked = False

    def read(self, array: ti.ScalarNdarray) -> np.ndarray:
        """Returns the array's values after all kernels, float32 [its length]; the next read overwrites them.

        Raises: RuntimeError if the GPU cannot be read, for example after an error of a kernel.
        """
        ti.sync()
        (count,) = array.shape
        if count > len(self._memory):
            self.release()
            self._memory = np.empty(count, np.float32)
            self._locked = self._on_gpu and self._lock()
        values = self._memory[:count]
        if self._on_gpu:
            _require_success(
                "cuMemcpyDtoH",
                cuda_driver().cuMemcpyDtoH_v2(
                    ctypes.c_void_p(values.ctypes.data), ctypes.c_uint64(address(array)), ctypes.c_size_t(values.nbytes)
                ),
            )
        else:
            ctypes.memmove(values.ctypes.data, address(array), values.nbytes)
        return values

    def release(self) -> None:
        """Frees the memory."""
        if self._locked:
            memory = ctypes.c_void_p(self._memory.ctypes.data)
            _require_success("cuMemHostUnregister", cuda_driver().cuMemHostUnregister(memory))
        self._memory, self._locked = np.empty(0, np.float32), False

    def _lock(self) -> bool:
        """Locks the memory, and returns whether the system allows it; memory that is not locked is read more slowly."""
        memory, size = ctypes.c_void_p(self._memory.ctypes.data), ctypes.c_size_t(self._memory.nbytes)
        return bool(cuda_driver().cuMemHostRegister_v2(memory, size, ctypes.c_uint(0)) == SUCCESS)


def _require_success(call: str, status: int) -> None:
    if status != SUCCESS:
        raise RuntimeError(f"{call} failed with CUDA's error {status}")
