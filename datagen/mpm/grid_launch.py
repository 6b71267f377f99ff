"""Runs one substep of all scenes in a launch: on a CPU, and for a scene that is large enough for a whole GPU."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from datagen.mpm.device import Device
from datagen.mpm.launch import Launch, device_array, device_vectors
from datagen.mpm.layout import COUNT, STATUS, VALUE, VARIANT, has_solid

import taichi as ti  # isort: skip

from datagen.mpm import grid_kernel  # isort: skip

MAXIMUM_PARTS = 4  # largest number of copies of the grid on a CPU, one for each thread
SUBSTEPS_PER_CHECK = 64  # largest number of substeps between two checks; on a GPU each check waits for the device


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
        for frame in range(1, frames + 1):
            grid_kernel.begin_frame(self.frame_s, frame * self.frame_s, self.scene_value, self.counter)
            self._run_frame()
            self._enter(frame)
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

    def _run_frame(self) -> None:
        """Runs substeps until no scene has time left. The host checks only after the last estimate of their number."""
        pending = 1
        while pending:
            for _ in range(min(pending, SUBSTEPS_PER_CHECK)):
                grid_kernel.substep(
                    self.position, self.velocity, self.affine, self.deformation, self.volume, self.strained,
                    self.covered, self.spread, self.response, self.label, self.law_row, self.hidden, self.scene_value,
                    self.counter, self.setting, self.law, self.shape, self.node, self.gain, self.fallen, self.block,
                    self.contact, self.contact_normal, self.pose, self.variant,
                )  # fmt: skip
            value = self.scene_value.to_numpy()
            busy = value[:, VALUE.remaining] > 0
            pending = int(value[busy, VALUE.substeps_ahead].max()) if busy.any() else 0
