"""Rollouts as USD and PLY, read back by USD's own library and trimesh."""

import importlib.util
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from pxr import Usd, UsdGeom

from hgn.render.exchange import fluid_surface, save_rollout
from hgn.render.pictures import particle_spacing
from hgn.rollout import main as rollout_main
from hgn.scene.material import MATERIALS
from hgn.scene.motion import Motion
from hgn.scene.rollout_file import Rollout, frame_velocity
from hgn.scene.rotation import euler_rotation
from hgn.scene.scene import Obstacle
from hgn.schema import ConfigError

SPACING = 1 / 128


def block(random, side=12):
    """A cube of water, 8 particles in a cell of 1/64, float64 [N, 3]."""
    if random:
        return 0.3 + np.random.default_rng(0).random((side**3, 3)) * side * SPACING
    return 0.3 + (np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5) * SPACING


@pytest.fixture(scope="module")
def rollout():
    """Water and sand by turns, moving; a box and a sheet; names that USD does not allow."""
    start_N3 = block(random=False, side=6).astype(np.float32)
    motion_T13 = np.arange(3, dtype=np.float32)[:, None, None] * np.float32((0.01, -0.002, 0.0))
    box = trimesh.creation.box((0.3, 0.1, 0.2))
    obstacles = tuple(
        Obstacle(name, box.vertices + shift, box.faces[:count].astype(np.int32), closed)
        for name, shift, count, closed in (("my box-1", 0.5, 12, True), ("2 sheets", 0.2, 4, False))
    )
    material_N = np.arange(len(start_N3), dtype=np.uint8) % 2
    return Rollout(start_N3 + motion_T13, material_N, obstacles, (1.0, 1.0, 1.0), 60.0)


@pytest.mark.parametrize("ending", ["usda", "usdc", "ply"])
def test_a_disk_that_fails(tmp_path, rollout, file_limit, ending):
    """The error is the system's, with the file that was to be written, and no part of it is left."""
    file_limit(1000)
    with pytest.raises(OSError, match=r"Input/output error: .*scene\.usd|File too large") as fault:
        save_rollout(tmp_path / f"scene.{ending}", rollout)
    assert "\n" not in str(fault.value) and not list(tmp_path.iterdir())


def meshes_of(stage):
    return [UsdGeom.Mesh(prim) for prim in stage.GetPrimAtPath("/World/obstacles").GetChildren()]


def test_usd_is_read_back(tmp_path, rollout):
    """Every position, velocity, index and triangle; seconds by the frame rate; nothing else is left in the folder."""
    path = save_rollout(tmp_path / "a" / "scene.usdc", rollout, surface=True)
    assert [file.name for file in path.parent.iterdir()] == ["scene.usdc"]
    stage = Usd.Stage.Open(str(path))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 2, 60)
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert all(prim.GetTypeName() for prim in stage.Traverse())  # Blender loses the up axis below one without a type
    velocity_TN3 = frame_velocity(rollout.position_TN3, 60.0)
    for index, name in enumerate(MATERIALS[:2]):
        points = UsdGeom.Points(stage.GetPrimAtPath(f"/World/particles/{name}"))
        mine_N = np.array(points.GetIdsAttr().Get())
        np.testing.assert_array_equal(mine_N, np.flatnonzero(rollout.material_N == index))
        assert list(points.GetWidthsAttr().Get()) == pytest.approx([SPACING])
        for frame in range(3):
            np.testing.assert_array_equal(points.GetPointsAttr().Get(frame), rollout.position_TN3[frame, mine_N])
            np.testing.assert_array_equal(points.GetVelocitiesAttr().Get(frame), velocity_TN3[frame, mine_N])
    assert not stage.GetPrimAtPath("/World/particles/snow")
    for mesh, obstacle in zip(meshes_of(stage), rollout.obstacles, strict=True):
        np.testing.assert_allclose(mesh.GetPointsAttr().Get(), obstacle.vertex_V3, rtol=1e-6)
        indices = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        np.testing.assert_array_equal(indices, obstacle.triangle_F3)
    surface = UsdGeom.Mesh(stage.GetPrimAtPath("/World/surface"))
    first, last = (np.array(surface.GetPointsAttr().Get(frame)) for frame in (0, 2))
    np.testing.assert_allclose(last.mean(0) - first.mean(0), (0.02, -0.004, 0), atol=SPACING / 2)


def test_obstacles_of_one_name_stay_apart(tmp_path, rollout):
    """A mesh placed twice, also at one place, and names that USD writes alike, are a prim each."""
    names = {"ramp": 0.0, "ramp ": 0.25, "a b": 2, "a-b": 3, "a_b": 4, "a_b ": 0.0}
    box, _ = rollout.obstacles
    shapes = tuple(replace(box, name=name.strip(), vertex_V3=box.vertex_V3 + shift) for name, shift in names.items())
    stage = Usd.Stage.Open(str(save_rollout(tmp_path / "a.usda", replace(rollout, obstacles=shapes))))
    for mesh, obstacle in zip(meshes_of(stage), shapes, strict=True):
        np.testing.assert_allclose(mesh.GetPointsAttr().Get(), obstacle.vertex_V3, rtol=1e-6)


def test_what_enters_and_what_moves(tmp_path, rollout):
    """USD and PLY hold the particles that are there, and obstacles at each frame where their motion has them."""
    position_TN3 = rollout.position_TN3.copy()
    position_TN3[0, -7:] = np.nan
    entry_N = np.repeat([0, 1], [len(rollout.material_N) - 7, 7])
    turns = np.stack([np.eye(3), euler_rotation((0.0, 60.0, 30.0))])
    motion = Motion(np.array([0.0, 2 / 60]), np.array([(0.0, 0.0, 0.0), (0.1, 0.2, 0.3)]), turns, (0.5, 0.4, 0.3))
    box, sheet = rollout.obstacles
    moving = replace(
        rollout, position_TN3=position_TN3, entry_frame_N=entry_N, obstacles=(replace(box, motion=motion), sheet)
    )
    stage = Usd.Stage.Open(str(save_rollout(tmp_path / "a.usdc", moving, surface=True)))
    save_rollout(tmp_path / "a.ply", moving, surface=True)
    for frame in range(3):
        found = [UsdGeom.Points(stage.GetPrimAtPath(f"/World/particles/{name}")) for name in MATERIALS[:2]]
        for points, index in zip(found, (0, 1), strict=True):
            there_N = np.flatnonzero((rollout.material_N == index) & np.isfinite(position_TN3[frame, :, 0]))
            np.testing.assert_array_equal(points.GetIdsAttr().Get(frame), there_N)
            np.testing.assert_array_equal(points.GetPointsAttr().Get(frame), position_TN3[frame, there_N])
            assert np.isfinite(np.array(points.GetVelocitiesAttr().Get(frame))).all()
        cloud = trimesh.load(tmp_path / f"a_000{frame}.ply")
        assert len(cloud.vertices) == np.isfinite(position_TN3[frame, :, 0]).sum()
        expected_V3 = motion.place(box.vertex_V3, frame / 60)
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/obstacles/my_box_1"))
        to_world = np.array(UsdGeom.XformCache(frame).GetLocalToWorldTransform(mesh.GetPrim()))
        corner_V3 = np.array(mesh.GetPointsAttr().Get()) @ to_world[:3, :3] + to_world[3, :3]
        np.testing.assert_allclose(corner_V3, expected_V3, atol=1e-6)
        ply = trimesh.load(tmp_path / f"a_obstacle_0_000{frame}.ply", process=False)
        np.testing.assert_allclose(ply.vertices, expected_V3, atol=1e-6)


def test_ply_is_read_back(tmp_path, rollout):
    """A file a frame with places, velocities and materials; the obstacles once; the water's surface a frame."""
    first = save_rollout(tmp_path / "scene.ply", rollout, surface=True)
    assert first == tmp_path / "scene_0000.ply"
    parts = ("obstacle_0", "obstacle_1", *(f"{kind}000{i}" for kind in ("", "surface_") for i in range(3)))
    names = {f"scene_{part}.ply" for part in parts}
    assert {file.name for file in tmp_path.iterdir()} == names
    cloud = trimesh.load(tmp_path / "scene_0002.ply")
    np.testing.assert_array_equal(cloud.vertices.astype(np.float32), rollout.position_TN3[2])
    data = cloud.metadata["_ply_raw"]["vertex"]["data"]
    velocity_N3 = np.stack([data[name] for name in ("vx", "vy", "vz")], -1)
    np.testing.assert_array_equal(velocity_N3, frame_velocity(rollout.position_TN3, 60.0)[2])
    np.testing.assert_array_equal(data["material"], rollout.material_N)
    assert len(trimesh.load(tmp_path / "scene_obstacle_1.ply", process=False).faces) == 4
    assert trimesh.load(tmp_path / "scene_surface_0001.ply").is_watertight


@pytest.mark.parametrize("random", [False, True])
def test_the_surface_encloses_the_water(random):
    """Closed, and of the particles' volume within 5 %, for a lattice and a random filling; empty without any."""
    position_N3 = block(random)
    mesh = trimesh.Trimesh(*fluid_surface(position_N3, particle_spacing(position_N3)), process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(len(position_N3) * SPACING**3, rel=0.05)
    assert [array.shape for array in fluid_surface(np.zeros((0, 3)), SPACING)] == [(0, 3), (0, 3)]


@pytest.mark.parametrize("ending", ["usdc", "ply"])
def test_surfaces_of_diverged_rollouts(tmp_path, rollout, ending):
    """Water that is not finite or far away, as all of it in the last frame, has no surface; water at one place has."""
    position_TN3 = rollout.position_TN3.copy()
    position_TN3[0, 0], position_TN3[1, 0], position_TN3[2] = np.nan, 500.0, np.nan
    position_TN3[:2, 2:] = 0.5
    save_rollout(tmp_path / f"a.{ending}", replace(rollout, position_TN3=position_TN3), surface=True)
    if ending == "usdc":
        stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
        surface = UsdGeom.Mesh(stage.GetPrimAtPath("/World/surface"))
        sizes = [np.abs(surface.GetPointsAttr().Get(frame)).max(initial=0) for frame in range(3)]
        assert 0.4 < sizes[0] < 0.6 and 0.4 < sizes[1] < 0.6 and sizes[2] == 0


def test_what_cannot_be_written_is_said_before_the_simulation(monkeypatch):
    """A surface in VTKHDF; USD without its library."""
    with pytest.raises(ConfigError, match="surface must be false unless out ends in"):
        rollout_main({"surface": True, "weights": "no such weights"})
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "pxr" else find_spec(name))
    with pytest.raises(ModuleNotFoundError, match="pxr"):
        rollout_main({"out": "scene.usdc", "weights": "no such weights"})
