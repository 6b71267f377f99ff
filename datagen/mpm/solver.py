"""Simulates batches of scenes: MLS-MPM with water, sand, snow and mesh obstacles, on a CPU or a CUDA device.

The method is the paper's simulator, Taichi Elements, with the corrections that hgn.config.MpmConfig names.
Shape legend: T frames, N particles of a scene, B scenes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from datagen.mpm.collider import BOTH_SIDES, Collider, build_collider
from datagen.mpm.device import Device, initialise
from datagen.mpm.layout import (
    BLOCK,
    BLOCK_NODES,
    CONSTANT,
    COUNT,
    REPORTED,
    SETTING,
    SHAPE,
    STATUS,
    VALUE,
    VARIANT,
    constants,
    lame_parameters,
)
from hgn.config import MpmConfig
from hgn.scene.material import SAND, SNOW, WATER
from hgn.scene.scene import Scene
from hgn.schema import ConfigError, require

import taichi as ti  # isort: skip  # after datagen.mpm.device, which keeps its banner off stdout

from datagen.mpm import kernels  # isort: skip

MAXIMUM_PARTS = 4  # copies of the grid on a CPU, one a thread
SUBSTEPS_PER_CHECK = 64  # at most; on a GPU each check waits for the device
CELL_TOLERANCE = 1e-3  # of a cell that a domain may be longer or shorter than whole cells

__all__ = ["SceneFailure", "Simulated", "initialise", "simulate"]


@dataclass(frozen=True, eq=False)
class Simulated:
    """One scene's trajectory."""

    position_TN3: np.ndarray  # float32, domain units; frame 0 is the initial state, bitwise
    counters: dict[str, Any]  # JSON-able: substeps, smallest_time_step_s, floors hit


@dataclass(frozen=True)
class SceneFailure:
    """A scene that was stopped; the others of its batch went on, unaffected."""

    cause: str


def simulate(
    scenes: Sequence[Scene],
    config: MpmConfig,
    frames: int,
    frame_rate_hz: float,
    on_frame: Callable[[int], None] | None = None,
    cpu_threads: int | None = None,
) -> list[Simulated | SceneFailure]:
    """Simulates `scenes` side by side and returns `frames` frames of each, the initial state among them.

    The scenes may differ in particles, materials, obstacles and gravity, but share domain and cell size. With
    an adaptive time step each scene takes its own steps: min(stability_fraction dx sqrt(rho / (3 lambda_h +
    2 mu_h)), speed_fraction dx / |v|max), spread evenly over what is left of the frame. A fixed time step is
    taken ceil(frame / step) times a frame in full, as Taichi Elements does: 54 times at 60 Hz and 3.125e-4 s,
    which is 1.25 % more than the frame. `on_frame(t)` is called when frame t of all scenes is complete, from 0.
    `cpu_threads` counts from the process's first simulation; see `initialise`.

    On a CPU the result of a scene is the same, bitwise, whatever its batch mates do, and depends on
    `cpu_threads` only through the number of parts that particles are summed in, min(cpu_threads, 4). On a GPU
    sums are in no fixed order.

    A scene that turns non-finite, leaves the domain or needs more than `maximum_substeps_per_frame` ends as a
    SceneFailure with cause and frame. A scene without particles gives [frames, 0, 3].

    Raises: ConfigError for scenes that do not share a grid, particles outside the walls, obstacles that are
    not finite, fewer than one frame, or a device that is not there.
    """
    require(frames >= 1, "frames", "at least 1", frames)
    require(frame_rate_hz > 0 and math.isfinite(frame_rate_hz), "frame_rate_hz", "a finite number > 0", frame_rate_hz)
    if not scenes:
        return []
    node_counts = _shared_grid(scenes, config)
    low, high = particle_bounds(scenes[0], config)
    for index, scene in enumerate(scenes):
        _require_sound(scene, index, low, high)
    colliders = [build_collider(scene, config.collider_band_cells) for scene in scenes]

    device = initialise(config.device, cpu_threads)
    occupied = [index for index, scene in enumerate(scenes) if scene.particle_count]
    results: list[Simulated | SceneFailure] = [
        Simulated(np.empty((frames, 0, 3), np.float32), _no_counters()) for _ in scenes
    ]
    if occupied:
        launch = _Launch([scenes[i] for i in occupied], [colliders[i] for i in occupied], config, node_counts, device)
        try:
            outcomes = launch.run(frames, frame_rate_hz, on_frame)
        finally:
            launch.release()
        for index, outcome in zip(occupied, outcomes, strict=True):
            results[index] = outcome
    elif on_frame is not None:
        for frame in range(frames):
            on_frame(frame)
    return results


def particle_bounds(scene: Scene, config: MpmConfig) -> tuple[np.ndarray, np.ndarray]:
    """The smallest and largest coordinates that particles may have, float32 [3] each, domain units.

    Beyond them all nodes of a particle are wall nodes, or lie outside the grid.
    """
    nodes = np.array([round(length / scene.cell_size) for length in scene.domain_size])
    low = np.full(3, (config.wall_cells - 1.5) * scene.cell_size)
    high = np.minimum(nodes - config.wall_cells + 0.5, nodes - 1.5) * scene.cell_size
    # a rounding inside, so that the scaled coordinate cannot round to the next base node
    return (low * (1 + 1e-6)).astype(np.float32), (high * (1 - 1e-6)).astype(np.float32)


def fixed_substeps(config: MpmConfig, frame_rate_hz: float) -> int:
    """Substeps a frame of a fixed time step: as many as it takes to reach the frame's end."""
    return max(1, math.ceil(1 / (frame_rate_hz * config.fixed_time_step_s) - 1e-6))


def _shared_grid(scenes: Sequence[Scene], config: MpmConfig) -> tuple[int, int, int]:
    first = scenes[0]
    require(first.cell_size > 0 and math.isfinite(first.cell_size), "cell_size", "a finite number > 0", first.cell_size)
    for index, scene in enumerate(scenes):
        for name in ("domain_size", "cell_size"):
            if getattr(scene, name) != getattr(first, name):
                raise ConfigError(
                    f"{name} must be the same in all scenes of a batch, got {getattr(scene, name)} in scene {index} "
                    f"and {getattr(first, name)} in scene 0; simulate them apart"
                )
    counts = []
    for axis, length in zip("xyz", first.domain_size, strict=True):
        cells = length / first.cell_size
        require(
            math.isfinite(cells) and abs(cells - round(cells)) <= CELL_TOLERANCE,
            f"domain_size ({axis})",
            f"a whole number of cells of {first.cell_size}",
            length,
        )
        smallest = 2 * config.wall_cells + 2
        require(
            cells >= smallest - 0.5,
            f"domain_size ({axis})",
            f"at least {smallest} cells: the walls, and two between them",
            length,
        )
        counts.append(round(cells))
    return counts[0], counts[1], counts[2]


def _require_sound(scene: Scene, index: int, low: np.ndarray, high: np.ndarray) -> None:
    for name in ("gravity", "velocity_N3"):
        if not np.isfinite(getattr(scene, name)).all():
            raise ConfigError(f"{name} of scene {index} must be finite")
    position = np.asarray(scene.position_N3, np.float32)
    outside = np.flatnonzero(~((position >= low) & (position <= high)).all(axis=1))
    if len(outside):
        raise ConfigError(
            f"position_N3 of scene {index} must lie within the walls, {low.tolist()} to {high.tolist()}, got "
            f"{position[outside[0]].tolist()} for particle {outside[0]} ({len(outside)} such particles); "
            "move the particles inwards or enlarge domain_size"
        )


def _no_counters() -> dict[str, Any]:
    counters: dict[str, Any] = dict.fromkeys(REPORTED, 0)
    counters["smallest_time_step_s"] = None
    counters["largest_speed"] = 0.0
    counters["particles_inside_obstacles_at_start"] = 0
    counters["particles_inside_obstacles_at_end"] = 0
    return counters


class _Launch:
    """The device arrays of one batch of scenes, each with at least one particle, and the loop over frames."""

    def __init__(
        self,
        scenes: Sequence[Scene],
        colliders: Sequence[Collider],
        config: MpmConfig,
        node_counts: tuple[int, int, int],
        device: Device,
    ) -> None:
        self.scenes, self.colliders, self.config, self.node_counts = scenes, colliders, config, node_counts
        atomic = device.kind == "gpu"
        self.parts = 1 if atomic else min(device.threads, MAXIMUM_PARTS)
        self.particle_begin = np.concatenate([[0], np.cumsum([scene.particle_count for scene in scenes])])
        self.blocks = tuple(-(-count // BLOCK) for count in node_counts)
        all_blocks = len(scenes) * math.prod(self.blocks)
        nodes, particles = all_blocks * BLOCK_NODES * self.parts, int(self.particle_begin[-1])
        if max(nodes, particles) >= 2**31:
            raise ConfigError(
                f"a batch must hold less than 2^31 nodes and particles, got {nodes} nodes of {len(scenes)} scenes and "
                f"{particles} particles; lower scenes_per_launch"
            )
        label = np.concatenate(
            [4 * index + np.asarray(scene.material_N, np.int32) for index, scene in enumerate(scenes)]
        )
        present = [bool((label % 4 == kind).any()) for kind in (WATER, SAND, SNOW)]
        has_contact = any(len(collider.node_K3) for collider in colliders)
        self.variant = (
            VARIANT.water * present[WATER]
            + VARIANT.sand * present[SAND]
            + VARIANT.snow * present[SNOW]
            + VARIANT.contact * has_contact
            + VARIANT.taichi_elements_sand * (config.sand_volume_correction == "taichi_elements")
            + VARIANT.atomic * atomic
            + VARIANT.parts * self.parts
        )
        self.position = _vectors(np.concatenate([scene.position_N3 for scene in scenes]))
        self.velocity = _vectors(np.concatenate([scene.velocity_N3 for scene in scenes]))
        self.affine = ti.Matrix.ndarray(3, 3, ti.f32, particles)
        self.deformation = ti.Matrix.ndarray(3, 3, ti.f32, particles if present[SAND] or present[SNOW] else 1)
        self.volume = ti.ndarray(ti.f32, particles)
        self.label = _array(label.astype(np.int32))
        self.scene_value = _array(self._scene_values())
        self.counter = _array(np.zeros((len(scenes), COUNT.length), np.int64))
        self.shape = _array(self._shape())
        self.node = ti.Vector.ndarray(4, ti.f32, nodes)
        self.block = _array(np.zeros(2 * all_blocks + 1, np.int32))
        contact, normal = self._contacts() if has_contact else (np.full(1, -1, np.int32), np.zeros((1, 3), np.float32))
        self.contact, self.contact_normal = _array(contact), _vectors(normal)

    def release(self) -> None:
        """Gives the device memory back: Taichi 1.7.4 frees scalar arrays by itself, but not those of vectors."""
        program = ti.lang.impl.get_runtime().prog
        for array in (
            self.position, self.velocity, self.affine, self.deformation, self.node, self.contact_normal
        ):  # fmt: skip
            program.delete_ndarray(array.arr)

    def _scene_values(self) -> np.ndarray:
        value = np.zeros((len(self.scenes), VALUE.length), np.float32)
        value[:, VALUE.smallest_time_step] = np.inf
        shear, bulk = lame_parameters(self.config)
        for row, scene in zip(value, self.scenes, strict=True):
            row[VALUE.gravity : VALUE.gravity + 3] = scene.gravity
            constant = {WATER: 3 * bulk, SAND: 3 * bulk + 2 * shear, SNOW: 0.0}
            row[VALUE.least_stiffness] = max(constant[kind] for kind in np.unique(scene.material_N).tolist())
        return value

    def _shape(self) -> np.ndarray:
        """The int32 shape that kernels read, with the bounds of the parts that each scene's particles fall into."""
        begin = [
            start + (stop - start) * part // self.parts
            for start, stop in zip(self.particle_begin[:-1], self.particle_begin[1:], strict=True)
            for part in range(self.parts)
        ]
        shape = np.zeros(SHAPE.part_begin, np.int32)
        shape[SHAPE.nodes : SHAPE.nodes + 3] = self.node_counts
        shape[SHAPE.blocks : SHAPE.blocks + 3] = self.blocks
        shape[SHAPE.scene_blocks] = math.prod(self.blocks)
        shape[SHAPE.all_blocks] = len(self.scenes) * math.prod(self.blocks)
        shape[SHAPE.wall_cells] = self.config.wall_cells
        shape[SHAPE.sticky_walls] = self.config.wall_contact == "stick"
        shape[SHAPE.maximum_substeps] = self.config.maximum_substeps_per_frame
        return np.concatenate([shape, np.array([*begin, self.particle_begin[-1]], np.int32)])

    def _settings(self, frame_rate_hz: float) -> np.ndarray:
        config, cell_size = self.config, self.scenes[0].cell_size
        low, high = particle_bounds(self.scenes[0], config)
        setting = np.zeros(SETTING.length, np.float32)
        setting[: CONSTANT.length] = constants(config)
        setting[SETTING.cell_size] = cell_size
        setting[SETTING.inverse_cell_size] = 1 / cell_size
        if config.time_step == "fixed":
            setting[SETTING.fixed_time_step] = config.fixed_time_step_s
            setting[SETTING.fixed_substeps] = fixed_substeps(config, frame_rate_hz)
        setting[SETTING.stability_fraction] = config.stability_fraction
        setting[SETTING.speed_fraction] = config.speed_fraction
        setting[SETTING.friction] = config.collider_friction
        setting[SETTING.low : SETTING.low + 3] = low
        setting[SETTING.high : SETTING.high + 3] = high
        setting[SETTING.size : SETTING.size + 3] = self.scenes[0].domain_size
        return setting

    def _contacts(self) -> tuple[np.ndarray, np.ndarray]:
        """Per node twice the index of its normal, plus 1 where motion is stopped both ways, or -1; the normals."""
        scene_nodes = math.prod(self.blocks) * BLOCK_NODES
        contact = np.full(len(self.scenes) * scene_nodes, -1, np.int32)
        first = 0
        for index, collider in enumerate(self.colliders):
            block, local = np.divmod(collider.node_K3.astype(np.int64), BLOCK)
            place = (block[:, 0] * self.blocks[1] + block[:, 1]) * self.blocks[2] + block[:, 2]
            place = place * BLOCK_NODES + (local[:, 0] * BLOCK + local[:, 1]) * BLOCK + local[:, 2]
            both_sides = collider.kind_K == BOTH_SIDES
            contact[index * scene_nodes + place] = 2 * np.arange(first, first + len(place)) + both_sides
            first += len(place)
        return contact, np.concatenate([collider.normal_K3 for collider in self.colliders])

    def run(
        self, frames: int, frame_rate_hz: float, on_frame: Callable[[int], None] | None
    ) -> list[Simulated | SceneFailure]:
        scenes, config = self.scenes, self.config
        frame_s = 1 / frame_rate_hz
        if config.time_step == "fixed":
            frame_s = fixed_substeps(config, frame_rate_hz) * config.fixed_time_step_s
        setting = _array(self._settings(frame_rate_hz))
        kernels.start(self.velocity, self.affine, self.deformation, self.volume, self.label, self.scene_value, setting)
        trajectory = [np.empty((frames, scene.particle_count, 3), np.float32) for scene in scenes]
        for rows, scene in zip(trajectory, scenes, strict=True):
            rows[0] = scene.position_N3
        if on_frame is not None:
            on_frame(0)
        cause: dict[int, str] = {}
        for frame in range(1, frames):
            kernels.begin_frame(frame_s, self.scene_value, self.counter)
            self._run_frame(setting)
            position = self.position.to_numpy()
            status = self.counter.to_numpy()[:, COUNT.status]
            for index, begin in enumerate(self.particle_begin[:-1]):
                if index in cause:
                    continue
                if status[index] != STATUS.running:
                    cause[index] = self._cause(int(status[index]), frame)
                else:
                    trajectory[index][frame] = position[begin : self.particle_begin[index + 1]]
            if on_frame is not None:
                on_frame(frame)
            if len(cause) == len(scenes):
                break
        counters = self._counters(trajectory)
        return [
            SceneFailure(cause[index]) if index in cause else Simulated(trajectory[index], counters[index])
            for index in range(len(scenes))
        ]

    def _run_frame(self, setting: ti.ScalarNdarray) -> None:
        """Substeps until no scene has time left; the host looks only when the last estimate has run out."""
        pending = 1
        while pending:
            for _ in range(min(pending, SUBSTEPS_PER_CHECK)):
                kernels.substep(
                    self.position, self.velocity, self.affine, self.deformation, self.volume, self.label,
                    self.scene_value, self.counter, setting, self.shape, self.node, self.block, self.contact,
                    self.contact_normal, self.variant,
                )  # fmt: skip
            value = self.scene_value.to_numpy()
            busy = value[:, VALUE.remaining] > 0
            pending = int(value[busy, VALUE.substeps_ahead].max()) if busy.any() else 0

    def _cause(self, status: int, frame: int) -> str:
        config = self.config
        if status == STATUS.not_finite:
            rule = "a particle's position, velocity or velocity gradient is no longer finite"
        elif status == STATUS.left_domain:
            rule = "a particle left the domain"
        else:
            rule = (
                f"the frame needs more than maximum_substeps_per_frame = {config.maximum_substeps_per_frame} substeps"
            )
        return f"frame {frame}: {rule}"

    def _counters(self, trajectory: list[np.ndarray]) -> list[dict[str, Any]]:
        counter, value = self.counter.to_numpy(), self.scene_value.to_numpy()
        out = []
        for index, collider in enumerate(self.colliders):
            counters = _no_counters()
            for name in REPORTED:
                counters[name] = int(counter[index, getattr(COUNT, name)])
            smallest = float(value[index, VALUE.smallest_time_step])
            counters["smallest_time_step_s"] = smallest if math.isfinite(smallest) else None
            counters["largest_speed"] = float(math.sqrt(value[index, VALUE.largest_speed_square]))
            counters["particles_inside_obstacles_at_start"] = collider.count_inside(trajectory[index][0])
            counters["particles_inside_obstacles_at_end"] = collider.count_inside(trajectory[index][-1])
            out.append(counters)
        return out


def _array(values: np.ndarray) -> ti.ScalarNdarray:
    types = {"float32": ti.f32, "int32": ti.i32, "int64": ti.i64, "uint8": ti.u8}
    out = ti.ndarray(types[values.dtype.name], values.shape)
    out.from_numpy(np.ascontiguousarray(values))
    return out


def _vectors(values_N3: np.ndarray) -> ti.VectorNdarray:
    out = ti.Vector.ndarray(3, ti.f32, len(values_N3))
    out.from_numpy(np.ascontiguousarray(values_N3, np.float32))
    return out
