"""Cuts polygons of OBJ and PLY files into triangles. Concave ones are cut by ears; mesh readers would cut fans.

Shape legend: V vertices, K corners of a polygon, M polygons with the same number of corners, F triangles.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

FLAT = 1e-9  # smallest turn at a corner that counts as concave, as a fraction of the polygon's area
MAXIMUM_CORNERS = 2_000  # of one concave face; cutting takes the square, which is limited for the sum of all faces
_LINE = re.compile(rb"^[ \t]*([vf])[ \t]+(.*)$", re.MULTILINE)
_JOINED = re.compile(rb"\\\r?\n")
_COMMENT = re.compile(rb"[ \t]#.*")
_INDICES = ("vertex_indices", "vertex_index")  # usual names of the property with a face's vertices
_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"), **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"), **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"), **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"), **dict.fromkeys(("double", "float64"), "f8"),
}  # fmt: skip


def plain_obj(data: bytes) -> bytes:
    """Returns an OBJ file without comments after numbers and without continued lines, which trimesh cannot read."""
    return _COMMENT.sub(b"", _JOINED.sub(b" ", data))


def polygons_of_obj(data: bytes) -> tuple[np.ndarray, list[np.ndarray]]:
    """Returns vertices, float64 [V, 3], and the vertices of each face of a plain OBJ file."""
    vertices: list[list[bytes]] = []
    faces = []
    for keyword, text in _LINE.findall(data):
        words = text.split()
        if keyword == b"v":
            vertices.append(words[:3])
            continue
        index = np.array([int(word.partition(b"/")[0]) for word in words])
        faces.append(np.where(index > 0, index - 1, index + len(vertices)))  # negative indices count backwards
    return np.array(vertices, np.float64).reshape(-1, 3), faces


def polygons_of_ply(data: bytes) -> tuple[np.ndarray, list[np.ndarray]]:
    """Returns vertices and faces of a PLY file, as `polygons_of_obj`. Raises: ValueError or LookupError if damaged."""
    end = re.search(rb"end_header[ \t]*\r?\n", data)
    if end is None or not data.startswith(b"ply"):
        raise ValueError("it has no header of PLY")
    form, elements = "", list[tuple[str, int, list[list[str]]]]()
    for line in data[: end.start()].decode("ascii", "replace").splitlines():
        words = line.split() or [""]
        if words[0] == "format":
            form = words[1]
        elif words[0] == "element":
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property":
            elements[-1][2].append(words[1:])
    numbers = _Numbers(data[end.end() :], "" if form == "ascii" else "<>"["big" in form])
    vertex_V3, faces = np.zeros((0, 3)), list[np.ndarray]()
    for name, count, properties in elements:
        names = [entry[-1] for entry in properties]
        columns = numbers.columns(count, properties)
        if name == "vertex":
            vertex_V3 = np.stack([columns[names.index(axis)] for axis in "xyz"], axis=1)
        elif name == "face":
            lists = [entry[-1] for entry in properties if entry[0] == "list"]
            given = next((name for name in (*_INDICES, *lists) if name in names), "vertex_indices")
            faces = [np.asarray(face).astype(np.int64) for face in columns[names.index(given)]]
    return vertex_V3, faces


class _Numbers:
    """The numbers after the header of a PLY file. `order` is the byte order; it is empty for text."""

    def __init__(self, data: bytes, order: str) -> None:
        self.order, self.place = order, 0
        self.bytes, self.words = data, np.zeros(0) if order else np.array(data.split(), np.float64)

    def columns(self, count: int, properties: list[list[str]]) -> list[Any]:
        """Returns the next rows of these properties as columns. A column of lists contains arrays."""
        start = self.place
        if not properties:
            return []
        try:
            return self._alike(count, properties)
        except ValueError:  # lists of different lengths, or the end of the file
            self.place = start
        return list(zip(*(self._row(properties) for _ in range(count)), strict=True)) or [[] for _ in properties]

    def _alike(self, count: int, properties: list[list[str]]) -> list[np.ndarray]:
        """Reads rows whose lists have the same lengths as in the first row. Raises: ValueError for other lengths."""
        start = self.place
        lengths = [np.size(value) for value in self._row(properties)] if count else [1] * len(properties)
        self.place, kinds, firsts = start, list[str](), list[int]()
        for (*kind, _), length in zip(properties, lengths, strict=True):
            firsts.append(len(kinds))
            kinds += [kind[0]] if len(kind) == 1 else [kind[1], *[kind[2]] * length]
        table = self._take(count, kinds)
        columns: list[np.ndarray] = []
        for entry, first, length in zip(properties, firsts, lengths, strict=True):
            if entry[0] != "list":
                columns.append(table[:, first])
                continue
            if (table[:, first] != length).any():
                raise ValueError("lists of different lengths")
            columns.append(table[:, first + 1 : first + 1 + length])
        return columns

    def _row(self, properties: list[list[str]]) -> list[Any]:
        row: list[Any] = []
        for *kind, _ in properties:
            if len(kind) == 1:
                row.append(self._take(1, kind)[0, 0])
            else:
                length = int(self._take(1, kind[1:2])[0, 0])
                row.append(self._take(length, kind[2:])[:, 0])
        return row

    def _take(self, count: int, kinds: list[str]) -> np.ndarray:
        """Returns the next numbers, float64 [count, kinds]. Raises: ValueError at the end of the file."""
        if not self.order:
            last = self.place + count * len(kinds)
            if last > len(self.words):
                raise ValueError("it is cut")
            table = self.words[self.place : last].reshape(count, len(kinds))
            self.place = last
            return table
        dtype = np.dtype([(str(i), self.order + _TYPES[kind]) for i, kind in enumerate(kinds)])
        if not 0 <= count * dtype.itemsize <= len(self.bytes) - self.place:
            raise ValueError("it is cut")
        rows = np.ndarray(count, dtype, self.bytes, self.place)
        self.place += count * dtype.itemsize
        return np.stack([rows[name].astype(np.float64) for name in dtype.names or ()], axis=1)


def concave_cut(vertex_V3: np.ndarray, faces: list[np.ndarray]) -> np.ndarray | None:
    """Returns the triangles of all faces, int64 [F, 3], or None if no face is concave.

    Raises: ValueError naming a face whose edges cross, or which has a vertex that does not exist.
    """
    concave = _concave(vertex_V3, faces)
    if not concave:
        return None
    if sum(len(faces[number]) ** 2 for number in concave) > MAXIMUM_CORNERS**2:
        largest = max(len(faces[number]) for number in concave)
        raise ValueError(f"it has {len(concave)} concave faces, of up to {largest} corners; cut them into triangles")
    pieces = []
    for number, face in enumerate(faces):
        if number in concave:
            pieces.append(face[_ears(_flattened(vertex_V3[face]), number)])
        elif len(face) > 2:
            pieces.append(np.stack([np.full(len(face) - 2, face[0]), face[1:-1], face[2:]], axis=1))
    return np.concatenate(pieces)


def _concave(vertex_V3: np.ndarray, faces: list[np.ndarray]) -> set[int]:
    """Returns the numbers of the concave faces."""
    sizes, result = np.array([len(face) for face in faces], np.int64), set()
    for size in np.unique(sizes[sizes > 3]):
        number_M = np.flatnonzero(sizes == size)
        face_MK = np.stack([faces[number] for number in number_M])
        if face_MK.min() < 0 or face_MK.max() >= len(vertex_V3):
            return set()  # other code refuses such a file
        point_MK3 = vertex_V3[face_MK]
        edge_MK3 = np.roll(point_MK3, -1, axis=1) - point_MK3
        turn_MK3 = np.cross(np.roll(edge_MK3, 1, axis=1), edge_MK3)
        # Newell's normal relative to the first corner, which keeps it exact far from the origin
        local_MK3 = point_MK3 - point_MK3[:, :1]
        normal_M3 = np.cross(local_MK3, np.roll(local_MK3, -1, axis=1)).sum(axis=1)
        inward_MK = np.einsum("mka,ma->mk", turn_MK3, normal_M3)
        bad_M = (inward_MK < -FLAT * (normal_M3**2).sum(axis=1)[:, None]).any(axis=1)
        result |= set(number_M[bad_M].tolist())
    return result


def _flattened(point_K3: np.ndarray) -> np.ndarray:
    """Returns a polygon projected along its normal, counterclockwise, float64 [K, 2]."""
    local_K3 = point_K3 - point_K3[0]
    normal_3 = np.cross(local_K3, np.roll(local_K3, -1, axis=0)).sum(axis=0)
    normal_3 = normal_3 / max(float(np.linalg.norm(normal_3)), 1e-300)
    first_3 = np.cross(np.eye(3)[np.argmin(np.abs(normal_3))], normal_3)
    first_3 /= max(float(np.linalg.norm(first_3)), 1e-300)
    return np.stack([local_K3 @ first_3, local_K3 @ np.cross(normal_3, first_3)], axis=1)


def _ears(point_K2: np.ndarray, number: int) -> np.ndarray:
    """Returns the triangles of a polygon, corners int [K - 2, 3]. Repeatedly cuts off a corner that contains no other.

    Corners on a straight line become triangles without area, so that neighbouring faces still share their edges.
    """
    rest, ears = list(range(len(point_K2))), []
    area = float(_cross(point_K2, np.roll(point_K2, -1, axis=0)).sum())
    edge_K2 = np.roll(point_K2, -1, axis=0) - point_K2
    side_KK = _cross(edge_K2[:, None], point_K2[None] - point_K2[:, None])  # side of edge i, at corner j
    apart_KK = side_KK * np.roll(side_KK, -1, axis=1) < 0
    if area <= 0 or (apart_KK & apart_KK.T).any():
        raise ValueError(f"face {number} cannot be cut into triangles, because its edges cross")
    while len(rest) > 3:
        point_K2_left = point_K2[rest]
        before, after = np.roll(point_K2_left, 1, axis=0), np.roll(point_K2_left, -1, axis=0)
        turn_K = _cross(point_K2_left - before, after - point_K2_left)
        # widest ears first; triangles without area come last
        for k in np.argsort(-turn_K, kind="stable"):
            if turn_K[k] < -FLAT * area:
                raise ValueError(f"face {number} cannot be cut into triangles, because its edges touch")
            a, b, c = before[k], point_K2_left[k], after[k]
            same_K = (point_K2_left[:, None] == np.stack([a, b, c])).all(axis=2).any(axis=1)
            others = point_K2_left[~same_K]
            sides = [_cross(end - start, others - start) for start, end in ((a, b), (b, c), (c, a))]
            if turn_K[k] <= FLAT * area or not (np.minimum.reduce(sides) >= 0).any():
                ears.append([rest[k - 1], rest[k], rest[(k + 1) % len(rest)]])
                del rest[k]
                break
    return np.array([*ears, rest])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
