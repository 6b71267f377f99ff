"""Symmetry augmentation on backend torch: applies a symmetry to each scene of a batch, on the batch's device.

Shape legend: W window frames, N particles, K obstacle cells, S scenes.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch

from hgn.data.batch import Batch
from hgn.network.cell_keys import pack, unpack
from hgn.network.moving import MovingObstacles
from hgn.network.obstacles import ObstacleCells
from hgn.scene.symmetry import Symmetry, drawn_symmetry


def drawn_symmetries(batch: Batch) -> list[Symmetry]:
    """Returns a symmetry for each scene, drawn from its sample's seed."""
    return [drawn_symmetry(own, seed) for own, seed in zip(batch.symmetries_S, batch.seeds_S, strict=True)]


def under_symmetries(batch: Batch, symmetries: Sequence[Symmetry]) -> Batch:
    """Returns a copy of the batch with the images of its scenes. Domains do not change."""
    scene_S, friction_S3 = torch.arange(len(symmetries), device=batch.scene_N.device), batch.wall_friction_S3
    return replace(
        batch,
        window_WN3=_points(batch.window_WN3, batch.scene_N, symmetries),
        gravity_S3=_vectors(batch.gravity_S3, scene_S, symmetries),
        obstacles=batch.obstacles and obstacles_under(batch.obstacles, symmetries),
        moving=batch.moving and moving_under(batch.moving, symmetries),
        wall_friction_S3=None if friction_S3 is None else friction_S3.gather(-1, _axes(symmetries, scene_S)[0]),
    )


def obstacles_under(obstacles: ObstacleCells, symmetries: Sequence[Symmetry]) -> ObstacleCells:
    """Returns cells and normals of the images. Cell k becomes n - 2 - k on a mirrored axis with n nodes of the solver.

    A particle exactly on a face belongs to the cell above it, also in the image.
    """
    scene_K, cell_K3 = unpack(obstacles.key_K)
    source_K3, mirrored_K3 = _axes(symmetries, scene_K)
    last_S3 = torch.tensor([s.cells for s in symmetries], device=scene_K.device) - 1
    cell_K3 = cell_K3.gather(-1, source_K3)
    key_K = pack(scene_K, torch.where(mirrored_K3, last_S3[scene_K] - cell_K3, cell_K3))
    normal_K3 = _vectors(obstacles.normal_K3, scene_K, symmetries)
    order_K = torch.argsort(key_K)
    own = {name: getattr(obstacles, name) for name in ("friction_K", "distance_K")}
    values = {name: value_K[order_K] for name, value_K in own.items() if value_K is not None}
    return replace(obstacles, key_K=key_K[order_K], normal_K3=normal_K3[order_K], **values)


def moving_under(moving: MovingObstacles, symmetries: Sequence[Symmetry]) -> MovingObstacles:
    """Returns the images of moving obstacles in their frame. Later frames are not images."""
    rows = [*symmetries] * moving.layers
    return replace(moving, cells=moving.cells and obstacles_under(moving.cells, rows), poses=moving.poses.under(rows))


def _points(point_N3: torch.Tensor, scene_N: torch.Tensor, symmetries: Sequence[Symmetry]) -> torch.Tensor:
    """Returns the images of positions […, N, 3]."""
    source_N3, mirrored_N3 = _axes(symmetries, scene_N)
    sum_S3 = torch.tensor([s.mirror_sum for s in symmetries], dtype=torch.float64).to(point_N3)
    point_N3 = point_N3.gather(-1, source_N3.expand(point_N3.shape))
    return torch.where(mirrored_N3, sum_S3[scene_N] - point_N3, point_N3)


def _vectors(vector_N3: torch.Tensor, scene_N: torch.Tensor, symmetries: Sequence[Symmetry]) -> torch.Tensor:
    """Returns the images of directions [N, 3]."""
    source_N3, mirrored_N3 = _axes(symmetries, scene_N)
    vector_N3 = vector_N3.gather(-1, source_N3)
    return torch.where(mirrored_N3, -vector_N3, vector_N3)


def _axes(symmetries: Sequence[Symmetry], scene_N: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the source axis of each coordinate and whether it is mirrored, [N, 3]."""
    source_S3 = torch.tensor([s.source for s in symmetries], device=scene_N.device)
    mirrored_S3 = torch.tensor([s.mirrored for s in symmetries], device=scene_N.device)
    return source_S3[scene_N], mirrored_S3[scene_N]
