"""Measures time and memory of contenders in one process after a warm-up: runs by device events, rollouts by frames."""

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
import torch

from hgn.runtime.backend import set_matmul_precision
from hgn.scene.episode import Episode

WARM_UP = 3
MINIMUM_ROUNDS = 5
TOGETHER_S = 20e-6  # frames reported closer together than this were computed together
# rollouts
SCENES = 3  # number of scenes timed one by one
BATCHES = (8, 64, 256)  # numbers of scenes side by side; the fastest one of each contender is reported
FRAMES, SECONDS = 100, 0.5  # largest length of a timed rollout; slow contenders simulate fewer frames
SOLVER_FRAMES = 300  # more, because the solver's frames are slowest when material has landed
WARM_FRAMES, TRITON_WARM_FRAMES = 6, 70  # also the smallest number of timed frames; Triton reports 32 frames together
SOLVER_WARM_FRAMES = 2  # the solver compiles in the first frame
GAIN = 0.95  # a larger batch is better if the time per scene is below this fraction


class Timed:
    """A contender: `sample` does the work once or more and returns milliseconds."""

    warm_up = WARM_UP  # samples that do not count
    rounds: int | None = None  # number of samples of a slow contender; None: one in each round
    failure: str | None = None  # the reason for which the times are invalid

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
    """Returns the samples of each contender in milliseconds, after a warm-up. A round takes one sample of each.

    Ends after `rounds` rounds, or when `is_over` returns True after at least MINIMUM_ROUNDS.
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


def statistics(milliseconds: Sequence[float]) -> dict[str, Any]:
    """Returns the columns `ms` (the median), `ms_quartiles`, `ms_range` and `samples`; without samples only `ms`."""
    if not len(milliseconds):
        return {"ms": None}
    least, low, middle, high, most = np.percentile(milliseconds, (0, 25, 50, 75, 100)).tolist()
    return {"ms": middle, "ms_quartiles": [low, high], "ms_range": [least, most], "samples": len(milliseconds)}


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


class Simulates(Protocol):
    """A contender that simulates scenes side by side and reports its frames."""

    row: dict[str, Any]
    stepped: bool

    def trials(self, episodes: Sequence[Episode], frames: int, on_frame: FrameClock, /) -> object: ...
    def release(self) -> None: ...


class Stopwatch:
    """Times rollouts of some scenes one by one, and of a batch side by side."""

    def __init__(self, contender: Simulates, references: Sequence[Episode], device: torch.device) -> None:
        """Warms up everything that is timed, and chooses the number of frames and the batch."""
        some = sorted(references[:SCENES], key=lambda episode: -len(episode.material_N))  # the largest allocates most
        self.contender, self.singles = contender, [[episode] for episode in some]
        self.single_ms: list[float] = []
        self.batched_ms: list[float] = []
        contender.release()
        memory, captures = GpuMemory(device), not contender.stepped
        self.solver = contender.row["system"] == "mpm"
        most = min(SOLVER_FRAMES if self.solver else FRAMES, len(some[0].position_TN3))
        frames = min(TRITON_WARM_FRAMES if captures else WARM_FRAMES, most)
        if self.solver:
            for scenes in self.singles:  # each set of materials is another kernel
                self._frame_ms(scenes, min(SOLVER_WARM_FRAMES, most))
        elif captures:
            self._frame_ms(self.singles[0], frames)
        taken = self._frame_ms(self.singles[0], frames)
        self.memory_gb = None if self.solver else memory.peak_gb()
        self.batch, together = self._best_batch(references, frames, self.solver or captures)
        self.single_frames, self.batch_frames = (
            most if ms is None or self.solver else min(most, max(frames, int(1e3 * SECONDS / ms)))
            for ms in (taken, together)
        )
        if captures:
            for single in self.singles:
                self._frame_ms(single, self.single_frames)
            self._frame_ms(self.batch, self.batch_frames)

    def _frame_ms(self, scenes: Sequence[Episode], frames: int) -> float | None:
        """Returns the mean time of a frame of a rollout; None if the rollout ends too early."""
        clock = FrameClock()
        self.contender.trials(scenes, frames, clock)
        return clock.milliseconds()

    def _best_batch(
        self, references: Sequence[Episode], frames: int, compiles: bool
    ) -> tuple[list[Episode], float | None]:
        """Returns the batch with the shortest time per scene, and the milliseconds of its frames."""
        best, least = list(references[:1]), None
        for count in BATCHES:
            batch = [references[i % len(references)] for i in range(count)]
            try:
                if compiles:
                    self._frame_ms(batch, frames)
                taken = self._frame_ms(batch, frames)
            except torch.OutOfMemoryError:
                self.contender.release()
                break
            if taken is None or (least is not None and taken / len(batch) > GAIN * least / len(best)):
                break
            best, least = batch, taken
        return best, least

    def round(self) -> dict[str, Any]:
        """Simulates each scene again. Returns `ms` per frame, and `ms_batched` per frame and scene of the batch."""
        rollouts = [(scenes, self.single_frames, self.single_ms) for scenes in self.singles]
        if not (self.solver and self.batched_ms):  # a whole rollout of many scenes is timed once
            rollouts.append((self.batch, self.batch_frames, self.batched_ms))
        for scenes, frames, milliseconds in rollouts:
            taken = self._frame_ms(scenes, frames)
            if taken is not None:
                milliseconds.append(taken / len(scenes))
        batch = {"ms_batched": statistics(self.batched_ms)["ms"], "batch_scenes": len(self.batch)}
        timed = {"timed_frames": self.single_frames, "memory_gb": self.memory_gb}
        return statistics(self.single_ms) | batch | timed


def free(device: torch.device) -> None:
    """Frees unused memory of the device."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


class GpuMemory:
    """Measures the memory of torch's tensors on a GPU from now on. Unused memory is freed before."""

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
