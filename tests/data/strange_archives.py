"""NumPy archives that claim far more than they hold, or take far more time."""

import io
import struct
import zipfile
import zlib

import numpy as np
from data.strange_files import cases
from data.strange_pickles import key_of_tuples, keys_of_one_hash, laughing

from hgn.scene.scene_file import load_scene


def zipped(members, name="train.npz"):
    """An archive of arrays of zeros, from their shapes."""

    def make(folder):
        with zipfile.ZipFile(folder / name, "w", zipfile.ZIP_DEFLATED) as archive:
            for member, (shape, dtype, held) in members.items():
                head = io.BytesIO()
                np.lib.format.write_array_header_1_0(head, {"descr": dtype, "fortran_order": False, "shape": shape})
                with archive.open(f"{member}.npy", "w", force_zip64=True) as file:
                    file.write(head.getvalue())
                    for _ in range(held // 2**20):
                        file.write(bytes(2**20))
        return folder / name

    return make


def longer(make, size):
    """The archive, whose one member claims only its first `size` bytes."""

    def on(folder):
        path = make(folder)
        with zipfile.ZipFile(path) as archive:
            (member,) = archive.infolist()
            with archive.open(member) as file:
                crc = zlib.crc32(file.read(size))
        data = path.read_bytes().replace(struct.pack("<I", member.CRC), struct.pack("<I", crc))
        path.write_bytes(data.replace(struct.pack("<I", member.file_size), struct.pack("<I", size)))
        return path

    return on


def scene_with(particles):
    def make(folder):
        particles(folder)
        path = folder / "s.yaml"
        path.write_text("groups:\n- {particles: train.npz, material: sand}\n")
        return path

    return make


BOMB = 80 * 2**20
cases(
    "particles",
    {
        "bomb": scene_with(zipped({"position": ((BOMB // 12, 3), "<f4", BOMB)})),
        "bomb beside": scene_with(zipped({"other": ((BOMB // 12, 3), "<f4", BOMB)})),
        "claim": scene_with(zipped({"position": ((10**10, 3), "<f4", 2**20)})),
        "no axis": scene_with(zipped({"position": ((10**18, 0, 3), "<f4", 0)})),
        "wide text": scene_with(zipped({"position": ((1,), "<U1000000000", 2**20)})),
        "many": scene_with(zipped({f"a{number}": ((2**18,), "<f4", 2**20) for number in range(70)})),
        "a longer stream": scene_with(longer(zipped({"position": ((1, 3), "<f4", 700 * 2**20)}), 140)),
    },
    load_scene,
)


def filled(value):
    """An array of one object."""
    array = np.empty(1, object)
    array[0] = value
    return array


def objects(value):
    """A pickled array that refers to a value."""
    return lambda folder: np.savez(folder / "train.npz", gns_data=filled(value))


def raw_pickle(data):
    def on(folder):
        head = io.BytesIO()
        np.lib.format.write_array_header_1_0(head, {"descr": "|O", "fortran_order": False, "shape": (1,)})
        with zipfile.ZipFile(folder / "train.npz", "w") as archive:
            archive.writestr("gns_data.npy", head.getvalue() + data)

    return on


PICKLES = {
    "a key of tuples": raw_pickle(key_of_tuples()),
    "keys of one hash": raw_pickle(keys_of_one_hash()),
    "memo": raw_pickle(b"\x80\x02}r\xff\xff\xff\x7f."),
    "long bytes": raw_pickle(b"\x80\x04\x8e" + struct.pack("<Q", 10**11) + b"x."),
    "references": objects((laughing(), np.full(4, 5))),
    **{f"{len(parts)} parts": objects(tuple(parts)) for parts in ([laughing()], [laughing(), 1, 2, 3])},
    "references as a trajectory": objects(laughing()),
    "an array of references": objects(filled(laughing())),
}
