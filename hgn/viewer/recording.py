"""Records the frames of a scene that changes, for going back in time and for the rollout file.

Shape legend: N particles, M velocities of a history, T frames.
"""

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hgn.scene.motion import Motion
from hgn.scene.rollout_file import Rollout
from hgn.schema import Vector, require
from hgn.viewer.placed import PlacedObstacle

FRAME_BYTES, PLACE_BYTES = 300, 600  # of a frame without its arrays, and of a place of an obstacle
SAVED_BYTES = 24  # of a point in each frame of a rollout file: its position and velocity


@dataclass(frozen=True, eq=False)
class Frame:
    """Holds the content of a frame. Particles keep their order; those that enter later come after the earlier ones."""

    position_N3: np.ndarray  # float32, domain units
    velocity_N3: np.ndarray  # float32, domain units per frame
    obstacles: tuple[PlacedObstacle, ...]
    gravity: Vector

    @property
    def bytes(self) -> int:
        return self.position_N3.nbytes + self.velocity_N3.nbytes + FRAME_BYTES

    def bytes_before(self, after: "Frame") -> int:
        """Returns the bytes of places of obstacles that only this frame and earlier ones need."""
        return PLACE_BYTES * len({*self.obstacles} - {*after.obstacles})


class Recording:
    """Holds the last frames of a simulation within `limit_bytes`, but at least the frames of a velocity history."""

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes, self.bytes, self.first = limit_bytes, 0, 0
        self.frames: deque[Frame] = deque()
        # Each particle has the frame before its entry, its material, and its velocities up to this frame, newest first.
        self.entered_N = np.zeros(0, np.int64)
        self.material_N = np.zeros(0, np.uint8)
        self.entry_NM3 = np.zeros((0, 1, 3), np.float32)

    @property
    def last(self) -> int:
        """Returns the number of the newest frame."""
        return self.first + len(self.frames) - 1

    @property
    def earliest(self) -> int:
        """Returns the first frame whose velocity histories are known completely."""
        return 0 if self.first == 0 else self.first + self.entry_NM3.shape[1] - 1

    def enter(self, material_A: np.ndarray, velocity_AM3: np.ndarray) -> None:
        """Adds particles that appear first in the next frame."""
        behind = np.full(len(material_A), max(self.last, 0))
        self.entered_N = np.concatenate([self.entered_N, behind])
        self.material_N = np.concatenate([self.material_N, np.asarray(material_A, np.uint8)])
        old_NM3 = self.entry_NM3[:, : velocity_AM3.shape[1]]
        lacking = velocity_AM3.shape[1] - old_NM3.shape[1]  # entries that new weights with a longer history need
        old_NM3 = np.concatenate([old_NM3, np.repeat(old_NM3[:, -1:], lacking, axis=1)], axis=1)
        self.entry_NM3 = np.concatenate([old_NM3, velocity_AM3])

    def append(self, frame: Frame) -> None:
        """Adds the next frame, and drops old frames above the limit."""
        if self.frames:
            self.bytes += self.frames[-1].bytes_before(frame)
        self.frames.append(frame)
        self.bytes += frame.bytes
        while self.bytes > self.limit_bytes and len(self.frames) > self.entry_NM3.shape[1] + 1:
            oldest = self.frames.popleft()
            self.bytes -= oldest.bytes + oldest.bytes_before(self.frames[0])
            self.first += 1

    def __getitem__(self, frame: int) -> Frame:
        return self.frames[frame - self.first]

    def history(self, frame: int) -> np.ndarray:
        """Returns velocity histories of a frame, float32 [N, M, 3] in domain units per frame, newest first."""
        rule = f"between {self.earliest} and {self.last}, the frames that are kept"
        require(self.earliest <= frame <= self.last, "frame", rule, frame)
        count, length = len(self[frame].position_N3), self.entry_NM3.shape[1]
        history_NM3 = np.empty((count, length, 3), np.float32)
        for row in range(length):
            earlier = frame - row
            present = 0
            if earlier >= self.first:
                velocity_N3 = self[earlier].velocity_N3[:count]
                present = len(velocity_N3)
                history_NM3[:present, row] = velocity_N3
            later = np.arange(present, count)
            age = np.minimum(self.entered_N[later] - earlier, length - 1)
            history_NM3[present:, row] = self.entry_NM3[later, age]
        return history_NM3

    def back_to(self, frame: int) -> None:
        """Deletes all frames after `frame`, and the particles that entered in them."""
        while self.last > frame:
            newest = self.frames.pop()
            self.bytes -= newest.bytes + self.frames[-1].bytes_before(newest)
        count = len(self[frame].position_N3)
        self.entered_N, self.material_N = self.entered_N[:count], self.material_N[:count]
        self.entry_NM3 = self.entry_NM3[:count]

    def rollout(self, domain_size: Vector, frame_rate_hz: float, cell_size: float, source: dict[str, str]) -> Rollout:
        """Returns the newest frames, with the entry frame of each particle. Their file is within `limit_bytes`.

        All particles and obstacles count in all frames. An obstacle is at rest before its first and after its last
        place.
        """
        count = len(self.frames[-1].position_N3)
        vertices = {o.body: len(o.body.mesh.vertex_V3) for frame in self.frames for o in frame.obstacles}
        most = max(2, self.limit_bytes // (SAVED_BYTES * max(1, count + sum(vertices.values()))))
        frames = [*self.frames][-most:]
        position_TN3 = np.full((len(frames), count, 3), np.nan, np.float32)
        for position_N3, frame in zip(position_TN3, frames, strict=True):
            position_N3[: len(frame.position_N3)] = frame.position_N3
        entry_N = np.searchsorted([len(frame.position_N3) for frame in frames], np.arange(count), side="right")
        places: dict[int, list[tuple[int, PlacedObstacle]]] = {}
        for index, frame in enumerate(frames):
            for obstacle in frame.obstacles:
                path = places.setdefault(obstacle.body.number, [])
                if not path or path[-1][1] is not obstacle:
                    path.append((index, obstacle))
        return Rollout(
            position_TN3=position_TN3,
            material_N=self.material_N[:count],
            obstacles=tuple(path[0][1].mesh(_motion(path, frame_rate_hz)) for path in places.values()),
            domain_size=domain_size,
            frame_rate_hz=frame_rate_hz,
            gravity=self.frames[-1].gravity,
            cell_size=cell_size,
            source=dict(source),
            entry_frame_N=entry_N if entry_N.any() else None,
        )


def _motion(path: list[tuple[int, PlacedObstacle]], frame_rate_hz: float) -> Motion | None:
    """Returns an obstacle's motion through its places by frame, or None if all places are equal."""
    keys = {0: path[0][1]}
    for (_, before), (index, after) in pairwise(path):
        if (before.position, before.rotation) != (after.position, after.rotation):
            keys |= {index - 1: before, index: after}
    if len(keys) == 1:
        return None
    first = path[0][1]
    return Motion(
        np.array(list(keys), np.float64) / frame_rate_hz,
        np.array([np.subtract(place.position, first.position) for place in keys.values()]),
        np.stack([place.rotation_33 @ first.rotation_33.T for place in keys.values()]),
        first.position,
    )
