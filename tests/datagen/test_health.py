"""/healthz at a port of its own."""

import asyncio
import http.client
import json
import socket
from contextlib import ExitStack, closing

from datagen.service import health
from datagen.service.health import HealthPage
from datagen.service.server import make_app, telling
from datagen.service.supervisor import PoolState


def ask(port):
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=60)) as connection:
        connection.request("GET", "/healthz")
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read())


def test_the_last_report_is_answered(monkeypatch):
    """Beside 100 connections that send nothing, too; a service that reports nothing for long is not well."""
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    with HealthPage(listener) as page, ExitStack() as stack:
        assert ask(port) == (503, {"status": "the service has not begun"})
        page.tell(200, {"status": "ok"})
        for _ in range(100):
            stack.enter_context(socket.create_connection(("127.0.0.1", port)))
        assert ask(port) == (200, {"status": "ok"})
        monkeypatch.setattr(health, "SILENCE_S", -1.0)
        assert ask(port) == (503, {"status": "the service has not reported for 0 s"})


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
