"""Distributes blocks of work over the cores of a CPU. Each thread computes whole blocks.

PyTorch would split every operation among its threads. Many operations of a frame take less time than a sleeping thread
needs to wake up.
"""

import functools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import TypeVar

import torch

Block = TypeVar("Block")
MAXIMUM_THREADS = 8  # further threads would wait for Python's lock, which each operation takes


@contextmanager
def single_threaded() -> Iterator[int]:
    """Limits PyTorch to one thread in operations of this thread. Yields the earlier number of threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield min(threads, MAXIMUM_THREADS)
    finally:
        torch.set_num_threads(threads)


def for_each(work: Callable[[Block], None], blocks: Sequence[Block], threads: int) -> None:
    """Calls `work` for each block, without gradients, on `threads` threads including this one.

    A free thread takes the next block. Blocks must write to disjoint memory. Raises the errors of `work`.
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
        wait(futures)  # after an error too no thread works on
    for future in futures:
        future.result()


@functools.lru_cache(1)
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """Returns the threads of a process. A forked process needs its own threads."""
    return ThreadPoolExecutor(threads, "core", lambda: torch.set_num_threads(1))
