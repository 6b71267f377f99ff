"""Device arrays of a batch of scenes, the loop over frames, failures and counters. All ways to run a batch share it.

Shape legend: T frames, N particles of a scene, P particles of all scenes, B scenes, K constants.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import Any

import numpy as np

from datagen.mpm.collider import Collider
from datagen.mpm.layout import (
    BLOCK,
    BLOCK_NODES,
    CONSTANT,
    COUNT,
    KEY,
    MATERIAL_VARIANTS,
    REPORTED,
    SETTING,
    SHAPE,
    STATUS,
    VALUE,
    VARIANT,
    material_laws,
)
from hgn.config import MpmConfig
from hgn.scene.emission import entry_frames
from hgn.scene.material import MATERIAL_BITS, MATERIAL_MASK, MATERIALS, SAND
from hgn.scene.scene import Scene, whole_cells
from hgn.schema import ConfigError, require
from hgn.solver_method import MAXIMUM_SUBSTEPS

import datagen.mpm.device  # noqa: F401  # isort: skip  # keeps Taichi's banner off stdout
import taichi as ti  # isort: skip

from datagen.mpm.surface_kernel import (  # isort: skip
    LIST_HEAD,
    NODE_VECTORS,
    TRIANGLE_VECTORS,
    place_contacts,
)
from datagen.mpm.body_arrays import body_arrays, list_begins, triangle_lists, triangle_vectors  # isort: skip

MAXIMUM_BLOCKS = 1024  # blocks along an axis; kernels store the number in ten bits


@dataclass(frozen=True, eq=False)
class Simulated:
    """One scene's trajectory."""

    # float32, domain units; frame 0 is the initial state, bitwise; NaN before the frame in which a particle enters
    position_TN3: np.ndarray
    counters: dict[str, Any]  # plain JSON types: substeps, smallest_time_step_s, floors hit


@dataclass(frozen=True)
class SceneFailure:
    cause: str  # why the scene was stopped; other scenes of its batch continue


def no_counters() -> dict[str, Any]:
    others = {"smallest_time_step_s": None, "largest_speed": 0.0}
    inside = {"particles_inside_obstacles_at_start": 0, "particles_inside_obstacles_at_end": 0}
    return dict.fromkeys(REPORTED, 0) | others | inside


def particle_bounds(scene: Scene, config: MpmConfig) -> tuple[np.ndarray, np.ndarray]:
    """Returns the smallest and largest coordinates that particles may have, float32 [3] each, domain units.

    Beyond them all nodes of a particle are wall nodes, or outside the grid.
    """
    nodes = np.array([round(length / scene.cell_size) for length in scene.domain_size])
    low = np.full(3, (config.wall_cells - 1.5) * scene.cell_size)
    high = np.minimum(nodes - config.wall_cells + 0.5, nodes - 1.5) * scene.cell_size
    # one rounding inside, so that the scaled coordinate cannot round to the next base node
    return (low * (1 + 1e-6)).astype(np.float32), (high * (1 - 1e-6)).astype(np.float32)


def cell_mass(scene: Scene) -> float:
    """Returns the scene's particles per cell; if unknown, the median over particles of the count in their own cell."""
    if scene.particles_per_cell is not None:
        return scene.particles_per_cell
    cell = np.floor(np.asarray(scene.position_N3, np.float64) / scene.cell_size).astype(np.int64)
    _, own, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    return float(np.median(count[own.ravel()]))


def fixed_substeps(config: MpmConfig, frame_rate_hz: float) -> int:
    """Returns the number of fixed time steps up to the end of a frame."""
    assert config.fixed_time_step_s is not None
    return max(1, math.ceil(1 / (frame_rate_hz * config.fixed_time_step_s) - 1e-6))


class Launch(ABC):
    """The device arrays of a batch of scenes, each with at least one particle, and the loop over frames.

    A subclass stores the particles, and computes frames in `_advance`.
    """

    parts = 1  # number of parts that each scene's particles are divided into
    copies = 1  # number of copies of the grid
    entries_a_node = 1  # numbers per node in the array of nodes

    def __init__(
        self,
        scenes: Sequence[Scene],
        colliders: Sequence[Collider],
        config: MpmConfig,
        node_counts: tuple[int, int, int],
        frame_rate_hz: float,
        stability_fractions: Sequence[float] | None = None,
    ) -> None:
        self.scenes, self.colliders, self.config = scenes, colliders, config
        self.frame_s = 1 / frame_rate_hz
        if config.fixed_time_step_s is not None:
            self.frame_s = fixed_substeps(config, frame_rate_hz) * config.fixed_time_step_s
        self.particle_begin = np.concatenate([[0], np.cumsum([scene.particle_count for scene in scenes])])
        self.particles = int(self.particle_begin[-1])
        self.blocks = tuple(-(-count // BLOCK) for count in node_counts)
        self.scene_nodes = math.prod(self.blocks) * BLOCK_NODES
        # second fields of nodes come last, in separate blocks
        self.ghosts = sum(int(collider.doubled_K.sum()) for collider in colliders)
        bodies = [body for collider in colliders for body in collider.bodies]
        ghost_room = self.ghosts
        self.second_fields = np.full(len(scenes), -1, np.int32)  # first one of each scene with moving sheets
        for index, collider in enumerate(colliders):
            if not all(body.closed for body in collider.bodies):
                self.second_fields[index] = ghost_room
                ghost_room += self.scene_nodes
        self.all_blocks = len(scenes) * math.prod(self.blocks) + -(-ghost_room // BLOCK_NODES)
        rule = f"at most {MAXIMUM_BLOCKS * BLOCK} cells a side"
        require(max(self.blocks) <= MAXIMUM_BLOCKS, "domain_size", rule, max(node_counts), "enlarge cell_size")
        nodes = self.all_blocks * BLOCK_NODES * self.copies
        if max(nodes * self.entries_a_node, self.particles) >= 2**31:
            raise ConfigError(
                f"a batch must have less than {2**31 // self.entries_a_node} nodes and {2**31} particles, got {nodes} "
                f"nodes of {len(scenes)} scenes and {self.particles} particles; lower scenes_per_launch"
            )
        label = np.concatenate(
            [(index << MATERIAL_BITS) + np.asarray(scene.material_N, np.int32) for index, scene in enumerate(scenes)]
        )
        self.entry_frame = np.concatenate([entry_frames(scene, frame_rate_hz) for scene in scenes])
        self.own_label = label.astype(np.int32)
        # particles that enter later wait in an additional scene that is never simulated
        self.rows = len(scenes) + bool(self.entry_frame.any())
        label = np.where(self.entry_frame > 0, (len(scenes) << MATERIAL_BITS) + (label & MATERIAL_MASK), label)
        laws, row = material_laws(scenes, config)
        has_contact = bool(bodies) or any(len(collider.node_K3) for collider in colliders)
        has_sweep = bool(bodies) or any(len(collider.sweep.base_K3) for collider in colliders)
        self.variant = (
            sum(MATERIAL_VARIANTS[material] for material in np.unique(label & MATERIAL_MASK))
            + VARIANT.contact * has_contact
            + VARIANT.sweep * has_sweep
            + VARIANT.sheets * (ghost_room > 0)
            + VARIANT.moving * bool(bodies)
            + VARIANT.moving_sheets * (ghost_room > self.ghosts)
            + VARIANT.taichi_elements * (config.method == "taichi_elements")
            + VARIANT.rate_of_sand * bool(config.sand_grain_diameter_m > 0 and SAND in label & MATERIAL_MASK)
            + VARIANT.several_laws * (len(laws) > 1)
            + VARIANT.parts * self.copies
        )
        self.label = device_array(label.astype(np.int32))
        self.law_row = device_array(row * CONSTANT.length)
        self.law = device_array(laws.ravel())
        self.setting = device_array(self._settings(frame_rate_hz))
        self.scene_value = device_array(self._scene_values(laws, row, stability_fractions))
        counter = np.zeros((self.rows, COUNT.length), np.int64)
        counter[len(scenes) :, COUNT.status] = STATUS.waiting
        self.counter = device_array(counter)
        self.node = self._node_array(nodes)
        self.hidden = ti.ndarray(ti.i32, self.particles if ghost_room else 1)
        self._place_contacts()

    def _place_contacts(self) -> None:
        """Writes contacts into device arrays."""
        masses = [cell_mass(scene) for scene in self.scenes]
        nodes = NODE_VECTORS * sum(len(collider.node_K3) for collider in self.colliders)
        triangles = TRIANGLE_VECTORS * sum(len(collider.sweep.triangle_F43) for collider in self.colliders)
        has_contacts = self.variant & (VARIANT.contact | VARIANT.sweep)
        has_triangles = self.variant & (VARIANT.sweep | VARIANT.sheets)
        vector = np.zeros((max(1, nodes + triangles), 3), np.float32)
        entries, length = [], 1
        if has_contacts:
            length = self.all_blocks * BLOCK_NODES
            entries.append(self._contacts(vector[:nodes].reshape(-1, NODE_VECTORS, 3), masses))
        if has_triangles:
            of_triangles = vector[nodes : nodes + triangles].reshape(-1, TRIANGLE_VECTORS, 3)
            place, value, length = self._sweeps(nodes, of_triangles)
            entries.append((place, value))
        bodies, pose = length, np.zeros(1, np.float32)
        if self.variant & VARIANT.moving:
            of_scenes = [collider.bodies for collider in self.colliders]
            value, more, pose = body_arrays(
                of_scenes, self.second_fields, self._frictions(), masses, length, len(vector)
            )
            entries.append((np.arange(length, length + len(value), dtype=np.int32), value))
            vector, length = np.concatenate([vector, more]), length + len(value)
        self.shape = device_array(self._shape(bodies))
        self.pose = device_array(pose)
        self.contact = ti.ndarray(ti.i32, length)
        self.contact.fill(-1)
        for place, value in entries:
            if len(place):
                place_contacts(self.contact, device_array(place), device_array(value))
        self.contact_normal = device_vectors(vector)

    @abstractmethod
    def _node_array(self, nodes: int) -> Any:
        """Allocates momentum or velocity, and mass, of `nodes` nodes."""

    def _vector_arrays(self) -> list[Any]:
        return [self.contact_normal]

    def release(self) -> None:
        """Frees the device memory. Taichi 1.7.4 frees scalar arrays by itself, but not arrays of vectors."""
        program = ti.lang.impl.get_runtime().prog
        for array in self._vector_arrays():
            program.delete_ndarray(array.arr)

    def _scene_values(
        self, laws: np.ndarray, row: np.ndarray, stability_fractions: Sequence[float] | None
    ) -> np.ndarray:
        value = np.zeros((self.rows, VALUE.length), np.float32)
        value[:, VALUE.smallest_time_step] = np.inf
        value[: len(self.scenes), VALUE.stability_fraction] = stability_fractions or self.config.stability_fraction
        shear, bulk = laws[:, CONSTANT.shear], laws[:, CONSTANT.bulk]
        # rows: materials; columns: rows of `laws`. The least stiffness of snow is 0, because it can soften completely.
        density = laws[:, CONSTANT.density]
        viscous = 4 * laws[:, CONSTANT.viscosity] / (density * self.scenes[0].cell_size)
        solid = (3 * bulk + 2 * shear) / density
        least = np.stack([(np.sqrt(3 * bulk / density) + viscous) ** 2, solid, 0 * bulk, solid])
        assert len(least) == len(MATERIALS)
        for index, scene in enumerate(self.scenes):
            own = slice(self.particle_begin[index], self.particle_begin[index + 1])
            value[index, VALUE.gravity : VALUE.gravity + 3] = scene.gravity
            value[index, VALUE.wall_friction : VALUE.wall_friction + 3] = scene.wall_friction
            value[index, VALUE.nodes : VALUE.nodes + 3] = whole_cells(scene.domain_size, scene.cell_size)
            value[index, VALUE.high : VALUE.high + 3] = particle_bounds(scene, self.config)[1]
            value[index, VALUE.size : VALUE.size + 3] = scene.domain_size
            # water's density comes from mass on the grid; heavier particles nearby would look like compressed water
            alike = (laws[row[own], CONSTANT.mass] == 1).all()
            value[index, VALUE.water_density] = (scene.particles_per_cell or 0.0) if alike else 0.0
            value[index, VALUE.least_stiffness] = least[scene.material_N, row[own]].max()
            speeds = [body.key_TK[:, KEY.speed].max() for body in self.colliders[index].bodies]
            value[index, VALUE.obstacle_speed] = max(speeds, default=0.0)
        return value

    def _shape(self, bodies: int) -> np.ndarray:
        """Returns the int32 shape for kernels, and the first particle of each part of each scene."""
        begin = [
            start + (stop - start) * part // self.parts
            for start, stop in zip(self.particle_begin[:-1], self.particle_begin[1:], strict=True)
            for part in range(self.parts)
        ]
        shape = np.zeros(SHAPE.part_begin, np.int32)
        shape[SHAPE.blocks : SHAPE.blocks + 3] = self.blocks
        shape[SHAPE.scene_blocks] = math.prod(self.blocks)
        shape[SHAPE.all_blocks] = self.all_blocks
        shape[SHAPE.ghosts] = self.ghosts
        shape[SHAPE.second_fields], shape[SHAPE.bodies] = bodies, bodies + len(self.scenes)
        shape[SHAPE.ghost_begin] = len(self.scenes) * self.scene_nodes
        shape[SHAPE.wall_cells] = self.config.wall_cells
        shape[SHAPE.maximum_substeps] = MAXIMUM_SUBSTEPS
        return np.concatenate([shape, np.array([*begin, self.particles], np.int32)])

    def _settings(self, frame_rate_hz: float) -> np.ndarray:
        config, choices, cell_size = self.config, self.config.choices, self.scenes[0].cell_size
        setting = np.zeros(SETTING.length, np.float32)
        setting[SETTING.cell_size] = cell_size
        setting[SETTING.inverse_cell_size] = 1 / cell_size
        if config.fixed_time_step_s is not None:
            setting[SETTING.fixed_time_step] = config.fixed_time_step_s
            setting[SETTING.fixed_substeps] = fixed_substeps(config, frame_rate_hz)
        if choices.transfer_speed_m_s is not None:
            setting[SETTING.transfer_interval] = cell_size / choices.transfer_speed_m_s
        setting[SETTING.leapfrog] = choices.time_integration == "leapfrog"
        if choices.water_density_relaxation_s is not None:
            setting[SETTING.density_relaxation] = 1 / choices.water_density_relaxation_s
        setting[SETTING.low] = particle_bounds(self.scenes[0], config)[0][0]
        return setting

    def _contacts(self, vector: np.ndarray, cell_masses: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """Returns the indices and entries of contact nodes (see grid_kernel.substep). Writes the entries' vectors."""
        # scene after scene, so that arrays stay in a core's cache; nodes with two fields get the first entries
        places, entries = np.empty(len(vector), np.int32), np.empty(len(vector), np.int32)
        filled, doubled, single = 0, 0, self.ghosts
        for index, (own, friction) in enumerate(zip(self.colliders, self._frictions(), strict=True)):
            count, ghosts = len(own.node_K3), int(own.doubled_K.sum())
            entry = np.empty(count, np.int32)
            entry[own.doubled_K] = np.arange(doubled, doubled + ghosts)
            entry[~own.doubled_K] = np.arange(single, single + count - ghosts)
            value = np.zeros((count, *vector.shape[1:]), np.float32)
            value[:, :2] = own.normal_K23
            value[:, 2, :2] = friction[own.obstacle_K2]
            value[:, 3, :2] = cell_masses[index] * own.least_K2
            value[:, 2:, 2] = own.distance_K2
            vector[entry] = value
            places[filled : filled + count] = self._places(own.node_K3) + np.int32(index * self.scene_nodes)
            entries[filled : filled + count] = entry
            filled, doubled, single = filled + count, doubled + ghosts, single + count - ghosts
        return places, entries

    def _frictions(self) -> list[np.ndarray]:
        """Returns the Coulomb coefficients of each scene's obstacles, at least one entry for each scene."""
        return [np.array([o.friction for o in scene.obstacles] or [0.0], np.float32) for scene in self.scenes]

    def _places(self, node_K3: np.ndarray) -> np.ndarray:
        """Returns the indices of nodes in a scene's arrays of nodes, int32 [K]."""
        x, y, z = node_K3.T
        place = ((x // BLOCK) * np.int32(self.blocks[1]) + y // BLOCK) * np.int32(self.blocks[2]) + z // BLOCK
        return place * np.int32(BLOCK_NODES) + ((x % BLOCK) * BLOCK + y % BLOCK) * BLOCK + z % BLOCK

    def _sweeps(self, first_vector: int, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """Returns indices and values of the contact array for the swept test (see grid_kernel.substep), and its length.
        Writes the triangles' vectors."""
        all_nodes = self.all_blocks * BLOCK_NODES
        sweeps = [collider.sweep for collider in self.colliders]
        end = 2 * all_nodes + sum(LIST_HEAD * len(sweep.begin_K) + len(sweep.triangle_L) for sweep in sweeps)
        if end >= 2**31:
            raise ConfigError(
                f"a batch must have less than 2^31 nodes, cells and lists of triangles, got {end}; lower "
                "scenes_per_launch"
            )
        bases, triangle = sum(len(sweep.base_K3) for sweep in sweeps), 0
        # filled in place, because memory for parts and copies takes longer than their values; bases come before lists
        places = np.arange(2 * all_nodes - bases, end, dtype=np.int32)
        values, filled, end = np.empty(len(places), np.int32), 0, 2 * all_nodes
        for index, (sweep, friction) in enumerate(zip(sweeps, self._frictions(), strict=True)):
            lists = triangle_lists(sweep, first_vector + TRIANGLE_VECTORS * triangle)
            own = slice(filled, filled + len(sweep.base_K3))
            places[own] = self._places(sweep.base_K3) + np.int32(all_nodes + index * self.scene_nodes)
            values[own] = np.int32(end) + list_begins(sweep)
            values[bases + end - 2 * all_nodes :][: len(lists)] = lists
            vector[triangle : triangle + len(sweep.triangle_F43)] = triangle_vectors(sweep, friction)
            triangle += len(sweep.triangle_F43)
            filled, end = own.stop, end + len(lists)
        return places, values, end

    @abstractmethod
    def _advance(self, frames: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Computes `frames` frames, and yields them a few at a time.

        Yields positions [frames, P, 3], valid until the next request, and the number of frames that each scene has
        completed so far [B].
        """

    def run(
        self, trajectory: Sequence[np.ndarray], on_frame: Callable[[int], None] | None, children: int
    ) -> list[Simulated | SceneFailure]:
        """Returns the frames of each scene, the initial state included, or why the scene was stopped.

        `trajectory` are the arrays for the frames of each scene, see `Simulated`. They contain the first of each
        `children` particles, counters count all particles. `on_frame` is called up to the last completed frame.
        """
        frames = len(trajectory[0])
        every = [slice(*pair) for pair in pairwise(self.particle_begin)]
        first = [slice(particles.start, particles.stop, children) for particles in every]
        last = np.concatenate([scene.position_N3 for scene in self.scenes])
        present, start = 0, (last[None], np.zeros(len(self.scenes), np.int64))
        for position, completed in chain([start], self._advance(frames - 1)):
            for rows, visible in zip(trajectory, first, strict=True):
                rows[present : present + len(position)] = position[:, visible]
                for frame in range(present, min(present + len(position), self.entry_frame[visible].max())):
                    rows[frame, self.entry_frame[visible] > frame] = np.nan
                # first touches of memory take seconds, and a GPU would wait for them after its last frames
                rows[present + len(position) : present + 2 * len(position)] = 0
            for frame in range(present, min(present + len(position), completed.max() + 1)):
                if on_frame is not None:
                    on_frame(frame)
            present += len(position)
            last[:] = position[-1]
            if (completed < present - 1).all():
                break
        status = self.counter.to_numpy()[:, COUNT.status]
        counters = self._counters()
        for index, (own, collider) in enumerate(zip(counters, self.colliders, strict=True)):
            places = {"start": (self.scenes[index].position_N3, 0), "end": (last[every[index]], frames - 1)}
            for when, (place_N3, frame) in places.items():
                if status[index] == STATUS.running:
                    entered_N3 = place_N3[self.entry_frame[every[index]] <= frame]
                    inside = collider.count_inside(entered_N3, frame * self.frame_s)
                    own[f"particles_inside_obstacles_at_{when}"] = inside
        return [
            Simulated(trajectory[index], counters[index])
            if status[index] == STATUS.running
            else SceneFailure(self._cause(int(status[index]), int(completed[index]) + 1))
            for index in range(len(self.scenes))
        ]

    def _cause(self, status: int, frame: int) -> str:
        rules = {
            STATUS.not_finite: "a particle's position, velocity or velocity gradient is no longer finite",
            STATUS.left_domain: "a particle left the domain",
            STATUS.too_many_substeps: f"the frame needs more than {MAXIMUM_SUBSTEPS} substeps",
        }
        return f"frame {frame}: {rules[status]}"

    def _counters(self) -> list[dict[str, Any]]:
        counter, value = self.counter.to_numpy(), self.scene_value.to_numpy()
        out = []
        for index in range(len(self.scenes)):
            counters = no_counters()
            for name in REPORTED:
                counters[name] = int(counter[index, getattr(COUNT, name)])
            smallest = float(value[index, VALUE.smallest_time_step])
            counters["smallest_time_step_s"] = smallest if math.isfinite(smallest) else None
            last = counter[index, COUNT.speed_square_bits].astype(np.int32).view(np.float32)
            counters["largest_speed"] = float(math.sqrt(max(value[index, VALUE.largest_speed_square], last)))
            out.append(counters)
        return out


def device_array(values: np.ndarray) -> ti.ScalarNdarray:
    types = {"float32": ti.f32, "int32": ti.i32, "int64": ti.i64, "uint8": ti.u8}
    out = ti.ndarray(types[values.dtype.name], values.shape)
    out.from_numpy(np.ascontiguousarray(values))
    return out


def device_vectors(values_N3: np.ndarray) -> ti.VectorNdarray:
    out = ti.Vector.ndarray(3, ti.f32, len(values_N3))
    out.from_numpy(np.ascontiguousarray(values_N3, np.float32))
    return out
