"""Distributes blocks of work over the cores of a CPU; each thread computes whole blocks.

PyTorch would split every operation among its threads. Many operations of a frame are shorter than the waking of a
sleeping thread.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

Block = TypeVar("Block")
MAXIMUM_THREADS = 8  # more threads wait for Python's lock, which each operation takes


@contextmanager
def single_threaded() -> Iterator[int]:
    """Limits PyTorch to one thread in operations of this thread; yields the number of threads before."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield min(threads, MAXIMUM_THREADS)
    finally:
        torch.set_num_threads(threads)


def for_each(work: Callable[[Block], None], blocks: Sequence[Block], threads: int) -> None:
    """Calls `work` for each block, without gradients, on a number of threads that includes this one.

    A free thread takes the next block. Blocks must write to disjoint memory. Raises: what `work` raises.
    """
    remaining, inference = iter(blocks), torch.is_inference_mode_enabled()

    def drain() -> None:
        with torch.inference_mode(inference), torch.no_grad():
            for block in remaining:
                work(block)

    helpers = min(threads, len(blocks)) - 1
    futures = [_pool(threads - 1, os.getpid()).submit(drain) for _ in range(helpers)]
    try:
        drain()
    finally:
        for future in futures:
            future.result()


@functools.lru_cache(1)
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """Returns the threads of a process; a forked process needs its own."""
    return ThreadPoolExecutor(threads, "core", lambda: torch.set_num_threads(1))
