"""Files of outputs: which ones a command replaces."""

import mmap

import pytest

from hgn.system import files

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
