"""The run times of contenders, all on the same scenes in one process."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from hgn.scene.episode import Episode
from tools.error_vs_time.contenders import Contender, frame_milliseconds
from tools.error_vs_time.score import quartiles
from tools.error_vs_time.settings import ErrorVsTimeConfig
from tools.timing import GpuMemory

WARM_FRAMES, TRITON_WARM_FRAMES = 6, 70  # the least that a contender is timed over, too
SOLVER_WARM_FRAMES = 2  # the initial state and the first, in which the solver compiles
GAIN = 0.95  # of a scene's time, that a larger batch must come below


class Stopwatch:
    """The run times of a contender over some scenes one by one and over some side by side, which are warmed up once."""

    def __init__(
        self, contender: Contender, references: Sequence[Episode], config: ErrorVsTimeConfig, device: torch.device
    ) -> None:
        """Simulates one scene and batches for some frames, which say how many take `timed_seconds`, and which batch
        is done soonest; then all that will be timed, as far as something is captured or compiled for it. Tells the
        most GPU memory that the first scene took, of what torch knows. The solver is timed over whole rollouts.
        """
        # The largest first: what is captured for it has room for the others.
        some = sorted(references[: config.timed_scenes], key=lambda episode: -len(episode.material_N))
        self.contender, self.singles = contender, [[episode] for episode in some]
        self.single_ms: list[float] = []
        self.batched_ms: list[float] = []
        contender.release()
        memory, largest = GpuMemory(device), self.singles[0]
        self.solver = contender.row["system"] == "mpm"
        most = config.mpm_timed_frames if self.solver else config.timed_frames
        most = min(most, len(largest[0].position_TN3))
        if self.solver:
            for scenes in self.singles:  # kernels are compiled for the materials that a scene holds
                frame_milliseconds(contender, scenes, min(SOLVER_WARM_FRAMES, most))
        # what looks at its frames 32 at a time tells nothing of fewer
        frames = min(WARM_FRAMES if contender.stepped else TRITON_WARM_FRAMES, most)
        captures = not contender.stepped
        if captures:  # which would be taken for the time of a frame
            frame_milliseconds(contender, largest, frames)
        taken = frame_milliseconds(contender, largest, frames)
        self.memory_gb = None if self.solver else memory.peak_gb()
        # the scenes again and again where a batch holds more
        counts = sorted(config.timed_batches)
        batches = [[references[i % len(references)] for i in range(count)] for count in counts]
        self.batch, together = self._best_batch(batches, frames, self.solver or captures)

        def affordable(milliseconds: float | None) -> int:
            if milliseconds is None or self.solver:
                return most
            return min(most, max(frames, int(1e3 * config.timed_seconds / milliseconds)))

        self.single_frames, self.batch_frames = affordable(taken), affordable(together)
        if captures:
            for single in self.singles:
                frame_milliseconds(contender, single, self.single_frames)
            frame_milliseconds(contender, self.batch, self.batch_frames)

    def _best_batch(
        self, batches: Sequence[list[Episode]], frames: int, compiles: bool
    ) -> tuple[list[Episode], float | None]:
        """The batch whose scenes are done soonest, and the milliseconds of its frames: larger ones are tried as long as
        they gain and there is memory.
        """
        best, least = batches[0], None
        for batch in batches:
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
        """Simulates each of the scenes once more; what the report tells of all times so far. `ms` is a frame of one
        scene, `ms_batched` a frame of each of the scenes side by side.
        """
        rollouts = [(scenes, self.single_frames, self.single_ms) for scenes in self.singles]
        if not (self.solver and self.batched_ms):  # a whole rollout of many scenes, once
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
