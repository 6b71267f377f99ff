"""A deterministic stand-in for scenes and solver, quick enough to make whole data sets in tests.

Loaded by name inside spawned workers. A file `simulated.log` in the working folder of a test records each key that
was simulated; files named `kill-<seed>`, `fail-<seed>` and `late-<seed>` there make the solver die or fail at that
seed, or its scene come late; in a folder `ending` each process that ends in order leaves a file.
"""

import atexit
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from datagen.pool.worker import Backend
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.scene.scene import Scene
from hgn.schema import ConfigError

FOLDER_VARIABLE = "BALLISTIC_FOLDER"
BALLISTIC = Backend(
    generate_scene="ballistic_solver:generate_scene",
    build_obstacle_grid="ballistic_solver:build_obstacle_grid",
    simulate="ballistic_solver:simulate",
    warm_up="ballistic_solver:warm_up",
)


@dataclass(frozen=True, eq=False)
class Simulated:
    position_TN3: np.ndarray
    counters: dict[str, Any]


@dataclass(frozen=True)
class SceneFailure:
    cause: str


def be_killed():
    os.kill(os.getpid(), signal.SIGKILL)


def control(name):
    return Path(os.environ[FOLDER_VARIABLE]) / name


def generate_scene(config, seed):
    if control(f"refuse-{seed}").exists():
        raise ConfigError("no room for the obstacles")
    if control(f"late-{seed}").exists():
        time.sleep(0.5)
    generator = np.random.default_rng(seed)
    count = 3 + seed % 4
    return Scene(
        position_N3=(0.4 + 0.2 * generator.random((count, 3))).astype(np.float32),
        velocity_N3=generator.normal(size=(count, 3)).astype(np.float32),
        material_N=generator.integers(0, 3, count).astype(np.uint8),
        cell_size=config.cell_size,
        seed=seed,
        specification={"seed": seed},
    )


def build_obstacle_grid(obstacles, cell_size, seed, domain_size):
    if control(f"gridless-{seed}").exists():
        raise ConfigError("a surface too large")
    kill = control(f"kill-grid-{seed}")
    if kill.exists():
        kill.unlink()
        be_killed()
    return ObstacleGrid(cell_size, np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))


class Unreadable:
    """An object larger than a pipe's buffer that cannot be unpickled."""

    def __init__(self):
        self.content = bytes(1_000_000)

    def __setstate__(self, state):
        raise ValueError("a collider of another time")


def unreadable_collider(scene, band_cells):
    return Unreadable()


def warm_up(scene, config, scenes):
    pass


def simulate(scenes, config, frames, frame_rate_hz, on_frame=None, children=1, trajectories=(), **_):
    results: list[Simulated | SceneFailure] = []
    for scene in scenes:
        with control("simulated.log").open("a") as log:
            log.write(f"{scene.seed}\n")
        if control("slow").exists():
            time.sleep(0.5)
        while control(f"hold-{scene.seed}").exists():
            time.sleep(0.02)
        if control("ending").exists():
            atexit.register((control("ending") / str(os.getpid())).touch)
        if control("raise").exists():
            raise RuntimeError(control("raise").read_text())
        kill = control(f"kill-{scene.seed}")
        if kill.exists():
            lives = int(kill.read_text())
            if lives == 1:
                kill.unlink()
            else:
                kill.write_text(str(lives - 1))
            be_killed()
        if control(f"fail-{scene.seed}").exists():
            results.append(SceneFailure("diverged in frame 3"))
            continue
        time_T11 = (np.arange(frames) / frame_rate_hz)[:, None, None]
        position = scene.position_N3 + time_T11 * scene.velocity_N3 + 0.5 * time_T11**2 * np.array(scene.gravity)
        position = position[:, ::children]
        results.append(Simulated(position.astype(np.float32), {"substeps": frames}))
    for path_TN3, result in zip(trajectories, results, strict=False):
        path_TN3[:] = result.position_TN3
    if on_frame is not None:
        for frame in range(frames):
            on_frame(frame)
    return results
