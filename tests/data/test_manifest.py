"""The manifest and the identity of a data set."""

import asyncio
import dataclasses
import errno
import json
from pathlib import Path

import pytest
from written_files import first_release

from datagen.pool.writer import DatasetWriter
from datagen.service.server import Published
from hgn.data.identity import dataset_identity, identity_differences, identity_hash
from hgn.data.index import ListedIndex
from hgn.data.manifest import EpisodeEntry, Manifest, QuarantinedScene, ShardEntry
from hgn.data.reader import EpisodeStore
from hgn.data.statistics import Moments, Statistics
from hgn.schema import ConfigError


def make_manifest():
    entry = EpisodeEntry("train-000000", 0, 2**62, 1, 4296, 300, {"position.npy": (512, 15_465_728)})
    moments = Moments(7, (0.1, -0.2, 1e-300), (1 / 3, 0.0, 2.0))
    shard = ShardEntry("train-000000-000001.tar", "train", 0, 1, "ab" * 32, 999, (entry,), Statistics(moments))
    config = {"scene": {"gravity": [0.0, -9.8, 0.0]}}
    return Manifest(
        config_hash=identity_hash(config),
        config=config,
        requested={"train": 1, "validation": 1, "test": 0},
        revision=3,
        shards=ListedIndex([shard], [QuarantinedScene("train-000000", 0, 5, "diverged")]),
    )


def test_roundtrip(tmp_path):
    """Saving and loading returns every field, floats bitwise."""
    make_manifest().save(tmp_path)
    assert Manifest.load(tmp_path) == make_manifest()
    assert Manifest.load(tmp_path).quarantined == make_manifest().quarantined
    assert {path.name for path in tmp_path.iterdir()} == {"manifest.json", "index"}


def test_counts():
    """A manifest knows what is published of what is requested."""
    manifest = make_manifest()
    assert (manifest.published("train"), manifest.published("validation")) == (1, 0)
    assert not manifest.complete
    assert dataclasses.replace(manifest, requested={"train": 1}).complete
    assert manifest.statistics("train").velocity.count == 7
    assert manifest.statistics("test") == Statistics()


def test_missing_manifest(tmp_path):
    """A folder without a data set is named together with the command that makes one."""
    for folder in (tmp_path, tmp_path / "nowhere"):
        assert not EpisodeStore.available(folder)
        with pytest.raises(ConfigError, match=r"manifest\.json must be the manifest .* generate one with"):
            Manifest.load(folder)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe"])
def test_garbled_manifest(tmp_path, content):
    """A manifest that is no JSON is refused with the remedy."""
    (tmp_path / "manifest.json").write_bytes(content)
    message = r"manifest\.json must be JSON .* delete manifest.json and run the generator again"
    with pytest.raises(ConfigError, match=message):
        Manifest.load(tmp_path)


def test_wrong_manifest(tmp_path):
    """Another schema, an unknown key or a wrong type is refused by name, the first with the remedy."""
    make_manifest().save(tmp_path)
    path, good = tmp_path / "manifest.json", first_release(tmp_path)
    for changes, message in (
        ({"schema_version": 2}, "schema_version must be 1, got 2; .* or use the version that made it"),
        ({"colour": 1}, "colour is not a known key"),
        ({"revision": "3"}, "revision must be a whole number, got '3'"),
        ({"shards": [good["shards"][0] | {"bytes": None}]}, r"shards\[0\]\.bytes must be a whole number"),
    ):
        path.write_text(json.dumps(good | changes))
        with pytest.raises(ConfigError, match=message):
            Manifest.load(tmp_path)


def test_identity_survives_json(make_config):
    """The identity in a manifest hashes to the manifest's hash, in any key order."""
    identity = dataset_identity(make_config())
    reread = json.loads(json.dumps(dict(reversed(identity.items()))))
    assert identity_hash(reread) == identity_hash(identity)
    assert identity_differences(reread, identity) == []


def test_differences_are_named():
    """Keys on one side only count as differences too."""
    lines = identity_differences({"a": {"b": 1, "c": 2}, "d": 3}, {"a": {"b": 1, "c": 4}, "e": 5})
    differences = ["a.c is 2 there, 4", "d is 3 there, nothing", "e is nothing there, 5"]
    assert lines == [f"{difference} is asked for" for difference in differences]


def test_manifest_that_is_replaced_while_it_is_read(make_config, folder, monkeypatch):
    """On NFS a file that another machine has replaced is lost to whoever had opened it: reader, writer and service read
    the one in its place."""
    real, lost = Path.read_bytes, 0

    def read_bytes(path):
        nonlocal lost
        if path.name == "manifest.json" and (lost := lost + 1) % 3:
            raise OSError(errno.ESTALE, "Stale file handle")
        return real(path)

    monkeypatch.setattr(Path, "read_bytes", read_bytes)
    assert Manifest.load(folder).complete
    with DatasetWriter(make_config()) as writer:
        assert writer.complete
    asyncio.run(Published(folder).snapshot())
    assert lost >= 9


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("name", "../../etc/passwd", r"shards\[0\]\.name must be a plain file name"),
        ("name", ".lock", r"shards\[0\]\.name must be a plain file name"),
        ("sha256", "../" * 10 + "evil", r"shards\[0\]\.sha256 must be 64 hexadecimal digits"),
        ("bytes", -1, r"shards\[0\]\.bytes must be a finite number >= 0"),
        ("split", "../train", r"shards\[0\]\.split must be one of"),
    ],
)
def test_manifest_cannot_name_other_files(folder, key, value, message):
    """Names and hashes of a manifest become paths: what could lead elsewhere is refused."""
    mapping = first_release(folder)
    mapping["shards"][0][key] = value
    (folder / "manifest.json").write_text(json.dumps(mapping))
    with pytest.raises(ConfigError, match=message):
        Manifest.load(folder)
