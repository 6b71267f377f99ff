"""Data sets on web servers that do not behave: unbounded answers, old copies, no ranges."""

import contextlib
import functools
import gzip
import http.server
import threading

import numpy as np
import pytest

import hgn.data.storage
from hgn.data.reader import EpisodeStore
from hgn.data.storage import open_storage
from hgn.schema import ConfigError
from hgn.system.patience import VARIABLE, UnreachableError

pytestmark = pytest.mark.usefixtures("cache")


class Quiet:
    """Of a server's handler: without a log."""

    def log_message(self, *arguments):
        pass


class PlainFiles(Quiet, http.server.SimpleHTTPRequestHandler):
    """Knows no ranges."""


def refusing(status):
    """A proxy's handler that answers with a status only."""

    class Proxy(Quiet, http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(status)
            self.send_header("Content-Length", "0")
            self.end_headers()

        do_CONNECT = do_GET

    return Proxy


@contextlib.contextmanager
def answering(handler):
    """The URL of a server of its own."""
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,)).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()


@pytest.mark.parametrize("status", ["100 Continue", "103 Early Hints"])
@pytest.mark.parametrize("count", [3, 10**9])
def test_interim_answers_are_bounded(monkeypatch, status, count):
    """A few of them may come before an answer. A server that sends no other does not answer."""
    monkeypatch.setenv(VARIABLE, "0")

    class Interim(Quiet, http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            with contextlib.suppress(ConnectionError):
                for _ in range(count):
                    self.wfile.write(f"HTTP/1.1 {status}\r\n\r\n".encode())
                self.send_response(200)
                self.end_headers()
                self.wfile.write(b"{}")

    with answering(Interim) as url:
        if count == 3:
            assert open_storage(url).manifest("manifest.json") == b"{}"
        else:
            monkeypatch.setattr("hgn.data.bounded_http.HEAD_S", 5.0)
            with pytest.raises(UnreachableError, match=r"\(last cause: it sent more than 100 interim answers\)"):
                open_storage(url).manifest("manifest.json")


@pytest.mark.parametrize("attack", ["gzip bomb", "endless", "long range"])
def test_answers_are_bounded(monkeypatch, attack):
    """A server cannot fill the memory: a packed answer stays packed, and one that is longer than was asked for, or
    than any, is cut."""
    monkeypatch.setattr("hgn.data.bounded_http.LARGEST_BYTES", 100_000)

    class Attack(Quiet, http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(206 if attack == "long range" else 200)
            if attack == "gzip bomb":
                self.send_header("Content-Encoding", "gzip")
            self.end_headers()
            with contextlib.suppress(ConnectionError):
                if attack == "gzip bomb":
                    self.wfile.write(gzip.compress(bytes(10**7)))
                for _ in range(0 if attack == "gzip bomb" else 1000):
                    self.wfile.write(bytes(10_000))

    with answering(Attack) as url:
        storage = open_storage(url)
        if attack == "gzip bomb":
            assert len(storage.manifest("manifest.json")) < 20_000
        else:
            limit = 50 if attack == "long range" else 100_000
            with pytest.raises(ConfigError, match=f"must send at most {limit} bytes, got more"):
                storage.read("s", 0, 50) if attack == "long range" else storage.manifest("manifest.json")


def test_proxy_that_remembers():
    """A proxy that has an older, shorter file of the index is asked again until it has the one that the manifest is
    about."""
    answers = iter([(416, b""), (206, b"56"), (206, b"5678")])

    class Proxy(Quiet, http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            status, content = next(answers)
            self.send_response(status)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

    with answering(Proxy) as url:
        assert open_storage(url).read("index", 5, 9) == b"5678"


@pytest.mark.parametrize("variable", ["http_proxy", "ALL_PROXY"])
def test_proxies_are_honoured(monkeypatch, variable):
    """http_proxy serves data of other machines, but not of this one or of hosts and networks in no_proxy."""
    asked = []

    class Proxy(Quiet, http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_response(200)
            self.send_header("Content-Length", "5")
            self.end_headers()
            self.wfile.write(b"hello")

    with answering(Proxy) as address:
        for name in ("http_proxy", "HTTP_PROXY", "https_proxy"):
            monkeypatch.setenv(name, "")  # so that it is as before after the test, though reading sets it
            monkeypatch.delenv(name)
        monkeypatch.setenv(variable, address.removeprefix("http://"))
        monkeypatch.setenv("no_proxy", "excepted.example, 10.0.0.0/8 *.own.example,fd00::/8")
        for host in ("u:p@excepted.example:80", "10.200.3.4:80", "a.b.own.example", "[fd00:1::2]:80"):
            assert not hgn.data.storage._uses_proxies(f"http://{host}/set")
        hgn.data.storage.remote_storage.cache_clear()
        for url in ("http://data.example:9", address):
            assert open_storage(f"{url}/set").read("manifest.json", 0, 5) == b"hello"
    assert asked == ["http://data.example:9/set/manifest.json", "/set/manifest.json"]
    monkeypatch.delenv("http_proxy")
    for proxy in ("socks5://127.0.0.1:1", "http://me:a#b@127.0.0.1:1", "http://me:a/b@127.0.0.1:1", "127.0.0.1:99999"):
        monkeypatch.setenv(variable, proxy)
        with pytest.raises(ConfigError, match=f"{variable.lower()} must be of the form http://host:port, got "):
            hgn.data.storage._uses_proxies("http://11.0.0.1/set")


@pytest.mark.parametrize(
    ("scheme", "status", "message"),
    [
        ("http", 407, "accessible through the proxy of http_proxy or https_proxy, got its answer 407"),
        ("https", 407, "accessible through the proxy of http_proxy or https_proxy, got its answer 407"),
        *(
            ("https", status, f"accessible through the proxy of .*, got its answer {status}")
            for status in (401, 403, 404, 410)
        ),
        (
            "http",
            403,
            "accessible, got access refused by its server or the proxy of http_proxy; set HGN_DATASET_TOKEN",
        ),
        ("https", 429, "no answer for 0 s .last cause: 429"),
    ],
)
def test_proxies_that_refuse_are_named(monkeypatch, scheme, status, message):
    """A proxy's own answer is not the server's. Only a 403 for a plain address may be of either."""
    for name in ("http_proxy", "https_proxy", "no_proxy"):
        monkeypatch.setenv(name, "")
    monkeypatch.setenv("HGN_PATIENCE_S", "0")
    hgn.data.storage.remote_storage.cache_clear()
    with answering(refusing(status)) as address:
        monkeypatch.setenv(f"{scheme}_proxy", address)
        with pytest.raises((ConfigError, OSError), match=message):
            open_storage(f"{scheme}://data.example:9/set").manifest("manifest.json")


def test_server_without_ranges(folder, monkeypatch):
    """A plain file server that knows no ranges will do."""
    monkeypatch.setattr(hgn.data.storage, "_CHUNK_BYTES", 4000)

    with answering(functools.partial(PlainFiles, directory=str(folder))) as url:
        pairs = list(zip(EpisodeStore(url, "train"), EpisodeStore(folder, "train"), strict=True))
        assert len(pairs) == 5 and all(np.array_equal(a.position_TN3, b.position_TN3) for a, b in pairs)
