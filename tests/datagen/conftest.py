"""Local workers as threads of this process: the same code without the seconds that a process takes to start."""

import multiprocessing
import os
import sys
import threading

import pytest

from datagen.pool import local_workers


class ThreadProcess:
    """A thread in place of a worker's process. It ends when the pool closes the connection."""

    exitcode = None

    def __init__(self, work):
        self._thread = threading.Thread(target=work, daemon=True)
        self._thread.start()

    def join(self, timeout=None):
        self._thread.join(timeout)

    def kill(self):
        pass


def start_thread(run, target, *arguments):
    here, there = multiprocessing.Pipe()

    def work():
        send = local_workers._Sender(there)
        with local_workers._errors_sent(send):
            target(there, send, *arguments)
        there.close()

    return ThreadProcess(work), here


class ThreadWorker(local_workers.LocalWorker):
    def kill(self):
        self.connection.close()  # the thread ends at its next word
        self.process.join()


@pytest.fixture
def threads(monkeypatch):
    """Workers of the pool are threads. None may be killed, or kill itself."""
    monkeypatch.setattr(local_workers, "start_child", start_thread)
    monkeypatch.setattr(local_workers, "LocalWorker", ThreadWorker)
    monkeypatch.setattr(os, "_exit", sys.exit)  # of a worker whose pool has gone: its thread ends
