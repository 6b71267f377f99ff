"""Rollouts of scenes as far as they come: one that diverges ends alone.

Shape legend: T frames, N particles of a scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hgn.runtime.simulator import DivergenceError, InitialState, Simulator


@dataclass(frozen=True, eq=False)
class Trial:
    """One scene as far as it came, and why it came no farther."""

    position_TN3: np.ndarray  # float32, domain units; frame 0 is the initial state
    cause: str | None = None  # of its end before the last frame

    @property
    def frame_count(self) -> int:
        return len(self.position_TN3)


def network_trials(
    simulator: Simulator, scenes: Sequence[InitialState], frames: int, on_frame: Callable[[int], None] | None = None
) -> list[Trial]:
    """Rollouts side by side; in halves where one diverges, so that the others go on and it ends where it must."""
    if not scenes:
        return []
    try:
        return [Trial(path_TN3) for path_TN3 in simulator.rollout(scenes, frames, on_frame)]
    except DivergenceError as error:
        if len(scenes) > 1:
            halves = scenes[: len(scenes) // 2], scenes[len(scenes) // 2 :]
            return [trial for half in halves for trial in network_trials(simulator, half, frames)]
        # The same again up to there. On a GPU sums are in no fixed order, and it may end earlier.
        (trial,) = network_trials(simulator, scenes, error.frame)
        return [Trial(trial.position_TN3, trial.cause or str(error))]
