"""Simulating test scenes with the solver, to the end or to its failure."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hgn.config import MpmConfig
from hgn.runtime.rollouts import RolloutResult
from hgn.scene.episode import Episode
from hgn.scene.rollout_file import obstacles_of_episode
from hgn.scene.scene import Scene
from hgn.system.files import make_folder, temporary_file


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
    on_frame: Callable[[int], None] | None = None,
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
