"""Processes that tests start, and waiting for them."""

import os
import subprocess
import time
from pathlib import Path

TESTS = Path(__file__).parent
PATIENCE_S = 600.0  # what hangs ends after it; no test expects a time


def wait_until(condition, seconds=PATIENCE_S):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)


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
