"""Trajectories in the formats of other programs, written with other libraries than they are read with."""

import json
import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from tensorboard.summary.writer.record_writer import RecordWriter

Simulation = tuple[np.ndarray, np.ndarray, np.ndarray]  # position [T, N, D], type [N], boundary at rest [P, D]
Splits = Mapping[str, Sequence[Simulation]]
KINEMATIC = {"lagrangebench": 1}  # types of the boundary; of all others 3


def metadata(dimensions=3, **changes):
    """Of this project's own data."""
    bounds = [[0.0, 1.0]] * dimensions
    return {"bounds": bounds, "dim": dimensions, "dt": 1 / 60, "default_connectivity_radius": 0.035} | changes


def write(folder, name, splits, info):
    """A folder in a format; `plain_h5` and `geoelements_list` are the other kinds of plain and geoelements."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "metadata.json").write_text(json.dumps(info))
    for split, simulations in splits.items():
        _WRITERS[name](folder, split, [_joined(name, *simulation) for simulation in simulations], simulations)
    return folder


def _joined(name, position_TND, type_N, boundary_PD):
    """The boundary's particles first, as one trajectory with the others."""
    still = np.repeat(boundary_PD[None], len(position_TND), axis=0)
    kinds = np.full(len(boundary_PD), KINEMATIC.get(name, 3))
    return np.concatenate([still, position_TND], axis=1, dtype=np.float32), np.concatenate([kinds, type_N])


def sequence_example(position_TND, type_N, key):
    """A serialised tf.SequenceExample as DeepMind's: a bytes value a frame."""
    message = _message_class()()
    message.context.feature["key"].int64_list.value.append(key)
    message.context.feature["particle_type"].bytes_list.value.append(type_N.astype("<i8").tobytes())
    for position_ND in position_TND:
        feature = message.feature_lists.feature_list["position"].feature.add()
        feature.bytes_list.value.append(position_ND.astype("<f4").tobytes())
    data: bytes = message.SerializeToString()
    return data


def _deepmind(folder, split, joined, _):
    with (folder / f"{split}.tfrecord").open("wb") as file:
        writer = RecordWriter(file)
        for key, (position_TND, type_N) in enumerate(joined):
            writer.write(sequence_example(position_TND, type_N, key))
        writer.flush()
    path = folder / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"sequence_length": len(joined[0][0]) - 1}))


def _geoelements(folder, split, joined, _):
    data = np.empty(len(joined), object)
    data[:] = [(position, types.astype(np.int64)) for position, types in joined]
    np.savez_compressed(folder / f"{split}.npz", gns_data=data)


def _geoelements_list(folder, split, joined, _):
    members = {}
    for number, (position, types) in enumerate(joined):
        entry = np.empty(3, object)
        entry[:] = [position, types, np.full(len(types), 0.5)]
        members[f"simulation_{number}"] = entry
    np.savez(folder / f"{split}.npz", **members)


def _hdf5(folder, split, joined, _):
    with h5py.File(folder / f"{split}.h5", "w") as file:
        for number, (position, types) in enumerate(joined):
            file[f"{number:05d}/position"] = position
            file[f"{number:05d}/particle_type"] = types.astype(np.int32)


def _plain(folder, split, joined, _):
    members = {}
    for number, (position, types) in enumerate(joined):
        members |= {f"{number:05d}/position": position, f"{number:05d}/particle_type": types}
    np.savez(folder / f"{split}.npz", **members)


def _neuralmpm(folder, split, _, simulations):
    (folder / split).mkdir()
    for number, (position, types, boundary) in enumerate(simulations):
        with h5py.File(folder / split / f"sim_{number}.h5", "w") as file:
            file["particles"] = np.concatenate([position, np.zeros_like(position)], axis=-1)  # velocities behind
            file["boundary"] = np.repeat(boundary[None], len(position), axis=0).astype(np.float32)
            file["types"] = types


_WRITERS = {
    "deepmind": _deepmind,
    "geoelements": _geoelements,
    "geoelements_list": _geoelements_list,
    "lagrangebench": _hdf5,
    "neuralmpm": _neuralmpm,
    "plain": _plain,
    "plain_h5": _hdf5,
}


class Hostile:
    """An object whose pickle runs code where it is loaded in the usual way."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


def pickled_npz(path, content):
    """An archive whose one array is the pickle of anything."""
    data = np.empty(1, object)
    data[0] = content
    assert pickle.dumps(data)
    np.savez(path, gns_data=data)


_MESSAGES = {  # label, name, number and type of each field; * repeats, and an entry is that of a map
    "BytesList": "*value 1 BYTES",
    "Int64List": "*value 1 INT64",
    "Feature": "bytes_list 1 BytesList, int64_list 3 Int64List",
    "Features": "*feature 1 Features.FeatureEntry",
    "Features.FeatureEntry": "key 1 STRING, value 2 Feature",
    "FeatureList": "*feature 1 Feature",
    "FeatureLists": "*feature_list 1 FeatureLists.FeatureListEntry",
    "FeatureLists.FeatureListEntry": "key 1 STRING, value 2 FeatureList",
    "SequenceExample": "context 1 Features, feature_lists 2 FeatureLists",
}


def _message_class():
    """tf.SequenceExample from its published definition (tensorflow/core/example/{example,feature}.proto)."""
    field = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="example.proto", package="tensorflow", syntax="proto3")
    made = {}
    for name, fields in _MESSAGES.items():
        owner, _, entry = name.rpartition(".")
        made[name] = made[owner].nested_type.add(name=entry) if owner else file.message_type.add(name=name)
        made[name].options.map_entry = bool(owner)
        for label, number, kind in (words.split() for words in fields.split(", ")):
            many = field.LABEL_REPEATED if label[0] == "*" else field.LABEL_OPTIONAL
            options = {"name": label.lstrip("*"), "number": int(number), "label": many}
            if kind.isupper():
                made[name].field.add(type=field.Type.Value(f"TYPE_{kind}"), **options)
            else:
                made[name].field.add(type=field.TYPE_MESSAGE, type_name=f".tensorflow.{kind}", **options)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("tensorflow.SequenceExample"))
