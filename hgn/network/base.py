"""The common parts of all particle networks: features, their normalisation, and the encoder (paper sec. 3.1).

Shape legend: N particles, W width, S scenes.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import nn

from hgn.config import MATERIAL_EMBEDDING, NetworkConfig
from hgn.network.features import WALL_DISTANCE_CELLS, Normaliser, ParticleState
from hgn.network.grid import GridHierarchy
from hgn.network.mlp import LEAKY_SLOPE, MLP
from hgn.network.own_physics import physics_columns, physics_widths
from hgn.network.relative import Contacts, relative_features
from hgn.step_config import UNCONSTRAINED, StepConfig


@dataclass(frozen=True, eq=False)
class Prediction:
    """A network's raw output: normalised accelerations [N, 3]. With relative inputs they do not contain gravity.

    With relative inputs a prediction also contains the contacts and the grid of its computation.
    """

    acceleration_N3: torch.Tensor
    contacts: Contacts | None = None
    grid: GridHierarchy | None = None


class ParticleNetwork(nn.Module, ABC):
    """Predicts the acceleration of every particle, in frame units.

    `step` contains the constraints of its frames. Simulations apply them (hgn.step), the network does not.
    """

    def __init__(self, config: NetworkConfig, slope: float = LEAKY_SLOPE) -> None:
        super().__init__()
        self.config = config
        self.step: StepConfig = UNCONSTRAINED
        self.normaliser = Normaliser()
        self.embedding = nn.Embedding(len(config.materials), MATERIAL_EMBEDDING)
        normal_width = 3 if config.obstacle_features else 0
        parts: tuple[int, ...] = (3 * config.velocity_history, normal_width, 6, MATERIAL_EMBEDDING)
        if config.relative:
            own = (sum(physics_widths(config)),) if any(physics_widths(config)) else ()
            parts = (config.feature_width - MATERIAL_EMBEDDING, MATERIAL_EMBEDDING, *own)
        self.encode = MLP(parts, config.width, config.width, slope=slope)

    @property
    def parameter_count(self) -> int:
        return sum(parameter.numel() for parameter in self.parameters())

    def forward(self, state: ParticleState, origin_S3: torch.Tensor | None = None) -> torch.Tensor:
        """Returns accelerations in frame units [N, 3]."""
        return self.restored_acceleration(self.normalised_acceleration(state, origin_S3), state)

    def restored_acceleration(self, normalised_N3: torch.Tensor, state: ParticleState) -> torch.Tensor:
        """Returns accelerations in frame units from the raw output. With relative inputs gravity is added."""
        acceleration_N3 = self.normaliser.restore_acceleration(normalised_N3)
        return acceleration_N3 + state.gravity_S3[state.scene_N] if self.config.relative else acceleration_N3

    def target(self, acceleration_N3: torch.Tensor, gravity_N3: torch.Tensor) -> torch.Tensor:
        """Returns the raw output for accelerations and gravity in frame units: inverts `restored_acceleration`."""
        return self.normaliser.normalise_acceleration(
            acceleration_N3 - gravity_N3 if self.config.relative else acceleration_N3
        )

    @abstractmethod
    def normalised_acceleration(self, state: ParticleState, origin_S3: torch.Tensor | None = None) -> torch.Tensor:
        """Returns the network's raw output [N, 3], which the loss compares with the normalised target.

        `origin_S3` is the origin of the grid in each scene. It has no effect on a network without a grid.
        """

    def prediction(self, state: ParticleState, origin_S3: torch.Tensor | None = None) -> Prediction:
        """Returns the raw output, and the contacts that the rest constraint needs."""
        return Prediction(self.normalised_acceleration(state, origin_S3))

    def relative_features(self, state: ParticleState, grid: GridHierarchy) -> tuple[torch.Tensor, Contacts]:
        """Returns all columns except those of the material and of own physics, and the contacts of coarsest cells."""
        return relative_features(state, grid, self.config, self.normaliser.acceleration_std[0])

    def encode_features(self, feature_NF: torch.Tensor, state: ParticleState, contacts: Contacts) -> torch.Tensor:
        """Returns latent vectors [N, W] of relative features and own physics. Own physics that is all 0 is skipped."""
        material_MH = self.encode.project(1, self.embedding.weight) + self.encode.first.bias
        hidden_NH = self.encode.add_projection(material_MH.index_select(0, state.material_N), 0, feature_NF)
        scale = self.normaliser.acceleration_std[0]
        for physics_NK in physics_columns(state, self.config, contacts.friction, scale):
            hidden_NH = self.encode.add_projection(hidden_NH, 2, physics_NK)
        return self.encode.finish(hidden_NH)

    def encode_particles(self, state: ParticleState, grid: GridHierarchy | None = None) -> torch.Tensor:
        """Returns latent vectors [N, W] of the particles (sec. 3.2, step 0). Relative inputs require the grid.

        If no scene has an obstacle, the product with the zero normals is skipped.
        """
        if self.config.relative:
            assert grid is not None
            feature_NF, contacts = self.relative_features(state, grid)
            return self.encode_features(feature_NF, state, contacts)
        velocity_NV = self.normaliser.normalise_velocity(state.velocity_NM3).flatten(1)
        farthest = WALL_DISTANCE_CELLS * self.config.cell_size
        beyond_N3 = state.domain_S3[state.scene_N] - state.position_N3
        wall_N6 = torch.cat([state.position_N3, beyond_N3], dim=-1).clamp(-farthest, farthest) / farthest
        material_MH = self.encode.project(3, self.embedding.weight) + self.encode.first.bias
        hidden_NH = material_MH.index_select(0, state.material_N)
        self.encode.add_projection(hidden_NH, 0, velocity_NV)
        self.encode.add_projection(hidden_NH, 2, wall_N6)
        if self.config.obstacle_features and state.obstacles is not None:
            normal_N3 = state.obstacles.normals(state.position_N3, state.scene_N)
            self.encode.add_projection(hidden_NH, 1, normal_N3)
        return self.encode.finish(hidden_NH)
