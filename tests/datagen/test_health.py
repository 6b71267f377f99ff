"""/healthz at a port of its own."""

import asyncio
import http.client
import json
import os
import signal
import socket
import threading
from contextlib import ExitStack, closing

import pytest
from processes import wait_until

from datagen.service import health
from datagen.service.health import MOST_OPEN, HealthPage, Page
from datagen.service.server import make_app, telling
from datagen.service.supervisor import PoolState


@pytest.fixture
def page():
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    with HealthPage(listener) as page:
        yield page, port


def ask(port):
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=60)) as connection:
        connection.request("GET", "/healthz")
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read())


def test_the_last_report_is_answered(page):
    """A separate process answers, even with 100 connections that send nothing."""
    told, port = page
    assert told.process.pid != os.getpid()
    assert ask(port) == (503, {"status": "the service has not started"})
    told.tell(200, {"status": "ok"})
    wait_until(lambda: ask(port) == (200, {"status": "ok"}))
    told.tell(503, {"status": 2000 * "\U0001f30a"})
    wait_until(lambda: ask(port)[0] == 503)
    told.tell(200, {"status": "ok"})
    wait_until(lambda: ask(port) == (200, {"status": "ok"}))
    with ExitStack() as stack:
        for _ in range(100):
            stack.enter_context(socket.create_connection(("127.0.0.1", port)))
        assert ask(port) == (200, {"status": "ok"})


def test_silence_is_told(monkeypatch):
    """A service that has not reported for a long time is unhealthy, whatever its last report."""
    with Page(socket.create_server(("127.0.0.1", 0))) as page:
        page.read('[200, {"status": "ok"}]')
        assert page.answer() == (200, b'{"status": "ok"}')
        monkeypatch.setattr(health, "SILENCE_S", -1.0)
        assert page.answer() == (503, b'{"status": "the service has not reported for 0 s"}')


def test_who_never_ends_a_request_keeps_nobody_out(monkeypatch, capsys):
    """Of too many connections that only begin a request the oldest are closed, however long they may wait."""
    monkeypatch.setattr(health._Handler, "timeout", None)
    listener = socket.create_server(("127.0.0.1", 0))
    with Page(listener) as page, ExitStack() as stack:
        threading.Thread(target=page.serve_forever, args=(0.01,), daemon=True).start()
        stack.callback(page.shutdown)
        waiting = [stack.enter_context(socket.create_connection(listener.getsockname())) for _ in range(MOST_OPEN + 5)]
        for connection in waiting:
            connection.sendall(b"GET /heal")
            connection.settimeout(10)
        assert ask(listener.getsockname()[1])[0] == 503
        assert [connection.recv(1) for connection in waiting[:6]] == 6 * [b""]
    assert not capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_process_that_is_gone_is_replaced(page, number):
    """Reports wait for nobody; a process that was killed or stopped is replaced, and the new one answers."""
    told, port = page
    assert ask(port)[0] == 503
    first = told.process
    os.kill(first.pid, number)

    def replaced():
        told.tell(200, {"status": 500 * "x"})
        return told.process is not first

    wait_until(replaced)
    told.tell(200, {"status": "ok"})
    wait_until(lambda: ask(port) == (200, {"status": "ok"}))
    assert first.returncode == -signal.SIGKILL


def test_what_is_told(tmp_path, folder):
    """A service whose manifest can be read is well, one without is not."""

    class Told(list[int]):
        def tell(self, status, content):
            self.append(status)

    async def tell(place, told):
        await telling(told, make_app(place, None, PoolState))()
        while not told:
            await asyncio.sleep(0.01)

    for place, status in ((folder, 200), (tmp_path / "none", 503)):
        told = Told()
        asyncio.run(tell(place, told))
        assert told == [status]
