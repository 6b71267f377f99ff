"""Files that claim far more than they hold: rollouts, particles, imports and manifests."""

import json
import os
import struct
import tarfile
import zlib

import h5py
import numpy as np
from data.foreign_writers import metadata, write
from data.strange_archives import BOMB, PICKLES, zipped
from data.strange_files import cases, saved
from data.test_index import shard
from scene.test_rollout_file import array, attribute, make_rollout, turned

from hgn.data.foreign.dataset import import_set
from hgn.data.foreign.settings import ImportConfig
from hgn.data.foreign.tfrecord import masked_crc
from hgn.data.identity import identity_hash
from hgn.data.manifest import Manifest
from hgn.data.shard import locate_members
from hgn.scene.rollout_file import read_rollout, write_rollout

# HDF5 and NumPy archives


def rollout(change):
    def make(folder):
        path = folder / "r.vtkhdf"
        write_rollout(path, make_rollout())
        with h5py.File(path, "r+") as file:
            change(file)
        return path

    return make


def claimed(name, shape, dtype):
    """A dataset of this shape, none of whose chunks was ever written."""

    def change(file):
        del file[name]
        file.create_dataset(name, shape, dtype, chunks=tuple(min(length, 64) for length in shape))

    return change


def links(file):
    """Groups that contain the next one a dozen times: 12^8 paths."""
    group = file
    for level in range(8):
        following = file.create_group(f"level{level}")
        for number in range(12):
            group[f"n{number}"] = following
        group = following


def chunked(file):
    """One number in a chunk of 2 GB."""
    del file["00000/position"]
    options = {"maxshape": (None,), "chunks": (500_000_000,), "compression": "gzip"}
    file.create_dataset("00000/position", (1,), "f4", **options)


def packed(megabytes, filters, count=64, chunks=1):
    """A dataset of numbers in chunks of 64 numbers, or `count`, each of which expands to megabytes of zeros."""

    def change(file):
        plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plan.set_chunk((count,))
        for _ in range(filters):
            plan.set_deflate(9)
        space = h5py.h5s.create_simple((count * chunks,))
        h5py.h5d.create(file["00000"].id, b"x", h5py.h5t.NATIVE_INT8, space, plan)
        content = zeros(megabytes)
        for _ in range(filters - 1):
            content = zlib.compress(content)
        for number in range(chunks):
            file["00000/x"].id.write_direct_chunk((number * count,), content)

    return change


def shared(path, count=250_000):
    """Two hundred datasets whose chunks are all one place of the file, which expands to 220 megabytes."""
    with h5py.File(path, "r+") as file:
        chunks = []
        for number in range(200):
            packed(0 if number else 220, 1, count)(file)
            chunks.append(file["00000/x"].id.get_chunk_info(0))
            file.move("00000/x", f"00000/x{number}")
    content, first = path.read_bytes(), chunks[0]
    for chunk in chunks[1:]:
        old, new = (struct.pack("<IIQQQ", one.size, 0, 0, 0, one.byte_offset) for one in (chunk, first))
        assert content.count(old) == 1
        content = content.replace(old, new)
    path.write_bytes(content)


def zeros(megabytes):
    """Zeros, compressed a thousandfold: the block of one megabyte, repeated, and the Adler-32 sum of zeros."""
    packer = zlib.compressobj(9, wbits=-15)
    block = packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH)
    return b"\x78\xda" + megabytes * block + b"\3\0" + struct.pack(">HH", megabytes * 2**20 % 65521, 1)


def filtered(name, code, values=()):
    """The dataset with a filter, whose code trusts the numbers in the file."""

    def change(file):
        value = file.pop(name)[()].astype(np.int32)
        plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plan.set_chunk(value.shape)
        plan.set_filter(code, h5py.h5z.FLAG_OPTIONAL, values)
        space = h5py.h5s.create_simple(value.shape)
        h5py.Dataset(h5py.h5d.create(file.id, name.encode(), h5py.h5t.NATIVE_INT32, space, plan))[...] = value

    return change


def crumbs(file):
    """A dataset of 60 million chunks of one number, none of which was written."""
    file.create_dataset("00000/x", (60_000_000,), "u1", chunks=(1,))


def external(file):
    """A dataset whose numbers are another file's bytes, and a link to another file."""
    del file["hgn/source"]
    file.create_dataset("hgn/source", (1,), "S64", external=[("/etc/hostname", 0, 64)])
    file["hgn/elsewhere"] = h5py.ExternalLink("/proc/self/mem", "/")


def soft(file):
    """A dataset's name that leads to itself, through another."""
    del file["hgn/source"]
    file["hgn/source"], file["hgn/other"] = h5py.SoftLink("/hgn/other"), h5py.SoftLink("/hgn/source")


def attributes(file):
    for number in range(600):
        file["hgn"].attrs[f"a{number}"] = "x" * 100


def loop(file):
    file["hgn/self"] = file["hgn"]


def replaced(name, value):
    return lambda file: (file.pop(name), file.create_dataset(name, data=value, compression="gzip"))


def linked_obstacles(file):
    group = file["hgn/obstacles"]
    one = group["0000"]
    replaced("vertices", np.zeros((60_000, 3)))(one)
    for number in range(2000):
        group[f"n{number}"] = one


def frames(count, particles, vertices=0):
    """Frames of particles that never enter, and of vertices."""

    def change(file):
        for name, value in {
            "VTKHDF/NumberOfPoints": np.full(count, 7),
            "VTKHDF/PointData/material": np.zeros(particles + vertices, np.uint8),
            "VTKHDF/Vertices/Connectivity": np.zeros(particles, np.int64),
        }.items():
            replaced(name, value)(file)
        file.create_dataset("hgn/entry_frame", data=np.full(particles, 10**6))

    return change


cases(
    "rollout",
    {
        "points": rollout(claimed("VTKHDF/Points", (10**10, 3), "f4")),
        **{
            f"place at {x!r}": rollout(array("VTKHDF/Points", np.full((56, 3), x)))
            for x in (np.float32(1e38), np.inf, 1e300)
        },
        "far reference": rollout(array("hgn/reference", np.full((3, 7, 3), 1e300))),
        "complex rotations": rollout(turned(np.eye(3)[None] + 0j)),
        "complex rate": rollout(attribute("frame_rate_hz", 60 + 0j)),
        "materials": rollout(claimed("VTKHDF/PointData/material", (10**11,), "u1")),
        "vertices": rollout(claimed("hgn/obstacles/0000/vertices", (10**10, 3), "f8")),
        "counts": rollout(claimed("VTKHDF/NumberOfPoints", (10**10,), "i8")),
        "reference": rollout(claimed("hgn/reference", (10**4, 10**6, 3), "f4")),
        "text": rollout(claimed("hgn/source", (10**10,), "S64")),
        "hard links": rollout(links),
        "other files": rollout(external),
        "soft links": rollout(soft),
        "attributes": rollout(attributes),
        "loop": rollout(loop),
        "linked obstacles": rollout(linked_obstacles),
        "frames of nobody": rollout(frames(100_000, 100_000)),
        "frames of vertices": rollout(frames(60, 0, 40_000_000)),
        "frames of few particles": rollout(frames(100_000, 1, 30_000)),
        "scale and offset": rollout(filtered("VTKHDF/PointData/material", h5py.h5z.FILTER_SCALEOFFSET, (2, 4))),
        "bits": rollout(filtered("VTKHDF/Vertices/Connectivity", h5py.h5z.FILTER_NBIT)),
        "a filter of others": rollout(filtered("VTKHDF/Vertices/Connectivity", 32015)),
        "triangles": rollout(replaced("hgn/obstacles/0000/triangles", np.tile(np.int32([0, 1, 2]), (5_000_000, 1)))),
    },
    read_rollout,
)


def imported(name, change=lambda folder: None, **changes):
    def make(folder):
        walk = 0.5 + 0.001 * np.random.default_rng(0).random((9, 4, 3)).astype(np.float32)
        walls = np.random.default_rng(1).uniform(0.1, 0.9, (6, 3)).astype(np.float32)
        source = write(folder / "foreign", name, {"train": [(walk, np.full(4, 5), walls)] * 2}, metadata(write_every=1))
        (source / "metadata.json").write_text(json.dumps(json.loads((source / "metadata.json").read_text()) | changes))
        change(source)
        return source

    return make


def h5(name, change):
    def on(folder):
        with h5py.File(folder / name, "r+") as file:
            change(file)

    return on


def tfrecords(folder):
    """A record that claims 2^40 bytes, under a checksum that holds."""
    length = struct.pack("<Q", 2**40)
    (folder / "train.tfrecord").write_bytes(length + struct.pack("<I", masked_crc(length)) + bytes(1000))


def crowded(file):
    """A wall of 20,000 particles at one place."""
    del file["boundary"]
    file["boundary"] = np.full((9, 20_000 // 9, 3), 0.25, np.float32)


cases(
    "import",
    {
        "position": imported("lagrangebench", h5("train.h5", claimed("00000/position", (10**4, 10**6, 3), "f4"))),
        "large chunks": imported("lagrangebench", h5("train.h5", chunked)),
        "compressed twice": imported("lagrangebench", h5("train.h5", packed(4000, 2))),
        "compressed to more": imported("lagrangebench", h5("train.h5", packed(900, 1))),
        "compressed to far more": imported("lagrangebench", h5("train.h5", packed(9000, 1, 10_000_000))),
        "compressed to more by chunks": imported("lagrangebench", h5("train.h5", packed(220, 1, 250_000, 4))),
        "chunks of one place": imported("lagrangebench", lambda folder: shared(folder / "train.h5")),
        "scale and offset": imported(
            "lagrangebench", h5("train.h5", filtered("00001/particle_type", h5py.h5z.FILTER_SCALEOFFSET, (2, 4)))
        ),
        "small chunks": imported("lagrangebench", h5("train.h5", crumbs)),
        "wide cells": imported("lagrangebench", obstacle_cell_size=1e300),
        "tiny cells": imported("lagrangebench", obstacle_cell_size=5e-324),
        "pipe": imported("neuralmpm", lambda folder: os.mkfifo(folder / "train" / "sim_00.h5")),
        "types": imported("lagrangebench", h5("train.h5", claimed("00001/particle_type", (10**11,), "i4"))),
        "links": imported("lagrangebench", h5("train.h5", links)),
        "particles": imported("neuralmpm", h5("train/sim_0.h5", claimed("particles", (10**4, 10**6, 6), "f4"))),
        "crowd": imported("neuralmpm", h5("train/sim_0.h5", crowded)),
        "npz": imported("plain", zipped({"a/position": ((9, BOMB // 108, 3), "<f4", BOMB)})),
        "object claim": imported("geoelements", zipped({"gns_data": ((10**10,), "|O", 0)})),
        **{name: imported("geoelements", change) for name, change in PICKLES.items()},
        "sequence length": imported("deepmind", sequence_length=10**30),
        "repeated key": imported(
            "plain",
            lambda folder: (folder / "metadata.json").write_text('{"a": 1, "a": 2, "b": [' + 240_000 * "[], " + "0]}"),
        ),
        "records": imported("deepmind", tfrecords),
        "nested metadata": imported(
            "plain", lambda folder: (folder / "metadata.json").write_text(300_000 * "[" + 300_000 * "]")
        ),
        "tiny radius": imported("plain", default_connectivity_radius=5e-324),
        "tiny step": imported("plain", dt=5e-324),
        "bounds": imported("plain", bounds=[[0, 1e300]] * 3, default_connectivity_radius=1e296),
    },
    lambda source: import_set(source, ImportConfig(out=str(source.parent / "out"), gravity=(0.0, -9.8, 0.0))),
)

# shards


def tar_headers(kind, count, size=b"00000000001", content=bytes(512)):
    """Headers of one kind, with a content each."""
    head = b"a".ljust(100, b"\0") + b"0000644\0" + b"0000000\0" * 2 + size + b"\0" + b"0" * 11 + b"\0"
    head += b" " * 8 + kind + bytes(355)
    return saved("a.tar", count * (head[:148] + f"{sum(head):06o}\0 ".encode() + head[156:] + content) + bytes(1024))


def pax(name, value):
    """One file, whose head has a number that is none."""

    def make(folder):
        with tarfile.open(folder / "a.tar", "w", format=tarfile.PAX_FORMAT) as tar:
            info = tarfile.TarInfo("a.json")
            info.pax_headers = {name: value}
            tar.addfile(info)
        return folder / "a.tar"

    return make


cases(
    "tar",
    {
        "long names": tar_headers(b"L", 900),
        "a long name": tar_headers(b"L", 1, b"77777777777"),
        "pax heads": tar_headers(b"x", 900),
        "digits of a head": tar_headers(b"x", 1, b"%011o" % 900_096, 900_096 * b"9"),
        "a large head": tar_headers(b"x", 1, b"77777777777"),
        **{
            f"{name} of a head": pax(name, value)
            for name, value in {"size": str(2**62), "GNU.sparse.map": "0,x", "GNU.sparse.size": "x"}.items()
        },
        "a large number": tar_headers(b"0", 1, b"\x80" + b"\x7f" * 10),
        "sparse files": tar_headers(b"S", 900, b"77777777777"),
        "links": tar_headers(b"2", 900),
        "a name twice": tar_headers(b"0", 2),
    },
    lambda path: [*locate_members(path)],
)

# manifests


def manifest(head=None, **changes):
    def make(folder):
        Manifest(identity_hash({}), {}, {"train": 1}, 1).save(folder, [shard(0)])
        path = folder / "manifest.json"
        stored = json.loads(path.read_text())
        if head is not None:
            head(stored)
        path.write_text(json.dumps(stored | changes))
        return folder

    return make


def totals(**values):
    def change(stored):
        stored["totals"]["train"] |= values
        if "shards" in values:
            stored["index"]["shards"] = values["shards"]

    return change


def state(**values):
    return lambda stored: stored["index"].update(values)


def listing(**values):
    """A data set whose index has other values in its line."""

    def make(folder):
        manifest()(folder)
        path, head = folder / "index" / "1-000000.jsonl", json.loads((folder / "manifest.json").read_text())
        line = json.dumps(json.loads(path.read_text()) | values) + "\n"
        path.write_text(line)
        head["index"]["segment_bytes"] = len(line)
        (folder / "manifest.json").write_text(json.dumps(head))
        return folder

    return make


EPISODE = {"key": "a", "index": 0, "seed": 0, "attempt": 0, "frames": 6, "members": {}}


def used(folder):
    """What a training does first."""
    from hgn.data.reader import EpisodeStore

    store = EpisodeStore(folder, "train")
    store.frames()
    store.particles([0])
    return list(store.entries), store.manifest.quarantined


def piped(name, device=None):
    """A pipe in the place of a file, or a device without an end."""

    def make(folder):
        Manifest(identity_hash({}), {}, {"train": 1}, 1).save(folder, [shard(0)])
        (path,) = folder.rglob(name)
        path.unlink()
        path.symlink_to(device) if device else os.mkfifo(path)
        return folder

    return make


cases(
    "manifest",
    {
        "pipe": piped("manifest.json"),
        "pipe of the index": piped("*-000000.jsonl"),
        "device": piped("manifest.json", "/dev/zero"),
        "device of the index": piped("*-000000.jsonl", "/dev/zero"),
        "episodes": manifest(totals(episodes=10**12), config={"frames": 6}, config_hash=identity_hash({"frames": 6})),
        "shards": manifest(totals(episodes=10**12, shards=10**12)),
        "bytes of a segment": manifest(state(segment_bytes=10**12)),
        "bytes of the table": manifest(lambda head: (totals(shards=1000)(head), state(table_bytes=10**12)(head))),
        "bytes of the quarantine": manifest(state(quarantine_bytes=10**12, quarantined=10**12)),
        "range": listing(stop=10**11),
        **{
            f"{count} particles": listing(episodes=[EPISODE | {"particles": count}]) for count in (2**40, -(2**40))
        },
        "negative range": listing(first=2**62, stop=-(2**62)),
        "control characters": listing(name="\x1b[31m.tar"),
        "nesting": saved("manifest.json", 400_000 * b"["),
        "config": manifest(config={"a": [[]] * 30_000}),
        "infinite config": lambda folder: (
            path := manifest(config={"a": 1})(folder) / "manifest.json",
            path.write_text(path.read_text().replace('"a": 1', '"a": 1e400')),
        )[0],
    },
    lambda folder: used(folder if folder.is_dir() else folder.parent),
)  # fmt: skip
