"""The processes of the pool: makers build scenes, solvers simulate them and stage the episodes.

Started with `spawn` (a forked Taichi hangs). A worker ends when its parent does, and leaves signals from the
terminal to it. Whatever goes wrong inside is sent to the parent; a worker that dies without a word is its affair too.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pkgutil
import signal
import sys
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np

from datagen.pool.plan import SceneTask
from datagen.pool.shard import stage_episode
from hgn.config import DatagenConfig
from hgn.data.identity import dataset_identity, identity_hash, physics_settings
from hgn.scene.episode import Episode
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.scene.scene import Scene
from hgn.schema import ConfigError
from hgn.system.extras import missing_extra
from hgn.system.processes import die_with_parent

_FRAME_REPORT_SECONDS = 1.0  # between reports of a worker; each is a line of a log with progress=json
_STAGING_THREADS = 8
_END_SECONDS = 10.0  # which a dismissed worker has


@dataclass(frozen=True)
class Backend:
    """Where the functions that do the work are found, as `module:function`; resolved inside the workers alone, so
    that the parent imports no solver.
    """

    generate_scene: str = "hgn.scene.random_scene:generate_scene"
    build_obstacle_grid: str = "hgn.scene.obstacle_grid:build_obstacle_grid"
    build_collider: str = "datagen.mpm.collider:build_collider"
    simulate: str = "datagen.mpm.solver:simulate"
    warm_up: str = "datagen.mpm.solver:warm_up"


@dataclass(frozen=True)
class MadeScene:
    """A scene ready for the solver."""

    task: SceneTask
    scene: Scene
    obstacle_grid: ObstacleGrid | None  # none: it follows, for the solver does not need it
    collider: Any = None  # what the solver makes of the obstacles


@dataclass(frozen=True)
class GridTask:
    """The obstacle grid of a made scene, to be built."""

    task: SceneTask
    scene: Scene


@dataclass(frozen=True)
class BuiltGrid:
    """What became of it: the grid, or why there is none."""

    task: SceneTask
    grid: ObstacleGrid | str


class Worker(ABC):
    """The pool's end of a worker, wherever it runs."""

    def __init__(self) -> None:
        self.idle = False
        self.tasks: dict[str, SceneTask | MadeScene | GridTask] = {}  # what it has and has not answered for, by key
        self.given = 0  # scenes to simulate, in all
        self.heard_at = time.monotonic()  # when it was last given or said something

    @abstractmethod
    def give(self, message: object) -> None:
        """Sends work. A worker that has died meanwhile is noticed at the next receive."""

    def tell(self, message: object) -> None:
        """Sends what belongs to work that it has. Only workers that leave something to be sent later are told."""
        raise NotImplementedError

    def dismiss(self) -> None:  # noqa: B027 - Ray ends its actors itself
        """Tells an idle one that nothing comes any more; `kill` waits a little for its end then."""

    @abstractmethod
    def kill(self) -> None:
        """Ends it at once."""

    @abstractmethod
    def cause_of_death(self) -> str:
        """Why a worker that no longer answers has ended."""

    def blamable(self) -> bool:
        """Whether what it was working on may have been its end; not where its whole machine went away."""
        return True


class LocalWorker(Worker):
    """A process of this machine."""

    def __init__(self, target: Callable[..., None], *arguments: Any) -> None:
        super().__init__()
        context = multiprocessing.get_context("spawn")
        self.connection, child = context.Pipe()
        self.process = context.Process(target=_run, args=(target, child, *arguments), daemon=True)
        with _terminal_signals_blocked():
            self.process.start()
        child.close()
        self.idle, self._patience_s = True, 0.0

    def give(self, message: object) -> None:
        self.idle, self.heard_at = False, time.monotonic()
        self.tell(message)

    def tell(self, message: object) -> None:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.connection.send(message)

    def dismiss(self) -> None:
        # Taichi writes what it compiled to its cache as the process ends
        self.connection.close()
        self._patience_s = _END_SECONDS

    def kill(self) -> None:
        # staged files appear whole or not at all, so nothing is half-written
        self.process.join(self._patience_s)
        self.process.kill()
        self.process.join()
        self.connection.close()

    def cause_of_death(self) -> str:
        self.process.join(timeout=10)
        code = self.process.exitcode
        if code is not None and code < 0:
            return f"its process was ended by {signal.Signals(-code).name}"
        return f"its process ended with exit code {code}"


def start_maker(config: DatagenConfig, backend: Backend) -> LocalWorker:
    """A process that answers each SceneTask with a MadeScene, or a cause, and each GridTask with a BuiltGrid."""
    return LocalWorker(_make_scenes, config, backend)


def start_solver(
    config: DatagenConfig, backend: Backend, threads: int | None, gpu: str | None, first_launch: int
) -> LocalWorker:
    """A process that simulates lists of MadeScene, and takes the BuiltGrid of those that lack one at any time.

    `gpu` is the one CUDA device that it may see; none: as given. The first list has `first_launch` scenes.
    """
    return LocalWorker(_solve, config, backend, threads, gpu, first_launch)


def receive(workers: Iterable[LocalWorker], timeout: float) -> Iterator[tuple[LocalWorker, tuple[Any, ...] | None]]:
    """What the workers have said, waiting `timeout` seconds at most for the first word; None from one that died."""
    by_connection = {worker.connection: worker for worker in workers}
    for connection in wait(list(by_connection), timeout):
        worker = by_connection[connection]  # type: ignore[index]
        try:
            message = worker.connection.recv()
        except (EOFError, ConnectionResetError):
            message = None
        yield worker, message


def _run(target: Callable[..., None], connection: Connection, *arguments: Any) -> None:
    _end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    send = _Sender(connection)
    with _errors_sent(send):
        target(connection, send, *arguments)


class _Sender:
    """Sends from the main thread and from the staging thread."""

    def __init__(self, connection: Connection) -> None:
        self._connection, self._lock = connection, threading.Lock()

    def __call__(self, *message: object) -> None:
        with self._lock:
            try:
                self._connection.send(message)
            except (BrokenPipeError, ConnectionResetError):
                os._exit(0)  # the parent has gone


def error_message(error: Exception) -> tuple[Any, ...]:
    """What a worker tells the pool of a fault that no scene is to blame for."""
    if isinstance(error, ConfigError):
        return "config_error", str(error)
    if isinstance(error, ModuleNotFoundError) and (missing := missing_extra(error)):
        return "config_error", missing
    if isinstance(error, OSError):
        return "os_error", error.errno, error.strerror, None if error.filename is None else str(error.filename)
    return "error", "".join(traceback.format_exception(error))


@contextlib.contextmanager
def _errors_sent(send: _Sender) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # noqa: BLE001 - not swallowed: the parent stops with this text
        send(*error_message(error))


def _make_scenes(connection: Connection, send: _Sender, config: DatagenConfig, backend: Backend) -> None:
    for task in _received(connection):
        if isinstance(task, GridTask):
            send("grid", _build_grid(task, backend))
        else:
            send(*make_scene(task, config, backend, with_grid=False))
        send("idle")


def make_scene(task: SceneTask, config: DatagenConfig, backend: Backend, with_grid: bool = True) -> tuple[Any, ...]:
    """What a maker answers: ("made", MadeScene), or ("failed", key, cause)."""
    generate_scene = pkgutil.resolve_name(backend.generate_scene)
    build_collider = pkgutil.resolve_name(backend.build_collider)
    try:
        scene = generate_scene(config.scene, task.seed)
        # here rather than in the solver, which would do it for one scene after another while its device waits
        collider = build_collider(scene, config.mpm.collider_band_cells)
    except ConfigError as error:  # no room for the obstacles, say: another seed may do
        return "failed", task.key, str(error)
    made = MadeScene(task, scene, None, collider)
    if with_grid:
        grid = _build_grid(GridTask(task, scene), backend).grid
        if isinstance(grid, str):
            return "failed", task.key, grid
        made = replace(made, obstacle_grid=grid)
    return "made", made


def _build_grid(task: GridTask, backend: Backend) -> BuiltGrid:
    build_obstacle_grid = pkgutil.resolve_name(backend.build_obstacle_grid)
    scene = task.scene
    try:
        grid = build_obstacle_grid(scene.obstacles, scene.cell_size, scene.seed, scene.domain_size)
    except ConfigError as error:
        return BuiltGrid(task.task, str(error))
    return BuiltGrid(task.task, grid)


class _Inbox:
    """What the pool sends to a solver, read while it simulates: lists of scenes, and grids."""

    def __init__(self, connection: Connection) -> None:
        self._batches: SimpleQueue[list[MadeScene] | None] = SimpleQueue()
        self._grids: defaultdict[SceneTask, Future[ObstacleGrid | str]] = defaultdict(Future)
        self._lock = threading.Lock()
        threading.Thread(target=self._read, args=(connection,), name="inbox", daemon=True).start()

    def batches(self) -> Iterator[list[MadeScene]]:
        """Until the pool has gone."""
        while (batch := self._batches.get()) is not None:
            yield batch

    def grid(self, made: MadeScene) -> ObstacleGrid | str:
        """The grid of a scene, or why there is none; waits for it."""
        if made.obstacle_grid is not None:
            return made.obstacle_grid
        grid = self._coming(made.task).result()
        with self._lock:
            self._grids.pop(made.task, None)
        return grid

    def _coming(self, task: SceneTask) -> Future[ObstacleGrid | str]:
        with self._lock:
            return self._grids[task]

    def _read(self, connection: Connection) -> None:
        for message in _received(connection):
            if isinstance(message, BuiltGrid):
                self._coming(message.task).set_result(message.grid)
            else:
                self._batches.put(message)
        self._batches.put(None)
        with self._lock:
            for grid in self._grids.values():
                grid.cancel()


def _solve(
    connection: Connection,
    send: _Sender,
    config: DatagenConfig,
    backend: Backend,
    threads: int | None,
    gpu: str | None,
    first_launch: int,
) -> None:
    if gpu is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpu
    config_hash = identity_hash(dataset_identity(config))
    inbox = _Inbox(connection)
    on_gpu = threads is None
    if on_gpu:  # it compiles while the first scenes are made
        pkgutil.resolve_name(backend.warm_up)(config.scene, config.mpm, first_launch)
    # one batch is staged while the next is simulated, so that a GPU does not wait for the disk
    with ThreadPoolExecutor(max_workers=_STAGING_THREADS) as stager:
        staging: list[Future[None]] = []
        for batch in inbox.batches():
            if on_gpu:  # the next may come already
                send("idle")
            results = simulate_batch(batch, config, backend, threads, lambda count: _frame_reporter(send, count))
            for future in staging:
                future.result()
            staging = [
                stager.submit(_stage, send, config, config_hash, inbox, made, result)
                for made, result in zip(batch, results, strict=True)
            ]
            send("frame", 0, 0)
            if not on_gpu:
                send("idle")


def simulate_batch(
    batch: list[MadeScene],
    config: DatagenConfig,
    backend: Backend,
    threads: int | None,
    reporter: Callable[[int], Callable[[int], None]] | None = None,
) -> list[Any]:
    """What the solver returns for each scene, by one launch for each length of episodes; `reporter` makes of a launch's
    scene count what is called with each of its frames.
    """
    simulate, lengths = pkgutil.resolve_name(backend.simulate), [config.dataset.frames_of(m.task.index) for m in batch]
    results: dict[SceneTask, Any] = {}
    for frames in sorted(set(lengths)):
        launch = [made for made, length in zip(batch, lengths, strict=True) if length == frames]
        found = simulate(
            [made.scene for made in launch],
            config.mpm,
            frames,
            config.dataset.frame_rate_hz,
            on_frame=reporter and reporter(len(launch)),
            cpu_threads=threads,
            colliders=[made.collider for made in launch],
        )
        results |= zip((made.task for made in launch), found, strict=True)
    return [results[made.task] for made in batch]


def _stage(send: _Sender, config: DatagenConfig, config_hash: str, inbox: _Inbox, made: MadeScene, result: Any) -> None:
    with _errors_sent(send):
        cause = failure_of(result)
        grid = inbox.grid(made) if cause is None else cause
        if isinstance(grid, str):
            send("failed", made.task.key, grid)
            return
        stage_episode(
            Path(config.dataset.folder),
            make_episode(replace(made, obstacle_grid=grid), result, config, config_hash),
        )
        send("staged", made.task.key)


def failure_of(result: Any) -> str | None:
    """Why what the solver returned is no episode; none where it is one."""
    cause = getattr(result, "cause", None)
    if cause is not None:
        return str(cause)
    return None if np.isfinite(result.position_TN3).all() else "positions are not finite"


def make_episode(made: MadeScene, result: Any, config: DatagenConfig, config_hash: str) -> Episode:
    """The episode of a scene with its grid and what the solver returned for it (`position_TN3`, `counters`)."""
    assert made.obstacle_grid is not None
    return Episode(
        key=made.task.key,
        position_TN3=np.ascontiguousarray(result.position_TN3, np.float32),
        initial_velocity_N3=made.scene.velocity_N3,
        material_N=made.scene.material_N,
        obstacle_grid=made.obstacle_grid,
        domain_size=made.scene.domain_size,
        gravity=made.scene.gravity,
        frame_rate_hz=config.dataset.frame_rate_hz,
        seed=made.task.seed,
        material_parameters={
            name: np.where(np.isnan(value), getattr(config.mpm, name), value).astype(np.float32)
            for name, value in made.scene.material_parameters.items()
        },
        specification=made.scene.specification,
        solver={
            "settings": physics_settings(config),
            "particles_per_cell": made.scene.particles_per_cell,
            "counters": dict(result.counters),
            "dataset": {"config_hash": config_hash, "attempt": made.task.attempt},
        },
    )


def _frame_reporter(send: _Sender, scenes: int) -> Callable[[int], None]:
    last = 0.0

    def report(frame: int) -> None:
        nonlocal last
        if time.monotonic() - last > _FRAME_REPORT_SECONDS:
            last = time.monotonic()
            send("frame", int(frame), scenes)

    return report


def _received(connection: Connection) -> Iterator[Any]:
    while True:
        try:
            yield connection.recv()
        except (EOFError, ConnectionResetError):
            return


def _end_with_parent() -> None:
    # on Linux the kernel does it; elsewhere a worker ends when it next touches its closed pipe
    die_with_parent(signal.SIGKILL)
    if sys.platform == "linux":
        parent = multiprocessing.parent_process()
        if parent is None or os.getppid() != parent.pid:
            os._exit(0)


@contextlib.contextmanager
def _terminal_signals_blocked() -> Iterator[None]:
    # a child inherits the mask: Ctrl-C reaches the whole process group, and only the parent may act on it.
    # Starting the resource tracker unblocks the signal, so it is started before.
    resource_tracker.ensure_running()
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)
