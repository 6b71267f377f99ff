"""Does the work of makers (draw scenes, build obstacles) and solvers (simulate); defines the interface of a worker."""

import errno
import pickle
import pkgutil
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from datagen.fine import scene_to_simulate, solver_on_grid
from datagen.pool.plan import SceneTask
from datagen.pool.worker_plan import WorkerPlan
from hgn.config import DatagenConfig
from hgn.data.identity import physics_settings
from hgn.scene.episode import Episode
from hgn.scene.moving import at_rest
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.scene.scene import Scene
from hgn.schema import ConfigError
from hgn.system.extras import missing_extra
from hgn.system.machine import memory_is_full


@dataclass(frozen=True)
class Backend:
    """Names the functions that do the work, as `module:function`. Only workers import them, the pool does not."""

    generate_scene: str = "hgn.scene.random_scene:generate_scene"
    build_obstacle_grid: str = "hgn.scene.obstacle_grid:build_obstacle_grid"
    build_collider: str = "datagen.mpm.collider:build_collider"
    simulate: str = "datagen.mpm.solver:simulate"
    warm_up: str = "datagen.mpm.solver:warm_up"


_Value = TypeVar("_Value")


class Parcel(Generic[_Value]):
    """Carries a value between processes as pickled bytes, which are unpickled only by `open`."""

    def __init__(self, value: _Value) -> None:
        self._value: _Value | None = value
        self._bytes: bytes | None = None

    def open(self) -> _Value:
        data = self._bytes
        if data is not None:
            self._value = pickle.loads(data)
            self._bytes = None
        return self._value  # type: ignore[return-value]

    def __getstate__(self) -> bytes:
        data = self._bytes
        return pickle.dumps(self._value, pickle.HIGHEST_PROTOCOL) if data is None else data

    def __setstate__(self, state: bytes) -> None:
        self._value, self._bytes = None, state


@dataclass(frozen=True)
class MadeScene:
    """Holds a scene that is ready for the solver."""

    task: SceneTask
    scene: Parcel[Scene]
    obstacle_grid: ObstacleGrid | None  # None: sent later, because the solver does not need it
    collider: Parcel[Any] = field(default_factory=lambda: Parcel(None))  # the solver's form of the obstacles
    simulated: Parcel[Any] = field(default_factory=lambda: Parcel(None))  # the scene on the solver's grid


@dataclass(frozen=True)
class GridTask:
    """Asks a maker for the obstacle grid of a scene. `build_grid` answers it."""

    task: SceneTask
    scene: Parcel[Scene]


@dataclass(frozen=True)
class BuiltGrid:
    """Holds the result of a GridTask: the grid, or why it could not be built."""

    task: SceneTask
    grid: ObstacleGrid | str


class Worker(ABC):
    """Defines the interface by which the pool uses a worker."""

    reports_often = False  # whether a busy worker sends messages at shorter intervals than dataset.worker_silence_s

    def __init__(self) -> None:
        self.idle = False
        self.tasks: dict[str, SceneTask | MadeScene | GridTask] = {}  # unanswered tasks by key
        self.given = 0  # total number of scenes given to simulate
        self.last_message_s = time.monotonic()  # time of the last message in either direction

    @abstractmethod
    def give(self, message: object) -> None:
        """Sends work. The next `receive` notices a dead worker."""

    def send(self, message: object) -> None:
        """Sends a worker one part of its task, for example the obstacle grid of a scene that it simulates."""
        raise NotImplementedError

    @abstractmethod
    def dismiss(self, deadline_s: float) -> None:
        """Asks the worker to keep what it has simulated, and to end. Waits until then, or time.monotonic()."""

    @abstractmethod
    def kill(self) -> None:
        """Ends the worker."""

    @abstractmethod
    def cause_of_death(self) -> str:
        """Returns why a worker that does not answer has ended."""

    def task_is_suspect(self) -> bool:
        """Returns whether the worker's task may have ended it; False if its machine has left the cluster."""
        return True


class WorkerFactory(Protocol):
    """Starts workers."""

    plan: WorkerPlan

    def start_maker(self) -> Worker: ...

    def start_solver(self, number: int) -> Worker: ...

    def receive(self, workers: Sequence[Worker], timeout: float) -> Iterator[tuple[Worker, tuple[Any, ...] | None]]:
        """Yields messages of workers, and None for a dead one. Waits at most `timeout` seconds for the first."""


def make_scene(task: SceneTask, config: DatagenConfig, backend: Backend, with_grid: bool = True) -> tuple[Any, ...]:
    """Returns a maker's answer: ("made", MadeScene) or ("failed", key, cause)."""
    generate_scene = pkgutil.resolve_name(backend.generate_scene)
    build_collider = pkgutil.resolve_name(backend.build_collider)
    try:
        scene = generate_scene(config.scene, task.seed)
        # Makers build the collider and draw fine particles. In a solver the GPU would idle meanwhile.
        finer = replace(scene, cell_size=config.reference_cell_size)
        collider = build_collider(finer, config.mpm.choices.collider_band_cells)
    except ConfigError as error:  # e.g. an obstacle does not fit; another seed may work
        return "failed", task.key, str(error)
    fine, parcel = scene_to_simulate(scene, config), Parcel(scene)
    made = MadeScene(task, parcel, None, Parcel(collider), parcel if fine is scene else Parcel(fine))
    if with_grid:
        grid = build_grid(GridTask(task, made.scene), backend).grid
        if isinstance(grid, str):
            return "failed", task.key, grid
        made = replace(made, obstacle_grid=grid)
    return "made", made


def build_grid(task: GridTask, backend: Backend) -> BuiltGrid:
    build_obstacle_grid = pkgutil.resolve_name(backend.build_obstacle_grid)
    scene = task.scene.open()
    try:
        grid = build_obstacle_grid(at_rest(scene.obstacles), scene.cell_size, scene.seed, scene.domain_size)
    except ConfigError as error:
        return BuiltGrid(task.task, str(error))
    return BuiltGrid(task.task, grid)


def simulate_batch(
    batch: list[MadeScene],
    config: DatagenConfig,
    backend: Backend,
    threads: int | None,
    reporter: Callable[[int], Callable[[int], None]] | None = None,
) -> list[Any]:
    """Simulates a batch in one launch per episode length. Returns the solver's results for visible particles.

    `reporter` maps the number of scenes in a launch to a function that is called with each frame.
    """
    simulate = pkgutil.resolve_name(backend.simulate)
    launches: dict[int, list[MadeScene]] = {}
    for made in batch:
        launches.setdefault(config.dataset.frames_of(made.task.index), []).append(made)
    children = 1 if config.reference is None else config.reference["particles_per_visible"]
    results: dict[SceneTask, Any] = {}
    for frames, launch in sorted(launches.items()):
        of_launch = simulate(
            [made.simulated.open() for made in launch],
            solver_on_grid(config.mpm, config.reference_cell_size, config.scene.cell_size),
            frames,
            config.dataset.frame_rate_hz,
            on_frame=reporter and reporter(len(launch)),
            cpu_threads=threads,
            colliders=[made.collider.open() for made in launch],
            children=children,
        )
        results |= {made.task: result for made, result in zip(launch, of_launch, strict=True)}
    return [results[made.task] for made in batch]


def failure_of(result: Any) -> str | None:
    """Returns why a result of the solver is not an episode, or None."""
    cause = getattr(result, "cause", None)
    if cause is not None:
        return str(cause)
    return None if np.isfinite(result.position_TN3).all() else "positions are not finite"


def make_episode(made: MadeScene, result: Any, config: DatagenConfig, config_hash: str) -> Episode:
    """Returns the episode of a scene with its grid and the solver's result (`position_TN3`, `counters`)."""
    assert made.obstacle_grid is not None
    scene, reference = made.scene.open(), config.reference
    return Episode(
        key=made.task.key,
        position_TN3=np.ascontiguousarray(result.position_TN3, np.float32),
        initial_velocity_N3=scene.velocity_N3,
        material_N=scene.material_N,
        obstacle_grid=made.obstacle_grid,
        domain_size=scene.domain_size,
        gravity=scene.gravity,
        frame_rate_hz=config.dataset.frame_rate_hz,
        seed=made.task.seed,
        material_parameters={
            name: np.where(np.isnan(value), getattr(config.mpm, name), value).astype(np.float32)
            for name, value in scene.material_parameters.items()
        },
        specification=scene.specification,
        wall_friction=scene.wall_friction,
        solver={
            "settings": physics_settings(config),
            "particles_per_cell": scene.particles_per_cell,
            "counters": dict(result.counters),
            "dataset": {"config_hash": config_hash, "attempt": made.task.attempt},
        }
        | ({} if reference is None else {"reference": reference}),
    )


def error_message(error: Exception) -> tuple[Any, ...]:
    """Returns a worker's message about an error that no scene has caused."""
    if isinstance(error, ConfigError):
        return "config_error", str(error)
    if isinstance(error, ModuleNotFoundError) and (missing := missing_extra(error)):
        return "config_error", missing
    if isinstance(error, OSError):
        return "os_error", error.errno, error.strerror, None if error.filename is None else str(error.filename)
    if memory_is_full(error):
        return "os_error", errno.ENOMEM, f"memory is full ({error})", None
    return "error", "".join(traceback.format_exception(error))
