"""Rollouts of scenes as far as they come: one that diverges ends alone.

Shape legend: T frames, N particles of a scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from hgn.network.features import ParticleState
from hgn.runtime.divergence import lost
from hgn.runtime.gns_backend import require_agreement
from hgn.runtime.simulator import DivergenceError, InitialState, Simulator, left_text


@dataclass(frozen=True, eq=False)
class RolloutResult:
    """One scene as far as it came, and why it came no farther."""

    position_TN3: np.ndarray  # float32, domain units; frame 0 is the initial state
    cause: str | None = None  # of its end before the last frame

    @property
    def frame_count(self) -> int:
        return len(self.position_TN3)


def network_trials(
    simulator: Simulator, scenes: Sequence[InitialState], frames: int, on_frame: Callable[[int], None] | None = None
) -> list[RolloutResult]:
    """Rollouts side by side. One that diverges ends where it must and the others go on: off backend triton without it,
    on backend triton again in halves.
    """
    if not scenes:
        return []
    if simulator.backend != "triton":
        return _plain_trials(simulator, scenes, frames, on_frame)
    try:
        return [RolloutResult(path_TN3) for path_TN3 in simulator.rollout(scenes, frames, on_frame)]
    except DivergenceError as error:
        if len(scenes) > 1:
            halves = scenes[: len(scenes) // 2], scenes[len(scenes) // 2 :]
            return [trial for half in halves for trial in network_trials(simulator, half, frames)]
        # The same again up to there. On a GPU sums are in no fixed order, and it may end earlier.
        (trial,) = network_trials(simulator, scenes, error.frame)
        return [RolloutResult(trial.position_TN3, trial.cause or str(error))]


@torch.inference_mode()
def _plain_trials(
    simulator: Simulator, scenes: Sequence[InitialState], frames: int, on_frame: Callable[[int], None] | None
) -> list[RolloutResult]:
    state = simulator.start(scenes)
    require_agreement(simulator.network, state, gradients=False)
    paths = [np.empty((frames, *scene.position_N3.shape), np.float32) for scene in scenes]
    for path_TN3, scene in zip(paths, scenes, strict=True):
        path_TN3[0] = scene.position_N3
    ends: dict[int, DivergenceError] = {}
    going = list(range(len(scenes)))
    for frame in range(1, frames):
        state = simulator.step(state)
        lost_N = lost(state.position_N3, state.domain_S3[state.scene_N])
        if bool(lost_N.any()):
            lost_S = torch.bincount(state.scene_N[lost_N], minlength=len(scenes)).tolist()
            for i in filter(lambda i: lost_S[i], going):
                ends[i] = DivergenceError(frame, left_text(lost_S[i], len(scenes[i].position_N3)))
            going = [i for i in going if i not in ends]
            state = _of_scenes(state, going)
        if not going:
            break
        position_N3, begin = state.position_N3.cpu().numpy(), 0
        for i in going:
            end = begin + len(scenes[i].position_N3)
            paths[i][frame], begin = position_N3[begin:end], end
        if on_frame is not None:
            on_frame(frame)
    return [
        RolloutResult(path_TN3[: ends[i].frame], str(ends[i])) if i in ends else RolloutResult(path_TN3)
        for i, path_TN3 in enumerate(paths)
    ]


def _of_scenes(state: ParticleState, scenes: Sequence[int]) -> ParticleState:
    """The state without the particles of other scenes; scenes keep their numbers."""
    kept_N = torch.isin(state.scene_N, torch.tensor(scenes, device=state.scene_N.device))
    return replace(
        state,
        position_N3=state.position_N3[kept_N],
        velocity_NM3=state.velocity_NM3[kept_N],
        material_N=state.material_N[kept_N],
        scene_N=state.scene_N[kept_N],
    )
