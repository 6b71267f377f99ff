"""A rollout in one HDF5 file that ParaView plays as an animation.

Two top-level groups:

/VTKHDF  a temporal PolyData of the VTKHDF specification (version 2). A step contains the obstacles' triangles and a
         vertex cell for each particle; the obstacles' points come first. PointData has `material` (255 on obstacles)
         and `velocity`. CellData has `obstacle`: the obstacle's number, or -1 for particles. Topology and materials
         are stored once; each step refers to those of the particles that are present.
/hgn     data without a place in VTK: domain, gravity, obstacles, source, ground truth. The specification allows other
         groups outside /VTKHDF.

ParaView selects its VTKHDF reader by the suffixes .vtkhdf and .hdf. For other suffixes choose it in the dialogue.
Shape legend: T frames, N particles, R frames of ground truth (in row_R3: rows), V vertices, P points (vertices and
particles), F triangles, C cells.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from hgn.scene.hdf5 import FileOnDisk, open_hdf5
from hgn.scene.material import MATERIALS, require_materials
from hgn.scene.motion import Motion
from hgn.scene.scene import Obstacle
from hgn.scene.simulated_frames import Simulation, simulated
from hgn.schema import Bound, BoxSize, ConfigError, OrdinarySize, Vector, require, require_bounds, strict_json, triple
from hgn.system.claims import Claims
from hgn.system.files import make_folder, space_reserved, sync_folder, sync_written, temporary_file

if TYPE_CHECKING:
    import h5py

FORMAT_NAME = "hgn rollout"
FORMAT_VERSION = 2  # version 1 had no obstacles in /VTKHDF
OBSTACLE_MATERIAL = 255
MOTION_FIELDS = ("time_T", "translation_T3", "rotation_T33")
VTKHDF_VERSION = (2, 0)  # the oldest version with temporal PolyData, for older ParaViews
CELL_CATEGORIES = {"Vertices": 1, "Lines": 1, "Polygons": 3, "Strips": 1}  # corners, in the order of Steps/CellOffsets
WRITE_EVERY_S = 1.0  # interval between writes of a growing file
LARGEST = 1e15  # largest size of a number, so that float32 stores its square
FARTHEST = 1000  # largest coordinate of particles in a file, in domain sizes; a simulation diverges before
# kinds of the numbers in datasets, as NumPy calls them
KINDS = {"VTKHDF/Points": "f", "VTKHDF/NumberOfPoints": "iu", "hgn/reference": "f", "hgn/entry_frame": "iu"}
TRIANGLE_BYTES = 1000  # about the memory that a picture takes for a triangle
FRAMES_OF_A_CHUNK = 64  # of datasets with one row for each frame
POINTS_OF_A_WRITE = 1_000_000  # points of the frames that are in memory together; each takes about 100 bytes


@dataclass(frozen=True, eq=False)
class Rollout:
    """A simulated trajectory with all data for drawing it. Frame 0 is the initial state.

    Positions of a diverged rollout may be NaN. The ground truth may have fewer or more frames than the rollout.
    Raises: ConfigError for shapes or materials that do not fit each other, and for numbers out of bounds.
    """

    position_TN3: np.ndarray  # float32, domain units
    material_N: np.ndarray  # uint8, index into `materials`
    obstacles: tuple[Obstacle, ...]
    domain_size: BoxSize
    frame_rate_hz: OrdinarySize
    gravity: Vector = (0.0, -9.8, 0.0)  # domain units per second squared
    cell_size: OrdinarySize = 1 / 64  # edge of obstacle cells
    # plain JSON types: weights and their sha256, the scene's specification, settings
    source: dict[str, Any] = field(default_factory=dict)
    reference_TN3: np.ndarray | None = None  # float32 [R, N, 3], ground truth at the same frame rate
    # int64 [N], sorted: the first frame of each particle; its earlier positions are ignored and read as NaN. None: all
    # particles are present from the start
    entry_frame_N: np.ndarray | None = None
    materials: tuple[str, ...] = MATERIALS
    # number of dimensions of the motion; with 2 all particles lie in the plane at half of the domain's size in z
    dimensions: Annotated[int, Bound("2 or 3", lambda count: isinstance(count, int) and count in (2, 3))] = 3

    def __post_init__(self) -> None:
        require_bounds(self)
        shape = self.position_TN3.shape
        if len(shape) != 3 or shape[0] < 1 or shape[2] != 3:
            raise ConfigError(f"position_TN3 must have shape (frames >= 1, particles, 3), got {shape}")
        if self.material_N.shape != shape[1:2]:
            raise ConfigError(f"material_N must have shape ({shape[1]},), got {self.material_N.shape}")
        require_materials("material_N", self.material_N, self.materials)
        if self.entry_frame_N is not None:
            entry_N = self.entry_frame_N
            if entry_N.shape != shape[1:2] or (np.diff(entry_N, prepend=0) < 0).any():
                raise ConfigError(f"entry_frame_N must have shape ({shape[1]},), >= 0 and in order, got {entry_N}")
        if self.reference_TN3 is not None:
            truth = self.reference_TN3.shape
            if len(truth) != 3 or truth[0] < 1 or truth[1:] != shape[1:]:
                raise ConfigError(f"reference_TN3 must have shape (frames >= 1, {shape[1]}, 3), got {truth}")

    @property
    def frame_count(self) -> int:
        return len(self.position_TN3)

    @property
    def particle_count(self) -> int:
        return self.position_TN3.shape[1]

    def present(self, frame: int) -> int:
        """Returns the number of particles present in a frame. They are the first particles."""
        if self.entry_frame_N is None:
            return self.particle_count
        return int(np.searchsorted(self.entry_frame_N, frame, side="right"))


def frame_velocity(
    position_TN3: np.ndarray, frame_rate_hz: float, entry_frame_N: np.ndarray | None = None
) -> np.ndarray:
    """Returns the velocity in each frame, float32 [T, N, 3] in domain units per second.

    It is the backward difference, as in the network (paper sec. 3.1). Frame 0 repeats the velocity of frame 1. In its
    first frame an entering particle has the velocity of its second frame, or zero without a second frame.
    """
    velocity_TN3 = np.zeros(position_TN3.shape, np.float32)
    velocity_TN3[1:] = np.diff(position_TN3, axis=0) * np.float32(frame_rate_hz)
    if len(velocity_TN3) > 1:
        velocity_TN3[0] = velocity_TN3[1]
    if entry_frame_N is not None:
        last = len(position_TN3) - 1
        late = np.flatnonzero((entry_frame_N > 0) & (entry_frame_N <= last))
        entry = entry_frame_N[late]
        velocity_TN3[entry, late] = velocity_TN3[np.minimum(entry + 1, last), late]
        velocity_TN3[last, late[entry == last]] = 0.0
    return velocity_TN3


def rollout_bytes(frames: int, particles: int, reference: bool = False) -> int:
    """Returns the size of a rollout's file, in any format, without its obstacles: positions and velocities."""
    return (1 << 20) + 4 * particles * frames * (10 if reference else 7)


def write_rollout(path: str | Path, rollout: Rollout) -> None:
    """Writes `rollout` to `path` atomically. Creates missing folders."""
    make_folder(Path(path).parent)
    with _growing_file(Path(path), rollout) as frames:
        frames.write(rollout.frame_count)


def write_frames(path: Path, rollout: Rollout, simulate: Simulation) -> None:
    """Writes the frames of `simulate` as they come, and puts them into `rollout.position_TN3`.

    Once a second the new frames are appended to a temporary file. The file is renamed to `path` at the end, also after
    Ctrl-C or an error of the simulation. The space for all frames is reserved first.
    Raises: OSError before the first frame if the disk has less space.
    """
    size = rollout_bytes(rollout.frame_count, rollout.particle_count, rollout.reference_TN3 is not None)
    with simulated(rollout.position_TN3) as frames:
        with space_reserved(path, size) as release, _growing_file(path, rollout) as file:

            def append() -> None:
                if time.monotonic() - file.written_s > WRITE_EVERY_S:
                    release(size * (frames.count - file.count) // rollout.frame_count)
                    file.write(frames.count)

            frames.take(simulate, append)
            release(size)
            file.write(frames.count)
        frames.place = path


@contextlib.contextmanager
def _growing_file(path: Path, rollout: Rollout) -> Iterator[_GrowingFile]:
    """Yields a temporary file without frames. It gets its name at the end, unless there was an error."""
    import h5py

    with temporary_file(path) as temporary:
        with FileOnDisk(temporary) as disk:
            with h5py.File(disk, "w") as file:
                yield _GrowingFile(file, rollout, disk.settle)
            disk.settle()
        sync_written(temporary)
        temporary.replace(path)
    sync_folder(path.parent)


def read_rollout(path: str | Path) -> Rollout:
    """Reads a file of `write_rollout`. Raises: ConfigError if it is missing, damaged, or not of this version."""
    path = Path(path)
    if not path.is_file():
        raise ConfigError(f"rollout must be an existing file, got {path}; python -m hgn.rollout writes one")
    rule, remedy = f"{path}: rollout must be a complete HDF5 file", "write it again"
    with open_hdf5(path, rule, remedy) as file:
        _check_format(file, path)
        try:
            return _read(file, Claims(path))
        except ConfigError as error:
            raise ConfigError(f"{path}: rollout must be consistent, got {error}; {remedy}") from error


class _GrowingFile:
    """A file with the first frames of a rollout. Each dataset with a row or rows for each frame grows."""

    def __init__(self, file: h5py.File, rollout: Rollout, settle: Callable[[], None]) -> None:
        self._file, self._group, self._rollout = file, file.create_group("VTKHDF"), rollout
        self._settle = settle
        self.count, self.written_s = 0, time.monotonic()
        _write_topology(self._group, rollout)
        _write_own(file.create_group("hgn"), rollout)

    def write(self, end: int) -> None:
        """Writes the frames before `end` that are not in the file. A repeated call completes an interrupted one."""
        points = self._rollout.particle_count + sum(len(obstacle.vertex_V3) for obstacle in self._rollout.obstacles)
        step = max(1, POINTS_OF_A_WRITE // max(1, points))
        for before in range(self.count, max(end, self.count + 1), step):
            self._append(min(before + step, end), points)

    def _append(self, end: int, most_points: int) -> None:
        rollout, begin = self._rollout, self.count
        start, again = max(begin - 2, 0), max(begin - 1, 0)  # a velocity in frame `again` may depend on the next frame
        position_TN3 = rollout.position_TN3[start:end]
        vertex_TV3, triangle_F3, _ = _triangles(rollout.obstacles, np.arange(start, end) / rollout.frame_rate_hz)
        entry_N = np.zeros(rollout.particle_count, int) if rollout.entry_frame_N is None else rollout.entry_frame_N
        velocity_TN3 = frame_velocity(position_TN3, rollout.frame_rate_hz, entry_N - start)
        velocity_TV3 = frame_velocity(vertex_TV3, rollout.frame_rate_hz)
        present_T = np.searchsorted(entry_N, np.arange(end), side="right")
        points_T = present_T + vertex_TV3.shape[1]
        before_T = np.cumsum([0, *points_T])
        for name, frame, value_TV3, value_TN3 in (
            ("Points", begin, vertex_TV3, position_TN3),
            ("PointData/velocity", again, velocity_TV3, velocity_TN3),
        ):
            row_R3 = _stacked(value_TV3[frame - start :], value_TN3[frame - start :], present_T[frame:])
            _extend(self._group, name, row_R3, int(before_T[frame]), most_points)
        for name, value_T in _numbers(present_T, points_T, len(triangle_F3), rollout).items():
            _extend(self._group, name, value_T[begin:], begin, FRAMES_OF_A_CHUNK)
        self._group["Steps"].attrs["NSteps"] = np.int64(end)
        self._file.flush()
        self._settle()
        self.count, self.written_s = end, time.monotonic()


def _extend(group: h5py.Group, name: str, value: np.ndarray, at: int, chunk: int) -> None:
    """Writes rows from row `at` to the end of a dataset, which grows."""
    if name not in group:
        rest, chunk = value.shape[1:], min(max(chunk, 1), 1 << 16)
        group.create_dataset(name, (0, *rest), value.dtype, maxshape=(None, *rest), chunks=(chunk, *rest))
    group[name].resize(at + len(value), 0)
    group[name][at:] = value


def _numbers(present_T: np.ndarray, points_T: np.ndarray, triangles: int, rollout: Rollout) -> dict[str, np.ndarray]:
    """Returns the datasets with one row for each frame."""
    frame_T = np.arange(len(present_T), dtype=np.int64)
    none_T, before_T = 0 * frame_T, np.cumsum(points_T) - points_T
    cells_T = {"Vertices": present_T, "Polygons": none_T + triangles}
    numbers: dict[str, np.ndarray] = {}
    for name, corners in CELL_CATEGORIES.items():
        number_T = cells_T.get(name, none_T)
        numbers |= {f"{name}/NumberOfCells": number_T, f"{name}/NumberOfConnectivityIds": number_T * corners}
    return numbers | {
        "NumberOfPoints": points_T,
        "Steps/Values": frame_T / rollout.frame_rate_hz,  # seconds
        "Steps/PartOffsets": frame_T,
        "Steps/NumberOfParts": none_T + 1,
        "Steps/PointOffsets": before_T,
        "Steps/CellOffsets": np.zeros((len(frame_T), len(CELL_CATEGORIES)), np.int64),
        "Steps/ConnectivityIdOffsets": np.zeros((len(frame_T), len(CELL_CATEGORIES)), np.int64),
        "Steps/PointDataOffsets/material": none_T,
        "Steps/PointDataOffsets/velocity": before_T,
        "Steps/CellDataOffsets/obstacle": rollout.particle_count - present_T,
    }


def _write_topology(group: h5py.Group, rollout: Rollout) -> None:
    """Writes the parts of /VTKHDF that are stored once."""
    group.attrs["Version"] = np.array(VTKHDF_VERSION, np.int64)
    # VTK requires a fixed-length ASCII string; h5py would write one of variable length
    group.attrs.create("Type", np.bytes_("PolyData"))
    vertex_TV3, triangle_F3, obstacle_F = _triangles(rollout.obstacles, np.zeros(1))
    vertices, particles = vertex_TV3.shape[1], rollout.particle_count
    cells = {"Vertices": vertices + np.arange(particles)[:, None], "Polygons": triangle_F3}
    for name, corners in CELL_CATEGORIES.items():
        cell_C = cells.get(name, np.zeros((0, corners)))
        category = group.create_group(name)
        category["Connectivity"] = cell_C.reshape(-1).astype(np.int64)
        category["Offsets"] = np.arange(len(cell_C) + 1, dtype=np.int64) * corners
    group.create_group("Steps")
    material_V = np.full(vertices, OBSTACLE_MATERIAL, np.uint8)
    group["PointData/material"] = np.concatenate([material_V, rollout.material_N.astype(np.uint8, copy=False)])
    group["CellData/obstacle"] = np.concatenate([np.full(particles, -1, np.int32), obstacle_F])


def _triangles(obstacles: tuple[Obstacle, ...], time_T: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns vertices of all obstacles at each time, float32 [T, V, 3], triangles [F, 3] and obstacle numbers [F]."""
    places = [np.zeros((len(time_T), 0, 3), np.float32)]
    triangles, first = [np.zeros((0, 3), np.int64)], 0
    for obstacle in obstacles:
        places.append(np.stack([obstacle.at(time).vertex_V3 for time in time_T]).astype(np.float32))
        triangles.append(obstacle.triangle_F3.astype(np.int64) + first)
        first += len(obstacle.vertex_V3)
    number_F = np.repeat(np.arange(len(obstacles), dtype=np.int32), [len(one.triangle_F3) for one in obstacles])
    return np.concatenate(places, axis=1), np.concatenate(triangles), number_F


def _stacked(value_TV3: np.ndarray, value_TN3: np.ndarray, present_T: np.ndarray) -> np.ndarray:
    """Returns the rows of the vertices and of the present particles, frame by frame, float32 [rows, 3]."""
    parts = zip(value_TV3, value_TN3, present_T, strict=True)
    rows = [part for row_V3, row_N3, count in parts for part in (row_V3, row_N3[:count])]
    return np.concatenate(rows or [value_TN3[:0].reshape(0, 3)]).astype(np.float32, copy=False)


def _write_own(group: h5py.Group, rollout: Rollout) -> None:
    group.attrs["format"] = FORMAT_NAME
    group.attrs["format_version"] = FORMAT_VERSION
    group.attrs["materials"] = json.dumps(rollout.materials)
    group.attrs["dimensions"] = rollout.dimensions
    for name in ("frame_rate_hz", "domain_size", "gravity", "cell_size"):
        group.attrs[name] = np.array(getattr(rollout, name), np.float64)
    group["source"] = json.dumps(rollout.source)  # a dataset, because attributes are limited to 64 KiB
    obstacles = group.create_group("obstacles")
    for index, obstacle in enumerate(rollout.obstacles):
        entry = obstacles.create_group(f"{index:04d}")
        entry.attrs["name"] = obstacle.name
        entry.attrs["closed"] = bool(obstacle.closed)
        entry["vertices"] = obstacle.vertex_V3.astype(np.float64, copy=False)
        entry["triangles"] = obstacle.triangle_F3.astype(np.int32, copy=False)
        if obstacle.motion is not None:
            entry.attrs["pivot"] = np.array(obstacle.motion.pivot, np.float64)
            for name in MOTION_FIELDS:
                entry[name.rpartition("_")[0]] = getattr(obstacle.motion, name)
    if rollout.entry_frame_N is not None:
        group["entry_frame"] = rollout.entry_frame_N.astype(np.int64, copy=False)
    if rollout.reference_TN3 is not None:
        group["reference"] = rollout.reference_TN3.astype(np.float32, copy=False)


def _check_format(file: h5py.File, path: Path) -> None:
    import h5py

    own = file.get("hgn")
    attributes = own.attrs if isinstance(own, h5py.Group) else {}
    name, version = attributes.get("format"), attributes.get("format_version")
    if not isinstance(name, str) or name != FORMAT_NAME:
        raise ConfigError(
            f"rollout must be a file that python -m hgn.rollout wrote, with format {FORMAT_NAME!r} "
            f"in group /hgn; got {path} with format {name!r}"
        )
    if not isinstance(version, np.integer) or version != FORMAT_VERSION:
        raise ConfigError(
            f"rollout format_version must be {FORMAT_VERSION}, got {version} in {path}; "
            "read it with the version of hgn that wrote it, or write it again"
        )


def _read(file: h5py.File, claims: Claims) -> Rollout:
    for name, kinds in KINDS.items():
        if name in file:
            require(file[name].dtype.kind in kinds, name, f"of kind {kinds}", str(file[name].dtype))
    own, vtk = file["hgn"], file["VTKHDF"]
    count_T = vtk["NumberOfPoints"][()]
    points, material_P = vtk["Points"], vtk["PointData/material"][()]
    vertices = len(material_P) - len(vtk["Vertices/Connectivity"])  # vertices of obstacles precede the particles
    shape = (len(count_T), len(material_N := material_P[vertices:]), 3)
    entry_N = own["entry_frame"][()] if "entry_frame" in own else np.zeros(shape[1], np.int64)
    claims.add("frames x points", len(count_T), len(material_P), 13)
    shown_TP = np.concatenate([np.zeros(vertices, np.int64), entry_N]) <= np.arange(shape[0])[:, None]
    if points.shape != (shown_TP.sum(), 3) or (count_T != shown_TP.sum(axis=1)).any():
        raise ConfigError(f"Points must contain {shape[0]} frames of {shape[1]} particles, got shape {points.shape}")
    position_TP3 = np.full((*shown_TP.shape, 3), np.nan, np.float32)
    with np.errstate(over="ignore"):  # infinite positions of particles are refused
        position_TP3[shown_TP] = points[()]
    source, materials = strict_json(own["source"][()]), strict_json(own.attrs["materials"])
    require(isinstance(source, dict), "source", "a mapping", source)
    rollout = Rollout(
        position_TN3=position_TP3[:, vertices:],
        material_N=material_N,
        obstacles=tuple(_read_obstacle(entry, claims) for _, entry in sorted(own["obstacles"].items())),
        domain_size=triple(own.attrs["domain_size"].tolist()),
        frame_rate_hz=float(own.attrs["frame_rate_hz"].item()),
        gravity=triple(own.attrs["gravity"].tolist()),
        cell_size=float(own.attrs["cell_size"].item()),
        source=source,
        reference_TN3=own["reference"][()] if "reference" in own else None,
        entry_frame_N=entry_N if "entry_frame" in own else None,
        materials=tuple(materials) if isinstance(materials, list) else materials,
        dimensions=np.asarray(own.attrs["dimensions"]).item(),
    )
    for name, array in (("Points", rollout.position_TN3), ("reference", rollout.reference_TN3)):
        size = 0.0 if array is None else float(np.fmax.reduce(np.abs(array), axis=None, initial=0.0))
        require(size <= FARTHEST * max(rollout.domain_size), name, f"at most {FARTHEST} domain sizes, or nan", size)
    return rollout


def _read_obstacle(entry: h5py.Group, claims: Claims) -> Obstacle:
    vertex_V3, triangle_F3 = entry["vertices"][()], entry["triangles"][()]
    for name, array, kinds in (("vertices", vertex_V3, "f"), ("triangles", triangle_F3, "iu")):
        if array.dtype.kind not in kinds or array.ndim != 2 or array.shape[1] != 3:
            raise ConfigError(f"{entry.name}: {name} must be numbers [any, 3], got {array.dtype} {array.shape}")
    rule, size = "finite and at most 1e15", float(np.abs(vertex_V3).max(initial=0))
    require(size <= LARGEST, f"{entry.name}: vertices", rule, size)
    low, high = triangle_F3.min(initial=0), triangle_F3.max(initial=0)
    if low < 0 or (len(triangle_F3) and high >= len(vertex_V3)):
        raise ConfigError(f"{entry.name}: triangles must be of {len(vertex_V3)} vertices, got vertices {low} to {high}")
    claims.add(f"{entry.name}: triangles", len(triangle_F3), TRIANGLE_BYTES)
    motion, triangle_F3 = _read_motion(entry) if "time" in entry else None, triangle_F3.astype(np.int32, copy=False)
    return Obstacle(str(entry.attrs["name"]), vertex_V3, triangle_F3, bool(entry.attrs["closed"]), motion=motion)


def _read_motion(entry: h5py.Group) -> Motion:
    arrays = {name: entry[name.rpartition("_")[0]][()] for name in MOTION_FIELDS}
    count = len(arrays["time_T"])
    shapes = ((count,), (count, 3), (count, 3, 3))
    for (name, value), shape in zip(arrays.items(), shapes, strict=True):
        if value.shape != shape:
            raise ConfigError(f"{entry.name}: {name} must have shape {shape}, got {value.shape}")
    pivot = triple(entry.attrs["pivot"].tolist())
    require(all(abs(x) <= LARGEST for x in pivot), f"{entry.name}: pivot", "finite and at most 1e15", list(pivot))
    return Motion(**arrays, pivot=pivot)
