"""Serves a data set over HTTP, read-only: the manifest, the listed shards, and the progress of the generator.

| path | contents | |
|---|---|---|
| /manifest.json | the manifest: contents of the data set, and the published part | ETag: sha256 of its bytes |
| /index/... | the index's files (see `hgn.data.index`) | Range |
| /<shard>.tar | a published shard | ETag: its sha256; Range, If-Range |
| /progress | counts and the pool's state, JSON | |
| /metrics | the same for Prometheus | |
| /healthz | 200 while the service works; needs no token; see `datagen.service.health` for a busy service | |

No other file of the folder can be read, nor a shard whose bytes differ from the manifest. With a token each request
must contain `Authorization: Bearer <token>`.
"""

import asyncio
import hashlib
import hmac
import re
from collections import Counter, defaultdict
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from pathlib import Path

import uvicorn
from anyio import CapacityLimiter, to_thread
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from datagen.service.health import HealthPage
from datagen.service.sendfile import FileRange
from datagen.service.supervisor import PoolState
from datagen.service.uvicorn_compat import SendfileProtocol
from hgn.data.index import INDEX_NAME, Index
from hgn.data.manifest import MANIFEST_NAME, Manifest
from hgn.data.verification import verify_file
from hgn.schema import ConfigError
from hgn.system.files import read_replaced

_OPEN_PATHS = ("/healthz",)
_GRACE_S = 5  # time for running answers after a stop; readers later resume interrupted downloads
_FRESH_S = 0.05  # largest age of a manifest that is used again; a thousand readers may send requests in a second
_BACKLOG = 256  # connections that the system accepts before the service handles them
_OTHER_FILES = 64  # open files besides connections and shards
OPEN_FILES = 1024  # assumed limit of open files
_REMEDY = "delete it and run the generator again"


@dataclass(frozen=True)
class Snapshot:
    """A manifest with its bytes and ETag."""

    content: bytes
    etag: str
    manifest: Manifest


class Published:
    """The manifest of a folder, and the index of its shards.

    A changed manifest and each needed line of the index are read once, however many requests arrive. A snapshot never
    changes, so a request sees one manifest.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._stamp: tuple[int, ...] | None = None
        self._snapshot: Snapshot | None = None
        self._looked_at = 0.0  # time by the loop's clock
        self._shards: dict[str, tuple[str, int]] = {}  # sha256 and bytes by name
        self._listed: Index | None = None  # the index of these shards
        self._reading, self._listing = asyncio.Lock(), asyncio.Lock()
        self._threads = CapacityLimiter(2)  # separate threads, because those of the app may be hashing shards

    async def snapshot(self) -> Snapshot:
        """Returns the present manifest. Raises: ConfigError if there is none that this version can read."""
        time = asyncio.get_running_loop().time
        if self._snapshot is None or time() > self._looked_at + _FRESH_S:
            async with self._reading:
                if self._snapshot is None or time() > self._looked_at + _FRESH_S:
                    looked_at = time()
                    await to_thread.run_sync(self._read, limiter=self._threads)
                    self._looked_at = looked_at
        assert self._snapshot is not None
        return self._snapshot

    async def shard(self, name: str) -> tuple[str, int] | None:
        """Returns the sha256 and size of a published shard, or None."""
        index = (await self.snapshot()).manifest.shards
        if name not in self._shards:
            async with self._listing:
                if index is not self._listed:
                    await to_thread.run_sync(self._list, index, limiter=self._threads)
        return self._shards.get(name)

    def _read(self) -> None:
        path = self.folder / MANIFEST_NAME
        try:
            status = path.stat()
        except FileNotFoundError:
            raise ConfigError("the data set has no manifest yet; try again later") from None
        stamp = (status.st_ino, status.st_mtime_ns, status.st_ctime_ns, status.st_size)
        if self._snapshot is None or stamp != self._stamp:
            content = read_replaced(path)
            manifest = Manifest.parse(content, self.folder)
            if self._snapshot is not None:
                manifest = replace(manifest, shards=self._snapshot.manifest.shards.continued(manifest.shards))
            self._snapshot = Snapshot(content, f'"{hashlib.sha256(content).hexdigest()}"', manifest)
            self._stamp = stamp

    def _list(self, index: Index) -> None:
        listed = self._listed
        first = len(listed) if listed is not None and listed.state.generation == index.state.generation else 0
        new = {shard.name: (shard.sha256, shard.bytes) for shard in index.since(first)}
        self._shards = (self._shards if first else {}) | new  # replaced as a whole, because requests read it meanwhile
        self._listed = index


class Guard:
    """Checks the token of each request, and counts answers."""

    def __init__(self, app: ASGIApp, token: str | None, counters: Counter[str]) -> None:
        self._app, self._counters = app, counters
        self._expected = None if token is None else f"Bearer {token}".encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def counted(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._counters[f"code {message['status']}"] += 1
            await send(message)
            self._counters["bytes"] += len(message.get("body", b"")) + message.get("count", 0)

        if scope["type"] != "http":
            return
        if any(
            name == b"transfer-encoding" or (name == b"content-length" and value != b"0")
            for name, value in scope["headers"]
        ):
            await PlainTextResponse("uploads are not accepted\n", 413, {"connection": "close"})(scope, receive, counted)
            return
        if self._expected is None and not _is_own_name(scope):  # a web page may let its host name point here
            await PlainTextResponse("use this machine's address, or set a token\n", 421)(scope, receive, counted)
            return
        if not self._allowed(scope):
            refusal = PlainTextResponse(
                "a valid token is needed: Authorization: Bearer <token>\n", 401, {"WWW-Authenticate": "Bearer"}
            )
            await refusal(scope, receive, counted)
            return
        await self._app(scope, receive, counted)

    def _allowed(self, scope: Scope) -> bool:
        if self._expected is None or scope["path"] in _OPEN_PATHS:
            return True
        given = [value for name, value in scope["headers"] if name == b"authorization"]
        # in constant time, so that the delay of the answer reveals nothing about the token
        return len(given) == 1 and hmac.compare_digest(given[0], self._expected)


def make_app(folder: Path, token: str | None, pool: Callable[[], PoolState]) -> Starlette:
    """Returns the service as an ASGI application."""
    published, counters = Published(folder), Counter[str]()
    hashing: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)

    async def manifest(request: Request) -> Response:
        snapshot = await published.snapshot()
        headers = {"etag": snapshot.etag, "cache-control": "no-cache"}
        if _unchanged(request, snapshot.etag):
            return Response(status_code=304, headers=headers)
        return Response(snapshot.content, headers=headers, media_type="application/json")

    async def index_file(request: Request) -> Response:
        index = (await published.snapshot()).manifest.shards
        name = f"{INDEX_NAME}/{request.path_params['name']}"
        size = await to_thread.run_sync(index.size, name)
        if size is None:
            return PlainTextResponse("the index has no such file\n", 404)
        # sent bytes of this file never change; it can only grow
        headers = {"etag": f'"{request.path_params["name"]}"', "cache-control": "private, no-cache"}
        return FileRange(folder / name, size, headers, "application/jsonl")

    async def shard(request: Request) -> Response:
        name = request.path_params["name"]
        entry = await published.shard(name)
        if entry is None:
            return PlainTextResponse("the manifest lists no such shard\n", 404)
        (sha256, size), path = entry, folder / name
        try:
            # many readers request a new shard together; only the first request computes its sha256
            async with hashing[name]:
                await to_thread.run_sync(verify_file, path, sha256, size, _REMEDY)
        except FileNotFoundError:
            return PlainTextResponse(f"{name} is missing here; it must be generated again\n", 404)
        except ConfigError:
            return PlainTextResponse(f"{name} is damaged here; {_REMEDY}\n", 410)
        etag = f'"{sha256}"'
        # later another data set may have a shard with this name at this address
        headers = {"etag": etag, "cache-control": "private, no-cache"}
        if _unchanged(request, etag):
            return Response(status_code=304, headers=headers)
        return FileRange(path, size, headers, "application/x-tar")

    async def progress(request: Request) -> Response:
        return JSONResponse(
            _progress((await published.snapshot()).manifest, pool()), headers={"cache-control": "no-store"}
        )

    async def metrics(request: Request) -> Response:
        text = _metrics((await published.snapshot()).manifest, pool(), counters)
        return PlainTextResponse(text, media_type="text/plain; version=0.0.4; charset=utf-8")

    async def health() -> dict[str, str]:
        await published.snapshot()
        return {"status": "ok", "generator": pool().status}

    async def healthz(request: Request) -> Response:
        return JSONResponse(await health())

    async def unreadable(request: Request, error: Exception) -> Response:
        return PlainTextResponse(f"{error}\n", 503, {"retry-after": "1"})

    app = Starlette(
        routes=[
            Route(f"/{MANIFEST_NAME}", manifest),
            Route(f"/{INDEX_NAME}/{{name}}", index_file),
            Route("/progress", progress),
            Route("/metrics", metrics),
            Route("/healthz", healthz),
            Route("/{name}", shard),
        ],
        middleware=[Middleware(Guard, token=token, counters=counters)],
        exception_handlers={ConfigError: unreadable, OSError: unreadable},
    )
    app.router.redirect_slashes = False
    app.state.health = health
    return app


def telling(page: HealthPage, app: Starlette) -> Callable[[], Awaitable[None]]:
    """Returns a function that reports the state of an app to `page`. It does not wait for a folder that hangs."""
    looks: set[asyncio.Task[None]] = set()

    async def look() -> None:
        try:
            page.tell(200, await app.state.health())
        except (ConfigError, OSError) as error:
            page.tell(503, {"status": str(error)})

    async def tell() -> None:
        if not looks:
            looks.add(task := asyncio.create_task(look()))
            task.add_done_callback(looks.discard)

    return tell


def make_server(
    app: ASGIApp,
    connections: int = SendfileProtocol.most_connections,
    open_files: int = OPEN_FILES,
    patience_s: float = SendfileProtocol.patience_s,
    every_second: Callable[[], Awaitable[None]] | None = None,
) -> uvicorn.Server:
    """Returns a server for `connections`, or fewer if `open_files` are too few; see SendfileProtocol."""
    most = max(1, min(connections, (open_files - _BACKLOG - _OTHER_FILES) // 2))  # a socket and a shard each
    limits = {"most_connections": most, "patience_s": patience_s}
    return uvicorn.Server(
        uvicorn.Config(
            app,
            http=type("Protocol", (SendfileProtocol,), limits),
            backlog=_BACKLOG,
            loop="asyncio",  # uvloop, which Uvicorn prefers if installed, cannot send files
            lifespan="off",
            ws="none",
            log_level="warning",
            access_log=False,
            server_header=False,
            limit_concurrency=most + 1,
            timeout_graceful_shutdown=_GRACE_S,
            callback_notify=every_second,
            timeout_notify=0,  # seconds; it is called every second
        )
    )


def _is_own_name(scope: Scope) -> bool:
    """Returns whether a request names this machine: localhost, or the address to which it was sent."""
    hosts = [value.decode("latin-1") for name, value in scope["headers"] if name == b"host"]
    names = [re.sub(r":\d+$", "", host).strip("[]") for host in hosts]
    own = ("localhost", "127.0.0.1", "::1", str((scope.get("server") or ("",))[0]))
    return all(name in own for name in names)


def _unchanged(request: Request, etag: str) -> bool:
    asked = request.headers.get("if-none-match", "")
    return asked.strip() == "*" or etag in [tag.strip().removeprefix("W/") for tag in asked.split(",")]


def _progress(manifest: Manifest, pool: PoolState) -> dict[str, object]:
    return {
        "config_hash": manifest.config_hash,
        "revision": manifest.revision,
        "complete": manifest.complete,
        "episodes": {
            split: {"requested": count, "published": manifest.published(split)}
            for split, count in manifest.requested.items()
        },
        "shards": len(manifest.shards),
        "bytes": sum(total.bytes for total in manifest.totals.values()),
        "quarantined": manifest.shards.state.quarantined,
        "generator": vars(pool)
        | {"running": [{"frame": frame, "scenes": scenes} for frame, scenes in pool.running.values()]},
    }


def _metrics(manifest: Manifest, pool: PoolState, counters: Counter[str]) -> str:
    splits = [(split, f'{{split="{split}"}}') for split in manifest.requested]
    codes = sorted(key.removeprefix("code ") for key in counters if key.startswith("code "))
    families: list[tuple[str, str, str, list[tuple[str, float]]]] = [
        ("hgn_episodes_requested", "gauge", "Requested number of episodes.",
         [(label, manifest.requested[split]) for split, label in splits]),
        ("hgn_episodes_published", "gauge", "Episodes that can be read.",
         [(label, manifest.published(split)) for split, label in splits]),
        ("hgn_shards_published", "gauge", "Shards that can be read.", [("", len(manifest.shards))]),
        ("hgn_shard_bytes_published", "gauge", "Bytes of these shards.",
         [("", sum(totals.bytes for totals in manifest.totals.values()))]),
        ("hgn_manifest_revision", "counter", "Revision of the manifest.", [("", manifest.revision)]),
        ("hgn_scenes_quarantined", "gauge", "Scenes that could not be simulated.",
         [("", manifest.shards.state.quarantined)]),
        ("hgn_generator_running", "gauge", "1 while the pool runs.", [("", int(pool.status == "running"))]),
        ("hgn_generator_failed", "gauge", "1 when it ended permanently with an error.",
         [("", int(pool.status == "failed"))]),
        ("hgn_generator_starts_total", "counter", "Starts of the pool.", [("", pool.starts)]),
        ("hgn_generator_episodes_done", "gauge", "Episodes published or staged.", [("", pool.done)]),
        ("hgn_generator_scenes_running", "gauge", "Scenes being simulated.",
         [("", sum(scenes for _, scenes in pool.running.values()))]),
        ("hgn_http_responses_total", "counter", "Answers by status code.",
         [(f'{{code="{code}"}}', counters[f"code {code}"]) for code in codes]),
        ("hgn_http_sent_bytes_total", "counter", "Bytes of all answers' bodies.", [("", counters["bytes"])]),
    ]  # fmt: skip
    lines = []
    for name, kind, text, samples in families:
        lines += [f"# HELP {name} {text}", f"# TYPE {name} {kind}"]
        lines += [f"{name}{label} {value}" for label, value in samples]
    return "\n".join(lines) + "\n"
