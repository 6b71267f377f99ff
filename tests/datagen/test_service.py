"""Tests the service: its files, its access control, and its handling of faults."""

import asyncio
import json
import multiprocessing
import os
import re
import select
import signal
import socket
import sys
import threading
import time
from collections import Counter
from typing import Any
from urllib.parse import unquote

import crowd
import pytest
from processes import exit_code, processes_of_session, start_module, wait_until
from written_files import Recorder

import datagen.service.server
import datagen.service.supervisor
import hgn.data.verification
from datagen.pool.progress import Progress
from datagen.service.__main__ import main
from datagen.service.server import make_app
from datagen.service.supervisor import PoolState, Supervisor
from hgn.data.manifest import Manifest, ShardEntry
from hgn.data.storage import TOKEN_VARIABLE
from hgn.data.verification import file_sha256

TOKEN = "correct-horse-battery"
SHARD = "/train-000002-000004.tar"


@pytest.fixture(autouse=True)
def no_long_pauses(monkeypatch):
    monkeypatch.setattr(datagen.service.supervisor, "_FIRST_PAUSE_S", 0.1)


async def request(app, path, method="GET", **headers):
    """Sends a request to a service, without a network: status, headers, body."""
    sent: list[dict[str, Any]] = []

    async def receive():
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message):
        sent.append(message)

    path, _, query = path.partition("?")
    scope = {
        "type": "http",
        "asgi": {"version": "3.0", "spec_version": "2.4"},
        "method": method,
        "path": unquote(path),
        "raw_path": path.encode(),
        "query_string": query.encode(),
        "root_path": "",
        "server": ("127.0.0.1", 80),
        "headers": [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()],
    }
    await app(scope, receive, send)
    body = b"".join(message.get("body", b"") for message in sent[1:])
    return sent[0]["status"], {k.decode(): v.decode() for k, v in sent[0]["headers"]}, body


@pytest.fixture
def ask(folder):
    """Sends a request to a service of `folder` that has just begun."""

    def ask(path, method="GET", token=None, **headers):
        app = make_app(folder, token, lambda: PoolState("running", 2, 3, 8, 6, {0: (4, 2)}))
        return asyncio.run(request(app, path, method, **headers))

    return ask


def test_manifest_and_its_etag(ask, folder):
    """The manifest is served as it is; whoever has it already is told so in a few bytes."""
    status, headers, body = ask("/manifest.json")
    assert status == 200 and body == (folder / "manifest.json").read_bytes()
    assert ask("/manifest.json", if_none_match=headers["etag"])[::2] == (304, b"")
    assert ask("/manifest.json", if_none_match='"other"')[0] == 200
    assert ask("/manifest.json", method="HEAD")[1] == headers


def test_index(ask, folder):
    """The service sends the index's files up to the sizes in the manifest, whole or in part."""
    path = folder / "index" / "1-000000.jsonl"
    content = path.read_bytes()
    path.write_bytes(content + b"not yet published")
    assert ask("/index/1-000000.jsonl")[::2] == (200, content)
    assert ask("/index/1-000000.jsonl", range="bytes=100-")[::2] == (206, content[100:])
    assert ask(f"/index/1-{5000 * '1'}.jsonl")[0] == 404


def test_many_ask_at_once(folder, monkeypatch):
    """After a publication the manifest is read once, and each line of the index once; a
    shard that many want is hashed once; and who asks whether the service lives waits for none of these."""
    work: Counter[str] = Counter()
    hash_may_end = threading.Event()

    def counted(name, real):
        return lambda *arguments: (work.update([name]), real(*arguments))[1]

    def slow(path):
        assert hash_may_end.wait(60)
        return file_sha256(path)

    def slowly(*arguments, real=Manifest.parse):
        time.sleep(0.1)  # for others to begin, were they let
        return real(*arguments)

    monkeypatch.setattr(Manifest, "parse", staticmethod(counted("parse", slowly)))
    monkeypatch.setattr(ShardEntry, "__post_init__", counted("line", ShardEntry.__post_init__))
    monkeypatch.setattr(hgn.data.verification, "file_sha256", counted("hash", slow))

    async def crowd():
        app = make_app(folder, None, PoolState)
        await asyncio.gather(*(request(app, path) for path in 16 * ["/manifest.json", "/progress"]))
        readers = [asyncio.create_task(request(app, SHARD)) for _ in range(60)]
        while not work["hash"]:
            await asyncio.sleep(0)
        await asyncio.sleep(0.2)
        assert (await request(app, "/healthz"))[0] == 200 and not any(reader.done() for reader in readers)
        hash_may_end.set()
        return await asyncio.gather(*readers)

    assert {answer[::2] for answer in asyncio.run(crowd())} == {(200, (folder / SHARD[1:]).read_bytes())}
    assert work == {"parse": 1, "line": 7, "hash": 1}


def test_shards_with_ranges(ask, folder):
    """A shard comes whole or in part; its ETag is its sha256; a range beyond the end is refused."""
    content = (folder / SHARD[1:]).read_bytes()
    status, headers, body = ask(SHARD)
    assert status == 200 and body == content and headers["accept-ranges"] == "bytes"
    entry = next(shard for shard in Manifest.load(folder).shards if shard.name == SHARD[1:])
    assert headers["etag"] == f'"{entry.sha256}"' and "no-cache" in headers["cache-control"]
    for given, start, stop in (("100-199", 100, 200), ("100-", 100, len(content)), ("-7", len(content) - 7, None)):
        status, headers, body = ask(SHARD, range=f"bytes={given}")
        assert status == 206 and body == content[start:stop]
    status, headers, _ = ask(SHARD, range=f"bytes={len(content)}-")
    assert status == 416 and headers["content-range"] == f"bytes */{len(content)}"
    assert ask(SHARD, range="bytes=5-2")[0] == 400
    assert ask(SHARD, range="bytes=0-9", if_range=f'"{entry.sha256}"')[2] == content[:10]
    assert ask(SHARD, range="bytes=0-9", if_range='"of another shard"')[2] == content
    assert ask(SHARD, if_none_match=f'W/"x", "{entry.sha256}"')[::2] == (304, b"")


OUTSIDE = ("/../outside.txt", "/%2e%2e/outside.txt", "/%2e%2e%2foutside.txt", "//etc/passwd", f"{SHARD}/", "/")
OTHERS = ("/.lock", "/.staging/train-000000.tar", "/train-000090-000091.tar", "/.train-000002-000004.tar.1.partial")
NO_INDEX = ("1-000001.jsonl", "2-000000.jsonl", "1-segments.jsonl", "..%2fmanifest.json", "1-x.jsonl")
WRONG = (None, TOKEN, f"Bearer {TOKEN[:-1]}", "Bearer ")
REFUSALS = [  # the path, the method, the service's token, what is given as one; the answer
    # what is not in the manifest does not exist: locks, staged and half-written files, paths that lead out
    *((path, "GET", None, None, 404) for path in (*OUTSIDE, *OTHERS, *(f"/index/{name}" for name in NO_INDEX))),
    *((SHARD, method, None, None, 405) for method in ("POST", "PUT", "DELETE", "PATCH")),
    # every path but /healthz asks for the token
    *((path, "GET", TOKEN, given, 401) for given in WRONG for path in ("/manifest.json", SHARD, "/metrics", "/no")),
    *((path, "GET", TOKEN, f"Bearer {TOKEN}", 200) for path in (SHARD, "/progress")),
    ("/healthz", "GET", TOKEN, None, 200),
]


def test_refusals(ask, folder):
    """The service sends only published files, and none without the token. Only the methods GET and HEAD have an
    effect."""
    (folder.parent / "outside.txt").write_text("secret")
    for name in OTHERS[2:]:
        (folder / name[1:]).write_bytes(b"not listed")
    for path, method, token, given, expected in REFUSALS:
        headers = {"authorization": given} if given else {}
        status, answer, body = ask(path, method=method, token=token, **headers)
        assert status == expected, (path, method, given)
        if status == 401:
            assert answer["www-authenticate"] == "Bearer" and TOKEN.encode() not in body


def test_a_page_elsewhere_cannot_ask(ask):
    """Without a token only requests that name this machine are answered: a browser's page may have given it a name."""
    own = [(host, None, 200) for host in ("127.0.0.1:80", "localhost", "[::1]:8000")]
    others = ("evil.example", "127.0.0.1.evil.example:80", "localhost@evil.example", "10.0.0.1", "")
    for host, token, status in (*own, *((host, None, 421) for host in others), ("data.example", TOKEN, 200)):
        given = {} if token is None else {"authorization": f"Bearer {token}"}
        assert ask("/manifest.json", token=token, host=host, **given)[0] == status, host


def test_damage_is_not_served(ask, folder):
    """A shard that was altered, cut or taken away, and a manifest of another version, are answered with an error. So
    is storage that fails; readers wait for it."""
    shard = folder / SHARD[1:]
    content = bytearray(shard.read_bytes())
    content[5000] ^= 1
    for damaged in (content, content[:1024]):
        shard.write_bytes(damaged)
        status, _, body = ask(SHARD)
        assert status == 410 and body.startswith(b"train-000002-000004.tar is damaged here; delete it and run")
    shard.unlink()
    assert ask(SHARD)[::2] == (404, b"train-000002-000004.tar is missing here; it must be generated again\n")
    shard.symlink_to(shard)
    assert ask(SHARD)[0] == 503
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps(manifest | {"schema_version": 99}))
    for path in ("/manifest.json", SHARD, "/healthz", "/progress"):
        status, _, body = ask(path)
        assert status == 503 and b"schema_version must be 1, got 99" in body
    (folder / "manifest.json").unlink()
    assert ask("/manifest.json")[::2] == (503, b"the data set has no manifest yet; try again later\n")
    (folder / "manifest.json").mkdir()
    assert ask("/healthz")[0] == ask("/progress")[0] == 503


def test_progress_and_metrics(ask):
    """Both report the published episodes and the pool's state. The metrics are valid Prometheus text."""
    progress = json.loads(ask("/progress")[2])
    assert progress["episodes"]["train"] == {"requested": 5, "published": 5} and progress["complete"]
    generator = progress["generator"]
    assert generator["status"] == "running" and generator["running"] == [{"frame": 4, "scenes": 2}]
    text = ask("/metrics")[2].decode()
    sample = re.compile(r'([a-z_]+)(\{[a-z]+="[a-z0-9]+"\})? [0-9.]+')
    named = {line.split()[2] for line in text.splitlines() if line.startswith("# TYPE")}
    values = {}
    for line in text.splitlines():
        if not line.startswith("#"):
            match = sample.fullmatch(line)
            assert match and match[1] in named, line
            values[match[1] + (match[2] or "")] = float(line.split()[-1])
    assert values['hgn_episodes_published{split="train"}'] == 5 and values["hgn_generator_starts_total"] == 2


def test_pool_that_says_nothing_is_started_again(make_config, monkeypatch):
    """A pool that was stopped, or hangs (in a folder that does not answer, say), is ended and started again."""
    monkeypatch.setattr(datagen.service.supervisor, "_LOOK_S", 0.01)
    started: list[Any] = []

    class Process:
        exitcode = None

        def __init__(self, connection):
            self.connection = connection

        def kill(self):
            self.exitcode = -signal.SIGKILL
            self.connection.close()

        def join(self):
            pass

    def start_child(target, *arguments, **options):
        here, there = multiprocessing.Pipe(duplex=False)
        started.append(Process(there))
        if len(started) > 1:
            there.send(("complete",))
            there.close()
        return started[-1], here

    monkeypatch.setattr(datagen.service.supervisor, "start_child", start_child)
    recorder = Recorder()
    with Supervisor(make_config(worker_silence_s=0.05), recorder) as supervisor:
        wait_until(lambda: supervisor.state.status == "complete")
    assert len(started) == 2 and "the pool ended (it sent nothing for 0 s); it is started" in recorder.messages[0]


def test_full_disk_is_waited_for(make_config, backend, tmp_path):
    """A pool that the machine is in the way of ends, and begins again by itself when it is not."""
    blocked = tmp_path / "blocked"
    blocked.write_text("in the way")
    recorder = Recorder()
    config = make_config(folder=str(blocked / "data"), training_scenes=1, validation_scenes=0, test_scenes=0)
    with Supervisor(config, recorder, backend) as supervisor:
        wait_until(lambda: supervisor.state.status == "waiting")
        assert "Not a directory" in supervisor.state.error
        blocked.unlink()
        wait_until(lambda: supervisor.state.status == "complete")
    assert Manifest.load(blocked / "data").complete and supervisor.state.error == ""


@pytest.mark.parametrize("error", [BrokenPipeError(32, "Broken pipe"), OSError(28, "No space left"), KeyError("fault")])
def test_log_that_nobody_reads(make_config, monkeypatch, error):
    """Generation continues if the log's reader ends, or if its disk is full. An internal error ends the service, and
    the reported state of the generator is correct."""

    class Log(Progress):
        def message(self, text):
            raise error

    outcomes = iter([("died", "SIGKILL"), ("complete", "")])
    monkeypatch.setattr(Supervisor, "_run_once", lambda self: next(outcomes))
    ended: list[str] = []
    supervisor = Supervisor(make_config(), Log())
    supervisor.on_unusable = lambda: ended.append(supervisor.unusable or "")
    with supervisor:
        supervisor._thread.join()
    if isinstance(error, OSError):
        assert supervisor.state.status == "complete" and not ended and error.strerror in supervisor.state.log_error
    else:
        assert supervisor.state.status == "failed" and ended == ["the pool's supervisor failed: KeyError('fault')"]


def run_service(arguments, monkeypatch):
    return exit_code(main, "service", arguments, monkeypatch)


def test_what_cannot_be_served(monkeypatch, capsys, tmp_path, folder):
    """A port in use, a token that is too short, a data set of another version and a file that is no shard end the
    service with one line before it makes anything."""
    monkeypatch.chdir(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        taken = listener.getsockname()[1]
        assert run_service([f"port={taken}"], monkeypatch) == 2
    errors = capsys.readouterr().err
    assert errors.startswith(f"error: host and port must be available, got 127.0.0.1:{taken} (Address already")
    mapping = json.loads((folder / "manifest.json").read_text()) | {"schema_version": 99}
    (folder / "manifest.json").write_text(json.dumps(mapping))
    assert run_service([f"out={folder}", "port=0"], monkeypatch) == 2
    assert "schema_version must be 1, got 99" in capsys.readouterr().err
    monkeypatch.setenv(TOKEN_VARIABLE, "short")
    assert run_service(["port=0"], monkeypatch) == 2
    assert "HGN_DATASET_TOKEN must be 16 or more" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["data"]
    (tmp_path / "made").mkdir()  # what only the pool finds out ends the service too
    (tmp_path / "made" / "train-000000-000001.tar").write_bytes(b"no tar")
    monkeypatch.delenv(TOKEN_VARIABLE)
    assert run_service(["out=made", "port=0", "progress=off"], monkeypatch) == 2
    assert "train-000000-000001.tar must be a complete tar" in capsys.readouterr().err


@pytest.mark.parametrize("early", [True, False])
@pytest.mark.parametrize("numbers", [[signal.SIGTERM], [signal.SIGTERM, signal.SIGHUP], [signal.SIGHUP] * 2])
def test_signals_end_the_service(monkeypatch, tmp_path, early, numbers):
    """Also before the server runs, and a closed terminal. No signal interrupts the end."""

    class Server:
        should_exit = False

        def __init__(self, *_, **__):
            if early:
                list(map(signal.raise_signal, numbers))

        def run(self, sockets):
            if not early:
                list(map(signal.raise_signal, numbers))
            assert self.should_exit

    monkeypatch.setattr(datagen.service.server, "make_server", Server)
    monkeypatch.setattr(Supervisor, "_run", lambda _: None)
    assert run_service([f"out={tmp_path}", "port=0", "progress=off"], monkeypatch) == 128 + numbers[0]


@pytest.mark.skipif(sys.platform != "linux", reason="looks for orphans in /proc")
def test_stopping_leaves_a_resumable_folder(backend, control, tmp_path):
    """After SIGTERM the service ends with code 143 and stops its pool. No process remains, and no file is incomplete.
    This holds even if nobody reads the log. test_kills.py tests `kill -9`."""
    (control / "slow").touch()
    arguments = ["out=made", "scenes=3", "dataset.validation_scenes=0", "dataset.test_scenes=0", "dataset.frames=5"]
    unread, log = os.pipe()
    os.set_blocking(log, False)
    while select.select([], [log], [], 0)[1]:
        os.write(log, bytes(4096))
    os.set_blocking(log, True)
    folder = tmp_path / "made"
    options = (*arguments, "port=0", "dataset.workers=1")
    process = start_module("ballistic_service", *options, cwd=tmp_path, stderr=log)
    wait_until(lambda: (folder / "manifest.json").exists() and Manifest.load(folder).revision >= 1)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 143
    wait_until(lambda: not processes_of_session(process.pid))
    os.close(unread), os.close(log)
    assert not list(folder.rglob("*.partial"))
    assert Manifest.load(folder).revision >= 1 and not Manifest.load(folder).complete


@pytest.mark.slow
def test_a_crowd_of_readers(tmp_path):
    """A hundred readers get every shard whole while it is generated, and /healthz answers at its own port."""
    crowd.main(10.0, 100, tmp_path / "crowd.json")
    figures = json.loads((tmp_path / "crowd.json").read_text())["figures"]
    assert figures["errors"] == [] and max(figures["memory_mb"]) < 150
    assert figures["answers"] > 100 * 32 and figures["healthz_s"]["samples"] > 0
