"""/healthz at a port of its own."""

import asyncio
import http.client
import json
import os
import signal
import socket
from contextlib import ExitStack

import pytest
from processes import wait_until

from datagen.service import health
from datagen.service.health import HealthPage
from datagen.service.server import make_app, telling
from datagen.service.supervisor import PoolState


@pytest.fixture
def page():
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    with HealthPage(listener) as page:
        yield page, port


def ask(port):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    connection.request("GET", "/healthz")
    answer = connection.getresponse()
    content = json.loads(answer.read())
    connection.close()
    return answer.status, content


def test_it_waits_for_nobody(page):
    """What was told last is answered by another process, and beside connections that ask nothing."""
    assert page[0]._process.pid != os.getpid()
    told, port = page
    assert ask(port) == (503, {"status": "the service has not begun"})
    told.tell(200, {"status": "ok"})
    wait_until(lambda: ask(port) == (200, {"status": "ok"}))
    with ExitStack() as stack:
        for _ in range(100):
            stack.enter_context(socket.create_connection(("127.0.0.1", port)))
        assert ask(port)[0] == 200


def test_a_process_that_is_stopped_holds_nobody_up(page):
    """Telling does not wait; what was told last is answered once the process goes on."""
    told, port = page
    assert ask(port)[0] == 503
    os.kill(told._process.pid, signal.SIGSTOP)
    for number in range(5000):
        told.tell(200, {"status": f"{number} {1000 * 'x'}"})
    os.kill(told._process.pid, signal.SIGCONT)
    wait_until(lambda: ask(port)[0] == 200)
    told.tell(200, {"status": "ok"})
    wait_until(lambda: ask(port) == (200, {"status": "ok"}))


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_process_that_is_gone_is_replaced(page, monkeypatch, number):
    """A process that was killed, or takes nothing for long, is replaced: who asks meanwhile is answered then."""
    monkeypatch.setattr(health, "SILENCE_S", 0.0)
    told, port = page
    wait_until(lambda: ask(port)[0] == 503)
    first = told._process
    os.kill(first.pid, number)

    def tell():
        told.tell(200, {"status": f"ok {1000 * 'x'}"})
        return told._process is not first

    wait_until(tell)
    told.tell(200, {"status": "ok"})
    wait_until(lambda: ask(port) == (200, {"status": "ok"}))
    assert first.returncode == -signal.SIGKILL


def test_silence_is_told(monkeypatch):
    """A service that says nothing for long is not well, whatever it said last."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with ours, theirs:
        theirs.setblocking(False)
        page = health._Page(theirs)
        ours.send(b'[200, {"status": "ok"}]')
        page.listen()
        assert page._page().startswith(b"HTTP/1.1 200 OK") and page._page().endswith(b'{"status": "ok"}')
        monkeypatch.setattr(health, "SILENCE_S", -1.0)
        assert page._page().startswith(b"HTTP/1.1 503") and b"has not moved for 0 s" in page._page()


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
