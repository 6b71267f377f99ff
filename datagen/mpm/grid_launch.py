"""One substep of all scenes a launch: the way on a CPU, and for a scene so large that it fills a GPU by itself."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from datagen.mpm.device import Device
from datagen.mpm.launch import Launch, device_array, device_vectors
from datagen.mpm.layout import COUNT, STATUS, VALUE, VARIANT, has_solid

import taichi as ti  # isort: skip

from datagen.mpm import grid_kernel  # isort: skip

MAXIMUM_PARTS = 4  # copies of the grid on a CPU, one a thread
SUBSTEPS_PER_CHECK = 64  # at most; on a GPU each check waits for the device


class GridLaunch(Launch):
    """Particles in arrays of vectors and matrices; a CPU sums in parts, a GPU with atomics."""

    def __init__(self, device: Device, *batch: Any) -> None:
        if device.kind == "cpu":
            self.parts = self.copies = min(device.threads, MAXIMUM_PARTS)
        super().__init__(*batch)
        self.variant += VARIANT.atomic * (device.kind == "gpu")
        self.position = device_vectors(np.concatenate([scene.position_N3 for scene in self.scenes]))
        self.velocity = device_vectors(np.concatenate([scene.velocity_N3 for scene in self.scenes]))
        self.affine = ti.Matrix.ndarray(3, 3, ti.f32, self.particles)
        self.deformation = ti.Matrix.ndarray(3, 3, ti.f32, self.particles if has_solid(self.variant) else 1)
        self.volume = ti.ndarray(ti.f32, self.particles)
        self.block = device_array(np.zeros(3 * self.all_blocks + 2, np.int32))
        grid_kernel.start(
            self.velocity, self.affine, self.deformation, self.volume, self.label, self.law_row, self.counter,
            self.law,
        )  # fmt: skip

    def _node_array(self, nodes: int) -> ti.VectorNdarray:
        self.gain = ti.Vector.ndarray(4, ti.f32, nodes)
        self.gain.fill(0)
        return ti.Vector.ndarray(4, ti.f32, nodes // self.copies)

    def _vector_arrays(self) -> list[Any]:
        own = [self.node, self.gain, self.position, self.velocity, self.affine, self.deformation]
        return super()._vector_arrays() + own

    def _advance(self, frames: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        completed = np.zeros(len(self.scenes), np.int64)
        for _ in range(frames):
            grid_kernel.begin_frame(self.frame_s, self.scene_value, self.counter)
            self._run_frame()
            completed += self.counter.to_numpy()[:, COUNT.status] == STATUS.running
            yield self.position.to_numpy()[None], completed

    def _run_frame(self) -> None:
        """Substeps until no scene has time left; the host looks only when the last estimate has run out."""
        pending = 1
        while pending:
            for _ in range(min(pending, SUBSTEPS_PER_CHECK)):
                grid_kernel.substep(
                    self.position, self.velocity, self.affine, self.deformation, self.volume, self.label,
                    self.law_row, self.hidden, self.scene_value, self.counter, self.setting, self.law, self.shape,
                    self.node, self.gain, self.block, self.contact, self.contact_normal, self.variant,
                )  # fmt: skip
            value = self.scene_value.to_numpy()
            busy = value[:, VALUE.remaining] > 0
            pending = int(value[busy, VALUE.substeps_ahead].max()) if busy.any() else 0
