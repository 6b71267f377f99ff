"""Mesh files: formats, closed bodies and sheets, placement, and what is refused."""

import numpy as np
import pytest
import trimesh

from hgn.scene.distance import contains
from hgn.scene.mesh import load_mesh
from hgn.schema import ConfigError

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def write(folder, text, name="mesh.obj"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "glb", "STL"])
def test_a_box_is_closed_in_every_format(tmp_path, suffix):
    """STL (whose corners are not shared), OBJ, PLY and GLB all give eight vertices, twelve triangles, closed."""
    path = tmp_path / f"box.{suffix}"
    trimesh.creation.box((1, 2, 3)).export(path, file_type=suffix.lower())
    obstacle = load_mesh(path)
    assert obstacle.closed and obstacle.name == "box"
    assert (obstacle.vertex_V3.shape, obstacle.triangle_F3.shape) == ((8, 3), (12, 3))
    assert (obstacle.vertex_V3.dtype, obstacle.triangle_F3.dtype) == (np.float64, np.int32)
    np.testing.assert_allclose(np.ptp(obstacle.vertex_V3, axis=0), [1, 2, 3])


def test_bodies_of_several_parts(tmp_path):
    """A GLB of two placed bodies is one closed obstacle with both. Of a shell with an inward inner surface the space
    between counts as inside, the cavity does not."""
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((1, 1, 1)))
    scene.add_geometry(trimesh.creation.box((1, 1, 1)), transform=trimesh.transformations.translation_matrix([3, 0, 0]))
    scene.export(tmp_path / "two.glb")
    outer, inner = trimesh.creation.icosphere(2, 1.0), trimesh.creation.icosphere(2, 0.5)
    inner.invert()
    trimesh.util.concatenate([outer, inner]).export(tmp_path / "shell.stl")
    two, shell = load_mesh(tmp_path / "two.glb"), load_mesh(tmp_path / "shell.stl")
    assert len(two.triangle_F3) == 24 and two.closed
    assert contains(np.array([[0.1, 0.2, 0.3], [1.5, 0, 0], [3.1, 0.2, 0.3]]), two).tolist() == [True, False, True]
    assert contains(np.array([[0.7, 0.1, 0.1], [0.1, 0.1, 0.1]]), shell).tolist() == [True, False]


def test_scale_then_rotation_then_translation(tmp_path):
    """A corner at (1, 0, 0) scaled by 2, turned by 90 degrees about z and moved lands at 2 y plus the move."""
    path = write(tmp_path, TRIANGLE + "f 1 2 3\n")
    obstacle = load_mesh(path, scale=2.0, rotation=(0.0, 0.0, 90.0), translation=(0.0, 0.0, 1.0))
    assert not obstacle.closed
    assert sorted(obstacle.vertex_V3.tolist()) == [[-2.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 2.0, 1.0]]


def test_flipped_triangles_are_turned_to_agree(tmp_path):
    """A watertight mesh with a third of its triangles flipped is closed, and its inside is the true inside."""
    mesh = trimesh.creation.torus(1.0, 0.4, major_sections=24, minor_sections=12)
    rng = np.random.default_rng(0)
    flipped = rng.random(len(mesh.faces)) < 1 / 3
    mesh.faces[flipped] = mesh.faces[flipped][:, ::-1]
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / "torus.ply")
    obstacle = load_mesh(tmp_path / "torus.ply")
    fixed = trimesh.Trimesh(obstacle.vertex_V3, obstacle.triangle_F3, process=False)
    assert obstacle.closed and fixed.is_winding_consistent and fixed.volume > 0
    point = rng.random((500, 3)) * 3 - 1.5
    tube = np.hypot(np.hypot(point[:, 0], point[:, 1]) - 1.0, point[:, 2])
    inside = contains(point, obstacle)
    assert inside[tube < 0.36].all() and not inside[tube > 0.4].any()


@pytest.mark.parametrize(
    ("text", "triangles"),
    [
        (TRIANGLE + "f 1 2 3\n", 1),
        (TRIANGLE + "f 1 2 3\nf 3 2 1\n", 1),  # both sides of one sheet
        (TRIANGLE + "v 1 1 0\nf 1 2 4 3\n", 2),
        (TRIANGLE + "v 2 0 0\nf 1 2 3\nf 1 2 4\nf 1 1 2\n", 1),  # with zero-area triangles
    ],
)
def test_meshes_with_a_boundary_are_sheets(tmp_path, text, triangles):
    """Whatever is not watertight is a sheet; zero-area and repeated triangles are dropped."""
    obstacle = load_mesh(write(tmp_path, text))
    assert not obstacle.closed
    assert len(obstacle.triangle_F3) == triangles
    assert len(obstacle.vertex_V3) == len(np.unique(obstacle.triangle_F3))


def test_one_sided_and_branching_surfaces_are_sheets(tmp_path):
    """A Klein bottle has two triangles at every edge but no inside; two boxes sharing an edge have four there."""
    n = 12

    def vertex(i, j):
        return (i % n) * n + ((j if i < n else -j) % n)

    faces = []
    for i, j in np.ndindex(n, n):
        a, b, c, d = vertex(i, j), vertex(i + 1, j), vertex(i + 1, j + 1), vertex(i, j + 1)
        faces += [(a, b, c), (a, c, d)]
    klein = trimesh.Trimesh(np.random.default_rng(0).random((n * n, 3)), faces, process=False)
    boxes = [trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1))]
    boxes[1].apply_translation([1, 1, 0])
    for name, mesh in (("klein.ply", klein), ("boxes.stl", trimesh.util.concatenate(boxes))):
        mesh.export(tmp_path / name)
        assert not load_mesh(tmp_path / name).closed


FACE = b"f 1 2 3\n"
GOOD = TRIANGLE.encode() + FACE
READABLE = "ramp must be a readable {} file"
REFUSED = [
    ("a.fbx", b"", {}, r"ramp must end in one of \.stl, \.obj, \.ply, \.glb, got .*a\.fbx; convert"),
    ("a.obj", b"", {}, "ramp must contain triangles, got none"),
    ("a.obj", b"v 0 0 0\nv 1 0 0\n", {}, "ramp must contain triangles"),
    ("a.stl", b"solid\nendsolid\n", {}, "ramp must contain triangles"),
    ("a.ply", b"bad", {}, READABLE.format("PLY")),
    ("a.glb", b"", {}, READABLE.format("GLB")),
    ("a.glb", b"glTFxxxxxx", {}, READABLE.format("GLB")),
    ("a.obj", TRIANGLE.encode() + b"f 1 2 9\n", {}, READABLE.format("OBJ")),
    ("a.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\n" + FACE, {}, "ramp must have finite vertices, got .*nan"),
    ("a.obj", b"v 0 0 inf\nv 1 0 0\nv 0 1 0\n" + FACE, {}, "ramp must have finite vertices, got .*inf"),
    ("a.obj", b"v 0 0 1e39\nv 1 0 0\nv 0 1 0\n" + FACE, {}, "ramp must stay within .*lower scale"),
    ("a.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\n" + FACE, {}, "ramp must have a triangle with an area"),
    ("none.obj", None, {}, r"ramp must be an existing file, got .*none\.obj"),
    *(
        ("a.obj", GOOD, {"scale": scale}, "ramp: scale must be a finite number > 0")
        for scale in (0.0, -1.0, np.nan, np.inf)
    ),
    ("a.obj", GOOD, {"translation": (0.0, np.nan, 0.0)}, "ramp: translation must be three finite numbers"),
    ("a.obj", GOOD, {"rotation": (np.inf, 0.0, 0.0)}, "ramp: rotation must be three finite numbers"),
]


@pytest.mark.parametrize(("name", "content", "options", "message"), REFUSED)
def test_bad_files_and_numbers_are_refused_by_name(tmp_path, name, content, options, message):
    """Unknown suffix, nothing inside, damage, non-finite numbers, no area: an error with field, file and cause."""
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigError, match=message):
        load_mesh(tmp_path / name, "ramp", **options)
