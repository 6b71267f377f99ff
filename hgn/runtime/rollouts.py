"""Rollouts of scenes to their end, or to the frame before they diverge."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hgn.runtime.simulator import InitialState, Simulator


@dataclass(frozen=True, eq=False)
class RolloutResult:
    """The frames of one scene, and the reason if they end early."""

    position_TN3: np.ndarray  # float32, domain units; frame 0 is the initial state
    cause: str | None = None  # why the rollout ended before the last frame

    @property
    def frame_count(self) -> int:
        return len(self.position_TN3)


def simulate_scenes(
    simulator: Simulator,
    scenes: Sequence[InitialState],
    frames: int,
    on_frame: Callable[[int], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> list[RolloutResult]:
    """Simulates scenes together. A scene that diverges ends, and the others continue until `stop` returns True."""
    if not scenes:
        return []
    paths, ended = simulator.paths(scenes, frames, on_frame, isolate=True, stop=stop)
    return [
        RolloutResult(path_TN3[: ended[i].frame], str(ended[i])) if i in ended else RolloutResult(path_TN3)
        for i, path_TN3 in enumerate(paths)
    ]
