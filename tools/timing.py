"""Times and memory of contenders that take turns in one process, after a warm-up, by device events."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch

from hgn.runtime.backend import set_matmul_precision

WARM_UP = 3
MINIMUM_ROUNDS = 5
TOGETHER_S = 20e-6  # frames reported closer together than this were computed together


class Timed:
    """A contender: `sample` does the work once or more and returns milliseconds."""

    warm_up = WARM_UP  # samples that do not count
    rounds: int | None = None  # number of samples of a slow contender; None: one a round
    failure: str | None = None  # why the times are invalid

    def sample(self) -> float:
        raise NotImplementedError


def once(run: Callable[[], object], device: torch.device) -> float:
    """Returns milliseconds of one run, by device events on a GPU and by the wall clock on a CPU."""
    if device.type != "cuda":
        started = time.perf_counter()
        run()
        return (time.perf_counter() - started) * 1e3
    first, last = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    torch.cuda.synchronize(device)
    first.record()
    run()
    last.record()
    last.synchronize()
    return first.elapsed_time(last)


def alternate(contenders: Sequence[Timed], rounds: int, is_over: Callable[[], bool]) -> list[list[float]]:
    """Returns the milliseconds of each contender, after warming up; a round takes one sample of each in turn.

    Ends after `rounds` rounds, or if `is_over` returns True after MINIMUM_ROUNDS.
    """
    for timed in contenders:
        for _ in range(timed.warm_up):
            timed.sample()
    milliseconds: list[list[float]] = [[] for _ in contenders]
    for index in range(rounds):
        if index >= MINIMUM_ROUNDS and is_over():
            break
        for timed, samples in zip(contenders, milliseconds, strict=True):
            if index % (1 if timed.rounds is None else max(1, rounds // timed.rounds)) == 0:
                samples.append(timed.sample())
    return milliseconds


def statistics(milliseconds: Sequence[float]) -> dict[str, object]:
    """Returns the columns `ms` (the median), `ms_quartiles`, `ms_range` and `samples` of a row."""
    least, low, middle, high, most = np.percentile(milliseconds, (0, 25, 50, 75, 100)).tolist()
    columns = {"ms": middle, "ms_quartiles": [low, high], "ms_range": [least, most]}
    return columns | {"samples": len(milliseconds)}


class FrameClock:
    """Records when frames end; a simulator may report several frames together."""

    def __init__(self) -> None:
        self.ends: list[float] = []

    def __call__(self, frame: int) -> None:
        self.ends.append(time.perf_counter())

    def milliseconds(self) -> float | None:
        """Returns the mean time of a frame after the first frames, or None if there are too few."""
        gaps = np.diff(self.ends)
        later = np.flatnonzero(gaps > TOGETHER_S)
        if not len(later):
            return None
        first = int(later[0])
        return 1e3 * float(gaps[first:].sum()) / (len(self.ends) - 1 - first)


def free(device: torch.device) -> None:
    """Frees unused memory of the device."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


class GpuMemory:
    """Memory of torch's tensors on a GPU from now on; unused memory is freed before."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        free(device)
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)
            self.before = torch.cuda.memory_allocated(device)

    def peak_gb(self) -> float | None:
        """Returns the peak so far; None on a CPU."""
        if self.device.type != "cuda":
            return None
        return (torch.cuda.max_memory_allocated(self.device) - self.before) / 1e9


@contextmanager
def matmul_precision(precision: str) -> Iterator[None]:
    """Sets the precision of PyTorch's matrix products inside the block."""
    before = torch.get_float32_matmul_precision()
    set_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
