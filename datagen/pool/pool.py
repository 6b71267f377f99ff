"""Generates the missing episodes of a data set with a pool of workers: makers build scenes, solvers simulate them.

The pool distributes work, publishes shards and replaces dead workers. The scenes of a dead worker are simulated again
in halves, then quarters, down to single scenes. A single scene is quarantined after the deaths of MAXIMUM_ATTEMPTS
workers, and the next seed replaces it. Workers run on this machine (local_workers.py) or on Ray (ray_workers.py).
"""

import errno
import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from datagen.pool.plan import SceneTask
from datagen.pool.progress import Progress
from datagen.pool.worker import BuiltGrid, GridTask, MadeScene, Worker, WorkerFactory
from datagen.pool.writer import DatasetWriter
from hgn.schema import ConfigError

MAXIMUM_ATTEMPTS = 3  # deaths of workers that had only one scene, after which this scene is quarantined
_WAIT_SECONDS = 0.2  # longest time until a stop request is noticed
_PACKING_SECONDS = 0.02  # maximum delay between packing and publishing a shard
_LOOK_SECONDS = 1.0  # interval of checks for shards of other generators
_END_SECONDS = 10.0  # time in which dismissed solvers must end
_LAUNCH_GROWTH = 32  # factor by which launches grow from the first one to the full size


class Stopped(Exception):  # noqa: N818 - a request, not an error
    """Reports that a stop was requested. Staged episodes are kept."""


class Pool:
    """Claims shards, generates their missing episodes, and publishes the shards."""

    def __init__(
        self,
        writer: DatasetWriter,
        progress: Progress,
        factory: WorkerFactory,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> None:
        self._writer, self._progress, self._factory, self._should_stop = writer, progress, factory, should_stop
        self._settings, self._plan = writer.config.dataset, factory.plan
        self._launch_size = self._largest_launch = self._plan.first_launch
        self._launches = 0
        self._deaths_in_a_row = 0
        self._alone: dict[str, int] = {}  # key of a scene: deaths of workers that had only this scene
        self._group: dict[str, int] = {}  # key of a scene: number of the group in which it is tried again
        self._grid_deaths: dict[SceneTask, int] = {}  # deaths of makers that computed the obstacle grid of this scene

    def run(self) -> None:
        """Runs until all shards that the writer may make are published, by this or another generator. Ends all workers.

        Raises: Stopped; ConfigError, OSError or RuntimeError from a worker.
        """
        self._todo: list[SceneTask] = []
        self._ready: list[MadeScene] = []
        self._gridless: list[MadeScene] = []  # scenes whose obstacle grid no maker has been given yet
        self._makers: list[Worker] = []
        self._solvers: list[Worker] = []
        self._counted, self._next_look, self._said_waiting = self._writer.done, 0.0, False
        self._awake_at = time.monotonic()
        self._progress.start(self._writer.done, self._writer.total, self._settings.frames)
        try:
            while True:
                if self._should_stop():
                    raise Stopped
                self._claim()
                if self._todo and not self._solvers:
                    self._start_workers()
                self._hand_out()
                published = self._publish()
                if not published and self._writer.complete:
                    return
                self._receive(0.0 if published else _PACKING_SECONDS if self._writer.packing else _WAIT_SECONDS)
        finally:
            self._end_workers()
            self._progress.close()

    def _end_workers(self) -> None:
        """Waits a short time for solvers to stage what they have simulated. A second Ctrl-C ends the wait."""
        try:
            for deadline_s in (0.0, time.monotonic() + _END_SECONDS):  # all end at the same time
                for solver in self._solvers:
                    solver.dismiss(deadline_s)
        finally:
            for worker in (*self._makers, *self._solvers):
                worker.kill()
        for task in [_task(item) for solver in self._solvers for item in solver.tasks.values()]:
            if self._writer.is_staged(task.split, task.index):
                self._accept(task)

    def _start_workers(self) -> None:
        missing = self._writer.total - self._writer.done
        # a solver takes seconds to start, so all start before the first scene is requested
        self._solvers = [self._factory.start_solver(i) for i in range(min(self._plan.solvers, missing))]
        self._makers = [self._factory.start_maker() for _ in range(min(self._plan.makers, missing))]
        self._launch_size = min(self._largest_launch, self._even_launch(0))

    def _even_launch(self, taken: int) -> int:
        """Returns an even launch size for the scenes that no solver has, except `taken` scenes of a new launch."""
        left = self._writer.total - self._writer.done - sum(len(solver.tasks) for solver in self._solvers) - taken
        share = max(1, math.ceil(left / len(self._solvers)))
        return math.ceil(share / math.ceil(share / self._plan.scenes_per_launch))

    def _claim(self) -> None:
        """Claims as many shards as the makers need. The remaining shards are left to other generators."""
        if len(self._todo) >= self._plan.makers or time.monotonic() < self._next_look:
            return
        self._writer.refresh()
        while len(self._todo) < self._plan.makers:
            before = set(self._writer.remaining())
            shard = self._writer.claim_next()
            if shard is None:
                self._next_look = time.monotonic() + _LOOK_SECONDS
                break
            for split, index in self._writer.remaining():
                if (split, index) not in before:
                    self._put_back(self._writer.task(split, index))
        of_others, self._counted = self._writer.done - self._counted, self._writer.done
        if of_others > 0:
            self._progress.found(of_others)
        if not self._writer.has_claims and not self._writer.complete and not self._said_waiting:
            self._said_waiting = True
            self._progress.message("other generators make the remaining episodes; waiting for them")

    def _publish(self) -> bool:
        shard = self._writer.publish_next()  # other episodes are staged while the shard is packed
        if shard is not None:
            self._progress.shard(shard.name, len(shard.episodes), self._writer.manifest.revision)
        return shard is not None

    def _hand_out(self) -> None:
        # a GPU solver asks for its next scenes as soon as it has received some, so solvers without scenes come first
        for solver in sorted(self._solvers, key=lambda solver: (bool(solver.tasks), solver.given)):
            others_first = solver.tasks and any(other.idle and not other.tasks for other in self._solvers)
            if solver.idle and not others_first and (batch := self._next_batch(solver)):
                solver.tasks.update((made.task.key, made) for made in batch)
                solver.given += len(batch)
                solver.give(batch)
        for maker in self._makers:
            if maker.idle and (task := self._next_task()):
                maker.tasks[_task(task).key] = task
                maker.give(task)

    def _next_task(self) -> SceneTask | GridTask | None:
        """Returns a maker's next task, or None: a scene of the next launch, else of later launches, else a grid.

        At most two full launches per solver are made ahead. If a solver already has a scene whose obstacle grid is
        missing, this grid precedes scenes of later launches.
        """
        coming = len(self._ready) + len(self._being_made())
        short = coming < self._launch_size
        if self._todo and short:
            return self._todo.pop(0)
        ahead = coming < 2 * self._plan.scenes_per_launch * self._plan.solvers
        simulated = bool(self._gridless) and any(self._gridless[0].task.key in solver.tasks for solver in self._solvers)
        if self._todo and ahead and not simulated:
            return self._todo.pop(0)
        if self._gridless:
            made = self._gridless.pop(0)
            return GridTask(made.task, made.scene)  # a launch needs grids only at its end
        return None

    def _being_made(self) -> list[SceneTask]:
        return [task for maker in self._makers for task in maker.tasks.values() if isinstance(task, SceneTask)]

    def _next_batch(self, solver: Worker) -> list[MadeScene]:
        """Returns the next scenes to simulate, or none if it is better to wait for more."""
        self._ready.sort(key=lambda made: made.task.place)
        for made in self._ready:
            group = self._group.get(made.task.key)
            if group is not None:
                if solver.tasks:  # these are still being staged; the group runs alone to show which scenes end a worker
                    return []
                batch = [other for other in self._ready if self._group.get(other.task.key) == group]
                self._ready = [other for other in self._ready if self._group.get(other.task.key) != group]
                return batch
        size = self._launch_size
        unmade = [*self._todo, *self._being_made()]
        if not self._ready or (unmade and len(self._ready) < size):
            return []
        # training waits for the first shards in order, so a small launch must not overtake unfinished scenes
        growing = self._largest_launch < self._plan.scenes_per_launch
        if growing and any(task.place < self._ready[size - 1].task.place for task in unmade):
            return []
        batch, self._ready = self._ready[:size], self._ready[size:]
        self._launches += 1
        if self._launches % len(self._solvers) == 0:  # each solver has had a launch of this size
            self._largest_launch = min(_LAUNCH_GROWTH * self._largest_launch, self._plan.scenes_per_launch)
            self._launch_size = min(self._largest_launch, self._even_launch(len(batch)))
        return batch

    def _receive(self, timeout: float) -> None:
        for worker, message in self._factory.receive((*self._makers, *self._solvers), timeout):
            worker.last_message_s = time.monotonic()
            if message is not None:
                self._handle(worker, *message)
            elif self._should_stop():  # the signal reached the whole process group
                raise Stopped
            else:
                self._replace(worker, worker.cause_of_death())
        # a stopped process sends nothing; nor does one that waits for a device forever
        silence, now = self._settings.worker_silence_s, time.monotonic()
        slept, self._awake_at = now - self._awake_at > silence / 2, now
        for worker in (*self._makers, *self._solvers):
            if slept:  # this process was stopped too (Ctrl-Z, a frozen container)
                worker.last_message_s = now
            elif worker.reports_often and worker.tasks and now - worker.last_message_s > silence:
                self._replace(worker, f"it sent nothing for {silence:.0f} s")

    def _handle(self, worker: Worker, kind: str, *values: Any) -> None:
        if kind == "idle":
            worker.idle = True
            if worker in self._solvers:
                self._progress.frame(self._solvers.index(worker), 0, 0)
        elif kind == "frame":
            self._progress.frame(self._solvers.index(worker), *values)
        elif kind == "made":
            (made,) = values
            del worker.tasks[made.task.key]
            self._ready.append(made)
            if made.obstacle_grid is None:
                self._gridless.append(made)
        elif kind == "grid":
            (built,) = values
            del worker.tasks[built.task.key]
            self._grid_built(built)
        elif kind == "staged":
            self._accept(_task(worker.tasks.pop(values[0])))
        elif kind == "failed":
            key, cause = values
            self._quarantine(_task(worker.tasks.pop(key)), cause)
        elif kind == "config_error":
            raise ConfigError(values[0])
        elif kind == "os_error":
            raise OSError(*values)
        else:
            raise RuntimeError(f"a worker failed:\n{values[0]}")

    def _grid_built(self, built: BuiltGrid) -> None:
        """Adds a grid to its scene, which waits for a launch or is already with a solver."""
        key, grid = built.task.key, built.grid
        for place, made in enumerate(self._ready):
            if made.task == built.task:
                if isinstance(grid, str):
                    self._quarantine(self._ready.pop(place).task, grid)
                else:
                    self._ready[place] = replace(made, obstacle_grid=grid)
                return
        for solver in self._solvers:
            sent = solver.tasks.get(key)
            if isinstance(sent, MadeScene) and sent.task == built.task:
                if not isinstance(grid, str):
                    solver.tasks[key] = replace(sent, obstacle_grid=grid)
                solver.send(built)
                return

    def _accept(self, task: SceneTask) -> None:
        self._deaths_in_a_row = 0
        self._writer.add_staged(task.split, task.index)
        self._counted += 1
        self._progress.episode(task.key)

    def _quarantine(self, task: SceneTask, cause: str) -> None:
        self._progress.message(f"{task.key} (seed {task.seed}) could not be simulated: {cause}; trying another seed")
        self._alone.pop(task.key, None)
        self._group.pop(task.key, None)
        self._put_back(self._writer.quarantine(task, cause))

    def _put_back(self, task: SceneTask) -> None:
        self._todo.append(task)
        self._todo.sort(key=lambda task: task.place)

    def _replace(self, worker: Worker, cause: str) -> None:
        suspect = worker.task_is_suspect()
        self._deaths_in_a_row += suspect
        halvings = self._plan.scenes_per_launch.bit_length()
        if self._deaths_in_a_row > 3 * MAXIMUM_ATTEMPTS + self._plan.solvers + halvings:
            text = f"workers keep dying before they finish any scene, the last because {cause}"
            raise ChildProcessError(errno.ECHILD, text)
        self._progress.message(f"a worker died ({cause}); it is replaced and its scenes are tried again")
        lost = list(worker.tasks.values())
        worker.kill()
        if worker in self._solvers:
            number = self._solvers.index(worker)
            self._progress.frame(number, 0, 0)
            self._solvers[number] = self._factory.start_solver(number)
        else:
            self._makers[self._makers.index(worker)] = self._factory.start_maker()
        groups = max(self._group.values(), default=0) + 1
        for place, item in enumerate(lost):
            task = _task(item)
            if isinstance(item, GridTask):
                self._grid_lost(item, cause, suspect)
                continue
            if isinstance(item, MadeScene) and self._writer.is_staged(task.split, task.index):
                self._accept(task)
                continue
            # any scene of a launch may be the cause, so halves are tried; deaths count only for a scene that ran alone
            if suspect:
                self._alone[task.key] = self._alone.get(task.key, 0) + (len(lost) == 1)
                self._group[task.key] = groups + (2 * place >= len(lost))
            if self._alone.get(task.key, 0) >= MAXIMUM_ATTEMPTS:
                self._quarantine(task, cause)
            elif isinstance(item, MadeScene):
                self._ready.append(item)
            else:
                self._put_back(task)

    def _grid_lost(self, item: GridTask, cause: str, suspect: bool) -> None:
        deaths = self._grid_deaths[item.task] = self._grid_deaths.get(item.task, 0) + suspect
        if deaths >= MAXIMUM_ATTEMPTS:
            self._grid_built(BuiltGrid(item.task, cause))
        else:
            self._gridless.insert(0, MadeScene(item.task, item.scene, None))


def _task(item: SceneTask | MadeScene | GridTask) -> SceneTask:
    return item if isinstance(item, SceneTask) else item.task
