"""Locks of runs, data sets and caches: who has one keeps it, and what is no file is refused."""

import fcntl
import os
import stat
from pathlib import Path

import pytest

from datagen.pool.locks import ShardLocks
from hgn.data.shard_cache import CACHE_VARIABLE, CachedShard, cached_shard
from hgn.schema import ConfigError
from hgn.system.locks import locked, make_again


def test_a_deleted_lock_file_locks(tmp_path):
    """A run's folder stays locked where somebody deletes the lock's file."""
    path = tmp_path / "run" / ".lock"
    with locked(path, "run", "another training is in it; wait, or choose"):
        path.unlink()
        with pytest.raises(ConfigError, match="run must be a folder of its own"), locked(path, "run", "no;"):
            pass
    with locked(path, "run", "no;"):
        pass


def test_a_deleted_lock_file_of_generators(tmp_path):
    """A generator that starts after `.lock` was deleted is refused until the others end; they would overwrite each
    other's files."""
    locks = [ShardLocks(tmp_path) for _ in range(2)]
    (tmp_path / ".lock").unlink()
    for each in locks:
        with pytest.raises(ConfigError, match=r"\.lock must exist while generators run .* wait for their end"):
            ShardLocks(tmp_path)
        assert not (tmp_path / ".lock").exists()
        each.close()
    for each in [ShardLocks(tmp_path) for _ in range(2)]:
        each.close()
    with locked(tmp_path / ".lock", "run", "no;"):  # by a training whose run is the data set's folder
        ShardLocks(tmp_path).close()


def test_a_deleted_folder_is_locked_again(tmp_path):
    """The one that is made in its place, unless another process has made and locked it before."""
    run = tmp_path / "run"
    refused = pytest.raises(ConfigError, match="run must be a folder of its own")
    with locked(run / ".lock", "run", "no;"):
        for number in range(2):
            run.rename(tmp_path / str(number))
            make_again(run)
            make_again(run)
            with refused, locked(run / ".lock", "run", "no;"):
                pass
            with locked(tmp_path / str(number) / ".lock", "run", "no;"):
                pass
        run.rename(tmp_path / "deleted")
        run.mkdir()
        other = os.open(run, os.O_RDONLY)
        fcntl.flock(other, fcntl.LOCK_EX)
        for _ in range(2):
            with refused:
                make_again(run)
        os.close(other)
        make_again(run)
    with locked(run / ".lock", "run", "no;"):
        pass


STRANGE = {
    "link": lambda path: path.symlink_to(path.with_name("target")),
    "dangling link": lambda path: path.symlink_to(path.with_name("missing")),
    "pipe": os.mkfifo,
    "folder": Path.mkdir,
    "socket": lambda path: os.mknod(path, stat.S_IFSOCK),
    "device": lambda path: os.mknod(path, stat.S_IFCHR, os.makedev(1, 3)),
}
LOCKS = {  # what locks a file of a folder, and the file's name
    "run": (".lock", lambda folder: locked(folder / ".lock", "run", "no;").__enter__()),
    "data set": (".lock", ShardLocks),
    "cache": (
        f".{'f' * 64}.tar.partial",
        lambda folder: cached_shard(CachedShard("u", "f" * 64, 1), 0.0, (), lambda *_: None),
    ),
}


@pytest.mark.parametrize("kind", STRANGE)
@pytest.mark.parametrize("lock", LOCKS)
def test_locks_that_are_no_files(tmp_path, monkeypatch, lock, kind):
    """A link, a pipe, a folder, a socket or a device in the place of a lock is refused in one line and left as it is,
    where opening it would wait for ever or change the link's target."""
    (name, take), folder = LOCKS[lock], tmp_path / "shards"
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    folder.mkdir()
    (folder / "target").write_text("mine")
    try:
        STRANGE[kind](folder / name)
    except PermissionError:
        pytest.skip("only root creates devices")
    before = (folder / name).lstat()
    with pytest.raises(ConfigError, match=rf"{name} must be a file, got a link, pipe, device or folder; delete it"):
        take(folder)
    assert (folder / name).lstat() == before and (folder / "target").read_text() == "mine"
    assert {path.name for path in folder.iterdir()} == {name, "target"}
