"""Keeps memory that PyTorch frees on a CPU in the process, for the next frame.

The GNU C library returns large blocks to the system, which then sets 18,000 pages to zero in a frame of 4,296
particles. This takes up to a quarter of the frame's time.
"""

import ctypes
import functools
import platform

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # parameters of mallopt in malloc.h
LARGEST = 32 << 20  # largest size of a block in bytes that mallopt takes


@functools.cache
def keep_freed_memory() -> bool:
    """Makes the GNU C library keep freed blocks. Returns False for another C library."""
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    return bool(mallopt(MMAP_THRESHOLD, LARGEST)) and bool(mallopt(TRIM_THRESHOLD, 2**31 - 1))
