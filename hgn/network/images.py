"""Images of scenes, turned by 180 degrees about y, in which simulations predict every second frame.

A network's sideways errors repeat in each frame and add up. So frame k is predicted in the image IMAGES[k mod 2] of the
scene, and the accelerations are turned back. A bias of the network then cancels over two frames, in scenes of any
symmetry. Training shows all images (hgn.scene.symmetry). The turn mirrors the axes x and z. A mirrored axis exchanges
the planes on which the walls of `step.wall_clearance` stop particles: x becomes domain + near - far - x. In backend
triton `show_image` writes the image of particles, and `advance` the sign of the next image.
Shape legend: N particles, S scenes, V rows of moving obstacles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from hgn.network.features import ParticleState
from hgn.network.obstacles import ObstacleCells
from hgn.step_config import StepConfig

IMAGES = ((1, 1, 1), (-1, 1, -1))  # signs of the axes; frames take them in turn, and frame 0 the first
MIRRORS = sum((sign < 0) << 3 * i + axis for i, image in enumerate(IMAGES) for axis, sign in enumerate(image))


@dataclass(frozen=True, eq=False)
class Image:
    """Maps x to sign x + shift in each scene. The map is its own inverse."""

    sign_S3: torch.Tensor
    shift_S3: torch.Tensor

    @staticmethod
    def of(state: ParticleState, step: StepConfig, dimensions: int) -> Image:
        """Returns the images of scenes at their frames. Unused axes are not mirrored."""
        near, far = step.wall_clearance or (0.0, 0.0)
        signs = [[sign if axis < dimensions else 1 for axis, sign in enumerate(image)] for image in IMAGES]
        sign_S3 = torch.tensor(signs, device=state.frame_S.device)[state.frame_S % len(IMAGES)].to(state.domain_S3)
        return Image(sign_S3, (sign_S3 < 0) * (state.domain_S3 + near - far))

    def places(self, position_N3: torch.Tensor, scene_N: torch.Tensor) -> torch.Tensor:
        """Returns the images of positions."""
        return self.sign_S3[scene_N] * position_N3 + self.shift_S3[scene_N]

    def shown(self, state: ParticleState) -> ParticleState:
        """Returns the image of a state. Its barriers are those of the scene."""
        sign_N3, moving = self.sign_S3[state.scene_N], state.moving
        if moving is not None:
            rows = moving.layers, 1
            poses = moving.poses.mirrored(self.sign_S3.repeat(rows), self.shift_S3.repeat(rows))
            moving = replace(moving, poses=poses)
        return replace(
            state,
            position_N3=self.places(state.position_N3, state.scene_N),
            velocity_NM3=sign_N3[:, None] * state.velocity_NM3,
            gravity_S3=self.sign_S3 * state.gravity_S3,
            obstacles=state.obstacles and ImageCells.seen(state.obstacles, self),
            moving=moving,
        )


@dataclass(frozen=True, eq=False)
class ImageCells(ObstacleCells):
    """The image of obstacle cells. Positions are looked up in the scene itself."""

    cells: ObstacleCells
    image: Image

    @staticmethod
    def seen(cells: ObstacleCells, image: Image) -> ImageCells:
        own = cells.key_K, cells.normal_K3, cells.cell_size, cells, image
        return ImageCells(*own, friction_K=cells.friction_K, distance_K=cells.distance_K)

    def surfaces(self, position_N3: torch.Tensor, scene_N: torch.Tensor) -> torch.Tensor:
        surface_NV = self.cells.surfaces(self.image.places(position_N3, scene_N), scene_N)
        return torch.cat([self.image.sign_S3[scene_N] * surface_NV[:, :3], surface_NV[:, 3:]], dim=-1)
