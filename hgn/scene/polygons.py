"""Cuts polygons of OBJ and PLY files into triangles, concave polygons by ear clipping.

Shape legend: V vertices, K corners of a polygon, M polygons with the same number of corners, F triangles. In `_ears`: L
corners that are left, W polygons whose next ear is not yet found.
"""

import codecs
import io
import re
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from hgn.system.claims import Claims

FLAT = 1e-9  # smallest turn at a corner that counts as concave, as a fraction of the polygon's area
# Largest number of corners of a concave face. The time of a cut grows with its square; the sum of squares is limited.
MAXIMUM_CORNERS = 2_000
PAIR_BYTES = 16  # bytes that a pair of corners of a concave face counts as, because each takes time
_LINE = re.compile(rb"^[ \t]*([vf])[ \t]+(.*)$", re.MULTILINE | re.IGNORECASE)
_SPACES = bytes.maketrans(b"\r\f\v", b"\n  ")
_UTF_16 = re.compile(rb"\xff\xfe|\xfe\xff|[^\0]\0[^\0]\0|\0[^\0]\0[^\0]")
_COMMENT = re.compile(rb"(?:^|[ \t])#.*", re.MULTILINE)
# free-form surfaces, and other files
_UNREAD = re.compile(rb"^[ \t]*(surf|bzp|bsp|cdp|fo|call)[ \t]", re.MULTILINE | re.IGNORECASE)
_INDICES = ("vertex_indices", "vertex_index")  # usual names of the property with a face's vertices
_TYPES = {
    **dict.fromkeys(("char", "int8"), "b"),
    **dict.fromkeys(("uchar", "uint8"), "B"),
    **dict.fromkeys(("short", "int16"), "h"),
    **dict.fromkeys(("ushort", "uint16"), "H"),
    **dict.fromkeys(("int", "int32"), "i"),
    **dict.fromkeys(("uint", "uint32"), "I"),
    **dict.fromkeys(("float", "float32"), "f"),
    **dict.fromkeys(("double", "float64"), "d"),
}  # fmt: skip; format characters of struct and NumPy


def refuse_utf_16(data: bytes) -> None:
    """Raises ValueError for UTF-16 text."""
    if _UTF_16.match(data):
        raise ValueError("it is UTF-16 text; save it as UTF-8")


def number_words(text: bytes) -> list[bytes]:
    """Returns the words of text that has only numbers. Raises: ValueError for 1_0, which Python reads as 10."""
    words = text.split()
    if b"_" in text:
        word = next(word for word in words if b"_" in word).decode("utf-8", "replace")
        raise ValueError(f"it has {word[:80]} for a number; write it without _")
    return words


def polygons_of_obj(data: bytes) -> tuple[np.ndarray, list[np.ndarray]]:
    """Returns vertices, float64 [V, 3], and the vertices of each face of an OBJ file.

    Raises: ValueError for UTF-16, vertex 0, fewer than three coordinates, numbers that cannot be read, and free-form
    surfaces.
    """
    refuse_utf_16(data)
    text = data.replace(codecs.BOM_UTF8, b"").replace(b"\r\n", b"\n").translate(_SPACES)
    text = _COMMENT.sub(b"", text).replace(b"\\\n", b" ")
    if unread := _UNREAD.search(text):
        raise ValueError(f"it contains {unread[1].decode()}, which is not read; write polygons")
    vertices: list[list[bytes]] = []
    faces = []
    for keyword, line in _LINE.findall(text):
        words = number_words(line)
        if keyword in b"vV":
            if len(words) < 3:
                raise ValueError(f"vertex {len(vertices) + 1} has {len(words)} coordinates, not 3")
            vertices.append(words[:3])
        elif len(words) > 2:
            index = np.array([int(word.partition(b"/")[0]) for word in words])
            if not index.all():
                raise ValueError("a face has vertex 0, but OBJ counts from 1")
            faces.append(np.where(index > 0, index - 1, index + len(vertices)))  # negative indices count backwards
    return np.array(vertices, np.float64).reshape(len(vertices), 3), faces


def polygons_of_ply(data: bytes) -> tuple[np.ndarray, list[np.ndarray]]:
    """Returns vertices and faces of a PLY file, as `polygons_of_obj`. Raises: ValueError or LookupError if damaged."""
    refuse_utf_16(data)
    file, form, element, elements = io.BytesIO(data), "", "", dict[str, tuple[int, list[list[str]]]]()
    for line in file if data.startswith(b"ply") else ():
        words = line.decode("ascii", "replace").split() or [""]
        if words == ["end_header"]:
            break
        if words[0] == "format":
            form = words[1]
        elif words[0] == "element":
            element = words[1]
            if element in elements:
                raise ValueError(f"it has the element {element[:80]} twice")
            elements[element] = int(*number_words(words[2].encode())), []
        elif words[0] == "property":
            elements[element][1].append(words[1:])
    else:
        raise ValueError("it has no header of PLY")
    numbers = _Numbers(data[file.tell() :], "" if form == "ascii" else "<>"["big" in form])
    vertex_V3, faces = np.zeros((0, 3)), list[np.ndarray]()
    for name, (count, properties) in elements.items():
        names = [entry[-1] for entry in properties]
        if name == "tristrips" and count:
            raise ValueError("it contains tristrips, which are not read; write polygons")
        columns = numbers.columns(count, properties)
        if name == "vertex":
            vertex_V3 = np.stack([columns[names.index(axis)] for axis in "xyz"], axis=1, dtype=np.float64)
        elif name == "face":
            lists = [entry[-1] for entry in properties if entry[0] == "list"]
            given = next((name for name in (*_INDICES, *lists) if name in names), "vertex_indices")
            faces = [np.asarray(face).astype(np.int64) for face in columns[names.index(given)]]
            if properties[names.index(given)][2][0] in "fd":
                raise ValueError("its faces name vertices by numbers that are not whole")
    return vertex_V3, faces


class _Numbers:
    """The numbers after the header of a PLY file. `order` is the byte order; it is empty for text."""

    def __init__(self, data: bytes, order: str) -> None:
        self.order, self.place = order, 0
        self.bytes, self.words = data, np.zeros(0) if order else np.array(number_words(data), np.float64)

    def columns(self, count: int, properties: list[list[str]]) -> list[Any]:
        """Returns the next rows of these properties as columns. A column of lists contains arrays."""
        start = self.place
        if not properties:
            return []
        if 4 * count > len(self.bytes) and any(entry[0] == "list" for entry in properties):  # each takes 150 bytes
            raise ValueError(f"it has {len(self.bytes)} bytes for {count} lists, fewer than triangles need")
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
                row += self._few(1, kind[0])
            else:
                row.append(self._few(int(*self._few(1, kind[1])), kind[2]))
        return row

    def _few(self, count: int, kind: str) -> Sequence[float]:
        """Returns the next numbers of one kind. Raises: ValueError at the file's end; struct.error for a bad count."""
        if not self.order:
            return self._take(count, [kind])[:, 0].tolist()
        start, form = self.place, f"{self.order}{count}{_TYPES[kind]}"
        self.place += struct.calcsize(form)
        if self.place > len(self.bytes):
            raise ValueError("it is cut")
        return struct.unpack_from(form, self.bytes, start)

    def _take(self, count: int, kinds: list[str]) -> np.ndarray:
        """Returns the next numbers, float64 [count, kinds]. Raises: ValueError at the end of the file."""
        if not self.order:
            last = self.place + count * len(kinds)
            if not self.place <= last <= len(self.words):
                raise ValueError("it is cut")
            table = self.words[self.place : last].reshape(count, len(kinds))
            whole = np.array([_TYPES.get(kind, "d") not in "fd" for kind in kinds])
            if len(bad := table[(table % 1 != 0) & whole]):
                raise ValueError(f"it has {bad[0]} where its header declares whole numbers")
            self.place = last
            return table
        dtype = np.dtype([(str(i), self.order + _TYPES[kind]) for i, kind in enumerate(kinds)])
        if not 0 <= count * dtype.itemsize <= len(self.bytes) - self.place:
            raise ValueError("it is cut")
        rows = np.ndarray(count, dtype, self.bytes, self.place)
        self.place += count * dtype.itemsize
        return np.stack([rows[name].astype(np.float64) for name in dtype.names or ()], axis=1)


def concave_cut(vertex_V3: np.ndarray, faces: list[np.ndarray], claims: Claims) -> np.ndarray | None:
    """Returns the triangles of all faces, int64 [F, 3], or None if no face is concave. Adds their pairs of corners to
    `claims`.

    Raises: ValueError naming a face whose edges cross or touch, or if concave faces have too many corners.
    """
    concave = _concave(vertex_V3, faces)
    if not concave:
        return None
    pairs = sum(face_MK.size * face_MK.shape[1] for _, face_MK in concave)
    if pairs > MAXIMUM_CORNERS**2:
        count, largest = sum(len(face_MK) for _, face_MK in concave), max(face_MK.shape[1] for _, face_MK in concave)
        raise ValueError(f"it has {count} concave faces, of up to {largest} corners; cut them into triangles")
    claims.add("concave faces", pairs, PAIR_BYTES)
    cut: dict[int, np.ndarray] = {}
    for number_M, face_MK in concave:
        corner_MF3 = _ears(_flattened(vertex_V3[face_MK]), number_M)
        cut |= zip(number_M.tolist(), np.take_along_axis(face_MK[:, None], corner_MF3, axis=2), strict=True)
    pieces = []
    for number, face in enumerate(faces):
        if number in cut:
            pieces.append(cut[number])
        elif len(face) > 2:
            pieces.append(np.stack([np.full(len(face) - 2, face[0]), face[1:-1], face[2:]], axis=1))
    return np.concatenate(pieces)


def fans(faces: list[np.ndarray]) -> np.ndarray:
    """Returns the triangles of convex faces in the order of the faces, int64 [F, 3]."""
    corners = {
        size: np.array([(0, 1, 2), (2, 3, 0)] if size == 4 else [(0, k, k + 1) for k in range(1, size - 1)])
        for size in {len(face) for face in faces}
    }
    return np.concatenate([face[corners[len(face)]] for face in faces])


def fans_by_size(faces: list[np.ndarray]) -> np.ndarray:
    """Returns the triangles of convex faces: of triangles, the halves of quads, of larger faces, int64 [F, 3]."""
    triangle_M3, quad_M4 = (
        np.array([face for face in faces if len(face) == size], np.int64).reshape(-1, size) for size in (3, 4)
    )
    larger = [fans([face]) for face in faces if len(face) > 4]
    return np.concatenate([triangle_M3, quad_M4[:, [0, 1, 2]], quad_M4[:, [2, 3, 0]], *larger])


def _concave(vertex_V3: np.ndarray, faces: list[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Returns numbers [M] and vertices [M, K] of faces that are concave or cross themselves, for each K."""
    sizes, result = np.array([len(face) for face in faces], np.int64), []
    for size in np.unique(sizes[sizes > 3]):
        number_M = np.flatnonzero(sizes == size)
        face_MK = np.stack([faces[number] for number in number_M])
        if face_MK.min() < 0 or face_MK.max() >= len(vertex_V3):
            return []  # hgn.scene.mesh refuses the file
        point_MK3 = vertex_V3[face_MK]
        edge_MK3 = np.roll(point_MK3, -1, axis=1) - point_MK3
        turn_MK3 = np.cross(np.roll(edge_MK3, 1, axis=1), edge_MK3)
        normal_M3 = _normals(point_MK3)
        inward_MK = np.einsum("mka,ma->mk", turn_MK3, normal_M3)
        size_M = (normal_M3**2).sum(axis=1)
        bad_M = (inward_MK < -FLAT * size_M[:, None]).any(axis=1)
        bad_M |= size_M < FLAT**2 * (turn_MK3**2).sum(axis=2).max(axis=1)  # no area: opposite loops cancel
        if size > 4:  # more than one loop of the same orientation: exterior angles of more than 360 degrees
            ahead_MK = (np.roll(edge_MK3, 1, axis=1) * edge_MK3).sum(axis=2) * np.sqrt(size_M)[:, None]
            bad_M |= np.arctan2(inward_MK, ahead_MK).sum(axis=1) > 3 * np.pi
        if bad_M.any():
            result.append((number_M[bad_M], face_MK[bad_M]))
    return result


def _normals(point_MK3: np.ndarray) -> np.ndarray:
    """Returns Newell's normals. Positions relative to the first corner keep them accurate far from the origin."""
    local_MK3 = point_MK3 - point_MK3[:, :1]
    return np.asarray(np.cross(local_MK3, np.roll(local_MK3, -1, axis=1)).sum(axis=1))


def _flattened(point_MK3: np.ndarray) -> np.ndarray:
    """Returns polygons projected along their normals, counterclockwise, float64 [M, K, 2]."""
    normal_M3 = _unit(_normals(point_MK3))
    first_M3 = _unit(np.cross(np.eye(3)[np.argmin(np.abs(normal_M3), axis=1)], normal_M3))
    local_MK3 = point_MK3 - point_MK3[:, :1]
    axes = (first_M3, np.cross(normal_M3, first_M3))
    return np.concatenate([local_MK3 @ axis_M3[:, :, None] for axis_M3 in axes], axis=2)


def _unit(vector_M3: np.ndarray) -> np.ndarray:
    length_M1 = np.sqrt(vector_M3[:, None] @ vector_M3[:, :, None])[:, 0]
    return np.asarray(vector_M3 / np.maximum(length_M1, 1e-300))


def _ears(point_MK2: np.ndarray, number_M: np.ndarray) -> np.ndarray:
    """Returns the triangles of polygons, corners int [M, K - 2, 3].

    Cuts off corners one by one. The triangle of such a corner (an ear) contains no other corner.
    Corners on a straight line become triangles without area, so that neighbouring faces still share their edges.
    """
    count, size = point_MK2.shape[:2]
    area_M = _cross(point_MK2, np.roll(point_MK2, -1, axis=1)).sum(axis=1)
    edge_MK2 = np.roll(point_MK2, -1, axis=1) - point_MK2
    side_MKK = _cross(edge_MK2[:, :, None], point_MK2[:, None] - point_MK2[:, :, None])  # side of edge i, at corner j
    apart_MKK = side_MKK * np.roll(side_MKK, -1, axis=2) < 0
    crossing_M = ~(area_M > 0) | (apart_MKK & apart_MKK.transpose(0, 2, 1)).any(axis=(1, 2))
    _require_none(number_M[crossing_M], "cross")
    rest_ML, ears = np.tile(np.arange(size), (count, 1)), []
    row_M, blocker_MK = np.arange(count), np.full((count, size), -1)  # a corner in each one's triangle; -1: none known
    for left in range(size, 3, -1):
        point_ML2 = np.take_along_axis(point_MK2, rest_ML[:, :, None], axis=1)
        corner_3ML2 = np.stack([np.roll(point_ML2, 1, axis=1), point_ML2, np.roll(point_ML2, -1, axis=1)])
        turn_ML = _cross(corner_3ML2[1] - corner_3ML2[0], corner_3ML2[2] - corner_3ML2[1])
        # widest ears first; triangles without area come last
        order_ML = np.argsort(-turn_ML, axis=1, kind="stable")
        blocked_ML = blocker_MK[row_M[:, None], np.take_along_axis(rest_ML, order_ML, axis=1)] >= 0
        waiting, ear_M = row_M, np.zeros(count, np.int64)
        while len(waiting):
            rank = blocked_ML[waiting].argmin(axis=1)
            k = order_ML[waiting, rank]
            turn, flat, corner_3W2 = turn_ML[waiting, k], FLAT * area_M[waiting], corner_3ML2[:, waiting, k]
            _require_none(number_M[waiting[blocked_ML[waiting, rank] | (turn < -flat)]], "touch")
            others_WL2 = point_ML2[waiting]
            inside_WL = np.ones(others_WL2.shape[:2], bool)
            for start_W2, end_W2 in zip(corner_3W2, np.roll(corner_3W2, -1, axis=0), strict=True):
                inside_WL &= _cross((end_W2 - start_W2)[:, None], others_WL2 - start_W2[:, None]) >= 0
                inside_WL &= (others_WL2 != start_W2[:, None]).any(axis=2)
            shut = (turn > flat) & inside_WL.any(axis=1)
            ear_M[waiting[~shut]], waiting = k[~shut], waiting[shut]
            blocked_ML[waiting, rank[shut]] = True
            blocker_MK[waiting, rest_ML[waiting, k[shut]]] = rest_ML[waiting, inside_WL[shut].argmax(axis=1)]
        ears.append(np.take_along_axis(rest_ML, (ear_M[:, None] + (-1, 0, 1)) % left, axis=1))
        blocker_MK[row_M[:, None], ears[-1]] = -1  # the triangles of the ear's neighbours have changed
        blocker_MK[blocker_MK == ears[-1][:, 1:2]] = -1
        rest_ML = rest_ML[np.arange(left) != ear_M[:, None]].reshape(count, left - 1)
    return np.stack([*ears, rest_ML], axis=1)


def _require_none(number_M: np.ndarray, cause: str) -> None:
    if len(number_M):
        raise ValueError(f"face {number_M[0]} cannot be cut into triangles, because its edges {cause}")


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
