"""USD files as particles and obstacles: what is read, and what is refused by name."""

import re
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from processes import write_program

from hgn.render.exchange import save_rollout
from hgn.scene import usd
from hgn.scene.mesh import load_mesh
from hgn.scene.rollout_file import Rollout
from hgn.scene.scene import Obstacle
from hgn.scene.scene_file import load_scene
from hgn.schema import ConfigError

pytest.importorskip("pxr")
from hgn.scene import usd_program

CORNERS = ", ".join(f"({x}, {y}, {z})" for x in (0, 1) for y in (0, 1) for z in (0, 1))
BOX = f"""def Mesh "box" {{\npoint3f[] points = [{CORNERS}]\nint[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
int[] faceVertexIndices = [0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]\n}}\n"""
PLACED = f"""def Xform "a" {{\ndouble3 xformOp:translate = (10, 0, 5)\nfloat3 xformOp:scale = (2, 4, 6)
uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]\n{BOX}}}\n"""
L_SHAPE = """def Mesh "l" {\npoint3f[] points = [(0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 1, 0), (1, 2, 0), (0, 2, 0)]
int[] faceVertexCounts = [6]\nint[] faceVertexIndices = [3, 4, 5, 0, 1, 2]\n}\n"""


def copies(depth, width, name):
    """Prims that each stand for many instances of the ones before."""
    text = ""
    for level in range(depth):
        refers = f"(instanceable = true\nreferences = </{name}>)"
        name = f"level{level}"
        text += f'def "{name}" {{\n' + "".join(f'def "c{i}" {refers} {{}}\n' for i in range(width)) + "}\n"
    return text


def mesh_of(folder, text, metadata=""):
    (folder / "mesh.usda").write_text(f"#usda 1.0\n({metadata})\n{text}")
    return load_mesh(folder / "mesh.usda")


def test_meshes(tmp_path):
    """Polygons are placed by their transforms, in metres with y up; concave ones are cut; hidden ones are left out."""
    hidden = L_SHAPE.replace("{", '{\ntoken visibility = "invisible"', 1)
    box = mesh_of(tmp_path, PLACED + hidden, 'metersPerUnit = 0.1\nupAxis = "Z"')
    assert box.closed and len(box.triangle_F3) == 12  # z, up to 1.1, becomes y, and y becomes -z
    np.testing.assert_allclose([box.vertex_V3.min(0), box.vertex_V3.max(0)], [[1, 0.5, -0.4], [1.2, 1.1, 0]], atol=1e-9)
    twice = mesh_of(tmp_path, BOX + 'def "copy" (references = </box>) {\ndouble3 xformOp:translate = (9, 0, 0)\n'
                    'uniform token[] xformOpOrder = ["xformOp:translate"]\n}\n')  # fmt: skip
    assert len(twice.triangle_F3) == 24
    flat = mesh_of(tmp_path, L_SHAPE)  # without units: USD's default of a centimetre
    a, b, c = flat.vertex_V3[flat.triangle_F3].transpose(1, 0, 2)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(3e-4)


def test_particles(tmp_path, monkeypatch):
    """A rollout's first frame comes back as groups, with velocities and obstacles, also under the limits of a shell. A
    claimed size is no memory."""
    write_program(tmp_path / "limited", f'#!/bin/bash\nulimit -t 40 -v 8000000 && exec {sys.executable} "$@"\n')
    monkeypatch.setattr(sys, "executable", str(tmp_path / "limited"))
    start_N3 = (0.3 + 0.4 * np.random.default_rng(0).random((30, 3))).astype(np.float32)
    path_TN3 = start_N3 + np.arange(3, dtype=np.float32)[:, None, None] * np.float32((0.01, 0, 0))
    sheet = Obstacle("sheet", 0.2 + np.eye(3), np.array([[0, 1, 2]], np.int32), False)
    file = save_rollout(tmp_path / "a.usdc", Rollout(path_TN3, np.arange(30) % 2, (sheet,), (1.0, 1.0, 1.0), 60.0))
    text = "groups: [{particles: a.usdc, material: sand}, {particles: a.usdc, material: water}]\n"
    (tmp_path / "a.yaml").write_text(text + "obstacles: [{mesh: a.usdc}]")
    scene = load_scene(tmp_path / "a.yaml")
    np.testing.assert_array_equal(scene.position_N3, np.concatenate([start_N3[1::2], start_N3[::2]]))
    np.testing.assert_allclose(scene.velocity_N3, np.tile([0.6, 0, 0], (30, 1)), atol=1e-5)
    np.testing.assert_allclose(sorted(scene.obstacles[0].vertex_V3.tolist()), sorted((0.2 + np.eye(3)).tolist()))
    data = file.read_bytes()
    count = data.index(start_N3[1].tobytes()) - 8
    assert struct.unpack_from("<Q", data, count) == (15,)
    file.write_bytes(data[:count] + struct.pack("<Q", 1 << 36) + data[count + 8 :])
    with pytest.raises(
        ConfigError, match=r"groups\[0\].particles must be a readable USD file, .*it is damaged, or needs"
    ):
        load_scene(tmp_path / "a.yaml")


def test_content_that_compresses_well(tmp_path):
    """A million triangles in a few kilobytes are refused."""
    from pxr import Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usdc"))
    mesh = UsdGeom.Mesh.Define(stage, "/m")
    mesh.CreatePointsAttr([(0, 0, 0)])
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray([3] * 10**6))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray(3 * 10**6))
    stage.Save()
    with pytest.raises(ConfigError, match="needs more memory than files of its size"):
        load_mesh(tmp_path / "a.usdc")


TRIANGLE = {
    "points": ("half3[]", "[(0, 0, 0), (1, 0, 0), (0, 2, 0)]"),
    "faceVertexCounts": ("uchar[]", "[3]"),
    "faceVertexIndices": ("uint64[]", "[0, 1, 2]"),
    "holeIndices": ("uchar[]", "[]"),
    "velocities": ("half3[]", "[(0, 0, 0), (1, 0, 0), (0, 2, 0)]"),
}


def of_types(kind, **given):
    values = {name: value for name, value in (TRIANGLE | given).items() if kind == "Mesh" or name[:2] in ("po", "ve")}
    return f'def {kind} "m" {{\n' + "".join(f"{of} {name} = {value}\n" for name, (of, value) in values.items()) + "}"


def read_of(folder, text):
    (folder / "a.usda").write_text(f"#usda 1.0\n{text}\n")
    return usd.read_usd_particles(folder / "a.usda", "sand") if "Points" in text else load_mesh(folder / "a.usda")


def test_numbers_of_small_types(tmp_path):
    """Halves, and integers of any size, are read as the numbers that they are."""
    mesh, points = (read_of(tmp_path, of_types(kind)) for kind in ("Mesh", "Points"))
    start_N3 = np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.02, 0]])
    np.testing.assert_allclose(mesh.vertex_V3[mesh.triangle_F3[0]].sum(0), start_N3.sum(0), atol=1e-8)
    for name in ("position", "velocity"):
        np.testing.assert_allclose(points[name], start_N3, atol=1e-12)


OTHER_TYPES = [
    ("points", "bool[]", "[1, 1, 0]"),
    ("points", "token[]", '["0", "1", "2"]'),
    ("points", "quath[]", "[(0, 0, 0, 1)]"),
    ("points", "float3", "(0, 1, 2)"),
    ("points", "string", '"a"'),
    ("velocities", "float2[]", "[(0, 1), (0, 1), (0, 1)]"),
    ("velocities", "timecode[]", "[0, 1, 2]"),
    ("faceVertexCounts", "bool[]", "[1]"),
    ("faceVertexCounts", "token[]", '["3"]'),
    ("faceVertexCounts", "uchar", "3"),
    ("faceVertexIndices", "half[]", "[0, 1, 2]"),
    ("faceVertexIndices", "timecode[]", "[0, 1, 2]"),
    ("holeIndices", "asset[]", "[@a@]"),
    ("holeIndices", "matrix3d[]", "[((1, 0, 0), (0, 1, 0), (0, 0, 1))]"),
]


@pytest.mark.parametrize(("name", "of", "value"), OTHER_TYPES)
def test_values_of_other_types(tmp_path, capsys, name, of, value):
    """Values that are not the numbers of their attribute are refused with its name and the prim's path. The program is
    called in this process, because its start takes longer than its work."""
    kind = "Points" if name == "velocities" else "Mesh"
    (tmp_path / "a.usda").write_text(f"#usda 1.0\n{of_types(kind, **{name: (of, value)})}\n")
    stage, room = usd_program.opened(str(tmp_path / "a.usda")), [1 << 20]
    with pytest.raises(SystemExit, match=r"^3$"):
        usd_program.read_particles(stage, room, "sand") if kind == "Points" else usd_program.read_meshes(stage, room)
    assert re.fullmatch(rf"has {name} of type \w+ at /m; .*\n", capsys.readouterr().err)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('def Sphere "ball" {}', "contains Sphere at /ball, which is not read"),
        ('def Mesh "m" (payload = @/etc/hostname@) {}', "refers to '/etc/hostname', and other files are not read"),
        ('def Xform "x" (clips = {dictionary a = {asset[] assetPaths = [@b@]\n}\n}) {}', "refers to 'clips of /x'"),
        (of_types("Mesh", points=("string", '"a"')), r"has points of type str at /m; "),
        (BOX.replace("7, 3]", "7, 8]"), "has polygons at /box that are not of its 8 points"),
        (BOX.replace("}", "", 1), "must be a readable USDA file, .*it is damaged"),
        ('def Points "p" {\npoint3f[] points = [(0, 0, 0)]\n}', "must contain triangles, got none"),
        (BOX + copies(8, 10, "box"), "it is damaged, or needs more memory or time than"),
    ],
)
def test_what_is_not_read(tmp_path, monkeypatch, text, message):
    """Content of other kinds, of other files, damaged or endless content end in one line that names it."""
    program = Path(usd.__file__).with_name("usd_program.py").read_text()
    (tmp_path / "usd_program.py").write_text(program.replace("\nSECONDS = 5 ", "\nSECONDS = 1 "))
    monkeypatch.setattr(usd, "__file__", str(tmp_path / "usd.py"))
    with pytest.raises(ConfigError, match=message) as raised:
        mesh_of(tmp_path, text)
    assert "\n" not in str(raised.value)
