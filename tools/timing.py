"""Times and memory of what takes turns in one process: warmed up, by device events, as medians; precisions alike."""

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
TOGETHER_S = 20e-6  # frames that are reported less than this apart were computed together


class Timed:
    """What takes turns: `sample` does the work once or more and returns milliseconds."""

    warm_up = WARM_UP  # samples that are thrown away
    rounds: int | None = None  # samples in all, for one that is long; none: one a round
    failure: str | None = None  # why what was timed is worth nothing

    def sample(self) -> float:
        raise NotImplementedError


def once(run: Callable[[], object], device: torch.device) -> float:
    """Milliseconds of one run: between device events on a GPU, of the wall clock on a CPU."""
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
    """The milliseconds of each: every round takes one sample of each contender in turn, once all are warmed up.

    Ends after `rounds` rounds, or where `is_over` says so once MINIMUM_ROUNDS are done.
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


def median_and_quartiles(milliseconds: Sequence[float]) -> dict[str, object]:
    """Of a row: `ms`, `ms_quartiles` and how many samples these are."""
    low, middle, high = np.percentile(milliseconds, (25, 50, 75)).tolist()
    return {"ms": middle, "ms_quartiles": [low, high], "samples": len(milliseconds)}


class FrameClock:
    """Notes when frames are done; a simulator may report several at once."""

    def __init__(self) -> None:
        self.ends: list[float] = []

    def __call__(self, frame: int) -> None:
        self.ends.append(time.perf_counter())

    def milliseconds(self) -> float | None:
        """Mean time of a frame behind the first ones, which start things up; none where there are too few."""
        gaps = np.diff(self.ends)
        later = np.flatnonzero(gaps > TOGETHER_S)
        if not len(later):
            return None
        first = int(later[0])
        return 1e3 * float(gaps[first:].sum()) / (len(self.ends) - 1 - first)


def free(device: torch.device) -> None:
    """Gives memory of the device back that nobody uses any more."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


class GpuMemory:
    """What a GPU holds of torch's tensors from now on, beyond what it held; what nobody uses is freed before."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        free(device)
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)
            self.before = torch.cuda.memory_allocated(device)

    def peak_gb(self) -> float | None:
        """The most so far; none on a CPU."""
        if self.device.type != "cuda":
            return None
        return (torch.cuda.max_memory_allocated(self.device) - self.before) / 1e9


@contextmanager
def matmul_precision(precision: str) -> Iterator[None]:
    """While it is entered PyTorch multiplies matrices at that precision."""
    before = torch.get_float32_matmul_precision()
    set_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
