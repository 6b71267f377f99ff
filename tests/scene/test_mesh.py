"""Mesh files: formats, closed bodies and sheets, faces of many corners, placement, and what is refused."""

import struct

import numpy as np
import pytest
import trimesh

from hgn.scene.distance import contains
from hgn.scene.mesh import load_bodies, load_mesh
from hgn.scene.polygons import concave_cut, fans_by_size
from hgn.scene.scene_file import load_scene
from hgn.scene.scene_notes import notes_on_files
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
PLY = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n"
PLY += b"property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
GOOD = TRIANGLE.encode() + FACE
FACETS = (
    2
    * b"facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n".split(b"\n")[:7]
)
READABLE = "ramp must be a readable {} file"
REFUSED = [
    (
        "a.fbx",
        b"",
        {},
        r"ramp must end in one of \.stl, \.obj, \.ply, \.glb, \.usdc, \.usda, \.usd, got .*a\.fbx; convert",
    ),
    ("a.obj", b"", {}, "ramp must contain triangles, got none"),
    ("a.obj", b"v 0 0 0\nv 1 0 0\n", {}, "ramp must contain triangles"),
    ("a.stl", b"solid\nendsolid\n", {}, "ramp must contain triangles"),
    ("a.ply", b"bad", {}, READABLE.format("PLY")),
    ("a.stl", bytes(80) + struct.pack("<I", 3) + bytes(149), {}, "it has 233 of 234 bytes"),
    ("a.stl", b"solid\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n", {}, "it ends before endsolid"),
    *(
        ("a.stl", b"\n".join([head, *FACETS]), {}, "it ends before endsolid")
        for head in (b"solid endsolid", b"solid\nendsolid\nsolid")
    ),
    *(
        ("a.stl", b"\n".join([b"solid", *FACETS[:first], *FACETS[last:], b"endsolid"]), {}, "incomplete facet: f")
        for first, last in ((3, 7), (5, 7), (6, 7), (12, 14), (13, 14), (2, 3))
    ),
    ("a.glb", b"", {}, READABLE.format("GLB")),
    ("a.glb", b"glTFxxxxxx", {}, READABLE.format("GLB")),
    ("a.obj", TRIANGLE.encode() + b"f 1 2 9\n", {}, "ramp must have triangles whose indices are below 3, .*8"),
    ("a.obj", GOOD + b"f 0 1 2\n", {}, "a face has vertex 0, but OBJ counts from 1"),
    *(
        ("a.obj", GOOD + word + b" 1 2 3\n", {}, f"contains {word.strip().decode()}, which is not read")
        for word in (b"surf", b"call", b"fo", b"bzp", b"SURF", b"Call", b"FO", b"\tBZP")
    ),
    ("a.obj", GOOD + b"surf\\\n 1 2 3\n", {}, "contains surf, which is not read"),
    *(("a.obj", x + FACE, {}, "has . coordinates, not 3") for x in (b"v 0 0\nv 1 0\nv 0 1\n", GOOD + b"v 1\n")),
    *(
        (f"a.{suffix}", text.decode().encode(name), {}, "it is UTF-16 text")
        for name in ("utf-16", "utf-16-le", "utf-16-be")
        for suffix, text in (("obj", GOOD), ("ply", PLY), ("stl", b"\n".join([b"solid a", *FACETS, b"endsolid"])))
    ),
    ("a.ply", PLY.replace(b"3 0 1 2", b"-1 0 1 2"), {}, "it is cut"),
    *(
        ("a.ply", PLY.replace(b"3 0 1 2", face), {}, "it has .* where its header declares whole numbers")
        for face in (b"3 0 1 1.5", b"3 0.5 1 2", b"3.5 0 1 2", b"3 0 1 nan")
    ),
    ("a.ply", PLY.replace(b"face 1", b"face 2").replace(b"0 1 2", b"0 1 2\n4 0 1 2 1.5"), {}, "it has 1.5 where its"),
    ("a.ply", PLY.replace(b"element face", b"element vertex 3\nelement face"), {}, "has the element vertex twice"),
    ("a.ply", PLY.replace(b"element vertex 3\n", b""), {}, READABLE.format("PLY")),
    ("a.ply", PLY.replace(b"end_header", b"comment end_header"), {}, "it has no header of PLY"),
    ("a.ply", PLY.replace(b"face 1", b"tristrips 1"), {}, "it contains tristrips, which are not read"),
    ("a.ply", PLY.replace(b"uchar int", b"uchar float"), {}, "by numbers that are not whole"),
    *(
        (name, text.replace(b"1", b"0_1", count), {}, "it has 0_1.* for a number; write it without _")
        for name, text, count in (
            *(("a.obj", GOOD, 1), ("a.obj", TRIANGLE.encode() + FACE.replace(b"1", b"0_1"), 0)),
            *(("a.ply", PLY.replace(b"face 1", b"face 0_1"), 0), ("a.ply", PLY.replace(b"0 1 2", b"0 0_1 2"), 0)),
            ("a.stl", b"\n".join([b"solid", *FACETS, b"endsolid"]).replace(b"x 1", b"x 0_1"), 0),
        )
    ),
    ("a.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\n" + FACE, {}, "ramp must have finite vertices, got .*nan"),
    ("a.obj", b"v 0 0 inf\nv 1 0 0\nv 0 1 0\n" + FACE, {}, "ramp must have finite vertices, got .*inf"),
    ("a.obj", b"v 0 0 1e39\nv 1 0 0\nv 0 1 0\n" + FACE, {}, "ramp must stay within .*lower scale"),
    ("a.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\n" + FACE, {}, "ramp must have a triangle with an area"),
    ("none.obj", None, {}, r"ramp must be an existing file, got .*none\.obj"),
    *(
        ("a.obj", GOOD, {"scale": scale}, "ramp: scale must be a finite number > 0")
        for scale in (0.0, -1.0, np.nan, np.inf)
    ),
    ("a.obj", GOOD, {"translation": (0.0, np.nan, 0.0)}, "ramp: translation must be three numbers from -1e"),
    *(("a.obj", GOOD, {"rotation": x}, "rotation must be three numbers") for x in ((np.inf, 0.0, 0.0), (90.0, 0.0))),
]


@pytest.mark.parametrize(("name", "content", "options", "message"), REFUSED)
def test_bad_files_and_numbers_are_refused_by_name(tmp_path, name, content, options, message):
    """Unknown suffix, nothing inside, damage, non-finite numbers, no area: an error with field, file and cause."""
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigError, match=message):
        load_mesh(tmp_path / name, "ramp", **options)


@pytest.mark.parametrize("name", ["ramp.objj", "ramp.ob", "ramp.ojb", "rampp.obj"])
def test_a_mistyped_mesh_is_answered_with_the_file(tmp_path, name):
    """The similar mesh of the folder, also where the ending is mistyped; not where a file of that name exists."""
    (tmp_path / "ramp.obj").write_bytes(GOOD)
    with pytest.raises(ConfigError, match=rf"{name}; did you mean ramp\.obj\?$"):
        load_mesh(tmp_path / name)
    (tmp_path / "ramp.objj").touch()
    with pytest.raises(ConfigError, match=r"ramp\.objj; convert the mesh$"):
        load_mesh(tmp_path / "ramp.objj")


STEPS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nv 0 0 1\nf 1 2 4\n"


@pytest.mark.parametrize(
    "text",
    [
        *("\ufeff" + STEPS, STEPS.replace(" ", "\t"), STEPS.replace("v 1", " \tv 1"), STEPS.upper()),
        *(
            STEPS.replace("\n", "\r\n"),
            STEPS.replace("\n", "\r"),
            "# c:\\a\\\n" + STEPS,
            STEPS.replace("1 2", "1 \\\n2"),
        ),
        *(STEPS.replace("v 1", "\fv\v1"), STEPS.replace("f 1", "\ufefff 1")),
        *(STEPS.replace("1 2 3", "-3 -2 -1").replace("1 2 4", "-4 -3 -1"), STEPS.replace("2 4", "2 -1")),
        *("usemtl a\n" + STEPS.replace("f 1 2 4", "usemtl b\nf 1 2 4"), STEPS + "f 1\nf 1 2\n#f 2 3 4\n"),
    ],
)
def test_spellings_of_obj(tmp_path, text):
    """Each program's spelling gives the same triangles: marks, tabs, capitals, line ends, comments, indices."""
    write(tmp_path, text)
    write(tmp_path, STEPS, "usual.obj")
    assert load_mesh(tmp_path / "mesh.obj").corners.tolist() == load_mesh(tmp_path / "usual.obj").corners.tolist()
    assert len(load_mesh(tmp_path / "mesh.obj").triangle_F3) == 2


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"format", b"comment end_header\nobj_info end_header\ncomment the end_header\nformat"),
        (b"format", b"comment \v element vertex 9\ncomment \x1e property float x\nformat"),
        *((b"\n", b"\r\n"), (b"\n", b" \n"), (b"\n", b"\n "), (b"float x", b" float\tx")),
    ],
)
def test_spellings_of_ply(tmp_path, old, new):
    """Comments of any words, line ends and spaces change nothing."""
    (tmp_path / "a.ply").write_bytes(PLY.replace(old, new))
    assert load_mesh(tmp_path / "a.ply").corners.tolist() == [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]


# outlines, counterclockwise; the area of each
OUTLINES = {
    "L": ([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], 3.0),
    "U": ([(0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)], 7.0),
    "chevron": ([(0, 0), (2, 1), (4, 0), (2, 3)], 4.0),
    "star": (
        [(np.cos(a) * r, np.sin(a) * r) for a, r in zip(np.arange(10) * np.pi / 5, [2, 0.7] * 5, strict=True)],
        10 * 0.5 * 2 * 0.7 * np.sin(np.pi / 5),
    ),
    "comb": ([(0, 0), (7, 0), (7, 3), (6, 3), (6, 1), (5, 1), (5, 3), (3, 3), (3, 1), (1, 1), (1, 3), (0, 3)], 15.0),
    "straight": ([(0, 0), (1, 0), (2, 0), (2, 2), (1, 2), (1, 1), (0, 1)], 3.0),  # three corners on a line
    # with a hole, reached through a bridge
    "frame": ([(0, 0), (3, 0), (3, 3), (0, 3), (0, 0), (1, 1), (1, 2), (2, 2), (2, 1), (1, 1)], 8.0),
}


def prism(outline, turn=0):
    """Corners and faces of a prism of height 1; each face begins at its corner `turn`."""
    count = len(outline)
    vertices = [(x, y, z) for z in (0, 1) for x, y in outline]
    bottom, top = list(range(count))[::-1], list(range(count, 2 * count))
    sides = [[i, (i + 1) % count, (i + 1) % count + count, i + count] for i in range(count)]
    turned = [np.roll(face, turn).tolist() for face in (bottom, top)]
    return np.array(vertices, float), [*turned, *sides]


def write_obj(path, vertices, faces):
    lines = ["v " + " ".join(map(str, vertex)) for vertex in vertices.tolist()]
    forms = ("{0}", "{0}/1/1", "{0}//1")
    lines.append("vt 0 0\nvn 0 0 1")
    for number, face in enumerate(faces):
        words = [forms[number % 3].format(i - len(vertices) if number % 2 else i + 1) for i in face]
        lines.append("f " + " \\\n ".join(words) + " # a face")
    path.write_text("\n".join(lines) + "\n")


def write_ply(path, vertices, faces, binary):
    head = ["ply", f"format {'binary_little_endian' if binary else 'ascii'} 1.0", f"element vertex {len(vertices)}"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    if binary:
        body = vertices.astype("<f4").tobytes()
        body += b"".join(struct.pack(f"<B{len(face)}i", len(face), *face) for face in faces)
    else:
        rows = [" ".join(map(str, vertex)) for vertex in vertices.tolist()]
        rows += [" ".join(map(str, [len(face), *face])) for face in faces]
        body = ("\n".join(rows) + "\n").encode()
    path.write_bytes("\n".join(head).encode() + body)


@pytest.mark.parametrize("name", OUTLINES)
@pytest.mark.parametrize("form", ["obj", "ascii.ply", "binary.ply"])
def test_concave_faces_are_cut_by_ears(tmp_path, name, form):
    """A prism over a concave outline has its volume, whichever corner its faces begin with; a point in the notch is
    outside."""
    outline, area = OUTLINES[name]
    for turn in range(0, len(outline), 2):
        vertices, faces = prism(outline, turn)
        path = tmp_path / f"prism{turn}.{form}"
        write_obj(path, vertices, faces) if form == "obj" else write_ply(path, vertices, faces, "binary" in form)
        obstacle = load_mesh(path)
        mesh = trimesh.Trimesh(obstacle.vertex_V3, obstacle.triangle_F3, process=False)
        assert abs(mesh.volume) == pytest.approx(area, rel=1e-5)
        assert obstacle.closed or name in ("frame", "straight")
        assert mesh.area == pytest.approx(2 * area + perimeter(outline), rel=1e-5)


def perimeter(outline):
    edge = np.roll(outline, -1, axis=0) - np.array(outline)
    return np.linalg.norm(edge, axis=1).sum()


@pytest.mark.parametrize(
    "face", [[0, 2, 1, 4, 3], [0, 2, 1, 3], [5, 7, 9, 6, 8]],
    ids=["one loop inwards", "two equal loops", "pentagram"],
)  # fmt: skip
def test_faces_whose_edges_cross_are_refused(tmp_path, face):
    """There is no right cut: the face is named."""
    angle = np.arange(5) * 2 * np.pi / 5
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    vertices = np.concatenate([[(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (3, 1, 0)], ring])
    write_obj(tmp_path / "crossing.obj", vertices, [[0, 1, 2], face])
    with pytest.raises(ConfigError, match="face 1 cannot be cut into triangles, because its edges cross"):
        load_mesh(tmp_path / "crossing.obj")


def test_convex_faces_are_left_to_the_reader():
    """Nothing changes for meshes without concave faces, also far from the origin, in other planes, or bent."""
    rng = np.random.default_rng(0)
    angle = np.arange(7) * 2 * np.pi / 7
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    square = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0.2), (0, 1, 0)], float)
    for points in (ring, 1e-3 * ring + 5, square):
        assert concave_cut(points, [np.arange(len(points))], None) is None


CUBE = trimesh.creation.box(bounds=((0, 0, 0), (1, 1, 1)))


def needle_cube(split):
    """A cube in which an edge of one face has a further corner, which a triangle without area closes."""
    vertices, faces = CUBE.vertices.tolist(), CUBE.faces.tolist()
    a, b, c = faces.pop(split)
    vertices.append((0.5 * (np.array(vertices[a]) + vertices[b])).tolist())
    middle = len(vertices) - 1
    return np.array(vertices), [*faces, [a, middle, c], [middle, b, c], [b, middle, a]]


@pytest.mark.parametrize("form", ["obj", "ascii.ply", "binary.ply"])
@pytest.mark.parametrize("split", [0, 5, 11])
def test_needles_do_not_open_a_body(tmp_path, form, split):
    """Closedness is tested before triangles without area are dropped."""
    vertices, faces = needle_cube(split)
    path = tmp_path / f"a.{form}"
    write_obj(path, vertices, faces) if form == "obj" else write_ply(path, vertices, faces, "binary" in form)
    obstacle, points = load_mesh(path), np.array([(0.5, 0.4, 0.6), (1.5, 0.4, 0.6)])
    assert obstacle.closed and contains(points, obstacle).tolist() == [True, False]


@pytest.mark.parametrize("more", [CUBE.faces[:1], CUBE.faces[:1, ::-1], CUBE.faces, [(0, 0, 1)]])
def test_repeated_faces_are_no_sheet(tmp_path, more):
    """A body with some faces given twice is the body."""
    write_obj(tmp_path / "a.obj", CUBE.vertices, [*CUBE.faces, *more])
    (body,) = load_bodies(tmp_path / "a.obj")
    assert body.closed and len(body.triangle_F3) == 12


def test_small_bodies_stay_closed(tmp_path):
    """A body whose corners coincide in float32 far from the origin is as closed as its file says."""
    cube = trimesh.creation.icosphere(subdivisions=3)
    write_obj(tmp_path / "a.obj", cube.vertices, cube.faces.tolist())
    assert load_mesh(tmp_path / "a.obj", scale=2e-5, translation=(100.0, 100.0, 100.0)).closed


@pytest.mark.parametrize("size", [1, 500])
@pytest.mark.parametrize(("seam", "closed"), [(1e-9, True), (1e-7, True), (1e-6, True), (1e-3, False)])
def test_seams(tmp_path, seam, closed, size):
    """Corners that an exporter writes once for each triangle, with an error, are one, and larger gaps stay open."""
    corners = trimesh.creation.icosphere(subdivisions=3).triangles.reshape(-1, 3)
    corners = size * (corners + seam * np.random.default_rng(0).uniform(-1, 1, corners.shape))
    write_obj(tmp_path / "a.obj", corners, np.arange(len(corners)).reshape(-1, 3).tolist())
    body = load_mesh(tmp_path / "a.obj")
    assert body.closed == closed and contains(size * np.array([(0, 0, 0.9), (0, 0, 1.1)]), body).tolist() == [
        closed,
        False,
    ]


def test_each_body_is_judged_by_itself(tmp_path):
    """A ball, a torus and a lone triangle: two solids and a sheet; the group inside the ball is refused."""
    ball = trimesh.creation.icosphere(radius=0.2)
    ball.apply_translation((0.5, 0.5, 0.5))
    ring = trimesh.creation.torus(0.1, 0.02)
    ring.apply_translation((0.5, 0.85, 0.5))
    leaf = trimesh.Trimesh([(0.1, 0.1, 0.1), (0.2, 0.1, 0.1), (0.1, 0.1, 0.2)], [(0, 1, 2)], process=False)
    trimesh.util.concatenate([leaf, ball, ring]).export(tmp_path / "three.stl")
    solid, sheet = load_bodies(tmp_path / "three.stl")
    assert solid.closed and len(solid.triangle_F3) == len(ball.faces) + len(ring.faces)
    assert not sheet.closed and len(sheet.triangle_F3) == 1
    group = "groups: [{shape: cube, size: 0.05, position: [%s], material: water}]\nobstacles: [{mesh: three.stl}]\n"
    (tmp_path / "in.yaml").write_text(group % "0.5, 0.5, 0.5")
    with pytest.raises(ConfigError, match=r"must be clear of closed obstacles, got .* inside three"):
        load_scene(tmp_path / "in.yaml")
    (tmp_path / "out.yaml").write_text(group % "0.8, 0.2, 0.8")
    note = "1 triangles are a sheet, because they enclose no volume: three_sheets"
    assert notes_on_files(load_scene(tmp_path / "out.yaml")) == [note]


@pytest.mark.parametrize("word", ["plain", "mark", "\r", "\r\n", " ", "\f\n", "capitals", "name", "solids", "wide"])
def test_spellings_of_text_stl(tmp_path, word):
    """A mark of UTF-8, line ends, one line, capitals, names and several solids change nothing."""
    text = trimesh.exchange.stl.export_stl_ascii(CUBE).replace("\r\n", "\n")
    text = {
        "mark": "\ufeff" + text,
        "capitals": text.upper(),
        "name": text.replace("solid ", "solid outer vertex"),
        "solids": text.replace("endfacet", "endfacet\nendsolid one\nsolid two"),
        "wide": text.replace(" ", " \t "),
    }.get(word, text.replace("\n", word) if word.isspace() else text)
    (tmp_path / "a.stl").write_bytes(text.encode())
    body = load_mesh(tmp_path / "a.stl")
    assert body.closed and len(body.triangle_F3) == 12


def test_binary_stl_with_more_behind(tmp_path):
    """Some programs write colours or comments behind the triangles, and `solid` before them."""
    data = trimesh.exchange.stl.export_stl(CUBE)
    for head in (data[:80], b"solid made by a program".ljust(80)):
        for tail in (b"\0", b"facets of another kind", bytes(100)):
            (tmp_path / "a.stl").write_bytes(head + data[80:] + tail)
            assert load_mesh(tmp_path / "a.stl").closed


@pytest.mark.parametrize("sizes", [(3,), (4,), (3, 4), (3, 4, 5, 7), (6,), (2, 3)])
def test_order_of_triangles(sizes):
    """Convex polygons become triangles in the order of trimesh. Samples of obstacles depend on the order."""
    rng = np.random.default_rng(0)
    faces = [rng.integers(0, 99, rng.choice(sizes)) for _ in range(40)]
    assert np.array_equal(fans_by_size(faces), trimesh.geometry.triangulate_quads(faces))
    assert fans_by_size([]).shape == (0, 3)
