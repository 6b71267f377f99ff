"""The scenes of conf/gallery as cases of the stability reports.

A gallery file is a scene file with a section `measure`: frames, bounds (observables.BoundEntry), and numbers that draws
vary. Draw 0 is the file itself. Draw 1 is for choices between networks, draw 2 for reports, the others are free.
"""

import copy
import functools
import hashlib
import json
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hgn.scene.scene import Scene
from hgn.scene.scene_file import MEASURE, GroupEntry, SceneFile, read_mapping, scene_files, scene_of
from hgn.schema import ConfigError, FrameCount, from_mapping, known_keys, require, require_bounds, to_mapping
from tools.scenes import joined
from tools.stability.observables import LACKS, BoundEntry, Film

GALLERY = "gallery"
NAME = re.compile(rf"({GALLERY}(?:_(\d+))?)(?::(.+))?")  # a case: a draw of the gallery, or one scene of a draw
GALLERY_CASES = "gallery, gallery_NUMBER, gallery:SCENE, gallery_NUMBER:SCENE"  # for messages
GRID_CELLS = (64, 96)  # solver cells per unit of length
REFERENCE = Path(__file__).parents[2] / "results" / "stability"
ATTEMPTS = 20  # largest number of attempts at a draw, if its groups have too little space


@dataclass(frozen=True, kw_only=True)
class VaryEntry:
    """A number that each draw takes from a range, and adds to values of the file, times a factor for each value."""

    range: tuple[float, float]
    add: dict[str, float]  # factors by place in the file, as in groups.0.position.1

    def __post_init__(self) -> None:
        require(-1e9 <= self.range[0] <= self.range[1] <= 1e9, "range", "in order, from -1e9 to 1e9", [*self.range])
        require(len(self.add) > 0, "add", "at least one place in the file", self.add)


@dataclass(frozen=True, kw_only=True)
class MeasureEntry:
    """The section `measure` of a gallery file."""

    kind: str  # kind of scene, for a column of tables
    frames: FrameCount  # number of simulated frames, at 60 per second
    bounds: tuple[BoundEntry, ...]
    vary: tuple[VaryEntry, ...] = ()
    far: GroupEntry | None = None  # a body that is added far away, in a second simulation

    def __post_init__(self) -> None:
        require_bounds(self)
        require(len(self.bounds) > 0, "bounds", "at least one", [])
        for index, bound in enumerate(self.bounds):
            last = max(bound.frames[1], bound.since)
            require(last < self.frames, f"bounds[{index}].frames", f"below frames ({self.frames})", last)


@dataclass(frozen=True, eq=False)
class GalleryCase:
    """A gallery scene: its file's content with a draw's changes, on any grid."""

    name: str
    file: Path
    content: Mapping[str, Any]
    measure: MeasureEntry

    def scene(self, cells: int = GRID_CELLS[0], far: bool = False) -> Scene:
        """Returns the scene on a grid of `cells` cells per unit of length, with the far body if wanted."""
        content: dict[str, Any] = {**self.content, "cell_size": 1 / cells}
        scene = scene_of(content, self.file)
        if not far:
            return scene
        body = {**content, "groups": [self.content[MEASURE]["far"]], "emitters": [], "obstacles": []}
        return joined([scene, scene_of(body, self.file)])

    @functools.cached_property
    def scenes(self) -> tuple[Scene, ...]:
        """The scene on the file's own grid, and with the far body."""
        return (self.scene(), *((self.scene(far=True),) if self.measure.far else ()))

    @functools.cached_property
    def digest(self) -> str:
        """Identifies the simulated scene. Bounds and their frames are not part of it: they need no new simulation."""
        scene = self.scenes[0]
        meshes = [mesh.vertex_V3.tobytes() + mesh.triangle_F3.tobytes() for mesh in scene.obstacles]
        given = {
            "scene": scene.specification, "far": to_mapping(self.measure.far), "frames": self.measure.frames,
            "meshes": [hashlib.sha256(mesh).hexdigest() for mesh in meshes],
        }  # fmt: skip
        return hashlib.sha256(json.dumps(given, sort_keys=True).encode()).hexdigest()[:16]

    def film(self, scene: Scene, trials: Sequence[np.ndarray], rate_hz: float) -> Film:
        """Returns the film of a trajectory, and of the one with the far body if there is one."""
        beside = trials[1][:, : scene.particle_count] if len(trials) > 1 else None
        density = self.content.get("particles_per_cell", SceneFile.particles_per_cell)
        return Film(scene, trials[0], rate_hz, 1 / GRID_CELLS[0], density, beside)


def is_gallery(name: str) -> bool:
    """Returns whether a case is the gallery, a draw of it, or one of their scenes."""
    return NAME.fullmatch(name) is not None


def load_gallery(case: str = GALLERY) -> list[GalleryCase]:
    """Returns the scenes of a case such as gallery_1 or gallery:tap. Raises: ConfigError, starting with the file."""
    match = NAME.fullmatch(case)
    assert match is not None
    files = scene_files(GALLERY)
    require(len(files) > 0, "cases", "without gallery where conf/gallery has no scenes", case)
    if scene := match[3]:
        require(scene in files, "cases", "scenes of conf/gallery", case, known_keys(scene, files, "scenes"))
        files = {scene: files[scene]}
    return [load_case(name, file, int(match[2] or 0)) for name, file in files.items()]


def load_case(name: str, file: Path, draw: int = 0) -> GalleryCase:
    """Reads a gallery file. Raises: ConfigError, starting with the file."""
    given = read_mapping(file)
    try:
        require(MEASURE in given, MEASURE, "a section with frames and bounds", None)
        for attempt in range(ATTEMPTS):
            try:
                return _case(name, file, _drawn(given, name, draw, attempt))
            except ConfigError:
                if not draw or attempt == ATTEMPTS - 1:
                    raise
        raise AssertionError
    except ConfigError as error:
        raise error if str(error).startswith(str(file)) else ConfigError(f"{file}: {error}") from None


def _drawn(given: Mapping[str, Any], name: str, draw: int, attempt: int) -> dict[str, Any]:
    """Returns the file's content with the changes of a draw. `attempt` counts repetitions for lack of space."""
    content: dict[str, Any] = copy.deepcopy(dict(given))
    rng = np.random.default_rng([draw, zlib.crc32(name.encode()), attempt])
    for index, vary in enumerate(from_mapping(MeasureEntry, content[MEASURE], MEASURE).vary):
        drawn = float(rng.uniform(*vary.range)) if draw else 0.0
        for place, factor in vary.add.items():
            _add(content, place, factor * drawn, f"{MEASURE}.vary[{index}].add")
    return content | ({"seed": draw} if draw else {})


def _case(name: str, file: Path, content: Mapping[str, Any]) -> GalleryCase:
    """Returns a scene. Raises: ConfigError if a bound cannot be measured in it."""
    case = GalleryCase(name, file, content, from_mapping(MeasureEntry, content[MEASURE], MEASURE))
    scene, far = case.scene(), case.measure.far
    plain = not scene.emits and not scene.material_parameters
    rule = "left out in scenes with emitters or constants of materials"
    require(plain or far is None, f"{MEASURE}.far", rule, "a body")
    groups = 0 if scene.emits else len(content["groups"])
    for index, bound in enumerate(case.measure.bounds):
        where = f"{MEASURE}.bounds[{index}]"
        if bound.of in LACKS:
            lacks, rule = LACKS[bound.of]
            require(not lacks(scene, far), f"{where}.of", f"measured in scenes with {rule}", bound.of)
        rule = f"one of the {groups} groups, from 0, of a scene without emitters"
        require(bound.group is None or 0 <= bound.group < groups, f"{where}.group", rule, bound.group)
    if far is not None:
        try:
            case.scene(far=True)
        except ConfigError as error:
            raise ConfigError(f"{MEASURE}.far: {str(error).removeprefix(f'{file}: ')}") from error
    return case


def _add(content: Any, place: str, change: float, field: str) -> None:
    """Adds to a number in nested mappings and lists."""
    *parents, last = [int(part) if part.isdecimal() else part for part in place.split(".")]
    try:
        for part in parents:
            content = content[part]
        content[last] += change
    except (KeyError, IndexError, TypeError):
        raise ConfigError(
            f"{field} must be places of numbers in the file, as in groups.0.position.1, got {place}"
        ) from None
