"""Child processes that end with their parent."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any

PR_SET_PDEATHSIG = 1  # linux/prctl.h


def die_with_parent(number: int) -> None:
    """Asks Linux, in a child process, to send it the signal `number` when its parent ends for any reason."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, number)


def start_child(
    target: Callable[..., None], *arguments: Any, number: int = signal.SIGKILL, duplex: bool = True, daemon: bool = True
) -> tuple[SpawnProcess, Connection]:
    """Starts `target(connection, *arguments)` in a process of its own, and returns it with this end of the connection.

    The child gets the signal `number` when this process is gone. It is spawned, as a forked Taichi hangs.
    """
    context = multiprocessing.get_context("spawn")
    connection, child = context.Pipe(duplex)
    process = context.Process(target=_run, args=(target, number, child, *arguments), daemon=daemon)
    process.start()
    child.close()
    return process, connection


def cause_of_exit(process: SpawnProcess) -> str:
    """Returns in words how a process ended."""
    code = process.exitcode or 0
    return f"ended by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def _run(target: Callable[..., None], number: int, connection: Connection, *arguments: Any) -> None:
    die_with_parent(number)  # elsewhere than on Linux a child ends when it next touches its closed pipe
    parent = multiprocessing.parent_process()
    if sys.platform == "linux" and (parent is None or os.getppid() != parent.pid):
        os._exit(0)
    target(connection, *arguments)
