"""Files that the kernel sends: whole, in ranges, one after the other on a connection, or not at all."""

from __future__ import annotations

import asyncio
import hashlib
import http.client
import logging
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from datagen.service.sendfile import EXTENSION, FileRange
from datagen.service.server import make_server

SIZE = 5_000_001


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "file"
    path.write_bytes(hashlib.shake_128(b"file").digest(SIZE))
    return path


@pytest.fixture
def port(file: Path) -> Iterator[int]:
    async def answer(request: Request) -> Response:
        assert EXTENSION in request.scope["extensions"]
        return FileRange(file, SIZE, {"etag": '"tag"'}, "application/octet-stream")

    listener = socket.create_server(("127.0.0.1", 0))
    server = make_server(Starlette(routes=[Route("/file", answer)]), connections=8)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    yield listener.getsockname()[1]
    server.should_exit = True
    thread.join()


class LoopOfUvloop(asyncio.SelectorEventLoop):
    """As far as it differs: it cannot send files."""

    sendfile = asyncio.AbstractEventLoop.sendfile


@pytest.fixture
def uvloop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Installed, as with Uvicorn's own extras: Uvicorn takes it where nobody asks for a loop."""
    monkeypatch.setitem(sys.modules, "uvloop", SimpleNamespace(new_event_loop=LoopOfUvloop))
    monkeypatch.delitem(sys.modules, "uvicorn.loops.uvloop", raising=False)


@pytest.mark.usefixtures("uvloop")
def test_uvloop_is_left_alone(port: int, file: Path) -> None:
    """Where it is installed files come all the same."""
    connection = http.client.HTTPConnection("127.0.0.1", port)
    connection.request("GET", "/file")
    with connection.getresponse() as response:
        assert response.read() == file.read_bytes()
    connection.close()


def test_ranges_on_one_connection(port: int, file: Path) -> None:
    """Many answers come over one connection, each with just the bytes that were asked for."""
    content, connection = file.read_bytes(), http.client.HTTPConnection("127.0.0.1", port)
    for asked, status, start, stop in (
        (None, 200, 0, SIZE),
        ("bytes=0-0", 206, 0, 1),
        ("bytes=7-3000006", 206, 7, 3_000_007),
        ("bytes=-3000000", 206, SIZE - 3_000_000, SIZE),
        ("bytes=4999999-99999999999", 206, 4_999_999, SIZE),
        ("bytes=0-1,5-7", 200, 0, SIZE),
        (f"bytes={SIZE}-", 416, None, None),
        ("bytes=-", 400, None, None),
        ("bytes=" + "9" * 5000 + "-", 400, None, None),
        ("lines=1-2", 400, None, None),
        ("bytes=1-2", 206, 1, 3),
    ):
        connection.request("GET", "/file", headers={} if asked is None else {"Range": asked})
        answer = connection.getresponse()
        body = answer.read()
        assert answer.status == status, asked
        if start is not None:
            assert body == content[start:stop] and int(answer.headers["content-length"]) == len(body)
    connection.request("HEAD", "/file")
    answer = connection.getresponse()
    assert (answer.read(), answer.headers["content-length"]) == (b"", str(SIZE))
    connection.close()


def test_reader_that_leaves(port: int, file: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A reader that goes away amidst an answer costs nothing but that answer, and no line in the log."""
    caplog.set_level(logging.WARNING)
    for _ in range(3):
        with socket.create_connection(("127.0.0.1", port)) as leaving:
            leaving.sendall(b"GET /file HTTP/1.1\r\nHost: x\r\n\r\n")
            assert leaving.recv(1000).startswith(b"HTTP/1.1 200 OK")
    connection = http.client.HTTPConnection("127.0.0.1", port)
    connection.request("GET", "/file")
    assert connection.getresponse().read() == file.read_bytes()
    connection.close()
    assert not caplog.records


def test_file_that_became_shorter(port: int, file: Path) -> None:
    """A file that was cut after it was checked ends the connection: what came is not taken for the whole."""
    file.write_bytes(file.read_bytes()[: SIZE // 2])
    connection = http.client.HTTPConnection("127.0.0.1", port)
    connection.request("GET", "/file")
    with pytest.raises((http.client.IncompleteRead, ConnectionError)):
        connection.getresponse().read()
    connection.close()
