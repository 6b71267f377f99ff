"""python -m tools.studies.load [--json FILE]: many readers at once of the dataset service, beside a plain file server.

Both serve the same files of random bytes from the same machine, in turns. The readers are threads of this process
that take bytes and do nothing with them; a first, untimed pass checks the sha256 of all that comes. No file server is
plainer than Python's own, `http.server.ThreadingHTTPServer`.
"""

from __future__ import annotations

import functools
import hashlib
import http.client
import http.server
import multiprocessing
import os
import socket
import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from hgn.command import run_command
from hgn.data.manifest import Manifest, ShardEntry
from hgn.data.statistics import merge_statistics
from hgn.data.storage import file_sha256
from hgn.schema import from_mapping, require_positive, to_mapping
from hgn.system.files import write_json
from hgn.system.machine import available_cpus
from hgn.system.progress import bar
from hgn.system.provenance import provenance, without_folders

HOST = "127.0.0.1"
RANGE_BYTES = 16 * 2**20  # as the data set readers ask
_BUFFER_BYTES = 2**20


@dataclass(frozen=True)
class LoadConfig:
    """`python -m tools.studies.load`: who reads how much."""

    readers: int = 8
    files: int = 4
    file_mb: int = 64
    rounds: int = 9  # each reader takes all files once a round, from each server in turn
    json: str | None = None  # also write the rows to this file; --json FILE does the same

    def __post_init__(self) -> None:
        require_positive(self, "readers", "files", "file_mb", "rounds")


def main(mapping: dict[str, Any]) -> None:
    """Prints bytes per second of each way to read and its ratio to the plain server, and writes JSON where asked to."""
    config = from_mapping(LoadConfig, mapping)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        manifest = make_files(folder, config)
        ways = {
            "plain file server, whole files": (start(_serve_plain, folder), False),
            "service, whole files": (service := start(_serve, folder), False),
            "service, ranges": (service, True),
        }
        plain = next(iter(ways))
        rates: dict[str, list[float]] = {way: [] for way in ways}
        for (_, port), ranges in ways.values():
            for shard in manifest.shards:
                read(port, shard, RANGE_BYTES if ranges else None, check=True)
        with bar("reading", total=config.rounds, unit="round") as progress:
            for _ in range(config.rounds):
                for way, ((_, port), ranges) in ways.items():
                    rates[way].append(together(port, manifest, config.readers, RANGE_BYTES if ranges else None))
                progress.update()
        for process in {process for (process, _), _ in ways.values()}:
            process.terminate()
            process.join()
    rows: list[dict[str, Any]] = [
        {
            "way": way,
            "readers": config.readers,
            "bytes_per_second": statistics.median(values),
            "slowest": min(values),
            "fastest": max(values),
            "ratio": statistics.median(a / b for a, b in zip(values, rates[plain], strict=True)),
        }
        for way, values in rates.items()
    ]
    for row in rows:
        speed, low, high = (row[key] / 1e9 for key in ("bytes_per_second", "slowest", "fastest"))
        print(f"{row['way']:31} {speed:5.2f} GB/s ({low:.2f} to {high:.2f})  {row['ratio']:.2f} of the plain one")
    if config.json is not None:
        meta = provenance() | {"cpus": available_cpus(), "config": without_folders(to_mapping(config))}
        write_json(config.json, {"meta": meta, "rows": rows})


def make_files(folder: Path, config: LoadConfig) -> Manifest:
    """Files of random bytes, and a manifest that lists them as shards."""
    shards = []
    for i in range(config.files):
        path = folder / f"train-{i:06d}-{i + 1:06d}.tar"
        path.write_bytes(os.urandom(config.file_mb * 2**20))
        size, sha256 = path.stat().st_size, file_sha256(path)
        shards.append(ShardEntry(path.name, "train", i, i + 1, sha256, size, (), merge_statistics(())))
    requested = {"train": config.files, "validation": 0, "test": 0}
    manifest = Manifest("0" * 64, {}, requested, revision=1, shards=tuple(shards))
    manifest.save(folder)
    return manifest


def start(serve: Callable[[Path, Connection], None], folder: Path) -> tuple[multiprocessing.process.BaseProcess, int]:
    """A server in a process of its own, and its port."""
    context = multiprocessing.get_context("spawn")
    connection, child = context.Pipe()
    process = context.Process(target=serve, args=(folder, child), daemon=True)
    process.start()
    child.close()
    return process, connection.recv()


def together(port: int, manifest: Manifest, readers: int, range_bytes: int | None) -> float:
    """Bytes per second while each of several readers takes all shards, each in an order of its own."""
    shards = manifest.shards
    failed: list[BaseException] = []

    def read_all(first: int) -> None:
        try:
            for i in range(len(shards)):
                read(port, shards[(first + i) % len(shards)], range_bytes)
        except BaseException as error:
            failed.append(error)
            raise

    threads = [threading.Thread(target=read_all, args=(i,)) for i in range(readers)]
    began = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    seconds = time.perf_counter() - began
    if failed:
        raise failed[0]
    return readers * sum(shard.bytes for shard in shards) / seconds


def read(port: int, shard: ShardEntry, range_bytes: int | None, check: bool = False) -> None:
    """Takes one shard, whole or in ranges. Raises: RuntimeError when other bytes come, or not as many."""
    buffer, digest, have = memoryview(bytearray(_BUFFER_BYTES)), hashlib.sha256(), 0
    connection = http.client.HTTPConnection(HOST, port)
    while have < shard.bytes:
        stop = shard.bytes if range_bytes is None else min(have + range_bytes, shard.bytes)
        headers = {} if range_bytes is None else {"Range": f"bytes={have}-{stop - 1}"}
        connection.request("GET", f"/{shard.name}", headers=headers)
        answer = connection.getresponse()
        if answer.status != (200 if range_bytes is None else 206):
            raise RuntimeError(f"{shard.name} must be there, got the answer {answer.status}")
        while count := answer.readinto(buffer):
            have += count
            if check:
                digest.update(buffer[:count])
        if have != stop:
            raise RuntimeError(f"{shard.name} must come to byte {stop}, got {have}")
    connection.close()
    if check and digest.hexdigest() != shard.sha256:
        raise RuntimeError(f"{shard.name} came with other bytes")


def _serve(folder: Path, connection: Connection) -> None:
    from datagen.service.server import make_app, make_server
    from datagen.service.supervisor import PoolState

    with socket.create_server((HOST, 0), backlog=1024) as listener:
        connection.send(listener.getsockname()[1])
        make_server(make_app(folder, None, PoolState), connections=1024).run(sockets=[listener])


def _serve_plain(folder: Path, connection: Connection) -> None:
    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *arguments: object) -> None:
            pass

    with http.server.ThreadingHTTPServer((HOST, 0), functools.partial(Quiet, directory=str(folder))) as server:
        connection.send(server.server_port)
        server.serve_forever()


if __name__ == "__main__":
    run_command(main, "load")
