"""Scene files: YAML with obstacles (built-in shapes or meshes) and groups of particles.

See conf/example/ for examples. Lengths are in domain units, angles in degrees, y points up.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hgn.config import OBSTACLE_SHAPES, MpmConfig, config_directory
from hgn.scene.distance import contains, extent
from hgn.scene.emission import Face
from hgn.scene.group import MOST_PARTICLES, WALL_CELLS, Region, fill, particle_count, region_of
from hgn.scene.material import MATERIAL_PARAMETERS, MATERIALS, material_index
from hgn.scene.motion import Motion
from hgn.scene.particle_file import read_particles
from hgn.scene.rotation import euler_rotation, euler_rotations
from hgn.scene.scene import Obstacle, Scene, whole_cells
from hgn.scene.shapes import shape_obstacle
from hgn.schema import (
    Bounded,
    BoxSize,
    ConfigError,
    NonNegative,
    PathName,
    Positive,
    Vector,
    from_mapping,
    known_keys,
    near_file,
    require,
    require_bounds,
    to_mapping,
)
from hgn.system.claims import most_bytes
from hgn.system.yaml_files import read_yaml

GROUP_SHAPES, EMITTER_SHAPES = ("cube", "sphere", "box"), ("disc", "rectangle")
MAXIMUM_ENTRIES = 256  # entries are obstacles, or groups and emitters
# limit of the bytes of files of particles, each counted as often as a scene names it: FILES_BYTES, or REPEATS times the
# bytes of the files counted once, if that is more
FILES_BYTES, REPEATS = 12 << 20, 8
MEASURE = "measure"  # section of files in conf/gallery that tools.stability reads
MILLIMETRES = "a file in millimetres needs scale: 0.001"
MOST_TURNS = 1000  # of an obstacle between keyframes that are 180 degrees or more apart
EMITTER_STREAM = 2**31  # key of the emitters' random streams, which are separate from those of groups


@dataclass(frozen=True)
class KeyframeEntry(Bounded):
    """A pose of an obstacle relative to its initial pose."""

    time: NonNegative[float]  # seconds
    translation: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)  # degrees about fixed axes (x, then y, then z) through the obstacle's position


@dataclass(frozen=True)
class ObstacleEntry:
    """An obstacle: either `mesh` (a file, with `scale`) or `shape` (a built-in one, with `size`)."""

    mesh: PathName | None = None  # path relative to the scene file
    scale: Positive[float] | None = None  # factor for the mesh; null: 1
    shape: str | None = None
    size: Positive[float] | None = None  # side, diameter, or base width and height
    position: Vector | None = None  # translation of a mesh (null: none), or centre of a shape
    rotation: Vector = (0.0, 0.0, 0.0)  # degrees about the fixed x axis, then y, then z
    friction: NonNegative[float] | None = None  # Coulomb coefficient; null: 0
    keyframes: tuple[KeyframeEntry, ...] = ()  # poses in order of time; left out: the obstacle is at rest

    def __post_init__(self) -> None:
        require_bounds(self)
        if (self.mesh is None) == (self.shape is None):
            seen = "neither" if self.mesh is None else "both"
            raise ConfigError(f"mesh or shape must be given, not both, got {seen}")
        if self.mesh is not None:
            require(self.size is None, "size", "left out with mesh", self.size, "meshes take scale")
        else:
            require(self.shape in OBSTACLE_SHAPES, "shape", f"one of {', '.join(OBSTACLE_SHAPES)}", self.shape)
            require(self.scale is None, "scale", "left out with shape", self.scale, "shapes take size")
            require(self.size is not None, "size", "given with shape", self.size)
            require(self.position is not None, "position", "given with shape", self.position)
        _ = self.motion  # checks the keyframes

    @functools.cached_property
    def motion(self) -> Motion | None:
        """Returns the motion of the obstacle, or None."""
        if not self.keyframes:
            return None
        key_T7 = _without_half_turns(np.array([(k.time, *k.translation, *k.rotation) for k in self.keyframes]))
        rotation_T33 = euler_rotations(key_T7[:, 4:].tolist())
        return Motion(key_T7[:, 0], key_T7[:, 1:4], rotation_T33, self.position or (0.0, 0.0, 0.0))


def _without_half_turns(key_T7: np.ndarray) -> np.ndarray:
    """Returns rows of time, translation and rotation, with others between those 180 degrees or more apart.

    Motion interpolates along the shorter way. Raises: ConfigError for large turns about several axes.
    """
    turn_T3 = np.abs(np.diff(key_T7[:, 4:], axis=0))
    far_T = turn_T3.max(axis=1) >= 180
    rule = "of rotations less than 180 degrees apart, or different in one angle"
    wrong_T = np.flatnonzero(far_T & (np.count_nonzero(turn_T3, axis=1) > 1))[:1]
    require(not len(wrong_T), "keyframes", rule, key_T7[np.append(wrong_T, wrong_T + 1), 4:].tolist())
    turns = float(turn_T3[far_T].sum()) / 360
    require(turns <= MOST_TURNS, "keyframes", f"of at most {MOST_TURNS} turns together", turns)
    piece_T = np.where(far_T, np.ceil(turn_T3.max(axis=1) / 120), 1).astype(int)
    rows = zip(key_T7, key_T7[1:], piece_T, strict=False)
    return np.concatenate([key_T7[:1], *(np.linspace(before, after, count + 1)[1:] for before, after, count in rows)])


@dataclass(frozen=True, kw_only=True)
class MaterialEntry:
    """A material, and constants that replace the solver's settings."""

    material: str
    youngs_modulus_pa: float | None = None
    poisson_ratio: float | None = None
    density_kg_m3: float | None = None
    sand_friction_angle_deg: float | None = None
    snow_hardening: float | None = None
    snow_critical_compression: float | None = None
    snow_critical_stretch: float | None = None
    water_tension: float | None = None
    water_viscosity_pa_s: float | None = None

    def __post_init__(self) -> None:
        require_bounds(self)
        MpmConfig(**self.parameters)  # validates the constants
        material_index(self.material)

    @property
    def parameters(self) -> dict[str, Any]:
        """Returns the given constants of the material, by name."""
        given = {name: getattr(self, name) for name in MATERIAL_PARAMETERS}
        return {name: value for name, value in given.items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class GroupEntry(MaterialEntry):
    """A volume of one material that is filled with random particles, or `particles`, a file that contains them."""

    shape: str | None = None  # cube, sphere or box
    size: float | tuple[float, float, float] | None = None  # side, diameter, or the three edges of a box
    position: Vector | None = None  # position of the centre
    particles: PathName | None = None  # .npz with position and optionally velocity [N, 3], or USD; relative to the file
    velocity: Vector = (0.0, 0.0, 0.0)  # domain units per second

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("shape", "size", "position"):
            given = getattr(self, name)
            if self.particles is None:
                require(given is not None, name, "given", None, "or give particles, a file")
            else:
                require(given is None, name, "left out with particles", given)
        if self.particles is not None:
            return
        require(self.shape in GROUP_SHAPES, "shape", f"one of {', '.join(GROUP_SHAPES)}", self.shape)
        rule = "a list of three edges for a box" if self.shape == "box" else f"one number for a {self.shape}"
        require(isinstance(self.size, tuple) == (self.shape == "box"), "size", rule, self.size)
        for edge in self.edges:
            require(0 < edge < math.inf, "size", "finite and > 0", self.size)
        assert self.position is not None

    @property
    def edges(self) -> Vector:
        """Returns the three edges, or three times the side or diameter."""
        assert self.size is not None
        return self.size if isinstance(self.size, tuple) else (self.size, self.size, self.size)

    @property
    def region(self) -> Region:
        """Returns the region that the shape fills."""
        assert self.shape is not None and self.position is not None
        return region_of(self.shape, self.edges, self.position)


@dataclass(frozen=True, kw_only=True)
class EmitterEntry(MaterialEntry):
    """A face through which particles enter, at the density of groups."""

    shape: str  # disc or rectangle, perpendicular to the velocity
    size: float | tuple[float, float]  # diameter, or the edges of a rectangle; the first one is horizontal
    position: Vector  # position of the centre
    velocity: Vector  # velocity of entering particles, domain units per second
    stop: NonNegative[float]  # seconds after the start of the simulation
    start: NonNegative[float] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.shape in EMITTER_SHAPES, "shape", f"one of {', '.join(EMITTER_SHAPES)}", self.shape)
        rule = "a list of two edges for a rectangle" if self.shape == "rectangle" else "one number for a disc"
        require(isinstance(self.size, tuple) == (self.shape == "rectangle"), "size", rule, self.size)
        for edge in self.size if isinstance(self.size, tuple) else (self.size,):
            require(0 < edge < math.inf, "size", "finite and > 0", self.size)
        require(1e-15 <= math.hypot(*self.velocity) <= 1e15, "velocity", "of length 1e-15 to 1e15", self.velocity)
        require(self.stop > self.start, "stop", f"later than start ({self.start:g})", self.stop)

    @property
    def face(self) -> Face:
        if isinstance(self.size, tuple):
            return Face(self.position, self.velocity, edges=self.size)
        return Face(self.position, self.velocity, radius=0.5 * self.size)


@dataclass(frozen=True)
class SceneFile:
    """The content of a scene file. The defaults are the paper's."""

    groups: tuple[GroupEntry, ...] = ()
    emitters: tuple[EmitterEntry, ...] = ()
    obstacles: tuple[ObstacleEntry, ...] = ()
    domain_size: BoxSize = (1.0, 1.0, 1.0)
    cell_size: Positive[float] = 1 / 64  # edge of the cells of the solver's grid and of obstacle cells
    gravity: Vector = (0.0, -9.8, 0.0)  # domain units per second squared
    particles_per_cell: Positive[float] = 8.0
    floor_friction: NonNegative[float] = 0.0  # Coulomb coefficient of the domain's floor and ceiling
    wall_friction: NonNegative[float] = 0.0  # Coulomb coefficient of the side walls
    seed: int = 0  # seed of the particles and of the obstacle samples

    def __post_init__(self) -> None:
        require_bounds(self)
        require(len(self.groups + self.emitters) > 0, "groups", "a list with at least one group, or emitters", [])
        for name, entries in (("groups and emitters", self.groups + self.emitters), ("obstacles", self.obstacles)):
            require(len(entries) <= MAXIMUM_ENTRIES, name, f"at most {MAXIMUM_ENTRIES}", len(entries), "join some")
        require(self.seed >= 0, "seed", "a whole number >= 0", self.seed)


def find_scene(name: str) -> Path:
    """Returns the file at a path, or the scene in conf/example or conf/gallery with a name such as `funnel`.

    Raises: ConfigError for a name without suffix that is neither a file nor an example.
    """
    if Path(name).is_file() or not re.fullmatch(r"\w*", name):
        return Path(name)
    files = scene_files("example") | scene_files("gallery")
    own = f"did you mean {name}.yaml?" if Path(f"{name}.yaml").is_file() else known_keys(name, files, "examples")
    require(name in files, "scene", "a YAML file or the name of an example", name, own)
    return files[name]


def scene_files(folder: str) -> dict[str, Path]:
    """Returns the scene files in a folder of conf by name."""
    return {path.stem: path for path in sorted((config_directory() / folder).glob("*.yaml"))}


def load_scene(path: str | Path) -> Scene:
    """Reads a scene file.

    Each group has its own random stream, so a change of one group does not move the particles of others.
    Raises: ConfigError, starting with the path, for unknown keys, invalid values, unreadable meshes, and groups that
    overlap the solver's walls (3 cells) or closed obstacles.
    """
    return scene_of(read_mapping(path), path)


def read_mapping(path: str | Path) -> dict[str, Any]:
    """Reads the YAML of a scene file. Raises: ConfigError, starting with the path."""
    path = Path(path)
    if not path.is_file():
        others = ", ".join(sorted(each.name for each in path.parent.glob("*.y*ml") if each.is_file()))
        remedy = near_file(path) or (others and f"YAML files there: {others}")
        raise ConfigError(f"scene must be an existing YAML file, got {path}; {remedy}".removesuffix("; "))
    mapping = read_yaml(path)
    require(isinstance(mapping, dict), f"{path}: the file", "a mapping of keys to values, such as groups", mapping)
    return dict(mapping)


@np.errstate(all="ignore")  # numbers that are not finite are refused
def scene_of(mapping: Mapping[str, Any], path: str | Path) -> Scene:
    """Returns the scene of a file's content. Meshes are relative to `path`. Raises: ConfigError as load_scene."""
    content = {key: value for key, value in mapping.items() if key != MEASURE}
    try:
        file = from_mapping(SceneFile, content)
        for index, entry in enumerate(content.get("obstacles", ())):
            name, remedy = f"obstacles[{index}].keyframes", "leave them out for an obstacle at rest"
            require(entry.get("keyframes") != [], name, "at least one", [], remedy)
        return _build(file, Path(path).parent)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _build(file: SceneFile, folder: Path) -> Scene:
    whole_cells(file.domain_size, file.cell_size)
    _require_few_repeats([entry.particles for entry in file.groups], folder)
    bodies = list(_obstacles(file.obstacles, folder))
    # sheets of partly watertight meshes come last, so that entry i has obstacle i
    obstacles = (*(first for first, *_ in bodies), *(sheet for _, *others in bodies for sheet in others))
    rule = f"at most {MOST_PARTICLES} particles together, with those of emitters"
    total: float = 0
    stored: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for i, entry in enumerate(file.groups):
        if entry.particles is not None:
            name = f"groups[{i}].particles"
            stored[i] = read_particles(folder / entry.particles, name, entry.material, file.domain_size)
            total += len(stored[i][0])
            require(total <= MOST_PARTICLES, "groups", rule, total, "leave some files out")
    filling = file.particles_per_cell, file.cell_size
    try:
        counts = [
            len(stored[i][0]) if i in stored else particle_count(entry.region, *filling)
            for i, entry in enumerate(file.groups)
        ]
        entering = [e.face.count(e.stop - e.start, *filling) for e in file.emitters]
        total = sum(counts) + sum(entering)
    except ArithmeticError:  # sizes or cells beyond the range of floats
        total = math.inf
    require(total <= MOST_PARTICLES, "groups", rule, total, "lower size or particles_per_cell")
    positions, times = [], [np.zeros(sum(counts))]
    for index, (entry, count) in enumerate(zip(file.groups, counts, strict=True)):
        if index in stored:
            positions.append(stored[index][0])
            continue
        region, name = entry.region, f"groups[{index}] ({entry.shape} of {entry.material})"
        position_N3 = fill(region, count, np.random.Generator(np.random.PCG64([file.seed, index])))
        _require_inside_walls(name, np.array(region.centre), region.reach, position_N3, file)
        _require_clear(name, position_N3, obstacles, file)
        positions.append(position_N3)
    for index, (emitter, count) in enumerate(zip(file.emitters, entering, strict=True)):
        name = f"emitters[{index}] ({emitter.shape} of {emitter.material})"
        rng = np.random.Generator(np.random.PCG64([file.seed, EMITTER_STREAM, index]))
        position_N3, time_N = emitter.face.draw(emitter.start, emitter.stop, count, rng)
        _require_inside_walls(name, np.array(emitter.position), emitter.face.reach, position_N3, file)
        _require_clear(name, np.vstack([position_N3, np.array(emitter.position, np.float32)]), obstacles, file)
        positions.append(position_N3)
        times.append(time_N)
    entries: list[GroupEntry | EmitterEntry] = [*file.groups, *file.emitters]
    sizes = counts + entering
    velocity_N3 = np.repeat(np.array([entry.velocity for entry in entries], np.float32), sizes, axis=0)
    begins = np.cumsum(sizes) - sizes
    for index, (_, own_N3) in stored.items():
        velocity_N3[begins[index] : begins[index] + sizes[index]] += own_N3
    entry_s_N = np.concatenate(times)
    order = np.argsort(entry_s_N, kind="stable")  # groups come first
    return Scene(
        position_N3=np.concatenate(positions)[order],
        velocity_N3=velocity_N3[order],
        material_N=np.repeat(np.array([MATERIALS.index(e.material) for e in entries], np.uint8), sizes)[order],
        obstacles=obstacles,
        domain_size=file.domain_size,
        cell_size=file.cell_size,
        gravity=file.gravity,
        seed=file.seed,
        particles_per_cell=file.particles_per_cell,
        wall_friction=(file.wall_friction, file.floor_friction, file.wall_friction),
        material_parameters={name: value[order] for name, value in _material_parameters(entries, sizes).items()},
        specification={"kind": "file", **to_mapping(file), "particle_counts": sizes},
        entry_s_N=entry_s_N[order] if file.emitters else None,
    )


def _material_parameters(groups: Sequence[MaterialEntry], counts: list[int]) -> dict[str, np.ndarray]:
    """Returns the constants of the groups by name, float32 [N]; NaN for groups without the constant."""
    names = [name for name in MATERIAL_PARAMETERS if any(name in group.parameters for group in groups)]
    columns = {name: [group.parameters.get(name, np.nan) for group in groups] for name in names}
    return {name: np.repeat(np.array(column, np.float32), counts) for name, column in columns.items()}


def _sizes(names: Iterable[str | None], folder: Path) -> list[tuple[Path, int]]:
    paths = [(folder / name).resolve() for name in names if name and (folder / name).is_file()]
    return [(path, path.stat().st_size) for path in paths]


def _require_few_repeats(particles: Iterable[str | None], folder: Path) -> None:
    """Raises ConfigError for files that together would take minutes and gigabytes, because they are named often."""
    sizes = _sizes(particles, folder)
    size, most = sum(size for _, size in sizes), max(FILES_BYTES, REPEATS * sum(dict(sizes).values()))
    rule = f"of at most {most} bytes together, each counted as often as it is named"
    require(size <= most, "particles", rule, size, "join entries of one file, or simplify the file")


def _obstacles(entries: Sequence[ObstacleEntry], folder: Path) -> Iterator[tuple[Obstacle, ...]]:
    """Yields the obstacles of each entry: one, or two for a mesh with watertight bodies and other triangles."""
    surfaces: Any = None
    for index, entry in enumerate(entries):
        if entry.mesh is None:
            assert entry.shape is not None and entry.size is not None and entry.position is not None
            name = f"obstacle_{index}_{entry.shape}"
            bodies: tuple[Obstacle, ...] = (
                shape_obstacle(entry.shape, entry.size, entry.position, euler_rotation(entry.rotation), name),
            )
        else:
            # it imports parts of SciPy that few scenes need
            from hgn.scene.mesh import Surfaces, load_bodies

            if surfaces is None:
                # half, because cuts of concave faces, which count least for their time, take about 10 s for 12 MB
                size = sum(dict(_sizes((each.mesh for each in entries), folder)).values()) // 2
                surfaces = Surfaces(most_bytes(size))
            bodies = load_bodies(
                folder / entry.mesh,
                f"obstacles[{index}].mesh",
                scale=1.0 if entry.scale is None else entry.scale,
                translation=entry.position or (0.0, 0.0, 0.0),
                rotation=entry.rotation,
                surfaces=surfaces,
            )
        yield tuple(dataclasses.replace(body, friction=entry.friction or 0.0, motion=entry.motion) for body in bodies)


def _require_clear(name: str, position_N3: np.ndarray, obstacles: Sequence[Obstacle], file: SceneFile) -> None:
    for obstacle in (each.at(0.0) for each in obstacles):
        if inside := int(contains(position_N3, obstacle).sum()):
            larger = (np.ptp(obstacle.vertex_V3, axis=0) >= file.domain_size).all()
            unit = f", or its scale ({MILLIMETRES})" if larger else ""
            extents = f"particles: {extent(position_N3)}; obstacle: {extent(obstacle.vertex_V3)}"
            raise ConfigError(
                f"{name} must be clear of closed obstacles, got {inside} of {len(position_N3)} particles inside "
                f"{obstacle.name} ({extents}); move or shrink the particles or the obstacle{unit}"
            )


def _require_inside_walls(
    name: str, centre: np.ndarray, reach: np.ndarray, position_N3: np.ndarray, file: SceneFile
) -> None:
    wall = WALL_CELLS * file.cell_size
    high = np.array(file.domain_size) - wall
    if (centre - reach >= wall - 1e-9).all() and (centre + reach <= high + 1e-9).all():
        return
    outside = int(((position_N3 < wall) | (position_N3 > high)).any(axis=1).sum())
    raise ConfigError(
        f"{name} must lie between the walls, which are {WALL_CELLS} cells ({wall:g}) thick, got {outside} of "
        f"{len(position_N3)} particles outside; move or shrink it, or raise domain_size"
    )
