"""Data sets at a URL: the same episodes as in a folder, whatever the network, the server and the cache do."""

import contextlib
import dataclasses
import errno
import fcntl
import io
import os
import re
import threading
import urllib.request
from pathlib import Path

import fsspec
import numpy as np
import pytest
from processes import PATIENCE_S, exit_code, free_port
from serving import serving

import hgn.data.storage
from datagen.service.server import make_app
from datagen.service.supervisor import PoolState
from hgn.data import shard_cache
from hgn.data.manifest import Manifest
from hgn.data.reader import EpisodeStore
from hgn.data.shard_cache import CACHE_VARIABLE, LIMIT_VARIABLE, cache_folder
from hgn.data.storage import TOKEN_VARIABLE, StorageError, is_remote, open_storage
from hgn.schema import ConfigError
from hgn.system.patience import UnreachableError, without_patience

TOKEN = "correct-horse-battery"


@pytest.fixture(autouse=True)
def _token(cache, monkeypatch):
    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)


def in_memory(folder, name):
    """A copy of a data set in fsspec's memory."""
    files = fsspec.filesystem("memory")
    for path in (*folder.glob("*.tar"), folder / "manifest.json", *folder.glob("index/*")):
        files.pipe(f"/{name}/{path.relative_to(folder)}", path.read_bytes())
    return f"memory://{name}"


def brought(url, entry=None, **options):
    """The path of a shard, the first one, in the cache."""
    entry = entry or Manifest.load(url).shards[0]
    return open_storage(url).shard(entry.name, entry.sha256, entry.bytes, **options)


@pytest.fixture
def serve(folder):
    """Starts the service's server, without a pool, on a port of its own: its URL."""
    with contextlib.ExitStack() as running:

        def start(token=None, port=0):
            _, port = running.enter_context(serving(make_app(folder, token, PoolState), port, connections=16))
            return f"http://127.0.0.1:{port}"

        start.stop = running.close
        yield start


def same_episodes(one, other):
    pairs = zip(one, other, strict=True)
    return all(a.key == b.key and np.array_equal(a.position_TN3, b.position_TN3) for a, b in pairs)


def test_url_or_folder():
    """URLs are told from folders by their protocol; file:// is a folder."""
    assert is_remote("http://host:1") and is_remote("s3://bucket/data") and is_remote("memory://x")
    assert not is_remote("data/obstacles") and not is_remote(Path("/data")) and not is_remote("file:///data")
    for url in (
        "gopher://host",
        "http://[::1",
        "http://h:99999/x",
        "http://h:x/",
        "http://a..b/x",
        f"http://{64 * 'a'}/x",
        "http://",
        "s3://",
        "data://x",
        "jupyter://x",
    ):
        with pytest.raises(ConfigError, match=f"dataset.folder must be a folder or a URL.*, got '{re.escape(url)}'"):
            open_storage(url)


def test_service_gives_what_the_folder_holds(folder, serve, cache):
    """Over HTTP the same episodes come, from a cache that names shards by their sha256."""
    store = EpisodeStore(serve(), "train")
    assert same_episodes(store, EpisodeStore(folder, "train"))
    names = {f"{shard.sha256}.tar" for shard in store.manifest.shards_of("train")}
    assert {path.name for path in cache.iterdir()} == names


def test_manifest_is_sent_once(folder, serve, monkeypatch):
    """Polling a manifest that has not changed costs no more than asking."""
    monkeypatch.setattr("datagen.service.server._FRESH_S", -1.0)  # each poll looks
    url, sizes = serve(), []
    store = EpisodeStore(url, "train")
    files = open_storage(url)._files
    real = files.cat_file
    monkeypatch.setattr(files, "cat_file", lambda *a, **k: sizes.append(len(data := real(*a, **k))) or data)
    assert not store.refresh()
    manifest = Manifest.load(folder)
    dataclasses.replace(manifest, revision=99).save(folder, manifest.shards)
    assert not store.refresh() and store.manifest.revision == 99
    assert sizes[0] == 0 and sizes[1] > 1000


def test_growing_data_set(make_config, make_dataset, serve, folder):
    """A data set that grows behind its URL is seen to grow; shards that are known stay where they are."""
    store = EpisodeStore(serve(), "train")
    first = store[0].position_TN3
    make_dataset(make_config(training_scenes=9))
    assert store.refresh() and len(store) == 9 and np.array_equal(store[0].position_TN3, first)
    store.fetch_ahead()
    assert same_episodes(store, EpisodeStore(folder, "train"))


def test_same_names_do_not_collide(make_config, make_dataset, tmp_path):
    """Two data sets whose shards have the same names, in one cache, are kept apart."""
    folders = [make_dataset(make_config(folder=str(tmp_path / name), frames=n)) for name, n in (("a", 4), ("b", 7))]
    stores = [EpisodeStore(in_memory(folder, f"collide{i}"), "train") for i, folder in enumerate(folders)]
    assert [store.manifest.shards[0].name for store in stores] == ["train-000000-000001.tar"] * 2
    assert [store[0].frame_count for store in stores] == [4, 7]
    for store, folder in zip(stores, folders, strict=True):
        assert same_episodes(store, EpisodeStore(folder, "train"))


def test_ranks_share_the_cache(folder, serve, cache):
    """Readers of one machine that want the same shards at once each get them whole; each is fetched once."""
    url, barrier, keys = serve(), threading.Barrier(2), []

    def read():
        store = EpisodeStore(url, "train")
        barrier.wait()
        keys.append([episode.key for episode in store])

    readers = [threading.Thread(target=read) for _ in range(2)]
    for reader in readers:
        reader.start()
    for reader in readers:
        reader.join(PATIENCE_S)
    assert keys[0] == keys[1] == [entry.key for entry in EpisodeStore(folder, "train").entries]
    with urllib.request.urlopen(f"{url}/metrics") as answer:
        text = answer.read().decode()
    (line,) = [line for line in text.splitlines() if line.startswith('hgn_http_responses_total{code="206"}')]
    segments = len(readers)  # each reader reads the index
    assert int(line.split()[-1]) == Manifest.load(folder).totals["train"].shards + segments
    assert not list(cache.glob("*.partial"))


def partial_of(entry, cache):
    """Where a shard is fetched to."""
    cache.mkdir(parents=True, exist_ok=True)
    return cache / f".{entry.sha256}.tar.partial"


@pytest.mark.parametrize("left", [b"", b"prefix", b"garbage", b"too long"])
def test_fetching_goes_on_where_it_ended(folder, cache, left, monkeypatch):
    """Bytes that a killed process had fetched are used, unless they are wrong."""
    monkeypatch.setattr(hgn.data.storage, "_CHUNK_BYTES", 1000)
    url = in_memory(folder, f"resume-{left.decode().replace(' ', '-')}")
    entry = Manifest.load(url).shards[0]
    content = (folder / entry.name).read_bytes()
    fetched = {b"prefix": content[:5000], b"garbage": b"?" * 5000, b"too long": content + b"?"}.get(left, b"")
    partial_of(entry, cache).write_bytes(fetched)
    reads: list[int] = []
    files = open_storage(url)._files
    real = files.cat_file
    monkeypatch.setattr(files, "cat_file", lambda *a, **k: reads.append(k["start"]) or real(*a, **k))
    path = brought(url, entry)
    assert path.read_bytes() == content and [p.name for p in cache.iterdir()] == [path.name]
    assert reads[0] == (5000 if left in (b"prefix", b"garbage") else 0)
    assert (0 in reads) == (left != b"prefix")


def test_damaged_cache_is_mended(folder, cache, capsys):
    """A shard that changed on this machine's disk is fetched again."""
    url = in_memory(folder, "mended")
    path = brought(url)
    path.write_bytes(b"?" * path.stat().st_size)
    os.utime(path, ns=(1, 1))
    assert brought(url).read_bytes()[:5] == b"train"
    assert "it was altered; it is fetched again" in capsys.readouterr().err


@pytest.mark.parametrize("more", [512, -512])
def test_an_index_that_claims_another_size_removes_nothing(folder, cache, more):
    """A cached shard of another set whose sha256 such an index names stays, and the claim is refused."""
    url = in_memory(folder, "claimed")
    path, entry = brought(url), Manifest.load(url).shards[0]
    claimed = dataclasses.replace(entry, bytes=entry.bytes + more)
    with pytest.raises(StorageError, match=rf"train-.*\.tar must have {claimed.bytes} bytes, got {entry.bytes} of its"):
        brought(url, claimed)
    assert path.read_bytes() == (folder / entry.name).read_bytes()


def test_altered_or_cut_shards_are_refused(folder, cache):
    """A shard that differs from the manifest is refused, and is never stored in the cache."""
    url, files = in_memory(folder, "altered"), fsspec.filesystem("memory")
    first, second, *_ = Manifest.load(url).shards_of("train")
    content = (folder / first.name).read_bytes()
    files.pipe(f"/altered/{first.name}", content[:700] + b"?" + content[701:])
    files.pipe(f"/altered/{second.name}", content[: second.bytes // 2])
    store = EpisodeStore(url, "train")
    with pytest.raises(ConfigError, match=r"memory://altered/train-.*\.tar must have sha256 [0-9a-f]{64}, got other"):
        store[0]
    with pytest.raises(ConfigError, match=rf"must have {second.bytes} bytes, got {second.bytes // 2}; it is truncated"):
        store[1]
    files.rm(f"/altered/{second.name}")
    with pytest.raises(ConfigError, match="is listed in the index but missing"):
        store[1]
    assert list(cache.iterdir()) == []


def test_shards_that_other_processes_remove(folder, cache, monkeypatch):
    """A shard that a process with the same full cache removes before it is opened is fetched again, several times."""
    store, expected = EpisodeStore(in_memory(folder, "removed"), "train"), EpisodeStore(folder, "train")[0]
    read, removed = hgn.data.storage._Folder.read, []

    def remove_first(files, name, *given):
        if len(removed) < 3:
            removed.append((files._folder / name).unlink())
        return read(files, name, *given)

    monkeypatch.setattr(hgn.data.storage._Folder, "read", remove_first)
    assert np.array_equal(store[0].position_TN3, expected.position_TN3) and len(removed) == 3


@pytest.mark.parametrize("full", ["limit", "disk"])
def test_full_cache(folder, cache, monkeypatch, full):
    """A data set larger than the cache's limit, or than its disk, can be read repeatedly: the oldest shards are
    removed. Shards that are only fetched ahead remove none."""
    room = 30_000  # of 51,200 bytes in four shards
    if full == "limit":
        monkeypatch.setenv(LIMIT_VARIABLE, str(room / 1e9))
    else:

        class OnFullDisk(io.FileIO):
            def write(self, content):
                content = content[: room - sum(path.stat().st_size for path in cache.iterdir())]
                if not content:
                    raise OSError(errno.ENOSPC, "No space left on device")
                return super().write(content)

        def opened(path, mode, opener):
            return io.BufferedRandom(OnFullDisk(path, "a+", opener=opener))

        monkeypatch.setattr("hgn.data.shard_cache.open", opened, raising=False)
    url = in_memory(folder, f"large-{full}")
    store, expected = EpisodeStore(url, "train"), EpisodeStore(folder, "train")
    store.fetch_ahead()
    assert store._fetcher
    store._fetcher.join()
    kept = sorted(cache.glob("*.tar"))
    assert 0 < store._fetched < len(store.manifest.shards) and len(kept) == 2
    for _ in range(2):
        for mine, other in zip(store, expected, strict=True):
            assert np.array_equal(mine.position_TN3, other.position_TN3)
            assert sum(path.stat().st_size for path in cache.glob("*.tar")) <= room
    assert sorted(cache.glob("*.tar")) != kept
    monkeypatch.setenv(LIMIT_VARIABLE, "1e-9")
    for path in cache.glob("*.tar"):
        path.unlink()
    with pytest.raises(OSError, match="the cache is full"):
        store[0]


def test_clock_that_was_set_back(folder, cache, monkeypatch):
    """The oldest shards are removed first, even if this machine's clock was in the future when they were fetched."""
    url = in_memory(folder, "clock")
    first, second, third, *_ = sorted(Manifest.load(url).shards, key=lambda shard: -shard.bytes)
    os.utime(brought(url, first), (2**33, 2**33))
    kept = brought(url, second)
    monkeypatch.setenv(LIMIT_VARIABLE, str((second.bytes + third.bytes) / 1e9))
    expected = sorted([kept, brought(url, third)])
    assert sorted(cache.glob("*.tar")) == expected


@pytest.mark.parametrize("patience_s", [0.0, 0.2, 1e6])
def test_who_fetches_was_stopped(folder, cache, monkeypatch, patience_s):
    """A process that was stopped while it fetched a shard is not waited for without end, and not at all by a training
    that ends."""
    monkeypatch.setattr(shard_cache, "_STALLED_S", 0.1)
    url = in_memory(folder, "stopped")
    entry = Manifest.load(url).shards[0]
    with partial_of(entry, cache).open("wb") as partial, contextlib.ExitStack() as stack:
        fcntl.flock(partial, fcntl.LOCK_EX)
        if patience_s == 1e6:
            stack.enter_context(without_patience())
        with pytest.raises(UnreachableError, match="another process is fetching it"):
            brought(url, patience_s=patience_s)


def test_no_data_set_there(serve):
    """A URL without a manifest is told apart from one that does not answer."""
    fsspec.filesystem("memory").pipe("/empty/readme", b"")
    assert not EpisodeStore.available("memory://empty")
    with pytest.raises(ConfigError, match=r"memory://empty/manifest\.json must be the manifest of a data set, got no"):
        EpisodeStore("memory://empty", "train")
    assert not EpisodeStore.available(serve() + "/elsewhere")


def test_token(folder, serve, monkeypatch):
    """The token of the environment opens the service; without it, or with another one, the message names it."""
    url = serve(TOKEN)
    for token in (None, "another-token-of-ours"):
        if token:
            monkeypatch.setenv(TOKEN_VARIABLE, token)
        hgn.data.storage.remote_storage.cache_clear()
        with pytest.raises(ConfigError, match="must be accessible, got access refused; set HGN_DATASET_TOKEN"):
            EpisodeStore(url, "train")
    monkeypatch.setenv(TOKEN_VARIABLE, TOKEN)
    hgn.data.storage.remote_storage.cache_clear()
    assert same_episodes(EpisodeStore(url, "train"), EpisodeStore(folder, "train"))


def test_server_that_comes_back(folder, serve):
    """A reader waits for a service that restarts, and meanwhile continues with its present episodes."""
    url = serve()
    store = EpisodeStore(url, "train")
    _ = store[0]
    serve.stop()
    assert not store.refresh() and store[0].key == "train-000000"
    threading.Timer(0.5, serve, kwargs={"port": int(url.rpartition(":")[2])}).start()
    assert same_episodes(store, EpisodeStore(folder, "train"))


def test_command_without_its_server(monkeypatch, capsys):
    """If the server stays unreachable, the command ends with exit code 1 and one line with the remedy."""
    url = f"http://127.0.0.1:{free_port()}"
    assert exit_code(lambda _: Manifest.load(url, patience_s=0.01), "datagen", [], monkeypatch) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: no answer for 0 s (last cause: ") and error.count("\n") == 1
    assert error.endswith(f"{url}/manifest.json; check its server or disk and run the same command again\n")


def test_addresses_of_ipv6():
    """fsspec would take the first :: for the end of a protocol."""
    url = f"http://user:word@[::1]:{free_port()}/set"
    with pytest.raises(UnreachableError, match="Cannot connect to host ::1:"):
        Manifest.load(url, patience_s=0.01)


def test_server_that_is_away_is_not_asked_at_once_again(folder, serve, monkeypatch):
    """Looking for news at a machine that is off costs one wait in a while, and a split is read without it."""
    url = serve()
    store = EpisodeStore(url, "train")
    _ = store.of_split("validation")[:]
    serve.stop()
    assert not store.refresh()
    files = open_storage(url)._files
    monkeypatch.setattr(files, "cat_file", lambda *a, **k: pytest.fail("it was asked"))
    assert not store.refresh() and same_episodes(store.of_split("validation"), EpisodeStore(folder, "validation"))


def test_what_is_within_reach(folder, serve, cache, monkeypatch):
    """`within_reach` is False for an absent server, and for a shard that a stopped process is fetching. It is True for
    a local shard, for one that comes immediately, and for one that another process is fetching."""
    monkeypatch.setattr(shard_cache, "_STALLED_S", 0.1)
    url = serve()
    store = EpisodeStore(url, "train")
    assert store.within_reach([0, 1], patience_s=0)
    third = list(store.manifest.shards_of("train"))[2]
    with partial_of(third, cache).open("wb") as partial:
        fcntl.flock(partial, fcntl.LOCK_EX)
        assert not store.within_reach([2], patience_s=0)
        monkeypatch.setattr(shard_cache.patience.without, "wait", lambda _: partial.close())
        assert store.within_reach([2], patience_s=0)
    serve.stop()
    assert store.within_reach([0, 1], patience_s=0) and not store.within_reach([1, 4], patience_s=0)
    assert EpisodeStore(folder, "train").within_reach(range(5), patience_s=0)


FILE_SYSTEM = rf"{CACHE_VARIABLE} must name a folder on a file system with file locks, got .*shards \(Function not"
FAULTS = [  # of the cache: a call that fails and its error, or what lies in the way; the message
    *(((os, "fsync", number), OSError, ": .*cache/shards/.*tar") for number in (errno.ENOSPC, errno.EIO, errno.EFBIG)),
    ((fcntl, "flock", errno.ENOSYS), ConfigError, FILE_SYSTEM),  # as on Lustre without -o flock
    ("a link", ConfigError, "must be a file, got a link"),
    ("a file", ConfigError, rf"{CACHE_VARIABLE} must name a writable folder .* got .*shards \(Not a directory\)"),
]


@pytest.mark.parametrize(("fault", "error", "message"), FAULTS)
def test_a_cache_that_fails(folder, cache, monkeypatch, tmp_path, fault, error, message):
    """The error names the obstacle in the cache, which stays unchanged, and fetched bytes do not remain there. If the
    folder has no locks or cannot be created, the error asks for another folder. Without the fault the shard is read."""
    url, precious = in_memory(folder, "failing"), tmp_path / "precious"
    precious.write_text("mine")
    store = EpisodeStore(url, "train")

    def failing(*arguments):
        raise OSError(fault[2], os.strerror(fault[2]))

    with monkeypatch.context() as patch:
        if fault == "a link":
            partial_of(store.manifest.shards[0], cache).symlink_to(precious)
        elif fault == "a file":
            patch.setenv(CACHE_VARIABLE, str(precious))
        else:
            patch.setattr(*fault[:2], failing)
        with pytest.raises(error, match=message):
            store[0]
    assert precious.read_text() == "mine" and not [path for path in cache.glob("*") if path.suffix == ".tar"]
    if fault == "a link":
        partial_of(store.manifest.shards[0], cache).unlink()
    assert store[0].key == "train-000000"


def test_damage_at_the_service(folder, serve):
    """A reader of a damaged shard immediately gets an error that names the service."""
    store = EpisodeStore(serve(), "train")
    shard = folder / store.manifest.shards[0].name
    shard.write_bytes(shard.read_bytes()[:-1] + b"?")
    with pytest.raises(ConfigError, match=r"train-000000-000001.tar is damaged on its server; delete it there and"):
        store[0]


def test_cache_folder(monkeypatch, tmp_path):
    """HGN_CACHE names the cache; otherwise it is where programs of this machine keep theirs. A user without a home, as
    in some containers, is told what to name."""
    assert cache_folder() == tmp_path / "cache" / "shards"
    monkeypatch.delenv(CACHE_VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "hgn" / "shards"
    monkeypatch.delenv("XDG_CACHE_HOME")

    def homeless():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", homeless)
    with pytest.raises(ConfigError, match=f"{CACHE_VARIABLE} must name a folder"):
        cache_folder()
