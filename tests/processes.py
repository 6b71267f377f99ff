"""Processes that tests start, and waiting for them; commands in this one."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hgn.command import run_command

TESTS = Path(__file__).parent
BALLISTIC_PATH = os.pathsep.join([str(TESTS.parent), str(TESTS / "datagen")])  # the stand-in for the solver on it
PATIENCE_S = 600.0  # what hangs ends after it; no test expects a time


def wait_until(condition, seconds=PATIENCE_S):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)


def start_module(module, *arguments, **options):
    """Starts `python -m MODULE`, perhaps one with the stand-in for the solver, in a session of its own."""
    environment = os.environ | {"PYTHONPATH": BALLISTIC_PATH}
    return subprocess.Popen(
        [sys.executable, "-m", module, *arguments], env=environment, start_new_session=True, **options
    )


def completed(process):
    """It, with all that it printed, once it has ended."""
    output, errors = process.communicate(timeout=PATIENCE_S)
    return subprocess.CompletedProcess(process.args, process.returncode, output, errors)


def write_program(path, text):
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)


def exit_code(command, name, arguments, monkeypatch):
    """Of a command that runs here as its module runs it."""
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with pytest.raises(SystemExit) as ended:
        run_command(command, name)
    return ended.value.code


def free_port():
    """One of this machine at which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


def answers(port):
    """Whether somebody listens at a port of this machine."""
    with socket.socket() as caller:
        return caller.connect_ex(("127.0.0.1", port)) == 0


def run_compiled(python, folder, program, *arguments):
    """Runs a program of the tests with Triton compiling into `folder`, not interpreting; what it printed."""
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    environment |= {"TRITON_CACHE_DIR": str(folder), "PYTHONPATH": str(TESTS.parent)}
    command = [str(python), str(TESTS / program), *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def processes_of_session(session):
    """The processes of a session that are still running (Linux)."""
    running = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(fields[3]) == session and fields[0] != "Z":
            running.append(int(path.parent.name))
    return running
