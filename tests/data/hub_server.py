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
    """Serves repositories. `failures` is the number of next answers that are errors of an overloaded server. `asked`
    contains the requested paths."""

    def __init__(self, folder):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.folder, self.failures, self.asked = folder, 0, list[str]()
        self.url = f"http://127.0.0.1:{self.server_port}"


class _Handler(http.server.BaseHTTPRequestHandler):
    server: Hub
    protocol_version = "HTTP/1.1"

    def log_message(self, *_):
        pass

    def do_GET(self):
        path = unquote(self.path.partition("?")[0])
        self.server.asked.append(path)
        status, data, headers = self._answer(path)
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(data)

    do_HEAD = do_GET

    def _answer(self, path):
        """Status, body and headers."""
        if self.server.failures:
            self.server.failures -= 1
            return 503, b"busy", {}
        listing = re.fullmatch(r"/api/(models|datasets)/([^/]+/[^/]+)(?:/(revision|tree)/([^/]+))?", path)
        if listing:
            root = self.server.folder / listing[1] / listing[2]
            if not root.is_dir():
                return 404, b"{}", {"X-Error-Code": "RepoNotFound"}
            names = sorted(str(file.relative_to(root)) for file in root.rglob("*") if file.is_file())
            tree = [{"type": "file", "path": n, "size": (root / n).stat().st_size, "oid": COMMIT} for n in names]
            about = {"id": listing[2], "sha": COMMIT, "siblings": [{"rfilename": name} for name in names]}
            return 200, json.dumps(tree if listing[3] == "tree" else about).encode(), {}
        match = re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path)
        if match is None:
            return 404, b"", {}
        if "private" in match[2] and self.headers.get("Authorization") != f"Bearer {TOKEN}":
            return 401, b"", {"X-Error-Code": "RepoNotFound"}
        file = self.server.folder / (match[1] or "models") / match[2] / match[4]
        if not file.is_file():
            return 404, b"", {"X-Error-Code": "EntryNotFound"}
        data = file.read_bytes()
        tag = hashlib.sha256(data).hexdigest()
        headers = {"ETag": f'"{tag}"', "X-Repo-Commit": COMMIT, "Accept-Ranges": "bytes"}
        asked = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        if asked is None:
            return 200, data, headers
        start, stop = int(asked[1]), min(int(asked[2] or len(data)) + 1, len(data))
        return 206, data[start:stop], headers | {"Content-Range": f"bytes {start}-{stop - 1}/{len(data)}"}


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
