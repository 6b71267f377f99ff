"""The settings of the constraints of a frame; hgn.step implements them."""

from dataclasses import dataclass
from typing import Annotated

from hgn.schema import Bound, Bounded, NonNegative, Positive, require

Clearance = Annotated[float, Bound("from 0 to 1e9", lambda value: 0 <= value <= 1e9)]
WallClearance = tuple[Clearance, Clearance]


@dataclass(frozen=True)
class StepConfig(Bounded):
    """The constraints of simulated frames (hgn.step). They need no training. Lengths are in domain units."""

    # deformation of particles in contact stops if its speed is below rest_threshold * |g| * (one frame); 0: never
    rest_threshold: NonNegative[float] = 0.0
    # smallest distance from the domain's planes at the near sides (0) and at the far sides; null: no walls
    wall_clearance: WallClearance | None = None
    # smallest distance from an obstacle's triangles, which no particle passes; null: particles may pass
    obstacle_clearance: Positive[float] | None = None

    @property
    def rests(self) -> bool:
        """Returns whether slow deformations stop."""
        return self.rest_threshold > 0

    @property
    def in_training(self) -> "StepConfig":
        """Returns the constraints of pushforward simulations: obstacles only, so errors at rest and walls remain."""
        return StepConfig(obstacle_clearance=self.obstacle_clearance)

    def require_fits(self, relative: bool, dimensions: int) -> None:
        """Raises ConfigError if a network with these inputs and dimensions does not support the constraints."""
        name, value = "step.rest_threshold", self.rest_threshold
        require(not self.rests or relative, name, "0 with inputs=absolute", value)
        require(not self.rests or dimensions == 3, name, "0 with dimensions=2", value)
        fits = self.obstacle_clearance is None or dimensions == 3
        require(fits, "step.obstacle_clearance", "null with dimensions=2", self.obstacle_clearance)


UNCONSTRAINED = StepConfig()
