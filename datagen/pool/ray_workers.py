"""Runs workers on a Ray cluster: `ray start --head` on one machine, `ray start --address=...` on others, `pool=ray`.

Makers and solvers are Ray actors. The pool schedules, retries and publishes as with local processes. Episodes travel
through Ray's object store, so only the pool's machine needs the data set's folder. All machines need this project in
the same version of Python. An actor waits until a machine has capacity, so machines may leave and join at any time.
"""

import contextlib
import logging
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from datagen.pool.plan import SceneTask
from datagen.pool.shard import stage_parts
from datagen.pool.worker import (
    Backend,
    MadeScene,
    Worker,
    error_message,
    failure_of,
    make_episode,
    make_scene,
    simulate_batch,
)
from datagen.pool.worker_plan import plan_cluster
from hgn.config import DatagenConfig
from hgn.data.identity import dataset_identity, identity_hash
from hgn.data.shard import episode_tar
from hgn.schema import ConfigError

_CONNECT_REMEDY = (
    "start one with `ray start --head` on one machine and `ray start --address=...` on the others, and set RAY_ADDRESS "
    "to its address, as in 10.0.0.1:6379"
)


class RayWorkerFactory:
    """Starts actors on a cluster. As a context manager it connects to the cluster."""

    def __init__(self, config: DatagenConfig, backend: Backend, early: bool = False) -> None:
        """Raises: ConfigError if Ray is not installed."""
        try:
            import ray
        except ImportError:
            raise ConfigError(
                "pool=ray needs Ray, which is not installed; pip install 'hgn[ray]' on every machine"
            ) from None
        self._ray, self._config, self._backend, self._early = ray, config, backend, early

    def __enter__(self) -> "RayWorkerFactory":
        """Raises: ConfigError if no cluster answers."""
        address = os.environ.get("RAY_ADDRESS") or "auto"
        try:
            self._ray.init(address=address, log_to_driver=False, logging_level=logging.WARNING)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise ConfigError(
                f"pool=ray needs a Ray cluster at {address}, got {type(error).__name__}; {_CONNECT_REMEDY}"
            ) from None
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        self.plan = plan_cluster(self._config, nodes, self._early)
        return self

    def __exit__(self, *error: object) -> None:
        self._ray.shutdown()

    def start_maker(self) -> Worker:
        return self._start(_Maker, self._config, self._backend, num_cpus=0, scheduling_strategy="SPREAD")

    def start_solver(self, number: int) -> Worker:
        threads = self.plan.threads
        resources = {"num_gpus": 1, "num_cpus": 0} if threads is None else {"num_cpus": threads}
        return self._start(_Solver, self._config, self._backend, threads, **resources)

    def receive(self, workers: Sequence[Worker], timeout: float) -> Iterator[tuple[Worker, tuple[Any, ...] | None]]:
        waiting = {ref: worker for worker in workers if isinstance(worker, RayWorker) for ref in worker.answers}
        if not waiting:
            time.sleep(timeout)
            return
        ready, _ = self._ray.wait(list(waiting), num_returns=1, timeout=timeout)
        for ref in ready:
            worker = waiting[ref]
            try:
                kind, *values = worker.take(ref)
            except self._ray.exceptions.RayError as error:
                worker.cause = f"{type(error).__name__} on node {worker.node or 'not yet known'}"
                # Ray reports a silent node as unavailable first, and an actor killed by its scene as dead
                worker.silent = isinstance(error, self._ray.exceptions.ActorUnavailableError)
                yield worker, None
                continue
            if kind == "ready":
                (worker.node,) = values
            else:
                yield worker, (kind, *values)
            if not worker.answers:
                yield worker, ("idle",)

    def _start(self, kind: type, *arguments: object, **options: Any) -> "RayWorker":
        # Ray neither restarts nor retries, because the pool counts a scene's deaths and replaces workers
        actor: Any = self._ray.remote(kind).options(max_restarts=0, max_task_retries=0, **options).remote(*arguments)
        return RayWorker(self._ray, actor, Path(self._config.dataset.folder))


class RayWorker(Worker):
    """Represents an actor in the pool. It is idle once the cluster has placed it on a machine."""

    def __init__(self, ray: Any, actor: Any, folder: Path) -> None:
        super().__init__()
        self._ray, self._actor, self._folder = ray, actor, folder
        self.answers = [actor.ready.remote()]
        self.node: str | None = None
        self.cause, self.silent = "", False

    def give(self, message: object) -> None:
        self.idle = False
        count = len(message) if isinstance(message, list) else 1
        answers = self._actor.work.options(num_returns=count).remote(message)
        self.answers = answers if count > 1 else [answers]

    def take(self, answer: Any) -> tuple[Any, ...]:
        """Returns the content of a finished answer. An episode is staged. Raises: RayError."""
        self.answers.remove(answer)
        kind, *values = self._ray.get(answer)
        if kind != "packed":
            return kind, *values
        key, packed = values
        stage_parts(self._folder, key, [packed])
        return "staged", key

    def dismiss(self, deadline_s: float) -> None:
        # of a launch, whose answers are finished together, the pool may have received only the first ones
        with contextlib.suppress(self._ray.exceptions.RayError):  # the actor, or its node, has died
            while self.answers and time.monotonic() < deadline_s:
                ready, _ = self._ray.wait(self.answers, timeout=0, fetch_local=False)
                if not ready:
                    return
                self.take(*ready)

    def kill(self) -> None:
        self.answers = []
        self._ray.kill(self._actor)

    def cause_of_death(self) -> str:
        return self.cause

    def task_is_suspect(self) -> bool:
        alive = {node["NodeID"] for node in self._ray.nodes() if node["Alive"]}
        return not self.silent and (self.node is None or self.node in alive)


class _Maker:
    """Builds scenes in an actor."""

    def __init__(self, config: DatagenConfig, backend: Backend) -> None:
        self._config, self._backend = config, backend

    def ready(self) -> tuple[str, str]:
        return "ready", _node()

    def work(self, task: SceneTask) -> tuple[Any, ...]:
        try:
            return make_scene(task, self._config, self._backend)
        except Exception as error:  # noqa: BLE001 - not swallowed: the pool stops with this text
            return error_message(error)


class _Solver:
    """Simulates scenes in an actor, and yields one answer for each."""

    def __init__(self, config: DatagenConfig, backend: Backend, threads: int | None) -> None:
        self._config, self._backend, self._threads = config, backend, threads

    def ready(self) -> tuple[str, str]:
        return "ready", _node()

    def work(self, batch: list[MadeScene]) -> Any:
        try:
            answers = self._simulate(batch)
        except Exception as error:  # noqa: BLE001 - not swallowed: the pool stops with this text
            answers = [error_message(error)] * len(batch)
        return answers if len(answers) > 1 else answers[0]

    def _simulate(self, batch: list[MadeScene]) -> list[tuple[Any, ...]]:
        config_hash = identity_hash(dataset_identity(self._config))
        results = simulate_batch(batch, self._config, self._backend, self._threads)
        answers: list[tuple[Any, ...]] = []
        for made, result in zip(batch, results, strict=True):
            cause = failure_of(result)
            if cause is not None:
                answers.append(("failed", made.task.key, cause))
            else:
                parts = episode_tar(make_episode(made, result, self._config, config_hash))
                answers.append(("packed", made.task.key, b"".join(parts)))
        return answers


def _node() -> str:
    import ray

    return ray.get_runtime_context().get_node_id()
