"""Run times of contenders, all on the same scenes in one process."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from hgn.scene.episode import Episode
from tools.error_vs_time.contenders import Contender, frame_milliseconds
from tools.error_vs_time.score import quartiles
from tools.timing import GpuMemory

SCENES = 3  # timed one by one
BATCHES = (8, 64, 256)  # scenes side by side, of which each contender takes its best
FRAMES, SECONDS = 100, 0.5  # of each timed rollout, at most; slow contenders simulate fewer frames
SOLVER_FRAMES = 300  # the solver's frames are slowest when material has landed
WARM_FRAMES, TRITON_WARM_FRAMES = 6, 70  # also the least number of timed frames; Triton reports 32 frames at once
SOLVER_WARM_FRAMES = 2  # the solver compiles in the first frame
GAIN = 0.95  # of a scene's time, below which a larger batch is better


class Stopwatch:
    """Measures a contender on some scenes one by one, and side by side."""

    def __init__(self, contender: Contender, references: Sequence[Episode], device: torch.device) -> None:
        """Warms up everything that is timed, and chooses the number of frames and the batch."""
        some = sorted(references[:SCENES], key=lambda episode: -len(episode.material_N))  # the largest allocates most
        self.contender, self.singles = contender, [[episode] for episode in some]
        self.single_ms: list[float] = []
        self.batched_ms: list[float] = []
        contender.release()
        memory, largest = GpuMemory(device), self.singles[0]
        self.solver = contender.row["system"] == "mpm"
        most = min(SOLVER_FRAMES if self.solver else FRAMES, len(largest[0].position_TN3))
        if self.solver:
            for scenes in self.singles:  # each set of materials is another kernel
                frame_milliseconds(contender, scenes, min(SOLVER_WARM_FRAMES, most))
        frames = min(WARM_FRAMES if contender.stepped else TRITON_WARM_FRAMES, most)
        captures = not contender.stepped
        if captures:
            frame_milliseconds(contender, largest, frames)
        taken = frame_milliseconds(contender, largest, frames)
        self.memory_gb = None if self.solver else memory.peak_gb()
        self.batch, together = self._best_batch(references, frames, self.solver or captures)

        def affordable(milliseconds: float | None) -> int:
            if milliseconds is None or self.solver:
                return most
            return min(most, max(frames, int(1e3 * SECONDS / milliseconds)))

        self.single_frames, self.batch_frames = affordable(taken), affordable(together)
        if captures:
            for single in self.singles:
                frame_milliseconds(contender, single, self.single_frames)
            frame_milliseconds(contender, self.batch, self.batch_frames)

    def _best_batch(
        self, references: Sequence[Episode], frames: int, compiles: bool
    ) -> tuple[list[Episode], float | None]:
        """Returns the batch with the shortest time a scene, and the milliseconds of its frames."""
        best, least = list(references[:1]), None
        for count in BATCHES:
            batch = [references[i % len(references)] for i in range(count)]
            try:
                if compiles:
                    frame_milliseconds(self.contender, batch, frames)
                taken = frame_milliseconds(self.contender, batch, frames)
            except torch.OutOfMemoryError:
                self.contender.release()
                break
            if taken is None or (least is not None and taken / len(batch) > GAIN * least / len(best)):
                break
            best, least = batch, taken
        return best, least

    def round(self) -> dict[str, Any]:
        """Simulates each scene once more; returns `ms` of a frame and `ms_batched` of a frame and scene."""
        rollouts = [(scenes, self.single_frames, self.single_ms) for scenes in self.singles]
        if not (self.solver and self.batched_ms):  # a whole rollout of many scenes is timed once
            rollouts.append((self.batch, self.batch_frames, self.batched_ms))
        for scenes, frames, milliseconds in rollouts:
            taken = frame_milliseconds(self.contender, scenes, frames)
            if taken is not None:
                milliseconds.append(taken / len(scenes))
        return {
            "ms": float(np.median(self.single_ms)) if self.single_ms else None,
            "ms_quartiles": quartiles(self.single_ms),
            "ms_batched": float(np.median(self.batched_ms)) if self.batched_ms else None,
            "batch_scenes": len(self.batch),
            "timed_frames": self.single_frames,
            "memory_gb": self.memory_gb,
        }
