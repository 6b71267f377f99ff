"""Local workers as threads of this process: the same code without the seconds that a process takes to start."""

import multiprocessing
import os
import signal
import socket
import sys
import threading

import ballistic_solver
import pytest

from datagen.pool import local_workers


class KilledError(BaseException):
    """Ends a worker's thread like SIGKILL."""


def be_killed():
    raise KilledError


class ThreadProcess:
    """A thread in place of a worker's process. It ends when the pool closes the connection, or is killed by itself."""

    exitcode = None

    def __init__(self, connection, target, *arguments):
        self._call = connection, target, arguments
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def _work(self):
        connection, target, arguments = self._call
        send = local_workers._Sender(connection)
        try:
            with local_workers._errors_sent(send):
                target(connection, send, *arguments)
        except KilledError:
            self.exitcode = -signal.SIGKILL
        except SystemExit:
            pass  # its pool has gone
        with socket.socket(fileno=os.dup(connection.fileno())) as end:
            end.shutdown(socket.SHUT_RDWR)  # not closed, because the worker's other threads may be reading

    def join(self, timeout=None):
        self._thread.join(timeout)


def start_thread(run, target, *arguments):
    here, there = multiprocessing.Pipe()
    return ThreadProcess(there, target, *arguments), here


class ThreadWorker(local_workers.LocalWorker):
    def dismiss(self, deadline_s):
        pass

    def kill(self):
        self.connection.close()  # the thread ends at its next word
        self.process.join()


@pytest.fixture
def threads(monkeypatch):
    """Workers of the pool are threads, also those that the stand-in for the solver kills."""
    monkeypatch.setattr(local_workers, "start_child", start_thread)
    monkeypatch.setattr(local_workers, "LocalWorker", ThreadWorker)
    monkeypatch.setattr(ballistic_solver, "be_killed", be_killed)
    monkeypatch.setattr(os, "_exit", sys.exit)  # of a worker whose pool has gone: its thread ends
