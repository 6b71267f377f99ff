"""A stand-in of the Hugging Face Hub: a folder models/USER/NAME or datasets/USER/NAME a repository, by its protocol.

Files at /[datasets/]USER/NAME/resolve/REVISION/PATH with ranges, ETag and X-Repo-Commit; the list of a repository's
files at /api/{models,datasets}/USER/NAME; private ones ask for a token; every second answer may be an error.
"""

import hashlib
import http.server
import json
import re
import threading
from contextlib import contextmanager
from urllib.parse import unquote

COMMIT = "0123456789abcdef0123456789abcdef01234567"
TOKEN = "hf_of_the_test"


class Hub(http.server.ThreadingHTTPServer):
    """`failures` answers of those to come are errors of a server that is overloaded; `asked` are the paths."""

    def __init__(self, folder):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.folder, self.failures, self.asked = folder, 0, list[str]()
        self.url = f"http://127.0.0.1:{self.server_port}"


class _Handler(http.server.BaseHTTPRequestHandler):
    server: Hub
    protocol_version = "HTTP/1.1"

    def log_message(self, *_):
        pass

    def do_HEAD(self):
        self._answer(with_body=False)

    def do_GET(self):
        self._answer(with_body=True)

    def _answer(self, with_body):
        path = unquote(self.path.partition("?")[0])
        self.server.asked.append(path)
        if self.server.failures:
            self.server.failures -= 1
            return self._send(503, b"busy", with_body)
        listing = re.fullmatch(r"/api/(models|datasets)/([^/]+/[^/]+)(?:/(revision|tree)/([^/]+))?", path)
        if listing:
            root = self.server.folder / listing[1] / listing[2]
            if not root.is_dir():
                return self._send(404, b"{}", with_body, {"X-Error-Code": "RepoNotFound"})
            names = sorted(str(file.relative_to(root)) for file in root.rglob("*") if file.is_file())
            if listing[3] == "tree":
                tree = [{"type": "file", "path": n, "size": (root / n).stat().st_size, "oid": COMMIT} for n in names]
                return self._send(200, json.dumps(tree).encode(), with_body)
            about = {"id": listing[2], "sha": COMMIT, "siblings": [{"rfilename": name} for name in names]}
            return self._send(200, json.dumps(about).encode(), with_body)
        match = re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path)
        if match is None:
            return self._send(404, b"", with_body)
        kind = "datasets" if match[1] else "models"
        if "private" in match[2] and self.headers.get("Authorization") != f"Bearer {TOKEN}":
            return self._send(401, b"", with_body, {"X-Error-Code": "RepoNotFound"})
        file = self.server.folder / kind / match[2] / match[4]
        if not file.is_file():
            return self._send(404, b"", with_body, {"X-Error-Code": "EntryNotFound"})
        data = file.read_bytes()
        digest = hashlib.sha256(data).hexdigest()
        headers = {"ETag": f'"{digest}"', "X-Repo-Commit": COMMIT, "Accept-Ranges": "bytes"}
        asked = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        if asked is None:
            return self._send(200, data, with_body, headers)
        start, stop = int(asked[1]), min(int(asked[2] or len(data)) + 1, len(data))
        headers["Content-Range"] = f"bytes {start}-{stop - 1}/{len(data)}"
        return self._send(206, data[start:stop], with_body, headers)

    def _send(self, status, data, with_body, headers=None):
        self.send_response(status)
        for name, value in (headers or {}).items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if with_body:
            self.wfile.write(data)


@contextmanager
def served(folder):
    """The repositories of a folder, while it is entered."""
    with Hub(folder) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
