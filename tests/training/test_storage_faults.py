"""Tests temporary faults of a data set's storage: readers of a training keep their episodes and retry."""

import contextlib
import errno
import fcntl
import functools
import gzip
import http.server
import json
import os
import re
import signal
import threading
from pathlib import Path
from unittest import mock

import pytest
from data.test_http import Quiet, answering
from training.runs import metrics, train_mapping

import hgn.training.session
from hgn import train
from hgn.config import TrainConfig
from hgn.data.reader import EpisodeStore, find_episode, first_episodes
from hgn.data.storage import faults_outlived
from hgn.schema import ConfigError, from_mapping
from hgn.system.files import open_at_once
from hgn.system.locks import locked
from hgn.system.patience import VARIABLE, outlived, without_patience
from hgn.training import callbacks, checkpoint_writer, monitor
from hgn.training.checkpoint import LAST_NAMES, read_checkpoint
from hgn.training.dataset import wait_for_episodes
from hgn.training.stop import StopRequest

HTML = b"<html><body>502 Bad Gateway</body></html>"


@pytest.fixture(autouse=True)
def _quick(cache, monkeypatch):
    monkeypatch.setattr("hgn.system.patience.LONGEST_PAUSE_S", 0.05)
    monkeypatch.setattr("hgn.data.reader.AGAIN_S", 0.0)
    monkeypatch.setattr("hgn.data.storage._AWAY_S", 0.0)


def written(content, name="manifest.json"):
    """A file has another content for a while."""

    @contextlib.contextmanager
    def fault(folder):
        path = Path(folder) / name
        before = path.read_bytes()
        path.write_bytes(content(before) if callable(content) else content)
        try:
            yield
        finally:
            path.write_bytes(before)

    return fault


def renamed(name):
    """The folder, or a file in it, has another name for a while."""

    @contextlib.contextmanager
    def fault(folder):
        path = Path(folder) / name
        other = path.rename(path.with_name(f"{path.name}.away"))
        try:
            yield
        finally:
            other.rename(path)

    return fault


def older(before):
    """Returns a manifest without any shards."""
    head = json.loads(before)
    empty = {"shards": 0, "episodes": 0, "bytes": 0, "digest": "", "statistics": None}
    index = {"generation": head["index"]["generation"]}
    return json.dumps(head | {"revision": 0, "index": index, "totals": {"train": empty}}).encode()


def other_set(before):
    return json.dumps(json.loads(before) | {"config": {}, "config_hash": "0" * 64}).encode()


def more(index, totals=()):
    """A manifest with larger numbers than its index has."""

    def content(before):
        head = json.loads(before)
        for part, keys in ((head["index"], index), (head["totals"]["train"], totals)):
            part.update({key: part[key] + 1 for key in keys})
        return json.dumps(head).encode()

    return written(content)


FAULTS = {
    "generation": more(["generation"]),
    "a shard more": more(["shards"], ["shards"]),
    "an episode more": more(["shards", "segment_bytes"], ["shards", "episodes"]),
    "missing": renamed("manifest.json"),
    "folder renamed": renamed("."),
    "brace": written(b"{"),
    "empty": written(b""),
    "html": written(HTML),
    "no text": written(bytes(range(256))),
    "older": written(older),
    "other set": written(other_set),
}


def faulty(folder, name):
    return FAULTS[name](Path(folder).resolve())


@pytest.mark.parametrize("name", FAULTS)
def test_a_manifest_that_is_away_for_a_moment(data, name, capsys, monkeypatch):
    """The episodes stay, one line reports the fault, and the next refresh finds the manifest. After the patience it is
    an error, whose remedy is not to delete the manifest. Outside a training it is an error immediately."""
    store = EpisodeStore(data.dataset.folder, "train")
    with faulty(data.dataset.folder, name), pytest.raises((ConfigError, OSError)):
        store.refresh()
    with faults_outlived():
        with faulty(data.dataset.folder, name):
            assert not store.refresh() and len(store) == 5
            store.ask_again()
            assert capsys.readouterr().err.count("continuing with") == 1
        store.ask_again()
        with faulty(data.dataset.folder, name):
            assert not store.refresh()
            assert "continuing with 5 episodes for 120 s" in capsys.readouterr().err
            monkeypatch.setenv(VARIABLE, "0")
            with pytest.raises((ConfigError, OSError)) as error:
                store.ask_again()
            assert "delete manifest" not in str(error.value)
    assert not store.refresh()


def failing_at_first(real):
    """Calls `real` after an error of each of these kinds."""
    numbers = [errno.ESTALE, errno.EIO, errno.EROFS, errno.EACCES, errno.ENOENT]

    def call(*given, **options):
        if numbers:
            raise OSError(number := numbers.pop(), os.strerror(number))
        return real(*given, **options)

    return call


def of_the_index(content):
    return lambda folder: written(content, next(folder.glob("index/*-000000.jsonl")).relative_to(folder))(folder)


def lines_of(line):
    """As many lines of as many bytes as before."""
    return lambda before: b"".join(line.ljust(len(row) - 1) + b"\n" for row in before.splitlines(True))


AWAY = {
    "shard": renamed,
    "index": lambda _: renamed("index"),
    "folder": lambda _: renamed("."),
    "cut": lambda shard: written(lambda before: before[:700], shard),
    "altered": lambda shard: written(lambda before: before[:-1] + b"?", shard),
    "read": lambda _: lambda folder: mock.patch("hgn.data.storage.open_at_once", failing_at_first(open_at_once)),
    **{f"index of {line!r}": lambda _, line=line: of_the_index(lines_of(line)) for line in (b"{}", b"5", b"null")},
    "index of others": lambda _: of_the_index(functools.partial(re.sub, rb"[0-9a-f]{64}", 64 * b"0")),
    "index in another order": lambda _: of_the_index(lambda before: b"".join(before.splitlines(True)[::-1])),
    "another split": lambda _: of_the_index(lambda before: before.replace(b'"split":"train"', b'"split":"other"')),
}


@pytest.mark.parametrize("opened", [False, True, "evaluate", "rollout"])
@pytest.mark.parametrize("away", AWAY)
def test_files_that_are_away_for_a_moment(data, away, opened, monkeypatch):
    """Reading an episode, or lines of the index, waits for what is renamed, cut or altered, or cannot be opened: in a
    training, and as evaluations and rollouts read."""
    folder = Path(data.dataset.folder).resolve()
    store = EpisodeStore(folder, "train")
    _ = opened is True and store[0]
    monkeypatch.setattr("hgn.data.reader.EpisodeStore", lambda *_: store)  # whose manifest was read before
    fault = AWAY[away](store.manifest.shards[0].name)(folder)
    fault.__enter__()
    timer = threading.Timer(0.15, fault.__exit__, (None, None, None))
    timer.start()
    with faults_outlived() if isinstance(opened, bool) else contextlib.nullcontext():
        episodes = {
            "evaluate": lambda: first_episodes(store, 5),
            "rollout": lambda: [find_episode(folder, f"train-00000{place}") for place in range(5)],
        }.get(opened, lambda: [store[place] for place in range(5)])()
    assert [episode.frame_count for episode in episodes] == 5 * [6]
    timer.join()


def test_a_file_that_stays_altered(data, capsys, monkeypatch):
    """The line about the wait and the error say what is wrong with it, and not that its folder does not answer."""
    monkeypatch.setattr("hgn.system.patience.FIRST_PAUSE_S", 1.01)
    monkeypatch.setenv(VARIABLE, "1.5")
    store = EpisodeStore(data.dataset.folder, "train")
    fault = r"train-.*\.tar must have sha256 .*: it was altered; use an intact copy, or delete it and .* import the set"
    with (
        AWAY["altered"](store.manifest.shards[0].name)(Path(data.dataset.folder)),
        pytest.raises(ConfigError, match=fault),
        faults_outlived(),
    ):
        _ = store[0]
    assert re.search(fault + " again; retrying for 2 s", told := capsys.readouterr().err) and "answer" not in told


class Server(Quiet, http.server.SimpleHTTPRequestHandler):
    """A file server that answers each request with the next of `answers` first."""

    answers: list[tuple[int, bytes, dict[str, str]]] = []  # noqa: RUF012 - one list for all requests

    def do_GET(self):
        if not self.answers:
            super().do_GET()
            return
        status, body, headers = self.answers.pop(0)
        if status == 206:
            first, last = map(int, self.headers.get("Range", "bytes=0-9")[6:].split("-"))
            body = (1 + last - first) * body
        self.send_response(status)
        for name, value in ({"Content-Length": str(len(body))} | headers).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)


ANSWERS = [
    *((status, HTML, {}) for status in (404, 401, 503, 200, 410, 429, 500, 407)),
    *((200, body, {}) for body in (b"[]", b"{}", b"null", HTML.ljust(10**5))),
    *((200, HTML, headers) for headers in ({"Content-Length": "9999"}, {"Content-Length": "9"})),
    (200, gzip.compress(HTML), {"Content-Encoding": "gzip"}),
    (302, b"", {"Location": "/login.html"}),
    *((206, body, {"Content-Range": "bytes 0-9/99"}) for body in (b"\0", b"?", b"??")),
]


@pytest.mark.parametrize(
    ("status", "body", "headers"), ANSWERS, ids=[f"{i}: {row[0]}" for i, row in enumerate(ANSWERS)]
)
def test_answers_that_pass(data, status, body, headers):
    """Any refusal of a server is outlived, of the manifest and of a shard; so are a page and other bytes instead."""
    with answering(functools.partial(Server, directory=data.dataset.folder)) as url, faults_outlived():
        store = EpisodeStore(url, "train")
        Server.answers += [(status, body, headers)]
        assert not store.refresh() and len(store) == 5
        store.ask_again()
        list(store.entries)
        Server.answers += 3 * [(status, body, headers)]
        assert store[0].frame_count == 6
        store = EpisodeStore(f"{url}/.", "train")
        Server.answers += 3 * [(status, body, headers)]
        assert len(list(store.entries)) == 5
    assert not Server.answers


def test_a_server_whose_index_is_shorter_than_its_manifest_says(data, capsys, monkeypatch):
    """The index is not waited for, because the next manifest may be right."""
    monkeypatch.setenv(VARIABLE, "1")
    with answering(functools.partial(Server, directory=data.dataset.folder)) as url, faults_outlived():
        store = EpisodeStore(url, "train")
        with faulty(data.dataset.folder, "an episode more"):
            assert not store.refresh() and len(store) == 5
        assert "no answer for 0 s" in capsys.readouterr().err
        assert not store.refresh() and len(list(store.entries)) == 5


@pytest.mark.parametrize("name", ["brace", "empty", "html", "no text", "other set"])
def test_faults_while_a_training_waits_for_episodes(data, tmp_path, monkeypatch, name):
    """A manifest that breaks after the first look is read again; without patience it ends the wait."""
    mapping = train_mapping(data, tmp_path, minimum_episodes=9)
    mapping["dataset"]["training_scenes"] = 9
    config = from_mapping(TrainConfig, {key: value for key, value in mapping.items() if key != "name"})
    stop, (fault, again) = StopRequest(), (faulty(data.dataset.folder, name) for _ in range(2))
    ends = (lambda: None, lambda: fault.__exit__(None, None, None), lambda: setattr(stop, "signal", signal.SIGTERM))
    steps = iter((fault.__enter__, *ends, again.__enter__))
    monkeypatch.setattr("hgn.training.dataset.time.sleep", lambda _: next(steps)())
    generator = mock.Mock(running=True, frames_done=lambda: 0, found=0, kept=0)
    assert wait_for_episodes(config, generator, stop) is None
    monkeypatch.setenv(VARIABLE, "0")
    stop.signal = None
    with pytest.raises(ConfigError):
        wait_for_episodes(config, generator, stop)
    assert not list(steps)


def test_a_folder_of_a_run_that_fails_for_a_moment(data, tmp_path, monkeypatch):
    """Checkpoints, pictures and log lines that cannot be written are written later, each of them once."""
    for place, name in ((checkpoint_writer, "make_folder"), (callbacks, "_drop_cut_line"), (monitor, "write_pictures")):
        monkeypatch.setattr(place, name, failing_at_first(getattr(place, name)))
    assert train.main(train_mapping(data, tmp_path / "run", monitor_every=100, monitor_rollout_frames=2)) == 0
    lines = [line["update"] for line in metrics(tmp_path / "run") if "loss" in line]
    assert lines == sorted(set(lines)) and list((tmp_path / "run" / "pictures").iterdir())
    assert read_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")["hgn"]["updates"] == lines[-1]


def test_writes_wait_while_readers_end(tmp_path):
    """The end of the feed, after the last update, ends the waits of its readers, and not that for a checkpoint."""
    with without_patience():
        assert outlived(failing_at_first(lambda: 3), tmp_path / "last.ckpt") == 3


def test_a_training_outlives_a_fault(data, tmp_path, monkeypatch):
    """A damaged manifest at the start does not end a training. Without patience the training ends with an error and a
    checkpoint of its last update, from which it resumes."""
    started, run, again, calls = hgn.training.session.train_network, tmp_path / "run", EpisodeStore.ask_again, []

    def later(store):
        calls.append(store)
        if len(calls) > 8:
            again(store)

    def broken(*arguments):
        with faulty(data.dataset.folder, "other set"):
            return started(*arguments)

    monkeypatch.setattr(hgn.training.session, "train_network", broken)
    assert train.main(train_mapping(data, tmp_path / "whole", monitor_every=100)) == 0
    monkeypatch.setenv(VARIABLE, "0")
    monkeypatch.setattr(EpisodeStore, "ask_again", later)
    options = {"monitor_every": 100, "checkpoint_every": 100, "maximum_updates": 20}
    with pytest.raises((ConfigError, OSError)):
        train.main(train_mapping(data, run, **options))
    updates = read_checkpoint(run / "checkpoints" / "last.ckpt")["hgn"]["updates"]
    assert 0 < updates < 20
    monkeypatch.setattr(hgn.training.session, "train_network", started)
    assert train.main(train_mapping(data, run, **options)) == 0
    assert metrics(run)[-1]["update"] == 20


@pytest.mark.parametrize("every", [{"log_every": 3, "checkpoint_every": 100}, {"checkpoint_every": 2}])
def test_a_run_whose_folder_is_deleted(data, tmp_path, monkeypatch, every):
    """The folder is created and locked again, and the training continues."""
    run, before, refused = tmp_path / "run", callbacks.LogLines.on_train_batch_end, []

    def deleting(lines, trainer, module, *rest):
        if module.update == 6:
            run.rename(tmp_path / "deleted")
        before(lines, trainer, module, *rest)
        if module.update == 9:
            with (
                pytest.raises(ConfigError, match="run must be a folder of its own"),
                locked(run / ".lock", "run", "no;"),
            ):
                pass
            refused.append(module.update)

    monkeypatch.setattr(callbacks.LogLines, "on_train_batch_end", deleting)
    monkeypatch.setenv(VARIABLE, "2")
    assert train.main(train_mapping(data, run, loggers=[], **every)) == 0 and refused
    assert read_checkpoint(run / "checkpoints" / "last.ckpt")["hgn"]["updates"] == metrics(run)[-1]["update"] == 12


@pytest.mark.parametrize("every", [{"log_every": 3, "checkpoint_every": 100}, {"checkpoint_every": 2}])
def test_a_run_whose_folder_is_another_trainings(data, tmp_path, monkeypatch, every):
    """Another training starts in the place of the deleted folder. The first one ends, and writes nothing there."""
    run, before, other = tmp_path / "run", callbacks.LogLines.on_train_batch_end, []

    def deleting(lines, trainer, module, *rest):
        if module.update == 6:
            run.rename(tmp_path / "deleted")
            run.mkdir()
            other.append(os.open(run, os.O_RDONLY))
            fcntl.flock(other[0], fcntl.LOCK_EX)
        before(lines, trainer, module, *rest)

    monkeypatch.setattr(callbacks.LogLines, "on_train_batch_end", deleting)
    monkeypatch.setenv(VARIABLE, "2")
    with pytest.raises(ConfigError, match="another training is in it"):
        train.main(train_mapping(data, run, loggers=[], **every))
    assert {path.name for path in run.iterdir()} <= {".lock"}
    os.close(*other)


def without_checkpoints(run):
    """The run, whose checkpoints have another name for a while."""
    return renamed("checkpoints")(run)


def test_checkpoints_that_are_away_at_the_start(finished, capsys, monkeypatch):
    """The start waits for the checkpoints that a run has saved. If they stay away, it is refused, and it begins anew
    without the mark that the refusal names. A run that was killed before its first checkpoint begins anew."""
    data, run = finished
    fault = without_checkpoints(run)
    fault.__enter__()
    timer = threading.Timer(0.3, fault.__exit__, (None, None, None))
    timer.start()
    assert train.main(train_mapping(data, run, maximum_updates=16)) == 0
    timer.join()
    assert "resuming at update 12" in capsys.readouterr().err and metrics(run)[-1]["update"] == 16
    monkeypatch.setenv(VARIABLE, "0")
    with without_checkpoints(run):
        with pytest.raises(ConfigError, match=r"run must be a folder with the checkpoints .* delete .*run/\.saved to"):
            train.main(train_mapping(data, run))
        assert metrics(run)[-1]["update"] == 16
        (run / ".saved").unlink()
        assert train.main(train_mapping(data, run, maximum_updates=1, checkpoint_every=100)) == 0
        (run / "checkpoints").rename(run / "new")


@pytest.mark.parametrize("changes", [{}, {"checkpoint_every": 100}, {"checkpoint_every": 100, "monitor_every": 2}])
@pytest.mark.parametrize("names", [LAST_NAMES, LAST_NAMES[1:]])
def test_no_save_replaces_a_later_checkpoint(finished, monkeypatch, changes, names):
    """Checkpoints of later updates that come back while a training runs stay as they are, and it ends with a line."""
    data, run = finished
    (run / ".saved").unlink(missing_ok=True)
    for name in set(LAST_NAMES) - set(names):
        (run / "checkpoints" / name).unlink()
    kept = {path.name: path.read_bytes() for path in (run / "checkpoints").iterdir()}
    fault, started = without_checkpoints(run), callbacks.Checkpoints.on_train_start

    def back(checkpoints, *rest):
        started(checkpoints, *rest)
        fault.__exit__(None, None, None)

    monkeypatch.setattr(callbacks.Checkpoints, "on_train_start", back)
    fault.__enter__()
    rule = r"run must be a folder without checkpoints after update \d, got .*ckpt of update 1\d; start again"
    with pytest.raises(ConfigError, match=rule):
        train.main(train_mapping(data, run, maximum_updates=8, **changes))
    assert {path.name: path.read_bytes() for path in (run / "checkpoints").iterdir()} == kept


def test_a_run_in_a_mounted_bucket(data, tmp_path, monkeypatch):
    """Mounted object stores may have no hard links, no locks and no truncation. A run does without, and a line of
    metrics that was cut is removed as ever."""
    run, refused = tmp_path / "run", mock.Mock(side_effect=OSError(errno.EIO, os.strerror(errno.EIO)))
    monkeypatch.setattr(os, "link", refused)
    monkeypatch.setattr(os, "truncate", refused)
    monkeypatch.setattr(fcntl, "flock", mock.Mock(side_effect=OSError(errno.ENOSYS, "no locks")))
    assert train.main(train_mapping(data, run, maximum_updates=6)) == 0
    whole = (run / "metrics.jsonl").read_bytes()
    (run / "metrics.jsonl").write_bytes(whole + b'{"update": 8, "lo')
    assert train.main(train_mapping(data, run)) == 0
    assert (run / "metrics.jsonl").read_bytes().startswith(whole)
    assert [record["update"] for record in metrics(run) if "loss" in record] == [4, 6, 8, 12]
    assert {path.name for path in (run / "checkpoints").iterdir()} == {*LAST_NAMES, "best.ckpt"}
    updates = [read_checkpoint(run / "checkpoints" / name)["hgn"]["updates"] for name in LAST_NAMES]
    assert updates == sorted(updates, reverse=True) and updates[0] == 12
    monkeypatch.setattr(callbacks, "_drop_cut_line", refused)
    monkeypatch.setenv("HGN_PATIENCE_S", "1")
    with pytest.raises(OSError, match="Input/output error"):  # before the first update there is nothing to save
        train.main(train_mapping(data, run, maximum_updates=16))
