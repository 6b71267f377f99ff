"""The command: one line for each fault, exit codes, Ctrl-C, and progress for people and machines."""

import errno
import io
import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from unittest import mock

import pytest
import yaml
from docs.pages import run_module
from processes import PATIENCE_S, exit_code, processes_of_session, start_module, wait_until

from datagen.__main__ import main
from datagen.pool.progress import BarProgress
from hgn.command import run_command
from hgn.config import DatagenConfig, SceneConfig, config_directory
from hgn.data.manifest import Manifest
from hgn.schema import ConfigError, to_mapping

SMALL = ["scenes=3", "dataset.validation_scenes=1", "dataset.test_scenes=0", "dataset.frames=5", "dataset.workers=1"]


def test_no_key_is_taken_for_a_config_group():
    """A key with the name of a folder beside its file could not be set; `scene=file` and `scenes=3` can."""
    conf = config_directory()
    for path in (*conf.glob("*.yaml"), *conf.glob("command/*.yaml")):
        mapping = yaml.safe_load(path.read_text())
        plain = {key for key, value in mapping.items() if not isinstance(value, dict) and key != "defaults"}
        groups = {folder.name for folder in path.parent.iterdir() if folder.is_dir()}
        assert not plain & groups, path


FULL = [  # as libraries report it
    RuntimeError("[host_memory_pool.cpp:allocate_raw_memory@62] Virtual memory allocation (1073741824 B) failed.\n"),
    RuntimeError("[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory: 64 bytes"),
    RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB"),
    RuntimeError("can't start new thread"),
    ImportError("/a/taichi_python.so: failed to map segment from shared object"),
]


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (ConfigError("frames must be 2"), 2, "error: frames must be 2\n"),
        (ConfigError("http://user:secret@host must be"), 2, "error: http://host must be\n"),
        (OSError(errno.ENOSPC, "No space left on device", "b/a.tar"), 1, "error: No space left on device: b/a.tar;"),
        (FileNotFoundError(errno.ENOENT, "No usable temporary directory"), 1, "error: No usable temporary directory; "),
        (PermissionError(errno.EACCES, "Permission denied", "made"), 1, "error: Permission denied: made; check the"),
        (OSError(errno.EMFILE, "Too many open files"), 1, "error: Too many open files; raise the limit of open files"),
        (OSError(errno.ENFILE, "Too many here"), 1, "error: Too many here; close other programs"),
        (OSError(errno.ESTALE, "Stale file handle"), 1, "error: Stale file handle; check the disk"),
        (OSError(errno.EIO, "I/O error", "/b/\x1b[2Ja.tar"), 1, r"error: I/O error: /b/\x1b[2Ja.tar; check the disk"),
        (ConfigError("name must be a\u202eb"), 2, r"error: name must be a\u202eb"),
        (OSError("no number"), 1, "error: no number; check the disk"),
        (MemoryError("Unable to allocate 5 TiB"), 1, "error: memory is full (Unable to allocate 5 TiB)"),
        *((error, 1, "error: memory is full (") for error in FULL),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), 1, "error: Cannot allocate memory; close other programs"),
        (ChildProcessError(errno.ECHILD, "workers keep dying"), 1, "error: workers keep dying; free some memory, or"),
        (KeyboardInterrupt(), 130, "error: interrupted\n"),
        (RuntimeError("a fault"), None, None),
        (ImportError("no name x in y"), None, None),
        (FileNotFoundError(errno.ENOENT, "No such file", "x"), None, None),
        (FileNotFoundError(errno.ENOENT, "No file", "dangling"), 1, "error: No file: dangling; check its folder or"),
        (FileNotFoundError(errno.ENOENT, "No file", "gone/x"), 1, "error: No file: gone/x; check its folder or link"),
        # the kernel's own folders take no files
        *(
            (FileNotFoundError(errno.ENOENT, "No file", path), 1, f"error: No file: {path}; check its folder or link")
            for path in ("/proc/x", "/proc/sys/x.partial")
        ),
    ],
)
def test_faults_end_in_one_line(error, code, message, monkeypatch, capsys, tmp_path):
    """Faults that a person can mend print one line and no traceback; the exit code tells whose fault it is. Ours keep
    their traceback."""

    def fail(mapping):
        raise error

    monkeypatch.chdir(tmp_path)
    Path("dangling").symlink_to("nowhere")
    if code is None:
        monkeypatch.setattr(sys, "argv", ["datagen"])
        with pytest.raises(type(error)):
            run_command(fail, "datagen")
    else:
        assert exit_code(fail, "datagen", [], monkeypatch) == code
        printed = capsys.readouterr().err
        assert printed.startswith(message) and printed.count("\n") == 1


def test_help_and_config_print(tmp_path, monkeypatch, capfd):
    """Hydra's own options work and start nothing."""
    monkeypatch.chdir(tmp_path)

    def printed(*arguments):
        assert run_module("datagen", arguments) == 0
        return capfd.readouterr().out

    assert "generates or completes a data set" in printed("--help")
    output = printed("--cfg", "job", *SMALL)
    assert "training_scenes: 800" in output and yaml.safe_load(output)["scenes"] == 3
    experiment = printed("--cfg", "job", "experiment=demo")
    assert printed("--cfg", "job", "+experiment=demo") == experiment
    assert yaml.safe_load(experiment)["name"] == "demo"
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def command(backend, threads, tmp_path, monkeypatch, capfd):
    """Runs the command here, with workers that are threads: its exit code, output and errors."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        code = exit_code(partial(main, backend=backend), "datagen", list(arguments), monkeypatch)
        return code, *capfd.readouterr()

    return call


def test_makes_completes_and_leaves_alone(command, tmp_path):
    """The command makes a data set from any working folder, reports its completion, and then changes nothing."""
    code, output, errors = command(*SMALL, "out=made")
    assert code == 0 and output == "", errors
    assert errors.splitlines()[-1] == "made is complete: 3 train, 1 validation, 0 test episodes"
    assert "published train-000000-000001.tar (1 episode)" in errors and "\r" not in errors
    manifest = (tmp_path / "made" / "manifest.json").read_bytes()
    code, _, errors = command(*SMALL, "out=made")
    assert (code, errors) == (0, "made is complete: 3 train, 1 validation, 0 test episodes\n")
    assert (tmp_path / "made" / "manifest.json").read_bytes() == manifest
    assert [path.name for path in tmp_path.iterdir() if path.name != "control"] == ["made"]
    code, _, errors = command(*SMALL, "out=made", "scene=no_obstacles")
    assert code == 2 and errors.startswith("error: made contains another data set: scene.group_shapes is")


def test_resolved_config_file(command, make_config, tmp_path):
    """A resolved config in any folder, as the trainer writes one, serves instead of conf/."""
    dataset = make_config(training_scenes=1, validation_scenes=0, test_scenes=0, frames=4).dataset
    config = DatagenConfig(scene=SceneConfig(obstacle_count=1), dataset=dataset)
    (tmp_path / "dataset.yaml").write_text(yaml.safe_dump(to_mapping(config)))
    code, _, errors = command("--config-path", str(tmp_path), "--config-name", "dataset")
    assert code == 0, errors
    assert Manifest.load(dataset.folder).complete
    assert not (tmp_path / "outputs").exists()


def test_json_progress(command):
    """With progress=json standard output is one JSON object a line, and standard error is empty."""
    code, output, errors = command(*SMALL, "out=made", "progress=json")
    assert (code, errors) == (0, "")
    events = [json.loads(line) for line in output.splitlines()]
    assert all(event["time_s"] > 0 for event in events)
    assert events[0]["event"] == "start" and (events[0]["done"], events[0]["total"]) == (0, 4)
    assert [event["done"] for event in events if event["event"] == "episode"] == [1, 2, 3, 4]
    assert [event["revision"] for event in events if event["event"] == "shard"] == [1, 2, 3, 4]


@pytest.mark.skipif(sys.platform != "linux", reason="looks for orphans in /proc")
def test_stopping_leaves_a_resumable_folder(control, command, tmp_path):
    """Ctrl-C, which a launcher repeats, keeps every staged episode and leaves no process; the same command resumes.
    `kill -9` is what test_kills is about."""
    (control / "slow").touch()
    process = start_module("ballistic_command", *SMALL, "out=made", cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    manifest = tmp_path / "made" / "manifest.json"
    wait_until(lambda: manifest.exists() and Manifest.load(manifest.parent).revision >= 1)
    for _ in range(2):
        os.killpg(process.pid, signal.SIGINT)  # a terminal signals the whole group
        time.sleep(0.02)
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    wait_until(lambda: not processes_of_session(process.pid))
    assert "episodes are kept in made: run the same command to resume" in errors and "Traceback" not in errors
    assert not list((tmp_path / "made").rglob("*.partial"))
    (control / "slow").unlink()
    code, _, errors = command(*SMALL, "out=made")
    assert code == 0 and Manifest.load(tmp_path / "made").complete, errors
    seeds = (control / "simulated.log").read_text().split()
    assert len(set(seeds)) == 4 and len(seeds) <= 5  # at most the one in flight twice


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_bar(monkeypatch):
    """On a terminal the bar counts frames of running scenes, and a failed launch takes its frames back; in a log file
    progress is a few plain lines, whatever the number of frames. The time until the first frame is left out."""
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    bar = BarProgress()
    bar.start(1, 3, 100)
    start_s = bar._bar.start_t
    for frame, seconds in ((1, 60.0), (2, 62.0)):  # compilation takes 60 seconds
        bar._bar._time = mock.Mock(return_value=start_s + seconds)
        bar.frame(0, frame, 1)
    assert bar._bar.format_dict["elapsed"] == pytest.approx(2.0)
    for report, frames in (((0, 50, 1), 150), ((0, 0, 0), 100)):
        bar.frame(*report)
        assert bar._bar.n == frames
    bar.episode("train-000001")
    assert bar._bar.n == 200
    bar.message("hello")
    bar.close()
    assert "hello\n" in stream.getvalue() and "episodes 2/3" in stream.getvalue()
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    bar = BarProgress()
    bar.start(0, 2, 100)
    for frame in range(100):
        bar.frame(0, frame, 1)
    bar.shard("train-000000-000001.tar", 1, 1)
    bar.close()
    first, published, last = stream.getvalue().splitlines()
    assert "episodes 0/2" in first and "0/200" in first and "episodes 0/2" in last and "99/200" in last
    assert published == "published train-000000-000001.tar (1 episode)"
