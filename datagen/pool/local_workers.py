"""Runs workers in processes of this machine.

A worker ends with its parent, ignores signals of the terminal, and ends in order after SIGTERM. Its errors are sent to
the parent.
"""

import contextlib
import os
import pkgutil
import signal
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing.connection import Connection, wait
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from datagen.pool.plan import SceneTask
from datagen.pool.shard import stage_episode
from datagen.pool.worker import (
    Backend,
    BuiltGrid,
    GridTask,
    MadeScene,
    Worker,
    build_grid,
    error_message,
    failure_of,
    make_episode,
    make_scene,
    simulate_batch,
)
from datagen.pool.worker_plan import WorkerPlan
from hgn.config import DatagenConfig
from hgn.data.identity import dataset_identity, identity_hash
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.system.processes import ENDED, cause_of_exit, start_child
from hgn.system.signals import Signals

_FRAME_REPORT_SECONDS = 1.0  # interval between a worker's reports; each is a line with progress=json
_STAGING_THREADS = 8
_STAGING_FRAME = 8  # frame of a launch at which the results of the launch before are staged


class LocalWorker(Worker):
    """Runs a worker in a process of this machine."""

    reports_often = True

    def __init__(self, target: Callable[..., None], *arguments: Any) -> None:
        super().__init__()
        self.process, self.connection = start_child(_run, target, *arguments)
        self.idle = True

    def give(self, message: object) -> None:
        self.idle, self.last_message_s = False, time.monotonic()
        if isinstance(message, list):
            for made in message:  # sent one by one, because a whole launch (a gigabyte) would be copied several times
                self.send(made)
            message = None
        self.send(message)

    def send(self, message: object) -> None:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.connection.send(message)

    def dismiss(self, deadline_s: float) -> None:
        # at its end the process stages the scenes that it has simulated, and writes kernels to Taichi's cache
        self.process.terminate()
        self.process.join(max(0.0, deadline_s - time.monotonic()))

    def kill(self) -> None:
        # staged files are written atomically, so no partial file remains
        self.process.kill()
        self.process.join()
        self.connection.close()

    def cause_of_death(self) -> str:
        self.process.join(timeout=10)
        return cause_of_exit(self.process)


class LocalWorkerFactory:
    """Starts workers in processes of this machine."""

    def __init__(self, config: DatagenConfig, backend: Backend, plan: WorkerPlan) -> None:
        self.plan, self._config, self._backend = plan, config, backend

    def start_maker(self) -> Worker:
        """Starts a process that answers a SceneTask by a MadeScene or a cause, and a GridTask by a BuiltGrid."""
        return LocalWorker(_make_scenes, self._config, self._backend)

    def start_solver(self, number: int) -> Worker:
        """Starts a process that simulates batches. With several solvers on GPUs each uses one CUDA device.

        It receives a batch as one MadeScene after another, and None at the end, and BuiltGrid at any time.
        """
        plan = self.plan
        gpu = plan.gpus[number % len(plan.gpus)] if plan.solvers > 1 and plan.gpus else None
        return LocalWorker(_solve, self._config, self._backend, plan.threads, gpu, plan.first_launch)

    def receive(self, workers: Sequence[Worker], timeout: float) -> Iterator[tuple[Worker, tuple[Any, ...] | None]]:
        by_connection = {worker.connection: worker for worker in workers if isinstance(worker, LocalWorker)}
        for connection in wait(list(by_connection), timeout):
            worker = by_connection[connection]  # type: ignore[index]
            try:
                message = worker.connection.recv()
            except ENDED:
                message = None
            yield worker, message


def _run(connection: Connection, target: Callable[..., None], *arguments: Any) -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    send = _Sender(connection)
    with Signals(lambda number: sys.exit(128 + number), numbers=(signal.SIGTERM,)), _errors_sent(send):
        target(connection, send, *arguments)


class _Sender:
    """Sends messages from several threads."""

    def __init__(self, connection: Connection) -> None:
        self._connection, self._lock = connection, threading.Lock()

    def __call__(self, *message: object) -> None:
        with self._lock:
            try:
                self._connection.send(message)
            except (BrokenPipeError, ConnectionResetError):
                os._exit(0)  # the parent has ended


@contextlib.contextmanager
def _errors_sent(send: _Sender) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # noqa: BLE001 - not swallowed: the parent stops with this text
        send(*error_message(error))


def _make_scenes(connection: Connection, send: _Sender, config: DatagenConfig, backend: Backend) -> None:
    for task in _received(connection):
        if isinstance(task, GridTask):
            send("grid", build_grid(task, backend))
        else:
            send(*make_scene(task, config, backend, with_grid=False))
        send("idle")


class _Inbox:
    """Receives scenes, None at the end of a launch, and grids in a thread, while the solver simulates."""

    def __init__(self, connection: Connection, send: _Sender) -> None:
        self._batches: SimpleQueue[list[MadeScene] | None] = SimpleQueue()
        self._grids: defaultdict[SceneTask, Future[ObstacleGrid | str]] = defaultdict(Future)
        self._lock = threading.Lock()
        threading.Thread(target=self._read, args=(connection, send), name="inbox", daemon=True).start()

    def batches(self, before_waiting: Callable[[], None]) -> Iterator[list[MadeScene]]:
        """Yields batches until the pool ends. Calls `before_waiting` if the next batch is not there yet."""
        while True:
            if self._batches.empty():
                before_waiting()
            batch = self._batches.get()
            if batch is None:
                return
            yield batch

    def grid(self, made: MadeScene) -> ObstacleGrid | str:
        """Waits for the grid of a scene. Returns the grid, or why it could not be built."""
        if made.obstacle_grid is not None:
            return made.obstacle_grid
        grid = self._coming(made.task).result()
        with self._lock:
            self._grids.pop(made.task, None)
        return grid

    def _coming(self, task: SceneTask) -> Future[ObstacleGrid | str]:
        with self._lock:
            return self._grids[task]

    def _read(self, connection: Connection, send: _Sender) -> None:
        with _errors_sent(send):
            batch: list[MadeScene] = []
            for message in _received(connection):
                if isinstance(message, BuiltGrid):
                    self._coming(message.task).set_result(message.grid)
                elif isinstance(message, MadeScene):
                    message.scene.open()
                    message.collider.open()
                    batch.append(message)
                else:
                    self._batches.put(batch)
                    batch = []
            self._batches.put(None)
            with self._lock:
                for grid in self._grids.values():
                    grid.cancel()
            return
        os._exit(1)  # otherwise the parent could wait forever for this process to read


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
    inbox = _Inbox(connection, send)
    on_gpu = threads is None
    if on_gpu:  # compiles kernels while the first scenes are built
        pkgutil.resolve_name(backend.warm_up)(config.scene, config.mpm, first_launch)
    finished: list[tuple[MadeScene, Any]] = []  # scenes and results that are not being staged yet
    staging: list[Future[None]] = []
    with ThreadPoolExecutor(max_workers=_STAGING_THREADS) as stager:

        def stage_finished(frame: int = _STAGING_FRAME) -> None:
            if frame >= _STAGING_FRAME:
                staging.extend(stager.submit(_stage, send, config, config_hash, inbox, *pair) for pair in finished)
                finished.clear()

        # A batch is staged while the next is simulated, so that a GPU does not wait for the disk. Staging begins when
        # the device is busy: its threads would delay this thread, which prepares the next launch.
        try:
            for batch in inbox.batches(stage_finished):
                if on_gpu:  # the next batch may be sent
                    send("idle")
                reporter = partial(_frame_reporter, send, stage_finished)
                results = simulate_batch(batch, config, backend, threads, reporter)
                stage_finished()
                for future in staging:
                    future.result()
                staging.clear()
                finished += zip(batch, results, strict=True)
                del results  # staged results are freed
                if len(batch) <= _STAGING_THREADS:  # this takes little time, and a training may wait for the first ones
                    stage_finished()
                send("frame", 0, 0)
                if not on_gpu:
                    send("idle")
        finally:  # also after SIGTERM, or an error in the next batch
            stage_finished()


def _stage(send: _Sender, config: DatagenConfig, config_hash: str, inbox: _Inbox, made: MadeScene, result: Any) -> None:
    with _errors_sent(send):
        cause = failure_of(result)
        grid = inbox.grid(made) if cause is None else cause
        if isinstance(grid, str):
            send("failed", made.task.key, grid)
            return
        stage_episode(
            Path(config.dataset.folder), make_episode(replace(made, obstacle_grid=grid), result, config, config_hash)
        )
        send("staged", made.task.key)


def _frame_reporter(send: _Sender, on_frame: Callable[[int], None], scenes: int) -> Callable[[int], None]:
    last = 0.0

    def report(frame: int) -> None:
        nonlocal last
        on_frame(frame)
        if time.monotonic() - last > _FRAME_REPORT_SECONDS:
            last = time.monotonic()
            send("frame", int(frame), scenes)

    return report


def _received(connection: Connection) -> Iterator[Any]:
    while True:
        try:
            yield connection.recv()
        except ENDED:
            return
