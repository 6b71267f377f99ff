"""Simulates test scenes with the solver, to the end or to its failure."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from datagen.fine import fine_scene, visible_positions, wall_thickness
from hgn.config import MpmConfig
from hgn.runtime.rollouts import RolloutResult
from hgn.scene.episode import Episode
from hgn.scene.episode_obstacles import obstacles_of_episode
from hgn.scene.scene import Scene
from hgn.system.machine import available_cpus
from hgn.system.progress import bar

OnFrame = Callable[[int], None] | None


def solver_scene(episode: Episode, cell_size: float | None = None, wall: float = 0.0) -> Scene:
    """Returns an episode's initial state for the solver, on its own grid or another.

    A finer grid has more particles. They start at least `wall` from the domain's planes.
    """
    own = episode.obstacle_grid.cell_size
    density = episode.solver.get("particles_per_cell")  # not stored in older data
    scene = Scene(
        position_N3=np.array(episode.position_TN3[0]),
        velocity_N3=episode.initial_velocity_N3,
        material_N=episode.material_N,
        obstacles=obstacles_of_episode(episode),
        domain_size=episode.domain_size,
        cell_size=own,
        particles_per_cell=density,
        gravity=episode.gravity,
        seed=episode.seed,
    )
    if cell_size is None or cell_size == own:
        return scene
    if cell_size < own:
        return fine_scene(scene, cell_size, wall)
    return replace(
        scene, cell_size=cell_size, particles_per_cell=None if density is None else density * (cell_size / own) ** 3
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
    """Returns trajectories, for failed scenes only the initial state. Shows a progress bar if `on_frame` is None."""
    if on_frame is None:
        with bar("solver", total=frames, unit="frame") as progress:
            shown = lambda _: progress.update()  # noqa: E731
            return solver_trials(scenes, config, frames, frame_rate_hz, shown, colliders, stability_fractions)
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


@dataclass(frozen=True)
class Setting:
    """A setting of the solver on a grid."""

    step: float  # fraction of the limit of stability
    # Largest initial displacement of a particle along each axis, domain units. If the grid is finer than the episode's,
    # visible particles keep their places, and a value above 0 places their other children at new random places.
    perturbation: float = 0.0


class SolverLaunches:
    """Simulates scenes on one grid with all settings in one launch, which takes as long as its longest scene.

    Each scene is simulated once with each setting, and its colliders are built once.
    """

    def __init__(self, config: MpmConfig, cell_size: float, frame_rate_hz: float, frames: int) -> None:
        self.config, self.cell_size, self.frame_rate_hz, self.frames = config, cell_size, frame_rate_hz, frames
        self._settings: list[Setting] = []
        self._known: dict[tuple[Setting, str], RolloutResult] = {}
        self._colliders: dict[str, Any] = {}  # by the episode's key

    def add(self, setting: Setting) -> None:
        if setting not in self._settings:
            self._settings.append(setting)

    def trials(self, setting: Setting, episodes: Sequence[Episode]) -> list[RolloutResult]:
        """Returns trajectories from the episodes' first frames."""
        self.add(setting)
        missing = [episode for episode in episodes if (setting, episode.key) not in self._known]
        if missing:
            pairs = [(other, episode) for other in self._settings for episode in missing]
            simulated = self.simulate(pairs, self.frames, None)
            self._known |= {(s, e.key): trial for (s, e), trial in zip(pairs, simulated, strict=True)}
        return [self._known[setting, episode.key] for episode in episodes]

    def simulate(self, pairs: Sequence[tuple[Setting, Episode]], frames: int, on_frame: OnFrame) -> list[RolloutResult]:
        """Simulates these settings and episodes, even if they were simulated before."""
        from datagen.mpm.collider import build_collider

        new = {episode.key: self._scene(episode) for _, episode in pairs if episode.key not in self._colliders}
        band = self.config.choices.collider_band_cells
        with ThreadPoolExecutor(available_cpus()) as threads:
            built = threads.map(lambda scene: build_collider(scene, band), new.values())
            self._colliders |= dict(zip(new, built, strict=True))
        scenes = [self._scene(episode, setting.perturbation) for setting, episode in pairs]
        colliders = [self._colliders[episode.key] for _, episode in pairs]
        steps = [setting.step for setting, _ in pairs]
        trials = solver_trials(scenes, self.config, frames, self.frame_rate_hz, on_frame, colliders, steps)
        return [
            replace(trial, position_TN3=visible_positions(trial.position_TN3, len(episode.material_N)))
            for trial, (_, episode) in zip(trials, pairs, strict=True)
        ]

    def _scene(self, episode: Episode, perturbation: float = 0.0) -> Scene:
        finer = self.cell_size < episode.obstacle_grid.cell_size
        if perturbation and finer:  # other children of the same particles
            episode = replace(episode, seed=episode.seed + 1)
        scene = solver_scene(episode, self.cell_size, wall_thickness(self.config, self.cell_size))
        if perturbation and not finer:
            draw = np.random.default_rng(scene.seed).uniform
            scene.position_N3[:] += draw(-perturbation, perturbation, scene.position_N3.shape)
        return scene
