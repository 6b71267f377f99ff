"""Triangles of GLB files (glTF 2.0), with all core features that affect shapes, and with instances.

Materials, textures, cameras, lights and animations are ignored. Skins are refused.
"""

import base64
import re
import struct
from collections.abc import Collection, Iterator
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from scipy.spatial.transform import Rotation

from hgn.schema import strict_json
from hgn.system.claims import Claims

INSTANCES = "EXT_mesh_gpu_instancing"
VISIBILITY = "KHR_node_visibility"
READ = (INSTANCES, VISIBILITY, "KHR_mesh_quantization")  # extensions that change geometry
NEUTRAL = re.compile(r"[A-Z]+_(materials|texture|lights|xmp|animation|audio)\w*")  # extensions that do not change it
TRIANGLES, STRIP, FAN = 4, 5, 6  # modes of primitives; the modes from 0 to 3 are points and lines
COPIES = 3  # number of copies of vertices and triangles in the search for closed bodies
MOST_JSON_BYTES = 16 << 20  # largest JSON tree; Python takes up to 33 bytes of memory for each of its bytes
MOST_CHARACTERS = 4096  # of a uri that names a file
LEAST_BYTES = 1024  # memory claimed even for a primitive without content, because each takes time
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_INDICES = (5121, 5123, 5125)
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def read_glb(path: Path, data: bytes, claims: Claims) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices, float64 [V, 3], and triangles, int64 [F, 3], of the file's scene.

    `data` is the content of `path`, and `claims` are those of this reading.
    Raises: ValueError, LookupError, TypeError, struct.error or OSError for damaged, missing or unsupported data.
    """
    tree, binary = _chunks(data)
    unknown = [n for n in tree.get("extensionsRequired", ()) if n not in READ and not NEUTRAL.fullmatch(n)]
    if unknown:
        raise ValueError(f"it requires {', '.join(unknown)}, which is not read; export it without")
    asset = tree.get("asset", {})
    least = asset.get("minVersion", "2.0" if str(asset.get("version", 2)).startswith("2") else asset["version"])
    if least != "2.0":
        raise ValueError(f"it needs glTF {least}, but only 2.0 is supported; export it as glTF 2.0")
    file = _File(tree, binary, path.parent, claims)
    vertices, triangles, vertex_count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    for mesh, weights, place_M44 in file.placed():
        for position_V3, triangle_F3 in file.surfaces(mesh, weights):
            count = max(len(place_M44), 1)  # the primitives of a node without instances are computed too
            claims.add("its nodes", COPIES, count, LEAST_BYTES + position_V3.nbytes + triangle_F3.nbytes)
            for place_44 in place_M44:
                vertices.append(position_V3 @ place_44[:3, :3].T + place_44[:3, 3])
                triangles.append(triangle_F3 + vertex_count)
                vertex_count += len(position_V3)
    return np.concatenate(vertices), np.concatenate(triangles)


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, length = struct.unpack_from("<4sII", data)
    if magic != b"glTF" or version != 2 or length > len(data):
        raise ValueError(f"it begins with {magic!r}, version {version}, and has {len(data)} of {length} bytes")
    chunks: dict[bytes, bytes] = {}
    place = 12
    while place < length:
        size, kind = struct.unpack_from("<I4s", data, place)
        chunks.setdefault(kind, data[place + 8 : place + 8 + size])
        place += 8 + size
    if len(chunks[b"JSON"]) > MOST_JSON_BYTES:
        raise ValueError(f"its JSON must have at most {MOST_JSON_BYTES} bytes, got {len(chunks[b'JSON'])}")
    return strict_json(chunks[b"JSON"]), chunks.get(b"BIN\0", b"")


class _Entries(list[Any]):
    """A list without the negative indices of Python: some programs write -1 for no entry."""

    def __getitem__(self, index: Any) -> Any:
        if index < 0:
            raise IndexError(f"an entry has the index {index}")
        return super().__getitem__(index)


class _File:
    """The JSON tree of a file, and its buffers."""

    def __init__(self, tree: dict[str, Any], binary: bytes, folder: Path, claims: Claims) -> None:
        self.tree = {key: _Entries(value) if isinstance(value, list) else value for key, value in tree.items()}
        self.binary, self.folder, self.claims = binary, folder.resolve(), claims
        self.buffer, self.read = cache(self._buffer), cache(self._read)  # buffers may be the same file

    def placed(self) -> list[tuple[int, list[float], np.ndarray]]:
        """Returns the number of each mesh of the scene, the weights of its morph targets, its matrices [M, 4, 4]."""
        nodes = self.tree.get("nodes", [])
        if "scenes" in self.tree:
            roots = self.tree["scenes"][self.tree.get("scene", 0)].get("nodes", [])
        else:
            roots = set(range(len(nodes))) - {child for node in nodes for child in node.get("children", ())}
        result, waiting, visited = [], [(index, np.eye(4)) for index in roots], set()
        while waiting:
            index, parent_44 = waiting.pop()
            node = nodes[index]
            if index in visited:
                raise ValueError(f"node {index} has two parents")
            visited.add(index)
            if not node.get("extensions", {}).get(VISIBILITY, {}).get("visible", True):
                continue  # its children are invisible too
            translation, rotation, scale, matrix = (
                _numbers(node, f"node {index} has", name, count)
                for name, count in (("translation", 3), ("rotation", 4), ("scale", 3), ("matrix", 16))
            )
            own_44 = _places(translation, rotation, scale)[0] if matrix is None else np.reshape(matrix, (4, 4)).T
            place_44 = parent_44 @ own_44
            waiting += [(child, place_44) for child in node.get("children", ())]
            if "mesh" not in node:
                continue
            if "skin" in node:
                raise ValueError(f"node {index} has a skin; apply the armature")
            instances = node.get("extensions", {}).get(INSTANCES, {}).get("attributes", {})
            given = [(instances.get(name), name) for name in ("TRANSLATION", "ROTATION", "SCALE")]
            for i, _ in given:
                self.claims.add("instances", 1 if i is None else self.tree["accessors"][i]["count"], 128)
            kinds = ("VEC3", "VEC4", "VEC3")
            values = [
                None if i is None else self.accessor(i, f"node {index} has {name}", kind)
                for (i, name), kind in zip(given, kinds, strict=True)
            ]
            mesh, name = node["mesh"], "weights"
            default = _numbers(self.tree["meshes"][mesh], f"mesh {mesh} has", name)
            weights = _numbers(node, f"node {index} has", name) or default or []
            result.append((mesh, weights, place_44 @ _places(*values)))
        return result

    def surfaces(self, mesh: int, weights: list[float]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yields positions [V, 3] and triangles [F, 3] of the primitives with triangles."""
        for number, primitive in enumerate(self.tree["meshes"][mesh]["primitives"]):
            self.claims.add("primitives", LEAST_BYTES)
            mode, has = primitive.get("mode", TRIANGLES), f"primitive {number} of mesh {mesh} has"
            if mode not in range(FAN + 1):
                raise ValueError(f"{has} mode {mode}, which is not from 0 to {FAN}")
            if mode < TRIANGLES:
                continue
            if "POSITION" not in primitive.get("attributes", {}):
                raise ValueError(f"{has} no POSITION")
            position_V3 = self.accessor(primitive["attributes"]["POSITION"], f"{has} POSITION").astype(np.float64)
            for target, weight in zip(primitive.get("targets", ()), weights, strict=False):
                if weight and "POSITION" in target:
                    self.claims.add("morph targets", LEAST_BYTES + position_V3.nbytes)
                    moved_V3 = self.accessor(target["POSITION"], f"{has} a target")
                    if len(moved_V3) != len(position_V3):
                        raise ValueError(f"{has} a target of {len(moved_V3)} vertices, not {len(position_V3)}")
                    position_V3 = position_V3 + weight * moved_V3
            if "indices" in primitive:
                self.claims.add("indices", self.tree["accessors"][primitive["indices"]]["count"], 24)
                index = self.accessor(primitive["indices"], f"{has} indices", "SCALAR", _INDICES)[:, 0].astype(np.int64)
            else:
                index = np.arange(len(position_V3))
            if index.max(initial=-1) >= len(position_V3):
                raise ValueError(f"vertex {index.max()} of a primitive with {len(position_V3)} vertices")
            if mode == TRIANGLES:
                triangle_F3 = index.reshape(-1, 3)
            elif mode == STRIP:
                triangle_F3 = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
                triangle_F3[1::2] = triangle_F3[1::2, ::-1]
            else:
                triangle_F3 = np.stack([np.full_like(index[2:], index[0]), index[1:-1], index[2:]], axis=1)
            yield position_V3, triangle_F3

    def accessor(self, index: int, use: str, kind: str = "VEC3", codes: Collection[int] = _TYPES) -> np.ndarray:
        """Returns the values of an accessor, [count, width]. Normalised integers become fractions.

        Raises: ValueError that begins with `use` for another type than `kind`, or components other than `codes`.
        """
        entry = self.tree["accessors"][index]
        if entry["type"] != kind or entry["componentType"] not in codes:
            raise ValueError(
                f"{use} of type {entry['type']} with components {entry['componentType']}, not {kind} with one of "
                f"{', '.join(map(str, codes))}"
            )
        dtype, shape = np.dtype(_TYPES[entry["componentType"]]), (entry["count"], _WIDTHS[kind])
        sparse = entry.get("sparse")
        if "bufferView" in entry:
            value = self._values(entry, dtype, shape)
        elif sparse:
            self.claims.add(f"accessor {index}", *shape, 8)
            value = np.zeros(shape, dtype)
        else:
            used = ", ".join(self.tree.get("extensionsUsed", ())) or "no extension"
            raise ValueError(f"accessor {index} has no data; the file uses {used}")
        if sparse:
            value = value.copy()
            place, count = sparse["indices"], sparse["count"]
            at = self._values(place, np.dtype(_TYPES[place["componentType"]]), (count, 1))[:, 0]
            value[at.astype(np.uint64, casting="same_kind")] = self._values(sparse["values"], dtype, (count, shape[1]))
        if entry.get("normalized"):
            value = np.maximum(value / np.float64(np.iinfo(dtype).max), -1.0)
        return value

    def _values(self, entry: dict[str, Any], dtype: np.dtype[Any], shape: tuple[int, int]) -> np.ndarray:
        view = self.tree["bufferViews"][entry["bufferView"]]
        start, offset, stride = view.get("byteOffset", 0), entry.get("byteOffset", 0), view.get("byteStride", 0)
        sizes = start, offset, stride, view["byteLength"], self.tree["buffers"][view["buffer"]].get("byteLength", 0)
        if not all(isinstance(size, int) and size >= 0 for size in (*sizes, shape[0])):
            raise ValueError(
                f"bufferView {entry['bufferView']} has offsets or sizes that are not whole numbers of at least 0"
            )
        stride = max(stride, shape[1] * dtype.itemsize)  # values never overlap
        # without a copy: thousands of accessors may have one large view
        data = memoryview(self.buffer(view["buffer"]))[start : start + view["byteLength"]]
        last = offset + (shape[0] - 1) * stride + shape[1] * dtype.itemsize
        if shape[0] and last > len(data):
            raise ValueError(f"bufferView {entry['bufferView']} has fewer bytes than its values need")
        return np.ndarray(shape, dtype, data if shape[0] else None, offset, (stride, dtype.itemsize))

    def _buffer(self, index: int) -> bytes:
        uri = self.tree["buffers"][index].get("uri")
        if uri is None:
            if index or not self.binary:
                used = ", ".join(self.tree.get("extensionsUsed", ())) or "no extension"
                raise ValueError(f"buffer {index} has no data; the file uses {used}")
            return self.binary
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2], validate=True)
        if len(uri) > MOST_CHARACTERS:  # before `resolve`, whose time grows with the square of the number of parts
            raise ValueError(f"buffer {index} must have a uri of at most {MOST_CHARACTERS:,} characters")
        path = (self.folder / unquote(uri)).resolve()
        if not (path.is_file() and path.is_relative_to(self.folder)):
            raise FileNotFoundError(f"it names {uri!r}, which is not a file in its folder")
        return self.read(path, self.tree["buffers"][index]["byteLength"])

    def _read(self, path: Path, size: int) -> bytes:
        self.claims.add(path.name, size)
        with path.open("rb") as file:
            return file.read(size)


def _numbers(entry: dict[str, Any], has: str, name: str, count: int | None = None) -> list[float] | None:
    """Returns a list of numbers, `count` of them unless it is None; None if there is none."""
    value = entry.get(name)
    fits = isinstance(value, list) and set(map(type, value)) <= {int, float} and len(value) == (count or len(value))
    if name in entry and not fits:
        raise ValueError(f"{has} {name} {str(value)[:100]}, not a list of {count or 'any'} numbers")
    return value


def _places(translation: Any, rotation: Any, scale: Any) -> np.ndarray:
    """Returns matrices [M, 4, 4] from M or one of each: translation [3], quaternion x y z w [4] and scale [3]."""
    given = [
        np.atleast_2d(np.array(value, np.float64)) for value in (translation, rotation, scale) if value is not None
    ]
    place_M44 = np.tile(np.eye(4), (max(map(len, given), default=1), 1, 1))
    if rotation is not None:
        place_M44[:, :3, :3] = Rotation.from_quat(np.atleast_2d(np.array(rotation, np.float64))).as_matrix()
    if scale is not None:
        place_M44[:, :3, :3] *= np.reshape(np.array(scale, np.float64), (-1, 1, 3))
    if translation is not None:
        place_M44[:, :3, 3] = np.reshape(np.array(translation, np.float64), (-1, 3))
    return place_M44
