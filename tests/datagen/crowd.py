"""`python tests/datagen/crowd.py SECONDS READERS FILE.json`: readers of a data set that the service still generates.

Each looks at the manifest once a second and reads every shard; ten requests a second go to /healthz at its own port.
The stand-in for the solver generates, so that the service is what is measured. Linux only.
"""

import asyncio
import contextlib
import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from unittest import mock
from urllib.request import urlopen

import numpy as np
from processes import TESTS, free_port, start_module, wait_until

from hgn.data.manifest import Manifest
from hgn.system.machine import allow_open_files
from hgn.system.provenance import provenance

ASK_S, SCENES = 0.1, 32
OPTIONS = (
    *("out={folder}", "port={port}", "health_port={health_port}", f"scenes={SCENES}", "dataset.frames=5"),
    *("dataset.validation_scenes=0", "dataset.test_scenes=0", "dataset.workers=1", "dataset.episodes_per_shard=1"),
)


async def get(stream, path, headers=""):
    """Status, headers and body of an answer on an open connection."""
    reader, writer = stream
    writer.write(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n{headers}\r\n".encode())
    head = (await reader.readuntil(b"\r\n\r\n")).decode()
    size = re.search(r"(?im)^content-length: (\d+)", head)
    return int(head.split()[1]), head, await reader.readexactly(int(size[1]) if size else 0)


async def read(delay_s, port, until, figures):
    """One reader: all shards that are published until the time is over, each once, with its sha256."""
    await asyncio.sleep(delay_s)
    stream, etag, known = await asyncio.open_connection("127.0.0.1", port), "", set()

    async def answer(path, headers="", statuses=(200,)):
        figures["answers"] += 1
        status, head, body = await get(stream, path, headers)
        assert status in statuses, f"{path}: {status} {body[:200]!r}"
        return status, re.search(r"(?im)^etag: (\S+)", head)[1], body

    try:
        while (start := time.monotonic()) < until:
            unchanged = f"If-None-Match: {etag}\r\n" if etag else ""
            status, etag, body = await answer("/manifest.json", unchanged, (200, 304))
            if status == 200 and json.loads(body)["index"]["shards"]:
                # several processes pack shards, so their order in the index is not that of their episodes
                _, _, lines = await answer("/index/1-000000.jsonl")
                for name in [json.loads(line)["name"] for line in lines.splitlines()]:
                    if name not in known and time.monotonic() < until:
                        _, sha256, body = await answer(f"/{name}")
                        assert f'"{hashlib.sha256(body).hexdigest()}"' == sha256
                        figures["bytes"] += len(body)
                        known.add(name)
            await asyncio.sleep(max(0.0, 1 - (time.monotonic() - start)))
    finally:
        stream[1].close()


async def probe(port, until):
    """Seconds from asking for /healthz to its answer, on a new connection each time."""
    seconds = []
    while time.monotonic() < until:
        start = time.perf_counter()
        stream = await asyncio.open_connection("127.0.0.1", port)
        status, _, body = await get(stream, "/healthz")
        stream[1].close()
        assert status == 200, body
        seconds.append(time.perf_counter() - start)
        await asyncio.sleep(ASK_S)
    return seconds


def begun(port):
    """Whether the service has reported to the process of /healthz, which may be later than its first shard."""
    with contextlib.suppress(OSError), urlopen(f"http://127.0.0.1:{port}/healthz") as answer:
        return answer.status == 200
    return False


def probing(port, seconds):
    """The same in a process of its own, for the readers keep this one busy."""
    print(json.dumps(asyncio.run(probe(port, time.monotonic() + seconds))))


async def crowd(port, readers, seconds):
    figures, until = {"answers": 0, "bytes": 0}, time.monotonic() + seconds
    reading = (read(number / readers, port, until, figures) for number in range(readers))
    results = await asyncio.gather(*reading, return_exceptions=True)
    return figures | {"errors": [repr(result) for result in results if result is not None]}


def largest_mb(process):
    """The most memory of a process and of those that it started, each alone."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    status = {name: Path(f"/proc/{name}/status").read_text() for name in (str(process), *children)}
    return [int(re.search(r"VmHWM:\s+(\d+)", text)[1]) / 1e3 for text in status.values()]


def main(seconds, readers, file):
    allow_open_files(65_536)
    with tempfile.TemporaryDirectory() as folder, mock.patch.dict(os.environ, BALLISTIC_FOLDER=folder):
        port, health_port = free_port(), free_port()
        values = {"folder": f"{folder}/data", "port": port, "health_port": health_port}
        options = [option.format(**values) for option in OPTIONS]
        service = start_module("ballistic_service", *options, stderr=subprocess.DEVNULL)
        try:
            wait_until(lambda: Path(folder, "data/manifest.json").exists() and Manifest.load(f"{folder}/data").revision)
            wait_until(lambda: begun(health_port))
            command = [sys.executable, __file__, "probe", str(health_port), str(seconds)]
            environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (TESTS.parent, TESTS)))}
            asking = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
            figures = asyncio.run(crowd(port, readers, seconds))
            health_s = json.loads(asking.communicate()[0])
            memory = largest_mb(service.pid)
        finally:
            service.terminate()
            service.wait()
    figures |= {
        "healthz_s": {
            "median": float(np.median(health_s)), "p99": float(np.quantile(health_s, 0.99)), "largest": max(health_s),
            "samples": len(health_s),
        },
        "memory_mb": memory,  # of the service, and of each of its processes
        "load_average": list(os.getloadavg()),
    }  # fmt: skip
    report = {"meta": provenance() | {"config": {"seconds": seconds, "readers": readers}}, "figures": figures}
    Path(file).write_text(json.dumps(report, indent=1) + "\n")
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    if sys.argv[1] == "probe":
        probing(int(sys.argv[2]), float(sys.argv[3]))
    else:
        main(float(sys.argv[1]), int(sys.argv[2]), sys.argv[3])
