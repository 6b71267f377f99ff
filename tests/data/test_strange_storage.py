"""Storage that lies, drips or fails: caches, servers, passwords, and errors of the machine."""

import contextlib
import errno
import functools
import hashlib
import os
import re
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from data.test_http import PlainFiles, answering
from training.runs import train_mapping

from datagen import upload
from datagen.pool.plan import ShardRange
from datagen.pool.shard import inspect_shard
from hgn import evaluate, export, rollout, train
from hgn.config import NetworkConfig, TrainingConfig
from hgn.data import storage
from hgn.data.manifest import Manifest
from hgn.data.reader import EpisodeStore, find_episode, first_episodes
from hgn.data.sampler import Sample, SamplerState
from hgn.data.shard_cache import LIMIT_VARIABLE, CachedShard, cached_shard
from hgn.scene.npz import read_npz
from hgn.schema import ConfigError, printable
from hgn.system.patience import VARIABLE, UnreachableError, standard_patience_s
from hgn.training import readers

pytestmark = pytest.mark.usefixtures("cache")


@pytest.mark.parametrize("limit", ["", "0.001", "1000000"])
@pytest.mark.parametrize("size", [10**13, 2**62, 10**30])
def test_a_claimed_size_empties_no_cache(tmp_path, monkeypatch, limit, size):
    """A shard that no cache can contain is refused before anything is fetched or removed for it."""
    monkeypatch.setenv(LIMIT_VARIABLE, limit)
    folder = tmp_path / "cache" / "shards"
    folder.mkdir(parents=True)
    others = [folder / f"{number:064x}.tar" for number in range(7)]
    for path in others:
        path.write_bytes(bytes(1000))
    fetched: list[object] = []
    with pytest.raises(OSError) as error:
        cached_shard(CachedShard("http://x/a.tar", "f" * 64, size), 0.0, (), lambda *given: fetched.append(given))
    assert error.value.errno == errno.ENOSPC
    assert all(path.exists() for path in others) and not fetched


class Shards(PlainFiles):
    """Answers with a shard, or a range of one, of `size` bytes. `end` names the end of the answer's head."""

    size, end, claim = 5000, "", 15_000

    def do_GET(self):  # noqa: N802
        if not self.path.endswith(".tar"):
            super().do_GET()
            return
        start, stop = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", "bytes=0-9999999")).groups()
        content = bytes(self.size)[int(start) : int(stop) + 1] if "ranges" in self.end else bytes(self.size)
        self.send_response(206 if "ranges" in self.end else 200)
        if "length" in self.end:
            self.send_header("Content-Length", str(len(content)))
        if "claimed" in self.end:
            self.send_header("Content-Range", f"bytes {start}-{stop}/{self.claim}")
        if "chunked" in self.end:
            self.send_header("Transfer-Encoding", "chunked")
            content = b"%x\r\n%b\r\n0\r\n\r\n" % (len(content), content)
        self.end_headers()
        self.wfile.write(content)

    def do_HEAD(self):  # noqa: N802
        self.send_response(200)
        self.send_header("Content-Length", str(self.claim))
        self.end_headers()


@pytest.mark.parametrize("ranges", ["", "ranges "])
@pytest.mark.parametrize("length", ["length", "chunked", "no size", "claimed", "length claimed"])
@pytest.mark.parametrize("size", [5000, 50_000])
def test_a_claim_that_its_server_denies_empties_no_cache(data, tmp_path, monkeypatch, ranges, length, size):
    """The index claims a size that the cache could make space for, but the server's file is shorter or longer. The
    cache removes no more of its 20 other files than the written bytes need, whatever size the server reports, or
    repeats."""
    monkeypatch.setenv(LIMIT_VARIABLE, "0.000021")
    monkeypatch.setattr(storage, "_CHUNK_BYTES", 1000)
    monkeypatch.setattr(Shards, "end", ranges + length)
    monkeypatch.setattr(Shards, "size", size)
    folder, manifest = tmp_path / "cache" / "shards", Manifest.load(data.dataset.folder)
    folder.mkdir(parents=True)
    for number in range(20):
        (folder / f"{number:064x}.tar").write_bytes(bytes(1000))
    manifest.save(data.dataset.folder, [replace(shard, bytes=Shards.claim) for shard in manifest.shards])
    server = answering(functools.partial(Shards, directory=data.dataset.folder))
    with server as url, pytest.raises(ConfigError, match="must have "):
        EpisodeStore(url, "train")[0]
    written = min(size, Shards.claim) if ranges else 0
    assert len(list(folder.glob("*.tar"))) == min(20, 21 - written // 1000) and not list(folder.glob(".*"))


@pytest.mark.parametrize("dripping", ["manifest.json", ".tar", "head", "redirects"])
def test_a_server_that_drips_does_not_answer(data, monkeypatch, dripping):
    """A head or a body that is slower than the least speed has the same result as no answer. All heads of a chain of
    redirects have one deadline together."""
    monkeypatch.setenv(VARIABLE, "0")

    class Drip(PlainFiles):
        def drip(self, content):
            with contextlib.suppress(ConnectionError):
                for byte in content:
                    self.wfile.write(bytes([byte]))
                    time.sleep(0.005)

        def do_GET(self):  # noqa: N802
            redirects = int(self.path.partition("?")[2] or 0)
            if dripping == "redirects" and redirects < 9:
                time.sleep(0.1)
                self.send_response(302)
                self.send_header("Location", f"manifest.json?{redirects + 1}")
                self.send_header("Content-Length", "0")
                self.end_headers()
            else:
                super().do_GET()

        def end_headers(self):
            if dripping == "head":
                self.flush_headers()
                self.drip(b"X-Long: " + 300 * b"x" + b"\r\n")
            with contextlib.suppress(ConnectionError):
                super().end_headers()

        def copyfile(self, source, outputfile):
            if self.path.endswith(dripping):
                self.drip(source.read(50))
            with contextlib.suppress(ConnectionError):
                outputfile.write(source.read())

    with answering(functools.partial(Drip, directory=data.dataset.folder)) as url:
        store = EpisodeStore(url, "train") if dripping == ".tar" else None
        assert store is None or len(list(store.entries)) == 5
        monkeypatch.setattr("hgn.data.bounded_http.SLOW_S", 0.0)
        monkeypatch.setattr("hgn.data.bounded_http.LEAST_BYTES_S", 10**12)
        heads = dripping in ("head", "redirects")
        monkeypatch.setattr("hgn.data.bounded_http.HEAD_S", 0.2 if heads else 150.0)
        with pytest.raises(UnreachableError, match="TimeoutError" if heads else "bytes a second") as error:
            (store or EpisodeStore(url, "train"))[0]
        assert heads or error.value.filename.endswith(dripping)


def test_a_server_that_drips_after_a_burst(data, monkeypatch):
    """Bytes that came early do not excuse a drip later."""
    monkeypatch.setenv(VARIABLE, "0")
    monkeypatch.setattr("hgn.data.bounded_http.SILENCE_S", 0.3)
    monkeypatch.setattr("hgn.data.bounded_http.LEAST_BYTES_S", 10**6)
    path = Path(data.dataset.folder) / "manifest.json"
    path.write_bytes(path.read_bytes().ljust(10**7))

    class Drip(PlainFiles):
        def copyfile(self, source, outputfile):
            with contextlib.suppress(ConnectionError):
                outputfile.write(source.read(9 * 10**6))
                for _ in range(200):
                    outputfile.write(source.read(1))
                    time.sleep(0.005)
                outputfile.write(source.read())

    server = answering(functools.partial(Drip, directory=data.dataset.folder))
    with server as url, pytest.raises(UnreachableError, match="bytes a second"):
        EpisodeStore(url, "train")


@pytest.mark.parametrize("content", [b"zz\r\nabc", b"ffffffffffffffffff\r\nabc", b""])
@pytest.mark.parametrize("pause_s", [0, 0.1])
def test_malformed_bodies_end(data, monkeypatch, content, pause_s):
    """An answer whose chunk has no size, with its head or after it, ends like a server that does not answer."""
    monkeypatch.setenv(VARIABLE, "0")
    monkeypatch.setattr("hgn.data.bounded_http.SILENCE_S", 0.2)

    class Malformed(PlainFiles):
        def do_GET(self):  # noqa: N802
            self.send_response(200)
            self.send_header("Transfer-Encoding", "chunked")
            self.end_headers()
            time.sleep(pause_s)
            self.wfile.write(content)

    server = answering(functools.partial(Malformed, directory=data.dataset.folder))
    with server as url, pytest.raises(UnreachableError, match="no answer"):
        EpisodeStore(url, "train")


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("http://user:secret@host:80/a b", "http://host:80/a b"),
        ("https://user:p@ss:w@rd@host/a http://h?x=a@b", "https://host/a http://h?x=a@b"),
        ("got s3://key:se%40cret@bucket, ftp://u@h", "got s3://bucket, ftp://h"),
        ("https://me:pa/ss#w@host/x s3://KEY:se/cret@b/x http://h:80/a", "https://host/x s3://b/x http://h:80/a"),
        *(
            (text.format(password), text.format("").replace("user:@", ""))
            for text in ("http://user:{}@host:80/a", "'http://user:{}@[::1]/a'", "user:{}@h/a", "got x, user:{}@h/a")
            for password in ("80", "80ab", "80#ab", "80?ab", "80@ab", "8:0ab", "pa/ss", "8@a/b", "a/b@c/d", "a@b")
        ),
        # digits before a slash are a port, and what follows is a path
        ("http://host:80/a@b 'http://[fe80:1::2]:80/a@b'", "http://host:80/a@b 'http://[fe80:1::2]:80/a@b'"),
        ("http://[::1]/a@b/c http://user:pa/ss@host/ u:9a/s@h", "http://[::1]/a@b/c http://host/ h"),
        (
            "got 127.0.0.1:8000/a@b, http://h.org:80/a@main/b?c@d",
            "got 127.0.0.1:8000/a@b, http://h.org:80/a@main/b?c@d",
        ),
        ("got 'http://user:80 ab@host/a'", "got 'http://host/a'"),
        ("http://user:80%2F%40%23ab@host/a user:80%2F%40%23ab@h", "http://host/a h"),
        ("C:/a/b@c http://h:80 fails at u/v: a@b", "C:/a/b@c http://h:80 fails at u/v: a@b"),
        ("hf://datasets/a@main/b", "hf://datasets/a@main/b"),
        ("a@b.c file:///x@y http://h/p@q", "a@b.c file:///x@y http://h/p@q"),
        (
            "http://user:se cret@h/a, 'http://u r:se\ncret@h:80/a', http://u:12a b@h",
            "http://h/a, 'http://h:80/a', http://h",
        ),
        ("user:secret@h/a //u:secret@h http:/u:secret@h 'me:se cret@h'", "h/a //h http:/h 'h'"),
        (
            "http://h:80 fails: a@b (x@y), keys: a, b@c; x.yaml: a@b",
            "http://h:80 fails: a@b (x@y), keys: a, b@c; x.yaml: a@b",
        ),
        (
            "http://h/a?X-Amz-Signature=s&n=1&sig=s 'http://h?AWSAccessKeyId=s#token=s'",
            "http://h/a?X-Amz-Signature=…&n=1&sig=… 'http://h?AWSAccessKeyId=…#token=…'",
        ),
        ("h/a?sas=s&hmac=s&bearer=s&session_id=s", "h/a?sas=…&hmac=…&bearer=…&session_id=…"),
        (
            "h?%74oken=s&n=1&api%5Fkey=s&%73%49g=s 'h?a=1;%70%61ss=s'",
            "h?%74oken=…&n=1&api%5Fkey=…&%73%49g=… 'h?a=1;%70%61ss=…'",
        ),
        (
            "h?pw=s&ticket=s&otp=s&sid=s&a[token]=s&b%5Bkey%5D=s&n[]=1",
            "h?pw=…&ticket=…&otp=…&sid=…&a[token]=…&b%5Bkey%5D=…&n[]=1",
        ),
        ("h?hash=s&st=s&k=s&p=s&P=s 'h?K=s;%68ash=s&x_k=s'", "h?hash=…&st=…&k=…&p=…&P=… 'h?K=…;%68ash=…&x_k=…'"),
        ("h?top=1&test=2&mask=3&st_n=4&step=5&clip=6", "h?top=1&test=2&mask=3&st_n=4&step=5&clip=6"),
        *(
            (
                f"got {begin}{20 * 'aB3'}, 'x/{begin}{20 * 'c4'}'; {begin}short",
                f"got {begin}…, 'x/{begin}…'; {begin}short",
            )
            for begin in ("hf_", "ghp_", "gho_", "github_pat_", "glpat-", "sk-", "xoxb-", "AIza", "npm_", "pypi-")
        ),
        (
            plain := "mask-abcdefghijklmnopqrstuvwx, half_abcdefghijklmnopqrstuvwx9, disk-2026-11-30-a-b-c-d-e-f-g",
            plain,
        ),
        ("h?inside=1&resid=2&a[n]=3", "h?inside=1&resid=2&a[n]=3"),
        ("got u@d.com:secret@h/a, 'u@d.com:secret@h/a'", "got h/a, 'h/a'"),
        ("got u@127.0.0.1:80/a@b", "got u@127.0.0.1:80/a@b"),
        (
            "u:se\u00a0cret@h http://u:1\u00a0a b@h got u:se\u00a0cr\u2003et@h password=se\u00a0cret",
            "h http://h got h password=…",
        ),
        ("HF_TOKEN=s HGN_DATASET_TOKEN='s s', got api-key:s; x", "HF_TOKEN=… HGN_DATASET_TOKEN=…, got api-key:…; x"),
        ("'Authorization: Bearer s' authorization: Basic s= x", "'Authorization: …' authorization: … x"),
        (
            "{'password': 's', \"apiKey\": \"s\", b'x-token': b's', 'n': 1}",
            "{'password': …, \"apiKey\": …, b'x-token': …, 'n': 1}",
        ),
        ("headers [('x', 'Bearer s3s3')], bearer arms", "headers [('x', 'Bearer …')], bearer arms"),
        (
            "x.py '+x.Passwd=s s' a=b +x.client_secret=s tokens=[s, s]",
            "x.py '+x.Passwd=…' a=b +x.client_secret=… tokens=…",
        ),
        ("{'secrets': ['s', 's']} secret = \"s s\nPASSWORD: s", "{'secrets': …} secret = …"),
        ("export AWS_SECRET_ACCESS_KEY=s/s+s\ntoken:\n  name: x", "export AWS_SECRET_ACCESS_KEY=…\ntoken:\n  name: x"),
        (text := "HF_TOKEN must be 16 characters, key=3, code: 5; a valid token is needed: secret", text),
        ("http://h/a?frames=3&keyframes=4", "http://h/a?frames=3&keyframes=4"),
        ("\x1b]0;title\x07\x9b31m\u202egpj.\r\udc80", r"\x1b]0;title\x07\x9b31m\u202egpj.\r\udc80"),
        ("two\nlines of ü 日本 🙂", "two\nlines of ü 日本 🙂"),
    ],
)
def test_passwords_and_control_characters(text, shown):
    assert printable(text) == shown == str(ConfigError(text))


def test_long_messages_keep_no_end_of_a_signature():
    """A message is cut before signatures are removed, but not within one of them."""
    shown = str(ConfigError("got http://h?sig=" + 30_000 * "s"))
    assert shown.startswith("got http://h?sig=…") and "s" not in shown[18:]
    assert str(ConfigError(30_000 * "a" + "; give a shorter one")).endswith(" give a shorter one")


def test_no_file_of_a_run_has_the_password(data, tmp_path, capsys, monkeypatch):
    """Commands with a URL with a password write and print the URL, and their command line, without it."""
    run = tmp_path / "run"
    with answering(functools.partial(PlainFiles, directory=data.dataset.folder)) as url:
        mapping = train_mapping(data, run, monitor_every=100)
        mapping["dataset"]["folder"] = secret = url.replace("://", "://user:80%2F%40%23secret-word@")
        monkeypatch.setattr("sys.orig_argv", ["python", "-m", "hgn.train", f"dataset.folder={secret}"])
        assert train.main(mapping) == 0
        weights, options = run / "weights.safetensors", {"data": secret, "device": "cpu", "backend": "torch"}
        export.export(run / "checkpoints" / "last.ckpt", weights)
        options["weights"] = str(weights)
        evaluate.main(options | {"json": str(run / "errors.json"), "scenes": 1, "rollout_frames": 0})
        out = str(run / "rollout.vtkhdf")
        rollout.main(options | {"episode": "validation-000000", "frames": 2, "out": out, "render": True})
    upload.main({"data": data.dataset.folder, "to": "memory://user:secret-word@there"})
    shown = capsys.readouterr()
    assert "secret-word" not in shown.out + shown.err and (run / "rollout.png").is_file()
    assert not [path for path in run.rglob("*") if path.is_file() and b"secret-word" in path.read_bytes()]


@pytest.mark.parametrize("text", ["-1", "x", "nan", "1e9", "10000000", ""])
def test_a_patience_that_is_none(monkeypatch, text):
    monkeypatch.setenv(VARIABLE, text)
    with pytest.raises(ConfigError, match="HGN_PATIENCE_S must be a number of seconds"):
        standard_patience_s()


def test_few_open_files(data):
    """No shard stays open."""
    store = EpisodeStore(data.dataset.folder, "train")
    before = len([*Path("/proc/self/fd").iterdir()]) if Path("/proc/self/fd").exists() else 0
    assert [store[place].frame_count for place in range(len(store))] == 5 * [6]
    after = len([*Path("/proc/self/fd").iterdir()]) if before else 0
    assert after == before


def with_change(folder, split, change):
    """The name of a shard, changed by `change(bytes, places of the first episode's members)`, with a right checksum."""
    manifest = Manifest.load(folder)
    shards = list(manifest.shards)
    place = next(place for place, shard in enumerate(shards) if shard.split == split)
    path = Path(folder) / shards[place].name
    content = bytearray(path.read_bytes())
    change(content, shards[place].episodes[0].members)
    path.write_bytes(content)
    shards[place] = replace(shards[place], sha256=hashlib.sha256(content).hexdigest())
    manifest.save(folder, shards)
    return path.name


def with_value(folder, split, value, member):
    """Gives a shard's last position a value, NaN for example."""

    def change(content, members):
        offset, size = members[member]
        content[offset + size - 4 : offset + size] = np.float32(value).tobytes()

    return with_change(folder, split, change)


@pytest.mark.parametrize("value", [3e38, -1e19, 1e6, np.inf, np.nan])
@pytest.mark.parametrize(
    ("split", "member"), [("train", "position.npy"), ("train", "velocity.npy"), ("validation", "position.npy")]
)
def test_numbers_that_no_network_can_compute_with_are_named(data, tmp_path, split, member, value):
    """A training on them ends with an error that names the shard and the frame, instead of skipping updates."""
    name, rule = with_value(data.dataset.folder, split, value, member), "at most 1000 in size"
    rule = f"{member[:8]} must be {rule if abs(value) < np.inf else 'finite'}, got"
    with pytest.raises(ConfigError, match=f"{name} must be a valid shard, got {split}-.*: {rule}"):
        train.main(train_mapping(data, tmp_path / "run"))


@pytest.mark.parametrize("rate", [b"1e-9", b"30.0"])
def test_a_shard_of_another_frame_rate_is_named(data, tmp_path, rate):
    """The frames before its first one, which follow from its velocity, would be wrong or infinite."""

    def change(content, members):
        at = content.index(b'"frame_rate_hz":60.0', members["json"][0]) + 16
        content[at : at + 4] = rate

    name = with_change(data.dataset.folder, "train", change)
    with pytest.raises(ConfigError, match=rf"{name}: train-.* must have .* frame_rate_hz .*60.*, got .*{float(rate)}"):
        train.main(train_mapping(data, tmp_path / "run"))


def test_interleaved_members_of_an_archive(tmp_path):
    """The members of a trajectory need not follow one another in the file."""
    names = ("b/position", "a/position", "b/particle_type", "c", "a/particle_type")
    np.savez(tmp_path / "train.npz", **{name: np.full(3, number) for number, name in enumerate(names)})
    read = [name for name, _ in read_npz(tmp_path / "train.npz")]
    assert read == ["b/position", "b/particle_type", "a/position", "a/particle_type", "c"]


READS = {
    "index": lambda store: store[0],
    "first_episodes": lambda store: first_episodes(store, 1)[0],
    "find_episode": lambda store: find_episode(store.folder, "train-000000"),
}


@pytest.mark.parametrize("read", READS)
@pytest.mark.parametrize("size", [0, 1000, 100_000])
def test_a_shard_that_is_cut_under_an_episode(data, size, read):
    """An episode that was handed out stays readable; the next one is refused."""
    store = EpisodeStore(data.dataset.folder, "train")
    episode = READS[read](store)
    before = episode.position_TN3.tobytes()
    for path in Path(data.dataset.folder).glob("train*.tar"):
        os.truncate(path, min(size, path.stat().st_size - 1))
    assert episode.position_TN3.tobytes() == before
    with pytest.raises(ConfigError, match=r"must have \d+ bytes, got"):
        store[0]


def window_on_a_cpu(store):
    reader = readers.WindowReader(store, NetworkConfig(), TrainingConfig())
    reader.read(readers.DrawnChunk([[Sample(0, 3, 0)]], SamplerState(), ()))


def whole_on_a_gpu(store):
    readers.EpisodeReader(store, NetworkConfig(), TrainingConfig())._whole([0])


@pytest.mark.parametrize("read", [lambda store: store[0], window_on_a_cpu, whole_on_a_gpu])
def test_a_shard_that_is_cut_while_it_is_read(data, monkeypatch, read):
    """A file of a folder that shrinks after its check is refused. A map of it would end the process, so whole episodes,
    of evaluations and of trainings on a GPU, are read without one."""
    store, folder, verify = EpisodeStore(data.dataset.folder, "train"), Path(data.dataset.folder), storage.verify_file
    monkeypatch.setattr(np, "memmap", lambda *_, **__: pytest.fail("the file is mapped"))
    read(store)

    def cut_after(*given):
        verify(*given)
        for path in folder.glob("train*.tar"):
            os.truncate(path, 512)

    monkeypatch.setattr(storage, "verify_file", cut_after)
    with pytest.raises(ConfigError, match=r"must have \d+ bytes, got 512"):
        read(store)


def test_a_shard_that_is_cut_while_a_generator_checks_it(data, monkeypatch):
    """It is refused: the check reads a member after another, where a map of the file would end the process."""
    entry = max(Manifest.load(data.dataset.folder).shards, key=lambda shard: len(shard.episodes))
    path, part = Path(data.dataset.folder) / entry.name, ShardRange(entry.split, entry.first, entry.stop)
    assert len(entry.episodes) > 1 and inspect_shard(path, part, data) == entry
    monkeypatch.setattr("datagen.pool.shard.episode_statistics", lambda _: os.truncate(path, 512))
    with pytest.raises(ConfigError, match="must lie within 512 bytes"):
        inspect_shard(path, part, data)
