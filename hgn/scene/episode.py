"""An episode: one scene's simulated trajectory, as stored in shards and read by the trainer.

Each field is a member of its own (`position.npy`, `material.npy`, ..., `json`). So any WebDataset or tar client can
read it. Pickles are not used.
Shape legend: T frames, N particles, K obstacle cells, H frames before frame 0, P particles of obstacles.
"""

import io
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from hgn.scene.material import MATERIALS, elastic_particles, require_materials
from hgn.scene.npz import read_header
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.scene.own_physics import input_parameters
from hgn.scene.rest_shape import body_numbers, rest_neighbours
from hgn.scene.specification import require_specification
from hgn.schema import BoxSize, ConfigError, OrdinarySize, Vector, from_mapping, require, require_bounds, strict_json

SCHEMA_VERSION = 1

POSITION_MEMBER = "position.npy"
DESCRIPTION_MEMBER = "json"
PARAMETER_PREFIX = "parameter_"
# arrays by name, each stored as a member NAME.npy: stored type, and axes by the shape legend
_ARRAYS = {
    "position": ("<f4", "TN3"),
    "velocity": ("<f4", "N3"),
    "material": ("|u1", "N"),
    "obstacle_cell": ("<i4", "K3"),
    "obstacle_normal": ("<f4", "K3"),
    "obstacle_friction": ("<f4", "K"),
    "past": ("<f4", "HN3"),
    "boundary": ("<f4", "P3"),
}
_PARAMETER = ("<f4", "N")
_OPTIONAL = ("obstacle_friction", "past", "boundary")  # the last two only in imported episodes

_NAME = re.compile(r"[A-Za-z0-9_-]+")
_FARTHEST_CELL = 65_535  # largest coordinate of an obstacle cell; those of a network's grid have as many bits
_FARTHEST = 1000.0  # largest coordinate, speed and gravity, in domain sizes; a network's grid reaches twice as far
_BLOCK_PARTICLES = 1 << 17  # number of particles times number of frames whose positions are checked in one call


@dataclass(frozen=True, eq=False)
class Episode:
    """A trajectory. Frame 0 is the initial state, so T frames are T - 1 steps of 1 / frame_rate_hz seconds.

    Raises: ConfigError for a wrong shape, type or value. `encode_episode` and `decode_episode` check that positions
    are finite; the class does not, because the check is slow and verified files need it only once.
    """

    key: str  # sample name inside the data set, without dots: train-000012
    position_TN3: np.ndarray  # float32, domain units
    initial_velocity_N3: np.ndarray  # float32, domain units per second
    material_N: np.ndarray  # uint8, index into `materials`
    obstacle_grid: ObstacleGrid
    domain_size: BoxSize
    gravity: Vector  # domain units per second squared
    frame_rate_hz: OrdinarySize
    seed: int
    specification: dict[str, Any]  # all choices that made the scene
    solver: dict[str, Any]  # settings and counters: substeps, projections, floors hit
    # per-particle material parameters that differ from the solver's defaults, float32 [N] by name
    material_parameters: dict[str, np.ndarray] = field(default_factory=dict)
    materials: tuple[str, ...] = MATERIALS  # imported sets append their own names
    past_HN3: np.ndarray | None = None  # float32, the frames before frame 0, oldest first; None: free flight
    boundary_P3: np.ndarray | None = None  # float32, particles at rest that represent obstacles
    wall_friction: Vector = (0.0, 0.0, 0.0)  # Coulomb coefficients of the domain's walls normal to x, y and z

    def __post_init__(self) -> None:
        require(bool(_NAME.fullmatch(self.key)), "key", "letters, digits, - and _ (a dot would end it)", self.key)
        position = self.position_TN3
        if position.ndim != 3 or position.shape[0] < 1 or position.shape[2] != 3:
            raise ConfigError(f"{self.key}: position must have shape [frames >= 1, N, 3], got {position.shape}")
        for name in self.material_parameters:
            require(bool(_NAME.fullmatch(name)), f"{self.key}: parameter names", "letters, digits, - and _", name)
        try:
            require_bounds(self)
        except ConfigError as error:
            raise ConfigError(f"{self.key}: {error}") from None
        arrays, farthest = self.arrays(), _FARTHEST * max(self.domain_size)
        lengths = dict(zip("TN3", position.shape, strict=True)) | {"K": len(self.obstacle_grid.cell_K3)}
        lengths |= {"H": len(arrays.get("past", ())), "P": len(arrays.get("boundary", ()))}
        for name, array in arrays.items():
            stored, axes = _ARRAYS.get(name, _PARAMETER)
            dtype, shape = np.dtype(stored).newbyteorder("="), tuple(lengths[axis] for axis in axes)
            if array.dtype != dtype:
                raise ConfigError(f"{self.key}: {name} must be of type {dtype.name}, got {array.dtype}")
            if array.shape != shape:
                raise ConfigError(f"{self.key}: {name} must have shape {shape}, got {array.shape}")
            if name != "position":
                far = name in ("velocity", "past", "boundary")
                _require_within(f"{self.key}: {name}", array, farthest if far else 3e38)
        _require_within(f"{self.key}: gravity", np.array(self.gravity), farthest)
        require_materials(f"{self.key}: material", self.material_N, self.materials)
        cell_size, cell_K3 = self.obstacle_grid.cell_size, self.obstacle_grid.cell_K3
        require(1e-9 <= cell_size <= 1e9, f"{self.key}: cell_size", "from 1e-9 to 1e9", cell_size)
        _require_within(f"{self.key}: obstacle_cell", cell_K3.astype(np.int64), _FARTHEST_CELL)
        step_K3 = np.diff(cell_K3.astype(np.int64), axis=0)
        first_K = np.take_along_axis(step_K3, (step_K3 != 0).argmax(axis=1)[:, None], axis=1)  # without a sort
        ordered = bool((first_K > 0).all())
        require(ordered, f"{self.key}: obstacle_cell", "sorted and unique", f"{len(cell_K3)} cells")
        least = min((*self.wall_friction, *arrays.get("obstacle_friction", ())))
        require(least >= 0, f"{self.key}: friction", "at least 0", least)

    @property
    def imported(self) -> bool:
        """Returns whether the episode was imported (hgn.import_trajectories)."""
        return self.specification.get("kind") == "imported"

    @property
    def parameters(self) -> np.ndarray | None:
        """Returns the parameters that may be network inputs, float32 [N, parameters]; None: all have their defaults."""
        return input_parameters(self.material_parameters, self.solver.get("settings", {}), self.particle_count)

    @cached_property
    def rest_neighbours(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns hgn.scene.rest_shape.rest_neighbours of frame 0, in which elastic bodies have their rest shape."""
        body_N, elastic_N = body_numbers(self), elastic_particles(self.material_N, self.materials)
        return rest_neighbours(np.array(self.position_TN3[0]), elastic_N, body_N)

    @property
    def dimensions(self) -> int:
        """Returns the number of dimensions of the motion; with 2, z is constant."""
        return int(self.specification.get("dimensions", 3))

    @property
    def frame_count(self) -> int:
        return int(self.position_TN3.shape[0])

    @property
    def particle_count(self) -> int:
        return int(self.position_TN3.shape[1])

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns the arrays by member name, in storage order."""
        arrays = {
            "position": self.position_TN3,
            "velocity": self.initial_velocity_N3,
            "material": self.material_N,
            "obstacle_cell": self.obstacle_grid.cell_K3,
            "obstacle_normal": self.obstacle_grid.normal_K3,
            "obstacle_friction": self.obstacle_grid.friction_K,
            "past": self.past_HN3,
            "boundary": self.boundary_P3,
        }
        parameters = {PARAMETER_PREFIX + name: value for name, value in sorted(self.material_parameters.items())}
        return {name: array for name, array in (arrays | parameters).items() if array is not None}


@dataclass(frozen=True)
class _Description:
    """The `json` member: the fields of an episode that are not arrays."""

    schema_version: int
    seed: int
    specification: dict[str, Any]
    solver: dict[str, Any]
    domain_size: Vector
    gravity: Vector
    frame_rate_hz: float
    cell_size: float
    materials: tuple[str, ...] = MATERIALS
    wall_friction: Vector = (0.0, 0.0, 0.0)


def encode_episode(episode: Episode) -> dict[str, tuple[bytes | memoryview, ...]]:
    """Returns the members of an episode by their name after `<key>.`, in storage order, each in parts.

    The same episode gives the same bytes on every machine: plain `.npy` (version 1.0, little-endian, C order) and JSON
    with sorted keys. Arrays are not copied: their parts are views of them.
    Raises: ConfigError if positions are not finite, or if specification or solver cannot be written as JSON.
    """
    _require_sound_positions(episode)
    members: dict[str, tuple[bytes | memoryview, ...]] = {
        f"{name}.npy": _encode_array(array, _ARRAYS.get(name, _PARAMETER)[0])
        for name, array in episode.arrays().items()
    }
    description = {
        "schema_version": SCHEMA_VERSION,
        "seed": episode.seed,
        "specification": episode.specification,
        "solver": episode.solver,
        "domain_size": list(episode.domain_size),
        "gravity": list(episode.gravity),
        "frame_rate_hz": episode.frame_rate_hz,
        "cell_size": episode.obstacle_grid.cell_size,
    }
    if episode.materials != MATERIALS:
        description["materials"] = list(episode.materials)
    if any(episode.wall_friction):
        description["wall_friction"] = list(episode.wall_friction)
    try:
        text = json.dumps(description, sort_keys=True, allow_nan=False, separators=(",", ":"))
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"{episode.key}: specification and solver must be plain JSON (finite numbers, text, lists, mappings), "
            f"got {error}"
        ) from None
    members[DESCRIPTION_MEMBER] = (text.encode(),)
    return members


def decode_episode(key: str, members: Mapping[str, bytes | np.ndarray], scan_positions: bool = True) -> Episode:
    """Decodes the members of `encode_episode`.

    Members are bytes or flat uint8 arrays. Arrays are views of the members.
    `scan_positions=False` skips the check for finite positions, for verified bytes.
    Raises: ConfigError for a missing or unknown member, another schema version, a wrong shape, type or value.
    """
    if DESCRIPTION_MEMBER not in members:
        raise ConfigError(f"{key}: member {DESCRIPTION_MEMBER} is missing; generate the data set again")
    description = _decode_description(key, bytes(members[DESCRIPTION_MEMBER]))
    arrays: dict[str, np.ndarray] = {}
    for member, data in members.items():
        name = member.removesuffix(".npy")
        if name != member and (name in _ARRAYS or name.startswith(PARAMETER_PREFIX)):
            dtype, axes = _ARRAYS.get(name, _PARAMETER)
            arrays[name] = decode_array(f"{key}.{member}", data, dtype, len(axes))
        elif member != DESCRIPTION_MEMBER:
            known = ", ".join((*(f"{name}.npy" for name in _ARRAYS), "json"))
            raise ConfigError(f"{key}.{member} is not a known member; known: {known}")
    for name in _ARRAYS:
        if name not in arrays and name not in _OPTIONAL:
            raise ConfigError(f"{key}: member {name}.npy is missing; generate the data set again")
    normal_K3, friction_K = arrays["obstacle_normal"], arrays.get("obstacle_friction")
    settings = description.solver.get("settings", {})
    if friction_K is None and settings.get("collider_friction", 0.0) > 0:
        friction_K = np.full(len(normal_K3), settings["collider_friction"], np.float32)
    episode = Episode(
        key=key,
        position_TN3=arrays["position"],
        initial_velocity_N3=arrays["velocity"],
        material_N=arrays["material"],
        obstacle_grid=ObstacleGrid(description.cell_size, arrays["obstacle_cell"], normal_K3, friction_K),
        domain_size=description.domain_size,
        gravity=description.gravity,
        frame_rate_hz=description.frame_rate_hz,
        seed=description.seed,
        specification=description.specification,
        solver=description.solver,
        material_parameters={
            name.removeprefix(PARAMETER_PREFIX): array for name, array in arrays.items() if name not in _ARRAYS
        },
        materials=description.materials,
        past_HN3=arrays.get("past"),
        boundary_P3=arrays.get("boundary"),
        wall_friction=description.wall_friction,
    )
    if scan_positions:
        _require_sound_positions(episode)
    return episode


def decode_array(name: str, data: bytes | np.ndarray, dtype: str, dimensions: int) -> np.ndarray:
    """Returns the array of a plain `.npy` file in memory (bytes or a flat uint8 array), as a view.

    Raises: ConfigError naming the member if it is not such a file, has another type or number of dimensions, or is
    shorter or longer than its header states.
    """
    raw = np.frombuffer(data, dtype=np.uint8) if isinstance(data, bytes) else data
    head = io.BytesIO(raw[:4096].tobytes())
    shape, fortran_order, stored = read_header(head, name, newest=(1, 0))
    if stored != np.dtype(dtype) or fortran_order:
        order = ", Fortran order" if fortran_order else ""
        raise ConfigError(f"{name} must be of type {dtype} in C order, got {stored.str}{order}")
    if len(shape) != dimensions:
        raise ConfigError(f"{name} must have {dimensions} dimensions, got shape {shape}")
    start, size = head.tell(), math.prod(shape) * stored.itemsize
    if len(raw) - start != size:
        raise ConfigError(f"{name} must have {size} bytes for shape {shape}, got {len(raw) - start}")
    try:
        return raw[start:].view(stored).reshape(shape)
    except ValueError as error:  # one length is 0 and another is too large
        raise ConfigError(f"{name} must have another shape, got {shape} ({error})") from None


def _decode_description(key: str, text: bytes) -> _Description:
    try:
        mapping = strict_json(text)
    except ValueError as error:
        raise ConfigError(f"{key}.json must be JSON, got {error}") from None
    require_schema_version(mapping, f"{key}.json")
    description = from_mapping(_Description, mapping, f"{key}.json")
    settings = description.solver.get("settings", {})
    require_specification(description.specification, settings, description.cell_size, f"{key}.json")
    return description


def require_schema_version(mapping: object, name: str) -> None:
    """Raises ConfigError unless `mapping["schema_version"]` is the current version. Call it before other checks."""
    version = mapping.get("schema_version") if isinstance(mapping, Mapping) else None
    remedy = "generate the data set again with this version, or use the version that made it"
    require(version == SCHEMA_VERSION, f"{name}: schema_version", str(SCHEMA_VERSION), version, remedy)


def _require_sound_positions(episode: Episode) -> None:
    # A block at a time, which fits into a core's cache. With a call per frame, threads that check episodes would delay
    # each other, because each call waits for the interpreter's lock.
    position_TN3, farthest = np.asarray(episode.position_TN3), _FARTHEST * max(episode.domain_size)
    frames = max(1, _BLOCK_PARTICLES // max(episode.particle_count, 1))
    for first in range(0, episode.frame_count, frames):
        block = position_TN3[first : first + frames]
        if not max(block.max(initial=0), -block.min(initial=0)) <= farthest:
            for frame, position_N3 in enumerate(block, first):
                _require_within(f"{episode.key}: position", position_N3, farthest, f" in frame {frame}")


def _require_within(name: str, array: np.ndarray, farthest: float, place: str = "") -> None:
    """Raises ConfigError for a value that is not finite, or farther from 0 than `farthest`."""
    if not np.abs(array).max(initial=0) <= farthest:
        at = tuple(int(i) for i in np.argwhere(~(np.abs(array) <= farthest))[0])
        rule = f"at most {farthest:g} in size" if np.isfinite(array[at]) else "finite"
        raise ConfigError(f"{name} must be {rule}, got {array[at]} at {list(at)}{place}")


def _encode_array(array: np.ndarray, dtype: str) -> tuple[bytes, memoryview]:
    plain = np.ascontiguousarray(np.asarray(array), dtype=dtype)
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, np.lib.format.header_data_from_array_1_0(plain))
    return header.getvalue(), plain.reshape(-1).view(np.uint8).data
