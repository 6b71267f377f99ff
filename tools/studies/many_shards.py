"""python -m tools.studies.many_shards out=data/many: 100,000 small shards, and 1,000 readers of their service.

The generator's own writer publishes them one by one. Now and then the work of a claim, of a publication and of a look
at what is new is counted: lines of ours that are run, bytes that are read and written. Then readers poll the service
while more shards are published, and each must see every shard, in its order. Linux only: it counts in /proc.
"""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from datagen.pool.shard import stage_episode
from datagen.pool.writer import DatasetWriter
from hgn.command import run_command
from hgn.config import DatagenConfig, DatasetConfig
from hgn.data.index import SEGMENT_SHARDS, EpisodeEntry, ShardEntry
from hgn.data.manifest import Manifest
from hgn.data.reader import EpisodeStore
from hgn.data.statistics import Moments, Statistics
from hgn.scene.episode import Episode
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.schema import NonNegative, Positive, from_mapping, require, require_bounds
from hgn.system.files import write_json
from hgn.system.machine import allow_open_files
from hgn.system.progress import bar
from hgn.system.provenance import provenance

EXIT_RED = 1
START_BYTES = 1_000_000  # that a reader may read before it has its first sample
TOLERANCE = 0.2  # of the first counted work, that the last may be above or below
SPARE = 400  # lines and bytes that the length of a number is worth
PLACE = 16  # within a segment of the index: what a look costs goes round with its lines
_ASK_S = 0.1  # between two looks at /healthz


@dataclass(frozen=True)
class ManyShardsConfig:
    """`python -m tools.studies.many_shards`: how many, and how they are read."""

    out: str  # a new folder
    shards: Positive[int] = 100_000  # of one episode of two particles
    listed: NonNegative[int] = 0  # of these, at once and empty: the others are counted behind them, in minutes
    readers: Positive[int] = 1_000  # that poll once a second
    seconds: Positive[float] = 60.0
    publish_every_s: Positive[float] = 3.0  # meanwhile
    service_nice: int = 0  # of the service and of who asks for /healthz, on a machine that does other work
    readers_nice: NonNegative[int] = 0
    json: str | None = None

    def __post_init__(self) -> None:
        require_bounds(self)
        require(not Path(self.out).exists(), "out", "a new folder", self.out)


class Count:
    """Lines of ours that are run, and bytes that are read from and written to files, while it is entered."""

    def __enter__(self) -> Count:
        self.lines, self._before = 0, self._bytes()
        sys.settrace(self._trace)
        return self

    def __exit__(self, *error: object) -> None:
        sys.settrace(None)
        self.read, self.written = (b - a for a, b in zip(self._before, self._bytes(), strict=True))

    def _trace(self, frame: Any, event: str, argument: object) -> Any:
        self.lines += event == "line"
        return self._trace if f"{os.sep}data" in frame.f_code.co_filename else None

    def _bytes(self) -> tuple[int, int]:
        numbers = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
        return int(numbers["rchar"]), int(numbers["wchar"])


@dataclass(frozen=True)
class Work:
    """What was counted, and how much memory the process had, with so many shards published."""

    shards: int
    what: str  # claim, publication, look, start
    lines: int
    read: int  # bytes
    written: int
    memory_mb: float


def main(mapping: dict[str, Any]) -> int:
    """Prints what was counted and measured; the exit code is 1 where work grew, or a reader missed a shard."""
    config = from_mapping(ManyShardsConfig, mapping)
    require(sys.platform == "linux", "tools.studies.many_shards", "run on Linux", sys.platform)
    folder, later = Path(config.out), 1 + int(config.seconds / config.publish_every_s)
    dataset = DatasetConfig(
        folder=config.out, training_scenes=config.shards + later, validation_scenes=0, test_scenes=0, frames=3,
        episodes_per_shard=1,
    )  # fmt: skip
    with DatasetWriter(DatagenConfig(dataset=dataset)) as writer:
        work = publish(writer, config.shards, config.listed)
        service = serve_and_poll(writer, folder, config, later)
    faults = found(work, service)
    for row in work:
        print(
            f"{row.shards:>7,} shards: {row.what:<11} {row.lines:>6,} lines, {row.read:>9,} bytes read, "
            f"{row.written:>6,} written; {row.memory_mb:.0f} MB"
        )
    print(json.dumps(service, indent=1))
    print("\n".join(faults) or "no work grew, and every reader saw every shard")
    if config.json is not None:
        options = {name: value for name, value in asdict(config).items() if name not in ("out", "json")}
        rows = [asdict(row) for row in work]
        write_json(
            config.json,
            {"meta": provenance() | {"config": options}, "service": service, "faults": faults, "rows": rows},
        )
    return EXIT_RED if faults else 0


def publish(writer: DatasetWriter, shards: int, listed: int = 0) -> list[Work]:
    """Publishes one after the other, but those that are `listed` at once after the first count; counts now and then,
    always at one place of an index segment."""
    work = []
    segments = (shards - 1 - PLACE) // SEGMENT_SHARDS
    probes = {PLACE + SEGMENT_SHARDS * number for number in (1, 8, 78, segments) if 0 < number <= segments}
    store: EpisodeStore | None = None
    progress = bar("publishing", shards, unit="shard")
    number, first = 0, min(probes)
    while number < shards:
        if number == first + 1 and listed:
            list_at_once(writer, range(number, number + listed))
            number += listed
        progress.update()
        if number in probes and store is not None:
            store.refresh()
            with Count() as claim:
                writer.claim_next()
            stage_small(writer, number)
            with Count() as publication:
                writer.publish_next()
            with Count() as look:
                store.refresh()
            with Count() as start:
                EpisodeStore(writer.folder, "train").episodes[0 if listed else number // 2].position_TN3[0].sum()
            counts = {"claim": claim, "publication": publication, "look": look, "start": start}
            memory = _status(os.getpid(), "VmRSS")
            work += [Work(number, what, c.lines, c.read, c.written, memory) for what, c in counts.items()]
        else:
            publish_one(writer, number)
        if number == first // 2:  # what runs for the first time costs more
            store = EpisodeStore(writer.folder, "train")
            store.episodes[0]
        number += 1
    progress.close()
    return work


def publish_one(writer: DatasetWriter, number: int) -> None:
    """Claims, stages and publishes a shard."""
    shard = writer.claim_next()
    assert shard is not None and shard.first == number
    stage_small(writer, number)
    writer.publish_next()


def list_at_once(writer: DatasetWriter, numbers: range) -> None:
    """Shards that are there by name and in the index alone, as if another generator had published them."""
    shards = [empty_shard(number) for number in numbers]
    for shard in shards:
        (writer.folder / shard.name).touch()
    manifest = Manifest.load(writer.folder)
    manifest.extended(writer.folder, shards, (), revision=manifest.revision + len(shards))
    writer.refresh()


def empty_shard(number: int) -> ShardEntry:
    """The entry of a training shard of one episode and no bytes."""
    members = {f"{name}.npy": (512, 10_000_000) for name in ("position", "material")}
    entry = EpisodeEntry(f"train-{number:06d}", number, 2**62 + number, 0, 4296 + number % 1000, 6, members)
    statistics = Statistics(*2 * [Moments(10**6, (0.1, 0.2, 1 / 3), (0.1, 0.2, 1 / 3))])
    name = f"train-{number:06d}-{number + 1:06d}.tar"
    return ShardEntry(name, "train", number, number + 1, f"{number:064x}", 0, (entry,), statistics)


def serve_and_poll(writer: DatasetWriter, folder: Path, config: ManyShardsConfig, later: int) -> dict[str, Any]:
    """Figures of the service while readers poll it and `later` shards are published."""
    start = config.shards
    with _child(_serve, config.service_nice, folder) as (service, served):
        port, health_port = served.recv()
        with (
            _child(_poll, config.readers_nice, port, config.readers, start + later) as (_, readers),
            _child(_probe, config.service_nice, port) as (_, beside),
            _child(_probe, config.service_nice, health_port) as (_, probe),
        ):
            readers.recv(), probe.recv(), beside.recv()  # they are ready
            stop_at = time.time() + later * config.publish_every_s + 5
            readers.send(stop_at)
            probe.send(stop_at)
            beside.send(stop_at)
            used_before = _cpu_s(service.pid)
            for number in range(start, start + later):
                time.sleep(config.publish_every_s)
                publish_one(writer, number)
            polled, asked, asked_beside = readers.recv(), probe.recv(), beside.recv()
        used = {name: after - used_before[name] for name, after in _cpu_s(service.pid).items()}
        memory = _status(service.pid, "VmHWM")
        served.send("end")
        handled = served.recv()
    requests = polled["requests"] + len(asked) + len(asked_beside)
    return {
        "shards": start + later,
        "readers": config.readers,
        **polled,
        "healthz_wall_s": _quantiles(asked),  # at its own port
        "healthz_beside_readers_wall_s": _quantiles(asked_beside),
        "healthz_in_service_s": _quantiles(handled),
        "service_cpu_ms_a_request": 1e3 * used["ran"] / requests,
        "service_cpu_s": used["ran"],
        "service_waited_for_a_core_s": used["waited"],
        "service_memory_mb": memory,
        "load_average": list(os.getloadavg()),
    }


def found(work: list[Work], service: dict[str, Any]) -> list[str]:
    """What is not as it must be."""
    faults = []
    for what in ("claim", "publication", "look"):
        first, *_, last = (row for row in work if row.what == what)
        for name in ("lines", "read", "written"):
            before, after = getattr(first, name), getattr(last, name)
            if abs(after - before) > max(TOLERANCE * before, SPARE):
                faults.append(f"{what}: {name} went from {before} to {after}")
    start = max(row.read for row in work if row.what == "start")
    if start > START_BYTES:
        faults.append(f"a reader's start reads {start} bytes")
    if service["lost_connections"] or service["readers_that_saw_all"] < service["readers"]:
        faults.append(
            f"{service['lost_connections']} connections were lost, {service['readers_that_saw_all']} readers saw all"
        )
    return faults


def stage_small(writer: DatasetWriter, number: int) -> None:
    """An episode of two particles."""
    task = writer.task("train", number)
    generator = np.random.default_rng(number)
    none = np.zeros((0, 3))
    episode = Episode(
        key=task.key,
        position_TN3=(0.4 + 0.2 * generator.random((3, 2, 3))).astype(np.float32),
        initial_velocity_N3=np.zeros((2, 3), np.float32),
        material_N=np.zeros(2, np.uint8),
        obstacle_grid=ObstacleGrid(1 / 64, none.astype(np.int32), none.astype(np.float32)),
        domain_size=(1.0, 1.0, 1.0),
        gravity=(0.0, -9.8, 0.0),
        frame_rate_hz=writer.config.dataset.frame_rate_hz,
        seed=task.seed,
        material_parameters={},
        specification={},
        solver={"dataset": {"config_hash": writer.config_hash, "attempt": task.attempt}},
    )
    stage_episode(writer.folder, episode)
    writer.add_staged("train", number)


@contextmanager
def _child(target: Callable[..., None], nice: int, *arguments: Any) -> Iterator[tuple[Any, Connection]]:
    context = multiprocessing.get_context("spawn")
    connection, theirs = context.Pipe()
    process = context.Process(target=_nicely, args=(target, nice, theirs, *arguments), daemon=True)
    process.start()
    theirs.close()
    try:
        yield process, connection
    finally:
        process.join(10)
        process.kill()


def _nicely(target: Callable[..., None], nice: int, *arguments: Any) -> None:
    os.nice(nice)
    target(*arguments)


def _serve(connection: Connection, folder: Path) -> None:
    """The service of a folder, until it is told to end; sends the port, and the seconds that /healthz took in it."""
    import socket
    import threading

    from datagen.service.health import HealthPage
    from datagen.service.server import make_app, make_server, telling
    from datagen.service.supervisor import PoolState

    app, handled = make_app(folder, None, PoolState), []

    async def timed(scope: Any, receive: Any, send: Any) -> None:
        begun = time.perf_counter()
        await app(scope, receive, send)
        if scope.get("path") == "/healthz":
            handled.append(time.perf_counter() - begun)

    health = socket.create_server(("127.0.0.1", 0))
    health_port = health.getsockname()[1]
    with socket.create_server(("127.0.0.1", 0), backlog=1024) as listener, HealthPage(health) as page:
        server = make_server(timed, 4096, allow_open_files(65_536), every_second=telling(page, app))

        def end() -> None:
            connection.recv()
            connection.send(handled)
            server.should_exit = server.force_exit = True

        threading.Thread(target=end, daemon=True).start()
        connection.send((listener.getsockname()[1], health_port))
        server.run(sockets=[listener])


def _poll(connection: Connection, port: int, readers: int, shards: int) -> None:
    """Readers that each look at the manifest once a second, and ask for what they have not seen."""
    allow_open_files(65_536)
    connection.send("ready")
    stop_at = connection.recv()
    figures = {"requests": 0, "lost_connections": 0, "readers_that_saw_all": 0, "publications_seen": 0}

    async def read(number: int) -> None:
        await asyncio.sleep(number / readers)
        known, etag = None, ""
        stream = await asyncio.open_connection("127.0.0.1", port)
        while time.time() < stop_at:
            begun = time.monotonic()
            figures["requests"] += 1
            status, headers, body = await _get(stream, "/manifest.json", {"If-None-Match": etag} if etag else {})
            if status == 200:
                etag, count = headers["etag"], json.loads(body)["index"]["shards"]
                known = count if known is None else known
                while known < count:
                    figures["requests"] += 1
                    status, _, body = await _get(stream, f"/index?since={known}", {})
                    firsts = [json.loads(line)["first"] for line in body.splitlines()]
                    assert status == 200 and firsts == list(range(known, known + len(firsts)))
                    known += len(firsts)
                    figures["publications_seen"] += len(firsts)
            await asyncio.sleep(max(0.0, 1 - (time.monotonic() - begun)))
        figures["readers_that_saw_all"] += known == shards

    async def every() -> None:
        results = await asyncio.gather(*(read(number) for number in range(readers)), return_exceptions=True)
        faults = [repr(result) for result in results if result is not None]
        figures["lost_connections"] = len(faults)
        print(*sorted(set(faults)), sep="\n", end="", file=sys.stderr)

    asyncio.run(every())
    connection.send(figures)


def _probe(connection: Connection, port: int) -> None:
    """Seconds from asking for /healthz to its answer, on a connection of its own each time."""
    connection.send("ready")
    stop_at = connection.recv()

    async def ask() -> list[float]:
        taken = []
        while time.time() < stop_at:
            begun = time.perf_counter()
            stream = await asyncio.open_connection("127.0.0.1", port)
            status, _, _ = await _get(stream, "/healthz", {})
            stream[1].close()
            assert status == 200
            taken.append(time.perf_counter() - begun)
            await asyncio.sleep(_ASK_S)
        return taken

    connection.send(asyncio.run(ask()))


async def _get(
    stream: tuple[asyncio.StreamReader, asyncio.StreamWriter], path: str, headers: dict[str, str]
) -> tuple[int, dict[str, str], bytes]:
    reader, writer = stream
    lines = [
        f"GET {path} HTTP/1.1",
        "Host: 127.0.0.1",
        *(f"{name}: {value}" for name, value in headers.items()),
        "",
        "",
    ]
    writer.write("\r\n".join(lines).encode())
    head = (await reader.readuntil(b"\r\n\r\n")).decode().split("\r\n")
    answer = {name.lower(): value.strip() for name, _, value in (line.partition(":") for line in head[1:] if line)}
    body = await reader.readexactly(int(answer.get("content-length", 0)))
    return int(head[0].split()[1]), answer, body


def _quantiles(seconds: list[float]) -> dict[str, float]:
    middle, late = np.percentile(seconds, (50, 99)).tolist()
    return {"median": middle, "p99": late, "largest": max(seconds), "samples": len(seconds)}


def _status(process: int, name: str) -> float:
    """A line of /proc/PID/status, MB."""
    lines = dict(line.split(":", 1) for line in Path(f"/proc/{process}/status").read_text().splitlines())
    return int(lines[name].split()[0]) / 1e3


def _cpu_s(process: int) -> dict[str, float]:
    """Seconds on a core, and ready but without one."""
    rows = [path.read_text().split() for path in Path(f"/proc/{process}/task").glob("*/schedstat")]
    return {"ran": sum(int(row[0]) for row in rows) / 1e9, "waited": sum(int(row[1]) for row in rows) / 1e9}


if __name__ == "__main__":
    run_command(main, "many_shards")
