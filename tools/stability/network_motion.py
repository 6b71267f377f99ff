"""Motion whose right answer is known: flight in any direction and gravity, and bodies that meet without gravity.

A cube of one material flies from the middle of the domain, every frame until the walls could act. Two cubes meet off
centre: momentum and angular momentum are what they were. Judged are means over bodies, in float64.
Shape legend: T frames, N particles.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import cycle, islice
from typing import Any

import numpy as np

from hgn.config import MpmConfig, NetworkConfig, SceneConfig
from hgn.network.relative import CONTACT_REACH_CELLS
from hgn.runtime.rollouts import RolloutResult, simulate_scenes
from hgn.runtime.simulator import InitialState, Simulator
from hgn.scene.scene import Scene
from hgn.schema import ConfigError
from hgn.training.errors import position_mse
from tools.scenes import joined
from tools.solver_rollouts import solver_trials
from tools.stability.network_cases import cube
from tools.stability.row import Row

EARTH = 9.8  # domain units per second squared
SPEEDS = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0)  # domain units per second
ROOT = 3**-0.5
DIRECTIONS = {
    "+x": (1.0, 0.0, 0.0), "-x": (-1.0, 0.0, 0.0), "+z": (0.0, 0.0, 1.0), "-z": (0.0, 0.0, -1.0),
    "up": (0.0, 1.0, 0.0), "down": (0.0, -1.0, 0.0), "diagonal": (ROOT, ROOT, ROOT),
}  # fmt: skip
GRAVITIES = {
    "none": (0.0, 0.0, 0.0),
    "half, sideways": (0.5 * EARTH, 0.0, 0.0),
    "one, upwards": (0.0, EARTH, 0.0),
    "one, oblique": (-ROOT * EARTH, -ROOT * EARTH, ROOT * EARTH),
    "two, downwards": (0.0, -2 * EARTH, 0.0),
    "two, oblique": (1.2 * EARTH, 0.0, -1.6 * EARTH),
}  # domain units per second squared, named in the earth's
TURNS = {"-x": (1, 0, 2), "-z": (0, 2, 1)}  # exchanges of axes that turn upright gravity
AS_GOOD, TO_REST_FRAMES = 1.25, 90  # position MSE, of the upright rollouts'
# of which a mean is taken: a single cube's error is half or twice another's. They begin about the domain's middle,
# within this fraction of its sides
TURNED_CUBES, TURNED_SPREAD = 8, 0.1
KEPT_AT_LEAST, GRAVITY_WITHIN = 0.99, 0.02
FLIGHT_FRAMES = 60  # at most
REACH, BEYOND = 2.0, 0.5  # finest cells of the network from a wall, and from where its contacts end: see judged_reach
MEETING = (1.5, -0.5)  # domain units per second along x, of the two cubes
MEETING_FRAMES = 40
# Beside the solver, what it loses itself comes on top for angular momentum: spin that particles carry within a cell,
# and positions do not show. 0.04 for cubes of snow of 0.08, 0.06 for water, 0.07 for sand.
MOMENTUM_WITHIN, ANGULAR_WITHIN = 0.01, 0.05
MET_AT_LEAST = 0.1  # of the relative velocity, that must go over; beside the solver half of what goes over there


def motion_rows(
    simulator: Simulator,
    scene: SceneConfig,
    materials: Sequence[str],
    cases: Sequence[str],
    together: int | None,
    solver: MpmConfig | None,
) -> Iterator[Row]:
    """Rows of the cases throw, gravity and collision among `cases`, with so many scenes `together` in each rollout;
    none: a row's throws side by side. With settings of the solver that simulates collisions too.
    """
    for material in materials:
        for speed in SPEEDS if "throw" in cases else ():
            throws = {name: speed * np.array(way) for name, way in DIRECTIONS.items()} if speed else {"": np.zeros(3)}
            name = f"thrown at {speed:g} a second, {material}" if speed else f"dropped, {material}"
            yield flight_row(simulator, name, scene, material, throws, together)
        for name, gravity in GRAVITIES.items() if "gravity" in cases else ():
            throws = {"at rest": np.zeros(3), "+x": np.array(DIRECTIONS["+x"]), "up": np.array(DIRECTIONS["up"])}
            other = replace(scene, gravity=gravity)
            yield flight_row(simulator, f"gravity {name}, {material}", other, material, throws, together)
        if "gravity" in cases and solver is not None and len(set(scene.domain_size)) == 1:
            yield from turned_rows(simulator, scene, material, solver)
        if "collision" in cases:
            yield meeting_row(simulator, scene, material, together or 1, solver)


def flight_row(
    simulator: Simulator,
    name: str,
    scene: SceneConfig,
    material: str,
    throws: dict[str, np.ndarray],
    together: int | None,
) -> Row:
    """Whether all throws keep their velocity and fall as gravity says, in each frame of the flight."""
    middle_3, rate = 0.5 * np.array(scene.domain_size), simulator.frame_rate_hz
    together = together or len(throws)
    # full rollouts: the same throws again with other random places
    labels = list(islice(cycle(throws), together * -(-len(throws) // together)))
    scenes = [cube(scene, material, middle_3, throws[label], seed) for seed, label in enumerate(labels)]
    frames = [flight_frames(item, rate, judged_reach(simulator.network.config)) for item in scenes]
    trials: list[RolloutResult] = []
    try:
        for first in range(0, len(scenes), together):
            some = slice(first, first + together)
            trials += _rollouts(simulator, scenes[some], max(frames[some]) + 1)
    except ConfigError as refusal:
        return Row(name, GRAVITY_WITHIN, "refused", False, str(refusal))
    causes = [trial.cause for trial, last in zip(trials, frames, strict=True) if trial.frame_count <= last]
    if causes:
        return Row(name, GRAVITY_WITHIN, "diverged", False, str(causes[0]))
    flights = [flight(*item, rate) for item in zip(trials, scenes, frames, strict=True)]
    label, worst = max(zip(labels, flights, strict=True), key=lambda pair: pair[1]["error"])
    beyond, held = f"gravities off in frame {worst['error_frame']} {label}", worst["error"] <= GRAVITY_WITHIN
    more: dict[str, Any] = {"scenes": together, "particles": sum(item.particle_count for item in scenes[:together])}
    thrown = [pair for pair in zip(labels, flights, strict=True) if pair[1]["kept"] is not None]
    if thrown:
        label, slowed = min(thrown, key=lambda pair: pair[1]["kept"])
        beyond += f"; keeps {slowed['kept']:.1%} of its velocity in frame {slowed['kept_frame']} {label}"
        held, more["kept"] = held and slowed["kept"] >= KEPT_AT_LEAST, slowed["kept"]
    more["throws"] = {
        label: {key: one[key] for key in ("kept", "error", "across", "frames")}
        for label, one in zip(labels[: len(throws)], flights, strict=False)
    }
    return Row(name, GRAVITY_WITHIN, worst["error"], held, beyond, more)


def judged_reach(config: NetworkConfig) -> float:
    """How near to a wall flights are judged, in domain units: beyond what the solver's walls do, and what relative
    inputs know of them.
    """
    return max(REACH, CONTACT_REACH_CELLS + BEYOND if config.relative else 0.0) * config.cell_size


def flight_frames(scene: Scene, frame_rate_hz: float, reach: float) -> int:
    """Frames until a particle of the closed form, or its way on for a frame, comes so near to a wall; at least 1."""
    gravity_3, velocity_3 = np.array(scene.gravity) / frame_rate_hz**2, scene.velocity_N3[0] / frame_rate_hz
    low_3 = scene.position_N3.min(axis=0) - reach - np.abs(gravity_3)
    high_3 = np.array(scene.domain_size) - scene.position_N3.max(axis=0) - reach - np.abs(gravity_3)
    for frame in range(1, FLIGHT_FRAMES + 1):
        moved_3 = frame * velocity_3 + 0.5 * frame**2 * gravity_3
        if (moved_3 < -low_3).any() or (moved_3 > high_3).any():
            return max(frame - 1, 1)
    return FLIGHT_FRAMES


def flight(trial: RolloutResult, scene: Scene, frames: int, frame_rate_hz: float) -> dict[str, Any]:
    """What a flight shows at its worst beside its closed form: the share of its velocity `kept` across gravity (none
    for a drop), the `error` of its acceleration along gravity in gravities (the earth's where there is none), the
    frames of these, and the acceleration `across` gravity on average, in the earth's: what takes velocity away.
    """
    gravity_3 = np.array(scene.gravity) / frame_rate_hz**2
    thrown_3 = scene.velocity_N3[0].astype(np.float64) / frame_rate_hz
    size, speed = float(np.linalg.norm(gravity_3)), float(np.linalg.norm(thrown_3))
    centre_T3 = trial.position_TN3[: frames + 1].mean(axis=1, dtype=np.float64)
    velocity_T3 = np.concatenate([[thrown_3 - 0.5 * gravity_3], np.diff(centre_T3, axis=0)])
    error_T3 = np.diff(velocity_T3, axis=0) - gravity_3
    error_T = (
        np.abs(error_T3 @ gravity_3) / size**2 if size else np.linalg.norm(error_T3, axis=1) * frame_rate_hz**2 / EARTH
    )
    lost_T3 = velocity_T3[1:] - thrown_3
    if size:  # across gravity alone
        lost_T3 = lost_T3 - np.outer(lost_T3 @ gravity_3, gravity_3) / size**2
    lost_T = np.linalg.norm(lost_T3, axis=1)
    return {
        "kept": 1 - float(lost_T.max()) / speed if speed else None,
        "kept_frame": int(lost_T.argmax()),
        "error": float(error_T.max()),
        "error_frame": int(error_T.argmax()),
        "across": float(lost_T[-1]) / frames * frame_rate_hz**2 / EARTH,
        "frames": frames,
    }


def turned_rows(simulator: Simulator, scene: SceneConfig, material: str, solver: MpmConfig) -> Iterator[Row]:
    """Whether cubes that fall and come to rest are as near to the solver where the scenes and gravity are turned."""
    begun_K3 = 0.5 + TURNED_SPREAD * (2 * np.random.default_rng(0).random((TURNED_CUBES, 3)) - 1)
    places_K3 = begun_K3 * np.array(scene.domain_size)
    upright = [cube(scene, material, place_3, np.zeros(3), seed) for seed, place_3 in enumerate(places_K3)]
    reference: list[RolloutResult] = []
    straight: list[RolloutResult] = []
    for way, order in TURNS.items():
        name = f"to rest in gravity along {way}, {material}"
        x, y, z = (upright[0].gravity[axis] for axis in order)
        turned = [replace(each, position_N3=each.position_N3[:, order], gravity=(x, y, z)) for each in upright]
        try:
            back = _rollouts(simulator, turned, TO_REST_FRAMES)
        except ConfigError as refusal:
            yield Row(name, AS_GOOD, "refused", False, str(refusal))
            continue
        if not reference:  # seconds on a GPU, a minute on a CPU
            straight = _rollouts(simulator, upright, TO_REST_FRAMES)
            reference = solver_trials(upright, solver, TO_REST_FRAMES, simulator.frame_rate_hz)
        causes = [trial.cause for trial in (*straight, *back, *reference) if trial.cause is not None]
        if causes:
            yield Row(name, AS_GOOD, "diverged", False, causes[0])
            continue
        own, other = _mean_mse(straight, reference, (0, 1, 2)), _mean_mse(back, reference, order)
        more = {"upright_mse": own, "turned_mse": other, "cubes": TURNED_CUBES}
        beyond = "times the upright rollouts' position MSE to the solver"
        yield Row(name, AS_GOOD, other / own, other <= AS_GOOD * own, beyond, more)


def _mean_mse(trials: Sequence[RolloutResult], reference: Sequence[RolloutResult], order: tuple[int, ...]) -> float:
    """Of all frames and scenes, once the trials' axes are put in this order."""
    pairs = zip(trials, reference, strict=True)
    return float(np.mean([position_mse(own.position_TN3[..., order], true.position_TN3) for own, true in pairs]))


def meeting_row(
    simulator: Simulator, scene: SceneConfig, material: str, together: int, solver: MpmConfig | None
) -> Row:
    """Whether two cubes that meet off centre, without gravity, keep momentum and angular momentum."""
    name, rate = f"two bodies meet without gravity, {material}", simulator.frame_rate_hz
    scenes = [meeting(scene, material, seed) for seed in range(together)]
    try:
        trials = _rollouts(simulator, scenes, MEETING_FRAMES)
    except ConfigError as refusal:
        return Row(name, MOMENTUM_WITHIN, "refused", False, str(refusal))
    reach = judged_reach(simulator.network.config)
    figures = np.array([conserved(*item, reach, rate) for item in zip(trials, scenes, strict=True)])
    momentum, angular, met = (float(value) for value in (*figures[:, :2].max(axis=0), figures[:, 2].min()))
    particles = sum(item.particle_count for item in scenes)
    more: dict[str, Any] = {"angular": angular, "met": met, "particles": particles}
    least, most = MET_AT_LEAST, ANGULAR_WITHIN
    if solver is not None:
        (trial,) = solver_trials(scenes[:1], solver, MEETING_FRAMES, rate)
        beside = conserved(trial, scenes[0], reach, rate)
        more["solver"] = dict(zip(("momentum", "angular", "met"), beside, strict=True))
        least, most = 0.5 * beside[2], ANGULAR_WITHIN + beside[1]
    causes = [trial.cause for trial in trials if trial.cause is not None]
    held = not causes and momentum <= MOMENTUM_WITHIN and angular <= most and met >= least
    beyond = f"of momentum; {angular:.2%} of angular momentum; {met:.2f} of the relative velocity went over"
    return Row(name, MOMENTUM_WITHIN, momentum, held, causes[0] if causes else beyond, more)


def meeting(scene: SceneConfig, material: str, seed: int = 0) -> Scene:
    """Two cubes a fifth of their side apart, half of it off centre, that move towards each other along x."""
    size, middle_3 = scene.group_size, 0.5 * np.array(scene.domain_size)
    scene = replace(scene, gravity=(0.0, 0.0, 0.0))
    cubes = []
    for i, (side, speed) in enumerate(zip((-1, 1), MEETING, strict=True)):
        centre_3 = middle_3 + side * size * np.array([0.6, 0.25, 0.0])
        cubes.append(cube(scene, material, centre_3, np.array([speed, 0, 0]), 2 * seed + i))
    return joined(cubes)


def conserved(trial: RolloutResult, scene: Scene, reach: float, frame_rate_hz: float) -> tuple[float, float, float]:
    """The largest errors of momentum and of angular momentum about the centre, in shares of the first ones, until a
    particle comes so near to a wall; and the share of the relative velocity that went from one half of the particles to
    the other.
    """
    path_TN3, high_3 = trial.position_TN3.astype(np.float64), np.array(scene.domain_size) - reach
    free_T = ((path_TN3 > reach) & (path_TN3 < high_3)).all(axis=(1, 2))
    path_TN3 = path_TN3[: int(free_T.argmin()) if not free_T.all() else None]
    velocity_N3 = scene.velocity_N3.astype(np.float64) / frame_rate_hz

    def angular(place_N3: np.ndarray, moving_N3: np.ndarray) -> np.ndarray:
        return np.cross(place_N3 - place_N3.mean(axis=0), moving_N3 - moving_N3.mean(axis=0)).sum(axis=0)

    moved_TN3 = np.diff(path_TN3, axis=0)
    momentum_T3 = moved_TN3.mean(axis=1) - velocity_N3.mean(axis=0)
    begun_3, half = angular(path_TN3[0], velocity_N3), len(velocity_N3) // 2
    turned_T3 = np.array([angular(a + 0.5 * m, m) for a, m in zip(path_TN3[:-1], moved_TN3, strict=True)]) - begun_3
    over_T3 = moved_TN3[:, half:].mean(axis=1) - velocity_N3[half:].mean(axis=0)
    relative_3 = velocity_N3[:half].mean(axis=0) - velocity_N3[half:].mean(axis=0)
    return (
        float(np.linalg.norm(momentum_T3, axis=1).max() / np.linalg.norm(velocity_N3.mean(axis=0))),
        float(np.linalg.norm(turned_T3, axis=1).max() / np.linalg.norm(begun_3)),
        float(over_T3[-1] @ relative_3 / (relative_3 @ relative_3)),
    )


def _rollouts(simulator: Simulator, scenes: Sequence[Scene], frames: int) -> list[RolloutResult]:
    """Side by side. Raises: ConfigError where the weights refuse the scenes."""
    return simulate_scenes(simulator, [InitialState.of_scene(scene) for scene in scenes], frames)
