"""The run times of contenders, all on the same scenes in one process."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
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


@dataclass(eq=False)
class Stopwatch:
    """The run times of a contender: how many frames it is timed over, and what was measured."""

    contender: Contender
    batch: list[Episode]
    single_frames: int
    batch_frames: int
    memory_gb: float | None
    single: list[float] = field(default_factory=list)
    batched: list[float] = field(default_factory=list)


class Timing:
    """Times a contender over some scenes one by one and over some side by side, which are warmed up once."""

    def __init__(self, references: Sequence[Episode], config: ErrorVsTimeConfig, device: torch.device) -> None:
        # The largest first: what is captured for it has room for the others.
        some = sorted(references[: config.timed_scenes], key=lambda episode: -len(episode.material_N))
        self.singles = [[episode] for episode in some]
        # the scenes again and again where a batch holds more
        counts = sorted(config.timed_batches)
        self.batches = [[references[i % len(references)] for i in range(count)] for count in counts]
        self.config, self.device = config, device

    def begun(self, contender: Contender) -> Stopwatch:
        """Simulates one scene and batches for some frames, which say how many take `timed_seconds`, and which batch
        is done soonest; then all that will be timed, as far as something is captured or compiled for it. Tells the
        most GPU memory that the first scene took, of what torch knows. The solver is timed over whole rollouts.
        """
        contender.release()
        memory, largest = GpuMemory(self.device), self.singles[0]
        solver, gns = contender.row["system"] == "mpm", contender.row["system"].startswith("gns")
        most = self.config.mpm_timed_frames if solver else self.config.timed_frames
        most = min(most, len(largest[0].position_TN3))
        if solver:
            for scenes in self.singles:  # kernels are compiled for the materials that a scene holds
                frame_milliseconds(contender, scenes, min(SOLVER_WARM_FRAMES, most))
        # what looks at its frames 32 at a time tells nothing of fewer
        frames = min(WARM_FRAMES if contender.stepped else TRITON_WARM_FRAMES, most)
        captures = not contender.stepped or gns
        if captures:  # which would be taken for the time of a frame
            frame_milliseconds(contender, largest, frames)
        taken = frame_milliseconds(contender, largest, frames)
        memory_gb = None if solver else memory.peak_gb()
        batch, together = self._best_batch(contender, frames, solver or captures)

        def affordable(milliseconds: float | None) -> int:
            if milliseconds is None or solver:
                return most
            return min(most, max(frames, int(1e3 * self.config.timed_seconds / milliseconds)))

        watch = Stopwatch(contender, batch, affordable(taken), affordable(together), memory_gb)
        if captures:
            for single in self.singles:
                frame_milliseconds(contender, single, watch.single_frames)
            frame_milliseconds(contender, batch, watch.batch_frames)
        return watch

    def _best_batch(self, contender: Contender, frames: int, compiles: bool) -> tuple[list[Episode], float | None]:
        """The batch whose scenes are done soonest, and the milliseconds of its frames: larger ones are tried as long as
        they gain and there is memory.
        """
        best, least = self.batches[0], None
        for batch in self.batches:
            try:
                if compiles:
                    frame_milliseconds(contender, batch, frames)
                taken = frame_milliseconds(contender, batch, frames)
            except torch.OutOfMemoryError:
                contender.release()
                break
            if taken is None or (least is not None and taken / len(batch) > GAIN * least / len(best)):
                break
            best, least = batch, taken
        return best, least

    def round(self, watch: Stopwatch) -> dict[str, Any]:
        """Simulates each of the scenes once more; what the report tells of all times so far. `ms` is a frame of one
        scene, `ms_batched` a frame of each of the scenes side by side.
        """
        rollouts = [(scenes, watch.single_frames, watch.single) for scenes in self.singles]
        if not watch.batched or watch.contender.row["system"] != "mpm":  # a whole rollout of many scenes, once
            rollouts.append((watch.batch, watch.batch_frames, watch.batched))
        for scenes, frames, milliseconds in rollouts:
            taken = frame_milliseconds(watch.contender, scenes, frames)
            if taken is not None:
                milliseconds.append(taken / len(scenes))
        return {
            "ms": float(np.median(watch.single)) if watch.single else None,
            "ms_quartiles": quartiles(watch.single),
            "ms_batched": float(np.median(watch.batched)) if watch.batched else None,
            "batch_scenes": len(watch.batch),
            "timed_frames": watch.single_frames,
            "memory_gb": watch.memory_gb,
        }
