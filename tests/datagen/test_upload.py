"""Data sets in object stores: what is listed there is there whole, whatever becomes of the copying."""

import os
import signal
from pathlib import Path

import fsspec
import pytest

from datagen.upload import main
from hgn.data.manifest import Manifest
from hgn.data.reader import EpisodeStore
from hgn.schema import ConfigError


@pytest.fixture(autouse=True)
def store(cache):
    """fsspec's memory as the object store, empty."""
    files = fsspec.filesystem("memory")
    files.store.clear()
    return files


def keys(folder):
    return [episode.key for episode in EpisodeStore(folder, "train")]


def test_copy_is_the_data_set(make_config, make_dataset, capsys):
    """The copy reads like the folder; what comes later is added to it, and what is there is not sent again."""
    folder = make_dataset(make_config(training_scenes=2))
    assert main({"data": str(folder), "to": "memory://bucket/set"}) == 0
    assert capsys.readouterr().out == "memory://bucket/set has 5 shards, the whole data set\n"
    assert Manifest.load("memory://bucket/set") == Manifest.load(folder)
    assert keys("memory://bucket/set") == keys(folder) and len(keys(folder)) == 2
    files = fsspec.filesystem("memory")
    before = {name: file.modified for name, file in files.store.items()}
    make_dataset(make_config())
    assert main({"data": str(folder), "to": "memory://bucket/set/"}) == 0
    assert keys("memory://bucket/set") == keys(folder) and len(keys(folder)) == 5
    changed = {name for name, file in files.store.items() if before.get(name) != file.modified}
    new = ("manifest.json", "index/1-000000.jsonl", "train-000002-000004.tar", "train-000004-000005.tar")
    assert changed == {f"/bucket/set/{name}" for name in new}


@pytest.mark.parametrize("signalled", [False, True])
def test_copying_that_is_cut_off(folder, monkeypatch, store, signalled):
    """Wherever copying ends, the index lists no missing file, and the same command copies the missing shards, those
    that were cut off, and others of the same name and size. After a signal no further shard is copied."""
    real, sent = type(store).put_file, []

    def cut(self, path, target, **options):
        sent.append(target)
        if signalled and len(sent) == 2:
            real(self, path, target, **options)
            os.kill(os.getpid(), signal.SIGTERM)
        elif len(sent) == 4:
            store.pipe_file(target, Path(path).read_bytes()[:1000])
            raise KeyboardInterrupt
        else:
            real(self, path, target, **options)

    mapping = {"data": str(folder), "to": "memory://cut"}
    with monkeypatch.context() as patch:
        patch.setattr(type(store), "put_file", cut)
        if signalled:
            assert main(mapping) == 143 and len(store.store) == 2
        else:
            with pytest.raises(KeyboardInterrupt):
                main(mapping)
        assert not EpisodeStore.available("memory://cut")
        complete = sent[1 : 2 if signalled else 3]
        store.pipe_file(sent[0], store.cat_file(sent[0])[:-1] + b"?")
        sent.clear()
        patch.setattr(
            type(store), "put_file", lambda self, path, *rest, **_: (sent.append(*rest), real(self, path, *rest))
        )
        assert main(mapping) == 0
    assert keys("memory://cut") == keys(folder)
    assert {Path(name).name for name in sent} == {shard.name for shard in Manifest.load(folder).shards} - {
        Path(name).name for name in complete
    }


def test_what_is_refused(folder, make_config, make_dataset, tmp_path):
    """Another data set at the URL, one made anew, and an altered or missing shard."""
    main({"data": str(folder), "to": "memory://there"})
    other = make_dataset(make_config(folder=str(tmp_path / "other"), seed=7))
    with pytest.raises(ConfigError, match="to must be empty or contain the same data set, got another one in m"):
        main({"data": str(other), "to": "memory://there"})
    anew = make_dataset(make_config(folder=str(tmp_path / "anew"), training_scenes=1))
    with pytest.raises(ConfigError, match="to must contain the first shards of the local data set, got others"):
        main({"data": str(anew), "to": "memory://there"})
    shard = folder / "train-000001-000002.tar"
    shard.write_bytes(shard.read_bytes()[:-1] + b"?")
    with pytest.raises(ConfigError, match=r"must have sha256 .* it was altered"):
        main({"data": str(folder), "to": "memory://elsewhere"})
    shard.unlink()
    with pytest.raises(ConfigError, match=r"train-000001-000002.tar is listed in the index but missing"):
        main({"data": str(folder), "to": "memory://elsewhere"})
