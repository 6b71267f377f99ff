"""Mesh files as obstacles: STL, OBJ, PLY and GLB through trimesh.

Shape legend: V vertices, F triangles, E directed triangle edges (3 F).
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from hgn.config import MESH_SUFFIXES, is_mesh_file
from hgn.scene.rotation import euler_rotation, rotate, round_to_float32
from hgn.scene.scene import Obstacle
from hgn.scene.surface import area_vectors
from hgn.schema import ConfigError, Vector, require
from hgn.system.claims import Claims

_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}  # of a GLB's accessors
_NODES = 10_000  # that a GLB may have, and primitives: trimesh takes 0.3 ms for each


class _Beside(trimesh.resolvers.FilePathResolver):
    """Resolves references of a mesh file, only to plain files in its own folder or below."""

    def get(self, name: str) -> bytes:
        path = (Path(self.parent) / name).resolve()
        if not (path.is_file() and path.is_relative_to(Path(self.parent).resolve())):
            raise FileNotFoundError(f"it names {name!r}, which is no file in its folder")
        return path.read_bytes()


def load_mesh(
    path: str | Path,
    field: str = "mesh",
    *,
    scale: float = 1.0,
    translation: Vector = (0.0, 0.0, 0.0),
    rotation: Vector = (0.0, 0.0, 0.0),
) -> Obstacle:
    """Reads a mesh file: scaled, then turned about the fixed x, y and z axes (degrees, in this order), then moved.

    All parts of a file become one obstacle. Corners with equal float32 coordinates are merged, zero-area and repeated
    triangles dropped. A watertight mesh (two triangles at every edge, orientable) becomes a solid with consistent
    orientation; every other mesh is a sheet. It may reach outside the domain.

    Raises: ConfigError naming `field` for a missing or unreadable file, an unknown suffix, no triangles,
    non-finite coordinates, only zero-area triangles, or a bad scale, translation or rotation.
    """
    path = Path(path)
    require(0 < scale < np.inf, f"{field}: scale", "a finite number > 0", scale)
    for name, value in (("translation", translation), ("rotation", rotation)):
        require(bool(np.isfinite(value).all()), f"{field}: {name}", "three finite numbers", value)
    vertex_V3, triangle_F3 = _read(path, field)
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
    vertex_V3, triangle_F3 = _weld(round_to_float32(placed), triangle_F3)
    if len(triangle_F3) == 0:
        raise ConfigError(
            f"{field} must have a triangle with an area, got only zero-area triangles in {path}; "
            "raise scale or mend the mesh"
        )
    flip_F = _orientation(triangle_F3)
    if flip_F is not None:
        triangle_F3[flip_F] = triangle_F3[flip_F][:, ::-1]
    return Obstacle(path.stem, vertex_V3, triangle_F3, closed=flip_F is not None)


def _read(path: Path, field: str) -> tuple[np.ndarray, np.ndarray]:
    if not is_mesh_file(path):
        raise ConfigError(f"{field} must end in one of {', '.join(MESH_SUFFIXES)}, got {path}; convert the mesh")
    if not path.is_file():
        raise ConfigError(f"{field} must be an existing file, got {path}; in a scene file paths are relative to it")
    try:
        # else trimesh would silently remove non-finite vertices
        if path.suffix.lower() == ".glb":
            _require_small_glb(path)
        beside = _Beside(str(path))
        mesh = trimesh.load_scene(path, process=False, skip_materials=True, resolver=beside).to_mesh()
        vertex = np.array(mesh.vertices, np.float64).reshape(-1, 3)
        triangle = np.array(mesh.faces, np.int64).reshape(-1, 3)
    except ConfigError:
        raise
    except Exception as error:  # of any kind: trimesh reads damaged files too
        raise ConfigError(
            f"{field} must be a readable {path.suffix[1:].upper()} file, got {path} ({error}); export the mesh again"
        ) from error
    if len(triangle) == 0:
        raise ConfigError(f"{field} must contain triangles, got none in {path}; export the surface, not points")
    if triangle.min() < 0 or triangle.max() >= len(vertex):
        raise ConfigError(
            f"{field} must have triangles of its {len(vertex)} vertices, got vertices {triangle.min()} to "
            f"{triangle.max()} in {path}; export the mesh again"
        )
    return vertex, triangle


def _require_small_glb(path: Path) -> None:
    """Raises: ConfigError where the vertices and triangles that a GLB's nodes claim cannot be in the file; any other
    exception for a file that is no GLB.
    """
    with path.open("rb") as file:
        length, kind = struct.unpack("<12xI4s", file.read(20))
        if kind != b"JSON" or length > path.stat().st_size:
            raise ValueError("no JSON at its beginning")
        header: dict[str, Any] = json.loads(file.read(length))
    parts = [primitive for mesh in header.get("meshes", ()) for primitive in mesh["primitives"]]
    nodes = header.get("nodes", ())
    children = [child for node in nodes for child in node.get("children", ())]
    require(len(set(children)) == len(children), "mesh", "of nodes with one parent each", str(path))
    require(max(len(nodes), len(parts)) <= _NODES, "mesh", f"of at most {_NODES} nodes and primitives", str(path))
    claims, sizes = Claims(path), []
    for number, accessor in enumerate(header.get("accessors", ())):
        require(
            type(accessor["count"]) is int, f"{path}: accessors[{number}].count", "a whole number", accessor["count"]
        )
        sizes.append(8 * _COMPONENTS[accessor["type"]] * accessor["count"])  # bytes in float64
        claims.add(f"accessors[{number}]", sizes[-1])
    of_meshes = [
        sum(
            sizes[place]
            for part in mesh["primitives"]
            for place in (*part["attributes"].values(), part.get("indices", 0))
        )
        for mesh in header.get("meshes", ())
    ]
    for number, node in enumerate(nodes):
        claims.add(f"nodes[{number}]", of_meshes[node["mesh"]] if "mesh" in node else 0)


def _weld(vertex_V3: np.ndarray, triangle_F3: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merges equal vertices; drops zero-area and repeated triangles and unused vertices."""
    unique, index = np.unique(vertex_V3 + 0.0, axis=0, return_inverse=True)  # + 0.0 turns -0 to 0
    triangle = index.reshape(-1)[triangle_F3]
    triangle = triangle[(area_vectors(unique[triangle]) != 0).any(axis=1)]
    _, first = np.unique(np.sort(triangle, axis=1), axis=0, return_index=True)
    triangle = triangle[np.sort(first)]
    used, compact = np.unique(triangle, return_inverse=True)
    return unique[used], compact.reshape(-1, 3).astype(np.int32)


def _orientation(triangle_F3: np.ndarray) -> np.ndarray | None:
    """Returns the triangles to flip, bool [F], so that neighbours agree; None for a mesh that is not watertight.

    Each part keeps the orientation of most of its triangles. Two copies of every triangle, one per orientation, are
    connected to the copies of the neighbours that agree with them: an orientable part has two components, a one-sided
    part has one.
    """
    count = len(triangle_F3)
    start_E, end_E = triangle_F3.T.reshape(-1), np.roll(triangle_F3, -1, axis=1).T.reshape(-1)
    low_E, high_E = np.minimum(start_E, end_E).astype(np.int64), np.maximum(start_E, end_E)
    order = np.argsort(low_E * (int(triangle_F3.max()) + 1) + high_E, kind="stable")
    if len(order) % 2:
        return None
    one, two = order[0::2], order[1::2]
    if ((low_E[one] != low_E[two]) | (high_E[one] != high_E[two])).any():
        return None
    if ((low_E[one[1:]] == low_E[one[:-1]]) & (high_E[one[1:]] == high_E[one[:-1]])).any():
        return None  # four or more triangles at one edge
    disagree = start_E[one] == start_E[two]
    face_one, face_two = one % count, two % count
    row = np.concatenate([face_one, face_one + count])
    column = np.concatenate([face_two + np.where(disagree, count, 0), face_two + np.where(disagree, 0, count)])
    graph = coo_matrix((np.ones(len(row), np.int8), (row, column)), shape=(2 * count, 2 * count))
    parts, label = connected_components(graph, directed=False)
    upright, flipped = label[:count], label[count:]
    if (upright == flipped).any():
        return None
    # a component and its mirror image hold the same triangles; the one with more unflipped ones wins
    votes = np.bincount(upright, minlength=parts)
    kept_wins = (votes[upright] > votes[flipped]) | ((votes[upright] == votes[flipped]) & (upright < flipped))
    return ~kept_wins
