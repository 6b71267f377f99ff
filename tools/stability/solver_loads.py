"""Stiff and fast: stiffness, speed of impact, convergence of the default step, a long run."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from datagen.mpm.solver import SceneFailure, Simulated, particle_bounds, simulate
from hgn.config import MpmConfig
from hgn.scene.material import MATERIALS, SNOW
from hgn.scene.scene import Scene
from tools.stability.row import Row
from tools.stability.solver_scenes import block, centre_cells, front_cells, height_cells, thickness_cells

FRAME_RATE_HZ = 60.0
STIFFNESS = (1.0, 10.0, 100.0, 1000.0)
SPEEDS = (5.0, 10.0, 20.0, 30.0)
ENERGY = 1.01  # kinetic, of what a scene begins with and falls through; a hundredth is rounding and the frames' own
TOUCHED = ("floors", "caps", "clamps", "bounds")  # of the names of counters
CONVERGED = 0.03  # of height or front, from a step to half of it
CONVERGENCE_RATE_HZ = 240.0
RESOLVED_CELLS = 2.0
LONG_SUBSTEPS = 100_000
DROP_CELLS = 1.0  # between floor and block


def stiffnesses(base: MpmConfig) -> list[Row]:
    """Blocks that hit the floor at 3 m/s, up to a thousand times as stiff; and soft beside stiff in one scene."""
    rows = []
    for stiffness in STIFFNESS:
        config = dataclasses.replace(base, youngs_modulus_pa=base.youngs_modulus_pa * stiffness)
        outcomes = simulate([_falling(kind, 3.0) for kind in range(3)], config, 7, FRAME_RATE_HZ)
        rows += [
            _bounded(f"stiffness x{stiffness:g}, {MATERIALS[kind]} at 3 m/s", outcome, _falling(kind, 3.0), config)
            for kind, outcome in enumerate(outcomes)
        ]
    soft = _falling(SNOW, 3.0)
    modulus = np.full(soft.particle_count, base.youngs_modulus_pa, np.float32)
    modulus[soft.position_N3[:, 0] > soft.position_N3[:, 0].mean()] *= STIFFNESS[-1]
    contrast = dataclasses.replace(soft, material_parameters={"youngs_modulus_pa": modulus})
    (outcome,) = simulate([contrast], base, 7, FRAME_RATE_HZ)
    return [*rows, _bounded(f"stiffness contrast 1:{STIFFNESS[-1]:g}, snow at 3 m/s", outcome, contrast, base)]


def impacts(base: MpmConfig) -> list[Row]:
    """Blocks and single particles that hit the floor at up to 30 m/s."""
    cases = [
        (f"impact at {speed:g} m/s, {what} of {MATERIALS[kind]}", _falling(kind, speed, size))
        for speed in SPEEDS
        for kind in range(3)
        for what, size in (("block", 4.0), ("particle", 0.1))
    ]
    outcomes = simulate([scene for _, scene in cases], base, 13, FRAME_RATE_HZ)
    return [_bounded(name, outcome, scene, base) for (name, scene), outcome in zip(cases, outcomes, strict=True)]


def convergence(base: MpmConfig) -> list[Row]:
    """Heights of blocks that hit the floor and fronts of collapsing columns, at the default step and at half of it.

    Each row is the largest change of all frames in which the material is at least two cells thick and its centre still
    sinks: a film of less than a particle a column, and what flies off, have no height. Beside it stand two floors: what
    a displacement of 1e-6 of all particles changes, and what another random filling does. Transfers stay at their own
    rate, which is part of the grid's resolution: what smooths velocities is their number (see results/solver).
    """
    half = dataclasses.replace(base, stability_fraction=base.stability_fraction / 2)
    cases: list[tuple[str, Callable[[int], Scene], dict[str, Callable[[np.ndarray], float]]]] = [
        (
            f"a block of {MATERIALS[kind]} at {speed:g} m/s",
            lambda seed, kind=kind, speed=speed: _falling(kind, speed, 8.0, seed),  # type: ignore[misc]
            {"height": height_cells, "centre": centre_cells},
        )
        for speed in (4.5, 10.0)
        for kind in range(3)
    ]
    cases += [
        (
            f"a column of {MATERIALS[kind]}",
            lambda seed, kind=kind: block(kind, (2, 2, 28), (6, 12, 8), seed=seed),  # type: ignore[misc]
            {"height": height_cells, "front": front_cells},
        )
        for kind in range(3)
    ]
    rows = []
    for name, make, measures in cases:
        frames = 1 + round(CONVERGENCE_RATE_HZ * (0.4 if "column" in name else 0.1))
        shift = np.random.default_rng(1).standard_normal((make(0).particle_count, 3)).astype(np.float32)
        moved = dataclasses.replace(make(0), position_N3=make(0).position_N3 + np.float32(1e-6) * shift)
        paths, counts = [], []
        for config, scenes in ((base, [make(0), moved, make(1)]), (half, [make(0)])):
            for outcome in simulate(scenes, config, frames, CONVERGENCE_RATE_HZ):
                assert isinstance(outcome, Simulated), (name, outcome)
                paths.append(outcome.position_TN3.astype(np.float64))
                counts.append({name: outcome.counters[name] for name in ("substeps", "transfers")})
        whole, shifted, filled, fine = paths
        until = _sinks_until(whole)
        for measure, value in measures.items():
            series = [np.array([value(x) for x in path[:until]]) for path in (whole, shifted, filled, fine)]
            change, chaos, filling = ((np.abs(other / series[0] - 1)).max() for other in (series[3], *series[1:3]))
            beyond = (
                f"floors: {chaos:.1%} by 1e-6, {filling:.1%} by another filling; {series[0][0]:.3g} cells became "
                f"{series[0][-1]:.4g}, and {series[3][-1]:.4g} at half the step"
            )
            more: dict[str, Any] = {"displaced": float(chaos), "filled_anew": float(filling), "frames": until}
            more |= {"default_step": counts[0], "half_the_step": counts[3]}
            case = f"half the step: {measure} of {name}"
            rows.append(Row(case, CONVERGED, float(change), bool(change < CONVERGED), beyond, more))
    return rows


def _sinks_until(path_TN3: np.ndarray) -> int:
    """The number of frames until the material is thinner than two cells or its centre no longer sinks."""
    thin = np.array([thickness_cells(position) for position in path_TN3]) < RESOLVED_CELLS
    rises = np.append(np.diff(path_TN3[:, :, 1].mean(axis=1)) > 0, False)
    return int(np.argmax(np.append(thin | rises, True)))


def long_run(base: MpmConfig) -> list[Row]:
    """A small scene of all three materials for 100,000 substeps: nothing drifts, sinks or comes alive."""
    config = dataclasses.replace(base, time_step="fixed", fixed_time_step_s=1.5e-4)
    joined = [block(kind, (4 + 6 * kind, 3.5, 4), (3, 3, 3), seed=kind) for kind in range(3)]
    scene = Scene(
        np.concatenate([part.position_N3 for part in joined]), np.concatenate([part.velocity_N3 for part in joined]),
        np.concatenate([part.material_N for part in joined]), cell_size=joined[0].cell_size,
        domain_size=(24 / 64, 24 / 64, 24 / 64),
    )  # fmt: skip
    frames = 1 + math.ceil(LONG_SUBSTEPS / math.ceil(1 / (FRAME_RATE_HZ * config.fixed_time_step_s)))
    (outcome,) = simulate([scene], config, frames, FRAME_RATE_HZ)
    if isinstance(outcome, SceneFailure):
        return [Row("long run", LONG_SUBSTEPS, 0.0, False, outcome.cause)]
    last = outcome.position_TN3[-60:].astype(float)
    speed = float(np.sqrt((np.diff(last, axis=0) ** 2).sum(axis=2).mean())) * FRAME_RATE_HZ
    steps = float(outcome.counters["substeps"])
    beyond = f"root mean square speed over the last second {speed:.2g} m/s"
    return [Row("long run, three materials", LONG_SUBSTEPS, steps, steps >= LONG_SUBSTEPS and speed < 0.05, beyond)]


def _falling(kind: int, speed: float, size: float = 4.0, seed: int = 0) -> Scene:
    return block(kind, (30, 3 + DROP_CELLS, 30), (size, size, size), (0, -speed, 0), seed)


def _bounded(name: str, outcome: Simulated | SceneFailure, scene: Scene, config: MpmConfig) -> Row:
    """That it stays finite and inside, and that no kinetic energy comes from nowhere."""
    if isinstance(outcome, SceneFailure):
        return Row(name, ENERGY, "stopped", False, outcome.cause)
    low, high = particle_bounds(scene, config)
    inside = bool(((outcome.position_TN3 >= low) & (outcome.position_TN3 <= high)).all())
    path = outcome.position_TN3.astype(float)
    square = ((np.diff(path, axis=0) * FRAME_RATE_HZ) ** 2).sum(axis=2).mean(axis=1)
    start = float((scene.velocity_N3.astype(float) ** 2).sum(axis=1).mean())
    fallen = path[0, :, 1].mean() - path[1:, :, 1].mean(axis=1)
    energy = float((square / (start + 2 * abs(scene.gravity[1]) * np.maximum(fallen, 0))).max())
    floors = {key: value for key, value in outcome.counters.items() if value and key.endswith(TOUCHED)}
    noted = ", ".join(f"{value} {key.replace('_', ' ')}" for key, value in floors.items()) or "no floor touched"
    more = {key: outcome.counters[key] for key in ("substeps", "smallest_time_step_s", "largest_speed")}
    return Row(name, ENERGY, energy, inside and energy <= ENERGY, noted, more)
