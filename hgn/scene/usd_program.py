"""Reads a USD file in a process of its own, which hgn.scene.usd starts, because pxr trusts the sizes in a file.

`usd_program.py meshes FILE BYTES` or `particles FILE BYTES MATERIAL` writes arrays as npz to the standard output. It
ends with code 3 and one line about unsupported content. It needs only NumPy and pxr.
Shape legend: V vertices, K polygons, I corners of polygons, N particles.
"""

import io
import resource
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from pxr import Sdf, Usd, UsdGeom

SECONDS = 5  # of CPU for a small file; a few references of references can stand for billions of prims
ROOM = 512 << 20  # bytes for pxr's own tables
COPIES = 12  # of its arrays, in this program and in the search for closed bodies
FIRST = Usd.TimeCode.EarliestTime()  # first sample, or the value without samples
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # (x, y, z) @ Z_UP = (x, z, -y)
NO_SURFACE = ("Points", "Camera")
VECTORS, INTEGERS = np.zeros((0, 3)), np.zeros(0, np.int64)
NUMBERS = {"f": "iuf", "i": "iu"}  # kinds of a file's numbers, by the kind that they are converted to


def refuse(text: str) -> NoReturn:
    print(text, file=sys.stderr)
    sys.exit(3)


def opened(file: str) -> Usd.Stage:
    """Returns the stage of a file that refers to no other files."""
    layer, others = Sdf.Layer.FindOrOpen(file), list[str]()

    def find_clips(path: Any) -> None:
        spec = layer.GetPrimAtPath(path) if path.IsPrimPath() or path.IsPrimVariantSelectionPath() else None
        if spec is not None and spec.HasInfo("clips"):
            others.append(f"clips of {path}")

    others += filter(None, layer.GetCompositionAssetDependencies())  # empty: a reference within the file
    layer.Traverse(Sdf.Path.absoluteRootPath, find_clips)
    if others:
        refuse(f"refers to {others[0]!r}, and other files are not read; write one file (usdcat --flatten)")
    return Usd.Stage.Open(layer)


def placed(stage: Usd.Stage) -> Iterator[tuple[Any, np.ndarray]]:
    """Yields visible geometry with its matrix to domain units, float64 [4, 4] for row vectors."""
    unit, transforms = UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.XformCache(FIRST)
    if not 0 < unit < np.inf:
        refuse(f"must have metersPerUnit > 0, got {unit}")
    turn = Z_UP if UsdGeom.GetStageUpAxis(stage) == "Z" else np.eye(3)
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        if not (prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.PointInstancer)):
            continue
        shown = UsdGeom.Imageable(prim)
        if shown.ComputeVisibility(FIRST) != "invisible" and shown.ComputePurpose() not in ("guide", "proxy"):
            matrix_44 = np.array(transforms.GetLocalToWorldTransform(prim), np.float64)
            matrix_44[:, :3] = unit * matrix_44[:, :3] @ turn
            yield prim, matrix_44


def array(prim: Any, name: str, empty: np.ndarray, room: list[int]) -> np.ndarray:
    """Returns an attribute's numbers as `empty`, its value if missing, has them. Takes their bytes from `room[0]`."""
    value = prim.GetAttribute(name).Get(FIRST)
    given = empty if value is None else np.asarray(value)
    fits = given.ndim == empty.ndim and given.shape[1:] == empty.shape[1:]
    if not fits or given.dtype.kind not in NUMBERS[empty.dtype.kind]:
        refuse(f"has {name} of type {type(value).__name__} at {prim.GetPath()}; export it again")
    result = given.astype(empty.dtype)
    room[0] -= result.nbytes
    if room[0] < 0:
        refuse("needs more memory than files of its size; export less, or write it without instances")
    return result


def read_meshes(stage: Usd.Stage, room: list[int]) -> dict[str, np.ndarray]:
    """Returns `vertex` [V, 3], `count` [K] corners of each polygon, and `corner` [I]: their vertices."""
    vertices, counts, corners, total = [VECTORS], [INTEGERS], [INTEGERS], 0
    for prim, matrix_44 in placed(stage):
        kind, path = prim.GetTypeName(), prim.GetPath()
        if kind in NO_SURFACE:
            continue
        if kind != "Mesh" or prim.HasRelationship("skel:skeleton"):
            refuse(f"contains {'a skinned mesh' if kind == 'Mesh' else kind} at {path}, which is not read; bake it")
        vertex_V3 = array(prim, "points", VECTORS, room)
        names = ("faceVertexCounts", "faceVertexIndices", "holeIndices")
        count_K, corner_I, hole_H = (array(prim, name, INTEGERS, room) for name in names)
        fits = len(corner_I) == count_K.sum() and count_K.min(initial=3) >= 3
        if not fits or corner_I.min(initial=0) < 0 or corner_I.max(initial=-1) >= len(vertex_V3):
            refuse(f"has polygons at {path} that are not of its {len(vertex_V3)} points; export it again")
        kept_K = ~np.isin(np.arange(len(count_K)), hole_H)
        vertices.append(vertex_V3 @ matrix_44[:3, :3] + matrix_44[3, :3])
        counts.append(count_K[kept_K])
        corners.append(corner_I[np.repeat(kept_K, count_K)] + total)
        total += len(vertex_V3)
    return {"vertex": np.concatenate(vertices), "count": np.concatenate(counts), "corner": np.concatenate(corners)}


def read_particles(stage: Usd.Stage, room: list[int], material: str) -> dict[str, np.ndarray]:
    """Returns `position` and `velocity` [N, 3] of Points without `primvars:material`, or of this one."""
    positions, velocities = [VECTORS], [VECTORS]
    for prim, matrix_44 in placed(stage):
        if prim.GetTypeName() == "PointInstancer":
            refuse(f"contains PointInstancer at {prim.GetPath()}, which is not read; write Points")
        own = prim.GetAttribute("primvars:material").Get() if prim.HasAttribute("primvars:material") else material
        if prim.GetTypeName() != "Points" or own != material:
            continue
        position_N3, given_N3 = (array(prim, name, VECTORS, room) for name in ("points", "velocities"))
        velocity_N3 = given_N3 if prim.GetAttribute("velocities").HasValue() else np.zeros_like(position_N3)
        if velocity_N3.shape != position_N3.shape:
            refuse(f"has {len(velocity_N3)} velocities of {len(position_N3)} points at {prim.GetPath()}")
        positions.append(position_N3 @ matrix_44[:3, :3] + matrix_44[3, :3])
        velocities.append(velocity_N3 @ matrix_44[:3, :3])
    return {"position": np.concatenate(positions), "velocity": np.concatenate(velocities)}


if __name__ == "__main__":
    content, name, most, *rest = sys.argv[1:]
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    for kind, limit in (
        (resource.RLIMIT_AS, pages * resource.getpagesize() + ROOM + int(most)),
        (resource.RLIMIT_CPU, SECONDS + Path(name).stat().st_size // 2**20),
    ):
        given = resource.getrlimit(kind)[1]  # by ulimit, which only root may raise
        least = limit if given == resource.RLIM_INFINITY else min(limit, given)
        resource.setrlimit(kind, (least, least))
    stage = opened(name)
    room = [int(most) // COPIES]
    arrays = read_meshes(stage, room) if content == "meshes" else read_particles(stage, room, *rest)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    sys.stdout.buffer.write(buffer.getvalue())
