"""Files from anywhere: what is wrong with them ends in one line, never in a traceback, a hang or foreign data."""

import contextlib
import errno
import io
import os
import pickle
import resource
import signal
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from data.foreign_writers import metadata, sequence_example, write
from data.test_index import shard
from hypothesis import given, settings
from hypothesis import strategies as st
from scene.test_glb import box_with
from scene.test_rollout_file import make_rollout

from datagen.solve import SolveConfig
from hgn import card
from hgn.card import weights_card
from hgn.config import DatagenConfig, DatasetConfig, NetworkConfig, SceneConfig
from hgn.data.entries import SPLITS, QuarantinedScene
from hgn.data.foreign.formats import read_split, set_info
from hgn.data.foreign.settings import ImportConfig
from hgn.data.foreign.tfrecord import parse_sequence_example, read_records
from hgn.data.identity import identity_hash
from hgn.data.index import parse_json
from hgn.data.manifest import Manifest
from hgn.data.shard import locate_members
from hgn.network.build import build_network
from hgn.runtime.weights import WeightsInfo, load_weights, save_weights
from hgn.scene.mesh import load_mesh
from hgn.scene.npz import read_npz
from hgn.scene.rollout_file import read_rollout, write_rollout
from hgn.scene.scene_file import load_scene
from hgn.schema import ConfigError, from_mapping
from hgn.step_config import StepConfig
from hgn.system import claims
from hgn.system.claims import require_few_items, require_plain_pickle
from hgn.training.checkpoint import read_checkpoint
from hgn.training.imported import settings_of_imported


@pytest.mark.parametrize(
    ("cls", "mapping", "message"),
    [
        (SolveConfig, {"scene": "s", "frames": 10**12}, "frames must be at most 1,000,000, got 1000000000000"),
        (NetworkConfig, {"levels": 10**5}, "levels must be at most 1,000, got 100000"),
        (SceneConfig, {"obstacle_count": 10**5}, "obstacle_count must be at most 1,000, got 100000"),
        (NetworkConfig, {"width": 10**9}, "width must be at most 65,536"),
        (NetworkConfig, {"levels": 10**400}, "levels must be a number of at most 63 bits"),
        (NetworkConfig, {"cell_size": 10**400}, "cell_size must be a number of at most 63 bits"),
        (NetworkConfig, {"cell_size": 1e300}, "cell_size must be from 1e-9 to 1e9"),
        (
            DatagenConfig,
            {"scene": {"domain_size": [1e6] * 3}},
            "domain_size must be at most 2147483647 cells of 0.0156",
        ),
        (DatagenConfig, {"scene": {"cell_size": 1e-9}}, "domain_size must be at most 2147483647 cells of 1e-09"),
        (SceneConfig, {"domain_size": [1e300, 1, 1]}, r"domain_size\[0\] must be from 1e-9 to 1e9"),
        *(
            (
                cls,
                {"scene": "s"} | {"frame_rate_hz": rate} if cls is SolveConfig else {"frame_rate_hz": rate},
                "frame_rate_hz must be from 0.001 to 1e6, got",
            )
            for cls in (SolveConfig, DatasetConfig)
            for rate in (1e300, 1e-9, float("nan"))
        ),
        (StepConfig, {"wall_clearance": [0, 1e300]}, r"wall_clearance\[1\] must be from 0 to 1e9"),
        (SolveConfig, {"scene": "a\x1b[31m"}, r"scene must be text without control characters, got 'a\\x1b\[31m'"),
        (SolveConfig, {"scene": "a\ud800"}, "scene must be text without control characters"),
        (NetworkConfig, {"kind": "hgn\u202e"}, "kind must be text without control characters"),
    ],
)
def test_sizes_that_no_machine_has(cls, mapping, message):
    """Numbers that would end in MemoryError, or in hours of building a network, are refused by name."""
    with pytest.raises(ConfigError, match=message):
        from_mapping(cls, mapping)


@pytest.mark.parametrize(
    "name",
    ["<script>alert(1)</script>", "a | b", "x\n# y\n", "`a`", "[x](javascript:alert(1))", "```\n<b>", "\x1b[31m"],
)
def test_cards_show_names_as_words(name):
    """A file's or folder's name is text on a card, and opens no element, table, link or code."""
    info = WeightsInfo(NetworkConfig(), 60.0, 1 / 64)
    text, usual = (weights_card(info, each, f"{each}.safetensors", "mit").split("---\n")[2] for each in (name, "a"))
    assert not set("<[\x1b") & set(text)
    assert all(text.count(character) == usual.count(character) for character in "\n|`")


KINDS = {"kinds": {"landslide": -1, "mixer": 1}, "materials": ["water"]}


@pytest.mark.parametrize(
    "config",
    [
        *({}, {"scene": 3}, {"imported": {}}, {"imported": 5, "frame_rate_hz": "x"}),
        {"scene": KINDS, "frame_rate_hz": 60.0},
        {"imported": {"format": "plain", "materials": "water", "gravity": [0, 0, 0]}, "frame_rate_hz": 60.0},
    ],
)
def test_configs_of_other_data_sets(tmp_path, config):
    """A manifest whose config is none of this version ends in one line: of a card, and of a training on it."""
    Manifest(identity_hash(config), config, {"train": 1}, 1).save(tmp_path, [shard(0)])
    sections = {name: {} for name in ("network", "training", "scene")}
    mapping = {"dataset": {"folder": str(tmp_path)}, "imported": True, **sections}
    for read in (lambda: card.main({"data": str(tmp_path)}), lambda: settings_of_imported(mapping)):
        with pytest.raises(
            ConfigError, match=r"config that this version can read|must be a data set of|be a list of names"
        ):
            read()


@pytest.mark.parametrize("uri", ["pipe", "../outside.bin", "/etc/hostname", 1000 * "a://b:", None])
def test_meshes_that_are_not_read(tmp_path, uri):
    """A GLB's buffers are plain files in its folder: no pipe, where reading would wait for ever, no others. A
    version of the format that is not read is refused too."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    os.mkfifo(folder / "pipe")
    (tmp_path / "outside.bin").write_bytes(bytes(1000))
    content = box_with(lambda tree: uri is None or tree["buffers"][0].update(uri=uri))
    (folder / "mesh.glb").write_bytes(content[:4] + bytes(1) + content[5:] if uri is None else content)
    reason = ".*at most 4,096 characters" if uri and len(uri) > 100 else ""
    with pytest.raises(ConfigError, match="mesh must be a readable GLB file" + reason):
        load_mesh(folder / "mesh.glb")


def test_pickled_arrays_come_back():
    """Arrays of arrays, numbers, tuples and lists, in either byte order, are what they were."""
    entry, buffer = np.empty((2, 1), object), io.BytesIO()
    entry[:, 0] = [np.arange(6.0).reshape(2, 3).T, (np.float32(2), [np.array([True]), np.arange(3, dtype=">i8")])]
    np.savez(buffer, a=entry)
    ((_, array),) = read_npz(buffer, objects=True)
    assert array.shape == (2, 1) and array[0, 0].tolist() == [[0, 3], [1, 4], [2, 5]]
    number, (flag, order) = array[1, 0]
    assert number == 2 and flag.tolist() == [True] and order.tolist() == [0, 1, 2]


def test_pickled_array_with_a_state_that_none_has():
    """A type that says that its numbers are objects is refused: NumPy's own would take it, and write beyond memory."""
    entry, buffer = np.empty(1, object), io.BytesIO()
    entry[0] = np.arange(3.0)
    np.save(buffer, entry)
    content = buffer.getvalue()
    for old, new in ((b"f8", b"O8"), (b"K\x03\x85", b"K\x7f\x85"), (b"f8", b"V8")):
        assert content.count(old) == 1
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w") as whole:
            whole.writestr("a.npy", content.replace(old, new))
        with pytest.raises(ConfigError, match="a must be an array, or a pickle of arrays only, got"):
            list(read_npz(file, objects=True))


def mesh(suffix):
    content = trimesh.creation.box().export(file_type=suffix)
    return f"box.{suffix}", content.encode() if isinstance(content, str) else content, load_mesh


def checkpoint():
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "last.ckpt"
        torch.save({"hgn": {"network": {"width": 8}}, "state_dict": {"weight": torch.arange(100.0)}}, path)
        assert not zipfile.ZipFile(path).testzip()
        return "last.ckpt", path.read_bytes(), read_checkpoint


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda path, _: path.write_bytes(b"\x80\x02." + path.read_bytes()), "more than one archive"),
        (
            lambda _, archive: archive.writestr("a/DATA.PKL", b"\x80\x02cbuiltins\nbytearray\n."),
            "bytearray, which is no",
        ),
        (lambda _, archive: archive.writestr("a/DATA.PKL", b"\x80\x02ctorch\nTensor\n."), "torch Tensor, which is no"),
        (lambda _, archive: archive.writestr("a/b", b"x", zipfile.ZIP_BZIP2), "a/b is compressed"),
        (lambda _, archive: archive.writestr(archive.filelist[-1].filename, b"x"), "twice"),
        (lambda _, archive: archive.writestr("last/DATA.PKL", b"\x80\x02}."), "twice"),
        (lambda path, _: torch.save({"hgn": {}, "state_dict": {5: torch.zeros(1)}}, path), "must be a file of python"),
    ],
)
def test_archives_that_torch_reads_otherwise(tmp_path, change, message):
    """A checkpoint has one archive, as torch writes it, in which all that torch reads was checked."""
    path = tmp_path / "c.ckpt"
    path.write_bytes(checkpoint()[1])
    with zipfile.ZipFile(path, "a") as archive:
        change(path, archive)
    with pytest.raises(ConfigError, match=message):
        read_checkpoint(path)


def test_lists_that_are_too_long(monkeypatch):
    """The message states what is counted: the items of a long list, or those of references."""
    monkeypatch.setattr(claims, "MOST_ITEMS", 9)
    for value in (list(range(12)), [(1, 2, 3)] * 4):
        with pytest.raises(ValueError, match="more than 9 items; a reference counts as all of its items"):
            require_few_items(value)
    require_few_items(list(range(8)))


@pytest.mark.parametrize("protocol", [2, 4])
@pytest.mark.parametrize(
    ("value", "items", "size"),
    [([1], 2, 0), ((1, 2), 3, 0), ([[1], [2]], 5, 0), ({"a": [1]}, 4, 1), ([bytes(99)], 2, 99), (np.zeros(9), 1, 72)],
    ids=lambda value: type(value).__name__,
)
def test_references_count_as_what_they_refer_to(value, items, size, protocol):
    """A hundred references to a list, a tuple, a dict, a text or an array claim its items and bytes as often."""

    def claimed(content):
        given = claims.Claims("a", 0)
        require_plain_pickle(pickle.dumps(content, protocol=protocol), given)
        return given.used

    assert claimed([value] * 101) - claimed([value]) >= 100 * (claims.ITEM_BYTES * items + size)


def tar():
    name = (
        b"train-000000.json".ljust(100, b"\0") + b"0000644\0" + b"0000000\0" * 2 + b"00000000003\0" + b"0" * 11 + b"\0"
    )
    header = name + b" " * 8 + b"0" + bytes(355)
    header = header[:148] + f"{sum(header):06o}\0 ".encode() + header[156:]
    return "shard.tar", header + b"abc".ljust(512, b"\0") + bytes(1024), locate_members


def hdf5():
    with tempfile.TemporaryDirectory() as folder:
        write_rollout(Path(folder) / "rollout.vtkhdf", make_rollout())
        return "rollout.vtkhdf", (Path(folder) / "rollout.vtkhdf").read_bytes(), read_rollout


def archive():
    """Plain arrays."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, position=np.zeros((9, 3), np.float32), velocity=np.zeros((9, 3), np.float32))
    return "a.npz", buffer.getvalue(), lambda path: list(read_npz(path))


def pickles():
    """An array of arrays, as geoelements/gns has them: its bytes in an archive that is whole."""
    entry, buffer = np.empty(2, object), io.BytesIO()
    entry[:] = [np.zeros((4, 2, 3)), np.array([5, 6])]
    np.save(buffer, entry)

    def decode(path):
        whole = path.with_suffix(".npz")
        with zipfile.ZipFile(whole, "w") as file:
            file.writestr("a.npy", path.read_bytes())
        for _, array in read_npz(whole, objects=True):
            assert str(array) is not None and np.zeros(1, np.float32)[0] == 0

    return "a.npy", buffer.getvalue(), decode


def foreign(name):
    """A set of particles in another program's HDF5."""
    walk = np.full((9, 2, 3), 0.5, np.float32), np.array([5, 5]), np.full((2, 3), 0.3, np.float32)
    folder = write(Path(LISTED.name, name), name, {"train": [walk]}, metadata(write_every=1))
    (path,) = folder.rglob("*.h5")
    info = set_info(folder, name, ImportConfig(out="mine"))

    def decode(damaged):
        path.write_bytes(damaged.read_bytes())
        list(read_split(folder, "train", info))

    return path.name, path.read_bytes(), decode


def weights():
    """Weights of the smallest network."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "w.safetensors"
        network = build_network(NetworkConfig(width=2, levels=1, message_passing_steps=1))
        save_weights(path, network, WeightsInfo(network.config, 60.0, 1 / 64))
        return path.name, path.read_bytes(), load_weights


def records():
    """DeepMind's trajectories: the messages of records whose checksums hold, and records as they are."""
    walk = np.full((9, 2, 3), 0.5, np.float32)
    message = sequence_example(walk, np.array([5, 5]), 7)

    def decode(path):
        data = path.read_bytes()
        with contextlib.suppress(ConfigError):
            list(read_records(path))
        context, lists = parse_sequence_example(data, "here")
        assert context is not None and lists is not None

    return "train.tfrecord", message, decode


LISTED = tempfile.TemporaryDirectory()  # data sets without their shards


def index(name):
    """A file of a data set's index: all that it lists is read, and looked up."""
    folder = Path(LISTED.name, name.strip("*"))
    folder.mkdir()
    failures = [QuarantinedScene("train-000000", 0, 7, "too stiff")]
    Manifest(identity_hash({}), {}, {"train": 2}, 2).save(folder, [shard(0), shard(1)], failures)
    (path,) = folder.rglob(name)
    content = path.read_bytes()

    def decode(damaged):
        path.write_bytes(damaged.read_bytes())
        try:
            manifest = Manifest.load(folder)
            assert all(isinstance(entry.bytes, int) for entry in manifest.shards) and manifest.quarantined is not None
            for split in SPLITS:
                manifest.statistics(split)
                manifest.shards.digest(split, manifest.published(split))
        finally:
            path.write_bytes(content)

    return path.name, content, decode


FILES = {
    "hdf5": hdf5(),
    "manifest": index("manifest.json"),
    "segment": index("*-000000.jsonl"),
    "quarantined": index("*-quarantined.jsonl"),
    **{suffix: mesh(suffix) for suffix in ("stl", "ply", "glb", "obj")},
    **{name: foreign(name) for name in ("lagrangebench", "neuralmpm")},
    "npz": archive(),
    "pickles": pickles(),
    "checkpoint": checkpoint(),
    "weights": weights(),
    "tfrecord": records(),
    "tar": tar(),
    "yaml": ("s.yaml", b"groups:\n- {shape: cube, size: 0.1, position: [0.5, 0.5, 0.5], material: sand}\n", load_scene),
    "json": ("i.jsonl", b'{"bytes": 12, "totals": {"train": 7}}', lambda path: parse_json(path.read_bytes(), "i")),
}


@pytest.mark.parametrize("read", [0, 1])
@pytest.mark.parametrize("kind", ["hdf5", "npz", "checkpoint", "lagrangebench", "neuralmpm"])
def test_a_disk_that_fails_while_a_library_reads(tmp_path, monkeypatch, kind, read):
    """The error is the system's, with the file's name. Libraries took it for damage, or for another kind of file."""
    name, content, decode = FILES[kind]
    path, preadv, places = tmp_path / name, os.preadv, []
    path.write_bytes(content)

    def failing(*arguments):
        places.append(arguments)
        if len(places) > read:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return preadv(*arguments)

    monkeypatch.setattr(os, "preadv", failing)
    with pytest.raises(OSError, match=rf"Input/output error: .*{name}"):
        decode(path)


@pytest.mark.parametrize("kind", ["stl", "ply", "glb", "obj", "weights", "tfrecord"])
def test_a_disk_that_fails(tmp_path, kind):
    """The error is the system's, with the file's name, and not damage of the file. Memory without pages stands in."""
    name, _, decode = FILES[kind]
    path = tmp_path / name
    path.symlink_to("/proc/self/mem")
    decode = decode if kind != "tfrecord" else lambda path: list(read_records(path))
    with pytest.raises(OSError, match=rf"Input/output error: .*{name}"):
        decode(path)


def test_a_disk_that_fails_while_hdf5_opens_a_file(tmp_path):
    """The process ends as usual after the error. HDF5's objects crashed it if the error kept them."""
    (tmp_path / "a.h5").symlink_to("/proc/self/mem")
    program = "import sys, pathlib, hgn.scene.rollout_file as files; files.read_rollout(pathlib.Path(sys.argv[1]))"
    ended = subprocess.run([sys.executable, "-c", program, tmp_path / "a.h5"], capture_output=True, check=False)
    assert ended.returncode == 1 and b"Input/output error" in ended.stderr


@pytest.mark.parametrize("kind", FILES)
def test_decoders_bear_any_bytes(kind, request):
    """A file with some bytes changed, cut or repeated is read, or refused with a message, within 0.5 GB of memory."""
    name, content, decode = FILES[kind]
    places = st.lists(st.tuples(st.integers(0, len(content) - 1), st.integers(0, 255)), max_size=4)
    soak = request.config.getoption("soak")

    @settings(max_examples=soak or 120, deadline=None, derandomize=not soak, database=None)
    @given(places, st.integers(0, len(content)), st.integers(0, 3))
    def damaged(changes, cut, kind_of_cut):
        data = bytearray(content)
        for place, value in changes:
            data[place] = value
        data = {1: data[:cut], 2: data[cut:], 3: data[:cut] + data}.get(kind_of_cut, data)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            path.write_bytes(data)
            signal.alarm(60)  # a hang ends the tests
            try:
                decode(path)
            except ConfigError as error:
                assert str(error)
            finally:
                signal.alarm(0)

    most_before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    damaged()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < most_before + 500_000  # kB
