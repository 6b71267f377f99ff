"""Rollouts of scenes as far as they come: one that diverges ends alone.

Shape legend: T frames, N particles of a scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from hgn.network.features import ParticleState
from hgn.runtime.divergence import DivergedError, describe_diverged
from hgn.runtime.simulator import InitialState, Simulator
from hgn.runtime.stepped_rollout import SteppedRollout


@dataclass(frozen=True, eq=False)
class RolloutResult:
    """One scene as far as it came, and why it came no farther."""

    position_TN3: np.ndarray  # float32, domain units; frame 0 is the initial state
    cause: str | None = None  # of its end before the last frame

    @property
    def frame_count(self) -> int:
        return len(self.position_TN3)


def simulate_scenes(
    simulator: Simulator, scenes: Sequence[InitialState], frames: int, on_frame: Callable[[int], None] | None = None
) -> list[RolloutResult]:
    """Rollouts side by side. One that diverges ends where it must and the others go on: without it where the backend
    makes frames one by one, and else again in halves.
    """
    if not scenes:
        return []
    if simulator.backend.stepped:
        return _without_diverged(simulator, scenes, frames, on_frame)
    try:
        return [RolloutResult(position_TN3) for position_TN3 in simulator.rollout(scenes, frames, on_frame)]
    except DivergedError as error:
        if len(scenes) > 1:
            halves = scenes[: len(scenes) // 2], scenes[len(scenes) // 2 :]
            return [result for half in halves for result in simulate_scenes(simulator, half, frames)]
        # The same again up to there. On a GPU sums are in no fixed order, and it may end earlier.
        (result,) = simulate_scenes(simulator, scenes, error.frame)
        return [RolloutResult(result.position_TN3, result.cause or str(error))]


def _without_diverged(
    simulator: Simulator, scenes: Sequence[InitialState], frames: int, on_frame: Callable[[int], None] | None
) -> list[RolloutResult]:
    positions = [np.empty((frames, *scene.position_N3.shape), np.float32) for scene in scenes]
    for position_TN3, scene in zip(positions, scenes, strict=True):
        position_TN3[0] = scene.position_N3
    ends: dict[int, DivergedError] = {}
    going = list(range(len(scenes)))
    with simulator.backend.rollout(simulator.start(scenes)) as rollout:
        assert isinstance(rollout, SteppedRollout)
        for frame in range(1, frames):
            rollout.step()
            diverged_N = rollout.diverged()
            if bool(diverged_N.any()):
                count_S = torch.bincount(rollout.state.scene_N[diverged_N], minlength=len(scenes)).tolist()
                for i in filter(lambda i: count_S[i], going):
                    ends[i] = DivergedError(frame, describe_diverged(count_S[i], len(scenes[i].position_N3)))
                going = [i for i in going if i not in ends]
                rollout.state = _of_scenes(rollout.state, going)
            if not going:
                break
            position_N3, begin = rollout.state.position_N3.cpu().numpy(), 0
            for i in going:
                end = begin + len(scenes[i].position_N3)
                positions[i][frame], begin = position_N3[begin:end], end
            if on_frame is not None:
                on_frame(frame)
    return [
        RolloutResult(position_TN3[: ends[i].frame], str(ends[i])) if i in ends else RolloutResult(position_TN3)
        for i, position_TN3 in enumerate(positions)
    ]


@torch.inference_mode()
def _of_scenes(state: ParticleState, scenes: Sequence[int]) -> ParticleState:
    """The state without the particles of other scenes; scenes keep their numbers."""
    remaining_N = torch.isin(state.scene_N, torch.tensor(scenes, device=state.scene_N.device))
    return replace(
        state,
        position_N3=state.position_N3[remaining_N],
        velocity_NM3=state.velocity_NM3[remaining_N],
        material_N=state.material_N[remaining_N],
        scene_N=state.scene_N[remaining_N],
    )
