"""Files of at most 1 MB that claim far more than they hold: weights, checkpoints, meshes and scenes."""

import json
import pickle
import struct
import zipfile

import torch
import trimesh
from safetensors.torch import save

from hgn.config import NetworkConfig
from hgn.runtime.weights import WeightsInfo, load_weights
from hgn.scene.mesh import load_mesh
from hgn.scene.obstacle_grid import build_obstacle_grid
from hgn.scene.scene_file import load_scene
from hgn.schema import to_mapping
from hgn.training.checkpoint import network_of_checkpoint, read_checkpoint

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


# weights and checkpoints


def weights(text=None, tensors=None, **network):
    info = to_mapping(WeightsInfo(NetworkConfig(width=8, levels=1, message_passing_steps=1), 60.0, 1 / 64))
    info["network"] |= network
    return saved("w.safetensors", save(tensors or {}, metadata={"hgn": text or json.dumps(info)}))


def many_tensors():
    return {f"t{number}": torch.zeros(1) for number in range(10_000)}


cases(
    "weights",
    {
        "wide": weights(width=65_536),
        "wide with tensors": weights(tensors=many_tensors(), width=65_536),
        "deep": weights(levels=1000, message_passing_steps=1000),
        "deep with tensors": weights(tensors=many_tensors(), levels=1000, message_passing_steps=1000),
        "long history": weights(velocity_history=1000, width=65_536),
        "gns": weights(kind="gns", levels=1, message_passing_steps=1000, width=65_536),
        "many materials": weights(materials=[f"m{number}" for number in range(50_000)]),
        "nested": weights(text=100_000 * "["),
        "long list": weights(text='{"format_version": 1, "network": [' + 150_000 * "[]," + "0]}"),
    },
    load_weights,
)


def checkpoint(content, compress=False):
    def make(folder):
        path = folder / "c.ckpt"
        torch.save(content() if callable(content) else content, path)
        return deflated(path) if compress else path

    return make


def deflated(path, pickled=None):
    """The archive with compressed records; `pickled` replaces data.pkl."""
    with zipfile.ZipFile(path) as archive:
        records = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED if pickled is None else zipfile.ZIP_STORED) as archive:
        for name, data in records.items():
            archive.writestr(name, pickled if pickled is not None and name.endswith("data.pkl") else data)
    return path


def pickled(data):
    return lambda folder: deflated(checkpoint({"hgn": {}})(folder), data)


def called(function, *arguments):
    """A pickle that calls a function."""

    class Call:
        def __reduce__(self):
            return function, arguments

    return pickle.dumps({"hgn": Call()}, protocol=2)


def section(**network):
    config = to_mapping(NetworkConfig(width=8, levels=1, message_passing_steps=1)) | network
    return {"hgn": {"network": config, "step": {}}, "state_dict": {}}


def laughing(depth=12, width=10):
    """A list of 10 to the 12 items, by references."""
    value = [1.0]
    for _ in range(depth):
        value = [value] * width
    return value


cases(
    "checkpoint",
    {
        "compressed": checkpoint({"hgn": {}, "state_dict": {"w": torch.zeros(50_000_000)}}, compress=True),
        "wide": checkpoint(section(width=65_536)),
        "deep": checkpoint(section(levels=1000, message_passing_steps=1000)),
        "references": checkpoint({"hgn": {"network": laughing()}, "state_dict": {}}),
        "references in the network": checkpoint(section(materials=laughing())),
        "expanded tensor": checkpoint(
            lambda: section() | {"state_dict": {"network.x": torch.zeros(1).expand(10**6, 10**6)}}
        ),
        "bytearray": pickled(called(bytearray, 10**11)),
        "memo": pickled(b"\x80\x02}r\xff\xff\xff\x7f."),
        "called storage": pickled(b"\x80\x02ctorch\nFloatStorage\n\x8a\x05\x00\xe8vH\x17\x85R."),
        "long text": pickled(b"\x80\x04\x8d" + struct.pack("<Q", 10**11) + b"x."),
    },
    lambda path: network_of_checkpoint(read_checkpoint(path), path),
)

# meshes


def glb(change):
    def make(folder):
        content = trimesh.creation.box().export(file_type="glb")
        length = struct.unpack("<I", content[12:16])[0]
        header = json.loads(content[20 : 20 + length])
        change(header)
        text = json.dumps(header).encode()
        text += b" " * (-len(text) % 4)
        rest = content[20 + length :]
        chunk = struct.pack("<II4s", 20 + len(text) + len(rest), len(text), b"JSON") + text + rest
        (folder / "m.glb").write_bytes(struct.pack("<4sI", b"glTF", 2) + chunk)
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


def instances(count):
    def change(header):
        header["nodes"] += [{"mesh": 0, "name": str(number)} for number in range(count)]
        header["scenes"][0]["nodes"] = list(range(len(header["nodes"])))

    return change


def cyclic(header):
    header["nodes"].append({"children": [0, len(header["nodes"])], "name": "self"})
    header["scenes"][0]["nodes"] = [len(header["nodes"]) - 1]


def repeated_primitives(header):
    header["meshes"][0]["primitives"] *= 5000


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


cases(
    "mesh",
    {
        "accessor without a view": glb(accessor(count=120_000_000, bufferView=None)),
        "accessor beyond its view": glb(accessor(count=120_000_000)),
        "sparse accessor": glb(sparse),
        "accessor of floats": glb(accessor(count=1e300)),
        "instances": glb(instances(19_000)),
        "instances by paths": glb(branching),
        "cycle": glb(cyclic),
        "primitives": glb(repeated_primitives),
        "stl": saved("m.stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(1000)),
        "text stl": saved("m.stl", b"solid a\n" + 15_000 * b"facet normal 0 0 1\nouter loop\nvertex 0 0 1\n"),
        "ply": ply(10**11),
        "binary ply": ply(10**11, "binary_little_endian", bytes(1000)),
        "ply with long lists": ply(3, "binary_little_endian", bytes(36) + b"\xff" + bytes(1000)),
        "ply of other elements": saved(
            "m.ply", b"ply\nformat binary_little_endian 1.0\nelement odd 100000000000\nproperty float x\nend_header\n"
        ),
        "obj of lines": saved("m.obj", b"v 0 0 0\n" + 200_000 * b"l 1\n"),
        "obj of polygons": saved("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + 80_000 * b"f 1 2 3 1\n"),
        "obj of one polygon": saved("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf" + 160_000 * b" 1 2 3"),
        "obj of groups": saved("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + 60_000 * b"o a\nf 1 2 3\n"),
        "obj of materials": saved("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + 40_000 * b"usemtl a\nf 1 2 3\n"),
        "obj index": saved("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 2000000000\n"),
    },
    load_mesh,
)


# scene files


def scene(text):
    return saved("s.yaml", text.encode())


GROUP = "groups:\n- {shape: cube, size: 0.1, position: [0.5, 0.5, 0.5], material: sand}\n"


def cells(path):
    """The obstacle cells of a scene, as all commands compute them."""
    loaded = load_scene(path)
    return build_obstacle_grid(loaded.obstacles, loaded.cell_size, loaded.seed, loaded.domain_size)


cases(
    "scene",
    {
        "large obstacle": scene(GROUP + "obstacles:\n- {shape: cone, size: 9000, position: [0.5, 0.2, 0.5]}\n"),
        "sheet of 9000": scene(GROUP + "obstacles:\n- {shape: square, size: 9000, position: [0.5, 0.2, 0.5]}\n"),
        "larger obstacle": scene(GROUP + "obstacles:\n- {shape: half_sphere, size: 9.0e+20, position: [0, 0.2, 0]}\n"),
        "small cells": scene(
            GROUP + "cell_size: 1.0e-7\nparticles_per_cell: 1.0e-20\n"
            "obstacles:\n- {shape: cone, size: 0.2, position: [0.5, 0.2, 0.5]}\n"
        ),
        "large domain": scene(
            GROUP + "domain_size: [9000, 9000, 9000]\nobstacles:\n- {shape: square, size: 9000, position: [1, 0, 1]}\n"
        ),
        "obstacles": scene(GROUP + "obstacles:\n" + 1000 * "- {shape: cone, size: 0.01, position: [0.1,0.1,0.1]}\n"),
        "groups": scene("groups:\n" + 1000 * "- {shape: cube, size: 0.001, position: [0.5,0.5,0.5], material: sand}\n"),
        "keyframes": scene(
            GROUP + "obstacles:\n- shape: cone\n  size: 0.1\n  position: [0.1, 0.1, 0.1]\n  keyframes:\n"
            + "".join(f"  - {{time: {number}}}\n" for number in range(3000))
        ),
        "long file": scene("groups: " + 990_000 * "a"),
        "long text": scene("groups: " + 240_000 * "a"),
        "deep flow": scene("groups: " + 240_000 * "["),
        "short lists": scene("groups: [" + 40_000 * "[]," + "]"),
        "anchors": scene("a: &a " + 100_000 * "[1]\n"),
    },
    cells,
)  # fmt: skip
