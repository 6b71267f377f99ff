"""jobs/nginx.conf: TLS in front of a dataset service, with nginx itself where it is installed."""

import os
import shutil
import string
import subprocess
import sys
from pathlib import Path

import pytest
from processes import PATIENCE_S, free_port, wait_until
from serving import serving

from datagen.service.server import make_app
from datagen.service.supervisor import PoolState
from hgn.data.storage import TOKEN_HOST_VARIABLE, TOKEN_VARIABLE

ROOT = Path(__file__).resolve().parents[2]
TOKEN = "correct-horse-battery"
READER = """
import sys
from hgn.data.reader import EpisodeStore
store = EpisodeStore(sys.argv[1], "train")
for _ in sys.stdin:
    store.refresh()
    print(len(store), sum(float(episode.position_TN3.sum()) for episode in store), flush=True)
"""
pytestmark = pytest.mark.skipif(
    shutil.which("nginx") is None or shutil.which("openssl") is None, reason="needs nginx and openssl"
)


@pytest.fixture
def address(make_config, tmp_path):
    """Of nginx in front of a service of `data`, which asks for the token."""
    folder, port = Path(make_config().dataset.folder), free_port()
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", "/CN=localhost", "-addext",
         "subjectAltName=DNS:localhost", "-keyout", tmp_path / "privkey.pem", "-out", tmp_path / "fullchain.pem"],
        check=True, capture_output=True,
    )  # fmt: skip
    template = string.Template((ROOT / "jobs/nginx.conf").read_text())
    values = {"SERVER_NAME": "localhost", "CERTIFICATES": str(tmp_path), "LISTEN": f"127.0.0.1:{port}"}
    command = ["nginx", "-p", str(tmp_path), "-e", str(tmp_path / "log"), "-c", str(tmp_path / "hgn.conf")]
    with serving(make_app(folder, TOKEN, PoolState), connections=64) as (server, service):
        (tmp_path / "hgn.conf").write_text(template.safe_substitute(values | {"SERVICE": f"127.0.0.1:{service}"}))
        nginx = subprocess.Popen([*command, "-g", "daemon off;"])
        try:
            wait_until(lambda: server.started and ((tmp_path / "nginx.pid").exists() or nginx.poll() is not None))
            assert nginx.poll() is None, (tmp_path / "log").read_text()
            yield f"https://localhost:{port}"
        finally:
            nginx.terminate()
            nginx.wait()


def reader(address, tmp_path, **variables):
    trust = {"SSL_CERT_FILE": str(tmp_path / "fullchain.pem"), "HGN_CACHE": str(tmp_path / "cache")}
    environment = os.environ | {"PYTHONPATH": str(ROOT), TOKEN_VARIABLE: TOKEN} | trust | variables
    return subprocess.Popen(
        [sys.executable, "-c", READER, address],
        env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def test_a_data_set_that_grows(make_config, make_dataset, address, tmp_path):
    """A reader takes a data set through TLS, shards by ranges, and sees it grow. Without the token it is refused, also
    where the token is meant for another host; a certificate that nobody vouches for is refused too."""
    make_dataset(make_config(training_scenes=2))
    process = reader(address, tmp_path)
    assert process.stdin is not None and process.stdout is not None

    def ask():
        process.stdin.write("\n")
        process.stdin.flush()
        return process.stdout.readline()

    assert ask().startswith("2 ")
    make_dataset(make_config(training_scenes=5))
    wait_until(lambda: ask().startswith("5 "))
    process.communicate()
    refused = reader(address, tmp_path, **{TOKEN_HOST_VARIABLE: "elsewhere:443"})
    assert "must be accessible, got access refused" in refused.communicate("\n", timeout=PATIENCE_S)[1]
    waiting = reader(address, tmp_path, SSL_CERT_FILE="")
    assert waiting.stderr is not None
    try:
        assert "certificate" in waiting.stderr.readline()
    finally:
        waiting.kill()
        waiting.communicate()
