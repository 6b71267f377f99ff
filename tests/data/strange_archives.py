"""NumPy archives that claim far more than they hold, or take far more time."""

import io
import pickle
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
        "a longer stream": scene_with(longer(zipped({"position": ((1, 3), "<f4", 400 * 2**20)}), 140)),
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


def raw_pickle(data, members=1):
    def on(folder):
        head = io.BytesIO()
        np.lib.format.write_array_header_1_0(head, {"descr": "|O", "fortran_order": False, "shape": (1,)})
        with zipfile.ZipFile(folder / "train.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            for number in range(members):
                content = head.getvalue() + (data() if callable(data) else data)
                archive.writestr(f"gns_data{number or ''}.npy", content)

    return on


TEXT, WALK = 600_000, np.full((9, 4, 3), 0.5, np.float32)
WHOLE = pickle.dumps(filled((WALK, np.full(4, 5))), protocol=4)


def copies(after=b""):
    """Twelve thousand arrays that have one text as their bytes, in the other byte order, and what follows on each."""
    kind = b"cnumpy\ndtype\nX\2\0\0\0i2K\0K\1\x87R(K\3X\1\0\0\0>NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\0tb"
    shape, text = b"K\1J" + struct.pack("<i", TEXT // 2) + b"\x85", b"B" + struct.pack("<I", TEXT) + bytes(TEXT)
    function, arguments = b"cnumpy.core.multiarray\n_reconstruct\n", b"cnumpy\nndarray\nK\0\x85C\1b\x87"
    parts = b"(" + shape + kind + b"\x89" + text + b"tq\0" + function + b"q\1" + arguments + b"q\2"
    return b"\x80\4" + parts + b"](" + 12_000 * (b"h\1h\2Rh\0b" + after) + b"e."


PICKLES = {
    "a key of tuples": raw_pickle(key_of_tuples()),
    "keys of one hash": raw_pickle(keys_of_one_hash()),
    "memo": raw_pickle(b"\x80\x02}r\xff\xff\xff\x7f."),
    "long bytes": raw_pickle(b"\x80\x04\x8e" + struct.pack("<Q", 10**11) + b"x."),
    "references": objects((laughing(), np.full(4, 5))),
    **{f"{len(parts)} parts": objects(tuple(parts)) for parts in ([laughing()], [laughing(), 1, 2, 3])},
    "references as a trajectory": objects(laughing()),
    "an array of references": objects(filled(laughing())),
    "operations": raw_pickle(lambda: b"\x80\2" + 31_000_000 * b"N0" + b"N."),
    "operations of many arrays": raw_pickle(lambda: b"\x80\4" + 1_000_000 * b"N0" + WHOLE[2:], members=30),
    "arrays of one text": raw_pickle(copies()),
    "unused arrays of one text": raw_pickle(copies(b"\x940")),
    "references to bytes": objects((WALK, 12_000 * [bytes(TEXT)])),
    "references to a text": objects((WALK, 3000 * [TEXT * "x"])),
    "references to an array": objects((12_000 * [np.zeros(TEXT)], 5)),
}
