"""Measures of trajectories by name, for the limits of cases (case.py).

A measure returns a figure, a record of figures, or a list of records; None if a trajectory ended too early for it.
Shape legend: T frames, N particles.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from hgn.network.relative import CONTACT_REACH_CELLS
from hgn.runtime.rollouts import RolloutResult
from hgn.runtime.simulator import InitialState
from hgn.scene.distance import outside_domain
from hgn.training.errors import position_mse
from tools.measures import energies, energy_scale, neighbours
from tools.stability.case import Outcome

EARTH = 9.8  # domain units per second squared
STIR_FRAMES = 60  # number of last frames over which the squared speed at rest is averaged
TURNS = {"-x": (1, 0, 2), "-z": (0, 2, 1)}  # exchanges of axes that turn upright gravity in this direction


def energy_growth(outcome: Outcome) -> float:
    """Returns the largest increase of kinetic and potential energy since the start, in falls through the domain."""
    growths = [0.0]
    for trial, scene in zip(outcome.trials, outcome.scenes, strict=True):
        if trial.frame_count > 1:
            gravity_3 = np.asarray(scene.gravity, np.float64) / outcome.frame_rate_hz**2
            speed_N3 = scene.velocity_N3 / outcome.frame_rate_hz
            start_N = 0.5 * (speed_N3**2).sum(-1) - trial.position_TN3[0].astype(np.float64) @ gravity_3
            growth = float(energies(trial.position_TN3, gravity_3).max()) - float(start_N.mean())
            growths.append(growth / energy_scale(gravity_3, scene.domain_size))
    return max(growths)


def energy_rise(outcome: Outcome) -> float:
    """Returns the largest increase of the energy of `energy_growth` since any earlier frame.

    Elastic energy is not included, so even a correct bounce has a rise. Limits therefore add the solver's rise.
    """
    rises = [0.0]
    for trial, scene in zip(outcome.trials, outcome.scenes, strict=True):
        gravity_3 = np.asarray(scene.gravity, np.float64) / outcome.frame_rate_hz**2
        energy_T = energies(trial.position_TN3, gravity_3)
        if len(energy_T):
            rise = float((energy_T - np.minimum.accumulate(energy_T)).max())
            rises.append(rise / energy_scale(gravity_3, scene.domain_size))
    return max(rises)


def outside(outcome: Outcome) -> float:
    """Returns the largest fraction of a scene's particles that end outside of the domain."""
    pairs = zip(outcome.trials, outcome.scenes, strict=True)
    return max(outside_domain(trial.position_TN3[-1], scene.domain_size) for trial, scene in pairs)


def share_of_way(outcome: Outcome) -> float:
    """Returns the smallest mean displacement along the known acceleration, as a fraction of the closed form."""
    shares = []
    for trial, scene in zip(outcome.trials, outcome.scenes, strict=True):
        last = min(outcome.case.known_frames, trial.frame_count - 1)
        known_3, seconds = np.asarray(outcome.case.known_3, np.float64), last / outcome.frame_rate_hz
        if not last or not known_3.any():
            shares.append(1.0)
            continue
        moved_N3 = trial.position_TN3[last].astype(np.float64) - trial.position_TN3[0] - seconds * scene.velocity_N3
        shares.append(float((moved_N3 @ known_3).mean() / (0.5 * seconds**2 * (known_3 @ known_3))))
    return min(shares)


def flight(trial: RolloutResult, scene: InitialState, frame_rate_hz: float) -> dict[str, Any]:
    """Compares the mean motion of a body with free flight. Returns these figures:

    - `kept`: smallest fraction of the velocity across gravity that remains (None for a drop); `kept_frame`: its frame
    - `error`: largest error of the acceleration along gravity, as a fraction of gravity; `error_frame`: its frame. In a
      scene without gravity it is the error in all directions, as a fraction of the earth's gravity.
    - `across`: mean acceleration across gravity that slows the body down, as a fraction of the earth's gravity
    - `frames`: number of simulated frames
    """
    gravity_3, frames = np.array(scene.gravity) / frame_rate_hz**2, trial.frame_count - 1
    thrown_3 = scene.velocity_N3[0].astype(np.float64) / frame_rate_hz
    size, speed = float(np.linalg.norm(gravity_3)), float(np.linalg.norm(thrown_3))
    centre_T3 = trial.position_TN3.mean(axis=1, dtype=np.float64)
    velocity_T3 = np.concatenate([[thrown_3 - 0.5 * gravity_3], np.diff(centre_T3, axis=0)])
    error_T3 = np.diff(velocity_T3, axis=0) - gravity_3
    lost_T3 = velocity_T3[1:] - thrown_3
    if size:
        error_T = np.abs(error_T3 @ gravity_3) / size**2
        lost_T3 = lost_T3 - np.outer(lost_T3 @ gravity_3, gravity_3) / size**2
    else:
        error_T = np.linalg.norm(error_T3, axis=1) * frame_rate_hz**2 / EARTH
    lost_T = np.linalg.norm(lost_T3, axis=1)
    return {
        "kept": 1 - float(lost_T.max()) / speed if speed else None,
        "kept_frame": int(lost_T.argmax()),
        "error": float(error_T.max()),
        "error_frame": int(error_T.argmax()),
        "across": float(lost_T[-1]) / frames * frame_rate_hz**2 / EARTH,
        "frames": frames,
    }


def throws(outcome: Outcome) -> dict[str, dict[str, Any]]:
    """Returns the flight of each labelled scene."""
    flights = [flight(*pair, outcome.frame_rate_hz) for pair in zip(outcome.trials, outcome.scenes, strict=True)]
    return dict(zip(outcome.case.labels, flights, strict=True))


def gravity_error(outcome: Outcome) -> float:
    """Returns the largest error of an acceleration along gravity."""
    return float(np.max([one["error"] for one in throws(outcome).values()]))


def kept(outcome: Outcome) -> float:
    """Returns the smallest fraction of a velocity that remains, among bodies that were thrown."""
    return float(np.min([one["kept"] for one in throws(outcome).values() if one["kept"] is not None]))


def conserved(outcome: Outcome) -> tuple[float, float, float]:
    """Compares two equal bodies that meet with the conservation laws, until a particle comes close to a wall.

    Returns the largest errors of momentum and of angular momentum about the centre, as fractions of their initial
    values, and the fraction of the relative velocity that one body passed on to the other.
    """
    (trial,), (scene,), reach = outcome.trials, outcome.scenes, wall_distance(outcome.simulator.network.config)
    path_TN3, high_3 = trial.position_TN3.astype(np.float64), np.array(scene.domain_size) - reach
    free_T = ((path_TN3 > reach) & (path_TN3 < high_3)).all(axis=(1, 2))
    path_TN3 = path_TN3[: int(free_T.argmin()) if not free_T.all() else None]
    velocity_N3 = scene.velocity_N3.astype(np.float64) / outcome.frame_rate_hz

    def angular(place_N3: np.ndarray, moving_N3: np.ndarray) -> np.ndarray:
        return np.cross(place_N3 - place_N3.mean(axis=0), moving_N3 - moving_N3.mean(axis=0)).sum(axis=0)

    moved_TN3 = np.diff(path_TN3, axis=0)
    momentum_T3 = moved_TN3.mean(axis=1) - velocity_N3.mean(axis=0)
    started_3, half = angular(path_TN3[0], velocity_N3), len(velocity_N3) // 2
    turned_T3 = np.array([angular(a + 0.5 * m, m) for a, m in zip(path_TN3[:-1], moved_TN3, strict=True)]) - started_3
    over_T3 = moved_TN3[:, half:].mean(axis=1) - velocity_N3[half:].mean(axis=0)
    relative_3 = velocity_N3[:half].mean(axis=0) - velocity_N3[half:].mean(axis=0)
    return (
        float(np.linalg.norm(momentum_T3, axis=1).max() / np.linalg.norm(velocity_N3.mean(axis=0))),
        float(np.linalg.norm(turned_T3, axis=1).max() / np.linalg.norm(started_3)),
        float(over_T3[-1] @ relative_3 / (relative_3 @ relative_3)),
    )


def wall_distance(config: Any) -> float:
    """Returns the distance from walls, in domain units, within which motion is not checked.

    The solver's walls act up to two finest cells away, relative inputs up to their reach and half a cell.
    """
    return max(2.0, CONTACT_REACH_CELLS + 0.5 if config.relative else 0.0) * config.cell_size


def turned_ratio(outcome: Outcome) -> float | None:
    """Returns the position MSE to the solver in turned gravity, divided by that of the upright scenes."""
    assert outcome.upright is not None
    own, solver = outcome.upright
    if not outcome.complete or any(trial.cause is not None for trial in (*own, *solver)):
        return None
    order = TURNS[outcome.case.labels[0]]

    def mean_mse(trials: Any, order: tuple[int, ...]) -> float:
        pairs = zip(trials, solver, strict=True)
        return float(np.mean([position_mse(one.position_TN3[..., order], true.position_TN3) for one, true in pairs]))

    return mean_mse(outcome.trials, order) / mean_mse(own, (0, 1, 2))


def collapse(outcome: Outcome) -> list[dict[str, float]] | None:
    """Returns spread and mean height, in obstacle cells, and neighbours within a cell, of each scene in `at_frames`.

    The spread is the root mean square distance from the mean along x and z.
    """
    if not outcome.complete:
        return None
    rows: list[dict[str, float]] = []
    for number, (trial, scene) in enumerate(zip(outcome.trials, outcome.scenes, strict=True)):
        for frame in outcome.case.at_frames:
            place_N3 = trial.position_TN3[frame].astype(np.float64) / scene.obstacle_grid.cell_size
            spread = float(np.sqrt(0.5 * place_N3[:, [0, 2]].var(axis=0).sum()))
            own = {"spread": spread, "height": float(place_N3[:, 1].mean()), "neighbours": neighbours(place_N3, 1.0)}
            rows.append({"scene": number, "frame": frame} | own)
    return rows


def rest(outcome: Outcome) -> dict[str, float] | None:
    """Measures the particles of all scenes in frame `settled` and at the end. Lengths are in obstacle cells.

    - `drift`: root mean square displacement between the two frames
    - `height_before`, `height`: mean height at the two frames
    - `neighbours`: number of neighbours within a cell at the end; `density`: its ratio to the number at `settled`
    - `spread`: root mean square distance from the mean along x and z, at the end
    - `squared_speed`: mean squared speed about the scene's mean velocity in the last STIR_FRAMES, (domain units/s)²
    """
    if not outcome.complete:
        return None
    moved, heights, counts, speeds, spreads = [], [], [], [], []
    for trial, scene in zip(outcome.trials, outcome.scenes, strict=True):
        cell = scene.obstacle_grid.cell_size
        last_TN3 = trial.position_TN3[-STIR_FRAMES - 1 :].astype(np.float64)
        velocity_TN3 = outcome.frame_rate_hz * np.diff(last_TN3, axis=0)
        speeds.append(np.square(velocity_TN3 - velocity_TN3.mean(axis=1, keepdims=True)).sum(axis=-1).mean(axis=0))
        pair_2N3 = trial.position_TN3[[outcome.case.settled, -1]].astype(np.float64) / cell
        moved.append(np.square(pair_2N3[1] - pair_2N3[0]).sum(axis=1))
        heights.append(pair_2N3[..., 1])
        spreads.append(0.5 * pair_2N3[1][:, [0, 2]].var(axis=0).sum())
        counts.append([neighbours(place_N3, 1.0) * len(place_N3) for place_N3 in pair_2N3])
    before, after = np.concatenate(heights, axis=1).mean(axis=1)
    first, last = np.sum(counts, axis=0)
    return {
        "drift": float(np.sqrt(np.concatenate(moved).mean())),
        "height_before": float(before),
        "height": float(after),
        "density": float(last / max(first, 1.0)),
        "neighbours": float(last / np.concatenate(heights, axis=1).shape[1]),
        "spread": float(np.sqrt(np.mean(spreads))),
        "squared_speed": float(np.concatenate(speeds).mean()),
    }


MEASURES: dict[str, Callable[[Outcome], Any]] = {
    "energy_growth": energy_growth,
    "energy_rise": energy_rise,
    "outside_domain": outside,
    "share_of_way": share_of_way,
    "throws": throws,
    "gravity_error": gravity_error,
    "kept": kept,
    "momentum": lambda outcome: conserved(outcome)[0],
    "angular": lambda outcome: conserved(outcome)[1],
    "met": lambda outcome: conserved(outcome)[2],
    "turned_ratio": turned_ratio,
    "collapse": collapse,
    "rest": rest,
}
