"""Files that the kernel sends: whole, in ranges, one after the other on a connection, or not at all."""

import asyncio
import hashlib
import http.client
import itertools
import logging
import os
import socket
import sys
from asyncio.selector_events import _SelectorSocketTransport
from collections import Counter
from contextlib import ExitStack, closing
from types import SimpleNamespace

import pytest
from processes import wait_until
from serving import serving
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.responses import Response
from starlette.routing import Route

from datagen.service.sendfile import EXTENSION, FileRange
from datagen.service.server import Guard

SIZE = 5_000_001


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(hashlib.shake_128(b"file").digest(SIZE))
    return path


@pytest.fixture
def serve(file):
    async def answer(request):
        assert EXTENSION in request.scope["extensions"]
        return FileRange(file, SIZE, {"etag": '"tag"'}, "application/octet-stream")

    with ExitStack() as running:

        def serve(**limits):
            routes = [Route("/file", answer), Route("/page", lambda request: Response(bytes(2**24)))]
            app = Starlette(routes=routes, middleware=[Middleware(Guard, token=None, counters=Counter())])
            return running.enter_context(serving(app, **limits))

        yield serve


@pytest.fixture
def port(serve):
    return serve(connections=8)[1]


def get(port, **headers):
    """What comes at a request of the file by a connection of its own."""
    with closing(http.client.HTTPConnection("127.0.0.1", port)) as connection:
        connection.request("GET", "/file", headers=headers)
        return connection.getresponse().read()


class LoopOfUvloop(asyncio.SelectorEventLoop):
    """As far as it differs: it cannot send files."""

    sendfile = asyncio.AbstractEventLoop.sendfile


@pytest.fixture
def uvloop(monkeypatch):
    """Installed, as with Uvicorn's own extras: Uvicorn takes it where nobody asks for a loop."""
    monkeypatch.setitem(sys.modules, "uvloop", SimpleNamespace(new_event_loop=LoopOfUvloop))
    monkeypatch.delitem(sys.modules, "uvicorn.loops.uvloop", raising=False)


@pytest.mark.usefixtures("uvloop")
def test_uvloop_is_left_alone(port, file):
    """Where it is installed files come all the same."""
    assert get(port) == file.read_bytes()


def test_ranges_on_one_connection(port, file):
    """One connection carries many answers, each with exactly the requested bytes."""
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


def test_reader_that_leaves(port, file, caplog):
    """If a reader disconnects during an answer, only this answer fails, and nothing is logged."""
    caplog.set_level(logging.WARNING)
    for _ in range(3):
        with socket.create_connection(("127.0.0.1", port)) as leaving:
            leaving.sendall(b"GET /file HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            assert leaving.recv(1000).startswith(b"HTTP/1.1 200 OK")
    assert get(port) == file.read_bytes() and not caplog.records


@pytest.mark.parametrize("pipe", [False, True])
def test_file_that_became_shorter(port, file, pipe):
    """A file that was cut after it was checked, or is a pipe, ends the connection: what came is not taken for the
    whole."""
    content = file.read_bytes()
    file.unlink()
    _ = os.mkfifo(file) if pipe else file.write_bytes(content[: SIZE // 2])
    with pytest.raises((http.client.IncompleteRead, ConnectionError)):
        get(port)


HALF = b"GET /file HTTP/1.1\r\n"
EIGHT = {"connections": 1000, "open_files": 256 + 64 + 16}  # by the limit of open files


def waiting(port, sent):
    connection = socket.create_connection(("127.0.0.1", port))
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.sendall(sent)
    return connection


@pytest.mark.parametrize("sent", [b"", HALF])
def test_who_only_waits_keeps_nobody_out(serve, sent, file):
    """Connections beyond the limit that send nothing, or half a request, are closed for one that sends a request."""
    server, port = serve(**EIGHT)
    with ExitStack() as stack:
        for _ in range(40):
            stack.enter_context(waiting(port, sent))
        assert get(port, Range="bytes=0-9") == file.read_bytes()[:10]
        assert len(server.server_state.connections) <= 8


@pytest.mark.parametrize("taken", [0, 1])
def test_waiting_comes_to_an_end(serve, monkeypatch, taken):
    """Connections that send nothing, half a request, or never read their answer, or a byte of it now and then, are
    cut."""
    real, left = _SelectorSocketTransport.get_write_buffer_size, itertools.count(2**23, -taken)
    monkeypatch.setattr(
        _SelectorSocketTransport, "get_write_buffer_size", lambda transport: min(real(transport), next(left))
    )
    server, port = serve(**EIGHT, patience_s=0.2)
    asked = (b"", HALF, HALF + b"Host: x\r\n\r\n", b"GET /page HTTP/1.1\r\nHost: x\r\n\r\n")
    with ExitStack() as stack:
        for sent in asked:
            stack.enter_context(waiting(port, sent))
        wait_until(lambda: len(server.server_state.connections) == 4)
        wait_until(lambda: not server.server_state.connections)


def test_bodies_are_refused(port):
    """A request with a body, perhaps without an end, is answered and its connection closed."""
    with socket.create_connection(("127.0.0.1", port)) as endless:
        endless.sendall(b"GET /file HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nhello\r\n")
        answer = b"".join(iter(lambda: endless.recv(4096), b""))
    assert answer.startswith(b"HTTP/1.1 413") and b"uploads are not accepted" in answer


def test_other_protocols_are_logged_with_their_address(port, caplog):
    """A client of HTTPS gets an answer, and the log has its address."""
    with closing(socket.create_connection(("127.0.0.1", port))) as connection:
        connection.sendall(b"\x16\x03\x01\x02\x00\x01\r\n\r\n")
        assert connection.recv(100).startswith(b"HTTP/1.1 400")
    assert [record.getMessage() for record in caplog.records] == ["127.0.0.1: Invalid HTTP request received."]
