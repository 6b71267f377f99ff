"""Particle features (paper sec. 3.1) and their normalisation.

f_i = (v^n … v^{n-m+1}, n_o, d, e):

    v    velocities in frame units, normalised per axis
    n_o  normal of the particle's obstacle cell
    d    distances to the domain's six planes, clamped to d_max and divided by it
    e    learned embedding of the material

Shape legend: N particles, m velocities, S scenes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import nn

from hgn.network.barriers import Barriers
from hgn.network.elastic import RestShape
from hgn.network.moving import MovingObstacles
from hgn.network.obstacles import ObstacleCells
from hgn.scene.material import MATERIALS
from hgn.schema import ConfigError

WALL_DISTANCE_CELLS = 8.0  # d_max / R of the paper
# Standard deviation of accelerations along an unused axis: as a factor too small to move particles, as a divisor not 0.
STILL = 1e-30


@dataclass(frozen=True, eq=False)
class ParticleState:
    """The particles of a batch of scenes: the input of a network."""

    position_N3: torch.Tensor  # domain units
    velocity_NM3: torch.Tensor  # displacement per frame, newest first
    material_N: torch.Tensor  # int64, index into the network's materials
    scene_N: torch.Tensor  # int64, index of the particle's scene
    domain_S3: torch.Tensor  # domain size of each scene
    gravity_S3: torch.Tensor  # gravity of each scene, domain units per frame squared
    obstacles: ObstacleCells | None
    barriers: Barriers | None = None  # triangles of obstacles; only with step.obstacle_clearance
    wall_friction_S3: torch.Tensor | None = None  # friction of the walls normal to x, y, z; None: 0, or no input
    parameter_NP: torch.Tensor | None = None  # columns of hgn.network.own_physics; None: 0, or no input
    rest: RestShape | None = None  # rest shape of elastic bodies; None: no such bodies, or no input
    moving: MovingObstacles | None = None  # moving obstacles; `obstacles` and `barriers` contain those at rest
    frame_S: torch.Tensor = None  # type: ignore[assignment]  # int64, frames computed before; None becomes 0

    def __post_init__(self) -> None:
        if self.frame_S is None:
            zero_S = torch.zeros_like(self.domain_S3[:, 0], dtype=torch.int64)
            object.__setattr__(self, "frame_S", zero_S)

    @property
    def scene_count(self) -> int:
        return len(self.domain_S3)

    def selected(self, rows_N: torch.Tensor | slice) -> "ParticleState":
        """Returns the state with some of the particles. Scenes keep their numbers."""
        names = ("position_N3", "velocity_NM3", "material_N", "scene_N", "parameter_NP", "rest")
        some: dict[str, Any] = {name: value[rows_N] for name in names if (value := getattr(self, name)) is not None}
        return replace(self, **some)


class Normaliser(nn.Module):
    """Mean and standard deviation per axis of velocity and acceleration, in frame units.

    Training noise is added to the standard deviations in quadrature, as in GNS's code (Sanchez-Gonzalez et al. 2020).
    """

    velocity_mean: torch.Tensor
    velocity_std: torch.Tensor
    acceleration_mean: torch.Tensor
    acceleration_std: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        for quantity in ("velocity", "acceleration"):
            self.register_buffer(f"{quantity}_mean", torch.zeros(3))
            self.register_buffer(f"{quantity}_std", torch.ones(3))

    def set(
        self, quantity: str, mean_3: torch.Tensor, std_3: torch.Tensor, noise_std: float, dimensions: int = 3
    ) -> None:
        """Sets `velocity` or `acceleration` from the data's statistics. The smallest standard deviation is 1e-9.

        Unused axes (`dimensions` and above) get STILL. Output along them moves particles by less than rounding.
        """
        getattr(self, f"{quantity}_mean").copy_(mean_3)
        total_3 = torch.sqrt(std_3.double() ** 2 + noise_std**2).clamp(min=1e-9)
        getattr(self, f"{quantity}_std").copy_(total_3)
        getattr(self, f"{quantity}_mean")[dimensions:] = 0.0
        getattr(self, f"{quantity}_std")[dimensions:] = 1.0 if quantity == "velocity" else STILL

    def set_isotropic(self, acceleration_std_3: torch.Tensor, noise_std: float, dimensions: int = 3) -> None:
        """Sets the normaliser for relative inputs: zero means and one scale, the rms over the axes, noise included."""
        for quantity in ("velocity", "acceleration"):
            scale = acceleration_std_3[:dimensions].double().square().mean().sqrt().expand(3)
            self.set(quantity, torch.zeros(3), scale, noise_std, dimensions)

    def feature_scale(self, relative: bool) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns mean and standard deviation [3] of velocity features. Relative inputs use those of accelerations."""
        quantity = "acceleration" if relative else "velocity"
        return getattr(self, f"{quantity}_mean"), getattr(self, f"{quantity}_std")

    def normalise_velocity(self, velocity: torch.Tensor) -> torch.Tensor:
        return (velocity - self.velocity_mean) / self.velocity_std

    def normalise_acceleration(self, acceleration: torch.Tensor) -> torch.Tensor:
        return (acceleration - self.acceleration_mean) / self.acceleration_std

    def restore_acceleration(self, normalised: torch.Tensor) -> torch.Tensor:
        return normalised * self.acceleration_std + self.acceleration_mean


def material_rows(material_N: np.ndarray, materials: Sequence[str], names: Sequence[str] = MATERIALS) -> torch.Tensor:
    """Converts indices into `names` to indices into a network's material list, int64 [N].

    Raises: ConfigError for a material that the network was not trained with.
    """
    row = [materials.index(name) if name in materials else -1 for name in names]
    rows_N = np.asarray(row, np.int64)[material_N]
    if (rows_N < 0).any():
        unknown = names[int(material_N[rows_N < 0][0])]
        raise ConfigError(
            f"material must be one of the training data's ({', '.join(materials)}), got {unknown}; "
            "use weights that were trained with it, for example own_physics"
        )
    return torch.from_numpy(rows_N)
