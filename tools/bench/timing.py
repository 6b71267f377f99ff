"""Times of several contenders in one process: warmed up, alternating, by device events, as medians."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

WARM_UP = 3
MINIMUM_ROUNDS = 5


@dataclass
class Timed:
    """One contender: `sample` does the work once or more and returns milliseconds."""

    sample: Callable[[], list[float]]
    rounds: int | None = None  # samples in all, for one that is long; none: one a round
    milliseconds: list[float] = field(default_factory=list)

    def quartiles(self) -> tuple[float, float, float]:
        """Lower quartile, median and upper quartile, ms."""
        low, middle, high = np.percentile(self.milliseconds, (25, 50, 75)).tolist()
        return low, middle, high


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


def alternate(contenders: Sequence[Timed], rounds: int, seconds: float) -> None:
    """Fills `milliseconds` of each: every round takes one sample of each contender in turn.

    Ends after `rounds` rounds, or after `seconds` once MINIMUM_ROUNDS are done. Warm-up samples are thrown away.
    """
    started = time.monotonic()
    for timed in contenders:
        for _ in range(WARM_UP if timed.rounds is None else 1):
            timed.sample()
    for index in range(rounds):
        if index >= MINIMUM_ROUNDS and time.monotonic() - started > seconds:
            break
        for timed in contenders:
            every = 1 if timed.rounds is None else max(1, rounds // timed.rounds)
            if index % every == 0:
                timed.milliseconds += timed.sample()
