"""A simulation frame by frame, by whatever predicts accelerations; and what every backend's simulations can do.

Shape legend: T frames, N particles of all scenes, M velocities of a history, S scenes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np
import torch

from hgn.network.features import ParticleState
from hgn.network.grid import GridRangeError
from hgn.runtime.divergence import DivergedError, describe_diverged, diverged
from hgn.step.reference import advanced
from hgn.step_config import StepConfig


class Rollout(Protocol):
    """A simulation in progress."""

    def run(self, frames: int, on_frame: Callable[[int], None] | None = None) -> np.ndarray:
        """Positions of so many more frames, float32 [T, N, 3]; `on_frame` is told the number of each.

        Raises: DivergedError.
        """

    def frames(self) -> Iterator[np.ndarray]:
        """Positions float32 [N, 3] of frame after frame, without an end. Raises: DivergedError."""

    def motion(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions [N, 3] and velocity histories [N, M, 3] behind the last frame of `run`."""

    def take(self, state: ParticleState) -> bool:
        """Goes on with another state; false where there is no room for it, and nothing changes."""


@torch.inference_mode()
def stepped(
    predict: Callable[[ParticleState], torch.Tensor], state: ParticleState, step: StepConfig, dimensions: int
) -> ParticleState:
    """Returns the state a frame later, without gradients."""
    return advanced(state, predict(state), step, dimensions)


class SteppedRollout:
    """`predict` gives accelerations [N, 3] of a state, in frame units; `step` constrains the frames."""

    def __init__(
        self, predict: Callable[[ParticleState], torch.Tensor], state: ParticleState, step: StepConfig, dimensions: int
    ) -> None:
        self.predict, self.state, self.frame = predict, state, 0
        self._step, self._dimensions = step, dimensions

    def step(self) -> None:
        """One frame. Raises: DivergedError where positions are beyond what a grid can hold."""
        self.frame += 1
        try:
            self.state = stepped(self.predict, self.state, self._step, self._dimensions)
        except GridRangeError as error:
            raise DivergedError(self.frame, str(error)) from None

    def diverged(self) -> torch.Tensor:
        """Which particles have come apart from the others, bool [N]."""
        return diverged(self.state.position_N3, self.state.domain_S3[self.state.scene_N])

    def motion(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self.state.position_N3, self.state.velocity_NM3

    def take(self, state: ParticleState) -> bool:
        self.state = state
        return True

    def frames(self) -> Iterator[np.ndarray]:
        while True:
            self.step()
            if diverged_count := int(self.diverged().sum()):
                raise DivergedError(self.frame, describe_diverged(diverged_count, len(self.state.position_N3)))
            yield self.state.position_N3.cpu().numpy()

    def run(self, frames: int, on_frame: Callable[[int], None] | None = None) -> np.ndarray:
        position_TN3 = np.empty((frames, *self.state.position_N3.shape), np.float32)
        for index, position_N3 in enumerate(itertools.islice(self.frames(), frames)):
            position_TN3[index] = position_N3
            if on_frame is not None:
                on_frame(self.frame)
        return position_TN3
