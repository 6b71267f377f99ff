"""Runs one substep of all scenes in a launch: on a CPU, and for a scene that is large enough for a whole GPU.

Shape legend: B scenes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from datagen.mpm.collider import MOVE_CELLS, build_collider
from datagen.mpm.device import Device
from datagen.mpm.launch import Launch, device_array, device_vectors
from datagen.mpm.layout import COUNT, STATUS, VALUE, VARIANT, has_solid
from hgn.scene.scene import Scene
from hgn.schema import require

import taichi as ti  # isort: skip

from datagen.mpm import grid_kernel  # isort: skip

MAXIMUM_PARTS = 4  # largest number of copies of the grid on a CPU, one for each thread
SUBSTEPS_PER_CHECK = 64  # largest number of substeps between two checks; on a GPU each check waits for the device
AT_REST = 1e-6  # fraction of MOVE_CELLS that is rounding
MAXIMUM_MOVE_CELLS = 100.0  # largest motion of an obstacle in a frame


def motion_cells(scenes: Sequence[Scene], begin: float, end: float) -> np.ndarray:
    """Returns how far the obstacles of each scene move in a frame at their largest speed, in cells, float64 [B].

    Raises: ConfigError if one moves more than MAXIMUM_MOVE_CELLS in the frame.
    """
    most = np.zeros(len(scenes))
    for index, scene in enumerate(scenes):
        for number, obstacle in enumerate(scene.obstacles):
            if obstacle.motion is None:
                continue
            # keyframes within the frame count, because an obstacle may move and return
            stops = obstacle.motion.keyframes_between(begin, end)
            way = 0.0
            for first, last in itertools.pairwise([begin, *stops, end]):
                turn, velocity, pivot = obstacle.motion.rates(first, last)
                arm = np.linalg.norm(obstacle.motion.place(obstacle.vertex_V3, first) - pivot, axis=1).max(initial=0.0)
                speed = float(np.linalg.norm(velocity) + np.linalg.norm(turn) * arm)
                way = max(way, speed * (end - begin) / scene.cell_size)
            require(
                way <= MAXIMUM_MOVE_CELLS,
                f"obstacles[{number}].keyframes of scene {index}",
                f"no faster than {MAXIMUM_MOVE_CELLS:g} cells a frame",
                f"{way:.4g} from {begin:.4g} s on",
                "give it more time",
            )
            most[index] = max(most[index], way)
    return most


def motion_parts(cells_B: np.ndarray) -> int:
    """Returns the number of parts of a frame in which no obstacle moves more than MOVE_CELLS; 0 if none moves."""
    return math.ceil(cells_B.max(initial=0.0) / MOVE_CELLS - AT_REST)


class GridLaunch(Launch):
    """Runs a batch substep by substep. A CPU sums in parts, a GPU with atomics."""

    def __init__(self, device: Device, *batch: Any) -> None:
        if device.kind == "cpu":
            self.parts = self.copies = min(device.threads, MAXIMUM_PARTS)
        super().__init__(*batch)
        self.variant += VARIANT.atomic * (device.kind == "cuda")
        self.position = device_vectors(np.concatenate([scene.position_N3 for scene in self.scenes]))
        self.velocity = device_vectors(np.concatenate([scene.velocity_N3 for scene in self.scenes]))
        self.affine = ti.Matrix.ndarray(3, 3, ti.f32, self.particles)
        self.deformation = ti.Matrix.ndarray(3, 3, ti.f32, self.particles if has_solid(self.variant) else 1)
        self.volume, self.covered = (ti.ndarray(ti.f32, self.particles) for _ in range(2))
        self.strained = device_array(np.full(self.particles, -1, np.float32))
        self.covered.fill(0)
        self.spread = device_array(np.zeros(self.particles, np.int32))
        self.response = ti.Matrix.ndarray(3, 3, ti.f32, self.particles)
        self.block = device_array(np.zeros(8 * self.all_blocks + 2, np.int32))
        self.age = device_array(np.zeros(self.rows, np.float32))
        grid_kernel.start(
            self.velocity, self.affine, self.deformation, self.volume, self.label, self.law_row, self.counter, self.law
        )

    def _node_array(self, nodes: int) -> ti.VectorNdarray:
        self.gain = ti.Vector.ndarray(4, ti.f32, nodes)
        self.gain.fill(0)
        self.fallen = ti.ndarray(ti.f32, nodes // self.copies)
        return ti.Vector.ndarray(4, ti.f32, nodes // self.copies)

    def _vector_arrays(self) -> list[Any]:
        own = [self.node, self.gain, self.position, self.velocity, self.affine, self.deformation, self.response]
        return super()._vector_arrays() + own

    def _advance(self, frames: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        completed = np.zeros(len(self.scenes), np.int64)
        moved_B = np.zeros(len(self.scenes), bool)
        for frame in range(frames):
            cells_B = motion_cells(self.scenes, frame * self.frame_s, (frame + 1) * self.frame_s)
            parts, moves_B = max(motion_parts(cells_B), 1), cells_B > AT_REST * MOVE_CELLS
            built_B = np.zeros(len(self.scenes), np.int64)  # the part in which contacts were built
            for part in range(parts):
                time_s, end_s = ((frame + number / parts) * self.frame_s for number in (part, part + 1))
                old_B = self._outdated((frame + built_B / parts) * self.frame_s, end_s)
                old_B |= cells_B * (part + 1 - built_B) > MOVE_CELLS * parts
                old_B = moves_B & (old_B | (part == 0)) | moved_B
                if old_B.any():
                    self._move(old_B, time_s, end_s)
                moved_B[:] = False
                built_B = np.where(old_B | ~moves_B, part, built_B)
                if self.moving:
                    age_s = np.zeros(self.rows, np.float32)
                    age_s[: len(self.scenes)] = (part - built_B) * (self.frame_s / parts)
                    self.age.from_numpy(age_s)
                grid_kernel.begin_part(self.frame_s / parts, self.age, int(part == 0), self.scene_value, self.counter)
                self._run_part()
            moved_B = moves_B
            self._enter(frame + 1)
            completed += self.counter.to_numpy()[: len(self.scenes), COUNT.status] == STATUS.running
            yield self.position.to_numpy()[None], completed

    def _enter(self, frame: int) -> None:
        """Adds the particles that are present for the first time in a frame to their scenes."""
        which = np.flatnonzero(self.entry_frame == frame)
        if len(which):
            grid_kernel.enter(
                device_array(which.astype(np.int32)), device_array(self.own_label), self.velocity, self.label,
                self.law_row, self.scene_value, self.counter, self.setting, self.law,
            )  # fmt: skip

    def _outdated(self, begin_s_B: np.ndarray, end_s: float) -> np.ndarray:
        """Returns the scenes with a keyframe between two times, bool [B]: contacts move with constant velocity."""
        return np.array(
            [
                any(
                    len(obstacle.motion.keyframes_between(begin_s, end_s))
                    for obstacle in scene.obstacles
                    if obstacle.motion is not None
                )
                for scene, begin_s in zip(self.scenes, begin_s_B, strict=True)
            ]
        )

    def _move(self, which_B: np.ndarray, begin: float, end: float) -> None:
        """Rebuilds the contacts of scenes in their poses at `begin`. They move as between the two times."""
        band_cells = self.config.choices.collider_band_cells
        self.colliders = list(self.colliders)
        for index in np.flatnonzero(which_B).tolist():
            self.colliders[index] = build_collider(self.scenes[index], band_cells, begin)
            self.spans[index] = begin, end
        self.ghosts = sum(int(collider.doubled_K.sum()) for collider in self.colliders)
        ti.lang.impl.get_runtime().prog.delete_ndarray(self.contact_normal.arr)
        self._place_contacts()

    def _run_part(self) -> None:
        """Runs substeps until no scene has time left. The host checks only after the last estimate of their number."""
        pending = 1
        while pending:
            for _ in range(min(pending, SUBSTEPS_PER_CHECK)):
                grid_kernel.substep(
                    self.position, self.velocity, self.affine, self.deformation, self.volume, self.strained,
                    self.covered, self.spread, self.response, self.label, self.law_row, self.hidden, self.scene_value,
                    self.counter, self.setting, self.law, self.shape, self.node, self.gain, self.fallen, self.block,
                    self.contact, self.contact_normal, self.variant,
                )  # fmt: skip
            value = self.scene_value.to_numpy()
            busy = value[:, VALUE.remaining] > 0
            pending = int(value[busy, VALUE.substeps_ahead].max()) if busy.any() else 0
