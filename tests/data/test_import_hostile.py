"""Files of other programs that are damaged, malformed or hostile: refused by the name of file and field."""

import json
import os
import warnings
import zipfile

import h5py
import numpy as np
import pytest
from data.foreign_writers import Hostile, metadata, pickled_npz, sequence_example, write
from data.test_import import TYPES, options
from tensorboard.summary.writer.record_writer import RecordWriter

from hgn import import_trajectories
from hgn.data.foreign.formats import find_format, set_info
from hgn.data.foreign.settings import ImportConfig
from hgn.data.foreign.tfrecord import read_records
from hgn.schema import ConfigError


def flip(place):
    """Changes a byte of train.tfrecord."""

    def change(folder):
        data = bytearray((folder / "train.tfrecord").read_bytes())
        data[place] ^= 1
        (folder / "train.tfrecord").write_bytes(data)

    return change


def cut(name, size):
    return lambda folder: os.truncate(folder / name, size)


def meta(**changes):
    def change(folder):
        path = folder / "metadata.json"
        kept = json.loads(path.read_text()) | changes
        path.write_text(json.dumps({key: value for key, value in kept.items() if value is not None}))

    return change


def hdf5(name, key, value=None):
    """Puts another array in the place of one, or takes it away."""

    def change(folder):
        with h5py.File(folder / name, "a") as file:
            old = file[key][()]
            del file[key]
            if value is not None:
                file[key] = value(old)

    return change


def rewrite(folder, **changes):
    """Puts other arrays into train.npz: functions of those that are there, or new ones."""
    with np.load(folder / "train.npz") as archive:
        members = dict(archive)
    for key, value in changes.items():
        members[key] = value(members[key]) if callable(value) else value
    np.savez(folder / "train.npz", **members)


def npz(key, value):
    return lambda folder: rewrite(folder, **{key: value})


def with_nan(array):
    array = array.copy()
    array[3, 1, 1] = np.nan
    return array


def moving(array):
    return array + 0.01 * np.arange(len(array), dtype=np.float32)[:, None, None]


def claimed(folder):
    """Returns a file of few bytes whose header claims 7 TiB."""
    with h5py.File(folder / "train.h5", "a") as file:
        del file["00000/position"]
        file.create_dataset("00000/position", (10**6, 10**6, 2), "f4", chunks=(1, 1000, 2))


def partly_written(folder):
    """Positions of which one frame was written before the program ended."""
    with h5py.File(folder / "train.h5", "a") as file:
        old = file["00000/position"][()]
        del file["00000/position"]
        file.create_dataset("00000/position", old.shape, "f4", chunks=(1, *old.shape[1:]))[0] = old[0]


def cells(cell, length=1.0):
    """Obstacle cells of the plain layout."""

    def change(folder):
        meta(obstacle_cell_size=1 / 64)(folder)
        normal = np.tile(np.array([[0, length, 0]], np.float32), (len(cell), 1))
        rewrite(folder, **{"00001/obstacle_cell": np.array(cell), "00001/obstacle_normal": normal})

    return change


def with_step_context(folder):
    """Appends an empty list of this name to each record."""
    records = list(read_records(folder / "train.tfrecord"))
    with (folder / "train.tfrecord").open("wb") as file:
        for data in records:
            RecordWriter(file).write(data + b"\x12\x12\x0a\x10\x0a\x0cstep_context\x12\0")


def twice(folder):
    """An archive with two arrays of one name."""
    with zipfile.ZipFile(folder / "train.npz", "a") as archive, warnings.catch_warnings(action="ignore"):
        archive.writestr("00000/position.npy", archive.read("00001/position.npy"))


def at_the_side(folder):
    meta(periodic_boundary_conditions=[True] * 3)(folder)
    hdf5("train.h5", "00000/position", lambda a: a - np.array([0.48, 0, 0], np.float32))(folder)


WALK = np.zeros((9, 2, 3))


def text(content):
    """Other metadata."""
    return lambda folder: (folder / "metadata.json").write_text(content)


def other_objects(content):
    return lambda folder: np.savez(folder / "train.npz", arr_0=np.array(content))


def pickled(content):
    return lambda folder: pickled_npz(folder / "train.npz", content(folder))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("deepmind", flip(0), r"train.tfrecord: record 0: length must have CRC .*: it was altered"),
        ("deepmind", flip(200), r"train.tfrecord: record 0: data must have CRC .*: it was altered"),
        ("deepmind", cut("train.tfrecord", 300), r"record 0: data must have \d+ bytes, .*: file truncated"),
        ("deepmind", cut("train.tfrecord", 5), r"record 0: length must have 12 bytes, got 5: file truncated"),
        ("deepmind", meta(sequence_length=3), r"record 0: position must have \d+ numbers for sequence_length \+ 1"),
        ("deepmind", meta(sequence_length=None), r"metadata.json: sequence_length must be a whole number, got None"),
        ("deepmind", meta(bounds=None), r"bounds must be given if .*metadata.json does not contain it"),
        ("deepmind", meta(bounds=[[0, 0.2]] * 3), r"bounds must contain the particles, got .* of .*record"),
        ("plain", meta(bounds=[[0, 1]] * 2, dim=None, gravity=[0, -1, 0]), "2 finite numbers, one for each axis of b"),
        ("deepmind", meta(dt="soon"), r"metadata.json: dt must be a finite number, got 'soon'"),
        ("deepmind", meta(dim=2.5), r"metadata.json: dim must be 2 or 3, got 2.5"),
        ("deepmind", meta(bounds=[[0, 1], [0, 1], [0, float("inf")]]), r"bounds must be finite numbers in pairs"),
        ("deepmind", meta(default_connectivity_radius=1e-12), r"radius must .*, got 1e-12; correct .* bounds"),
        *(("deepmind", text(one), r"metadata.json must be JSON") for one in ("[" * 9**6, '{"a": 010}', '{"a": 1:30}')),
        ("plain", text('{"a": 1,\n "b": [[0]],\n "a": 5}'), "the key a is given twice"),
        ("plain", text('{"a": 3,\n\t"b": {\n\t"c": 1,\n\t"c": 2}}'), "must be JSON, got the key c is given twice"),
        ("lagrangebench", meta(periodic_boundary_conditions="no"), r"conditions must be finite numbers in a list"),
        ("lagrangebench", meta(write_every=0), r"metadata.json: write_every must be > 0, got 0.0"),
        ("lagrangebench", hdf5("train.h5", "00000/particle_type", lambda a: 0 * a - 1), r"position must be of part"),
        ("lagrangebench", claimed, r"train.h5: /00000/position must keep the content within"),
        ("lagrangebench", partly_written, "train.h5: /00000/position must be written as a whole, got 1 of 9 chunks"),
        ("plain", npz("00000/gravity", np.array([0, 1e14, 0])), "00000: gravity must be at most .*, one box per"),
        ("plain", meta(g_ext_magnitude=-9.8), "metadata.json: g_ext_magnitude must be >= 0, got -9.8"),
        ("plain", meta(dt=1e-10), "dt must be a finite number > 0, from 1e-09 to 1e.09, got 1e-10"),
        ("plain", meta(obstacle_cell_size=0), r"metadata.json: obstacle_cell_size must be from 1.53e-05 .*got 0.0"),
        ("plain", meta(materials=["water"]), r"metadata.json: materials must be names by number, got \['water'\]"),
        ("plain", meta(materials={"1": "Wa ter"}), r"materials must be names of lower-case letters.*got 'Wa ter'"),
        *(("plain", meta(boundary_types=[n]), "boundary_types must be whole numbers, at") for n in (3.5, 1e300)),
        ("plain", meta(boundary_types="none"), r"metadata.json: boundary_types must be finite numbers in a list"),
        ("plain", cells([[2, 2, 2]] * 2), r"00001: obstacle_cell must be unique, got '1 repeated'"),
        ("plain", cells([[1 << 40, 2, 2]]), r"00001: obstacle_cell must be cells inside the box"),
        ("plain", cells([[2, 2, 2]], 5.0), r"00001: obstacle_normal must be of length 1, got 5"),
        ("deepmind", meta(dt=-1), r"metadata.json: dt must be a finite number > 0, .*, got -1"),
        ("deepmind", meta(context_mean=[0.0]), r"context_mean must be absent, got a set with step_context"),
        ("deepmind", meta(dim=2), r"metadata.json: bounds must be \[low, high\] for each of 2 axes"),
        ("geoelements", cut("train.npz", 400), r"train.npz must be a complete NumPy archive"),
        ("geoelements", pickled(lambda folder: Hostile(folder / "ran")), r"gns_data must be .*not part of an array"),
        ("geoelements", pickled(lambda _: (np.zeros((9, 2, 3)),)), r"gns_data\[0\] must be \(position, particle_type"),
        ("geoelements", pickled(lambda _: (np.zeros((9, 2, 3), int), 5)), r"\[0\]: position must be float32"),
        ("geoelements", pickled(lambda _: ([[1.0], [1.0, 2.0]], 5)), r"gns_data\[0\]: position must be an array, got"),
        ("geoelements", pickled(lambda _: (WALK, [5, np.inf])), r"gns_data\[0\]: particle_type must be whole numbers"),
        ("geoelements", pickled(lambda _: (WALK, 5, np.ones(7))), r"material_property must be numbers for one or 2"),
        ("geoelements", pickled(lambda _: (WALK, 5, [[1.0], [1.0, 2.0]])), r"material_property must be an array, got"),
        ("geoelements", pickled(lambda _: (np.zeros((9, 2, 3)), [5, 6, 5])), r"\[0\]: particle_type must be one"),
        ("geoelements", pickled(lambda _: (np.zeros((9, 2, 2)), 5)), r"position must have shape \[any, any, 3\], got"),
        ("plain", other_objects({"a": (WALK, [5, 5]), "b": 3}), r"train\.npz: arr_0.* must "),
        ("plain", other_objects([{"position": WALK}]), r"train\.npz: arr_0.* must "),
        ("plain", other_objects({"a": {"particle_type": [5], "material_property": 1}}), r"train\.npz: arr_0.* must "),
        ("deepmind", with_step_context, r"record 0: step_context must be absent"),
        ("plain", twice, r"train.npz: 00000/position must appear once"),
        *(("plain", meta(dt=dt), rf"metadata.json: dt must be a finite number, got {dt!r}") for dt in (True, "0.01")),
        ("plain", meta(bounds=[["0", "1"]] * 3), r"metadata.json: bounds must be finite numbers in pairs"),
        ("plain", meta(default_connectivity_radius=50.0), r"radius must be at most the width .* 1, got 50"),
        *(("plain", meta(materials={n: "clay"}), f"materials must be names by .*got '{n}'") for n in ("07", "\u0667")),
        *(("plain", npz("00000/position", lambda a, t=t: a.astype(t)), "position must be flo") for t in ("f2", "g")),
        ("plain", npz("00000/position", lambda a: np.full(a.shape, 1e300)), "position must be at most 1e15, got 1e"),
        ("plain", npz("00000/material_property", np.float64(1e300)), "material_property must be at most 1e15, got 1e"),
        ("plain", npz("00000/gravity", np.full(3, 1e300)), "00000: gravity must be at most 1e15, got 1e"),
        *(
            ("plain", npz("00000/particle_type", lambda a, n=n: np.full(len(a), n)), "00000: particle_type must be wh")
            for n in (np.uint64(2**64 - 1), np.float16(0.5), np.longdouble(5))
        ),
        ("plain", other_objects(None), r"train\.npz: arr_0.* must "),
        ("lagrangebench", cut("train.h5", 2000), r"train.h5 must be a complete HDF5 file"),
        ("lagrangebench", hdf5("train.h5", "00001/position"), r"train.h5: 00001: position is missing"),
        ("lagrangebench", hdf5("train.h5", "00000/particle_type"), r"train.h5: 00000: particle_type must be present"),
        ("lagrangebench", hdf5("train.h5", "00000/position", with_nan), r"position must be finite, got nan at \[3"),
        ("lagrangebench", hdf5("train.h5", "00000/particle_type", lambda a: a + 40), r"particle_type must have a"),
        ("lagrangebench", at_the_side, r"conditions must be false on axis x, because particles of .*00000 come within"),
        ("lagrangebench", hdf5("train.h5", "00000/position", lambda a: a[:5]), r"must be of at least 5 \+ 2 frames"),
        ("neuralmpm", hdf5("train/sim_0.h5", "boundary"), r"sim_0.h5: boundary must be present and complete"),
        ("neuralmpm", hdf5("train/sim_0.h5", "boundary", moving), r"sim_0.h5: boundary must be at rest, got 'a disp"),
        ("neuralmpm", hdf5("train/sim_0.h5", "particles", lambda a: a.astype(np.int32)), r"particles must be float32"),
        ("neuralmpm", hdf5("train/sim_0.h5", "types", lambda a: a[1:]), r"particle_type must be one number for each"),
        ("plain", npz("00000/position", with_nan), r"train.npz: 00000: position must be finite, got nan at"),
        ("plain", npz("00000/particle_type", lambda a: a + 0.5), r"00000: particle_type must be whole"),
        ("plain", npz("lonely", lambda a: a), r"lonely"),
        ("plain", npz("00000/position", moving), r"types \[3\] must be at rest, got .*obstacles cannot move"),
    ],
)  # fmt: skip
def test_malformed_files_are_refused(name, change, message, tmp_path):
    """By the name of file and field; nothing is run or written, and no manifest appears."""
    generator = np.random.default_rng(0)
    walk_TN3 = (0.5 + 0.001 * generator.normal(size=(9, 4, 3))).astype(np.float32)
    wall_P3 = generator.uniform(0.1, 0.9, (6, 3)).astype(np.float32)
    simulations = {"train": [(walk_TN3, TYPES[[0, 1, 2, 0]], wall_P3)] * 2}
    extra = {"write_every": 1} if name == "lagrangebench" else {}
    source = write(tmp_path / "foreign", name, simulations, metadata(**extra))
    if message == "lonely":
        np.savez(source / "train.npz", lonely=walk_TN3)
        message = r"train.npz: lonely must be named TRAJECTORY/FIELD"
    else:
        change(source)
    with pytest.raises(ConfigError, match=message):
        import_trajectories.main(options(tmp_path / "mine", source))
    assert not (source / "ran").exists() and not (tmp_path / "mine").exists()


def test_files_of_several_formats_are_refused(tmp_path):
    """The files determine the format, so a folder has those of one."""
    (tmp_path / "train").mkdir()
    (tmp_path / "train.tfrecord").touch()
    with pytest.raises(ConfigError, match=r"from must be a folder with files of one format, got .deepmind and neuralm"):
        find_format(tmp_path)


@pytest.mark.parametrize("types", [[1, 7, 1], [1, 5, 1], None])
def test_types_without_a_name_in_own_materials_are_refused(types, tmp_path):
    """If metadata name materials, other numbers have no names, as DeepMind's 7 or the 1 of files without types."""
    source = write(tmp_path / "foreign", "plain", {}, metadata(materials={"1" if types else "0": "gravel"}))
    members = {"a/position": np.full((9, 3, 3), 0.5, np.float32)} | ({"a/particle_type": types} if types else {})
    np.savez(source / "train.npz", **members)
    number = types[1] if types else 1
    with pytest.raises(ConfigError, match=rf"particle_type must have a name for each number, got \[{number}\]"):
        import_trajectories.main(options(tmp_path / "mine", source, materials={}))
    import_trajectories.main(options(tmp_path / "mine", source, materials={str(number): "clay"}))


def test_gravity_of_any_size(tmp_path):
    """Gravity beyond 1e15 is refused before it is compared with free flight, where NumPy would warn."""
    source = write(tmp_path / "foreign", "plain", {}, metadata(gravity=[0, -1e300, 0]))
    with pytest.raises(ConfigError, match=r"gravity must be 3 finite numbers.*, at most 1e\+15, got \[0.0, -1e\+300"):
        set_info(source, "plain", ImportConfig(out="mine"))


@pytest.mark.parametrize("gravity", [None, [0.0, -9.8, 0.0]])
def test_sets_without_moving_particles_are_refused(gravity, tmp_path):
    """Also where gravity is estimated from their flight, or compared with it."""
    source = write(tmp_path / "foreign", "plain", {}, metadata(gravity=gravity))
    np.savez(source / "train.npz", **{"a/position": np.full((20, 9, 3), 0.5, np.float32), "a/particle_type": 3})
    with pytest.raises(ConfigError, match="position must be of particles that are not obstacles, got"):
        import_trajectories.main(options(tmp_path / "mine", source, gravity=None))


def test_a_record_without_a_feature_is_refused(tmp_path):
    """A SequenceExample lacks particle_type; and bytes that are none are no message."""
    from hgn.data.foreign.tfrecord import parse_sequence_example

    context, lists = parse_sequence_example(sequence_example(np.zeros((3, 2, 3)), np.array([5, 5]), 7), "here")
    assert set(context) == {"key", "particle_type"} and len(lists["position"]) == 3 and context["key"] == []
    for data in (b"\x0a\xff", b"\x0f", b"\xff" * 11, b"\x09\x00"):
        with pytest.raises(ConfigError, match=r"here must be a tf.SequenceExample, got"):
            parse_sequence_example(data, "here")


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"materials": 3}, "materials must be a mapping, got 3"),
        ({"radius": -1.0}, "^radius must be a finite number > 0, got -1.0"),
        ({"dt": -1.0}, "^dt must be a finite number > 0, got -1.0"),
    ],
)
def test_settings_are_refused_by_their_own_names(setting, message, tmp_path):
    """A wrong setting is not blamed on metadata.json."""
    with pytest.raises(ConfigError, match=message):
        import_trajectories.main({"from": str(tmp_path), "out": str(tmp_path / "new")} | setting)
