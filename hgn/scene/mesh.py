"""Mesh files as obstacles: STL, OBJ, PLY, GLB and USD.

Shape legend: V vertices, U distinct vertices, F triangles, E directed triangle edges (3 F), B bodies.
"""

from __future__ import annotations

import codecs
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from hgn.config import MESH_SUFFIXES, USD_ENDINGS, is_mesh_file
from hgn.scene.glb import read_glb
from hgn.scene.polygons import (
    concave_cut,
    fans,
    fans_by_size,
    number_words,
    polygons_of_obj,
    polygons_of_ply,
    refuse_utf_16,
)
from hgn.scene.rotation import euler_rotation, rotate, round_to_float32
from hgn.scene.scene import Obstacle
from hgn.scene.surface import area_vectors, distinct_rows, point_tree
from hgn.scene.usd import read_usd_polygons
from hgn.schema import ConfigError, Vector, near_file, no_file, require, require_vector
from hgn.system.claims import Claims
from hgn.system.files import errors_name

_FACET = re.compile(
    rb"\bfacet(?:\s+normal)?(?:\s+\S+){3}\s+outer\s+loop((?:\s+vertex(?:\s+\S+){3}){3})\s+endloop\s+endfacet\b", re.I
)
_PART_OF_FACET = re.compile(rb"\bfacet\s+normal\b.*|^[^\S\n]*(facet|outer|vertex|endloop|endfacet)\b.*", re.I | re.M)
_BINARY_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])

SEAM = 1e-5  # largest distance of vertices at open edges that are joined, relative to the mesh's longest side
PLACED_BYTES = 64  # bytes that a vertex or a triangle of a placed mesh counts as
MOST_NEAR = 10  # mean number of vertices in cells of this size above which none are joined, because pairs take memory


def load_mesh(path: str | Path, field: str = "mesh", **placing: Any) -> Obstacle:
    """Reads a mesh file as one obstacle, closed if all parts are watertight. Options and errors as in `load_bodies`."""
    first, *others = load_bodies(path, field, **placing)
    for other in others:
        vertex_V3 = np.concatenate([first.vertex_V3, other.vertex_V3])
        triangle_F3 = np.concatenate([first.triangle_F3, other.triangle_F3 + np.int32(len(first.vertex_V3))])
        first = Obstacle(first.name, vertex_V3, triangle_F3, closed=False)
    return first


def load_bodies(
    path: str | Path,
    field: str = "mesh",
    *,
    scale: float = 1.0,
    translation: Vector = (0.0, 0.0, 0.0),
    rotation: Vector = (0.0, 0.0, 0.0),
    surfaces: Surfaces | None = None,
) -> tuple[Obstacle, ...]:
    """Reads a mesh file as a solid of its watertight bodies, a sheet of its other triangles, or both.

    The mesh is scaled, then turned about the fixed x, y and z axes (degrees, in this order), then moved. It may extend
    beyond the domain. A body is watertight if it is orientable and exactly two triangles meet at each of its edges; its
    triangles get a consistent orientation. Open edges within SEAM of each other are joined for this check. After the
    check corners with equal float32 coordinates are merged, and zero-area and repeated triangles are removed.
    Calls with the same `surfaces` read each file once, and share a limit.

    Raises: ConfigError naming `field` for a missing or unreadable file, an unknown suffix, no triangles, coordinates
    that are not finite, only zero-area triangles, or a bad scale, translation or rotation.
    """
    path = Path(path)
    require(0 < scale < np.inf, f"{field}: scale", "a finite number > 0", scale)
    for name, value in (("translation", translation), ("rotation", rotation)):
        require_vector(f"{field}: {name}", value)
    vertex_V3, triangle_F3 = (surfaces or Surfaces()).read(path, field)
    bad = np.flatnonzero(~np.isfinite(vertex_V3).all(axis=1))
    if len(bad):
        raise ConfigError(
            f"{field} must have finite vertices, got {vertex_V3[bad[0]].tolist()} for vertex {bad[0]} of {path}; "
            "export the mesh again"
        )
    placed = rotate(scale * vertex_V3, euler_rotation(rotation)) + np.array(translation, np.float64)
    limit = float(np.finfo(np.float32).max)
    if not np.abs(placed).max() < limit:
        raise ConfigError(f"{field} must stay within {limit:.1e} after scaling, got more for {path}; lower scale")
    closed_F, flip_F = _bodies(vertex_V3, triangle_F3)
    rounded_V3 = round_to_float32(placed)
    if not closed_F.all():  # checked again after a join, because equal corners may differ in their last digits
        joined_V3 = _joined(rounded_V3, triangle_F3[~closed_F])
        also_F, other_F = _bodies(joined_V3, triangle_F3)
        used = triangle_F3[also_F & ~closed_F]
        rounded_V3[used] = joined_V3[used]
        closed_F, flip_F = closed_F | also_F, np.where(closed_F, flip_F, other_F)
    triangle_F3[flip_F] = triangle_F3[flip_F][:, ::-1]
    parts = []
    for closed, name in ((True, path.stem), (False, f"{path.stem}_sheets" if closed_F.any() else path.stem)):
        own_V3, own_F3 = _weld(rounded_V3, triangle_F3[closed_F == closed])
        if len(own_F3):
            parts.append(Obstacle(name, own_V3, own_F3, closed))
    if not parts:
        raise ConfigError(
            f"{field} must have a triangle with an area, got only zero-area triangles in {path}; "
            "raise scale or repair the mesh"
        )
    return tuple(parts)


class Surfaces:
    """The surfaces of mesh files, each read once. `most` limits the bytes that they count as together, because each
    pair of corners of concave faces, and each placed vertex and triangle, takes time.
    """

    def __init__(self, most: float = np.inf) -> None:
        self._surfaces: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self._most, self._used = most, 0

    def read(self, path: Path, field: str) -> tuple[np.ndarray, np.ndarray]:
        """Returns vertices, float64 [V, 3], and a copy of triangles, int64 [F, 3]. Raises: ConfigError."""
        if (name := os.path.realpath(path)) not in self._surfaces:
            vertex_V3, triangle_F3, claims = _read(path, field)
            self._surfaces[name], self._used = (vertex_V3, triangle_F3), self._used + claims.used
        vertex_V3, triangle_F3 = self._surfaces[name]
        self._used += PLACED_BYTES * (len(vertex_V3) + len(triangle_F3))
        rule = f"of at most {self._most} bytes with the meshes before it, each counted as often as it is named"
        require(self._used <= self._most, field, rule, self._used, "join entries of one file, or simplify the file")
        return vertex_V3, triangle_F3.copy()


@np.errstate(all="ignore")  # numbers that are not finite are refused
def _read(path: Path, field: str) -> tuple[np.ndarray, np.ndarray, Claims]:
    if not is_mesh_file(path):
        endings = ", ".join((*MESH_SUFFIXES, *USD_ENDINGS))
        remedy = "convert the mesh" if path.is_file() else near_file(path) or "convert the mesh"
        raise ConfigError(f"{field} must end in one of {endings}, got {path}; {remedy}")
    if not path.is_file():
        raise no_file(field, path, near_file(path) or f"there is no file at {path.absolute()}")
    with errors_name(path):
        data = b"" if path.suffix.lower() in USD_ENDINGS else path.read_bytes()
    try:
        claims = Claims(path)
        vertex, triangle = (read_glb if path.suffix.lower() == ".glb" else _read_polygons)(path, data, claims)
    except (ConfigError, ModuleNotFoundError):
        raise
    except Exception as error:  # damaged files raise any kind of error
        raise ConfigError(
            f"{field} must be a readable {path.suffix[1:].upper()} file, got {path} ({error}); export the mesh again"
        ) from error
    if len(triangle) == 0:
        raise ConfigError(f"{field} must contain triangles, got none in {path}; export the surface, not points")
    if triangle.min() < 0 or triangle.max() >= len(vertex):
        raise ConfigError(
            f"{field} must have triangles whose indices are below {len(vertex)}, its vertices, got {triangle.min()} to "
            f"{triangle.max()} in {path}; export the mesh again"
        )
    return vertex, triangle, claims


def _read_polygons(path: Path, data: bytes, claims: Claims) -> tuple[np.ndarray, np.ndarray]:
    """Reads STL, OBJ, PLY and USD."""
    kind = path.suffix[1:].lower()
    if kind == "stl":
        vertex_V3 = _corners_of_stl(data).reshape(-1, 3).astype(np.float64)
        return vertex_V3, np.arange(len(vertex_V3)).reshape(-1, 3)
    readers = {"obj": polygons_of_obj, "ply": polygons_of_ply}
    vertex_V3, faces = readers[kind](data) if kind in readers else read_usd_polygons(path)
    if (cut_F3 := concave_cut(vertex_V3, faces, claims)) is not None:
        return vertex_V3, cut_F3
    if kind == "obj" and len({len(face) for face in faces}) > 1:
        return vertex_V3, fans(faces)
    return vertex_V3, fans_by_size(faces)


def _corners_of_stl(data: bytes) -> np.ndarray:
    """Returns the corners of the triangles of a binary or a text STL file. Raises: ValueError if it is cut."""
    text = data.removeprefix(codecs.BOM_UTF8).replace(b"\r", b"\n")
    if text.lstrip()[:5].lower() != b"solid" or b"\0" in text[:200]:  # many binary files begin with `solid` too
        size = 84 + 50 * int.from_bytes(data[80:84], "little")
        if len(data) < size:
            refuse_utf_16(data)
            raise ValueError(f"it has {len(data)} of {size} bytes")
        return np.frombuffer(data[84:size], _BINARY_FACET)["corners"]  # some programs append bytes to the triangles
    if b"endsolid" not in text.lower().rpartition(b"endfacet")[2]:  # a name may contain it too
        raise ValueError("it ends before endsolid")
    if part := _PART_OF_FACET.search(_FACET.sub(b"\n", text)):
        raise ValueError(f"it has an incomplete facet: {part[0].decode('utf-8', 'replace').strip()[:80]}")
    return np.array(number_words(b" ".join(_FACET.findall(text)).lower().replace(b"vertex", b"")), np.float64)


def _bodies(vertex_V3: np.ndarray, triangle_F3: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns whether each triangle belongs to a watertight body, and whether it must be flipped, both bool [F].

    Vertices at equal positions count as one. Triangles with fewer than three distinct vertices do not count, and equal
    triangles count once.
    """
    _, _, index_V = distinct_rows(vertex_V3)
    triangle = index_V[triangle_F3]
    different_F = (triangle != np.roll(triangle, 1, axis=1)).all(axis=1)
    _, first, alike_F = distinct_rows(np.sort(triangle, axis=1))
    counted = np.sort(first[different_F[first]])
    closed_F, flip_F = np.zeros((2, len(triangle)), bool)
    if len(counted):
        closed_F[counted], flip_F[counted] = _orientation(triangle[counted])
    return closed_F[first][alike_F], flip_F  # repeated triangles belong to the body of the first one


def _joined(vertex_V3: np.ndarray, triangle_F3: np.ndarray) -> np.ndarray:
    """Returns the vertices, float64 [V, 3]. Vertices at open edges within SEAM of each other get the same position."""
    unique_U3, _, index_V = distinct_rows(vertex_V3)
    triangle = index_V[triangle_F3]
    edge_E2 = np.sort(np.stack([triangle, np.roll(triangle, -1, axis=1)], -1).reshape(-1, 2), axis=1)
    edge_E2, _, own_E = distinct_rows(edge_E2)
    border = np.unique(edge_E2[np.bincount(own_E) != 2])
    reach = SEAM * (np.ptp(unique_U3[triangle].reshape(-1, 3), axis=0).max() or 1.0)  # 0 if all corners are one
    _, _, cell = distinct_rows(np.floor(unique_U3[border] / reach))
    if (np.bincount(cell) ** 2).sum() < MOST_NEAR * len(border):
        row, column = point_tree(unique_U3[border]).query_pairs(reach, output_type="ndarray").T
        _, label = _components(row, column, len(border))
        unique_U3[border] = unique_U3[border[np.unique(label, return_index=True)[1][label]]]
    return np.asarray(unique_U3[index_V])


def _weld(vertex_V3: np.ndarray, triangle_F3: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merges equal vertices. Removes zero-area and repeated triangles, and unused vertices."""
    unique, _, index_V = distinct_rows(vertex_V3 + 0.0)  # turns -0 into 0
    triangle = index_V[triangle_F3]
    triangle = triangle[(area_vectors(unique[triangle]) != 0).any(axis=1)]
    _, first, _ = distinct_rows(np.sort(triangle, axis=1))
    triangle = triangle[np.sort(first)]
    used, compact = np.unique(triangle, return_inverse=True)
    return unique[used], compact.reshape(-1, 3).astype(np.int32)


def _orientation(triangle_F3: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns which triangles belong to watertight bodies, and which of these to flip for one orientation, bool [F].

    A body keeps the orientation of most of its triangles. Each triangle has two copies, one per orientation. A copy is
    connected to the copies of its neighbours with the same orientation. So an orientable body has two components, and
    a one-sided body has one.
    """
    count = len(triangle_F3)
    start_E, end_E = triangle_F3.T.reshape(-1), np.roll(triangle_F3, -1, axis=1).T.reshape(-1)
    low_E, high_E = np.minimum(start_E, end_E).astype(np.int64), np.maximum(start_E, end_E)
    _, edge_E, uses = np.unique(low_E * (int(triangle_F3.max()) + 1) + high_E, return_inverse=True, return_counts=True)
    order = np.argsort(edge_E, kind="stable")
    first = (np.cumsum(uses) - uses)[uses == 2]
    one, two = order[first], order[first + 1]
    disagree = start_E[one] == start_E[two]
    face_one, face_two = one % count, two % count
    row = np.concatenate([face_one, face_one + count])
    column = np.concatenate([face_two + np.where(disagree, count, 0), face_two + np.where(disagree, 0, count)])
    parts, label = _components(row, column, 2 * count)
    upright, flipped = label[:count], label[count:]
    # triangles that share any edge belong to one body
    same = edge_E[order[1:]] == edge_E[order[:-1]]
    bodies, body_F = _components(order[1:][same] % count, order[:-1][same] % count, count)
    open_B = np.zeros(bodies, bool)
    open_B[body_F[upright == flipped]] = True
    open_B[body_F[np.flatnonzero(uses[edge_E] != 2) % count]] = True
    # a component and its mirror image contain the same triangles; the one with more unflipped triangles is kept
    votes = np.bincount(upright, minlength=parts)
    kept_wins = (votes[upright] > votes[flipped]) | ((votes[upright] == votes[flipped]) & (upright < flipped))
    closed_F = ~open_B[body_F]
    return closed_F, closed_F & ~kept_wins


def _components(row: np.ndarray, column: np.ndarray, count: int) -> tuple[int, np.ndarray]:
    graph = coo_matrix((np.ones(len(row), np.int8), (row, column)), shape=(count, count))
    number, label = connected_components(graph, directed=False)
    return int(number), label
