"""Checks the parts of a stored scene's specification that programs read, because untrusted files have any JSON."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any

from hgn.config import MOST_OBSTACLES, OBSTACLE_SHAPES, is_mesh_file
from hgn.scene.material import INPUT_PARAMETERS
from hgn.scene.motion import Motion
from hgn.scene.surface import MAXIMUM_SAMPLES
from hgn.schema import Bound, Bounded, ConfigError, NonNegative, from_mapping, require, require_bounds

_Extent = Annotated[float, Bound("from 1e-9 to 1000", lambda value: 1e-9 <= value <= 1000)]
_Place = Annotated[float, Bound("from -1e9 to 1e9", lambda value: abs(value) <= 1e9)]
_Dimensions = Annotated[int, Bound("2 or 3", (2, 3).__contains__)]
_MOST = 1e15  # largest friction and parameter


@dataclass(frozen=True)
class _Obstacle:
    """An obstacle of a random scene."""

    shape: str
    size: _Extent  # domain units
    position: tuple[_Place, _Place, _Place]
    quaternion: tuple[float, float, float, float]
    friction: NonNegative[float] | None = None
    keyframes: tuple[tuple[float, tuple[float, float, float]], ...] | None = None

    def __post_init__(self) -> None:
        require_bounds(self)
        fits = self.shape in OBSTACLE_SHAPES or is_mesh_file(self.shape)
        require(fits, "shape", f"one of {', '.join(OBSTACLE_SHAPES)}, or a mesh file", self.shape)
        length = math.hypot(*self.quaternion)
        require(abs(length - 1) < 1e-6, "quaternion", "of length 1", length)
        if self.keyframes is not None:
            require(len(self.keyframes) > 0, "keyframes", "at least one", [])
            Motion.of_frames(self.keyframes, self.position)


@dataclass(frozen=True)
class _Group(Bounded):
    """A group of particles."""

    particle_count: NonNegative[int] = 0


@dataclass(frozen=True)
class _Specification(Bounded):
    """The parts of a specification that are read for all kinds of scenes."""

    dimensions: _Dimensions = 3
    particle_counts: tuple[NonNegative[int], ...] | None = None
    groups: tuple[dict[str, Any], ...] = ()
    layout: str = ""


def require_specification(specification: Mapping[str, Any], settings: object, cell_size: float, name: str) -> None:
    """Raises ConfigError, starting with `name`, for values that programs cannot read or compute with."""
    found: Any = _of(_Specification, specification, f"{name}.specification")
    for i, group in enumerate(found.groups):
        _of(_Group, group, f"{name}.specification.groups[{i}]")
    if specification.get("kind") == "random":
        path, records = f"{name}.specification.obstacles", specification.get("obstacles")
        require(isinstance(records, list), path, "a list", records)
        require(len(records or ()) <= MOST_OBSTACLES, path, f"at most {MOST_OBSTACLES}", len(records or ()))
        obstacles = [_of(_Obstacle, record, f"{path}[{i}]") for i, record in enumerate(records or ())]
        area = sum(obstacle.size * obstacle.size for obstacle in obstacles)
        rule = f"of sizes whose squares sum to at most {MAXIMUM_SAMPLES} cells"
        require(area <= MAXIMUM_SAMPLES * cell_size * cell_size, path, rule, area)
    require(isinstance(settings, Mapping), f"{name}.solver.settings", "a mapping", settings)
    for key, value in settings.items() if isinstance(settings, Mapping) else ():
        if key in ("collider_friction", *INPUT_PARAMETERS):
            number = isinstance(value, (int, float)) and 0 <= value <= _MOST
            require(number, f"{name}.solver.settings.{key}", f"from 0 to {_MOST:g}", value)


def _of(cls: type[Any], mapping: object, path: str) -> Any:
    """Returns the fields of `cls` in a mapping; others are not read."""
    if not isinstance(mapping, Mapping):
        raise ConfigError(f"{path} must be a mapping, got {mapping!r:.60}")
    names = {field.name for field in fields(cls)}
    return from_mapping(cls, {key: value for key, value in mapping.items() if key in names}, path)
