"""The rollout file: a roundtrip without loss, the VTKHDF layout, and messages for files that do not fit."""

import dataclasses
import json
import math
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from equality import assert_same
from scene.test_episode import make_episode

from hgn.config import SceneConfig
from hgn.scene import rollout_file
from hgn.scene.episode_obstacles import cell_obstacles, obstacles_of_episode
from hgn.scene.motion import Motion
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.scene.random_scene import generate_scene
from hgn.scene.rollout_file import Rollout, frame_velocity, read_rollout, write_frames, write_rollout
from hgn.scene.rotation import euler_rotation
from hgn.scene.scene import Obstacle
from hgn.schema import ConfigError

FRAMES, PARTICLES = 4, 7


def make_rollout(reference_frames=3):
    generator = np.random.default_rng(0)
    triangle = Obstacle("sheet", generator.random((3, 3)), np.array([[0, 1, 2]], np.int32), closed=False)
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], np.int32)
    tetrahedron = Obstacle("tetrahedron", np.eye(4, 3), faces, closed=True)
    reference = reference_frames and generator.random((reference_frames, PARTICLES, 3), np.float32)
    return Rollout(
        position_TN3=generator.random((FRAMES, PARTICLES, 3), np.float32),
        material_N=np.arange(PARTICLES, dtype=np.uint8) % 3,
        obstacles=(triangle, tetrahedron),
        domain_size=(1.0, 2.0, 0.5),
        frame_rate_hz=60.0,
        gravity=(0.0, -1.5, 0.25),
        cell_size=1 / 32,
        source={"weights": "model.safetensors", "sha256": "ab" * 32, "specification": {"seed": 3}},
        reference_TN3=reference,
    )


def stored(folder, rollout, change=None):
    """What is read of a rollout's file; `change` edits the file before."""
    path = folder / "new" / "rollout.vtkhdf"
    write_rollout(path, rollout)
    if change is not None:
        with h5py.File(path, "a") as file:
            change(file)
    return read_rollout(path)


@pytest.mark.parametrize("reference_frames", [None, 3, 6])
def test_roundtrip(tmp_path, reference_frames):
    """What is read is bit for bit what was written: ground truth of any length, a source above HDF5's limit of 64 KiB
    for attributes, and NaN positions of a diverged rollout."""
    written = dataclasses.replace(make_rollout(reference_frames), source={"specification": ["x" * 100] * 2000})
    assert_same(stored(tmp_path, written), written)
    written.position_TN3[2:] = np.nan
    np.testing.assert_array_equal(stored(tmp_path, written).position_TN3, written.position_TN3)


def attribute(name, value):
    return lambda file: file["hgn"].attrs.__setitem__(name, value)


def array(name, value):
    def change(file):
        del file[name]
        file[name] = value

    return change


def test_files_of_other_programs(tmp_path):
    """A file is read with the names of materials that it brings, more or others than the solver's, and keeps that all
    lies in a plane."""
    for names in (["water", "sand", "snow"], ["water", "sand", "snow", "goop"]):
        assert stored(tmp_path, make_rollout(), attribute("materials", json.dumps(names))).materials == tuple(names)
    flat = dataclasses.replace(make_rollout(), dimensions=2)
    assert stored(tmp_path, flat).dimensions == 2


def test_particles_that_enter(tmp_path):
    """A frame's points are those that are there; what is not yet there is read as NaN, with its frame of entry."""
    entry_N = np.array([0, 0, 0, 1, 1, 3, 9])
    rollout = dataclasses.replace(make_rollout(), obstacles=(), entry_frame_N=entry_N)
    write_rollout(tmp_path / "rollout.h5", rollout)
    read = read_rollout(tmp_path / "rollout.h5")
    np.testing.assert_array_equal(read.entry_frame_N, entry_N)
    shown_TN = entry_N <= np.arange(FRAMES)[:, None]
    np.testing.assert_array_equal(read.position_TN3[shown_TN], rollout.position_TN3[shown_TN])
    assert np.isnan(read.position_TN3[~shown_TN]).all()
    with h5py.File(tmp_path / "rollout.h5") as file:
        vtk = file["VTKHDF"]
        assert vtk["NumberOfPoints"][()].tolist() == vtk["Vertices/NumberOfCells"][()].tolist() == [3, 5, 5, 6]
        assert vtk["Steps/PointOffsets"][()].tolist() == [0, 3, 8, 13]
        assert vtk["Steps/PointDataOffsets/velocity"][()].tolist() == [0, 3, 8, 13]
        expected = (rollout.position_TN3[2] - rollout.position_TN3[1])[3:5] * 60
        for frame in (1, 2):  # none is known of the frame in which a particle enters
            begin = vtk["Steps/PointOffsets"][frame]
            np.testing.assert_allclose(vtk["PointData/velocity"][begin + 3 : begin + 5], expected, rtol=1e-5)


def test_vtkhdf_layout(tmp_path):
    """Datasets have the shapes of a temporal PolyData in VTKHDF: the obstacles' vertices and then the particles in each
    step; topology is stored once."""
    rollout = make_rollout()
    vertices, triangles = 7, 5
    whole = PARTICLES + vertices
    write_rollout(tmp_path / "rollout.h5", rollout)
    with h5py.File(tmp_path / "rollout.h5") as file:
        vtk = file["VTKHDF"]
        assert vtk.attrs["Version"].tolist() == [2, 0] and vtk.attrs["Type"] == b"PolyData"
        assert not h5py.h5a.open(vtk.id, b"Type").get_type().is_variable_str()
        sizes = {"Vertices": (PARTICLES, 1), "Lines": (0, 1), "Polygons": (triangles, 3), "Strips": (0, 1)}
        expected = {f"{name}/NumberOfCells": [cells] * FRAMES for name, (cells, _) in sizes.items()}
        expected |= {f"{name}/NumberOfConnectivityIds": [math.prod(size)] * FRAMES for name, size in sizes.items()}
        expected |= {"NumberOfPoints": [whole] * FRAMES, "Vertices/Connectivity": list(range(vertices, whole))}
        expected |= {"Vertices/Offsets": list(range(PARTICLES + 1)), "Steps/PartOffsets": list(range(FRAMES))}
        expected |= {"Steps/NumberOfParts": [1] * FRAMES, "Steps/CellOffsets": [[0] * 4] * FRAMES}
        expected |= {"CellData/obstacle": [-1] * PARTICLES + [0, 1, 1, 1, 1]}
        assert {name: vtk[name][()].tolist() for name in expected} == expected
        assert all(vtk[name]["Offsets"].shape == (cells + 1,) for name, (cells, _) in sizes.items())
        assert vtk["Points"].shape == (FRAMES * whole, 3)
        assert vtk["Polygons/Connectivity"][:6].tolist() == [0, 1, 2, 3, 4, 5]
        steps = vtk["Steps"]
        assert steps.attrs["NSteps"] == FRAMES and steps["ConnectivityIdOffsets"].shape == (FRAMES, 4)
        np.testing.assert_allclose(steps["Values"], np.arange(FRAMES) / 60)
        for data, offsets, values_TN in (
            ("Points", "PointOffsets", rollout.position_TN3),
            ("PointData/material", "PointDataOffsets/material", [rollout.material_N] * FRAMES),
            ("PointData/velocity", "PointDataOffsets/velocity", frame_velocity(rollout.position_TN3, 60.0)),
        ):
            for start, values_N in zip(steps[offsets][()] + vertices, values_TN, strict=True):
                np.testing.assert_array_equal(vtk[data][start : start + PARTICLES], values_N)


def moving_rollout():
    """A particle less in the first two frames, and an obstacle that turns and moves beside one at rest."""
    rollout = make_rollout(None)
    entry_N = np.zeros(PARTICLES, np.int64)
    entry_N[-1] = 2
    rollout.position_TN3[:2, -1] = np.nan
    quarter = np.stack([np.eye(3), euler_rotation((0.0, 90.0, 0.0))])
    times_T = np.array([0.0, (FRAMES - 1) / 60])
    motion = Motion(times_T, np.array([(0.0, 0.0, 0.0), (0.3, 0.0, 0.0)]), quarter, (0.5, 0.5, 0.5))
    still, other = rollout.obstacles
    moving = dataclasses.replace(other, motion=motion)
    return dataclasses.replace(rollout, entry_frame_N=entry_N, obstacles=(still, moving))


def test_what_enters_and_what_moves(tmp_path):
    """Particles without a position yet come back as such, obstacles with their motion."""
    written = moving_rollout()
    read = stored(tmp_path, written)
    np.testing.assert_array_equal(read.position_TN3, written.position_TN3)
    still, moving = read.obstacles
    assert still.motion is None and moving.motion is not None
    expected = written.obstacles[1].motion
    for time in (0.0, 0.01, 1.0):
        place_V3, expected_V3 = (motion.place(moving.vertex_V3, time) for motion in (moving.motion, expected))
        np.testing.assert_array_equal(place_V3, expected_V3)


def test_vtk_reads_it(tmp_path):
    """VTK's own reader has, at each time, the particles that are there and the obstacles where they then are, with
    material, velocity and the obstacle's number."""
    pytest.importorskip("vtkmodules", reason="vtk is not installed (half a gigabyte): pip install vtk")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOHDF import vtkHDFReader

    rollout = moving_rollout()
    write_rollout(tmp_path / "a.vtkhdf", rollout)
    reader = vtkHDFReader()
    reader.SetFileName(str(tmp_path / "a.vtkhdf"))
    reader.Update()
    assert reader.GetNumberOfSteps() == FRAMES
    velocity_TN3, before_V3 = frame_velocity(rollout.position_TN3, rollout.frame_rate_hz, rollout.entry_frame_N), None
    for frame in range(FRAMES):
        reader.UpdateTimeStep(frame / 60)
        data = reader.GetOutputDataObject(0)
        count = PARTICLES - (frame < 2)
        point_P3 = vtk_to_numpy(data.GetPoints().GetData())
        particle_N = [data.GetVerts().GetConnectivityArray().GetValue(i) for i in range(data.GetNumberOfVerts())]
        np.testing.assert_array_equal(point_P3[particle_N], rollout.position_TN3[frame, :count])
        arrays = (data.GetPointData().GetArray(name) for name in ("material", "velocity"))
        material_P, velocity_P3 = map(vtk_to_numpy, arrays)
        assert material_P.tolist() == [255] * 7 + rollout.material_N[:count].tolist()
        np.testing.assert_array_equal(velocity_P3[particle_N], velocity_TN3[frame, :count])
        assert np.isfinite(velocity_P3).all()
        still, moving = rollout.obstacles
        vertex_V3 = np.concatenate([still.vertex_V3, moving.motion.place(moving.vertex_V3, frame / 60)])
        np.testing.assert_allclose(point_P3[:7], vertex_V3, atol=1e-6)
        if before_V3 is not None:
            np.testing.assert_allclose(velocity_P3[:7], 60 * (vertex_V3 - before_V3), atol=1e-4)
        before_V3 = vertex_V3
        corner_F3 = vtk_to_numpy(data.GetPolys().GetConnectivityArray()).reshape(-1, 3)
        assert corner_F3.tolist() == [[0, 1, 2], *(rollout.obstacles[1].triangle_F3 + 3).tolist()]
        assert vtk_to_numpy(data.GetCellData().GetArray("obstacle")).tolist() == [-1] * count + [0, 1, 1, 1, 1]


def test_velocities():
    """Uniform motion has the same velocity in every frame; a single frame has none. A particle that is seen in the last
    frame alone has none yet; others that enter have that of their second frame."""
    speed = np.array([1.0, -2.0, 0.5], np.float32)
    position_TN3 = (np.arange(5, dtype=np.float32)[:, None, None] / 50) * speed
    np.testing.assert_allclose(frame_velocity(position_TN3, 50.0), np.broadcast_to(speed, (5, 1, 3)), rtol=1e-5)
    assert not frame_velocity(position_TN3[:1], 50.0).any()
    rollout = make_rollout(None)
    position_TN3, entry_N = rollout.position_TN3.copy(), np.array([0] * 5 + [2, 3])
    position_TN3[:2, 5] = position_TN3[:3, 6] = np.nan
    velocity_TN3 = frame_velocity(position_TN3, rollout.frame_rate_hz, entry_N)
    np.testing.assert_array_equal(velocity_TN3[2, 5], velocity_TN3[3, 5])
    assert np.isfinite(velocity_TN3[2:, 5]).all() and not velocity_TN3[3, 6].any()


def test_a_failed_write_leaves_the_old_file(tmp_path):
    """An error while writing keeps the file that was there and leaves no temporary file."""
    path = tmp_path / "rollout.h5"
    write_rollout(path, make_rollout())
    before = path.read_bytes()
    with pytest.raises(TypeError):
        write_rollout(path, dataclasses.replace(make_rollout(), source={"not JSON": object()}))
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["rollout.h5"]


SHEET = "hgn/obstacles/0000"


def turned(rotation_T33, pivot=0.0):
    """Keyframes of the sheet with these rotations."""
    count, attributes = len(rotation_T33), {"pivot": np.full(3, pivot)}
    values = {"time": np.arange(count), "translation": np.zeros((count, 3)), "rotation": rotation_T33}
    return lambda file: (file[SHEET].update(values), file[SHEET].attrs.update(attributes))


def external_points(file):
    """HDF5 can take data from any file that its reader may read."""
    points = file["VTKHDF/Points"]
    shape, dtype, foreign = points.shape, points.dtype, file.filename + ".raw"
    Path(foreign).write_bytes(bytes(10_000))
    del file["VTKHDF/Points"]
    file["VTKHDF"].create_dataset("Points", shape, dtype, external=[(foreign, 0, h5py.h5f.UNLIMITED)])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda file: file["hgn"].attrs.pop("format"), "format None"),
        (attribute("format_version", 99), "format_version must be 2, got 99"),
        (attribute("dimensions", 4), r"dimensions must be 2 or 3, got 4; write it again"),
        (attribute("materials", '["water"]'), r"material_N must be 0 to 0"),
        (attribute("materials", '["A B", "A B"]'), "materials must be names of lower-case"),
        (attribute("materials", '"water"'), "material_N: materials must be a list of names, got 'water'"),
        (array("VTKHDF/Points", np.zeros((5, 3), np.float32)), "4 frames of 7 particles"),
        (lambda file: file.pop("VTKHDF/Points"), r"must be a complete HDF5 file, got .*Points"),
        (attribute("format", np.array([1, 2])), "with format array"),
        (attribute("format_version", "x"), "format_version must be 2, got x"),
        (attribute("domain_size", np.array([np.nan, 1, 1])), r"domain_size\[0\] must be from 1e-9 to 1e9, got nan"),
        (attribute("domain_size", np.array([1.0, 1.0])), "must be a complete HDF5 file, got not enough values"),
        (attribute("gravity", np.array([0, np.inf, 0])), r"gravity\[1\] must be finite, got inf"),
        (attribute("gravity", np.full(3, 1e300)), r"gravity\[0\] must be at most 1e15"),
        *((attribute("dimensions", count), f"dimensions must be 2 or 3, got {count}") for count in (2.5, 2.0)),
        (attribute("cell_size", 0.0), "cell_size must be from 1e-9 to 1e9"),
        (array("hgn/source", '{"a": 1, "a": 2}'), "must be a complete HDF5 file, got the key a is given twice"),
        (array("hgn/source", "3"), "source must be a mapping, got 3"),
        (array("hgn", h5py.SoftLink("/hgn")), "must contain its data itself"),
        (array("VTKHDF/PointData/material", np.full(14, 0.5)), "material_N must be whole numbers, got 'float64'"),
        (array("VTKHDF/PointData/material", np.full(14, -3)), r"material_N must be 0 to 3 \(.*\), got -3"),
        (array(f"{SHEET}/triangles", np.array([[0, 1, 99]])), "triangles must be of 3 vertices, got vertices 0 to 99"),
        (array(f"{SHEET}/triangles", np.array([0, 1, 2])), r"triangles must be numbers \[any, 3\]"),
        (array(f"{SHEET}/vertices", np.zeros((3, 2))), r"vertices must be numbers \[any, 3\]"),
        (array(f"{SHEET}/vertices", np.full((3, 3), np.nan)), "vertices must be finite"),
        (array(f"{SHEET}/vertices", np.full((3, 3), 1e300)), "vertices must be finite and at most 1e15"),
        *((array(f"VTKHDF/{n}", np.full((4, 3), b"1")), f"VTKHDF/{n} must be") for n in ("Points", "NumberOfPoints")),
        (array("hgn/reference", np.full((3, 7, 3), b"1")), r"hgn/reference must be of kind f, got '\|S1'"),
        (lambda file: file.__setitem__("hgn/entry_frame", np.zeros(7)), "hgn/entry_frame must be of kind iu, got 'fl"),
        *((attribute("frame_rate_hz", rate), "frame_rate_hz must be from 1e-9 to 1e9") for rate in (1e300, 5e-324)),
        (attribute("domain_size", np.full(3, 1e15)), r"domain_size\[0\] must be from 1e-9 to 1e9, got 1"),
        (attribute("gravity", np.full(3, 1j)), "must be a complete HDF5 file, got .*complex"),
        *(
            (turned(x * np.ones((1, 3, 3))), "rotation must be rotation matrices")
            for x in (0, np.nan, 1e300, -np.eye(3))
        ),
        *((turned(np.eye(3)[None], value), "pivot must be finite and at") for value in (np.nan, 1e300)),
        (external_points, "must be stored in the file itself"),
        (lambda file: file.__setitem__("VTKHDF/other", h5py.ExternalLink("/", "/")), "got a link in other"),
    ],
)
def test_other_files_are_refused(tmp_path, change, message):
    """Missing files, files of other programs and versions, damaged ones, those with data of other files, and values
    that cannot be drawn are told apart in the message."""
    with pytest.raises(ConfigError, match=message):
        stored(tmp_path, make_rollout(), change)
    (tmp_path / "text.vtkhdf").write_text("not a rollout")
    for name, told in (("none", r"existing file, got .*none\.vtkhdf.*hgn\.rollout"), ("text", "complete HDF5 file")):
        with pytest.raises(ConfigError, match=told):
            read_rollout(tmp_path / f"{name}.vtkhdf")


@pytest.mark.parametrize("dtype", ["u1", "i8", "u8"])
def test_triangles_of_other_types(tmp_path, dtype):
    """Triangles are read as int32 from whole numbers of any size."""
    rollout = stored(tmp_path, make_rollout(), array(f"{SHEET}/triangles", np.array([[0, 1, 2]], dtype)))
    assert_same(rollout.obstacles, make_rollout().obstacles)
    assert rollout.obstacles[0].triangle_F3.dtype == np.int32


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position_TN3": np.zeros((2, 3), np.float32)}, "position_TN3 must have shape"),
        ({"material_N": np.zeros(3, np.uint8)}, r"material_N must have shape \(7,\)"),
        ({"material_N": np.full(7, 9, np.uint8)}, r"material_N must be 0 to 3 \(.*\), got 9"),
        ({"frame_rate_hz": float("nan")}, "frame_rate_hz must be from 1e-9 to 1e9"),
        ({"entry_frame_N": np.array([0, 0, 0, 0, 0, 2, 1])}, r"entry_frame_N must .* in order"),
        ({"reference_TN3": np.zeros((2, 6, 3), np.float32)}, "reference_TN3 must have shape"),
    ],
)
def test_inconsistent_rollouts_are_refused(change, message):
    """Arrays that do not fit together never reach a file."""
    with pytest.raises(ConfigError, match=message):
        dataclasses.replace(make_rollout(), **change)


def episode(specification):
    return make_episode(cells=1, domain_size=(1.0, 1.0, 1.0), specification=specification)


def test_cell_obstacles():
    """Each cell becomes one square of the cell's size around its centre: across the stored normal, of a flat set in
    its plane."""
    normal = np.array([[0, 1, 0], [0.6, 0, 0.8]], np.float32)
    grid = ObstacleGrid(0.25, np.array([[0, 1, 2], [3, 0, 1]], np.int32), normal)
    (squares,) = cell_obstacles(grid)
    corner = squares.vertex_V3[squares.triangle_F3]
    np.testing.assert_allclose(squares.vertex_V3.reshape(2, 4, 3).mean(axis=1), (grid.cell_K3 + 0.5) * 0.25)
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    np.testing.assert_allclose(np.linalg.norm(cross, axis=1), 0.25**2)
    direction = cross / np.linalg.norm(cross, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs((direction * np.tile(normal, (2, 1))).sum(axis=1)), 1, rtol=1e-6)
    (flat,) = cell_obstacles(grid, plane_z=0.6)
    corner_K43 = flat.vertex_V3.reshape(2, 4, 3)
    np.testing.assert_allclose(corner_K43[..., :2].mean(axis=1), (grid.cell_K3[:, :2] + 0.5) * 0.25)
    assert (np.ptp(corner_K43, axis=1) == (0.25, 0.25, 0)).all() and (corner_K43[..., 2] == 0.6).all()
    assert cell_obstacles(ObstacleGrid(0.25, np.empty((0, 3), np.int32), np.empty((0, 3), np.float32))) == ()


def test_obstacles_of_episodes():
    """A random scene's obstacles are built again from its specification; others show their obstacle cells."""
    record = {"shape": "cone", "size": 0.3, "position": [0.4, 0.3, 0.5], "quaternion": [0.5, 0.5, 0.5, 0.5]}
    (cone,) = obstacles_of_episode(episode({"kind": "random", "obstacles": [record]}))
    assert cone.name == "obstacle_0_cone" and cone.closed
    np.testing.assert_allclose((cone.vertex_V3.min(axis=0) + cone.vertex_V3.max(axis=0)) / 2, (0.4, 0.3, 0.5))
    np.testing.assert_allclose(np.ptp(cone.vertex_V3, axis=0).max(), 0.3, rtol=1e-6)
    (cells,) = obstacles_of_episode(episode({"kind": "user"}))
    assert len(cells.triangle_F3) == 2


def test_obstacles_of_random_scenes_are_exact():
    """The rebuilt meshes of a random scene are those it was simulated with, bit for bit, in the same order."""
    scene = generate_scene(SceneConfig(), 4)
    assert_same(obstacles_of_episode(episode(scene.specification)), scene.obstacles)


def growing():
    """A rollout whose particles enter in four frames, with an obstacle that moves."""
    turn = Motion(np.array([0.0, 0.05]), np.array([[0.0, 0, 0], [0.1, 0, 0]]), np.stack([np.eye(3)] * 2), (0.0, 0, 0))
    still, moving = make_rollout().obstacles
    entry_N = np.array([0, 0, 1, 1, 2, 3, 5])
    position_TN3 = np.random.default_rng(1).random((6, PARTICLES, 3), np.float32)
    position_TN3[np.arange(6)[:, None] < entry_N] = np.nan
    obstacles = (still, dataclasses.replace(moving, motion=turn))
    return dataclasses.replace(make_rollout(), position_TN3=position_TN3, obstacles=obstacles, entry_frame_N=entry_N)


def contents(path):
    """All datasets and attributes of a file."""
    values = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: values.update({(name, key): item.attrs[key] for key in item.attrs}))
        file.visititems(lambda name, item: values.update({name: item[()]} if isinstance(item, h5py.Dataset) else {}))
    return values


def test_files_grow(tmp_path, monkeypatch):
    """A file that is written frame by frame equals one that is written whole, and so does each file on the way."""
    monkeypatch.setattr("hgn.scene.rollout_file.WRITE_EVERY_S", -1.0)
    whole, path = growing(), tmp_path / "new" / "grown.vtkhdf"
    empty = dataclasses.replace(whole, position_TN3=np.full_like(whole.position_TN3, np.nan))

    def simulate(take):
        for count, frame_N3 in enumerate(whole.position_TN3):
            if count:
                (temporary,) = filter(h5py.is_hdf5, path.parent.iterdir())
                shutil.copy(temporary, tmp_path / "copy")
                write_rollout(tmp_path / "part", dataclasses.replace(whole, position_TN3=whole.position_TN3[:count]))
                np.testing.assert_equal(contents(tmp_path / "copy"), contents(tmp_path / "part"))
            assert not path.exists()
            take(frame_N3[: whole.present(count)])

    write_frames(path, empty, simulate)
    write_rollout(tmp_path / "whole", whole)
    np.testing.assert_equal(contents(path), contents(tmp_path / "whole"))
    np.testing.assert_array_equal(empty.position_TN3, whole.position_TN3)
    assert [each.name for each in path.parent.iterdir()] == ["grown.vtkhdf"]


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), OSError(28, "No space left"), ConfigError("it diverged"), MemoryError()]
)
def test_interrupted_files(tmp_path, error, monkeypatch, capsys):
    """Ctrl-C and errors of the simulation, of a disk or of the memory, keep the frames so far, those before the second
    frame the file of before; a write that was interrupted is done again."""
    whole, path = growing(), tmp_path / "a.vtkhdf"
    write_rollout(path, make_rollout())

    def simulate(take):
        list(map(take, whole.position_TN3[:count]))
        raise error

    for count in (0, 1, 4):
        with pytest.raises(type(error)):
            write_frames(path, dataclasses.replace(whole, position_TN3=whole.position_TN3.copy()), simulate)
        assert read_rollout(path).frame_count == (count if count == 4 else FRAMES)
        assert capsys.readouterr().err == (f"4 of 6 frames are in {path}\n" if count == 4 else "")
    if isinstance(error, OSError):
        monkeypatch.setattr("hgn.scene.rollout_file.WRITE_EVERY_S", -1.0)
        extend, errors = rollout_file._extend, [error]
        monkeypatch.setattr(
            rollout_file, "_extend", lambda group, name, *rest: _fails(errors, name) or extend(group, name, *rest)
        )
        with pytest.raises(OSError, match="No space"):
            write_frames(path, whole, lambda take: list(map(take, whole.position_TN3)))
        np.testing.assert_array_equal(read_rollout(path).position_TN3, whole.position_TN3[:3])
    assert [each.name for each in tmp_path.iterdir()] == ["a.vtkhdf"]


def _fails(errors, name, calls=[]):  # noqa: B006 - counts the calls
    calls.append(name)
    if calls.count("Steps/Values") == 3 and errors:
        raise errors.pop()
