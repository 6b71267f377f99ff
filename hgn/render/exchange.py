"""Writes rollouts for other programs: USD for Blender, Houdini and Omniverse, PLY sequences for any tool.

Both formats contain particles by material with velocities, and the obstacles as meshes. On request they also contain
water as a closed surface. USD and surfaces need the extra `files` (usd-core, pysplashsurf).
Shape legend: T frames, N particles, V vertices, F triangles.
"""

import errno
import itertools
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hgn.config import USD_ENDINGS
from hgn.render import PLY_ENDING
from hgn.render.pictures import rollout_spacing
from hgn.render.renderer import MATERIAL_COLORS, OBSTACLE_COLOR, PARTICLE_COLORS
from hgn.scene.material import FLUIDS
from hgn.scene.rollout_file import (
    Rollout,
    frame_velocity,
    rollout_bytes,
    write_frames,
    write_rollout,
)
from hgn.scene.scene import Obstacle
from hgn.scene.simulated_frames import Simulation, simulated
from hgn.schema import ConfigError, require_replaceable
from hgn.system.extras import require_installed
from hgn.system.files import WRITTEN_BY_HGN, space_reserved, sync_folder, sync_written

# Parameters of the surface, the lengths in particle radii (half the spacing). With them the volume of a block of 8
# particles per cell is correct within 4 %, for a lattice and for a random filling.
SMOOTHING_LENGTH, CUBE_SIZE, THRESHOLD = 3.0, 1.0, 0.6


def save_rollout(
    path: str | Path, rollout: Rollout, surface: bool = False, progress: Callable[[], Any] = lambda: None
) -> Path:
    """Writes `rollout` in the format of the name's suffix, and returns the (first) file.

    `.usdc`, `.usda`, `.usd`: one USD stage. `.ply`: NAME_0000.ply, NAME_0001.ply, …, NAME_obstacle_0.ply, …, and
    NAME_obstacle_0_0000.ply, … for an obstacle that moves. Any other suffix: VTKHDF. With `surface` USD and PLY also
    contain the water's surface. `progress` is called once per frame.
    Raises ConfigError for a surface in VTKHDF, and ModuleNotFoundError without the extra `files`.
    """
    path = Path(path)
    require_exchange(path, surface)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix not in (*USD_ENDINGS, PLY_ENDING):
        write_rollout(path, rollout)
        return path
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        partial = Path(folder) / path.name
        if path.suffix == PLY_ENDING:
            _write_ply(partial, rollout, surface, progress)
        else:
            from pxr import Tf

            try:
                _write_usd(partial, rollout, surface, progress)
            except Tf.ErrorException as error:  # of many lines, without the number of the system's error
                code = errno.ENOSPC if shutil.disk_usage(folder).free < 1 << 20 else errno.EIO
                raise OSError(code, os.strerror(code), str(path)) from error
        for file in Path(folder).iterdir():
            sync_written(file)
        written = [file.replace(path.parent / file.name) for file in sorted(Path(folder).iterdir())]
    sync_folder(path.parent)
    return written[0]


def save_frames(path: Path, rollout: Rollout, simulate: Simulation, surface: bool = False) -> Path:
    """Writes frames as they are simulated, and stores them in `rollout.position_TN3`. Formats: see `save_rollout`.

    USD and PLY are written after the last frame; after Ctrl-C they contain the frames so far. If a signal or an error
    ends this writing, the frames are in a new VTKHDF file.
    """
    if path.suffix not in (*USD_ENDINGS, PLY_ENDING):
        write_frames(path, rollout, simulate)
        return path
    with simulated(rollout.position_TN3) as frames:
        with space_reserved(path, rollout_bytes(rollout.frame_count, rollout.particle_count)):
            frames.take(simulate)
        shown = replace(rollout, position_TN3=rollout.position_TN3[: frames.count])
        try:
            frames.place = save_rollout(path, shown, surface, frames.end_if_interrupted)
        except BaseException:
            others = (path.with_name(f"{path.name}{number or ''}.vtkhdf") for number in itertools.count())
            unused = next(other for other in others if not other.exists())
            write_rollout(unused, shown)
            frames.place = unused
            raise
    return frames.place


def require_exchange(path: Path, surface: bool) -> None:
    """Raises the errors of a later `save_rollout`; call it before a simulation."""
    numbered = path.parent.glob(f"{path.stem}_*[0-9].ply") if path.suffix == PLY_ENDING else ()
    require_replaceable("out", path, *numbered)
    if path.suffix in USD_ENDINGS:
        require_installed("pxr")
    if surface:
        if path.suffix not in (*USD_ENDINGS, PLY_ENDING):
            raise ConfigError(f"surface must be false unless out ends in .usdc, .usda, .usd or .ply, got out={path}")
        require_installed("pysplashsurf")


def fluid_surface(position_N3: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the closed surface around a fluid's particles with this spacing: float64 [V, 3], int32 [F, 3].

    splashsurf computes it by marching cubes on the density field of SPH. Without particles the surface is empty.
    """
    if not len(position_N3):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    import pysplashsurf

    surface, _ = pysplashsurf.reconstruction_pipeline(
        position_N3.astype(np.float64),
        particle_radius=spacing / 2,
        smoothing_length=SMOOTHING_LENGTH,
        cube_size=CUBE_SIZE,
        iso_surface_threshold=THRESHOLD,
    )
    mesh = surface.mesh
    assert isinstance(mesh, pysplashsurf.TriMesh3d)
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int32)


def _surfaces(rollout: Rollout) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields the surface of each frame. Omits particles that are not finite or farther than ten domains away."""
    largest = max(rollout.domain_size)
    fluid_N = np.isin(rollout.material_N, FLUIDS)
    spacing = max(rollout_spacing(rollout, fluid_N), 1e-4 * largest)  # splashsurf refuses more than 2^63 cells
    for frame, position_N3 in enumerate(rollout.position_TN3):
        present = rollout.present(frame)
        water_N3 = position_N3[:present][fluid_N[:present]]
        yield fluid_surface(water_N3[(np.abs(water_N3) < 10 * largest).all(axis=1)], spacing)


def _write_usd(path: Path, rollout: Rollout, surface: bool, progress: Callable[[], Any]) -> None:
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(rollout.frame_rate_hz)
    stage.SetFramesPerSecond(rollout.frame_rate_hz)
    stage.SetMetadata("comment", WRITTEN_BY_HGN)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(rollout.frame_count - 1)
    world = UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    for name in ("obstacles", "particles"):  # in Blender, prims without a type would lose the up axis
        UsdGeom.Xform.Define(stage, f"/World/{name}")
    world.GetPrim().SetCustomDataByKey("gravity", Gf.Vec3d(*rollout.gravity))

    def colour(shape: Any, rgb_3: np.ndarray) -> None:
        shape.CreateDisplayColorAttr(Vt.Vec3fArray([Gf.Vec3f(*map(float, rgb_3))]))

    def mesh(name: str, rgb_3: np.ndarray) -> Any:
        prim = UsdGeom.Mesh.Define(stage, f"/World/{name}")
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        prim.CreateDoubleSidedAttr(True)
        colour(prim, rgb_3)
        return prim

    def fill(prim: Any, vertex_V3: np.ndarray, triangle_F3: np.ndarray, time: Any) -> None:
        points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(vertex_V3, np.float32))
        prim.GetPointsAttr().Set(points, time)
        prim.GetFaceVertexCountsAttr().Set(Vt.IntArray(len(triangle_F3), 3), time)
        prim.GetFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(triangle_F3.reshape(-1).astype(np.int32)), time)
        prim.GetExtentAttr().Set(UsdGeom.PointBased.ComputeExtent(points), time)

    moving = []
    for name, obstacle in zip(_identifiers(rollout.obstacles), rollout.obstacles, strict=True):
        prim = mesh(f"obstacles/{name}", OBSTACLE_COLOR)
        fill(prim, obstacle.vertex_V3, obstacle.triangle_F3, Usd.TimeCode.Default())
        if obstacle.motion is not None:
            moving.append((prim.AddTransformOp(), obstacle.motion))
    velocity_TN3 = frame_velocity(rollout.position_TN3, rollout.frame_rate_hz, rollout.entry_frame_N)
    width = rollout_spacing(rollout)
    of_material = {}
    for index, name in enumerate(rollout.materials):
        mine_N = np.flatnonzero(rollout.material_N == index)
        if len(mine_N):
            prim = UsdGeom.Points.Define(stage, f"/World/particles/{name}")
            prim.CreateIdsAttr(Vt.Int64Array.FromNumpy(mine_N.astype(np.int64)))
            prim.CreateWidthsAttr(Vt.FloatArray([width]))
            prim.SetWidthsInterpolation(UsdGeom.Tokens.constant)
            prim.GetPrim().CreateAttribute("primvars:material", Sdf.ValueTypeNames.String).Set(name)
            colour(prim, PARTICLE_COLORS[index])
            of_material[prim] = mine_N
    water = mesh("surface", MATERIAL_COLORS[FLUIDS[0]]) if surface else None
    surfaces = _surfaces(rollout) if surface else iter(())
    for frame, (position_N3, velocity_N3) in enumerate(zip(rollout.position_TN3, velocity_TN3, strict=True)):
        for prim, all_N in of_material.items():
            mine_N = all_N[: np.searchsorted(all_N, rollout.present(frame))]
            if rollout.entry_frame_N is not None:
                prim.GetIdsAttr().Set(Vt.Int64Array.FromNumpy(mine_N.astype(np.int64)), frame)
            points = Vt.Vec3fArray.FromNumpy(position_N3[mine_N])
            prim.GetPointsAttr().Set(points, frame)
            prim.GetVelocitiesAttr().Set(Vt.Vec3fArray.FromNumpy(velocity_N3[mine_N]), frame)
            prim.GetExtentAttr().Set(UsdGeom.PointBased.ComputeExtent(points), frame)
        if water is not None:
            fill(water, *next(surfaces), frame)
        for transform, motion in moving:
            rotation_33, origin_3 = motion.transform(frame / rollout.frame_rate_hz)
            rows = [[*row, 0.0] for row in rotation_33.T.tolist()]  # USD multiplies row vectors, as (x, 1) M
            transform.Set(Gf.Matrix4d([*rows, [*origin_3.tolist(), 1.0]]), frame)
        progress()
    stage.GetRootLayer().Save()


def _identifiers(obstacles: Sequence[Obstacle]) -> list[str]:
    """Returns unique names of prims. Further copies of one mesh file have their number as a suffix."""
    from pxr import Tf

    names: list[str] = []
    for index, obstacle in enumerate(obstacles):
        name = str(Tf.MakeValidIdentifier(obstacle.name))
        while name in names:
            name = f"{name}_{index}"
        names.append(name)
    return names


def _write_ply(path: Path, rollout: Rollout, surface: bool, progress: Callable[[], Any]) -> None:
    velocity_TN3 = frame_velocity(rollout.position_TN3, rollout.frame_rate_hz, rollout.entry_frame_N)
    fields = [(name, "<f4") for name in ("x", "y", "z", "vx", "vy", "vz")]
    fields += [(name, "u1") for name in ("material", "red", "green", "blue")]
    row_N = np.zeros(rollout.particle_count, fields)
    row_N["material"] = rollout.material_N
    for name, value_N in zip(("red", "green", "blue"), 255 * PARTICLE_COLORS[rollout.material_N].T, strict=True):
        row_N[name] = value_N
    kinds = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"comment {WRITTEN_BY_HGN}"]
    header += [f"comment material: {', '.join(rollout.materials)}"]
    properties = [f"property {kinds[kind]} {name}" for name, kind in fields]
    surfaces = _surfaces(rollout) if surface else iter(())
    digits = max(4, len(str(rollout.frame_count - 1)))
    for frame, (position_N3, velocity_N3) in enumerate(zip(rollout.position_TN3, velocity_TN3, strict=True)):
        for name, value_N in zip("xyz", position_N3.T, strict=True):
            row_N[name] = value_N
        for name, value_N in zip(("vx", "vy", "vz"), velocity_N3.T, strict=True):
            row_N[name] = value_N
        target = path.with_stem(f"{path.stem}_{frame:0{digits}d}")
        present = rollout.present(frame)
        head = (*header, f"element vertex {present}", *properties, "end_header", "")
        target.write_bytes("\n".join(head).encode() + row_N[:present].tobytes())
        if surface:
            _export(path.with_stem(f"{path.stem}_surface_{frame:0{digits}d}"), *next(surfaces))
        progress()
    for index, obstacle in enumerate(rollout.obstacles):
        if obstacle.motion is None:
            _export(path.with_stem(f"{path.stem}_obstacle_{index}"), obstacle.vertex_V3, obstacle.triangle_F3)
            continue
        for frame in range(rollout.frame_count):
            target = path.with_stem(f"{path.stem}_obstacle_{index}_{frame:0{digits}d}")
            _export(target, obstacle.at(frame / rollout.frame_rate_hz).vertex_V3, obstacle.triangle_F3)


def _export(path: Path, vertex_V3: np.ndarray, triangle_F3: np.ndarray) -> None:
    import trimesh

    content = trimesh.exchange.ply.export_ply(trimesh.Trimesh(vertex_V3, triangle_F3, process=False))
    path.write_bytes(content.replace(b"end_header", f"comment {WRITTEN_BY_HGN}\nend_header".encode(), 1))
