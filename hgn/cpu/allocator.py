"""Memory that PyTorch frees on a CPU stays with the process, for the next frame to take.

The GNU C library gives large blocks back to the system at once, which then hands out zeroed pages one by one, 18,000 a
frame of 4,296 particles: up to a quarter of its time.
"""

from __future__ import annotations

import ctypes
import functools
import platform

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # parameters of mallopt in malloc.h
LARGEST = 32 << 20  # bytes of a block that is kept: more mallopt refuses


@functools.cache
def keep_freed_memory() -> bool:
    """Tells the C library to keep freed blocks; False where there is another library, which is left as it is."""
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    return bool(mallopt(MMAP_THRESHOLD, LARGEST)) and bool(mallopt(TRIM_THRESHOLD, 2**31 - 1))
