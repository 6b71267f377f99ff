"""Pickles and checkpoints of at most 1 MB that claim far more than they hold, or take far more time."""

import os
import pickle
import struct
import zipfile

import torch
from data.strange_files import cases

from hgn.config import NetworkConfig
from hgn.schema import to_mapping
from hgn.training.checkpoint import network_of_checkpoint, read_checkpoint


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


def deflated_many(path):
    """An archive of eight thousand records."""
    with zipfile.ZipFile(path, "w") as archive:
        for number in range(8000):
            archive.writestr(f"c/data/{number}", b"")
        archive.writestr("c/data.pkl", b"\x80\x02}.")
    return path


def pickled(data):
    return lambda folder: deflated(checkpoint({"hgn": {}})(folder), data)


def called(function, *arguments):
    """A pickle that calls a function."""

    class Call:
        def __reduce__(self):
            return function, arguments

    return pickle.dumps({"hgn": Call()}, protocol=2)


def key_of_tuples(value=b"K\1"):
    """A pickle of a dict with a key of 2^60 items, by references: its hash visits each of them."""
    pairs = b"".join(b"h%c\x86q%c" % (depth, depth + 1) for depth in range(60))
    return b"\x80\x02}(K\1\x85q\0" + pairs + value + b"u."


def keys_of_one_hash(tuples=False, called=False):
    """A pickle of a dict with 60,000 keys that have one hash: finding a place for each of them visits all others.
    It is a dict, or an OrderedDict that is made of pairs."""
    if tuples:  # the hash of CPython (xxHash), for pairs whose second number follows from the first
        first, second, other, wrap = 11400714785074694791, 14029467366897019727, 2870177450012600261, 1 << 64

        def after(state, lane):
            state = (state + lane * second) % wrap
            return ((state << 31 | state >> 33) * first) % wrap

        wanted, inverse, keys = after(after(other, 1), 1), pow(second, -1, wrap), []
        turned = wanted * pow(first, -1, wrap) % wrap
        turned = (turned >> 31 | turned << 33) % wrap
        for number in range(1, 240_000):
            lane = (turned - after(other, number)) * inverse % wrap
            lane -= wrap if lane >> 63 else 0
            if abs(lane) < 2**61 - 1:
                keys.append(pickled_integer(number) + pickled_integer(lane) + b"\x86")
    else:
        keys = [pickled_integer(number * (2**61 - 1)) for number in range(1, 60_000)]
    if called:
        pairs = b"".join(key + b"N\x86" for key in keys[:45_000])
        return b"\x80\x02ccollections\nOrderedDict\n](" + pairs + b"e\x85R."
    return b"\x80\x02}(" + b"".join(key + b"N" for key in keys[:60_000]) + b"u."


def pickled_integer(number):
    data = number.to_bytes((number.bit_length() + 8) // 8, "little", signed=True)
    return b"\x8a" + bytes([len(data)]) + data


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
        "compressed": checkpoint({"hgn": {}, "state_dict": {"w": torch.zeros(18_000_000)}}, compress=True),
        "wide": checkpoint(section(width=65_536)),
        "references": checkpoint({"hgn": {"network": laughing()}, "state_dict": {}}),
        "references in the network": checkpoint(section(materials=laughing())),
        "expanded tensor": checkpoint(
            lambda: section() | {"state_dict": {"network.x": torch.zeros(1).expand(10**6, 10**6)}}
        ),
        "bytearray": pickled(called(bytearray, 10**11)),
        "a key of tuples": pickled(key_of_tuples()),
        "keys of one hash": lambda folder: pickled(keys_of_one_hash())(folder),
        "tuples of one hash": lambda folder: pickled(keys_of_one_hash(tuples=True))(folder),
        "an ordered dict of pairs": lambda folder: pickled(keys_of_one_hash(tuples=True, called=True))(folder),
        "operations": lambda folder: pickled(b"\x80\2" + 1_000_000 * b"N0" + b"}.")(folder),
        "memo": pickled(b"\x80\x02}r\xff\xff\xff\x7f."),
        "called storage": pickled(b"\x80\x02ctorch\nFloatStorage\n\x8a\x05\x00\xe8vH\x17\x85R."),
        "pipe": lambda folder: (os.mkfifo(folder / "c.ckpt"), folder / "c.ckpt")[1],
        "empty section": checkpoint({"hgn": {}, "state_dict": {}}),
        "nested lists": pickled(b"\x80\x02" + 100_000 * b"]" + 99_999 * b"a" + b"."),
        "many records": lambda folder: deflated_many(folder / "c.ckpt"),
        "long text": pickled(b"\x80\x04\x8d" + struct.pack("<Q", 10**11) + b"x."),
    },
    lambda path: network_of_checkpoint(read_checkpoint(path), path),
)
