"""Files of at most 12 MB that claim far more than they hold: weights, meshes and scenes."""

import functools
import json
import math
import os
import struct

import numpy as np
import torch
from safetensors.torch import save
from scene.test_glb import box_with

from hgn.config import NetworkConfig
from hgn.render.renderer import Stage, smooth_normals
from hgn.runtime.weights import WeightsInfo, load_weights
from hgn.scene.mesh import load_mesh
from hgn.scene.scene import Obstacle
from hgn.schema import to_mapping

CASES = {}


def case(function):
    CASES[function.__name__.replace("_", " ")] = function
    return function


def cases(kind, inputs, decode):
    """Several files of one kind: names, and functions from a folder to the file in it."""
    for name, make in inputs.items():
        CASES[f"{kind}: {name}"] = lambda folder, make=make: decode(make(folder))


def saved(name, content):
    def make(folder):
        path = folder / name
        path.write_bytes(content() if callable(content) else content)
        return path

    return make


# weights


def weights(text=None, tensors=None, **network):
    info = to_mapping(WeightsInfo(NetworkConfig(width=8, levels=1, message_passing_steps=1), 60.0, 1 / 64))
    info["network"] |= network
    return saved(
        "w.safetensors", lambda: save(tensors() if tensors else {}, metadata={"hgn": text or json.dumps(info)})
    )


ENDLESS = b'{"a": {"dtype": "F32", "shape": [0, 18446744073709551615, 2], "data_offsets": [0, 0]}}'
cases(
    "weights",
    {
        "wide": weights(width=65_536),
        "deep with tensors": weights(
            tensors=lambda: {f"t{number}": torch.zeros(1) for number in range(10_000)},
            levels=1000,
            message_passing_steps=1000,
        ),
        "gns": weights(kind="gns", levels=1, message_passing_steps=1000, width=65_536),
        "a shape of 2^64": saved("w.safetensors", struct.pack("<Q", len(ENDLESS)) + ENDLESS),
        "nested": weights(text=100_000 * "["),
        "digits": weights(text='{"format_version": ' + 100_000 * "9" + "}"),
        "a long head": saved("w.safetensors", struct.pack("<Q", 2**62) + b"{}" + bytes(1000)),
        "no head": saved("w.safetensors", struct.pack("<Q", 900_000) + 900_000 * b"["),
        "rate": weights(
            text=json.dumps(to_mapping(WeightsInfo(NetworkConfig(), 60.0, 1 / 64)) | {"frame_rate_hz": 1e308})
        ),
        "long list": weights(text='{"format_version": 1, "network": [' + 150_000 * "[]," + "0]}"),
    },
    load_weights,
)


# meshes


def glb(change):
    def make(folder):
        (folder / "m.glb").write_bytes(box_with(change))
        return folder / "m.glb"

    return make


def accessor(**values):
    def change(header):
        for entry in header["accessors"]:
            entry.update(values)
            if values.get("bufferView", 0) is None:
                del entry["bufferView"]

    return change


def sparse(header):
    header["accessors"][0] |= {"count": 120_000_000, "sparse": {"count": 1, "indices": {}, "values": {}}}
    del header["accessors"][0]["bufferView"]


def stride_0(header):
    for view in header["bufferViews"]:
        view["byteStride"] = 0
    accessor(count=100_000_000)(header)


def targets(header):
    """Thirty thousand morph targets that are all the mesh itself."""
    primitive = header["meshes"][0]["primitives"][0]
    primitive["targets"] = [{"POSITION": primitive["attributes"]["POSITION"]}] * 30_000
    header["meshes"][0]["weights"] = [1e-9] * 30_000


def sparse_instances(header):
    """Forty nodes of a million instances, none of which is in the file."""
    count = len(header["accessors"])
    value = {"componentType": 5126, "count": 10**6, "type": "VEC3", "sparse": {"count": 0, "indices": {}, "values": {}}}
    value["sparse"] |= {"indices": {"bufferView": 0, "componentType": 5125}, "values": {"bufferView": 0}}
    header["accessors"].append(value)
    attributes = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": count, "SCALE": count}}}
    header["nodes"] += [{"mesh": 0, "extensions": attributes}] * 40
    header["scenes"][0]["nodes"] = list(range(len(header["nodes"])))


def star(count):
    """The lines of one polygon, every other corner of which is concave."""
    corners = [(index / count * 2 * math.pi, 1 + index % 2) for index in range(count)]
    points = "".join(f"v {radius * math.cos(a):.4f} {radius * math.sin(a):.4f} 0\n" for a, radius in corners)
    return f"{points}f {' '.join(map(str, range(1, count + 1)))}\n".encode()


def large_view(header):
    """Five thousand primitives, all of them in one view of 60 MB."""
    position = header["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    header["meshes"][0]["primitives"] = 5000 * [{"mode": 5, "attributes": {"POSITION": position}}]
    view = {"buffer": 0, "byteOffset": 4, "byteLength": 60 << 20}
    header |= {
        "buffers": [{"uri": "m.bin", "byteLength": 61 << 20}],
        "bufferViews": len(header["bufferViews"]) * [view],
    }


def alike_buffers(header):
    """Ninety buffers, all of them one file of 60 MB."""
    header["meshes"][0]["primitives"] = [{"attributes": {"POSITION": i}} for i in range(90)]
    header["accessors"] = [{"bufferView": i, "componentType": 5126, "count": 3, "type": "VEC3"} for i in range(90)]
    header["buffers"] = 90 * [{"uri": "m.bin", "byteLength": 60 << 20}]
    header |= {"bufferViews": [{"buffer": i, "byteLength": 36} for i in range(90)]}


def far(folder, size):
    """A file of 1.2 GB beside the mesh, without blocks on the disk, and the size that a buffer of it claims."""
    os.truncate(saved("m.bin", b"")(folder), 1_200_000_000)
    return glb(lambda header: header["buffers"][0].update(uri="m.bin", byteLength=size))(folder)


def long_strip(folder):
    """A strip of 60 million triangles, whose indices are a file without blocks on the disk."""
    os.truncate(saved("m.bin", b"")(folder), 60_000_000)

    def change(header):
        strip = {"bufferView": len(header["bufferViews"]), "componentType": 5121, "count": 60_000_000, "type": "SCALAR"}
        header["meshes"][0]["primitives"][0] |= {"mode": 5, "indices": len(header["accessors"])}
        header["bufferViews"].append({"buffer": len(header["buffers"]), "byteLength": 60_000_000})
        header["buffers"].append({"uri": "m.bin", "byteLength": 60_000_000})
        header["accessors"].append(strip)

    return glb(change)(folder)


def empty_primitives(header):
    """Primitives without vertices: 3 * 10^8 of them, by nodes."""
    header["accessors"].append({"bufferView": 0, "componentType": 5126, "count": 0, "type": "VEC3"})
    header["meshes"] = [{"primitives": [{"attributes": {"POSITION": len(header["accessors"]) - 1}}] * 8000}]
    instances(30_000)(header)


def no_instances(header):
    """Nodes with 6 * 10^4 primitives of 4 * 10^5 vertices, in no place."""
    count, views = len(header["accessors"]), len(header["bufferViews"])
    header["bufferViews"].append({"buffer": 1, "byteLength": 1_200_000})
    header["buffers"].append({"uri": "m.bin", "byteLength": 1_200_000})
    places = {"bufferView": 0, "componentType": 5126, "count": 0, "type": "VEC3"}
    header["accessors"] += [places, {"bufferView": views, "componentType": 5121, "count": 399_999, "type": "VEC3"}]
    header["meshes"] = [{"primitives": [{"attributes": {"POSITION": count + 1}}] * 6000}]
    instancing = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": count}}}
    header["nodes"] = [{"mesh": 0, "extensions": instancing}] * 10
    header["scenes"][0]["nodes"] = list(range(10))


@functools.cache
def spiral(count):
    """The lines of one polygon, most of whose ears contain another corner."""
    turns = [(index, 1.0) for index in range(count)] + [(index, 1.1) for index in reversed(range(count))]
    places = [((first + 0.02 * index) * np.exp(0.06j * index)) for index, first in turns]
    lines = "".join(f"v {place.real} {place.imag} 0\n" for place in places)
    return f"{lines}f {' '.join(map(str, range(1, 2 * count + 1)))}\n".encode()


def instances(count):
    def change(header):
        header["nodes"] += [{"mesh": 0, "name": str(number)} for number in range(count)]
        header["scenes"][0]["nodes"] = list(range(len(header["nodes"])))

    return change


def repeated_primitives(header):
    header["meshes"][0]["primitives"] *= 1500


def branching(header):
    """Nodes that have two parents each: 2^20 paths."""
    first = len(header["nodes"])
    header["nodes"] += [{"children": [first + number + 1] * 2, "name": f"b{number}"} for number in range(20)]
    header["nodes"].append({"mesh": 0, "name": "leaf"})
    header["scenes"][0]["nodes"] = [first]


def ply(count, kind="ascii", body=b""):
    head = f"ply\nformat {kind} 1.0\nelement vertex {count}\nproperty float x\nproperty float y\nproperty float z\n"
    head += f"element face {count}\nproperty list uchar int vertex_indices\nend_header\n"
    return saved("m.ply", head.encode() + body)


CORNERS = b"vertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
SHORT_LISTS = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 20000\n" + 50 * b"property list uchar uchar vertex_indices\n" + b"end_header\n"
    + np.eye(3, dtype=np.float32).tobytes() + 50 * b"\3\0\1\2" + 19_999 * (b"\1\0" + bytes(49))
)  # fmt: skip

NEGATIVE_LISTS = (
    b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 300000000\nproperty list char int vertex_indices\nend_header\n0 0 0 1 0 0 0 1 0\n-1 0 1 2\n"
)


def empty_lists():
    """Twelve million faces without vertices, a byte each."""
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n"
    head += b"property float x\nproperty float y\nproperty float z\nelement face 12000000\n"
    head += b"property list uchar int vertex_indices\nend_header\n"
    return head + np.eye(3, dtype=np.float32).tobytes() + bytes(12_000_000)


def cloud():
    """An STL file of 30,000 triangles, all near the origin except one, so that most corners are neighbours."""
    facets = np.zeros(30_000, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    facets["corners"] = 2e-5 * np.random.default_rng(0).random((len(facets), 3, 3), np.float32)
    facets["corners"][0] += 1
    return bytes(80) + struct.pack("<I", len(facets)) + facets.tobytes()


cases(
    "mesh",
    {
        "accessor without a view": glb(accessor(count=120_000_000, bufferView=None)),
        "accessor beyond its view": glb(accessor(count=120_000_000)),
        "sparse accessor": glb(sparse),
        "a long strip": long_strip,
        "accessor of floats": glb(accessor(count=1e300)),
        "instances": glb(instances(1_500)),
        "instances by paths": glb(branching),
        "primitives": glb(repeated_primitives),
        "empty primitives": glb(empty_primitives),
        "no instances": lambda folder: saved("m.bin", bytes(1_200_000))(folder) and glb(no_instances)(folder),
        "weights": glb(lambda header: (targets(header), header["meshes"][0].update(weights=[1e308] * 2))),
        "stride 0": glb(stride_0),
        "large view": lambda folder: saved("m.bin", bytes(64 << 20))(folder) and glb(large_view)(folder),
        "alike buffers": lambda folder: saved("m.bin", bytes(60 << 20))(folder) and glb(alike_buffers)(folder),
        **{f"{size} bytes of a file": lambda folder, size=size: far(folder, size) for size in (1000, 1_200_000_000)},
        "long name of a file": glb(lambda header: header["buffers"][0].update(uri=2_000_000 * "=a:b@")),
        "long tree": glb(lambda header: header.update(x=6_000_000 * [[]])),
        "targets": glb(targets),
        "sparse instances": glb(sparse_instances),
        "long names": glb(lambda header: header.update(extensionsRequired=[f"x{n}" for n in range(100_000)])),
        "no buffers": glb(lambda header: header.pop("buffers")),
        "no such buffer": glb(lambda header: header["bufferViews"][0].update(buffer=-7)),
        "views that are text": glb(lambda header: header.update(bufferViews="abc")),
        "nodes that are numbers": glb(lambda header: header.update(nodes=[1, 2, None])),
        "a matrix of text": glb(lambda header: header["nodes"][0].update(matrix=["x"] * 16)),
        "a tree that is a list": saved("m.glb", b"glTF\2\0\0\0\x18\0\0\0\4\0\0\0JSON[  ]"),
        "stl": saved("m.stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(1000)),
        "text stl": saved("m.stl", b"solid a\n" + 15_000 * b"facet normal 0 0 1\nouter loop\nvertex 0 0 1\n"),
        "stl of solids": saved("m.stl", 9000 * (b"solid\nfacet normal 0 0 1\nouter loop\n" + CORNERS + b"endsolid\n")),
        "ply": ply(10**11),
        "ply of short lists": saved("m.ply", SHORT_LISTS),
        "ply of negative lists": saved("m.ply", NEGATIVE_LISTS),
        "ply of empty lists": saved("m.ply", empty_lists),
        "cloud of triangles": saved("m.stl", cloud),
        "binary ply": ply(10**11, "binary_little_endian", bytes(1000)),
        "ply with long lists": ply(3, "binary_little_endian", bytes(36) + b"\xff" + bytes(1000)),
        "ply of a star": saved(
            "m.ply",
            b"ply\nformat binary_little_endian 1.0\nelement vertex 60000\nproperty float x\nproperty float y\n"
            b"property float z\nelement face 1\nproperty list uint uint vertex_indices\nend_header\n"
            + np.random.default_rng(0).random((60_000, 3), np.float32).tobytes()
            + np.array([60_000, *range(60_000)], np.uint32).tobytes(),
        ),
        "ply of a long list": saved(
            "m.ply",
            b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
            b"property float z\nelement face 1\nproperty list uint uint vertex_indices\nend_header\n"
            + bytes(36)
            + b"\xff\xff\xff\x7f"
            + bytes(1000),
        ),
        "ply of many properties": saved(
            "m.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n" + 40_000 * b"property float x\n" + b"end_header\n"
        ),
        "ply of other elements": saved(
            "m.ply", b"ply\nformat binary_little_endian 1.0\nelement odd 100000000000\nproperty float x\nend_header\n"
        ),
        "obj of lines": saved("m.obj", b"v 0 0 0\n" + 100_000 * b"l 1\n"),
        "obj of polygons": saved("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + 25_000 * b"f 1 2 3 1\n"),
        "obj of pentagons": saved(
            "m.obj", b"v 0 0 0\nv 9 0 0\nv 1 1 0\nv 0 9 0\nv -9 5 0\n" + 82_000 * b"f 1 2 3 4 5\n"
        ),
        "obj of a spiral": saved("m.obj", lambda: spiral(990)),
        "obj of materials": saved(
            "m.obj",
            lambda: b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + b"".join(b"usemtl %d\nf 1 2 3\n" % n for n in range(45_000)),
        ),
        "obj of one polygon": saved("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf" + 20_000 * b" 1 2 3"),
        "obj of a star": saved("m.obj", lambda: star(30_000)),
        "obj of stars": saved(
            "m.obj", lambda: star(300) + 700 * (b"f " + b" ".join(b"%d" % (i + 1) for i in range(300)) + b"\n")
        ),
        "obj of large numbers": saved("m.obj", b"v " + 900_000 * b"1" + b" 0 0\nf 1 1 1\n"),
        "obj of groups": saved("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + 20_000 * b"o a\nf 1 2 3\n"),
        "obj index": saved("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 2000000000\n"),
    },
    load_mesh,
)


def fan(_):
    """The corners of 30,000 triangles, all of which meet at one place."""
    angle = np.linspace(0, 6, 30_001)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return np.stack([0 * ring[1:], ring[:-1], ring[1:]], axis=1)


def large_triangles(count):
    """Triangles on one another that fill a picture."""
    obstacle = Obstacle("large", 4 * np.eye(3) - 1, np.tile(np.int32([[0, 1, 2]]), (count, 1)), closed=False)
    return lambda _: [obstacle]


cases("picture", {"fan": fan}, smooth_normals)
cases(
    "picture",
    {f"{count} large triangles": large_triangles(count) for count in (50, 30_000)},
    lambda obstacles: Stage((1.0, 1.0, 1.0), obstacles, 0.01, 180),
)
