"""The solver's simulations for reports: all settings of one grid side by side, as a launch lasts as long as its
longest scene, whatever runs beside it; each is simulated once, and scenes get their colliders once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hgn.config import MpmConfig
from hgn.runtime.rollouts import RolloutResult
from hgn.scene.episode import Episode
from hgn.scene.scene import Scene
from hgn.system.machine import available_cpus
from tools.solver_rollouts import solver_scene, solver_trials

OnFrame = Callable[[int], None] | None


@dataclass(frozen=True)
class Setting:
    """What is varied on a grid: the share of the limit of stability, and how far particles start off at most."""

    step: float
    perturbation: float = 0.0  # domain units


class SolverLaunches:
    """Simulates scenes on one grid with every setting that was added."""

    def __init__(self, config: MpmConfig, cell_size: float, frame_rate_hz: float, frames: int) -> None:
        self.config, self.cell_size, self.frame_rate_hz, self.frames = config, cell_size, frame_rate_hz, frames
        self._settings: list[Setting] = []
        self._known: dict[tuple[Setting, str], RolloutResult] = {}
        self._colliders: dict[str, Future[Any]] = {}

    def add(self, setting: Setting) -> Setting:
        if setting not in self._settings:
            self._settings.append(setting)
        return setting

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
