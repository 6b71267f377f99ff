"""Frames by predicted accelerations, one by one: the stepper of backends torch and cpu.

Shape legend: T frames, N particles of all scenes, M velocities of a history, S scenes.
"""

from collections.abc import Callable, Iterator

import torch

from hgn.network.features import ParticleState
from hgn.runtime.divergence import diverged
from hgn.step.reference import advanced
from hgn.step_config import StepConfig


@torch.inference_mode()
def stepped(
    predict: Callable[[ParticleState], torch.Tensor], state: ParticleState, step: StepConfig, dimensions: int
) -> ParticleState:
    """Returns the state a frame later, without gradients."""
    return advanced(state, predict(state), step, dimensions)


class TorchStepper:
    """Computes frames with `predict`, which returns accelerations [N, 3] in frame units; `step` constrains them."""

    def __init__(
        self, predict: Callable[[ParticleState], torch.Tensor], state: ParticleState, step: StepConfig, dimensions: int
    ) -> None:
        self.predict, self.state = predict, state
        self._step, self._dimensions = step, dimensions

    def blocks(self, frames: int) -> Iterator[tuple[torch.Tensor, bool]]:
        """Yields each frame as a block. Raises: GridRangeError if positions are beyond the range of a grid."""
        for _ in range(frames):
            self.state = stepped(self.predict, self.state, self._step, self._dimensions)
            domain_N3 = self.state.domain_S3[self.state.scene_N]
            lost = bool(diverged(self.state.position_N3, domain_N3).any())
            yield self.state.position_N3[None], lost
            if lost:
                return

    def motion(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self.state.position_N3, self.state.velocity_NM3

    def keep(self, kept_N: torch.Tensor) -> None:
        self.state = self.state.selected(kept_N)

    def take(self, state: ParticleState) -> bool:
        self.state = state
        return True
