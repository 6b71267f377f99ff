"""Holds a scene that viewers change, and the actions of the page's buttons without the page.

Shape legend: N particles, A particles in a box, C candidates to enter.
"""

import io
import math
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from weakref import WeakSet

import numpy as np
import yaml
from scipy.spatial import KDTree

from hgn.runtime.divergence import DivergedError
from hgn.runtime.live import LiveSimulation
from hgn.runtime.simulator import InitialState, Simulator
from hgn.scene.distance import contains
from hgn.scene.group import WALL_CELLS, Region, fill, particle_count
from hgn.scene.history import velocity_after
from hgn.scene.material import MATERIALS, material_index
from hgn.scene.mesh import load_mesh
from hgn.scene.rollout_file import Rollout
from hgn.scene.scene import Scene
from hgn.scene.scene_file import ObstacleEntry
from hgn.scene.surface import point_tree
from hgn.schema import ConfigError, Vector, from_mapping, require, to_mapping, triple
from hgn.viewer.placed import Body, PlacedObstacle, moved_from, placed_by, with_obstacles
from hgn.viewer.recording import Frame, Recording

CLEARANCE = 1.25  # least distance of an entering particle from all others, in spacings of particles at rest
MAXIMUM_GRAVITY = 1000.0  # domain units per second squared
MAXIMUM_OBSTACLES, MAXIMUM_MESH_BYTES = 64, 128 << 20  # bytes of mesh files, those of past frames included
MOST_SAMPLES = 600_000  # surface samples of all added obstacles: about 4 CPU seconds, in which the page stands still
CHANGES = 100  # largest number of changes that can be undone
FULL_SHARE = 0.5  # the spout waits while more than this fraction of the particles of one frame are still near it


@dataclass(frozen=True)
class Spout:
    """Describes a source from which a material runs straight down, in domain units and domain units per second."""

    position: Vector  # centre of the disc
    material: str = "water"
    diameter: float = 0.08
    speed: float = 1.0

    def __post_init__(self) -> None:
        material_index(self.material)
        require(0 < self.diameter < math.inf, "diameter", "finite and > 0", self.diameter)
        require(0 <= self.speed < math.inf, "speed", "finite and >= 0", self.speed)


class PlaySession:
    """Holds one simulation with its past. Only one thread may use it at a time."""

    def __init__(
        self,
        simulator: Simulator,
        scene: Scene,
        folder: Path = Path(),
        maximum_particles: int = 40_000,
        keep_bytes: int = 1 << 30,
        weights: str = "",
    ) -> None:
        """Takes a scene file's scene and the `folder` of its meshes. Keeps past frames of at most `keep_bytes`.

        Raises ConfigError for a scene that the weights do not support, or for more than `maximum_particles`.
        """
        rule, remedy = f"at most {maximum_particles}", "raise particles"
        require(scene.particle_count <= maximum_particles, "scene's particles", rule, scene.particle_count, remedy)
        self.simulator, self.weights = simulator, weights
        self.maximum_particles, self.keep_bytes = maximum_particles, keep_bytes
        self.particles_per_cell = scene.particles_per_cell or 8.0
        self.random = np.random.default_rng(scene.seed)
        self._constants = scene.material_parameters  # of the first particles; those that enter later have none
        self.spout: Spout | None = None
        self._owed = 0.0  # fraction of a particle that the spout has yet to release
        self._bodies: WeakSet[Body] = WeakSet()  # bodies that viewers have added
        initial = InitialState.of_scene(replace(scene, obstacles=()))
        require(not scene.moves, "obstacles", "at rest in hgn.play", "keyframes", "leave them out")
        self.obstacles: tuple[PlacedObstacle, ...] = tuple(
            placed_by(from_mapping(ObstacleEntry, entry), folder, scene.cell_size)
            for entry in scene.specification.get("obstacles", ())
        )
        self._begin, self._begin_obstacles = with_obstacles(initial, self.obstacles), self.obstacles
        self.live = LiveSimulation(simulator, self._begin, maximum_particles)
        self._record_first()

    def restart(self) -> None:
        """Returns to the scene as it was opened, with the present weights."""
        live = LiveSimulation(self.simulator, self._begin, self.maximum_particles)
        self.live.close()
        self.live, self.obstacles, self.spout = live, self._begin_obstacles, None
        self._record_first()

    def _record_first(self) -> None:
        state = self.live.state
        self.undoable: list[tuple[int, tuple[PlacedObstacle, ...], Vector]] = []  # frame, obstacles, gravity: for undo
        recording = Recording(self.keep_bytes)
        recording.enter(self._begin.material_N, state.velocity_NM3.cpu().numpy())
        recording.append(self._frame_at(state.position_N3.cpu().numpy()))
        self.recording = recording  # other threads read the newest frame, which is always there

    @property
    def frame(self) -> int:
        """Returns the number of the newest frame."""
        return self.recording.last

    @property
    def full(self) -> bool:
        """Returns whether no more particles can enter."""
        return self.live.particle_count >= self.maximum_particles

    @property
    def newest(self) -> Frame:
        return self.recording.frames[-1]

    def materials(self) -> np.ndarray:
        """Returns the materials of the newest frame's particles as indices into MATERIALS, uint8 [N]."""
        return self.recording.material_N[: len(self.newest.position_N3)]

    @property
    def domain_size(self) -> Vector:
        return self.live.scenes[0].domain_size

    @property
    def cell_size(self) -> float:
        return self.live.scenes[0].obstacle_grid.cell_size

    @property
    def gravity(self) -> Vector:
        return self.live.scenes[0].gravity

    def _velocities(self) -> np.ndarray:
        """Returns velocities at the instant of the newest frame, float32 [N, 3] in domain units per second."""
        rate, newest = self.simulator.frame_rate_hz, self.newest
        velocity_N3 = rate * velocity_after(newest.velocity_N3, np.array(newest.gravity) / rate**2)
        return velocity_N3.astype(np.float32)

    def step(self) -> None:
        """Simulates one frame, after the particles of the spout have entered.

        Raises DivergedError. The scene then stays at the frame before.
        """
        if self.spout is not None:
            self._pour(self.spout)
        try:
            position_N3 = self.live.step()
        except DivergedError:
            self.rewind(self.frame)
            raise
        self.recording.append(self._frame_at(position_N3))

    def _frame_at(self, position_N3: np.ndarray) -> Frame:
        velocity_N3 = self.live.state.velocity_NM3[:, 0].cpu().numpy()
        return Frame(position_N3.copy(), velocity_N3.copy(), self.obstacles, self.gravity)

    def rewind(self, frame: int) -> None:
        """Goes back to a frame and deletes later ones. Without changes the simulation then repeats the same frames.

        Raises ConfigError for a frame that is not kept.
        """
        history_NM3 = self.recording.history(frame)
        then = self.recording[frame]
        self.live.restore(then.position_N3, history_NM3, frame)
        if then.obstacles != self.obstacles:
            self._set_obstacles(then.obstacles)
        if then.gravity != self.gravity:
            self.live.set_gravity(then.gravity)
        self.recording.back_to(frame)
        self.undoable = [before for before in self.undoable if before[0] <= self.frame]

    def remember(self) -> None:
        """Stores frame, obstacles and gravity before a change, for `undo`."""
        self.undoable = [*self.undoable[1 - CHANGES :], (self.frame, self.obstacles, self.gravity)]

    def undo(self) -> None:
        """Goes back to before the last change, or to the earliest frame kept. Raises ConfigError without a change."""
        require(bool(self.undoable), "undo", "used after a change", "none")
        frame, obstacles, gravity = self.undoable.pop()
        self.rewind(max(frame, self.recording.earliest))
        self._set_obstacles(obstacles)
        if gravity != self.gravity:
            self.live.set_gravity(gravity)

    # particles that enter

    def drop(self, material: str, position: Vector, diameter: float, speed: float = 0.0) -> int:
        """Adds a ball that moves down, without those of its particles that would be near others. Returns their number.

        Raises ConfigError for a material that the weights do not support.
        """
        spout = Spout(position, material, diameter, speed)
        region = Region(self._inside(position, 0.5 * diameter), radius=0.5 * diameter)
        count = particle_count(region, self.particles_per_cell, self.cell_size)
        position_C3 = fill(region, count, self.random)
        return self._enter(position_C3[self._free(position_C3)], spout)

    def _pour(self, spout: Spout) -> None:
        """Adds the particles that leave a spout in one frame, with the density of the material at rest."""
        length = spout.speed / self.simulator.frame_rate_hz
        radius = 0.5 * spout.diameter
        centre = self._inside(spout.position, radius, 0.5 * length)
        volume_cells = math.pi * radius**2 * length / self.cell_size**3
        self._owed += self.particles_per_cell * volume_cells
        count = int(self._owed)
        self._owed -= count
        distance_C, angle_C = radius * np.sqrt(self.random.random(count)), 2 * np.pi * self.random.random(count)
        height_C = length * (self.random.random(count) - 0.5)
        offset_C3 = np.stack([distance_C * np.cos(angle_C), height_C, distance_C * np.sin(angle_C)], axis=1)
        away_3 = np.array([radius, 0.5 * length, radius])
        near_A3 = self._between(np.array(centre) - away_3, np.array(centre) + away_3) - centre
        if (np.hypot(near_A3[:, 0], near_A3[:, 2]) < radius).sum() > FULL_SHARE * count:
            return  # the earlier particles are still at the spout
        self._enter((np.array(centre) + offset_C3).astype(np.float32), spout)

    def _inside(self, position: Vector, radius: float, half_height: float | None = None) -> Vector:
        """Returns the nearest centre at which a ball, or a disc with a half height, lies between the walls."""
        wall = WALL_CELLS * self.cell_size
        reach = np.array([radius, radius if half_height is None else half_height, radius]) + wall
        high = np.maximum(np.array(self.domain_size) - reach, reach)
        return triple(np.clip(position, reach, high))

    def _enter(self, position_C3: np.ndarray, spout: Spout) -> int:
        """Adds candidates outside closed obstacles, up to the maximum number."""
        position_C3 = position_C3[: max(0, self.maximum_particles - self.live.particle_count)]
        for obstacle in self.obstacles:
            if obstacle.body.mesh.closed:
                position_C3 = position_C3[~contains(position_C3, obstacle.mesh())]
        count = len(position_C3)
        if count:
            velocity_C3 = np.tile(np.array([0.0, -spout.speed, 0.0], np.float32), (count, 1))
            material_C = np.full(count, material_index(spout.material), np.uint8)
            self.recording.enter(material_C, self.live.add_particles(position_C3, velocity_C3, material_C))
        return count

    def _free(self, position_C3: np.ndarray) -> np.ndarray:
        """Returns whether each candidate is far from all other particles, bool [C]."""
        near = CLEARANCE * self.cell_size / self.particles_per_cell ** (1 / 3)
        low, high = position_C3.min(axis=0) - near, position_C3.max(axis=0) + near
        others_A3 = self._between(low, high)
        if not len(others_A3):
            return np.ones(len(position_C3), bool)
        distance_C, _ = KDTree(others_A3).query(position_C3, distance_upper_bound=near)
        return np.asarray(distance_C >= near)  # the distance is infinite without a near particle

    def _between(self, low_3: np.ndarray, high_3: np.ndarray) -> np.ndarray:
        """Returns the particles in a box, float32 [A, 3]."""
        position_N3 = self.live.state.position_N3.cpu().numpy()
        return position_N3[((position_N3 >= low_3) & (position_N3 <= high_3)).all(axis=1)]

    # obstacles

    def add_obstacle(self, entry: ObstacleEntry, folder: Path = Path()) -> PlacedObstacle:
        """Adds an obstacle of a shape, or of a mesh file in a folder. Raises ConfigError as a scene file does."""
        rule, count = f"at most {MAXIMUM_OBSTACLES}", len(self.obstacles) + 1
        require(count <= MAXIMUM_OBSTACLES, "obstacles", rule, count, "remove one")
        taken = sum(len(obstacle.samples[0]) for obstacle in self.obstacles if obstacle.body in self._bodies)
        placed = placed_by(entry, folder, self.cell_size, MOST_SAMPLES - taken)
        size = sum(len(body.mesh_file or b"") for body in {*self._bodies, placed.body})
        require(size <= MAXIMUM_MESH_BYTES, "mesh files", f"at most {MAXIMUM_MESH_BYTES} bytes", size, "restart")
        self._bodies.add(placed.body)
        self._set_obstacles((*self.obstacles, placed))
        return placed

    def add_mesh(self, path: Path, size: float, middle: Vector) -> PlacedObstacle:
        """Adds a mesh file around a place. The longest side of its bounding box becomes `size`."""
        low, high = (bound(load_mesh(path).vertex_V3, axis=0) for bound in (np.min, np.max))
        scale = size / float((high - low).max())
        position = triple(np.array(middle) - scale * 0.5 * (low + high))
        return self.add_obstacle(ObstacleEntry(mesh=path.name, scale=scale, position=position), path.parent)

    def free_place(self, size: float) -> Vector:
        """Returns the centre of a free cube in the domain, as near as possible to its middle at 0.3 of its height.

        Raises ConfigError if there is none.
        """
        surfaces = (obstacle.samples[0] for obstacle in self.obstacles)
        taken_A3 = np.concatenate([self.newest.position_N3, *surfaces])
        domain, middle = np.array(self.domain_size), np.array([0.5, 0.3, 0.5])
        share_C3 = np.stack(np.meshgrid(*[np.linspace(0.1, 0.9, 9)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        order_C = np.linalg.norm(share_C3 - middle, axis=1).argsort(kind="stable")
        centre_C3 = np.concatenate([middle[None], share_C3[order_C]]) * domain
        inside_C = (np.abs(centre_C3 - 0.5 * domain) + 0.5 * size <= 0.5 * domain + 1e-9).all(axis=1)
        distance_C, _ = point_tree(taken_A3).query(centre_C3, p=np.inf)  # infinite without points
        free_C = inside_C & (distance_C >= 0.5 * size + self.cell_size)
        if not free_C.any():
            raise ConfigError(f"size must leave room among particles and obstacles, got {size:g}; use a smaller one")
        return triple(centre_C3[free_C.argmax()])

    def move_obstacle(self, moved: PlacedObstacle) -> None:
        """Replaces the obstacle of the same body, if it is still there. Raises ConfigError for a place far outside."""
        reach, angles = 10 * max(self.domain_size), moved.rotation
        inside = all(abs(value) <= reach for value in moved.position) and all(map(math.isfinite, angles))
        require(inside, "obstacle", f"within {reach:g} of the origin, at finite angles", [*moved.position, *angles])
        moved_too = tuple(moved if o.body is moved.body else o for o in self.obstacles)
        self._set_obstacles(moved_too, before=self.newest.obstacles)

    def remove_obstacle(self, number: int) -> None:
        """Removes the obstacle whose body has this number."""
        self._set_obstacles(tuple(o for o in self.obstacles if o.body.number != number))

    def _set_obstacles(self, obstacles: tuple[PlacedObstacle, ...], before: tuple[PlacedObstacle, ...] = ()) -> None:
        """Replaces the obstacles. With weights that use `moving`, obstacles move from their places in `before`."""
        moving = {}
        if before and "moving" in self.simulator.network.config.own_physics:
            places = {obstacle.body.number: obstacle for obstacle in before}
            pairs = ((places.get(after.body.number, after), after) for after in obstacles)
            own = ((after, moved_from(place, after, 1 / self.simulator.frame_rate_hz)) for place, after in pairs)
            moving = {after: motion for after, motion in own if motion is not None}
        still = [obstacle for obstacle in obstacles if obstacle not in moving]
        self.live.replace_obstacles(with_obstacles(self.live.scenes[0], still, [*moving.values()]))
        self.obstacles = obstacles

    # gravity and weights

    def set_gravity(self, gravity: Vector) -> None:
        """Sets gravity in domain units per second squared.

        Raises ConfigError if it is not finite, above MAXIMUM_GRAVITY, or not supported by the weights.
        """
        size = math.hypot(*gravity)
        require(size <= MAXIMUM_GRAVITY, "gravity", f"finite and at most {MAXIMUM_GRAVITY:g} in size", list(gravity))
        self.live.set_gravity(gravity)

    def use_weights(self, simulator: Simulator, weights: str = "") -> None:
        """Continues with other weights from the present positions and velocities.

        Raises ConfigError for weights that do not support the scene, or that have another frame rate.
        """
        rate = self.simulator.frame_rate_hz
        require(simulator.frame_rate_hz == rate, "weights", f"for {rate} frames per second", simulator.frame_rate_hz)
        newest, history_NM3 = self.newest, self.recording.history(self.frame)
        first, velocity_N3 = self.live.scenes[0].selected(slice(len(newest.position_N3))), self._velocities()
        count = len(first.position_N3)
        now = replace(first, position_N3=newest.position_N3[:count], velocity_N3=velocity_N3[:count], past_HN3=None)
        live = LiveSimulation(simulator, now, self.maximum_particles)
        try:
            live.add_particles(newest.position_N3[count:], velocity_N3[count:], self.materials()[count:])
        except ConfigError:  # a material of added particles
            live.close()
            raise
        live.frame = self.frame
        if live.state.velocity_NM3.shape[1] == history_NM3.shape[1]:
            live.restore(newest.position_N3, history_NM3, self.frame)
        self.recording.enter(np.zeros(0, np.uint8), live.state.velocity_NM3[:0].cpu().numpy())
        self.live.close()
        self.live, self.simulator, self.weights = live, simulator, weights

    # saved files

    def scene_archive(self) -> bytes:
        """Returns the present scene: a zip of `scene.yaml`, files of particles, and the meshes.

        Particles of one material with equal constants are one group.
        Raises ConfigError without particles, because a scene file needs at least one.
        """
        require(len(self.newest.position_N3) > 0, "scene's particles", "at least one to be saved", 0, "pour some")
        groups: list[dict[str, object]] = []
        obstacles, files = [], {}
        position_N3 = np.clip(self.newest.position_N3, 0, np.array(self.domain_size, np.float32))
        velocity_N3, none_N = self._velocities(), np.full(len(position_N3), -1, np.float32)  # constants are never < 0
        columns = (np.append(np.nan_to_num(own, nan=-1), none_N[len(own) :]) for own in self._constants.values())
        row_NC = np.stack([self.materials(), *columns], axis=1)
        for row_C in np.unique(row_NC, axis=0):
            mine_N, material = (row_NC == row_C).all(axis=1), MATERIALS[int(row_C[0])]
            buffer = io.BytesIO()
            np.savez_compressed(buffer, position=position_N3[mine_N], velocity=velocity_N3[mine_N])
            name = f"{material}_{len(groups)}.npz"
            files[name] = buffer.getvalue()
            given = zip(self._constants, row_C[1:], strict=True)
            constants = {key: float(str(value)) for key, value in given if value >= 0}  # the digits of a float32
            groups.append({"particles": name, "material": material, **constants})
        for obstacle in self.obstacles:
            body = obstacle.body
            entry = {key: value for key, value in to_mapping(obstacle.entry).items() if value not in (None, [], ())}
            if body.mesh_file is not None:
                assert body.entry.mesh is not None
                entry["mesh"] = f"{body.name}{Path(body.entry.mesh).suffix}"
                files[entry["mesh"]] = body.mesh_file
            obstacles.append(entry)
        walls, floor, _ = self.live.scenes[0].wall_friction  # a scene file's side walls have one friction
        mapping = {
            "domain_size": list(self.domain_size),
            "cell_size": self.cell_size,
            "gravity": list(self.gravity),
            "particles_per_cell": self.particles_per_cell,
            "wall_friction": walls,
            "floor_friction": floor,
            "obstacles": obstacles,
            "groups": groups,
        }
        files["scene.yaml"] = yaml.safe_dump(mapping, sort_keys=False, default_flow_style=None).encode()
        archive = io.BytesIO()
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
            for name, content in files.items():
                file.writestr(name, content)
        return archive.getvalue()

    def rollout(self) -> Rollout:
        """Returns the newest frames as a rollout, whose file is within the bytes that are kept."""
        rate = self.simulator.frame_rate_hz
        return self.recording.rollout(
            self.domain_size, rate, self.cell_size, {"weights": self.weights, "scene": "play"}
        )
