"""The formats of particle trajectories: their files, content and units.

| format | files | made by |
|---|---|---|
| deepmind | {split}.tfrecord, metadata.json | google-deepmind/deepmind-research, learning_to_simulate |
| geoelements | {split}.npz of pickled arrays, metadata.json | geoelements/gns |
| lagrangebench | {split}.h5, metadata.json | tumaer/lagrangebench |
| neuralmpm | {split}/sim_{i}.h5 | OmerRochman/NeuralMPM |
| plain | {split}.npz or {split}.h5, metadata.json | docs/how_to/import.md |
"""

import contextlib
import itertools
import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hgn.data.foreign.settings import ImportConfig
from hgn.data.foreign.tfrecord import parse_sequence_example, read_records
from hgn.data.foreign.trajectory import FLUID, MOST_CELLS, SetInfo, Trajectory, as_array, checked, floats
from hgn.scene.hdf5 import damage_named, open_hdf5
from hgn.scene.material import MATERIAL_NAME
from hgn.scene.npz import read_npz
from hgn.schema import ConfigError, require
from hgn.system.yaml_files import read_json

_Named = tuple[str, Mapping[str, Any]]  # name of a trajectory for messages, and its fields
SPLIT_NAMES = {"train": ("train",), "validation": ("valid", "validation"), "test": ("test",)}
# particle types of DeepMind's sets, which geoelements and NeuralMPM use too, and of LagrangeBench's
_DEEPMIND = {0: "rigid", FLUID: "fluid", 5: "water", 6: "sand", 7: "goop"}
_LAGRANGEBENCH = {0: "fluid", 3: "rigid", 5: "water", 6: "sand", 7: "goop"}  # 5 to 7: its copies of DeepMind's sets


def find_format(folder: Path) -> str:
    """Returns the format of a folder's files. Raises: ConfigError for no format, or several."""
    require(folder.is_dir(), "from", "a folder with trajectories", str(folder))
    formats = []
    if _file(folder, "train", ".tfrecord"):
        formats.append("deepmind")
    if any((folder / name).is_dir() for name in SPLIT_NAMES["train"]):
        formats.append("neuralmpm")
    if archive := _file(folder, "train", ".npz"):
        _, first = next(read_npz(archive, objects=True), ("", np.zeros(0)))
        formats.append("geoelements" if first.dtype.hasobject else "plain")
    if _file(folder, "train", ".h5"):
        metadata = _metadata(folder)
        bench = {"solver", "write_every", "periodic_boundary_conditions"} & set(metadata)
        formats.append("lagrangebench" if bench else "plain")
    names = "train.tfrecord, train.npz, train.h5 or train/sim_0.h5"
    require(bool(formats), "from", f"a folder with {names}", str(folder), "see docs/how_to/import.md")
    remedy = "move the files of the others to another folder"
    several = f"{' and '.join(formats)} in {folder}"
    require(len(formats) == 1, "from", "a folder with files of one format", several, remedy)
    return formats[0]


def set_info(folder: Path, name: str, config: ImportConfig) -> SetInfo:
    """Reads the metadata of a set. Settings of the command line replace values of the metadata.

    Raises: ConfigError naming the missing or wrong value, and for forces that change with time.
    """
    raw = _metadata(folder)
    if isinstance(raw.get("train"), Mapping):  # geoelements' metadata may differ between training and rollout
        raw = dict(raw["train"])
    if "context_mean" in raw:
        raise ConfigError(
            f"{folder}/metadata.json: context_mean must be absent, got a set with step_context: forces that change "
            "with time are not supported"
        )
    types, boundary = (_LAGRANGEBENCH, [1, 2]) if name == "lagrangebench" else (_DEEPMIND, [3])

    def given(key: str, option: Any, shape: tuple[int | None, ...], standard: Any = None) -> Any:
        """Returns numbers from the command line, or else from the metadata, as lists of floats."""
        value = option if option is not None else raw.get(key)
        return standard if value is None else _numbers(f"{folder}/metadata.json: {key}", value, shape)

    bounds = given("bounds", config.bounds, (None, 2))
    dt, radius = given("dt", config.dt, ()), given("default_connectivity_radius", config.radius, ())
    for key, value in {"bounds": bounds, "dt": dt, "radius": radius}.items():
        rule = f"given if {folder}/metadata.json does not contain it"
        require(value is not None, key, rule, value, f"as in {key}={_EXAMPLES[key]}")
    dimensions = given("dim", config.dimensions, (), float(len(bounds)))
    require(dimensions in (2, 3), f"{folder}/metadata.json: dim", "2 or 3", dimensions)
    if name == "plain":
        named = raw.get("materials", {})
        require(isinstance(named, Mapping), f"{folder}/metadata.json: materials", "names by number", named)
        types = {_number(key, folder): _material(value, folder) for key, value in named.items()} or types
        boundary = given("boundary_types", None, (None,), boundary)
    types = types | {_number(key, folder): value for key, value in config.materials.items()}
    whole = all(abs(kind) <= 1e15 and kind == int(kind) for kind in boundary)
    require(whole, f"{folder}/metadata.json: boundary_types", "whole numbers, at most 1e15", boundary)
    size = given("g_ext_magnitude", None, ())
    require(size is None or size >= 0, f"{folder}/metadata.json: g_ext_magnitude", ">= 0", size)
    gravity = given("gravity", config.gravity, (None,), [0.0] * int(dimensions) if size == 0 else None)
    if name == "lagrangebench" and config.dt is None:
        every = given("write_every", None, (), 1.0)
        require(every > 0, f"{folder}/metadata.json: write_every", "> 0", every)
        dt *= every
    # LagrangeBench gives three axes for 2D sets too; the third is ignored
    key = "periodic_boundary_conditions"
    sides = raw.get(key, False)
    periodic = _numbers(f"{folder}/metadata.json: {key}", [sides] * 3 if isinstance(sides, bool) else sides, (None,))
    return SetInfo(
        format=name,
        dimensions=int(dimensions),
        frame_dt_s=dt,
        bounds=tuple((low, high) for low, high in bounds),
        radius=radius,
        materials=types,
        boundary_types=frozenset(map(int, boundary if config.boundary_types is None else config.boundary_types)),
        ignored_types=frozenset({-1} if name == "lagrangebench" else ()),
        gravity=None if gravity is None else tuple(gravity),
        gravity_size=size,
        obstacle_cell_size=given("obstacle_cell_size", None, ()),
        periodic=tuple(bool(value) for value in periodic[: int(dimensions)]),
        raw=raw,
    )


def _numbers(name: str, value: Any, shape: tuple[int | None, ...]) -> Any:
    """Returns a float, or nested lists of floats, of this shape. None in the shape means any length."""
    array: Any = np.full((), np.nan)
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        if (given := np.asarray(value)).dtype.kind in ("biufO" if shape else "iufO"):  # O: whole numbers of many bits
            array = given.astype(np.float64)
    fits = array.ndim == len(shape) and all(m in (n, None) for n, m in zip(array.shape, shape, strict=True))
    rule = "a finite number" if not shape else "finite numbers" + (" in pairs" if len(shape) == 2 else " in a list")
    require(fits and bool(np.isfinite(array).all()), name, rule, value)
    return array.tolist()


def _material(value: object, folder: Path) -> str:
    fits = isinstance(value, str) and MATERIAL_NAME.fullmatch(value) is not None
    require(fits, f"{folder}/metadata.json: materials", "names of lower-case letters, digits and _", value)
    return str(value)


def read_split(folder: Path, split: str, info: SetInfo) -> Iterator[Trajectory]:
    """Yields the trajectories of a split in a fixed order; none if there is no file.

    Raises: ConfigError naming file, trajectory and field, if the field is missing, incomplete, altered or of a wrong
    type.
    """
    return (_of_members(name, members, info) for name, members in _READERS[info.format](folder, split, info))


def _read_deepmind(folder: Path, split: str, info: SetInfo) -> Iterator[_Named]:
    path = _file(folder, split, ".tfrecord")
    for number, record in enumerate(read_records(path) if path else ()):
        name = f"{path}: record {number}"
        context, lists = parse_sequence_example(record, name)
        if "step_context" in lists:
            raise ConfigError(f"{name}: step_context must be absent: forces that change with time are not supported")
        types = _joined(f"{name}: particle_type", context.get("particle_type"), "<i8")
        flat = _joined(f"{name}: position", lists.get("position"), "<f4")
        frames: Any = info.raw.get("sequence_length")
        require(isinstance(frames, int), f"{folder}/metadata.json: sequence_length", "a whole number", frames)
        shape = (int(frames) + 1, len(types), info.dimensions)  # with the frame before the first velocity
        if flat.size != math.prod(shape):
            rule = f"{math.prod(shape)} numbers for sequence_length + 1, particles and dim {shape}"
            raise ConfigError(f"{name}: position must have {rule}, got {flat.size}")
        yield name, {"position": flat.reshape(shape), "particle_type": types}


def _joined(name: str, parts: list[bytes] | None, dtype: str) -> np.ndarray:
    if not parts:
        raise ConfigError(f"{name} is missing; the record must contain it as bytes")
    data = b"".join(parts)
    size = np.dtype(dtype).itemsize
    require(len(data) % size == 0, name, f"a multiple of {size} bytes", f"{len(data)} bytes")
    return np.frombuffer(data, dtype)


def _read_geoelements(folder: Path, split: str, info: SetInfo) -> Iterator[_Named]:
    path = _file(folder, split, ".npz")
    fields = ("position", "particle_type", "material_property")
    for member, array in read_npz(path, objects=True) if path else ():
        for key, entry in _entries(member, array):
            name, parts = f"{path}: {key}", entry
            if isinstance(entry, Mapping):
                parts = [entry[field] for field in fields if field in entry]
            parts = list(parts) if isinstance(parts, (tuple, list, np.ndarray)) else []
            if len(parts) not in (2, 3):
                rule = "(position, particle_type) or these and material_property"
                raise ConfigError(f"{name} must be {rule}, got {type(entry).__name__} of {len(parts)}")  # of any size
            yield name, dict(zip(fields, parts, strict=False))


def _entries(member: str, array: np.ndarray) -> Iterator[tuple[str, Any]]:
    """Yields name and content of each trajectory in an archive's array: one trajectory, or a dict or list of them."""
    content = array.item() if array.shape == () else array
    if isinstance(content, Mapping) and "position" not in content:
        yield from ((f"{member}[{key!r}]", entry) for key, entry in content.items())
    elif array.ndim == 1 and (member == "gns_data" or all(isinstance(entry, (Mapping, tuple)) for entry in content)):
        yield from ((f"{member}[{number}]", entry) for number, entry in enumerate(content))
    else:
        yield member, content


def _read_hdf5(folder: Path, split: str, info: SetInfo) -> Iterator[_Named]:
    path = _file(folder, split, ".h5")
    if path is None:
        archive = _file(folder, split, ".npz") if info.format == "plain" else None
        yield from _read_plain_npz(archive) if archive else ()
        return
    with _opened(path) as file:
        for key in sorted(file):
            with damage_named(f"{path}: {key} must be complete", _AGAIN):
                group = file[key]
                require(isinstance(group, h5py.Group), f"{path}: {key}", "a group with position", str(group))
                members = {name: _dataset(f"{path}: {key}", group, name) for name in group}
            yield f"{path}: {key}", members


def _read_plain_npz(path: Path) -> Iterator[_Named]:
    def trajectory(item: tuple[str, np.ndarray]) -> str:
        key = item[0].rpartition("/")[0]
        require(bool(key), f"{path}: {item[0]}", "named TRAJECTORY/FIELD", item[0])
        return key

    for key, arrays in itertools.groupby(read_npz(path), trajectory):
        yield f"{path}: {key}", {member.rpartition("/")[2]: array for member, array in arrays}


def _of_members(name: str, members: Mapping[str, Any], info: SetInfo) -> Trajectory:
    """Checks the fields of a trajectory, which readers of all formats name as in the plain format."""
    position = members.get("position", members.get("positions"))  # the second name is that in geoelements' HDF5
    if position is None:
        raise ConfigError(f"{name}: position is missing; it has {', '.join(members) or 'nothing'}")
    types = members.get("particle_type")
    if types is None:
        require(info.format == "plain", f"{name}: particle_type", "present", None)
        for key in members:
            other = key == "material_property" or not re.search("type|material", key, re.IGNORECASE)
            require(other, f"{name}: {key}", "named particle_type", key, "rename it")
        types = np.full((), FLUID)
    position_TND, type_N = checked(name, position, types, info.dimensions)
    real_N = ~np.isin(type_N, list(info.ignored_types))
    if not real_N.all():
        position_TND, type_N = position_TND[:, real_N], type_N[real_N]
    boundary, cell, normal = (members.get(key) for key in ("boundary", "obstacle_cell", "obstacle_normal"))
    if boundary is not None:
        boundary = floats(f"{name}: boundary", boundary, (None, info.dimensions))
    if cell is not None:
        require(info.obstacle_cell_size is not None, "metadata.json: obstacle_cell_size", "given", None)
        rule = "whole numbers [K, 3]"
        fits = cell.dtype.kind in "iu" and cell.ndim == 2 and cell.shape[1] == 3
        require(fits, f"{name}: obstacle_cell", rule, f"{cell.dtype} {list(cell.shape)}")
        require(normal is not None, f"{name}: obstacle_normal", "given with obstacle_cell", None)
        normal = floats(f"{name}: obstacle_normal", normal, cell.shape)
        _require_cells(name, cell, normal)
    gravity = members.get("gravity")
    if gravity is not None:
        gravity = floats(f"{name}: gravity", gravity, (info.dimensions,))
    property_NK = _properties(name, members.get("material_property"), len(real_N))
    return Trajectory(
        name, position_TND, type_N, boundary, None if property_NK is None else property_NK[real_N], cell, normal,
        None if gravity is None else tuple(float(value) for value in gravity),
    )  # fmt: skip


def _require_cells(name: str, cell_K3: np.ndarray, normal_K3: np.ndarray) -> None:
    lowest, highest = cell_K3.min(initial=0), cell_K3.max(initial=0)
    require(lowest >= -1 and highest < MOST_CELLS, f"{name}: obstacle_cell", "cells inside the box", [lowest, highest])
    alike = len(cell_K3) - len(np.unique(cell_K3, axis=0))
    require(alike == 0, f"{name}: obstacle_cell", "unique", f"{alike} repeated")
    length_K = np.linalg.norm(normal_K3, axis=1)
    unit = bool((np.abs(length_K - 1) < 1e-3).all())
    require(unit, f"{name}: obstacle_normal", "of length 1", float(length_K.max(initial=0)))


def _properties(name: str, given: Any, count: int) -> np.ndarray | None:
    """Returns K properties of each particle, float32 [N, K]. The file has a row for each particle, or one for all."""
    if given is None:
        return None
    array = as_array(f"{name}: material_property", given)
    rule = f"numbers for one or {count} particles"
    plain = array.dtype.kind in "iuf" and array.dtype.itemsize <= 8
    fits = plain and array.ndim <= 2 and (array.ndim == 0 or len(array) in (1, count))
    require(fits, f"{name}: material_property", rule, f"{array.dtype} {list(array.shape)}")
    columns = array.astype(np.float64).reshape(1 if array.ndim == 0 else len(array), -1)
    columns = floats(f"{name}: material_property", columns, (None, None)).astype(np.float32)
    return np.broadcast_to(columns, (count, columns.shape[1]))


def _read_neuralmpm(folder: Path, split: str, info: SetInfo) -> Iterator[_Named]:
    files = [path for name in SPLIT_NAMES[split] for path in (folder / name).glob("sim_*.h5")]
    for path in sorted(files, key=lambda path: (len(path.stem), path.stem)):
        with _opened(path) as file:
            axes = info.dimensions
            particles, boundary = (_wide(path, file, key, axes) for key in ("particles", "boundary"))
            types = _dataset(str(path), file, "types") if "types" in file else np.full((), FLUID)
            own = next((_dataset(str(path), file, key) for key in ("grav", "gravity") if key in file), None)
        if types.ndim == 1 and len(types) == particles.shape[1] + boundary.shape[1]:  # the boundary's types come first
            types = types[boundary.shape[1] :]
        moved = np.abs(boundary - boundary[:1]).max(initial=0)
        require(moved <= 1e-3 * info.radius, f"{path}: boundary", "at rest", f"a displacement of {moved:.3g}")
        members = {"position": particles, "particle_type": types}
        members |= {"boundary": boundary[0]} if boundary.size else {}
        if own is not None and info.gravity is None:  # these sets have a gravity for each simulation
            members |= {"gravity": floats(f"{path}: grav", own, (axes,))}
        yield str(path), members


def _wide(path: Path, file: h5py.File, key: str, axes: int) -> np.ndarray:
    """Returns the first columns of an array [frames, particles, columns]. A boundary may have no particles."""
    array = _dataset(str(path), file, key)
    rule = f"[frames, particles, {axes} or more columns]"
    require(array.ndim == 3 and array.shape[2] >= axes, f"{path}: {key}", rule, list(array.shape))
    return floats(f"{path}: {key}", array[..., :axes], (*array.shape[:2], axes))


_READERS: dict[str, Callable[[Path, str, SetInfo], Iterator[_Named]]] = {
    "deepmind": _read_deepmind,
    "geoelements": _read_geoelements,
    "lagrangebench": _read_hdf5,
    "neuralmpm": _read_neuralmpm,
    "plain": _read_hdf5,
}
_AGAIN = "fetch it again"
_EXAMPLES = {"bounds": "[[0.1,0.9],[0.1,0.9]]", "dt": "0.0025", "radius": "0.015"}


def _opened(path: Path) -> AbstractContextManager[h5py.File]:
    return open_hdf5(path, f"{path} must be a complete HDF5 file", _AGAIN)


def _dataset(name: str, group: h5py.Group, key: str) -> np.ndarray:
    with damage_named(f"{name}: {key} must be present and complete", _AGAIN):
        dataset = group[key]
        require(isinstance(dataset, h5py.Dataset), f"{name}: {key}", "a dataset", type(dataset).__name__)
        return np.asarray(dataset[()])


def _file(folder: Path, split: str, ending: str) -> Path | None:
    paths = [folder / f"{name}{ending}" for name in SPLIT_NAMES[split]]
    return next((path for path in paths if path.is_file()), None)


def _metadata(folder: Path) -> dict[str, Any]:
    path = folder / "metadata.json"
    if not path.is_file():
        return {}
    try:
        metadata = read_json(path)
    except ValueError as error:
        raise ConfigError(f"{path} must be JSON, got {error}") from None
    require(isinstance(metadata, dict), str(path), "a JSON object", type(metadata).__name__)
    return dict(metadata)


def _number(key: object, folder: Path) -> int:
    if re.fullmatch(r"0|-?[1-9][0-9]{0,17}", str(key)) is None:
        rule = "names by the number of a particle type"
        raise ConfigError(f"materials must be {rule}, got {key!r:.60} in {folder}; as in materials={{7: goop}}")
    return int(str(key))
