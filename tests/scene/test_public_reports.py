"""Kinds of reports that users of tools like this one publish, on scenes and meshes."""

import struct

import numpy as np
import pytest
import trimesh

from hgn.scene.distance import contains
from hgn.scene.mesh import load_bodies, load_mesh
from hgn.scene.polygons import concave_cut
from hgn.scene.scene_file import load_scene, notes_on_files
from hgn.schema import ConfigError

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
    "frame": (  # with a hole, reached through a bridge
        [(0, 0), (3, 0), (3, 3), (0, 3), (0, 0), (1, 1), (1, 2), (2, 2), (2, 1), (1, 1)],
        8.0,
    ),
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


def test_faces_whose_edges_cross_are_refused(tmp_path):
    """There is no right cut: the face is named."""
    vertices, _ = prism([(0, 0), (2, 0), (2, 2), (0, 2), (3, 1)])
    write_obj(tmp_path / "crossing.obj", vertices, [[0, 1, 2], [0, 2, 1, 4, 3]])
    with pytest.raises(ConfigError, match="face 1 cannot be cut into triangles, because its edges cross"):
        load_mesh(tmp_path / "crossing.obj")


def test_convex_faces_are_left_to_the_reader():
    """Nothing changes for meshes without concave faces, also far from the origin, in other planes, or bent."""
    rng = np.random.default_rng(0)
    angle = np.arange(7) * 2 * np.pi / 7
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    square = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0.2), (0, 1, 0)], float)
    for points in (ring, 1e-3 * ring + 5, square):
        assert concave_cut(points, [np.arange(len(points))]) is None


CUBE = trimesh.creation.box(bounds=((0, 0, 0), (1, 1, 1)))


# closed or not


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
    obstacle = load_mesh(path)
    assert obstacle.closed and contains(np.array([(0.5, 0.4, 0.6), (1.5, 0.4, 0.6)]), obstacle).tolist() == [
        True,
        False,
    ]


def test_small_bodies_stay_closed(tmp_path):
    """A body whose corners coincide in float32 far from the origin is as closed as its file says."""
    cube = trimesh.creation.icosphere(subdivisions=3)
    write_obj(tmp_path / "a.obj", cube.vertices, cube.faces.tolist())
    assert load_mesh(tmp_path / "a.obj", scale=2e-5, translation=(100.0, 100.0, 100.0)).closed


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
    assert notes_on_files(load_scene(tmp_path / "out.yaml")) == [
        "1 triangles are a sheet, because they enclose nothing: three_sheets"
    ]


def test_binary_stl_with_more_behind(tmp_path):
    """Some programs write colours or comments behind the triangles, and `solid` before them."""
    data = trimesh.exchange.stl.export_stl(CUBE)
    for head in (data[:80], b"solid made by a program".ljust(80)):
        for tail in (b"\0", b"facets of another kind", bytes(100)):
            (tmp_path / "a.stl").write_bytes(head + data[80:] + tail)
            assert load_mesh(tmp_path / "a.stl").closed


# scene files

GROUP = "groups:\n  - {shape: cube, size: 0.05, position: [0.5, 0.8, 0.5], material: water}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (GROUP + "seed: 1\n" + GROUP, r"line 4: the key groups is given twice, first in line 1"),
        (GROUP.replace("size: 0.05", "size: 0.05, size: 0.1"), "line 2: the key size is given twice, first in line 2"),
        ("\ufeff" + GROUP.replace("\n", "\r\n") + "seed: 1\r\nseed: 2\r\n", "line 4: the key seed is given twice"),
        ("gravity: [0, 0, 0]\n'gravity': [0, -9.8, 0]\n" + GROUP, "line 2: the key gravity is given twice"),
        (GROUP + "seed: 010\n", "line 3: seed: 010 is an octal number in YAML; write 10, or 8"),
        (GROUP + "cell_size: 00_17\n", "line 3: cell_size: 00_17 is an octal number"),
        (GROUP + "gravity:\n- 0\n- -9:30\n- 0\n", "line 5: gravity: -9:30 is a number of base 60 in YAML"),
        (GROUP + "cell_size: 1:0.5\n", "line 3: cell_size: 1:0.5 is a number of base 60"),
        (GROUP.replace("0.8", "1:48"), "line 2: position: 1:48 is a number of base 60"),
    ],
)
def test_surprises_of_yaml(tmp_path, text, message):
    """Keys given twice and numbers in other bases are refused with key and line."""
    (tmp_path / "scene.yaml").write_bytes(text.encode())
    with pytest.raises(ConfigError, match=message):
        load_scene(tmp_path / "scene.yaml")


def test_numbers_that_are_none(tmp_path):
    """Zero, a decimal that begins with it, a date of the name, and anchors used twice are no surprise."""
    text = GROUP.replace("[0.5, 0.8, 0.5]", "&middle [0.5, 0.8, 0.5]") + "obstacles:\n"
    text += "  - {shape: cone, size: 00.1, position: [0.2, 0.2, 0.2]}\nseed: 0\ngravity: [0, -0.98e1, +0]\n"
    (tmp_path / "scene.yaml").write_text(text)
    assert load_scene(tmp_path / "scene.yaml").gravity == (0, -9.8, 0)


@pytest.mark.parametrize(
    ("scale", "note"), [(1000, "no surface in the domain"), (1, None), (1e-3, "smaller than a cell")]
)
def test_units_of_a_bowl(tmp_path, scale, note):
    """A sheet around the whole domain, as a bowl in millimetres, is noted, and the scale that helps."""
    bowl = trimesh.creation.icosphere(subdivisions=2)
    bowl.update_faces(bowl.triangles_center[:, 1] < 0.5)
    bowl.apply_scale(0.3 * scale)
    bowl.export(tmp_path / "bowl.obj")
    (tmp_path / "scene.yaml").write_text(GROUP + "obstacles: [{mesh: bowl.obj, position: [0.5, 0.4, 0.5]}]\n")
    notes = notes_on_files(load_scene(tmp_path / "scene.yaml"))
    assert len(notes) == 1 + (note is not None) and (note is None or note in notes[1])


@pytest.mark.parametrize("inside", [0, 1, 7])
def test_stored_particles_inside_an_obstacle(tmp_path, inside):
    """They are noted with their number, for obstacles of any kind; an empty file is refused."""
    position_N3 = np.full((20, 3), 0.8, np.float32)
    position_N3[:inside] = (0.5, 0.3, 0.5)
    np.savez(tmp_path / "stored.npz", position=position_N3)
    trimesh.creation.box(extents=(0.3, 0.3, 0.3)).export(tmp_path / "box.ply")
    scene = "groups: [{particles: stored.npz, material: sand}]\n"
    for obstacle in (
        "{shape: cone, size: 0.3, position: [0.5, 0.3, 0.5]}",
        "{mesh: box.ply, position: [0.5, 0.3, 0.5]}",
    ):
        (tmp_path / "scene.yaml").write_text(scene + f"obstacles: [{obstacle}]\n")
        notes = notes_on_files(load_scene(tmp_path / "scene.yaml"))
        assert [note.partition(" lie")[0] for note in notes] == [f"{inside} of 20 particles of stored.npz"][
            : inside > 0
        ]
    np.savez(tmp_path / "stored.npz", position=position_N3[:0])
    with pytest.raises(ConfigError, match="position must be of one particle or more"):
        load_scene(tmp_path / "scene.yaml")
