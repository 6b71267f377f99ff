"""Starts child processes that end with their parent."""

import contextlib
import ctypes
import multiprocessing
import os
import signal
import subprocess
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any, BinaryIO

PR_SET_PDEATHSIG = 1  # from linux/prctl.h
ENDED = (EOFError, OSError)  # errors of `recv` if the other process has ended; OSError: in the middle of a message


def die_with_parent(number: int) -> None:
    """Asks Linux, in a child process, to send it the signal `number` when its parent ends for any reason."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, number)


class Program:
    """Runs a command in its own process group. Ctrl-C reaches only this process, which sends SIGINT when it ends."""

    def __init__(self, command: Sequence[str], output: BinaryIO, text: str = "") -> None:
        """Starts the command with `text` as its input. `output` is the file of its messages."""
        self.output = output
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=output,
            preexec_fn=partial(die_with_parent, signal.SIGINT),
            process_group=0,
        )
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError), self._process.stdin:  # the command may have ended already
            self._process.stdin.write(text.encode())

    @property
    def exit_code(self) -> int | None:
        """Returns the exit code, or None while the command runs."""
        return self._process.poll()

    def stop(self, patience_s: float = 0.0) -> None:
        """Ends the group by SIGKILL, and with patience before that by SIGINT, as Ctrl-C does."""
        for number in (signal.SIGINT, signal.SIGKILL)[patience_s == 0 :]:
            if self.exit_code is None:
                os.killpg(self._process.pid, number)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(patience_s if number == signal.SIGINT else None)


def last_message(file: BinaryIO) -> str:
    """Returns the last line of a program's output that is not JSON."""
    file.seek(0, os.SEEK_END)
    file.seek(max(file.tell() - 8192, 0))
    lines = map(str.strip, file.read().decode("utf-8", "replace").splitlines())
    return next((line for line in reversed(list(lines)) if line and not line.startswith("{")), "no message")


def start_child(
    target: Callable[..., None], *arguments: Any, number: int = signal.SIGKILL, duplex: bool = True, daemon: bool = True
) -> tuple[SpawnProcess, Connection]:
    """Starts `target(connection, *arguments)` in a new process, and returns it with this end of the connection.

    The child gets the signal `number` when this process ends. SIGINT is blocked in it, because Ctrl-C reaches the whole
    process group. It is spawned, because a forked Taichi hangs.
    """
    resource_tracker.ensure_running()  # its start unblocks the signal
    context = multiprocessing.get_context("spawn")
    connection, child = context.Pipe(duplex)
    process = context.Process(target=_run, args=(target, number, child, *arguments), daemon=daemon)
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)
    child.close()
    return process, connection


def cause_of_exit(process: SpawnProcess) -> str:
    """Returns a description of a process's end."""
    code = process.exitcode or 0
    return f"ended by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def _run(target: Callable[..., None], number: int, connection: Connection, *arguments: Any) -> None:
    die_with_parent(number)
    parent = multiprocessing.parent_process()
    if parent is None or os.getppid() != parent.pid:
        os._exit(0)
    target(connection, *arguments)
