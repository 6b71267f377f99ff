"""TFRecord files of tf.SequenceExample messages, read without TensorFlow.

A record consists of its length (uint64), the length's masked CRC-32C, the bytes, and their masked CRC-32C
(tensorflow.org/tutorials/load_data/tfrecord). A message consists of fields with a number, a wire type and a value
(protobuf.dev/programming-guides/encoding). These parts of tensorflow/core/example/*.proto are read:

    SequenceExample {Features context = 1; FeatureLists feature_lists = 2}
    Features {map<string, Feature> feature = 1}    FeatureLists {map<string, FeatureList> feature_list = 1}
    FeatureList {repeated Feature feature = 1}     Feature {BytesList bytes_list = 1}    BytesList {repeated bytes = 1}
"""

import struct
from collections.abc import Iterator
from pathlib import Path

from hgn.schema import ConfigError
from hgn.system.files import errors_name

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def read_records(path: Path) -> Iterator[bytes]:
    """Yields the records of a file. Raises: ConfigError naming an incomplete or altered record."""
    with errors_name(path), path.open("rb") as file:
        number, size = 0, path.stat().st_size
        while head := file.read(12):
            name = f"{path}: record {number}"
            if len(head) < 12:
                raise ConfigError(f"{name}: length must have 12 bytes, got {len(head)}: file truncated")
            (length,) = struct.unpack("<Q", head[:8])
            _require_crc(f"{name}: length", head[:8], head[8:])
            if length > size - file.tell() - 4:
                raise ConfigError(f"{name}: data must have {length} bytes, got {size - file.tell()}: file truncated")
            data = file.read(length)
            _require_crc(f"{name}: data", data, file.read(4))
            yield data
            number += 1


def masked_crc(data: bytes) -> int:
    """Returns the CRC-32C, rotated and shifted as TFRecord defines it."""
    import google_crc32c  # an extra package that only TFRecords need

    crc = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def _require_crc(name: str, data: bytes, stored: bytes) -> None:
    actual, expected = masked_crc(data), int.from_bytes(stored, "little")
    if actual != expected:
        raise ConfigError(f"{name} must have CRC {expected:#010x}, got {actual:#010x}: it was altered; fetch it again")


def parse_sequence_example(data: bytes, name: str) -> tuple[dict[str, list[bytes]], dict[str, list[bytes]]]:
    """Returns the byte values of a message by key: those of its context, and those of its feature lists, joined.

    Features with numbers have no values here. Raises: ConfigError if it is not such a message.
    """
    try:
        context: dict[str, list[bytes]] = {}
        lists: dict[str, list[bytes]] = {}
        for number, part in _fields(data):
            for inner, entry in _fields(part):
                if inner != 1:
                    continue
                pair = dict(_fields(entry))
                key = pair.get(1, b"").decode()
                value = pair.get(2, b"")
                if number == 1:
                    context[key] = _bytes_values(value)
                elif number == 2:
                    lists[key] = [
                        item for index, feature in _fields(value) if index == 1 for item in _bytes_values(feature)
                    ]
    except (ValueError, IndexError) as error:
        raise ConfigError(f"{name} must be a tf.SequenceExample, got {error}") from None
    return context, lists


def _bytes_values(feature: bytes) -> list[bytes]:
    return [item for number, values in _fields(feature) if number == 1 for index, item in _fields(values) if index == 1]


def _fields(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yields numbers and contents of a message's byte fields. Fields with numbers are skipped."""
    place = 0
    while place < len(data):
        tag, place = _varint(data, place)
        kind = tag & 7
        if kind == _BYTES:
            length, place = _varint(data, place)
            if length > len(data) - place:
                raise ValueError(f"a field of {length} bytes with {len(data) - place} left")
            yield tag >> 3, data[place : place + length]
            place += length
        elif kind == _VARINT:
            _, place = _varint(data, place)
        elif kind in (_FIXED64, _FIXED32):
            place += 8 if kind == _FIXED64 else 4
            if place > len(data):
                raise ValueError("a truncated number")
        else:
            raise ValueError(f"a field of wire type {kind}")


def _varint(data: bytes, place: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        byte = data[place]
        place += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, place
    raise ValueError("a number of more than ten bytes")
