"""Simulating test scenes with the solver, to the end or to its failure."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hgn.config import MpmConfig
from hgn.runtime.rollouts import RolloutResult
from hgn.scene.episode import Episode
from hgn.scene.rollout_file import obstacles_of_episode
from hgn.scene.scene import Scene
from hgn.system.files import make_folder, temporary_file
from hgn.system.machine import available_cpus

OnFrame = Callable[[int], None] | None


def solver_scene(episode: Episode, cell_size: float | None = None) -> Scene:
    """An episode's initial state for the solver, on its own grid or another."""
    own = episode.obstacle_grid.cell_size
    density = episode.solver.get("particles_per_cell")  # none in data made before it was kept
    return Scene(
        position_N3=np.array(episode.position_TN3[0]),
        velocity_N3=episode.initial_velocity_N3,
        material_N=episode.material_N,
        obstacles=obstacles_of_episode(episode),
        domain_size=episode.domain_size,
        cell_size=own if cell_size is None else cell_size,
        particles_per_cell=density if density is None or cell_size is None else density * (cell_size / own) ** 3,
        gravity=episode.gravity,
        seed=episode.seed,
    )


def solver_trials(
    scenes: Sequence[Scene],
    config: MpmConfig,
    frames: int,
    frame_rate_hz: float,
    on_frame: OnFrame = None,
    colliders: Sequence[Any] | None = None,
    stability_fractions: Sequence[float] | None = None,
) -> list[RolloutResult]:
    """The solver's trajectories; of a scene that it stops only the initial state is left."""
    from datagen.mpm.solver import SceneFailure, simulate

    results = simulate(
        scenes, config, frames, frame_rate_hz, on_frame, colliders=colliders, stability_fractions=stability_fractions
    )
    return [
        RolloutResult(scene.position_N3[None], result.cause)
        if isinstance(result, SceneFailure)
        else RolloutResult(result.position_TN3)
        for scene, result in zip(scenes, results, strict=True)
    ]


def kept_trials(
    folder: Path, scenes: Sequence[Scene], config: MpmConfig, frames: int, frame_rate_hz: float
) -> list[RolloutResult]:
    """The same; what lies in `folder` is not simulated again, and what was simulated is kept there. A folder is for one
    version of the solver.
    """
    make_folder(folder)
    physics = replace(config, device="auto", scenes_per_launch=None)
    keys = [hashlib.sha256(pickle.dumps((scene, physics, frames, frame_rate_hz))).hexdigest() for scene in scenes]
    files = [folder / f"{key}.npz" for key in keys]
    missing = [i for i, file in enumerate(files) if not file.exists()]
    if missing:
        simulated = solver_trials([scenes[i] for i in missing], config, frames, frame_rate_hz)
        for i, trial in zip(missing, simulated, strict=True):
            with temporary_file(files[i]) as temporary:
                with temporary.open("wb") as file:
                    np.savez(file, position_TN3=trial.position_TN3, cause=np.array(trial.cause or ""))
                temporary.replace(files[i])
    trials = []
    for path in files:
        with np.load(path) as stored:
            trials.append(RolloutResult(stored["position_TN3"], str(stored["cause"]) or None))
    return trials


def other_grid(config: MpmConfig, cell_size: float, own_cell_size: float) -> MpmConfig:
    """The solver's settings for cells of another size: walls as thick as they were, to the nearest node."""
    return replace(config, wall_cells=max(2, round(config.wall_cells * own_cell_size / cell_size)))


@dataclass(frozen=True)
class Setting:
    """What is varied on a grid: the share of the limit of stability, and how far particles start off at most."""

    step: float
    perturbation: float = 0.0  # domain units


class SolverLaunches:
    """Simulates scenes on one grid with every setting that was added, all side by side, as a launch lasts as long as
    its longest scene, whatever runs beside it; each is simulated once, and scenes get their colliders once.
    """

    def __init__(self, config: MpmConfig, cell_size: float, frame_rate_hz: float, frames: int) -> None:
        self.config, self.cell_size, self.frame_rate_hz, self.frames = config, cell_size, frame_rate_hz, frames
        self._settings: list[Setting] = []
        self._known: dict[tuple[Setting, str], RolloutResult] = {}
        self._colliders: dict[str, Future[Any]] = {}

    def add(self, setting: Setting) -> None:
        if setting not in self._settings:
            self._settings.append(setting)

    def knows(self, setting: Setting) -> bool:
        """Whether scenes were simulated with it."""
        return any(known == setting for known, _ in self._known)

    def collide(self, episodes: Sequence[Episode], threads: Executor) -> None:
        """Builds the colliders of the scenes on those threads."""
        from datagen.mpm.collider import build_collider

        for episode in episodes:
            if episode.key not in self._colliders:
                scene = solver_scene(episode, self.cell_size)
                self._colliders[episode.key] = threads.submit(build_collider, scene, self.config.collider_band_cells)

    def trials(self, setting: Setting, episodes: Sequence[Episode], on_frame: OnFrame = None) -> list[RolloutResult]:
        """Trajectories of `frames` frames from the episodes' first ones."""
        self.add(setting)
        missing = [episode for episode in episodes if (setting, episode.key) not in self._known]
        if missing:
            pairs = [(other, episode) for other in self._settings for episode in missing]
            simulated = self.simulate(pairs, self.frames, on_frame)
            self._known |= {(s, e.key): trial for (s, e), trial in zip(pairs, simulated, strict=True)}
        return [self._known[setting, episode.key] for episode in episodes]

    def simulate(self, pairs: Sequence[tuple[Setting, Episode]], frames: int, on_frame: OnFrame) -> list[RolloutResult]:
        """So many frames of these settings and episodes, whatever is known."""
        with ThreadPoolExecutor(available_cpus()) as threads:
            self.collide([episode for _, episode in pairs], threads)
        scenes = [self._scene(setting, episode) for setting, episode in pairs]
        colliders = [self._colliders[episode.key].result() for _, episode in pairs]
        steps = [setting.step for setting, _ in pairs]
        # a scene's steps are its own; where all are alike the config says so
        alike = replace(self.config, stability_fraction=steps[0])
        return solver_trials(scenes, alike, frames, self.frame_rate_hz, on_frame, colliders, steps)

    def _scene(self, setting: Setting, episode: Episode) -> Scene:
        scene = solver_scene(episode, self.cell_size)
        if setting.perturbation:
            draw = np.random.default_rng(scene.seed).uniform
            scene.position_N3[:] += draw(-setting.perturbation, setting.perturbation, scene.position_N3.shape)
        return scene
