"""Reading published episodes: verified, and growing with the data set."""

import dataclasses
import hashlib
import os
import pickle

import numpy as np
import pytest
from data.test_index import shard

import hgn.data.verification
from datagen.pool.writer import DatasetWriter
from hgn.config import SceneConfig
from hgn.data.identity import identity_hash
from hgn.data.manifest import Manifest
from hgn.data.reader import EpisodeStore
from hgn.data.verification import file_sha256, verify_file
from hgn.schema import ConfigError


def test_positions_are_read_only(folder):
    """Episodes come in their order, by place and by slice, with the sizes that the index has."""
    store = EpisodeStore(folder, "train")
    assert len(store) == 5 and [entry.key for entry in store.entries] == [f"train-{i:06d}" for i in range(5)]
    for episode, entry in zip(store, store.entries, strict=True):
        assert not episode.position_TN3.flags.writeable
        assert episode.position_TN3.shape == (entry.frames, entry.particles, 3) and episode.seed == entry.seed
    assert store[-1].key == "train-000004"
    assert [episode.key for episode in store[1:3]] == ["train-000001", "train-000002"]
    with pytest.raises(IndexError):
        store[5]


def test_a_shard_of_no_bytes(tmp_path):
    """A manifest that lists an empty file is refused with a message."""
    empty = dataclasses.replace(shard(0), sha256=hashlib.sha256().hexdigest(), bytes=0)
    Manifest(identity_hash({}), {}, {"train": 1}, 1).save(tmp_path, [empty])
    (tmp_path / empty.name).touch()
    with pytest.raises(ConfigError, match="must lie within 0 bytes"):
        EpisodeStore(tmp_path, "train")[0]


def test_store_travels_to_workers(folder):
    """A pickled store holds no episode data and opens the same episodes on the other side."""
    store = EpisodeStore(folder, "train")
    assert len(store[:]) == 5
    data = pickle.dumps(store)
    assert len(data) < 20_000
    assert np.array_equal(pickle.loads(data)[3].position_TN3, store[3].position_TN3)


def test_store_grows_with_the_dataset(make_config, make_dataset):
    """Refreshing appends new episodes, which may have other lengths, and keeps the indices of earlier ones. A data set
    without episodes can be opened. Only the three splits exist."""
    with DatasetWriter(make_config(training_scenes=3, long_fraction=0.4, long_frames=9)) as writer:
        assert EpisodeStore.available(writer.folder) and len(EpisodeStore(writer.folder, "train")) == 0
    folder = make_dataset(make_config(training_scenes=3, long_fraction=0.4, long_frames=9))
    train, test = EpisodeStore(folder, "train"), EpisodeStore(folder, "test")
    first = train[0].position_TN3
    assert not train.refresh() and train.frames() == [6, 6, 9]
    make_dataset(make_config(training_scenes=9, long_fraction=0.4, long_frames=9))
    assert train.refresh() and not test.refresh() and train.frames(4) == [6, 6, 9, 6]
    assert len(train) == 9 and np.array_equal(train[0].position_TN3, first)
    assert train.frames() == [episode.frame_count for episode in train] and 9 in train.frames()[3:]
    assert train.manifest.revision == Manifest.load(folder).revision
    assert train.statistics() == Manifest.load(folder).statistics("train")
    with pytest.raises(ConfigError, match="split must be one of train, validation, test, got 'dev'"):
        EpisodeStore(folder, "dev")


def test_shards_are_hashed_once(folder, monkeypatch):
    """A process verifies a shard once, however many stores open it."""
    hashed: list[str] = []
    real = hgn.data.verification.file_sha256
    monkeypatch.setattr(hgn.data.verification, "file_sha256", lambda path: hashed.append(path.name) or real(path))
    for _ in range(2):
        _ = list(EpisodeStore(folder, "train"))
    assert len(hashed) == len(set(hashed)) == 4


def test_refresh_refuses_another_dataset(folder, make_config, make_dataset, tmp_path):
    """Refreshing fails if the folder's data set was replaced, or has lost shards."""
    store = EpisodeStore(folder, "train")
    manifest = Manifest.load(folder)
    manifest.save(folder, manifest.shards[1:])
    with pytest.raises(ConfigError, match="must keep the train shards already published"):
        store.refresh()
    other = make_config(folder=str(tmp_path / "other"))
    made = make_dataset(dataclasses.replace(other, scene=SceneConfig(obstacle_count=1)))
    Manifest.load(made).save(folder, [])
    with pytest.raises(ConfigError, match="must contain the same data set as before"):
        store.refresh()


def test_times_that_were_set_back(folder):
    """A file whose bytes changed while its size and modification time stayed is hashed again."""
    path = folder / "train-000000-000001.tar"
    status, sha256 = path.stat(), file_sha256(path)
    verify_file(path, sha256, status.st_size, "")
    content = bytearray(path.read_bytes())
    content[700] ^= 1
    path.write_bytes(content)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    with pytest.raises(ConfigError, match="it was altered"):
        verify_file(path, sha256, status.st_size, "")
