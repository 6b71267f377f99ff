"""Work in blocks on the cores of a CPU: each thread computes whole blocks by itself.

PyTorch shares every single operation among its threads instead. Many of a frame are so short that waking a thread for
each costs more than they do, for idle threads sleep (hgn.system.threads).
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
MAXIMUM_THREADS = 8  # operations begin one at a time, whatever the number of threads: Python has one lock


@contextmanager
def single_threaded() -> Iterator[int]:
    """Within it, this thread's operations are computed by itself alone; gives how many threads they had before."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield min(threads, MAXIMUM_THREADS)
    finally:
        torch.set_num_threads(threads)


def for_each(work: Callable[[Block], None], blocks: Sequence[Block], threads: int) -> None:
    """`work` on each of the blocks, without gradients, by so many threads, this one among them.

    Whichever thread is free takes the next block: none waits for one whose core does something else. Blocks must write
    to different places. Raises: what `work` raises.
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
    """A forked process needs threads of its own."""
    return ThreadPoolExecutor(threads, "core", lambda: torch.set_num_threads(1))
