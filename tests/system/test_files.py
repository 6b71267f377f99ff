"""Files of outputs: which ones a command replaces."""

import mmap
import os
import stat
from types import SimpleNamespace

import pytest

from datagen.pool.shard import require_sealed
from hgn.data.fresh import FRESH_NAME, read_fresh
from hgn.data.shard import locate_members
from hgn.data.storage import open_storage
from hgn.data.verification import file_sha256
from hgn.system import files
from hgn.system.yaml_files import read_json, read_yaml
from hgn.training.callbacks import _drop_cut_line

MARKS = (b"written by HGN", b"hgn rollout", b'"hgn"', b"\x03hgn\x12", b"x\nprovenance:\n")


@pytest.mark.parametrize("mark", MARKS)
def test_marks_of_written_files_are_found_anywhere(tmp_path, monkeypatch, mark):
    """A file is read in blocks. A mark may lie in two of them. A map would end the process if the file became
    shorter."""
    monkeypatch.setattr(mmap, "mmap", lambda *_, **__: pytest.fail("the file is mapped"))
    monkeypatch.setattr(files, "BLOCK_BYTES", 32, raising=False)
    path = tmp_path / "out"
    for before in range(80):
        path.write_bytes(before * b"." + mark + 40 * b".")
        assert files.is_replaceable(path)
        path.write_bytes(before * b"." + mark[:-1] + b"?" + 40 * b".")
        assert not files.is_replaceable(path)


@pytest.mark.parametrize("block", [32, 33, 1000])
def test_marks_have_their_places(tmp_path, monkeypatch, block):
    """Some marks count only at the start of the file or of a line, not at the start of a block."""
    monkeypatch.setattr(files, "BLOCK_BYTES", block, raising=False)
    path = tmp_path / "out"
    for before in range(80):
        for mark in (b'{"meta": {', b"provenance:\n"):
            path.write_bytes(before * b"." + mark + 80 * b".")
            assert files.is_replaceable(path) == (before == 0)


def test_errors_name_the_file_that_was_to_be_written(tmp_path):
    """The temporary file, which is gone, is not named."""
    (tmp_path / "out").mkdir()
    with pytest.raises(IsADirectoryError) as error:
        files.write_atomically(tmp_path / "out", b"content")
    assert error.value.filename == str(tmp_path / "out")


READERS = {
    "manifest.json": lambda path: open_storage(path.parent).manifest(path.name),
    "train.idx": lambda path: open_storage(path.parent).read(path.name, 0, 8),
    "a.tar": locate_members,
    "b.tar": file_sha256,
    "c.npz": require_sealed,
    "scene.yaml": read_yaml,
    "metadata.json": read_json,
    FRESH_NAME: lambda path: read_fresh(path.parent),
    "metrics.jsonl": _drop_cut_line,
}


@pytest.mark.parametrize("name", READERS)
def test_errors_name_the_file_that_was_to_be_read(tmp_path, monkeypatch, name):
    """A disk that fails is reported with the file. Memory without pages stands in, which claims some bytes."""
    path = tmp_path / name
    path.symlink_to("/proc/self/mem")
    monkeypatch.setattr(os, "fstat", lambda _: SimpleNamespace(st_mode=stat.S_IFREG, st_size=100))
    with pytest.raises(OSError, match=r"Input/output error|Invalid argument") as error:
        READERS[name](path)
    assert error.value.filename == str(path)
