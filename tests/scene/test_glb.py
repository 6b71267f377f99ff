"""GLB files: all core features that shape triangles are read, all others refused by name."""

import base64
import json
import struct

import numpy as np
import pytest
import trimesh

from hgn.scene.distance import contains
from hgn.scene.mesh import load_bodies, load_mesh
from hgn.schema import ConfigError

CUBE = trimesh.creation.box(bounds=((0, 0, 0), (1, 1, 1)))
QUAD = np.array([(0, 2, 0), (1, 2, 0), (1, 2, 1), (0, 2, 1)], np.float32)


def glb_bytes(tree, data):
    """A GLB file of a header and its numbers."""
    chunks = b""
    for kind, pad, content in ((b"JSON", b" ", json.dumps(tree).encode()), (b"BIN\0", b"\0", data)):
        content += pad * (-len(content) % 4)
        chunks += struct.pack("<I4s", len(content), kind) + content
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def box_with(change):
    """A box as GLB, whose header is changed."""
    content = trimesh.creation.box().export(file_type="glb")
    end = 20 + int.from_bytes(content[12:16], "little")
    change(tree := json.loads(content[20:end]))
    return glb_bytes(tree, content[end + 8 :])


class Glb:
    """Writes a GLB file from arrays."""

    def __init__(self):
        self.data = b""
        self.tree = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], "meshes": [], "nodes": []}

    def view(self, array):
        self.data += b"\0" * (-len(self.data) % 4)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes})
        self.data += array.tobytes()
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, array, **more):
        codes = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[1 if array.ndim == 1 else array.shape[1]]
        entry = {"bufferView": self.view(array), "componentType": codes[array.dtype.name], "count": len(array)}
        self.tree["accessors"].append(entry | {"type": kind} | more)
        return len(self.tree["accessors"]) - 1

    def primitive(self, position, indices=None, **more):
        result = {"attributes": {"POSITION": self.accessor(np.asarray(position, np.float32))}} | more
        return result if indices is None else result | {"indices": self.accessor(np.asarray(indices, np.uint16))}

    def add(self, *primitives, **node):
        self.tree["meshes"].append({"primitives": list(primitives)})
        self.tree["nodes"].append({"mesh": len(self.tree["meshes"]) - 1} | node)

    def cube(self, **node):
        self.add(self.primitive(CUBE.vertices, CUBE.faces.reshape(-1)), **node)

    def save(self, path, **more):
        tree = self.tree | {"buffers": [{"byteLength": len(self.data)}], "scenes": [{"nodes": self.roots()}]} | more
        path.write_bytes(glb_bytes(tree, self.data))
        return path

    def roots(self):
        children = {child for node in self.tree["nodes"] for child in node.get("children", ())}
        return [i for i in range(len(self.tree["nodes"])) if i not in children]


def volume_of(bodies):
    return sum(abs(trimesh.Trimesh(body.vertex_V3, body.triangle_F3, process=False).volume) for body in bodies)


@pytest.mark.parametrize(
    ("mode", "indices"), [(5, None), (5, [0, 1, 3, 2]), (6, None), (6, [0, 1, 2, 3]), (4, [0, 1, 2, 2, 3, 0])]
)
def test_strips_and_fans(tmp_path, mode, indices):
    """A square beside a cube, as triangles, a strip and a fan, with indices and without; points and lines are no
    surface, and are left out."""
    file = Glb()
    file.add(*(file.primitive(QUAD, mode=none) for none in (0, 1, 2, 3)))
    file.cube()
    file.add(file.primitive(QUAD if mode != 5 or indices else QUAD[[0, 1, 3, 2]], indices, mode=mode))
    solid, sheet = load_bodies(file.save(tmp_path / "a.glb"))
    assert (solid.closed, len(solid.triangle_F3)) == (True, 12)
    flat = trimesh.Trimesh(sheet.vertex_V3, sheet.triangle_F3, process=False)
    assert not sheet.closed and flat.area == pytest.approx(1) and len(flat.faces) == 2


def test_instances(tmp_path):
    """Places, turns and scales of instances follow those of their node."""
    file = Glb()
    attributes = {
        "TRANSLATION": file.accessor(np.array([(0, 0, 0), (3, 0, 0), (0, 0, 5)], np.float32)),
        "ROTATION": file.accessor(np.array([(0, 0, 0, 1)] * 2 + [(0, 0, np.sqrt(0.5), np.sqrt(0.5))], np.float32)),
        "SCALE": file.accessor(np.array([(1, 1, 1), (1, 1, 1), (1, 2, 1)], np.float32)),
    }
    file.cube(scale=[2, 2, 2], extensions={"EXT_mesh_gpu_instancing": {"attributes": attributes}})
    file.save(tmp_path / "a.glb", extensionsUsed=["EXT_mesh_gpu_instancing"])
    bodies = load_bodies(tmp_path / "a.glb")
    assert volume_of(bodies) == pytest.approx(8 * (1 + 1 + 2))
    points = np.array([(7, 1, 1), (-3.5, 1, 11), (1, 1, 5), (-3.5, 1, 1)])
    assert contains(points, bodies[0]).tolist() == [True, True, False, False]


def test_nodes_in_nodes(tmp_path):
    """A matrix, and the parts of one, of a parent and its child."""
    file = Glb()
    file.cube(translation=[1, 0, 0])
    matrix = np.array([[2, 0, 0, 10], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]).T.reshape(-1).tolist()
    file.tree["nodes"].append({"matrix": matrix, "children": [0]})
    (body,) = load_bodies(file.save(tmp_path / "a.glb"))
    assert body.vertex_V3.min(0).tolist() == [12, 0, 0] and body.vertex_V3.max(0).tolist() == [14, 2, 2]


@pytest.mark.parametrize(("visible", "shown"), [(True, 3), (False, 1), (None, 3)])
@pytest.mark.parametrize("required", [True, False])
def test_invisible_nodes(tmp_path, visible, shown, required):
    """Nodes that are not visible are no obstacles, and neither are their children and instances."""
    file, name = Glb(), "KHR_node_visibility"
    file.cube()
    file.cube(translation=[5, 0, 0], extensions={name: {} if visible is None else {"visible": visible}}, children=[2])
    file.cube(translation=[0, 5, 0])
    path = file.save(tmp_path / "a.glb", extensionsUsed=[name], extensionsRequired=[name] * required)
    assert volume_of(load_bodies(path)) == pytest.approx(shown)


@pytest.mark.parametrize("dtype", [np.int8, np.uint8, np.int16, np.uint16])
def test_quantised_positions(tmp_path, dtype):
    """Normalised integers become fractions, and other integers keep their values."""
    file = Glb()
    largest = np.iinfo(dtype).max
    padded = np.zeros((8, 4), dtype)
    padded[:, :3] = largest * CUBE.vertices
    view = file.view(padded)
    file.tree["bufferViews"][view]["byteStride"] = padded.strides[0]
    codes = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123}
    entry = {"bufferView": view, "componentType": codes[np.dtype(dtype).name], "count": 8, "type": "VEC3"}
    indices = file.accessor(CUBE.faces.reshape(-1).astype(np.uint8))
    for more in ({"normalized": True}, {}):
        file.tree["accessors"].append(entry | more)
        place = len(file.tree["accessors"]) - 1
        file.add({"attributes": {"POSITION": place}, "indices": indices})
    file.save(tmp_path / "a.glb", extensionsRequired=["KHR_mesh_quantization"])
    assert volume_of(load_bodies(tmp_path / "a.glb")) == pytest.approx(1 + float(largest) ** 3)


def test_sparse_and_morphed_positions(tmp_path):
    """Replaced values of an accessor, with data of its own and without, and a morph target with its weight."""
    file = Glb()
    raised = CUBE.vertices[:, 1] > 0.5
    index = np.flatnonzero(raised).astype(np.uint16)
    primitive = file.primitive(CUBE.vertices, CUBE.faces.reshape(-1))
    values = {"bufferView": file.view((CUBE.vertices[raised] * (1, 3, 1)).astype(np.float32))}
    sparse = {"count": len(index), "indices": {"bufferView": file.view(index), "componentType": 5123}, "values": values}
    file.tree["accessors"][primitive["attributes"]["POSITION"]]["sparse"] = sparse
    file.add(primitive)
    moved = {"bufferView": file.view(np.tile(np.float32([0, 1, 0]), (len(index), 1)))}
    target = {"componentType": 5126, "count": 8, "type": "VEC3", "sparse": sparse | {"values": moved}}
    file.tree["accessors"].append(target)
    place = len(file.tree["accessors"]) - 1
    file.add(file.primitive(np.add(CUBE.vertices, (5, 0, 0)), CUBE.faces.reshape(-1)))
    file.tree["meshes"][1]["primitives"][0]["targets"] = [{"POSITION": place}]
    file.tree["meshes"][1]["weights"] = [0.5]
    assert volume_of(load_bodies(file.save(tmp_path / "a.glb"))) == pytest.approx(3 + 1.5)


def test_buffers_elsewhere(tmp_path):
    """In a file beside, with a name in percent signs, and in the address itself; not outside of the folder."""
    file = Glb()
    file.cube()
    (tmp_path / "own folder").mkdir()
    (tmp_path / "own folder" / "a b.bin").write_bytes(file.data)
    (tmp_path / "secret.bin").write_bytes(file.data)
    inline = "data:application/octet-stream;base64," + base64.b64encode(file.data).decode()
    for uri, fits in (("a%20b.bin", True), (inline, True), ("../secret.bin", False), ("none.bin", False)):
        path = file.save(tmp_path / "own folder" / "a.glb", buffers=[{"byteLength": len(file.data), "uri": uri}])
        if fits:
            assert len(load_mesh(path).triangle_F3) == 12
        else:
            with pytest.raises(ConfigError, match="is not a file in its folder"):
                load_mesh(path)


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "VENDOR_geometry"])
def test_required_extensions_that_are_not_read(tmp_path, name):
    """Each is named; those of materials, textures and lights do not matter."""
    file = Glb()
    file.cube()
    with pytest.raises(ConfigError, match=f"it requires {name}, which is not read"):
        load_mesh(file.save(tmp_path / "a.glb", extensionsRequired=["KHR_materials_unlit", name]))
    neutral = ["KHR_materials_unlit", "KHR_texture_basisu", "EXT_texture_webp", "KHR_lights_punctual"]
    assert load_mesh(file.save(tmp_path / "a.glb", extensionsRequired=neutral)).closed


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression"])
def test_compressed_data_without_the_requirement(tmp_path, name):
    """A cube, and a part whose data is only in an extension: refused by name."""
    file = Glb()
    file.cube()
    file.tree["accessors"].append({"componentType": 5126, "count": 8, "type": "VEC3"})
    if name == "EXT_meshopt_compression":
        file.tree["bufferViews"].append({"buffer": 1, "byteLength": 96, "extensions": {name: {}}})
        file.tree["accessors"][-1]["bufferView"] = len(file.tree["bufferViews"]) - 1
    file.add({"attributes": {"POSITION": len(file.tree["accessors"]) - 1}, "extensions": {name: {}}})
    buffers = [{"byteLength": len(file.data)}, {"byteLength": 96}]
    with pytest.raises(ConfigError, match=f"has no data; the file uses {name}"):
        load_mesh(file.save(tmp_path / "a.glb", extensionsUsed=[name], buffers=buffers))


def test_glb_that_lies(tmp_path):
    """Indices and accessors beyond the data, loops of nodes, skins, other versions and unknown modes and types end in
    one line."""

    def broken(change):
        file = Glb()
        file.cube()
        tree = file.tree | {"buffers": [{"byteLength": len(file.data)}]}
        change(tree)
        file.tree = tree
        return file.save(tmp_path / "a.glb", buffers=tree["buffers"])

    def loop(tree):
        tree["nodes"] = [{"mesh": 0}, {"children": [0, 0]}]

    def part(tree, **changes):
        tree["meshes"][0]["primitives"][0].update(changes)

    def morphed(tree, **changes):
        tree["accessors"].append(tree["accessors"][0] | changes)
        part(tree, targets=[{"POSITION": len(tree["accessors"]) - 1}])
        tree["meshes"][0]["weights"] = [1.0]

    # of the type of an index, whose first one lies in the file's last bytes: -1
    minus_one = {"count": 1, "indices": {"bufferView": 0, "componentType": 5122}, "values": {"bufferView": 0}}

    changes = [
        (lambda tree: tree["accessors"][0].update(count=10**9), "readable GLB"),
        (lambda tree: tree["accessors"][0].update(count=4), "vertex 7 of a primitive with 4"),
        (lambda tree: tree["accessors"][0].update(byteOffset=-4), "readable GLB"),
        (lambda tree: tree["nodes"][0].update(mesh=-1), "an entry has the index -1"),
        (lambda tree: tree["nodes"].append({"children": [-1]}), "an entry has the index -1"),
        (lambda tree: tree["bufferViews"][0].update(byteOffset=10**12), "readable GLB"),
        *(
            (lambda tree, kind=kind, name=name, size=size: tree[kind][0].update({name: size}), "that are not whole")
            for kind, name in (
                ("accessors", "count"),
                ("accessors", "byteOffset"),
                ("bufferViews", "byteLength"),
                ("bufferViews", "byteOffset"),
                ("bufferViews", "byteStride"),
                ("buffers", "byteLength"),
            )
            for size in (-1, 1.5, 8.0, "8")
        ),
        *(
            (lambda tree, k=k, n=n: tree["nodes"][0].update({k: n}), f"node 0 has {k} .*, not a list of")
            for k, values in {
                "translation": (None, 2.0, [5.0], [1, 2, 3, 4], ["1", 0, 0], [[1, 0, 0], [2, 0, 0]], [True, 0, 0]),
                "rotation": ([[0, 0, 0, 1]], [0, 0, 1]),
                "scale": ([[1, 1, 1]], [2]),
                "matrix": (np.eye(4).tolist(), 15 * [0.0]),
                "weights": ([[1, 2, 3]], "ab", None),
            }.items()
            for n in values
        ),
        (lambda tree: tree["meshes"][0].update(weights=[[1]]), "mesh 0 has weights .*, not a list of any numbers"),
        *(
            (lambda tree, n=n: tree["asset"].update(version=n), f"it needs glTF {n}, but only 2.0 is supported")
            for n in ("1.0", "3.0", 1)
        ),
        (lambda tree: morphed(tree, count=4), "primitive 0 of mesh 0 has a target of 4 vertices, not 8"),
        (lambda tree: morphed(tree, sparse=minus_one), "Cannot cast array data from dtype.'int16'"),
        (lambda tree: tree["nodes"][0].update(skin=0), "node 0 has a skin"),
        (loop, "node 0 has two parents"),
        (lambda tree: tree["asset"].update(minVersion="2.1"), "it needs glTF 2.1, but only 2.0 is supported"),
        *((lambda tree, mode=mode: part(tree, mode=mode), "primitive 0 of mesh 0 has mode") for mode in (7, -1, "4")),
        (lambda tree: part(tree, attributes={}), "primitive 0 of mesh 0 has no POSITION"),
        *(
            (lambda tree, i=i, more=more: tree["accessors"][i].update(more), f"primitive 0 of mesh 0 has {name}, not")
            for i, more, name in (
                (0, {"type": "VEC2"}, "POSITION of type VEC2 with components 5126"),
                (0, {"componentType": 5130}, "POSITION of type VEC3 with components 5130"),
                (1, {"type": "VEC3", "count": 12}, "indices of type VEC3 with components 5123"),
                (1, {"componentType": 5126, "count": 18}, "indices of type SCALAR with components 5126"),
            )
        ),
    ]
    for change, message in changes:
        path = broken(change)
        with pytest.raises(ConfigError, match=message):
            load_mesh(path)
    path.write_bytes(path.read_bytes().replace(b'"scenes"', b'"meshes"'))
    with pytest.raises(ConfigError, match="the key meshes is given twice"):
        load_mesh(path)
