"""Holds obstacles in motion on the device: cells and barriers in coordinates that move with them, and poses.

hgn.kernels.poses defines the records. An instant is a frame of a simulation or an update of a training.
Shape legend: T instants, S scenes, J most moving obstacles of a scene, V = J S rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import triton

from hgn.config import NetworkConfig
from hgn.kernels.poses import FIRST_POSE, ROW_COLUMNS
from hgn.kernels.scene_tables import OBSTACLE_COLUMNS, SceneHash, SceneTable
from hgn.network.moving import MovingObstacles, poses_of
from hgn.scene.moving import MovingObstacle
from hgn.scene.symmetry import Symmetry


@dataclass(frozen=True, eq=False)
class EpisodeMoving:
    """Holds the moving obstacles of an episode for updates, with their hashes."""

    obstacles: tuple[MovingObstacle, ...] = ()
    hashes: tuple[SceneHash | None, ...] = ()
    frame_s: float = 0.0

    @staticmethod
    def of(
        obstacles: tuple[MovingObstacle, ...], frame_s: float, network: NetworkConfig, device: torch.device
    ) -> "EpisodeMoving":
        """Returns the obstacles as `network` sees them."""
        grids = (obstacle.surfaces(network.obstacle_distance) for obstacle in obstacles)
        hashes = (SceneHash.of_grid(grid, "friction" in network.own_physics) for grid in grids)
        return EpisodeMoving(obstacles, tuple(own and own.to(device) for own in hashes), frame_s)


NONE_MOVES = EpisodeMoving()


class MovingTable:
    """Holds the records of the moving obstacles of several instants."""

    def __init__(self, instant: torch.Tensor, instants: int, scenes: int, layers: int, cell_size: float) -> None:
        """Takes the number of the instant, int32 [1]. `layers`, the largest J, is rounded up to a power of two."""
        self.instant, self.scenes, self.cell_size = instant, scenes, cell_size
        self.layers = triton.next_power_of_2(layers)
        shape = instants, scenes * self.layers, ROW_COLUMNS
        self.record_TVR = torch.zeros(shape, dtype=torch.int64, device=instant.device)
        self._alive: list[Any] = []  # cells and barriers, and their tables, whose addresses the records contain

    def fits(self, moving: MovingObstacles) -> bool:
        """Returns whether there are records for all obstacles."""
        same = moving.cell_size == self.cell_size and len(moving.scenes) == self.scenes
        return same and moving.layers <= self.layers

    def take(self, moving: MovingObstacles | None, friction: bool) -> None:
        """Writes the cells and barriers of obstacles to all instants, with `friction` that of cells too."""
        cells, barriers = (None, None) if moving is None else (moving.cells, moving.barriers)
        if self._alive and self._alive[0] is cells and self._alive[1] is barriers:
            return
        self.record_TVR.zero_()
        self._alive, tables, rows = [cells, barriers], {}, 0 if moving is None else len(moving.poses.place_V3)
        if cells is not None:
            tables[0] = SceneTable.of_obstacles(cells, rows, friction)
        if barriers is not None:
            tables[OBSTACLE_COLUMNS] = SceneTable.of_barriers(barriers, rows, self.instant.device)
        for first, table in tables.items():
            self.record_TVR[:, :rows, first : first + table.row_SC.shape[1]] = table.row_SC
        self._alive += tables.values()

    def write(self, samples: Sequence[tuple[EpisodeMoving, int]], symmetries: Sequence[Symmetry]) -> None:
        """Writes the images of samples, which are obstacles in a frame: an instant for the scenes of each update."""
        own, instants = [moving.obstacles for moving, _ in samples], len(samples) // self.scenes
        row_TVO = np.zeros((instants, self.record_TVR.shape[1], OBSTACLE_COLUMNS), np.int64)
        for number, ((moving, _), symmetry) in enumerate(zip(samples, symmetries, strict=True)):
            instant, scene = divmod(number, self.scenes)
            for row_O, cells in zip(row_TVO[instant, scene :: self.scenes], moving.hashes, strict=False):
                row_O[:] = 0 if cells is None else [*cells.row()[:-1], symmetry.code]
        self.record_TVR[:instants, :, :OBSTACLE_COLUMNS].copy_(torch.from_numpy(row_TVO))
        if any(own):
            frame_s = max(moving.frame_s for moving, _ in samples)
            self.set_poses(0, own, [frame for _, frame in samples], frame_s, symmetries)

    def set_poses(
        self,
        first: int,
        scenes: Sequence[Sequence[MovingObstacle]],
        frames: Sequence[int],
        frame_s: float,
        symmetries: Sequence[Symmetry] = (),
    ) -> None:
        """Writes the poses, or their images, of instant `first` and later ones. An instant has `self.scenes` scenes."""
        poses, layers = poses_of(scenes, frames, frame_s), max(map(len, scenes))
        poses = poses.under([*symmetries] * layers) if symmetries else poses
        parts = [poses.rotation_V33.flatten(1), poses.place_V3, poses.pivot_V3, poses.change_V33.flatten(1)]
        parts += [poses.shift_V3, poses.later.rotation_V33.flatten(1), poses.later.place_V3, 0 * poses.shift_V3[:, :1]]
        pose_JTSP = torch.cat(parts, 1).float().unflatten(0, (layers, -1, self.scenes))
        pose_TVP = pose_JTSP.transpose(0, 1).flatten(1, 2)
        if self.instant.device.type == "cuda":
            pose_TVP = pose_TVP.pin_memory()
        rows = self.record_TVR.view(torch.float32)[first : first + len(pose_TVP), : pose_TVP.shape[1], 2 * FIRST_POSE :]
        rows.copy_(pose_TVP, non_blocking=True)


def arguments_of(table: MovingTable | None, nothing: torch.Tensor) -> dict[str, Any]:
    """Returns arguments of kernels. Without a table they are `nothing`, which kernels do not read."""
    record, at, scenes = (nothing, nothing, 0) if table is None else (table.record_TVR, table.instant, table.scenes)
    return {"moving": record, "poses": record.view(torch.float32), "instant": at, "scenes": scenes}
